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
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from densify.config import Config
from densify.config.cache import Cache, code_digest, kept
from densify.config.errors import InputError, SweepError, UnfitSweepError
from densify.config.plugins import engine as engine_row
from densify.depth.rays import Rays, complete_boxes
from densify.flow.engines import Scene, SharedMotion, estimate_motion
from densify.free_space.ground import HeightMap, ground
from densify.free_space.sweep_frame import MAP_FRAME_REMEDY, are_placed, is_still, way_in_map
from densify.geometry import poses
from densify.geometry.types import (
    Cloud,
    Float,
    FlowField,
    Int,
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
from densify.pipeline.costs import Watch
from densify.pipeline.road import Road
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
LEAD_IN_S = 0.5  # before a window or a block, in which odometry settles
_TELL_SPEED = 2  # sweeps
_SOME = 8  # every eighth point tells the share of points below the ground


class Piece(NamedTuple):
    """Consecutive registered sweeps of one block that share a world."""

    number: int  # index of the block
    row: int  # index of the piece in the block
    # Poses of the piece's sweeps and of one before them, in the first's levelled lidar frame
    poses: Trajectory
    frames: tuple[int, ...]  # frame numbers of the piece's sweeps


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
        self._num_lead_in = max(_TELL_SPEED, timeline.num_in(LEAD_IN_S - around_s))
        self._run = run
        longest_block = max((len(block) for block in self.cut.blocks), default=0)
        num_raw = longest_block + self._num_lead_in
        self._sweeps = Sweeps(
            sequence, timeline, settings.register, num_raw, cache, run, self._watch
        )
        self.forget_raw = self._sweeps.read.cache_clear
        self.registration = lru_cache(maxsize=2)(self._registration)
        self._pieces = lru_cache(maxsize=2)(self._find_pieces)
        # Keyed by the index of the block and of the piece, because a Piece cannot be hashed.
        self._deskewed = lru_cache(maxsize=longest_block)(self._deskew)
        self._stretch = lru_cache(maxsize=1)(self._make_stretch)
        self._searched = lru_cache(maxsize=2)(self._find_searched)
        self._ground = lru_cache(maxsize=2)(self._find_ground)
        self._motion = lru_cache(maxsize=2)(self._find_motion)
        self._far = lru_cache(maxsize=1)(self._find_far)

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
        return self._stretch(self.cut.number_of[key], self.window_frames(key).frames)

    def raw(self, frame: int) -> Sweep:
        """Return a raw sweep (not deskewed), without returns of the own vehicle."""
        return self._sweeps.read(frame)

    def returns(self, frames: Sequence[int]) -> Int:
        """Return the (n,360) number of returns of raw sweeps in each degree of azimuth."""
        for frame in [f for f in frames if f not in self._sweeps.returns]:
            self.raw(frame)
        return np.stack([self._sweeps.returns[frame] for frame in frames])

    def around(self, key: int) -> Stretch:
        """Return the registered sweeps, within and around a key's window, searched for motion."""
        piece = self._piece(key)
        return self._stretch(piece.number, self._searched(piece.number, piece.row))

    def is_pair(self, key: int) -> bool:
        """Return True if motion of a key is searched in only two sweeps; a track needs three."""
        piece = self._piece(key)
        return len(self._searched(piece.number, piece.row)) == 2

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """Return the flow of all points in a key's window; ``engine`` None is ``flow.engine``."""
        engine, window, piece = (
            engine or self.settings.flow.engine,
            self.window(key),
            self._piece(key),
        )
        # Two sweeps are too few for ``groups``.
        if engine == "groups" and self.is_pair(key):
            engine = "pairs"
        if not engine_row(engine)[0].shared:
            scene = Scene(window, self._ground(piece.number, piece.row))
            return estimate_motion(scene, self.settings, engine)
        # All poses, but points only for the sweeps of the window.
        at_hand = {s.frame: s for s in window.sweeps}
        sweeps = [
            at_hand.get(f) or RegisteredSweep.without_points(piece.poses, f)
            for f in self._searched(piece.number, piece.row)
        ]
        motion = self._motion(piece.number, piece.row, engine)
        return motion.with_stretch(Stretch(tuple(sweeps)))

    def step(self, frame: int) -> StretchFlow:
        """Return the flow of a sweep to the next, or else previous sweep; empty without either."""
        window = self.window(frame)
        beside = [f for f in window.frames if f > frame] or [f for f in window.frames if f < frame]
        motion = self.motion(frame) if beside else None
        return StretchFlow(
            window, {(frame, f): motion.flow(frame, f) for f in beside[:1] if motion is not None}
        )

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
            tracks = complete_boxes(tracks, cloud, Rays(used, key), self._ground_of(key))
            deep = self._ground_of(key).below(cloud.rigid_points, stretch[key].T_world_lidar)
            return Moment(cloud.select(~deep) if deep.any() else cloud, flow, tracks)

    def share_below(self, key: int) -> float:
        """Return the share of the points of a key's window that lie below the ground."""
        heights, sweeps = self._ground_of(key), self.window(key).sweeps
        deep = [heights.below(s.sweep.points[::_SOME], s.T_world_lidar) for s in sweeps]
        return float(np.concatenate(deep).mean())

    def _ground_of(self, key: int) -> HeightMap:
        piece = self._piece(key)
        return self._ground(piece.number, piece.row)

    def standing(self, key: int) -> Beyond | None:
        """Return the static surfaces along the road beyond the key's window, None without any."""
        if not self.settings.accumulate.far_m:  # not requested
            return None
        piece = self._piece(key)
        surfaces = self._far(piece.number, piece.row)
        if not len(surfaces.frames):
            return None
        return Beyond(
            surfaces, poses.inverse(piece.poses.T_world_lidar[piece.poses.frames.index(key)])
        )

    def _piece(self, key: int) -> Piece:
        pieces = self._pieces(self.cut.number_of[key])
        return next(piece for piece in pieces if key in piece.frames)

    def _registration(self, number: int) -> Registration:
        """Register each run of consecutive sweeps, split at sweeps that cannot be registered."""
        settings, frames = self.settings.register, self._registered_together(number)

        def make() -> Registration:
            self._sweeps.prepare(frames)
            sweeps, bad, pieces = {}, {}, []
            for frame in frames:
                try:
                    self._sweeps.recorded_pose(frame)
                    sweeps[frame] = self._sweeps.read(frame)
                except InputError as error:
                    bad[frame] = LeftOut(str(error), unreadable=True)
            left = self.timeline.runs(sweeps)
            while left:
                together = left.pop()
                run = [sweeps[f] for f in together]
                recorded = None
                if settings.source == "dataset":
                    recorded = recorded_trajectory(self.sequence, run)
                try:
                    with self._watch.stage("register"):
                        piece = find_trajectory(run, settings, recorded)
                    self._check_frame(run, piece, recorded)
                    pieces.append(piece)
                except SweepError as error:
                    unfit = isinstance(error, UnfitSweepError)
                    bad[error.frame] = LeftOut(str(error), unreadable=False, unfit=unfit)
                    left += self.timeline.runs([f for f in together if f != error.frame])
            return Registration(tuple(sorted(pieces, key=lambda p: p.frames)), bad)

        return self._kept("registration", frames, make)

    def _check_frame(
        self, sweeps: Sequence[Sweep], trajectory: Trajectory, recorded: Trajectory | None
    ) -> None:
        """Raise InputError if sweeps are not in the scanner's frame but in the frame of a map."""
        ends, symptom = (sweeps[0], sweeps[-1]), ""
        if recorded is not None:
            if are_placed(sweeps, recorded.T_world_lidar):
                symptom = "the rays begin at the sweeps' poses"
        elif is_still(trajectory.T_world_lidar) and (way_m := way_in_map(*ends)):
            symptom = f"odometry finds no motion, but the rays of both begin {way_m:.1f} m apart"
        if symptom:
            raise InputError(
                f"{self.sequence.name}: sweeps {format_frames([s.frame for s in ends])} are in the "
                f"frame of a map: {symptom}; expected each in its scanner's own frame: "
                f"{MAP_FRAME_REMEDY}"
            )

    def _registered_together(self, number: int) -> list[int]:
        """Return the frames of a block's lead-in, then of the block."""
        block = self.cut.blocks[number]
        return [*self.timeline.before(block[0], self._num_lead_in), *block]

    def _find_pieces(self, number: int) -> list[Piece]:
        """Return the pieces of a block, with their poses."""
        block = frozenset(self.cut.blocks[number])
        wanted = block.union(self.timeline.before(self.cut.blocks[number][0], 1))
        pieces = list[Piece]()
        for piece in self.registration(number).pieces:
            frames = tuple(f for f in piece.frames if f in block)
            if frames:
                trajectory = piece.part([f for f in piece.frames if f in wanted], origin=frames[0])
                pieces.append(Piece(number, len(pieces), trajectory, frames))
        return pieces

    def _deskew(self, number: int, frame: int) -> RegisteredSweep:
        """Return a sweep of block ``number``, deskewed, at its pose in the world of its piece."""
        piece = next(p for p in self._pieces(number) if frame in p.frames)
        sweep = self._sweeps.read(frame)
        with self._watch.stage("deskew"):
            return deskew([sweep], piece.poses).sweeps[0]

    def _make_stretch(self, number: int, frames: tuple[int, ...]) -> Stretch:
        """Return deskewed sweeps of one piece of block ``number``, in the world of the piece."""
        return Stretch(tuple(self._deskewed(number, f) for f in frames))

    def _find_searched(self, number: int, row: int) -> tuple[int, ...]:
        """Return the frames of a piece where motion is searched: windows, and every n-th around."""
        frames, inside = self._pieces(number)[row].frames, self._in_windows(number)
        inside_rows = np.flatnonzero([frame in inside for frame in frames])
        if self._step_around == 1 or not len(inside_rows):
            return frames
        num_away = np.abs(np.arange(len(frames))[:, None] - inside_rows).min(axis=1)
        return tuple(f for f, n in zip(frames, num_away, strict=True) if n % self._step_around == 0)

    def _find_ground(self, number: int, row: int) -> HeightMap:
        """Return the height map of the ground of a piece."""
        stretch = self._stretch(number, self._searched(number, row))
        with self._watch.stage("ground"):
            return ground(stretch)

    def _find_motion(self, number: int, row: int, engine: str) -> SharedMotion:
        """Return the scene flow in a piece, without the sweeps to keep the cache small."""
        asked, frames = self._in_windows(number), self._searched(number, row)

        def make() -> SharedMotion:
            stretch, heights = self._stretch(number, frames), self._ground(number, row)
            with self._watch.stage("flow"):
                scene = Scene(stretch, heights, asked=asked)
                motion = estimate_motion(scene, self.settings, engine)
            return cast(SharedMotion, motion).with_stretch(Stretch(()))

        settings = [engine, self.settings.flow, self.settings.objective, sorted(asked), row]
        together = self._registered_together(number)
        return self._kept("motion", together, make, settings)

    def _find_far(self, number: int, row: int) -> StandingWorld:
        """Return the static surfaces along the road of a piece, in the piece's world."""
        cameras = list(self.sequence.cameras.values())
        far_m, settings = self.settings.accumulate.far_m, self.settings.register
        road = Road(self.timeline, self._sweeps, cameras, settings, far_m)
        # Sweeps of the block outside the windows belong to the far range.
        inside, frames = self._in_windows(number), self._pieces(number)[row].frames
        in_windows = tuple(f for f in frames if f in inside) or frames

        def make() -> StandingWorld:
            keys = [k for k in self.cut.keys_of(number) if k in in_windows]
            stretch = self._stretch(number, in_windows)
            with self._watch.stage("far"):
                return road.find_standing(stretch, keys, with_window=len(keys) > 1)

        # Processes of one run share the result. A digest would read every sweep of the road.
        shared = self._cache if self._run is not None else None
        inputs = [code_digest(), self._run, self.sequence.name, number, row]
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
            content = [(f, self._sweeps.content(f)) for f in frames]
            code, period_ns = code_digest(), self.timeline.period_ns
            return [code, self.settings.register, period_ns, content, list(settings)]

        return kept(self._cache, step, inputs, make)
