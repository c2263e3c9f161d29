# SPDX-License-Identifier: MIT
"""A recording and what is worked out about it, each step made once and asked for by name
(`densify.pipeline.block_steps`)::

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

* `Cut.around` (`densify.pipeline.blocks`): the windows of a few keys, which look at nothing else.
  `run` and `compare` use it: no key costs more than it must.
* `Cut.whole`: blocks of two seconds, counted from time 0 whatever keys are wanted, that look well
  into the blocks around. The same sweeps make the same maps, whatever else is asked for: `dataset`
  uses it.

Sweeps that cannot be read or registered are left out and split the recording: windows end there,
as they do at holes in time (`densify.readers.timeline`).
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
from densify.pipeline.block_steps import BlockSteps
from densify.pipeline.blocks import Cut
from densify.pipeline.costs import Watch
from densify.readers.timeline import Timeline, WindowFrames
from densify.registration.trajectory import LeftOut


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

    `window`, `motion`, `moment` and `standing` answer for a key; `steps` for a block, with what its
    keys share.
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
            cut = Cut.around(self.timeline, window, keys)
            if looks_around and engine_row(settings.flow.engine)[0].shared:
                cut = Cut.around(self.timeline, window, keys, self._around_s(keys))
        self.cut = cut
        self._num_around, self._watch = window, watch or Watch()
        self.steps = BlockSteps(
            sequence, settings, self.timeline, cut, window, cache, run, self._watch
        )
        self._places = self.steps.places

    def _around_s(self, keys: Collection[int]) -> float:
        """How far beyond the windows of keys what moves is looked for, by the points that the first
        one's sweep has; 0 where that says nothing."""
        settings = self.settings.flow
        if settings.look_around_s is not None or not keys:
            return settings.look_around_s or 0.0
        try:
            num_points = len(self.sequence[min(keys)])
        except InputError:  # whoever works on it says why
            return 0.0
        return settings.around_s(num_points / (self.timeline.period_ns * 1e-9))

    def window_frames(self, key: int) -> WindowFrames:
        """The frames of a key's window, and where it is cut and why.

        Raises InputError if the key does not exist or cannot be used, UnplacedSweepError if it
        cannot be registered; SweepError if none of its neighbours can.
        """
        found = self.timeline.window(key, self._num_around)
        number = self.cut.number_of[key]
        bad: dict[int, LeftOut] = {}
        for b in self._places.blocks_with(number, found.frames):
            own = self.cut.blocks[b].frames
            bad |= {f: why for f, why in self.steps.registration(b).bad.items() if f in own}
        if key in bad:
            raise bad[key].error(key)
        reasons = {f: why.reason for f, why in bad.items()}
        piece = self._places.piece(key)[1]
        window = self.timeline.window(key, self._num_around, reasons)
        window = WindowFrames(tuple(f for f in window.frames if f in piece.frames), window.cuts)
        failed = [f for f in found.frames if f in bad and not bad[f].unreadable]
        if failed and len(window.frames) == 1:
            raise bad[failed[0]].error(failed[0])
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

    def is_pair(self, key: int) -> bool:
        """Whether nothing can be followed around a key: a track shows itself in three sweeps."""
        number, (index, _) = self.cut.number_of[key], self._places.piece(key)
        return len(self._places.frames_within(number, self.cut.margin_s)[index]) == 2

    def motion(self, key: int, engine: str | None = None) -> Motion:
        """How everything in a key's window moves. engine: None for that of ``flow.engine``; of two
        sweeps ``pairs`` takes the place of ``groups``."""
        engine = engine or self.settings.flow.engine
        number, (index, piece) = self.cut.number_of[key], self._places.piece(key)
        window = self.window(key)
        if engine == "groups" and self.is_pair(key):
            engine = "pairs"
        if not engine_row(engine)[0].shared:
            scene = Scene(window, self.steps.ground(number)[index])
            return estimate_motion(scene, self.settings, engine)
        frames, motion = self.steps.motion(number, engine)[index]
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
        found = self.steps.far(number)[index]
        if not len(found.frames):
            return None
        return Beyond(found, poses.inverse(piece.T_world_lidar[piece.frames.index(key)]))
