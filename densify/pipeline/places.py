# SPDX-License-Identifier: MIT
"""Where the sweeps of a recording's blocks are: registered block by block, joined over neighbouring
blocks, and deskewed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache, partial

from densify.config import RegisterSettings
from densify.config.cache import Cache, kept
from densify.config.errors import InputError, SweepError, UnfitSweepError
from densify.geometry.types import LidarSequence, RegisteredSweep, Stretch, Trajectory
from densify.pipeline.blocks import Cut
from densify.pipeline.costs import Watch
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline
from densify.readers.window import recorded_trajectory
from densify.registration.deskew import deskew
from densify.registration.trajectory import LeftOut, Registration, find_trajectory


class Places:
    """Answers for a block by its number, and for what lies so many seconds around it.

    `registration`: poses of the block's own sweeps. `pieces`: of neighbouring sweeps, joined over
    blocks, each piece in a world of its own. `deskewed`: a sweep in its place.
    """

    def __init__(
        self,
        sequence: LidarSequence,
        settings: RegisterSettings,
        timeline: Timeline,
        cut: Cut,
        sweeps: Sweeps,
        cache: Cache | None,
        watch: Watch,
    ) -> None:
        self._sequence, self._settings, self._timeline = sequence, settings, timeline
        self._cut, self._sweeps, self._cache, self._watch = cut, sweeps, cache, watch
        self.registration = lru_cache(maxsize=8)(self._registration)
        self.pieces = lru_cache(maxsize=8)(self._find_pieces)
        self.deskewed = lru_cache(maxsize=cut.num_kept)(self._deskew)
        self._stretch = lru_cache(maxsize=1)(self._make_stretch)  # steps often ask for it again

    def _registration(self, number: int) -> Registration:
        frames = self._cut.blocks[number].frames
        num_before = self._timeline.num_in(self._settings.lead_in_s)
        if self._cut.margin_s:  # without a sweep before it a block could not be joined to the last
            num_before = max(1, num_before)
        bad, known, frames = {}, {}, (*self._timeline.before(frames[0], num_before), *frames)
        self._sweeps.prepare(frames)
        for frame in frames:
            try:
                known[frame] = (self._sweeps.content(frame), self._sweeps.recorded_pose(frame))
            except InputError as error:
                bad[frame] = LeftOut(str(error), unreadable=True)
        return kept(
            self._cache,
            "registration",
            Registration,
            lambda: [self._settings, self._timeline.period_ns, bad, known],
            partial(self._register, list(known), bad),
        )

    def _register(self, frames: Sequence[int], unreadable: Mapping[int, LeftOut]) -> Registration:
        """Register every run of neighbours by itself, parted again where a sweep is in the way."""
        pieces, bad, left = [], dict(unreadable), self._timeline.runs(frames)
        while left:
            run = left.pop()
            sweeps = [self._sweeps.read(f) for f in run]
            recorded = None
            if self._settings.source == "dataset":
                recorded = recorded_trajectory(self._sequence, sweeps)
            try:
                with self._watch.stage("register"):
                    pieces.append(find_trajectory(sweeps, self._settings, recorded))
            except SweepError as error:
                unfit = isinstance(error, UnfitSweepError)
                bad[error.frame] = LeftOut(str(error), unreadable=False, unfit=unfit)
                left += self._timeline.runs([f for f in run if f != error.frame])
        return Registration(tuple(sorted(pieces, key=lambda p: p.frames)), bad)

    def _find_pieces(self, number: int, around_s: float) -> list[Trajectory]:
        """Poses of neighbouring sweeps of a block and so far around it, and of one more at each
        end, which tells how the lidar moved; only those with a sweep of the block. The world is
        the lidar of the piece's first sweep in the block."""
        frames = self.around(number, around_s)
        before, after = self._timeline.before(frames[0], 1), self._timeline.after(frames[-1], 1)
        wanted = {*before, *frames, *after}
        pieces: list[Trajectory] = []
        for b in self.blocks_with(number, wanted):
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
        in_block = [[f for f in p.frames if f in self._cut.blocks[number].frames] for p in pieces]
        return [p.seen_from(f[0]) for f, p in zip(in_block, pieces, strict=True) if f]

    def piece(self, key: int) -> tuple[int, Trajectory]:
        """Which of the pieces of its block has the key, and that piece with its margin."""
        pieces = self.pieces(self._cut.number_of[key], self._cut.margin_s)
        return next((i, p) for i, p in enumerate(pieces) if key in p.frames)

    def around(self, number: int, around_s: float) -> list[int]:
        """Frames of a block and so far around it, but no farther than its margin."""
        block, around_ns = self._cut.blocks[number], round(min(around_s, self._cut.margin_s) * 1e9)
        if not around_ns:
            return list(block.frames)
        return self._timeline.within(block.begin_ns - around_ns, block.end_ns + around_ns)

    def within(self, piece: Trajectory, number: int, around_s: float) -> list[int]:
        """Frames of a piece that are in the block or so far around it."""
        around = frozenset(self.around(number, around_s))
        return [f for f in piece.frames if f in around]

    def frames_within(self, number: int, around_s: float) -> list[list[int]]:
        """Frames of each piece, without the one more at each end."""
        return [self.within(p, number, around_s) for p in self.pieces(number, around_s)]

    def blocks_with(self, number: int, frames: Collection[int]) -> list[int]:
        """The blocks that work out these frames for this one."""
        if not self._cut.margin_s:
            return [number]
        return sorted({self._cut.number_of[f] for f in frames})

    def stretch(self, number: int, around_s: float, frames: Sequence[int]) -> Stretch:
        """These sweeps of one piece, deskewed, in its world."""
        return self._stretch(number, min(around_s, self._cut.margin_s), tuple(frames))

    def _make_stretch(self, number: int, around_s: float, frames: tuple[int, ...]) -> Stretch:
        return Stretch(tuple(self.deskewed(number, around_s, f) for f in frames))

    def _deskew(self, number: int, around_s: float, frame: int) -> RegisteredSweep:
        piece = next(p for p in self.pieces(number, around_s) if frame in p.frames)
        sweep = self._sweeps.read(frame)
        with self._watch.stage("deskew"):
            return deskew([sweep], piece).sweeps[0]
