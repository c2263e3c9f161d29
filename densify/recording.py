# SPDX-License-Identifier: MIT
"""A recording and what is worked out about it, each step made once and asked for by name::

    sweeps         read, without the own vehicle's returns
    registration   poses of the sweeps
    images         range images: what each sweep saw, and therefore saw through
    ground         height of the ground
    evidence       what may move, told by all sweeps around
    motion         how everything moves
    moment         all sweeps of a key's window as they stand at the key's moment
    far            what stands along the road around, as sweeps beyond the window saw it

The sweeps are cut into blocks, and each step works on one block. How far it looks beyond its block
is a number of seconds, 0 at the least. Two ways to cut serve all users:

* `densify.blocks.Cut.around`: the windows of a few keys, which look at nothing else. `run` and
  `compare` use it: no key costs more than it must.
* `densify.blocks.Cut.whole`: blocks of two seconds, counted from time 0 whatever keys are wanted,
  that look well into the blocks around. The same sweeps make the same maps, whatever else is asked
  for: `dataset` uses it.

Sweeps that cannot be read or registered are left out and split the recording: windows end there,
as they do at holes in time (`densify.readers.timeline`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import chain
from typing import Any, NamedTuple, TypeVar, cast

from densify.blocks import Cut
from densify.cache import Cache, kept
from densify.clock import num_in_look
from densify.config import Config
from densify.costs import Watch
from densify.depth.accumulate import accumulate
from densify.depth.object_tracks import object_tracks
from densify.errors import InputError, SweepError
from densify.flow.engines import SharedMotion, estimate_motion, motion_type
from densify.flow.scene import Scene
from densify.flow.tracking.evidence import REACH_S, Candidates, FreeSpace, find_candidates
from densify.geometry import poses
from densify.geometry.ground import ground
from densify.geometry.height_map import HeightMap
from densify.geometry.range_image import RangeImage
from densify.places import Places
from densify.plugins.engines import engine as engine_row
from densify.readers.timeline import Timeline, WindowFrames
from densify.registration.trajectory import LeftOut
from densify.road import Road
from densify.sweeps import Sweeps
from densify.types import (
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
    Trajectory,
)

T = TypeVar("T")


class Moment(NamedTuple):
    """What is measured around a key, as it stands at the key's moment. flow: where asked for.
    tracks: of what moves; none without flow."""

    cloud: Cloud
    flow: StretchFlow | None
    tracks: tuple[ObjectTrack, ...]


class Beyond(NamedTuple):
    """What stands along the road beyond a key's window, in a world of its own."""

    standing: StandingWorld
    T_key_standing: Float


class Recording:
    """A sequence, settings, and the steps. Holds little: what was read and made last.

    `window`, `motion`, `moment` and `standing` answer for a key; `registration`, `images`,
    `ground`, `evidence`, `block_motion` and `far` make what the keys of a block share.
    """

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
        """window: sweeps on each side of a key. keys: work on their windows alone, see
        `Cut.around`; None for the whole recording, see `Cut.whole`. cache: keeps the steps' results
        on disk; None keeps nothing. run: the same for all processes between which no sweep changes;
        None for this object alone. watch: measures the steps.
        looks_around: of keys, what moves is looked for ``flow.look_around_s`` beyond their windows
        too, where the engine can make use of that.

        Raises InputError if a key does not exist.
        """
        self.sequence, self.settings = sequence, settings
        self.timeline = Timeline.of(sequence)
        cut = Cut.whole(self.timeline, window)
        if keys is not None:
            looks_around = looks_around and engine_row(settings.flow.engine)[0].shared
            beyond_s = settings.flow.look_around_s if looks_around else 0.0
            cut = Cut.around(self.timeline, window, keys, beyond_s)
        self.cut = cut
        self._num_around, self._cache, self._watch = window, cache, watch or Watch()
        # What the next step, key or block is likely to ask for again is kept in memory.
        num_before = self.timeline.num_in(settings.register.lead_in_s)
        num_raw = 1 if cut.margin_s else cut.num_kept + num_before
        self.sweeps = Sweeps(
            sequence, self.timeline, settings.register, num_raw, cache, run, self._watch
        )
        self._places = Places(
            sequence, settings.register, self.timeline, cut, self.sweeps, cache, self._watch
        )
        self.registration = self._places.registration
        self.images = lru_cache(maxsize=4)(self._images)
        self.ground = lru_cache(maxsize=4)(self._ground)
        self.evidence = lru_cache(maxsize=4)(self._evidence)
        self.block_motion = lru_cache(maxsize=2)(self._block_motion)
        self.far = lru_cache(maxsize=1)(self._far)

    # For a key

    def window_frames(self, key: int) -> WindowFrames:
        """The frames of a key's window, and where it is cut and why.

        Raises InputError if the key does not exist or cannot be read, SweepError if it cannot be
        registered, or none of its neighbours can.
        """
        found = self.timeline.window(key, self._num_around)
        number = self.cut.number_of[key]
        bad: dict[int, LeftOut] = {}
        for b in self._places.blocks_with(number, found.frames):
            own = self.cut.blocks[b].frames
            bad |= {f: why for f, why in self.registration(b).bad.items() if f in own}
        if key in bad and bad[key].unreadable:
            raise InputError(bad[key].reason)
        if key in bad:
            raise SweepError(bad[key].reason, key)
        reasons = {f: why.reason for f, why in bad.items()}
        piece = self._places.piece(key)[1]
        window = self.timeline.window(key, self._num_around, reasons)
        window = WindowFrames(tuple(f for f in window.frames if f in piece.frames), window.cuts)
        failed = [f for f in found.frames if f in bad and not bad[f].unreadable]
        if failed and len(window.frames) == 1:
            raise SweepError(bad[failed[0]].reason, failed[0])
        return window

    def window(self, key: int) -> Stretch:
        """The sweeps of a key's window, registered and deskewed. Errors as `window_frames`."""
        number = self.cut.number_of[key]
        frames = self.window_frames(key).frames
        return self._places.stretch(number, self.cut.margin_s, frames)

    def around(self, key: int) -> Stretch:
        """The sweeps that the motion in a key's window is found out from."""
        number, (index, _) = self.cut.number_of[key], self._places.piece(key)
        margin_s = self.cut.margin_s
        frames = self._places.frames_within(number, margin_s)[index]
        return self._places.stretch(number, margin_s, frames)

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """How everything in a key's window moves. engine: None for that of ``flow.engine``."""
        engine = engine or self.settings.flow.engine
        number, (index, piece) = self.cut.number_of[key], self._places.piece(key)
        window = self.window(key)
        if not engine_row(engine)[0].shared:
            scene = Scene(window, self.ground(number)[index], self.settings.flow.min_height_m)
            return estimate_motion(scene, self.settings, engine)
        frames, motion = self.block_motion(number, engine)[index]
        # All poses, but the points of the window only.
        at_hand = {s.frame: s for s in window.sweeps}
        sweeps = [at_hand.get(f) or RegisteredSweep.without_points(piece, f) for f in frames]
        return motion.with_stretch(Stretch(tuple(sweeps)))

    def step(self, frame: int) -> StretchFlow:
        """The flow of a sweep to the next; no step where none follows. Errors as `window_frames`,
        but a sweep may be alone."""
        window = self.window(frame)
        following = [f for f in window.frames if f > frame][:1]
        motion = self.motion(frame) if following else None
        return StretchFlow(
            window, {(frame, f): motion.flow(frame, f) for f in following if motion is not None}
        )

    def moment(
        self, key: int, all_sweeps: bool, engine: str | None, with_flow: bool = False
    ) -> Moment:
        """What is measured around a key, as it stands at the key's moment.

        all_sweeps: of the window; else the key sweep alone. engine: which flow moves the points,
        "" for the configured one; None leaves them where registration puts them. with_flow: and
        the flow of every sweep to the next one on the way to the key.
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
            return Moment(accumulate(used, fields, key, drop_lost), flow, tracks)

    def standing(self, key: int) -> Beyond | None:
        """What stands along the road before and behind the key's window; None where nothing beyond
        it is known, or wanted (``accumulate.far_m``)."""
        if not self.settings.accumulate.far_m:
            return None
        number = self.cut.number_of[key]
        pieces = self._places.pieces(number, 0.0)
        index, piece = next((i, p) for i, p in enumerate(pieces) if key in p.frames)
        found = self.far(number)[index]
        if not len(found.frames):
            return None
        return Beyond(found, poses.inverse(piece.T_world_lidar[piece.frames.index(key)]))

    # For a block, by its number

    def _images(self, number: int) -> dict[int, RangeImage]:
        """Range images of the block's sweeps, by frame."""
        places, num_together = self._places, num_in_look(self.timeline.period_ns * 1e-9)
        pieces = {f: p for p in places.pieces(number, 0.0) for f in places.within(p, number, 0.0)}

        def make() -> dict[int, RangeImage]:
            sweeps = [places.deskewed(number, 0.0, f) for f in pieces]
            with self._watch.stage("flow"), ThreadPoolExecutor() as pool:
                image = partial(RangeImage.of, num_together=num_together)
                return dict(zip(pieces, pool.map(image, sweeps), strict=True))

        return kept(
            self._cache,
            "images",
            dict[int, RangeImage],
            lambda: [num_together, *((f, self.sweeps.content(f), p) for f, p in pieces.items())],
            make,
        )

    def _ground(self, number: int) -> list[HeightMap]:
        """Height of the ground within reach of the block, for each of its pieces."""

        def make(frames: Sequence[int]) -> HeightMap:
            stretch = self._places.stretch(number, REACH_S, frames)
            with self._watch.stage("ground"):
                return ground(stretch, self.settings.ground)

        return [
            kept(
                self._cache,
                "ground",
                HeightMap,
                partial(self._near, number, index),
                partial(make, frames),
            )
            for index, frames in enumerate(self._places.frames_within(number, REACH_S))
        ]

    def _evidence(self, number: int) -> list[dict[int, Candidates]]:
        """What may move in the block's sweeps, by frame, for each of its pieces."""
        min_height_m = self.settings.flow.min_height_m

        def make(index: int, frames: Sequence[int]) -> dict[int, Candidates]:
            stretch = self._places.stretch(number, REACH_S, frames)
            heights = self.ground(number)[index]
            space = self._space(number, stretch)
            own = [i for i, f in enumerate(frames) if f in self.cut.blocks[number].frames]
            with self._watch.stage("flow"):
                found = find_candidates(stretch, space, heights, min_height_m, own)
            return {frames[i]: c for i, c in zip(own, found, strict=True)}

        return [
            kept(
                self._cache,
                "evidence",
                dict[int, Candidates],
                partial(self._evidence_inputs, number, index),
                partial(make, index, f),
            )
            for index, f in enumerate(self._places.frames_within(number, REACH_S))
        ]

    def _block_motion(self, number: int, engine: str) -> list[tuple[Sequence[int], SharedMotion]]:
        """How everything within the margin of the block moves, for each of its pieces: the frames,
        and the motion without their points."""
        margin_s = self.cut.margin_s

        def make(index: int, frames: Sequence[int]) -> SharedMotion:
            stretch = self._places.stretch(number, margin_s, frames)
            scene = Scene(
                stretch,
                self.ground(number)[index],
                self.settings.flow.min_height_m,
                make_space=partial(self._space, number, stretch),
                make_candidates=partial(self._candidates, number, frames),
                asked=self._in_windows(number),
            )
            with self._watch.stage("flow"):
                motion = estimate_motion(scene, self.settings, engine)
            return cast(SharedMotion, motion).with_stretch(Stretch(()))

        def inputs(piece: Trajectory, frames: Sequence[int]) -> Any:
            evidence = [
                self._evidence_inputs(b, index)
                for b in self._places.blocks_with(number, frames)
                for index in range(len(self._places.pieces(b, REACH_S)))
            ]
            content = [self.sweeps.content(f) for f in frames]
            settings = [self.settings.flow, self.settings.objective]
            asked = sorted(self._in_windows(number) or ())
            return [engine, engine_row(engine)[0], settings, piece, asked, evidence, content]

        found: list[tuple[Sequence[int], SharedMotion]] = []
        pieces = self._places.pieces(number, margin_s)
        for index, frames in enumerate(self._places.frames_within(number, margin_s)):
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
        cameras = list(self.sequence.cameras.values())
        far_m, settings = self.settings.accumulate.far_m, self.settings.register
        road = Road(self.timeline, self.sweeps, cameras, settings, far_m, self._watch)

        def make(frames: Sequence[int]) -> StandingWorld:
            keys = [k for k, n in self.cut.number_of.items() if n == number and k in frames]
            near = self._places.stretch(number, 0.0, frames)
            with self._watch.stage("far"):
                return road.standing(near, keys, with_near=len(keys) > 1)

        def inputs(piece: Trajectory, frames: Sequence[int]) -> Any:
            content = [self.sweeps.content_if_readable(f) for f in road.frames(piece, frames)]
            return [settings, far_m, cameras, piece, list(frames), content]

        pieces = self._places.pieces(number, 0.0)
        near_frames, inside = self._places.frames_within(number, 0.0), self._in_windows(number)
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
        if self.cut.margin_s:
            return None
        keys = (key for key, n in self.cut.number_of.items() if n == number)
        windows = (self.timeline.window(key, self._num_around).frames for key in keys)
        return frozenset(chain.from_iterable(windows))

    def _space(self, number: int, stretch: Stretch) -> FreeSpace:
        images = {
            f: image
            for b in self._places.blocks_with(number, stretch.frames)
            for f, image in self.images(b).items()
        }
        return FreeSpace.of(stretch, [images[f] for f in stretch.frames])

    def _candidates(self, number: int, frames: Sequence[int]) -> tuple[Candidates, ...]:
        evidence = {
            f: found
            for b in self._places.blocks_with(number, frames)
            for piece in self.evidence(b)
            for f, found in piece.items()
        }
        return tuple(evidence[f] for f in frames)

    # Kept on disk

    def _near(self, number: int, index: int) -> Any:
        """What the ground of a piece depends on."""
        piece = self._places.pieces(number, REACH_S)[index]
        content = [self.sweeps.content(f) for f in self._places.within(piece, number, REACH_S)]
        return [self.settings.ground, number, piece, content]

    def _evidence_inputs(self, number: int, index: int) -> Any:
        return [self.settings.flow.min_height_m, self._near(number, index)]
