# SPDX-License-Identifier: MIT
"""How the sweeps of a recording are cut into blocks that are worked on together."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from densify.readers.timeline import Timeline, check_key, check_window

BLOCK_S = 2.0
_MARGIN_S = 1.5  # beyond a block within which its motion is found,
_BEYOND_WINDOW_S = 0.5  # and at least so far beyond the windows of its keys


class Block(NamedTuple):
    """Sweeps whose results are made together. begin_ns, end_ns: the time they fill."""

    frames: tuple[int, ...]
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Cut:
    """How a recording is cut.

    blocks: ascending in time. number_of: frame of a key -> its block. margin_s: how far the motion
    of a block is followed beyond it; no step looks farther. 0: blocks know nothing of each other,
    and may overlap. num_kept: deskewed sweeps that are worth keeping in memory.
    """

    blocks: tuple[Block, ...]
    number_of: Mapping[int, int]
    margin_s: float
    num_kept: int

    def number_near(self, frame: int) -> int:
        """The block of a frame, or of the last sweep before it where it has none."""
        frames = sorted(self.number_of)
        return self.number_of[frames[max(0, bisect_right(frames, frame) - 1)]]

    @property
    def num_blocks_around(self) -> int:
        """How many blocks on each side of a block its motion is made of. Steps look one sweep
        farther than the margin, which may be as far as a hole in time is long."""
        return math.ceil((self.margin_s + 0.5) / BLOCK_S)

    @property
    def num_sweeps_of_block(self) -> int:
        """Sweeps that the motion of a block is made of, at the most."""
        most = max((len(block.frames) for block in self.blocks), default=0)
        return math.ceil(most * (1 + 2 * self.margin_s / BLOCK_S))

    @staticmethod
    def whole(timeline: Timeline, window: int) -> Cut:
        """Blocks of `BLOCK_S`, counted from time 0, of every sweep that has a stamp."""
        check_window(window)
        length_ns = round(BLOCK_S * 1e9)
        members: dict[int, list[int]] = {}
        for frame in timeline.frames:
            members.setdefault(timeline.stamp_of(frame) // length_ns, []).append(frame)
        blocks = tuple(
            Block(tuple(frames), at * length_ns, (at + 1) * length_ns)
            for at, frames in sorted(members.items())
        )
        number_of = {f: number for number, block in enumerate(blocks) for f in block.frames}
        margin_s = max(_MARGIN_S, window * timeline.period_ns * 1e-9 + _BEYOND_WINDOW_S)
        return Cut(blocks, number_of, margin_s, 2 * window + 3)

    @staticmethod
    def around(
        timeline: Timeline, window: int, keys: Collection[int], beyond_s: float = 0.0
    ) -> Cut:
        """The windows of the keys and ``beyond_s`` before and after them; those that overlap are
        one block, unless its keys then are more than `BLOCK_S` apart. Raises InputError if a key
        does not exist."""
        for key in keys:
            check_key(key)
        check_window(window)
        window += round(beyond_s * 1e9 / timeline.period_ns)
        groups: list[list[int]] = []
        spans: list[tuple[int, int]] = []
        for key in sorted(set(keys)):
            frames = timeline.window(key, window).frames
            first, last = timeline.row[frames[0]], timeline.row[frames[-1]]
            together = groups and (
                first <= spans[-1][1]
                and timeline.stamp_of(key) - timeline.stamp_of(groups[-1][0]) < BLOCK_S * 1e9
            )
            if together:
                groups[-1].append(key)
                spans[-1] = (spans[-1][0], last)
            else:
                groups.append([key])
                spans.append((first, last))
        blocks = []
        for first, last in spans:
            frames = timeline.frames[first : last + 1]
            end_ns = timeline.stamp_of(frames[-1]) + 1
            blocks.append(Block(frames, timeline.stamp_of(frames[0]), end_ns))
        number_of = {key: number for number, group in enumerate(groups) for key in group}
        most = max((len(block.frames) for block in blocks), default=0)
        return Cut(tuple(blocks), number_of, 0.0, most)
