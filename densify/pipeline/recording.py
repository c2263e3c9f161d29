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
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from densify.config import Config
from densify.config.cache import Cache, code_digest, get_cached
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
    StaticWorld,
    Stretch,
    StretchFlow,
    Sweep,
    Trajectory,
)
from densify.pipeline.accumulate import accumulate, object_tracks
from densify.pipeline.process import Watch
from densify.pipeline.road import Road, choose_views
from densify.pipeline.sweeps import Cut, Sweeps
from densify.readers.timeline import Timeline, WindowFrames, format_frames, recorded_trajectory
from densify.registration.deskew import deskew
from densify.registration.trajectory import LeftOut, Registration, find_trajectory

T = TypeVar("T")
# Time before a block, in which odometry converges to the vehicle's motion, and its least number of
# sweeps, which show the speed
_LEAD_IN_S, _MIN_LEAD_IN = 0.5, 2
_STRIDE = 8  # every eighth point is enough for the share of points below the ground


def _latest(method: Callable[..., T]) -> Callable[..., T]:
    """Keep the result of a method's latest call in memory, for calls with equal arguments."""

    @wraps(method)
    def call(recording: Recording, *args: Any) -> T:
        latest = recording._latest.get(method.__name__)
        if latest is None or latest[0] != args:
            latest = recording._latest[method.__name__] = args, method(recording, *args)
        return cast(T, latest[1])

    return call


@dataclass(frozen=True, eq=False)
class Piece:
    """Consecutive registered sweeps of one block that share a world."""

    number: int  # index of the block
    row: int  # index of the piece in the block
    # Poses of the piece's sweeps and, if there is one, of the sweep before them, in the world of
    # the piece: the levelled lidar frame of the first of ``frames``
    poses: Trajectory
    frames: tuple[int, ...]  # frame numbers of the piece's sweeps
    # By frame, those that were needed until now
    deskewed: dict[int, RegisteredSweep] = field(default_factory=dict)


class Moment(NamedTuple):
    """The points of a window at the reference time of its key."""

    cloud: Cloud  # accumulated points
    flow: StretchFlow | None  # flow of each sweep to the next one towards the key; None if unasked
    tracks: tuple[ObjectTrack, ...]  # tracks of the moving objects


class FarSurfaces(NamedTuple):
    """The static surfaces beyond a key's window."""

    world: StaticWorld
    T_key_world: Float  # (4,4) pose of that world in the key sweep's lidar frame


class Recording:
    """A sequence with its settings. It computes pipeline steps and keeps the latest in memory."""

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
            cache: Cache on disk for registration, motion and far; None for no cache.
            run: Name of a run whose processes share results through the cache; None for no sharing.
            looks_around: True searches motion also ``flow.look_around_s`` before and after the
                windows, if the engine tracks objects over several keys.

        Raises:
            InputError: A key does not exist, or the window is invalid.
        """
        self.sequence = sequence
        self.settings = settings
        self.timeline = timeline = Timeline.of(sequence)
        self._num_beside = window
        self._watch = watch or Watch()
        self._cache = cache
        self._run = run
        self._latest: dict[str, tuple[Any, Any]] = {}  # method -> arguments, result

        keys = timeline.frames if keys is None else keys
        Cut.of(timeline, window, keys)  # raises for a bad key or window before a sweep is read
        plugin, _ = engine_row(settings.flow.engine)
        looks_around &= plugin.shared
        around_s, step_s = self._look_around(keys) if looks_around else (0.0, 0.0)
        self.cut = Cut.of(timeline, window, keys, around_s)
        # Around the windows motion is searched in every n-th sweep.
        self._step_around = max(1, timeline.num_in(step_s))
        # Odometry converges in the sweeps around a window, too: less lead-in is needed.
        self._num_lead_in = max(_MIN_LEAD_IN, timeline.num_in(_LEAD_IN_S - around_s))

        num_kept = max(map(len, self.cut.blocks), default=0) + self._num_lead_in
        self.sweeps = Sweeps(
            sequence, timeline, settings.register, num_kept, cache, run, self._watch
        )

    def _look_around(self, keys: Collection[int]) -> tuple[float, float]:
        """Return the seconds around windows where motion is searched, and between its sweeps."""
        if self.settings.flow.look_around_s == 0:
            return 0.0, 0.0
        # The first readable key shows the number of points per second.
        for key in sorted(keys):
            with suppress(InputError):  # raised again where the key is made
                num_points = len(self.sequence[key])
                return self.settings.flow.around(num_points / (self.timeline.period_ns * 1e-9))
        return 0.0, 0.0

    def window_frames(self, key: int) -> WindowFrames:
        """Return the frames of a key's window, and the reasons if it is smaller than requested.

        Raises:
            SweepError: The key or all its neighbours cannot be registered.
            InputError: The key's sweep cannot be read.
        """
        requested = self.timeline.window(key, self._num_beside)
        left_out = self.registration(self.cut.number_of[key]).left_out
        if key in left_out:
            raise left_out[key].error(key)

        # The window ends before a sweep that is left out, and at the end of the key's piece.
        reasons = {frame: cause.reason for frame, cause in left_out.items()}
        usable = self.timeline.window(key, self._num_beside, reasons)
        in_piece = self._piece(key).poses.frames
        frames = tuple(frame for frame in usable.frames if frame in in_piece)

        # The key is alone because a neighbour failed to register. An unreadable neighbour is no
        # error: the recording may have lost it, and the key's own sweep gives a result.
        if len(frames) == 1:
            for frame in requested.frames:
                if frame in left_out and not left_out[frame].unreadable:
                    raise left_out[frame].error(frame)
        return WindowFrames(frames, usable.cuts)

    def window(self, key: int) -> Stretch:
        """Return the registered, deskewed sweeps of a key's window.

        Raise SweepError if the key cannot be registered, InputError if it cannot be read.
        """
        frames = self.window_frames(key).frames  # raises before a piece is looked up
        return self._stretch(self._piece(key), frames)

    def searched_stretch(self, key: int) -> Stretch:
        """Return the registered, deskewed sweeps of a key's piece in which motion is searched.

        These are all sweeps of windows, and every n-th sweep around. The key must be registered.
        """
        piece = self._piece(key)
        return self._stretch(piece, self._searched_frames(piece))

    def is_pair(self, key: int) -> bool:
        """Return True if motion of a key is searched in only two sweeps; a track needs three."""
        return len(self._searched_frames(self._piece(key))) == 2

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """Return the scene flow of all points in a key's window.

        ``engine`` is ``NAME[:ARGUMENT]``; None or "" takes the configured one. Raise SweepError or
        InputError if the key or the engine cannot be used.
        """
        engine = engine or self.settings.flow.engine
        window = self.window(key)
        piece = self._piece(key)
        # The engine ``groups`` tracks objects, which takes three sweeps.
        if engine == "groups" and self.is_pair(key):
            engine = "pairs"
        plugin, _ = engine_row(engine)
        if not plugin.shared:  # the motion serves this window alone, and is not kept
            return estimate_motion(Scene(window, self._ground(piece)), self.settings, engine)
        # The poses of all searched sweeps, but points only for those of the window
        in_window = {registered.frame: registered for registered in window.sweeps}
        sweeps = [
            in_window.get(frame) or RegisteredSweep.without_points(piece.poses, frame)
            for frame in self._searched_frames(piece)
        ]
        return self._motion(piece, engine).with_stretch(Stretch(tuple(sweeps)))

    def step(self, frame: int) -> StretchFlow:
        """Return a sweep's flow to the next sweep of its window, at its end to the first sweep."""
        window = self.window(frame)
        later = [other for other in window.frames if other > frame]
        earlier = [other for other in window.frames if other < frame]
        steps = [(frame, target) for target in (later or earlier)[:1]]
        return StretchFlow(window, {step: self.motion(frame).flow(*step) for step in steps})

    def moment(
        self, key: int, all_sweeps: bool, engine: str | None, with_flow: bool = False
    ) -> Moment:
        """Return the points of a key's window, accumulated at the key's reference time.

        Args:
            all_sweeps: Use all sweeps of the window, else the key sweep alone.
            engine: Scene-flow engine, "" for the configured engine, None for rigid accumulation.
            with_flow: Also return the flow of every sweep to the next sweep towards the key.
        """
        stretch = self.window(key)
        used = stretch if all_sweeps else Stretch((stretch[key],))
        flow = None
        tracks: tuple[ObjectTrack, ...] = ()
        if engine is None:
            fields = [FlowField.zero(len(registered.sweep)) for registered in used.sweeps]
        else:
            with self._watch.stage("flow"):
                motion = self.motion(key, engine)
                frames = self._watch.each("flow", stretch.frames)
                fields = [motion.flow(frame, key) for frame in frames]
                tracks = object_tracks(stretch, fields, key)
                if with_flow:
                    flow = StretchFlow.towards(key, stretch, motion)
        with self._watch.stage("accumulate"):
            drop_lost = self.settings.accumulate.unfollowed == "drop"
            cloud = accumulate(used, fields, key, drop_lost)
            del fields  # frees memory: they are as large as the cloud
            heights = self._ground(self._piece(key))
            tracks = complete_boxes(tracks, cloud, Rays(used, key), heights)
            is_below = heights.below(cloud.rigid_points, stretch[key].T_world_lidar)
            # Points below the ground are mirror images of a wet road, or noise.
            return Moment(cloud.select(~is_below) if is_below.any() else cloud, flow, tracks)

    def share_below(self, key: int) -> float:
        """Return the share of the points of a key's window that lie below the ground."""
        heights = self._ground(self._piece(key))
        is_below = [
            heights.below(registered.sweep.points[::_STRIDE], registered.T_world_lidar)
            for registered in self.window(key).sweeps
        ]
        return float(np.concatenate(is_below).mean())

    def find_far_surfaces(self, key: int) -> FarSurfaces | None:
        """Return the static surfaces beyond a key's window; None if ``far_m`` is 0 or none is."""
        if not self.settings.accumulate.far_m:
            return None
        piece = self._piece(key)
        surfaces = self._far(piece)
        T_world_key = self._stretch(piece, [key])[key].T_world_lidar
        return FarSurfaces(surfaces, poses.inverse(T_world_key)) if surfaces.frames else None

    def _piece(self, key: int) -> Piece:
        """Return the piece that holds the key sweep."""
        pieces = self._pieces(self.cut.number_of[key])
        return next(piece for piece in pieces if key in piece.frames)

    @_latest
    def registration(self, number: int) -> Registration:
        """Register each run of consecutive sweeps of a block, split at sweeps that are left out."""
        frames = self._frames_with_lead_in(number)

        def make() -> Registration:
            sweeps: dict[int, Sweep] = {}
            left_out: dict[int, LeftOut] = {}
            self.sweeps.prepare(frames)
            for frame in self._watch.each("read", frames):
                try:
                    self.sweeps.recorded_pose(frame)  # raises if the recording lacks the pose
                    sweeps[frame] = self.sweeps.read(frame)
                except InputError as error:
                    left_out[frame] = LeftOut(str(error), unreadable=True)

            pieces = []
            remaining = self.timeline.split_at_holes(sweeps)
            while remaining:
                run = remaining.pop()
                try:
                    pieces.append(self._register([sweeps[frame] for frame in run]))
                except SweepError as error:
                    # Without the sweep that failed, the rest is tried again.
                    is_unfit = isinstance(error, UnfitSweepError)
                    left_out[error.frame] = LeftOut(str(error), unreadable=False, unfit=is_unfit)
                    others = [frame for frame in run if frame != error.frame]
                    remaining += self.timeline.split_at_holes(others)
            in_order = sorted(pieces, key=lambda piece: piece.frames)
            return Registration(tuple(in_order), left_out)

        return self._cached("registration", frames, make)

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
                f"{self.sequence.name}: sweeps {ends} are in the frame of a map: {symptom}; "
                f"expected each in its scanner's own frame: {MAP_FRAME_REMEDY}"
            )
        return trajectory

    def _frames_with_lead_in(self, number: int) -> list[int]:
        """Return the frames of a block's lead-in, then of the block: all that registration uses."""
        block = self.cut.blocks[number]
        return [*self.timeline.before(block[0], self._num_lead_in), *block]

    @_latest
    def _pieces(self, number: int) -> list[Piece]:
        """Return the pieces of a block, with their poses, without the lead-in."""
        block = frozenset(self.cut.blocks[number])
        # The sweep before the block tells the twist of the block's first sweep.
        with_pose = block.union(self.timeline.before(self.cut.blocks[number][0], 1))
        pieces = list[Piece]()
        for trajectory in self.registration(number).pieces:
            frames = tuple(frame for frame in trajectory.frames if frame in block)
            if frames:
                part = [frame for frame in trajectory.frames if frame in with_pose]
                piece_poses = trajectory.part(part, origin=frames[0])
                pieces.append(Piece(number, len(pieces), piece_poses, frames))
        return pieces

    def _stretch(self, piece: Piece, frames: Sequence[int]) -> Stretch:
        """Return deskewed sweeps of a piece, in its world."""
        missing = [frame for frame in frames if frame not in piece.deskewed]
        for frame in self._watch.each("deskew", missing):
            sweep = self.sweeps.read(frame)
            with self._watch.stage("deskew", is_part=True):
                piece.deskewed[frame] = deskew([sweep], piece.poses).sweeps[0]
        return Stretch(tuple(piece.deskewed[frame] for frame in frames))

    @_latest
    def _searched_frames(self, piece: Piece) -> tuple[int, ...]:
        """Return the frames of a piece whose motion is searched: windows, and every n-th beside."""
        frames = piece.frames
        in_windows = self._in_windows(piece.number)
        window_rows = np.flatnonzero([frame in in_windows for frame in frames])
        if self._step_around == 1 or not len(window_rows):
            return frames
        # Number of sweeps to the nearest window, 0 within a window
        num_away = np.abs(np.arange(len(frames))[:, None] - window_rows).min(axis=1)
        is_searched = num_away % self._step_around == 0
        return tuple(np.array(frames)[is_searched].tolist())

    @_latest
    def _ground(self, piece: Piece) -> HeightMap:
        """Return the height map of the ground of a piece."""
        stretch = self._stretch(piece, self._searched_frames(piece))
        with self._watch.stage("ground"):
            return ground(stretch)

    @_latest
    def _motion(self, piece: Piece, engine: str) -> SharedMotion:
        """Return the scene flow in a piece, without the sweeps to keep the cache small."""
        asked = self._in_windows(piece.number)  # the frames whose flow may be asked for
        frames = self._searched_frames(piece)

        def make() -> SharedMotion:
            stretch = self._stretch(piece, frames)
            heights = self._ground(piece)
            with self._watch.stage("flow"):
                motion = estimate_motion(Scene(stretch, heights, asked), self.settings, engine)
            return cast(SharedMotion, motion).with_stretch(Stretch(()))

        settings = [engine, self.settings.flow, self.settings.objective, sorted(asked), piece.row]
        return self._cached("motion", self._frames_with_lead_in(piece.number), make, settings)

    @_latest
    def _far(self, piece: Piece) -> StaticWorld:
        """Return the static surfaces along the road of a piece, in the piece's world."""
        # Sweeps of the block outside the windows belong to the far range.
        in_windows = self._in_windows(piece.number)
        frames = tuple(frame for frame in piece.frames if frame in in_windows) or piece.frames

        def make() -> StaticWorld:
            keys = [key for key in self.cut.keys_of(piece.number) if key in frames]
            window = self._stretch(piece, frames)
            with self._watch.stage("far"):
                views = choose_views(self.sequence.cameras.values(), window, keys)
                far_m = self.settings.accumulate.far_m
                register = self.settings.register
                road = Road(self.timeline, self.sweeps, register, far_m, window, views)
                # For one key the sweeps of the window are accumulated anyway. With more keys, the
                # window of one is beyond the window of another.
                return road.find_static_surfaces(with_window=len(keys) > 1)

        # Processes of one run share the result. A digest would read every sweep of the road.
        shared = self._cache if self._run is not None else None
        inputs = [code_digest(), self._run, self.sequence.name, piece.number, piece.row]
        return get_cached(shared, "far", lambda: inputs, make)

    def _in_windows(self, number: int) -> frozenset[int]:
        """Return the frames of the windows of a block's keys."""
        keys = self.cut.keys_of(number)
        windows = (self.timeline.window(key, self._num_beside).frames for key in keys)
        return frozenset(frame for frames in windows for frame in frames)

    def _cached(
        self, step: str, frames: Iterable[int], make: Callable[[], T], settings: Sequence[Any] = ()
    ) -> T:
        """Return the result of ``make``, or the cached result for the same sweeps and settings."""

        def inputs() -> Any:
            content = [(frame, self.sweeps.content(frame)) for frame in frames]
            period_ns = self.timeline.period_ns
            return [code_digest(), self.settings.register, period_ns, content, list(settings)]

        return get_cached(self._cache, step, inputs, make)
