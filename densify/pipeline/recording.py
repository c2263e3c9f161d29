# SPDX-License-Identifier: MIT
"""A recording, and the pipeline steps computed once for a block of neighbouring keys::

    registration   poses of the block's sweeps, one world per piece
    deskewed       sweeps in the world of their piece
    ground         height map
    motion         scene flow of all points, from free-space violations
    far            static surfaces along the road beyond the windows

A block is split into pieces at sweeps that cannot be read or registered, and at holes in time.
Blocks are cut around the keys, and no other sweeps are read (`densify.pipeline.sweeps`).
Registration, motion and far are cached.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar, cast

import numpy as np

from densify.config import Config
from densify.config.cache import Cache, code_digest, kept
from densify.config.errors import InputError, SweepError, UnfitSweepError
from densify.config.plugins import engine as engine_row
from densify.depth.rays import Rays, complete_boxes
from densify.flow.engines import Scene, SharedMotion, estimate_motion
from densify.free_space.ground import HeightMap, ground
from densify.free_space.raw_sweeps import MAP_FRAME_REMEDY, in_map_frame
from densify.geometry import poses
from densify.geometry.types import (
    Cloud,
    Float,
    FlowField,
    LidarSequence,
    Motion,
    ObjectTrack,
    RegisteredSweep,
    StandingWorld,
    Stretch,
    StretchFlow,
    Sweep,
    Trajectory,
)
from densify.pipeline.accumulate import accumulate, object_tracks
from densify.pipeline.process import Watch
from densify.pipeline.road import Road, views_of
from densify.pipeline.sweeps import Cut, Sweeps
from densify.readers.timeline import (
    Timeline,
    WindowFrames,
    format_frames,
    recorded_trajectory,
)
from densify.registration.deskew import deskew
from densify.registration.trajectory import LeftOut, Registration, find_trajectory

T = TypeVar("T")
P = ParamSpec("P")
_LEAD_IN_S = 0.5  # before a window or a block, in which odometry settles
_MIN_LEAD_IN = 2  # sweeps that show the speed
_SOME = 8  # every eighth point tells the share of points below the ground


def _latest(
    method: Callable[Concatenate[Recording, P], T],
) -> Callable[Concatenate[Recording, P], T]:
    """Keep the result of a method's latest call in memory, for calls with equal arguments."""

    @wraps(method)
    def call(recording: Recording, *args: P.args, **kwargs: P.kwargs) -> T:
        step = recording._results.get(method.__name__)
        if step is None or step[0] != args:
            step = recording._results[method.__name__] = args, method(recording, *args, **kwargs)
        return cast(T, step[1])

    return call


@dataclass(frozen=True, eq=False)
class Piece:
    """Consecutive registered sweeps of one block that share a world."""

    number: int  # index of the block
    row: int  # index of the piece in the block
    # Poses of the piece's sweeps and of one before them, in the first's levelled lidar frame
    poses: Trajectory
    frames: tuple[int, ...]  # frame numbers of the piece's sweeps
    deskewed: dict[int, RegisteredSweep]  # its sweeps in its world, by frame, as they are needed

    def pose(self, frame: int) -> Float:
        """Return the pose ``T_world_lidar`` (4,4) of a sweep in the world of the piece."""
        pose: Float = self.poses.T_world_lidar[self.poses.frames.index(frame)]
        return pose


class Moment(NamedTuple):
    """Accumulated points at a key's time, flow from sweep to sweep (or None), objects' tracks."""

    cloud: Cloud
    flow: StretchFlow | None
    tracks: tuple[ObjectTrack, ...]


class Beyond(NamedTuple):
    """Static surfaces beyond a key's window, and the (4,4) pose of their world in the key frame."""

    standing: StandingWorld
    T_key_standing: Float


class Recording:
    """A sequence with its settings; computes pipeline steps and keeps recent results in memory."""

    def __init__(
        self,
        sequence: LidarSequence,
        settings: Config,
        window: int,
        keys: Collection[int] | None = None,
        cache: Cache | None = None,
        run: str | None = None,
        watch: Watch | None = None,
        looks_around: bool = False,
    ) -> None:
        """Read the time stamps, and cut the sweeps into blocks that are computed together.

        Args:
            window: Number of sweeps on each side of a key.
            keys: Frame numbers, around which sweeps are read; None for every frame.
            run: Name of a run whose processes share results through the cache; None for no sharing.
            looks_around: True also searches motion ``flow.look_around_s`` beyond the windows.
        """
        self.sequence, self.settings = sequence, settings
        self.timeline = timeline = Timeline.of(sequence)
        self._num_around, self._watch, self._cache = window, watch or Watch(), cache
        keys = timeline.frames if keys is None else keys
        Cut.of(timeline, window, keys)  # refuses bad ones before a sweep is read
        looks_around &= engine_row(settings.flow.engine)[0].shared
        around_s, step_s = self._look_around(keys) if looks_around else (0.0, 0.0)
        self.cut = Cut.of(timeline, window, keys, around_s)
        self._step_around = max(1, timeline.num_in(step_s))
        # The sweeps around a window count as lead-in, too.
        self._num_lead_in = max(_MIN_LEAD_IN, timeline.num_in(_LEAD_IN_S - around_s))
        self._run = run
        num_raw = max(map(len, self.cut.blocks), default=0) + self._num_lead_in
        self.sweeps = Sweeps(
            sequence, timeline, settings.register, num_raw, cache, run, self._watch
        )
        self._results: dict[str, tuple[tuple[Any, ...], Any]] = {}  # of `_latest`, by method

    def _look_around(self, keys: Collection[int]) -> tuple[float, float]:
        """Return seconds around windows, and between sweeps, in which motion is searched."""
        if not keys or self.settings.flow.look_around_s == 0:
            return 0.0, 0.0
        for key in sorted(keys):
            with suppress(InputError):  # raised again where the key is made
                num_points = len(self.sequence[key])
                return self.settings.flow.around(num_points / (self.timeline.period_ns * 1e-9))
        return 0.0, 0.0

    def window_frames(self, key: int) -> WindowFrames:
        """Return the frames of a key's window, and the reasons if it is smaller than requested.

        Raises InputError if the key does not exist or is unusable, UnplacedSweepError if it cannot
        be registered, SweepError if none of its neighbours can be registered.
        """
        whole = self.timeline.window(key, self._num_around)
        number = self.cut.number_of[key]
        block = self.cut.blocks[number]
        bad = {f: why for f, why in self.registration(number).bad.items() if f in block}
        if key in bad:
            raise bad[key].error(key)
        reasons = {f: why.reason for f, why in bad.items()}
        window = self.timeline.window(key, self._num_around, reasons)
        piece = frozenset(self._piece(key).poses.frames)
        window = WindowFrames(tuple(f for f in window.frames if f in piece), window.cuts)
        failed = [f for f in whole.frames if f in bad and not bad[f].unreadable]
        if failed and len(window.frames) == 1:
            raise bad[failed[0]].error(failed[0])
        return window

    def window(self, key: int) -> Stretch:
        """Return the registered, deskewed sweeps of a key's window. Raises as `window_frames`."""
        frames = self.window_frames(key).frames  # raises first
        return self._stretch(self._piece(key), frames)

    def around(self, key: int) -> Stretch:
        """Return the registered sweeps, within and around a key's window, searched for motion."""
        piece = self._piece(key)
        return self._stretch(piece, self._searched(piece))

    def is_pair(self, key: int) -> bool:
        """Return True if motion of a key is searched in only two sweeps; a track needs three."""
        return len(self._searched(self._piece(key))) == 2

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """Return the flow of all points in a key's window; ``engine`` None is ``flow.engine``."""
        engine = engine or self.settings.flow.engine
        window, piece = self.window(key), self._piece(key)
        # Two sweeps are too few for ``groups``.
        if engine == "groups" and self.is_pair(key):
            engine = "pairs"
        if not engine_row(engine)[0].shared:
            scene = Scene(window, self._ground(piece))
            return estimate_motion(scene, self.settings, engine)
        # All poses, but points only for the sweeps of the window.
        with_points = {s.frame: s for s in window.sweeps}
        sweeps = [
            with_points.get(f) or RegisteredSweep.without_points(piece.poses, f)
            for f in self._searched(piece)
        ]
        return self._motion(piece, engine).with_stretch(Stretch(tuple(sweeps)))

    def step(self, frame: int) -> StretchFlow:
        """Return the flow of a sweep to the next, or else previous sweep; empty without either."""
        window = self.window(frame)
        beside = [f for f in window.frames if f > frame] or [f for f in window.frames if f < frame]
        if not beside:
            return StretchFlow(window, {})
        step = (frame, beside[0])
        return StretchFlow(window, {step: self.motion(frame).flow(*step)})

    def moment(
        self, key: int, all_sweeps: bool, engine: str | None, with_flow: bool = False
    ) -> Moment:
        """Accumulate the key sweep, or all sweeps of its window, at the key's reference time.

        The scene flow is by ``engine``, "" for the configured engine, None for rigid accumulation.
        ``with_flow`` also returns the flow of every sweep to the next sweep towards the key.
        """
        stretch, flow = self.window(key), None
        tracks: tuple[ObjectTrack, ...] = ()
        used = stretch if all_sweeps else Stretch((stretch[key],))
        fields = [FlowField.zero(len(s.sweep)) for s in used.sweeps]
        if engine is not None:
            with self._watch.stage("flow"):
                motion = self.motion(key, engine)
                fields = [motion.flow(frame, key) for frame in stretch.frames]
                tracks = object_tracks(stretch, fields, key)
                if with_flow:
                    flow = StretchFlow.towards(key, stretch, motion)
        with self._watch.stage("accumulate"):
            drop_lost = self.settings.accumulate.unfollowed == "drop"
            cloud = accumulate(used, fields, key, drop_lost)
            heights = self._ground(self._piece(key))
            tracks = complete_boxes(tracks, cloud, Rays(used, key), heights)
            deep = heights.below(cloud.rigid_points, stretch[key].T_world_lidar)
            return Moment(cloud.select(~deep) if deep.any() else cloud, flow, tracks)

    def share_below(self, key: int) -> float:
        """Return the share of the points of a key's window that lie below the ground."""
        heights, sweeps = self._ground(self._piece(key)), self.window(key).sweeps
        deep = [heights.below(s.sweep.points[::_SOME], s.T_world_lidar) for s in sweeps]
        return float(np.concatenate(deep).mean())

    def standing(self, key: int) -> Beyond | None:
        """Return the static surfaces along the road beyond the key's window, None without any."""
        if not self.settings.accumulate.far_m:  # not requested
            return None
        piece = self._piece(key)
        surfaces = self._far(piece)
        return Beyond(surfaces, poses.inverse(piece.pose(key))) if surfaces.frames else None

    def _piece(self, key: int) -> Piece:
        pieces = self._pieces(self.cut.number_of[key])
        return next(piece for piece in pieces if key in piece.frames)

    @_latest
    def registration(self, number: int) -> Registration:
        """Register each run of consecutive sweeps, split at sweeps that cannot be registered."""
        frames = self._registered_together(number)

        def make() -> Registration:
            self.sweeps.prepare(frames)
            sweeps, bad, pieces = {}, {}, []
            for frame in frames:
                try:
                    self.sweeps.recorded_pose(frame)
                    sweeps[frame] = self.sweeps.read(frame)
                except InputError as error:
                    bad[frame] = LeftOut(str(error), unreadable=True)
            remaining = self.timeline.runs(sweeps)
            while remaining:
                together = remaining.pop()
                try:
                    pieces.append(self._register([sweeps[f] for f in together]))
                except SweepError as error:
                    unfit = isinstance(error, UnfitSweepError)
                    bad[error.frame] = LeftOut(str(error), unreadable=False, unfit=unfit)
                    remaining += self.timeline.runs([f for f in together if f != error.frame])
            return Registration(tuple(sorted(pieces, key=lambda p: p.frames)), bad)

        return self._kept("registration", frames, make)

    def _register(self, sweeps: Sequence[Sweep]) -> Trajectory:
        """Return the poses of consecutive sweeps; raise InputError if they are in a map's frame."""
        settings = self.settings.register
        is_recorded = settings.source == "dataset"
        recorded = recorded_trajectory(self.sequence, sweeps) if is_recorded else None
        with self._watch.stage("register"):
            trajectory = find_trajectory(sweeps, settings, recorded)
        symptom = in_map_frame(sweeps, trajectory, recorded)
        if symptom:
            ends = format_frames([sweeps[0].frame, sweeps[-1].frame])
            raise InputError(
                f"{self.sequence.name}: sweeps {ends} are in the "
                f"frame of a map: {symptom}; expected each in its scanner's own frame: "
                f"{MAP_FRAME_REMEDY}"
            )
        return trajectory

    def _registered_together(self, number: int) -> list[int]:
        """Return the frames of a block's lead-in, then of the block."""
        block = self.cut.blocks[number]
        return [*self.timeline.before(block[0], self._num_lead_in), *block]

    @_latest
    def _pieces(self, number: int) -> list[Piece]:
        """Return the pieces of a block, with their poses."""
        block = frozenset(self.cut.blocks[number])
        wanted = block.union(self.timeline.before(self.cut.blocks[number][0], 1))
        pieces = list[Piece]()
        for piece in self.registration(number).pieces:
            frames = tuple(f for f in piece.frames if f in block)
            if frames:
                trajectory = piece.part([f for f in piece.frames if f in wanted], origin=frames[0])
                pieces.append(Piece(number, len(pieces), trajectory, frames, {}))
        return pieces

    def _stretch(self, piece: Piece, frames: Sequence[int]) -> Stretch:
        """Return deskewed sweeps of a piece, in its world."""
        for frame in frames:
            if frame not in piece.deskewed:
                sweep = self.sweeps.read(frame)
                with self._watch.stage("deskew"):
                    piece.deskewed[frame] = deskew([sweep], piece.poses).sweeps[0]
        return Stretch(tuple(piece.deskewed[frame] for frame in frames))

    @_latest
    def _searched(self, piece: Piece) -> tuple[int, ...]:
        """Return the frames of a piece where motion is searched: windows, and every n-th around."""
        frames, inside = piece.frames, self._in_windows(piece.number)
        inside_rows = np.flatnonzero([frame in inside for frame in frames])
        if self._step_around == 1 or not len(inside_rows):
            return frames
        num_away = np.abs(np.arange(len(frames))[:, None] - inside_rows).min(axis=1)
        return tuple(f for f, n in zip(frames, num_away, strict=True) if n % self._step_around == 0)

    @_latest
    def _ground(self, piece: Piece) -> HeightMap:
        """Return the height map of the ground of a piece."""
        stretch = self._stretch(piece, self._searched(piece))
        with self._watch.stage("ground"):
            return ground(stretch)

    @_latest
    def _motion(self, piece: Piece, engine: str) -> SharedMotion:
        """Return the scene flow in a piece, without the sweeps to keep the cache small."""
        asked, frames = self._in_windows(piece.number), self._searched(piece)

        def make() -> SharedMotion:
            stretch, heights = self._stretch(piece, frames), self._ground(piece)
            with self._watch.stage("flow"):
                scene = Scene(stretch, heights, asked=asked)
                motion = estimate_motion(scene, self.settings, engine)
            return cast(SharedMotion, motion).with_stretch(Stretch(()))

        settings = [engine, self.settings.flow, self.settings.objective, sorted(asked), piece.row]
        return self._kept("motion", self._registered_together(piece.number), make, settings)

    @_latest
    def _far(self, piece: Piece) -> StandingWorld:
        """Return the static surfaces along the road of a piece, in the piece's world."""
        # Sweeps of the block outside the windows belong to the far range.
        inside = self._in_windows(piece.number)
        in_windows = tuple(f for f in piece.frames if f in inside) or piece.frames

        def make() -> StandingWorld:
            keys = [k for k in self.cut.keys_of(piece.number) if k in in_windows]
            window, cameras = self._stretch(piece, in_windows), self.sequence.cameras.values()
            with self._watch.stage("far"):
                views, far_m = views_of(cameras, window, keys), self.settings.accumulate.far_m
                register = self.settings.register
                road = Road(self.timeline, self.sweeps, register, far_m, window, views)
                return road.find_standing(with_window=len(keys) > 1)

        # Processes of one run share the result. A digest would read every sweep of the road.
        shared = self._cache if self._run is not None else None
        inputs = [code_digest(), self._run, self.sequence.name, piece.number, piece.row]
        return kept(shared, "far", lambda: inputs, make)

    def _in_windows(self, number: int) -> frozenset[int]:
        """Return the frames of the windows of a block's keys."""
        keys = self.cut.keys_of(number)
        windows = (self.timeline.window(key, self._num_around).frames for key in keys)
        return frozenset(frame for frames in windows for frame in frames)

    def _kept(
        self,
        step: str,
        frames: Iterable[int],
        make: Callable[[], T],
        settings: Sequence[Any] = (),
    ) -> T:
        """Return the result of ``make``, or the cached result for the same sweeps and settings."""

        def inputs() -> Any:
            content = [(f, self.sweeps.content(f)) for f in frames]
            code, period_ns = code_digest(), self.timeline.period_ns
            return [code, self.settings.register, period_ns, content, list(settings)]

        return kept(self._cache, step, inputs, make)
