# SPDX-License-Identifier: MIT
"""The blocks of sweeps that a recording is cut into: keys that share registration and motion."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from densify.readers.timeline import Timeline, check_key, check_window

BLOCK_S = 2.0
AROUND_S = 1.0  # what moves is looked for at least this far around a block of a whole recording


@dataclass(frozen=True)
class Cut:
    """Blocks, ascending in time, which may overlap.

    blocks: the frames of each: the windows of its keys, and what is between and around them.
    number_of: key -> its block.
    """

    blocks: tuple[tuple[int, ...], ...]
    number_of: Mapping[int, int]

    def number_near(self, frame: int) -> int:
        """Return the block of a frame, or of the last key before it."""
        keys = sorted(self.number_of)
        return self.number_of[keys[max(0, bisect_right(keys, frame) - 1)]]

    def keys_of(self, number: int) -> list[int]:
        """Return the keys of a block."""
        return [key for key, n in self.number_of.items() if n == number]

    @staticmethod
    def whole(timeline: Timeline, window: int) -> Cut:
        """Cut all sweeps, as keys, into blocks of `BLOCK_S`, counted from time 0.

        The same sweeps make the same maps, whatever keys are asked for.
        """
        groups: dict[int, list[int]] = {}
        for frame in timeline.frames:
            groups.setdefault(timeline.stamp_of(frame) // round(BLOCK_S * 1e9), []).append(frame)
        window = max(_checked(window), timeline.num_in(AROUND_S))
        return _cut(timeline, window, [groups[at] for at in sorted(groups)])

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
        window = _checked(window) + round(beyond_s * 1e9 / timeline.period_ns)
        groups: list[list[int]] = []
        for key in sorted(set(keys)):
            first = timeline.row[timeline.window(key, window).frames[0]]
            if (
                groups
                and first <= timeline.row[timeline.window(groups[-1][-1], window).frames[-1]]
                and timeline.stamp_of(key) - timeline.stamp_of(groups[-1][0]) < BLOCK_S * 1e9
            ):
                groups[-1].append(key)
            else:
                groups.append([key])
        return _cut(timeline, window, groups)


def _checked(window: int) -> int:
    check_window(window)
    return window


def _cut(timeline: Timeline, window: int, groups: Sequence[Sequence[int]]) -> Cut:
    blocks = []
    for keys in groups:
        first = timeline.window(keys[0], window).frames[0]
        last = timeline.window(keys[-1], window).frames[-1]
        blocks.append(timeline.frames[timeline.row[first] : timeline.row[last] + 1])
    number_of = {key: number for number, keys in enumerate(groups) for key in keys}
    return Cut(tuple(blocks), number_of)
