# SPDX-License-Identifier: MIT
"""The blocks of sweeps that a recording is cut into; each step works on one block."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from densify.readers.timeline import Timeline, check_key, check_window

BLOCK_S = 2.0
MARGIN_S = 1.5  # around a block within which its motion is found,
BEYOND_WINDOW_S = 0.5  # and at least this far beyond the windows of its keys


class Block(NamedTuple):
    """Sweeps whose results are made together. begin_ns, end_ns: the time they fill."""

    frames: tuple[int, ...]
    begin_ns: int
    end_ns: int


@dataclass(frozen=True)
class Cut:
    """A recording cut into blocks.

    blocks: ascending in time. number_of: frame of a key -> its block. margin_s: how far around a
    block its steps look; 0: blocks are independent and may overlap. num_kept: deskewed sweeps that
    are worth keeping in memory.
    """

    blocks: tuple[Block, ...]
    number_of: Mapping[int, int]
    margin_s: float
    num_kept: int

    def number_near(self, frame: int) -> int:
        """Return the block of a frame, or of the last sweep before it where it has none."""
        frames = sorted(self.number_of)
        return self.number_of[frames[max(0, bisect_right(frames, frame) - 1)]]

    def keys_of(self, number: int) -> list[int]:
        """Return the keys of a block."""
        return [key for key, n in self.number_of.items() if n == number]

    @staticmethod
    def whole(timeline: Timeline, window: int) -> Cut:
        """Cut all sweeps into blocks of `BLOCK_S`, counted from time 0.

        The same sweeps make the same maps, whatever keys are asked for.
        """
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
        margin_s = max(MARGIN_S, window * timeline.period_ns * 1e-9 + BEYOND_WINDOW_S)
        return Cut(blocks, number_of, margin_s, 2 * window + 3)

    @staticmethod
    def around(
        timeline: Timeline, window: int, keys: Collection[int], beyond_s: float = 0.0
    ) -> Cut:
        """Take the windows of a few keys, and ``beyond_s`` around them, and nothing else.

        Windows that overlap are one block, unless its keys are more than `BLOCK_S` apart. Raises
        InputError if a key does not exist.
        """
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
        return Cut(tuple(blocks), number_of, 0.0, max((len(b.frames) for b in blocks), default=0))
