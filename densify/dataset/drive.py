# SPDX-License-Identifier: MIT
"""What the keys of a recording share, each piece of it made once: poses, range images, ground, what
may move, and how it moves.

A recording is cut into blocks of `BLOCK` frames, counted from frame 0 whatever keys are wanted, so
that the same sweeps always make the same maps. Each step looks a fixed number of sweeps beyond its
block and takes what the blocks around have made:

    registration    poses of a block's sweeps, odometry starting a few sweeps before it
    images          range images of its deskewed sweeps
    evidence        what may move in its sweeps, by all sweeps within reach, and the ground there
    motion          tracks of everything that moves, followed well into the blocks around: what two
                    neighbours say of the sweeps between them is found from the same evidence

Sweeps that cannot be read or registered are left out and split the recording: windows end there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any
from uuid import uuid4

import numpy as np

from densify.config import Config
from densify.cache import Cache, digest
from densify.errors import InputError, SweepError
from densify.flow.scene import Scene
from densify.flow.tracking.evidence import REACH, Candidates, FreeSpace, find_candidates
from densify.flow.tracking.groups import GroupMotion, estimate_motion
from densify.geometry.ground import ground
from densify.geometry.height_map import HeightMap
from densify.geometry.poses import inverse
from densify.geometry.range_image import RangeImage
from densify.pipeline import find_trajectory, motion_by
from densify.readers.window import read_sweeps
from densify.registration.deskew import deskew
from densify.types import LidarSequence, Motion, RegisteredSweep, Stretch, Sweep, Trajectory

BLOCK = 20
_MARGIN = 15  # sweeps beyond the block within which motion is found,
_BEYOND_WINDOW = 5  # and at least so many beyond the windows of its keys


def margin(window: int) -> int:
    """Sweeps on each side of a block that its motion is found from."""
    return max(_MARGIN, window + _BEYOND_WINDOW)


@dataclass(frozen=True)
class Registration:
    """pieces: poses of consecutive sweeps, each with a world of its own, those before the block
    that odometry started with included. bad: frame -> why it is left out."""

    pieces: tuple[Trajectory, ...]
    bad: Mapping[int, str]


@dataclass(frozen=True)
class Evidence:
    """Of the sweeps of a block that belong to one piece; by frame."""

    ground: HeightMap
    candidates: Mapping[int, Candidates]


class Drive:
    """A recording. Holds little: what was read and made last; the rest is in the cache.

    window: sweeps on each side of the keys. run: the same for all processes between which no sweep
    changes; None is by itself. All methods take a block's number unless they say so.
    """

    def __init__(
        self,
        sequence: LidarSequence,
        settings: Config,
        window: int,
        cache: Cache,
        run: str | None = None,
    ) -> None:
        self._sequence, self._settings, self._window = sequence, settings, window
        self._cache, self._run = cache, run or uuid4().hex
        self._frames = frozenset(sequence.frames)
        self._margin = margin(window)
        # What the next step, key or block is likely to ask for again.
        self._digests = lru_cache(maxsize=None)(self._find_digests)
        self.registration = lru_cache(maxsize=8)(self._registration)
        self.images = lru_cache(maxsize=4)(self._images)
        self.evidence = lru_cache(maxsize=4)(self._evidence)
        self.motion = lru_cache(maxsize=1)(self._motion)
        self._deskewed = lru_cache(maxsize=2 * window + 3)(self._deskew_for_key)

    def window(self, key: int) -> Stretch:
        """The sweeps of a key's window, registered and deskewed; cut where the recording ends or a
        sweep is left out. Raises SweepError if the key itself is."""
        block = key // BLOCK
        piece = self._piece_of(key, block)
        near = [f for f in _within(piece, block, self._margin) if abs(f - key) <= self._window]
        return Stretch(tuple(self._deskewed(block, f) for f in near))

    def motion_of(self, key: int) -> Motion:
        """Of everything in the window of a key."""
        block = key // BLOCK
        piece, window = self._piece_of(key, block), self.window(key)
        frames = _within(piece, block, self._margin)
        if self._settings.flow.engine != "groups":
            heights = next(e.ground for e in self.evidence(block) if key in e.candidates)
            return motion_by(self._settings.flow.engine, window, heights, self._settings)
        motion = next(m for f, m in self.motion(block) if key in f)
        # All poses, but the points of the window only.
        at_hand = {s.frame: s for s in window.sweeps}
        stretch = Stretch(tuple(at_hand.get(f) or _hollow(piece, f) for f in frames))
        return replace(motion, stretch=stretch)

    def _piece_of(self, key: int, block: int) -> Trajectory:
        bad = self.registration(block).bad
        if key in bad:
            raise SweepError(bad[key], key)
        return next(p for p in self._pieces(block, self._margin) if key in p.frames)

    def _registration(self, block: int) -> Registration:
        # Without a sweep before it a block could not be joined to the one before.
        num_before = max(1, self._settings.register.num_lead_in)
        first, end = block * BLOCK - num_before, (block + 1) * BLOCK
        given = self._settings.register.source == "dataset"
        bad, known = {}, {}
        for frame in (f for f in range(first, end) if f in self._frames):
            try:
                pose = self._sequence.T_world_lidar(frame) if given else None
                known[frame] = (self._digest(frame), pose)
            except InputError as error:
                bad[frame] = str(error)
        inputs = [self._settings.register, bad, known]

        def register() -> Registration:
            return self._register(list(known), bad)

        return self._cache.get("registration", inputs, register)

    def _register(self, frames: Sequence[int], unreadable: Mapping[int, str]) -> Registration:
        """Every run of consecutive frames by itself, parted again where a sweep is in the way."""
        pieces, bad, left = [], dict(unreadable), _runs(frames)
        while left:
            run = left.pop()
            sweeps = [self._read(f) for f in run]
            try:
                pieces.append(find_trajectory(self._sequence, sweeps, self._settings.register))
            except SweepError as error:
                bad[error.frame] = str(error)
                left += _runs([f for f in run if f != error.frame])
        return Registration(tuple(sorted(pieces, key=lambda p: p.frames)), bad)

    def _pieces(self, block: int, around: int) -> list[Trajectory]:
        """Poses of consecutive sweeps of a block and so many around it, and of one more at each
        end, which tells how the lidar moved; only those with a sweep of the block. The world is
        the lidar of the piece's first sweep in the block."""
        first, end = block * BLOCK - around - 1, (block + 1) * BLOCK + around + 1
        pieces: list[Trajectory] = []
        for b in range(max(0, first // BLOCK), (end - 1) // BLOCK + 1):
            for found in self.registration(b).pieces:
                own = [f for f in found.frames if f // BLOCK == b and first <= f < end]
                if not own:
                    continue
                before = own[0] - 1
                if pieces and pieces[-1].frames[-1] == before and before in found.frames:
                    pieces[-1] = _joined(pieces[-1], found, own)
                else:
                    pieces.append(_part(found, own))
        in_block = [[f for f in p.frames if f // BLOCK == block] for p in pieces]
        return [_in_world_of(f[0], p) for f, p in zip(in_block, pieces, strict=True) if f]

    def _images(self, block: int) -> dict[int, RangeImage]:
        """By frame."""
        pieces = {f: p for p in self._pieces(block, 0) for f in _within(p, block, 0)}
        inputs = [(f, self._digest(f), p) for f, p in pieces.items()]

        def image() -> dict[int, RangeImage]:
            return {f: RangeImage.of(self._deskew(f, p)) for f, p in pieces.items()}

        return self._cache.get("images", inputs, image)

    def _evidence(self, block: int) -> list[Evidence]:
        """Of each piece."""

        def find(piece: Trajectory) -> Evidence:
            stretch = self._stretch(piece, _within(piece, block, REACH))
            heights = ground(stretch, self._settings.ground)
            space = FreeSpace.of(stretch, [self.images(f // BLOCK)[f] for f in stretch.frames])
            own = [i for i, f in enumerate(stretch.frames) if f // BLOCK == block]
            min_height_m = self._settings.flow.min_height_m
            found = find_candidates(stretch, space, heights, min_height_m, own)
            return Evidence(
                heights, {stretch.frames[i]: c for i, c in zip(own, found, strict=True)}
            )

        return [
            self._cache.get("evidence", inputs, partial(find, piece))
            for piece, inputs in self._evidence_inputs(block)
        ]

    def _evidence_inputs(self, block: int) -> list[tuple[Trajectory, Any]]:
        settings = [self._settings.ground, self._settings.flow.min_height_m, block]
        return [
            (p, [settings, p, [self._digest(f) for f in _within(p, block, REACH)]])
            for p in self._pieces(block, REACH)
        ]

    def _motion(self, block: int) -> list[tuple[Sequence[int], GroupMotion]]:
        """Of each piece: the frames, and how everything in them moves, without their points."""
        flow = self._settings.flow
        found: list[tuple[Sequence[int], GroupMotion]] = []

        def find(piece: Trajectory, frames: Sequence[int]) -> GroupMotion:
            stretch = self._stretch(piece, frames)
            space = FreeSpace.of(stretch, [self.images(f // BLOCK)[f] for f in frames])
            candidates = {
                f: c
                for b in _blocks(frames)
                for e in self.evidence(b)
                for f, c in e.candidates.items()
            }
            own = [e for e in self.evidence(block) if not e.candidates.keys().isdisjoint(frames)]
            scene = Scene(
                stretch,
                own[0].ground,
                flow.min_height_m,
                make_space=lambda: space,
                make_candidates=lambda: tuple(candidates[f] for f in frames),
            )
            motion = estimate_motion(scene, self._settings, "")
            return replace(motion, stretch=Stretch(()))

        for piece in self._pieces(block, self._margin):
            frames = _within(piece, block, self._margin)
            evidence = [inputs for b in _blocks(frames) for inputs in self._evidence_inputs(b)]
            inputs = [flow.soft, piece, evidence, [self._digest(f) for f in frames]]
            motion = self._cache.get("motion", inputs, partial(find, piece, frames))
            found.append((frames, motion))
        return found

    def _digest(self, frame: int) -> str:
        """Of a sweep's content. Raises InputError if it cannot be read."""
        found = self._digests(frame // BLOCK)[frame]
        if isinstance(found, InputError):
            raise found
        return found

    def _find_digests(self, block: int) -> dict[int, str | InputError]:
        """By frame; looked up by all processes of a run, which only the first has to read for."""

        def read() -> dict[int, str | InputError]:
            found: dict[int, str | InputError] = {}
            for frame in range(block * BLOCK, (block + 1) * BLOCK):
                if frame in self._frames:
                    try:
                        found[frame] = digest(self._read(frame))
                    except InputError as error:
                        found[frame] = error
            return found

        inputs = [self._run, self._sequence.name, self._settings.register, block]
        return self._cache.get("digests", inputs, read)

    def _read(self, frame: int) -> Sweep:
        return next(read_sweeps(self._sequence, [frame], self._settings.register))

    def _stretch(self, piece: Trajectory, frames: Sequence[int]) -> Stretch:
        return Stretch(tuple(self._deskew(f, piece) for f in frames))

    def _deskew(self, frame: int, piece: Trajectory) -> RegisteredSweep:
        return deskew([self._read(frame)], piece).sweeps[0]

    def _deskew_for_key(self, block: int, frame: int) -> RegisteredSweep:
        return self._deskew(frame, self._piece_of(frame, block))


def _runs(frames: Sequence[int]) -> list[list[int]]:
    """Consecutive ones together."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][-1] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return runs


def _blocks(frames: Sequence[int]) -> list[int]:
    return sorted({f // BLOCK for f in frames})


def _within(piece: Trajectory, block: int, around: int) -> list[int]:
    """Frames of the block and so many around it."""
    first, end = block * BLOCK - around, (block + 1) * BLOCK + around
    return [f for f in piece.frames if first <= f < end]


def _part(piece: Trajectory, frames: Sequence[int]) -> Trajectory:
    rows = [piece.frames.index(f) for f in frames]
    return Trajectory(tuple(frames), piece.stamp_ns[rows], piece.T_world_lidar[rows])


def _joined(piece: Trajectory, following: Trajectory, frames: Sequence[int]) -> Trajectory:
    """With these frames of another trajectory, which has the piece's last frame too."""
    T_world_last = piece.T_world_lidar[-1]
    T_other_last = following.T_world_lidar[following.frames.index(piece.frames[-1])]
    part = _part(following, frames)
    return Trajectory(
        piece.frames + part.frames,
        np.concatenate([piece.stamp_ns, part.stamp_ns]),
        np.concatenate(
            [piece.T_world_lidar, T_world_last @ inverse(T_other_last) @ part.T_world_lidar]
        ),
    )


def _in_world_of(frame: int, piece: Trajectory) -> Trajectory:
    T_old_new = piece.T_world_lidar[piece.frames.index(frame)]
    return replace(piece, T_world_lidar=inverse(T_old_new) @ piece.T_world_lidar)


def _hollow(piece: Trajectory, frame: int) -> RegisteredSweep:
    """A sweep's place and time without its points."""
    i, nothing = piece.frames.index(frame), np.zeros(0)
    sweep = Sweep(
        *(frame, int(piece.stamp_ns[i]), np.zeros((0, 3)), nothing.astype(np.float32), None),
        *(nothing.astype(np.uint8), nothing.astype(np.int64)),
    )
    return RegisteredSweep(sweep, piece.T_world_lidar[i], np.zeros(6), np.zeros(6))
