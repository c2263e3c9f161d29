# SPDX-License-Identifier: MIT
"""The steps before a key's moment, each made once for all keys of a block, and kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import chain
from typing import Any, cast

from densify.config import Config
from densify.config.cache import Cache, kept
from densify.config.plugins.engines import engine as engine_row
from densify.flow.engines import Scene, SharedMotion, estimate_motion, motion_type
from densify.flow.tracking.candidates import Candidates, find_candidates
from densify.free_space.ground import ground
from densify.free_space.height_map import HeightMap
from densify.free_space.range_image import RangeImage
from densify.free_space.seen_through import REACH_S, FreeSpace, range_images
from densify.geometry.clock import num_in_batch
from densify.geometry.types import LidarSequence, StandingWorld, Stretch, Trajectory
from densify.pipeline.blocks import Cut
from densify.pipeline.costs import Watch
from densify.pipeline.places import Places
from densify.pipeline.road import Road
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline


class BlockSteps:
    """`registration`, `images`, `ground`, `evidence`, `motion` and `far` of a block, by its number.
    What was asked for last is kept in memory: the next step, key or block is likely to ask for it
    again."""

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
        num_before = timeline.num_in(settings.register.lead_in_s)
        num_raw = 1 if cut.margin_s else cut.num_kept + num_before
        register = settings.register
        self._sweeps = Sweeps(sequence, timeline, register, num_raw, cache, run, watch)
        self.places = Places(sequence, register, timeline, cut, self._sweeps, cache, watch)
        self.registration = self.places.registration
        self.images = lru_cache(maxsize=4)(self._images)
        self.ground = lru_cache(maxsize=4)(self._ground)
        self.evidence = lru_cache(maxsize=4)(self._evidence)
        self.motion = lru_cache(maxsize=2)(self._motion)
        self.far = lru_cache(maxsize=1)(self._far)
        self._free_space = lru_cache(maxsize=1)(self._find_space)

    def _images(self, number: int) -> dict[int, RangeImage]:
        """Range images of the block's sweeps, by frame."""
        places, num_together = self.places, num_in_batch(self._timeline.period_ns * 1e-9)
        pieces = {f: p for p in places.pieces(number, 0.0) for f in places.within(p, number, 0.0)}

        def make() -> dict[int, RangeImage]:
            sweeps = [places.deskewed(number, 0.0, f) for f in pieces]
            with self._watch.stage("flow"):
                return dict(zip(pieces, range_images(sweeps, num_together), strict=True))

        return kept(
            self._cache,
            "images",
            dict[int, RangeImage],
            lambda: [num_together, *((f, self._sweeps.content(f), p) for f, p in pieces.items())],
            make,
        )

    def _ground(self, number: int) -> list[HeightMap]:
        """Height of the ground within reach of the block, for each of its pieces."""

        def make(frames: Sequence[int]) -> HeightMap:
            stretch = self.places.stretch(number, REACH_S, frames)
            with self._watch.stage("ground"):
                return ground(stretch, self._settings.ground)

        return [
            kept(
                self._cache,
                "ground",
                HeightMap,
                partial(self._near, number, index),
                partial(make, frames),
            )
            for index, frames in enumerate(self.places.frames_within(number, REACH_S))
        ]

    def _evidence(self, number: int) -> list[dict[int, Candidates]]:
        """What may move in the block's sweeps, by frame, for each of its pieces."""

        def make(index: int, frames: Sequence[int]) -> dict[int, Candidates]:
            stretch = self.places.stretch(number, REACH_S, frames)
            heights = self.ground(number)[index]
            space = self._space(number, REACH_S, tuple(frames))
            own = [i for i, f in enumerate(frames) if f in self._cut.blocks[number].frames]
            with self._watch.stage("flow"):
                found = find_candidates(stretch, space, heights, own)
            return {frames[i]: c for i, c in zip(own, found, strict=True)}

        return [
            kept(
                self._cache,
                "evidence",
                dict[int, Candidates],
                partial(self._evidence_inputs, number, index),
                partial(make, index, f),
            )
            for index, f in enumerate(self.places.frames_within(number, REACH_S))
        ]

    def _motion(self, number: int, engine: str) -> list[tuple[Sequence[int], SharedMotion]]:
        """How everything within the margin of the block moves, for each of its pieces: the frames,
        and the motion without their points."""
        margin_s = self._cut.margin_s

        def make(index: int, frames: Sequence[int]) -> SharedMotion:
            stretch = self.places.stretch(number, margin_s, frames)
            scene = Scene(
                stretch,
                self.ground(number)[index],
                make_space=partial(self._space, number, margin_s, tuple(frames)),
                make_candidates=partial(self._candidates, number, frames),
                asked=self._in_windows(number),
            )
            with self._watch.stage("flow"):
                motion = estimate_motion(scene, self._settings, engine)
            return cast(SharedMotion, motion).with_stretch(Stretch(()))

        def inputs(piece: Trajectory, frames: Sequence[int]) -> Any:
            evidence = [
                self._evidence_inputs(b, index)
                for b in self.places.blocks_with(number, frames)
                for index in range(len(self.places.pieces(b, REACH_S)))
            ]
            content = [self._sweeps.content(f) for f in frames]
            settings = [self._settings.flow, self._settings.objective]
            asked = sorted(self._in_windows(number) or ())
            return [engine, engine_row(engine)[0], settings, piece, asked, evidence, content]

        found: list[tuple[Sequence[int], SharedMotion]] = []
        pieces = self.places.pieces(number, margin_s)
        for index, frames in enumerate(self.places.frames_within(number, margin_s)):
            motion = kept(
                self._cache,
                "motion",
                motion_type(engine),
                partial(inputs, pieces[index], frames),
                partial(make, index, frames),
            )
            found.append((frames, motion))
        return found

    def _far(self, number: int) -> list[StandingWorld]:
        """What stands along the road, for each piece of the block and in its world; of a whole
        recording with the block's own sweeps, of which a key leaves out those of its window."""
        cameras = list(self._sequence.cameras.values())
        far_m, settings = self._settings.accumulate.far_m, self._settings.register
        road = Road(self._timeline, self._sweeps, cameras, settings, far_m, self._watch)

        def make(frames: Sequence[int]) -> StandingWorld:
            keys = [k for k, n in self._cut.number_of.items() if n == number and k in frames]
            near = self.places.stretch(number, 0.0, frames)
            with self._watch.stage("far"):
                return road.standing(near, keys, with_near=len(keys) > 1)

        def inputs(piece: Trajectory, frames: Sequence[int]) -> Any:
            content = [self._sweeps.content_if_readable(f) for f in road.frames(piece, frames)]
            return [settings, far_m, cameras, piece, list(frames), content]

        pieces = self.places.pieces(number, 0.0)
        near_frames, inside = self.places.frames_within(number, 0.0), self._in_windows(number)
        if inside:  # what is looked at beyond the windows is as far as the rest of the road
            near_frames = [[f for f in frames if f in inside] or frames for frames in near_frames]
        return [
            kept(self._cache, "far", StandingWorld, partial(inputs, pieces[i], f), partial(make, f))
            for i, f in enumerate(near_frames)
        ]

    # What they are made of

    def _in_windows(self, number: int) -> frozenset[int] | None:
        """The frames of the windows of a block's keys; None of a whole recording, whose motion
        serves windows of any size."""
        if self._cut.margin_s:
            return None
        keys = (key for key, n in self._cut.number_of.items() if n == number)
        windows = (self._timeline.window(key, self._num_around).frames for key in keys)
        return frozenset(chain.from_iterable(windows))

    def _space(self, number: int, around_s: float, frames: tuple[int, ...]) -> FreeSpace:
        """What these sweeps of one piece saw through."""
        return self._free_space(number, min(around_s, self._cut.margin_s), frames)

    def _find_space(self, number: int, around_s: float, frames: tuple[int, ...]) -> FreeSpace:
        images = {
            f: image
            for b in self.places.blocks_with(number, frames)
            for f, image in self.images(b).items()
        }
        stretch = self.places.stretch(number, around_s, frames)
        return FreeSpace.of(stretch, [images[f] for f in frames])

    def _candidates(self, number: int, frames: Sequence[int]) -> tuple[Candidates, ...]:
        evidence = {
            f: found
            for b in self.places.blocks_with(number, frames)
            for piece in self.evidence(b)
            for f, found in piece.items()
        }
        return tuple(evidence[f] for f in frames)

    # Kept on disk

    def _near(self, number: int, index: int) -> Any:
        """What the ground of a piece depends on."""
        piece = self.places.pieces(number, REACH_S)[index]
        content = [self._sweeps.content(f) for f in self.places.within(piece, number, REACH_S)]
        return [self._settings.ground, number, piece, content]

    def _evidence_inputs(self, number: int, index: int) -> Any:
        return [self._near(number, index)]
