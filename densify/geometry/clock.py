# SPDX-License-Identifier: MIT
"""When sweeps were taken, and which of them are near each other in time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.geometry.types import Float, Int, Stretch

LOOK_S = 0.1
"""Sweeps closer in time are taken together: in each of them few points tell little of motion, and
the rings on the ground, that go with the scanner, hide its own."""


@dataclass(frozen=True, eq=False)
class Clock:
    """The reference times of sweeps, which are asked for by index.

    time_ns: (W,) int64, ascending, at any rate and with holes.
    """

    time_ns: Int

    @staticmethod
    def of(stretch: Stretch) -> Clock:
        """The clock of a stretch, its times counted from the first sweep."""
        stamp_ns = np.array([s.sweep.stamp_ns for s in stretch.sweeps], np.int64)
        return Clock(stamp_ns - stamp_ns[:1])

    @cached_property
    def time_s(self) -> Float:
        """(W,) `time_ns` in seconds."""
        return np.asarray(self.time_ns * 1e-9, np.float64)

    @cached_property
    def period_ns(self) -> float:
        """The usual time between two sweeps; infinite for fewer."""
        return float(np.median(np.diff(self.time_ns))) if len(self.time_ns) > 1 else np.inf

    def near(self, i: int, j: int, reach_s: float) -> bool:
        """Whether two sweeps are at most ``reach_s`` apart, to the nearest sweep: half a period
        more is allowed."""
        return bool(abs(self.time_ns[i] - self.time_ns[j]) <= self._slack_ns(reach_s))

    def num_in(self, duration_s: float) -> int:
        """How many sweeps usually follow each other in that time, at least 1."""
        return max(1, round(duration_s * 1e9 / self.period_ns))

    def looks(self) -> tuple[tuple[int, ...], ...]:
        """The sweeps, those that follow each other within less than `LOOK_S` (to the nearest sweep)
        together: at 10 Hz and below each is a look of its own."""
        groups: list[list[int]] = []
        for j, time_ns in enumerate(self.time_ns.tolist()):
            since_ns = time_ns - self.time_ns[groups[-1][0]] if groups else np.inf
            if since_ns + 0.5 * self.period_ns < LOOK_S * 1e9:
                groups[-1].append(j)
            else:
                groups.append([j])
        return tuple(map(tuple, groups))

    def around(self, i: int, reach_s: float, most: int) -> list[int]:
        """The sweeps before and after sweep i, to the nearest ``reach_s`` away from it, in order;
        where there are more than ``most`` on one side, so many of them, evenly."""
        within_ns = self._slack_ns(reach_s)
        first = int(np.searchsorted(self.time_ns, self.time_ns[i] - within_ns))
        end = int(np.searchsorted(self.time_ns, self.time_ns[i] + within_ns, side="right"))
        before, after = range(i - 1, first - 1, -1), range(i + 1, end)
        return sorted(_thinned(before, most) + _thinned(after, most))

    def at(self, i: int, later_s: float) -> int | None:
        """The sweep before (after) sweep i whose time is nearest to ``later_s`` before (after) it;
        None at the end of the stretch."""
        side = range(i + 1, len(self.time_ns)) if later_s > 0 else range(i - 1, -1, -1)
        asked_ns = self.time_ns[i] + later_s * 1e9
        return min(side, key=lambda j: abs(self.time_ns[j] - asked_ns), default=None)

    def nearest(self, j: int, among: Iterable[int]) -> int:
        """The sweep among these that is nearest to sweep j in time, the earlier of two."""
        return min(among, key=lambda k: (abs(self.time_ns[k] - self.time_ns[j]), k))

    def from_end_s(self, i: int) -> float:
        """The time to the nearer end."""
        from_end_ns = min(self.time_ns[i] - self.time_ns[0], self.time_ns[-1] - self.time_ns[i])
        return float(from_end_ns) / 1e9

    def _slack_ns(self, reach_s: float) -> float:
        return reach_s * 1e9 + 0.5 * self.period_ns


def num_in_look(period_s: float) -> int:
    """How many sweeps so far apart are one look, see `Clock.looks`."""
    return max(1, int(np.ceil(LOOK_S / period_s + 0.5)) - 1)


def _thinned(side: range, most: int) -> list[int]:
    if len(side) <= most:
        return list(side)
    return [side[k] for k in np.rint(np.linspace(0, len(side) - 1, most)).astype(int)]
