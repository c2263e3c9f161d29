# SPDX-License-Identifier: MIT
"""The steps before a key's moment, each made once for all keys of a block, and kept in the cache::

    registration   poses of the block's sweeps
    pieces         poses joined over neighbouring blocks
    images         range images of the sweeps
    ground         height map
    evidence       points that may move, by free-space violations
    motion         motion of everything in and around the block
    far            static surfaces along the road, measured beyond the windows

Most steps have a result for each piece: sweeps that cannot be read or registered, and holes in
time, split the recording into pieces, each with a world of its own.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain
from typing import Any, TypeVar, cast

from densify.config import Config
from densify.config.cache import Cache, kept
from densify.config.errors import InputError, SweepError, UnfitSweepError
from densify.flow.engines import Scene, SharedMotion, estimate_motion, motion_type
from densify.flow.tracking.candidates import Candidates, find_candidates
from densify.free_space.ground import HeightMap, ground
from densify.free_space.range_image import RangeImage
from densify.free_space.seen_through import REACH_S, FreeSpace, range_images
from densify.geometry.clock import num_in_batch
from densify.geometry.types import (
    LidarSequence,
    RegisteredSweep,
    StandingWorld,
    Stretch,
    Trajectory,
)
from densify.pipeline.blocks import Cut
from densify.pipeline.costs import Watch
from densify.pipeline.road import Road
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline, recorded_trajectory
from densify.registration.deskew import deskew
from densify.registration.trajectory import LeftOut, Registration, find_trajectory

T = TypeVar("T")
LEAD_IN_S = 0.5  # sweeps before a block from which odometry learns the speed


class Steps:
    """The steps, by the number of the block. The last results are kept in memory."""

    def __init__(
        self,
        sequence: LidarSequence,
        settings: Config,
        timeline: Timeline,
        cut: Cut,
        window: int,
        cache: Cache | None,
        run: str | None,
        watch: Watch,
    ) -> None:
        """window: sweeps on each side of a key. cache, run, watch: as of `Recording`."""
        self._sequence, self._settings, self._timeline = sequence, settings, timeline
        self._cut, self._num_around, self._cache, self._watch = cut, window, cache, watch
        num_raw = 1 if cut.margin_s else cut.num_kept + timeline.num_in(LEAD_IN_S)
        self._sweeps = Sweeps(sequence, timeline, settings.register, num_raw, cache, run, watch)
        self.registration = lru_cache(maxsize=8)(self._registration)
        self.pieces = lru_cache(maxsize=8)(self._pieces)
        self._deskewed = lru_cache(maxsize=cut.num_kept)(self._deskew)
        self.stretch = lru_cache(maxsize=1)(self._stretch)
        self.images = lru_cache(maxsize=4)(self._images)
        self.ground = lru_cache(maxsize=4)(self._ground)
        self._space = lru_cache(maxsize=1)(self._free_space)
        self.evidence = lru_cache(maxsize=4)(self._evidence)
        self.motion = lru_cache(maxsize=2)(self._motion)
        self.far = lru_cache(maxsize=1)(self._far)

    # Poses

    def _registration(self, number: int) -> Registration:
        """Register the block's sweeps: each run of neighbours alone, split at a bad sweep."""
        settings, frames = self._settings.register, self._registered_together(number)

        def make() -> Registration:
            self._sweeps.prepare(frames)
            sweeps, bad, pieces = {}, {}, []
            for frame in frames:
                try:
                    sweeps[frame] = self._sweeps.read(frame)
                    self._sweeps.recorded_pose(frame)
                except InputError as error:
                    sweeps.pop(frame, None)
                    bad[frame] = LeftOut(str(error), unreadable=True)
            left = self._timeline.runs(sweeps)
            while left:
                together = left.pop()
                run = [sweeps[f] for f in together]
                recorded = None
                if settings.source == "dataset":
                    recorded = recorded_trajectory(self._sequence, run)
                try:
                    with self._watch.stage("register"):
                        pieces.append(find_trajectory(run, settings, recorded))
                except SweepError as error:
                    unfit = isinstance(error, UnfitSweepError)
                    bad[error.frame] = LeftOut(str(error), unreadable=False, unfit=unfit)
                    left += self._timeline.runs([f for f in together if f != error.frame])
            return Registration(tuple(sorted(pieces, key=lambda p: p.frames)), bad)

        return self._kept("registration", Registration, number, 0, make)

    def _registered_together(self, number: int) -> list[int]:
        """Return the frames of a block, behind those of its lead-in."""
        frames = self._cut.blocks[number].frames
        # Without a sweep before it, a block could not be joined to the last one.
        num_before = max(1, self._timeline.num_in(LEAD_IN_S))
        return [*self._timeline.before(frames[0], num_before), *frames]

    def _pieces(self, number: int) -> list[Trajectory]:
        """Return the poses of the sweeps in and around a block, joined over blocks.

        One more sweep at each end tells how the lidar moved. Only pieces with a sweep of the block
        are returned. The world is the lidar of the piece's first sweep in the block, upright.
        """
        own_frames, frames = self._cut.blocks[number].frames, self._frames_around(number)
        before, after = self._timeline.before(frames[0], 1), self._timeline.after(frames[-1], 1)
        wanted = {*before, *frames, *after}
        pieces: list[Trajectory] = []
        for b in self.blocks_around(number):
            members = {*self._cut.blocks[b].frames}
            if not self._cut.margin_s:  # no other block has the sweep before
                members |= {*before}
            for found in self.registration(b).pieces:
                own = [f for f in found.frames if f in wanted & members]
                if not own:
                    continue
                first = found.frames.index(own[0])
                if pieces and first and pieces[-1].frames[-1] == found.frames[first - 1]:
                    pieces[-1] = pieces[-1].joined(found, own)
                else:
                    pieces.append(found.part(own))
        in_block = [[f for f in p.frames if f in own_frames] for p in pieces]
        return [p.seen_from(f[0]) for f, p in zip(in_block, pieces, strict=True) if f]

    def blocks_around(self, number: int) -> list[int]:
        """Return the blocks that hold a block's sweeps and those within its margin."""
        if not self._cut.margin_s:
            return [number]
        frames = self._frames_around(number)
        ends = *self._timeline.before(frames[0], 1), *self._timeline.after(frames[-1], 1)
        return sorted({self._cut.number_of[f] for f in (*frames, *ends)})

    def _frames_around(self, number: int, reach_s: float = 1e6) -> list[int]:
        """Return the frames of a block and of ``reach_s`` around it, at most of its margin."""
        block, around_ns = self._cut.blocks[number], round(min(reach_s, self._cut.margin_s) * 1e9)
        if not around_ns:
            return list(block.frames)
        return self._timeline.within(block.begin_ns - around_ns, block.end_ns + around_ns)

    def frames(self, number: int, reach_s: float = 1e6) -> list[tuple[int, ...]]:
        """Return the same frames piece by piece, without the one more at each end."""
        around = frozenset(self._frames_around(number, reach_s))
        return [tuple(f for f in p.frames if f in around) for p in self.pieces(number)]

    def _deskew(self, number: int, frame: int) -> RegisteredSweep:
        piece = next(p for p in self.pieces(number) if frame in p.frames)
        sweep = self._sweeps.read(frame)
        with self._watch.stage("deskew"):
            return deskew([sweep], piece).sweeps[0]

    def _stretch(self, number: int, frames: tuple[int, ...]) -> Stretch:
        """Return these sweeps of one piece, deskewed, in its world."""
        return Stretch(tuple(self._deskewed(number, f) for f in frames))

    # Free space, ground and motion

    def _images(self, number: int) -> dict[int, RangeImage]:
        """Return range images of the block's sweeps, by frame."""
        num_together = num_in_batch(self._timeline.period_ns * 1e-9)

        def make() -> dict[int, RangeImage]:
            frames = list(chain.from_iterable(self.frames(number, 0)))
            sweeps = [self._deskewed(number, f) for f in frames]
            with self._watch.stage("flow"):
                return dict(zip(frames, range_images(sweeps, num_together), strict=True))

        return self._kept("images", dict[int, RangeImage], number, 1, make)

    def _ground(self, number: int) -> list[HeightMap]:
        """Return the ground within reach of the block, for each piece."""

        def make() -> list[HeightMap]:
            stretches = (self.stretch(number, f) for f in self.frames(number, REACH_S))
            found = []
            for stretch in stretches:
                with self._watch.stage("ground"):
                    found.append(ground(stretch))
            return found

        return self._kept("ground", list[HeightMap], number, 1, make)

    def _free_space(self, number: int, frames: tuple[int, ...]) -> FreeSpace:
        """Return what these sweeps of one piece saw through."""
        images = {f: i for b in self.blocks_around(number) for f, i in self.images(b).items()}
        return FreeSpace.of(self.stretch(number, frames), [images[f] for f in frames])

    def _evidence(self, number: int) -> list[dict[int, Candidates]]:
        """Return what may move in the block's sweeps, by frame, for each piece."""

        def make() -> list[dict[int, Candidates]]:
            evidence = []
            for frames, heights in zip(
                self.frames(number, REACH_S), self.ground(number), strict=True
            ):
                stretch, space = self.stretch(number, frames), self._space(number, frames)
                own = [i for i, f in enumerate(frames) if f in self._cut.blocks[number].frames]
                with self._watch.stage("flow"):
                    found = find_candidates(stretch, space, heights, own)
                evidence.append({frames[i]: c for i, c in zip(own, found, strict=True)})
            return evidence

        return self._kept("evidence", list[dict[int, Candidates]], number, 2, make)

    def _candidates(self, number: int, frames: Sequence[int]) -> tuple[Candidates, ...]:
        around = self.blocks_around(number)
        evidence = {f: c for b in around for piece in self.evidence(b) for f, c in piece.items()}
        return tuple(evidence[f] for f in frames)

    def _motion(self, number: int, engine: str) -> list[SharedMotion]:
        """Return the motion in and around the block, for each piece, without its points."""
        asked = self._in_windows(number)

        def make() -> list[SharedMotion]:
            motions = []
            for frames, heights in zip(self.frames(number), self.ground(number), strict=True):
                scene = Scene(
                    self.stretch(number, frames),
                    heights,
                    make_space=lambda frames=frames: self._space(number, frames),  # type: ignore[misc]
                    make_candidates=lambda frames=frames: self._candidates(number, frames),  # type: ignore[misc]
                    asked=asked,
                )
                with self._watch.stage("flow"):
                    motion = estimate_motion(scene, self._settings, engine)
                motions.append(cast(SharedMotion, motion).with_stretch(Stretch(())))
            return motions

        settings = [engine, self._settings.flow, self._settings.objective, sorted(asked or ())]
        kind: Any = types.GenericAlias(list, (motion_type(engine),))
        found: list[SharedMotion] = self._kept("motion", kind, number, 3, make, settings)
        return found

    def _far(self, number: int) -> list[StandingWorld]:
        """Return the static surfaces along the road, for each piece of the block, in its world."""
        cameras = list(self._sequence.cameras.values())
        far_m, settings = self._settings.accumulate.far_m, self._settings.register
        road = Road(self._timeline, self._sweeps, cameras, settings, far_m)
        near, inside = self.frames(number, 0), self._in_windows(number)
        if inside:  # sweeps beyond the windows are as far as the rest of the road
            near = [tuple(f for f in frames if f in inside) or frames for frames in near]

        def make() -> list[StandingWorld]:
            worlds = []
            for frames in near:
                keys = [k for k in self._cut.keys_of(number) if k in frames]
                stretch = self.stretch(number, frames)
                with self._watch.stage("far"):
                    worlds.append(road.find_standing(stretch, keys, with_near=len(keys) > 1))
            return worlds

        def along_road() -> list[Any]:
            frames = {f for around in near for f in road.frames(around)}
            return [far_m, cameras, near, [self._sweeps.content(f) for f in sorted(frames)]]

        if not self._cut.margin_s:  # to make it costs less than to read the road for a digest
            return make()
        return self._kept("far", list[StandingWorld], number, 1, make, along_road)

    def _in_windows(self, number: int) -> frozenset[int] | None:
        """Return the frames of the windows of a block's keys; None of a whole recording, whose
        motion serves windows of any size."""
        if self._cut.margin_s:
            return None
        keys = self._cut.keys_of(number)
        return frozenset(
            f for key in keys for f in self._timeline.window(key, self._num_around).frames
        )

    def _kept(
        self,
        step: str,
        kind: type[T],
        number: int,
        hops: int,
        make: Callable[[], T],
        settings: Any = (),
    ) -> T:
        """Return what ``make`` returns, or the cache has of the same inputs.

        hops: the step depends on sweeps of the blocks around a block, of those around them, ...
        """

        def inputs() -> Any:
            blocks = {number}
            for _ in range(hops):
                blocks = {n for b in blocks for n in self.blocks_around(b)}
            frames = sorted({f for b in blocks for f in self._registered_together(b)})
            content = [(f, self._sweeps.content(f)) for f in frames]
            own = self._cut.blocks[number].frames, self._timeline.period_ns
            more = settings() if callable(settings) else settings
            return [self._settings.register, own, content, more]

        return kept(self._cache, step, kind, inputs, make)
