# SPDX-License-Identifier: MIT
"""A recording, and what is known around each of its keys.

The sweeps are cut into blocks (`densify.pipeline.blocks`), and the steps that keys share are made
block by block (`densify.pipeline.steps`). `run` and `compare` cut around a few keys, which look at
nothing else; `dataset` and `flow_steps` cut the whole recording, so that the same sweeps make the
same maps whatever else is asked for.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from densify.config import Config
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.config.plugins.engines import engine as engine_row
from densify.depth.accumulate import accumulate, object_tracks
from densify.flow.engines import Scene, estimate_motion
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
)
from densify.pipeline.blocks import Cut
from densify.pipeline.costs import Watch
from densify.pipeline.steps import Steps
from densify.readers.timeline import Timeline, WindowFrames
from densify.registration.trajectory import LeftOut


class Moment(NamedTuple):
    """All points around a key at the key's moment. flow: where asked for. tracks: of what moves."""

    cloud: Cloud
    flow: StretchFlow | None
    tracks: tuple[ObjectTrack, ...]


class Beyond(NamedTuple):
    """Static surfaces along the road beyond a key's window, in a world of their own."""

    standing: StandingWorld
    T_key_standing: Float


class Recording:
    """A sequence with settings, and what the steps find in it."""

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
        """Read the stamps, nothing else.

        window: sweeps on each side of a key. keys: work on their windows alone; None for the whole
        recording. cache: keeps the results of steps on disk. run: the same text for all processes
        between which no sweep changes; None for this object alone. watch: measures the steps.
        looks_around: find motion ``flow.look_around_s`` beyond the windows of the keys too.

        Raises InputError if a key does not exist.
        """
        self.sequence, self.settings = sequence, settings
        self.timeline = Timeline.of(sequence)
        self._num_around, self._watch = window, watch or Watch()
        if keys is None:
            self.cut = Cut.whole(self.timeline, window)
        else:
            self.cut = Cut.around(self.timeline, window, keys)
            if looks_around and engine_row(settings.flow.engine)[0].shared:
                self.cut = Cut.around(self.timeline, window, keys, self._around_s(keys))
        self.steps = Steps(
            sequence, settings, self.timeline, self.cut, window, cache, run, self._watch
        )

    def _around_s(self, keys: Collection[int]) -> float:
        """Return how far beyond the windows to look, by the number of points of the first key."""
        settings = self.settings.flow
        if settings.look_around_s is not None or not keys:
            return settings.look_around_s or 0.0
        try:
            num_points = len(self.sequence[min(keys)])
        except InputError:  # raised again where the key is made
            return 0.0
        return settings.around_s(num_points / (self.timeline.period_ns * 1e-9))

    def window_frames(self, key: int) -> WindowFrames:
        """Return the frames of a key's window, and where it is cut and why.

        Raises InputError if the key does not exist or cannot be used, UnplacedSweepError if it
        cannot be registered; SweepError if none of its neighbours can.
        """
        whole = self.timeline.window(key, self._num_around)
        bad: dict[int, LeftOut] = {}
        for b in self.steps.blocks_around(self.cut.number_of[key]):
            own = self.cut.blocks[b].frames
            bad |= {f: why for f, why in self.steps.registration(b).bad.items() if f in own}
        if key in bad:
            raise bad[key].error(key)
        reasons = {f: why.reason for f, why in bad.items()}
        window = self.timeline.window(key, self._num_around, reasons)
        piece = self.steps.pieces(self.cut.number_of[key])[self._piece(key)]
        window = WindowFrames(tuple(f for f in window.frames if f in piece.frames), window.cuts)
        failed = [f for f in whole.frames if f in bad and not bad[f].unreadable]
        if failed and len(window.frames) == 1:
            raise bad[failed[0]].error(failed[0])
        return window

    def window(self, key: int) -> Stretch:
        """Return the registered, deskewed sweeps of a key's window. Errors as `window_frames`."""
        return self.steps.stretch(self.cut.number_of[key], self.window_frames(key).frames)

    def around(self, key: int) -> Stretch:
        """Return the sweeps in which the motion in a key's window is found."""
        return self.steps.stretch(self.cut.number_of[key], self._frames_around(key))

    def is_pair(self, key: int) -> bool:
        """Return True if there are two sweeps around a key: a track needs three."""
        return len(self._frames_around(key)) == 2

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """Return the motion of everything in a key's window.

        engine: None for that of ``flow.engine``; for two sweeps ``pairs`` replaces ``groups``.
        """
        engine, number = engine or self.settings.flow.engine, self.cut.number_of[key]
        window, index = self.window(key), self._piece(key)
        if engine == "groups" and self.is_pair(key):
            engine = "pairs"
        if not engine_row(engine)[0].shared:
            scene = Scene(window, self.steps.ground(number)[index])
            return estimate_motion(scene, self.settings, engine)
        motion = self.steps.motion(number, engine)[index]
        # All poses, but the points of the window only.
        at_hand, piece = {s.frame: s for s in window.sweeps}, self.steps.pieces(number)[index]
        sweeps = [
            at_hand.get(f) or RegisteredSweep.without_points(piece, f)
            for f in self._frames_around(key)
        ]
        return motion.with_stretch(Stretch(tuple(sweeps)))

    def step(self, frame: int) -> StretchFlow:
        """Return the flow of a sweep to the next; no step where none follows.

        Errors as `window_frames`, but a sweep may be alone.
        """
        window = self.window(frame)
        following = [f for f in window.frames if f > frame][:1]
        motion = self.motion(frame) if following else None
        return StretchFlow(
            window, {(frame, f): motion.flow(frame, f) for f in following if motion is not None}
        )

    def moment(
        self, key: int, all_sweeps: bool, engine: str | None, with_flow: bool = False
    ) -> Moment:
        """Accumulate the sweeps around a key at the key's moment.

        all_sweeps: of the window; else the key sweep alone. engine: of the flow that moves the
        points, "" for the configured one; None for rigid accumulation. with_flow: return the flow
        of every sweep to the next one on the way to the key too.
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
        """Return the static surfaces before and behind the key's window.

        None where nothing is known there, or wanted (``accumulate.far_m``).
        """
        if not self.settings.accumulate.far_m:
            return None
        number, index = self.cut.number_of[key], self._piece(key)
        found, piece = self.steps.far(number)[index], self.steps.pieces(number)[index]
        if not len(found.frames):
            return None
        return Beyond(found, poses.inverse(piece.T_world_lidar[piece.frames.index(key)]))

    def _piece(self, key: int) -> int:
        """Return which of the pieces of its block holds the key."""
        pieces = self.steps.pieces(self.cut.number_of[key])
        return next(i for i, piece in enumerate(pieces) if key in piece.frames)

    def _frames_around(self, key: int) -> tuple[int, ...]:
        return self.steps.frames(self.cut.number_of[key])[self._piece(key)]
