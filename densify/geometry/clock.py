# SPDX-License-Identifier: MIT
"""Find sweeps that are near each other in time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.geometry.types import Float, Int, Stretch

_BATCH_S = 0.1


@dataclass(frozen=True, eq=False)
class Clock:
    """Reference times of W sweeps, at any rate, with gaps; methods use sweep indices 0 to W - 1."""

    time_ns: Int  # (W,) int64, ascending

    @staticmethod
    def of(stretch: Stretch) -> Clock:
        """Build the clock of a stretch of sweeps; time 0 is its first sweep's reference time."""
        stamp_ns = np.array([s.sweep.stamp_ns for s in stretch.sweeps], np.int64)
        return Clock(stamp_ns - stamp_ns[:1])

    @cached_property
    def time_s(self) -> Float:
        """The (W,) reference times in seconds."""
        return np.asarray(self.time_ns * 1e-9, np.float64)

    @cached_property
    def period_ns(self) -> float:
        """The median time between consecutive sweeps, infinite for fewer than two sweeps."""
        return float(np.median(np.diff(self.time_ns))) if len(self.time_ns) > 1 else np.inf

    def near(self, i: int, j: int, reach_s: float) -> bool:
        """Return True if sweeps i and j are at most ``reach_s`` plus half a period apart."""
        return bool(abs(self.time_ns[i] - self.time_ns[j]) <= self._slack_ns(reach_s))

    def num_in(self, duration_s: float) -> int:
        """Return the number of sweep periods in a duration, rounded, at least 1."""
        return max(1, round(duration_s * 1e9 / self.period_ns))

    def batches(self) -> tuple[tuple[int, ...], ...]:
        """Return groups of consecutive sweep indices, each covering about 0.1 s.

        A faster scanner measures fewer points per sweep, and objects move less between its sweeps.
        A batch therefore has about as many points as one sweep at 10 Hz. At 10 Hz or slower each
        batch is one sweep.
        """
        groups: list[list[int]] = []
        for j, time_ns in enumerate(self.time_ns.tolist()):
            since_ns = time_ns - self.time_ns[groups[-1][0]] if groups else np.inf
            if since_ns + 0.5 * self.period_ns < _BATCH_S * 1e9:
                groups[-1].append(j)
            else:
                groups.append([j])
        return tuple(map(tuple, groups))

    def around(self, i: int, reach_s: float, max_per_side: int) -> list[int]:
        """Return the sweeps within ``reach_s`` plus half a period of sweep i, without i, ascending.

        More than ``max_per_side`` sweeps on a side are thinned out evenly.
        """
        within_ns = self._slack_ns(reach_s)
        first = int(np.searchsorted(self.time_ns, self.time_ns[i] - within_ns))
        end = int(np.searchsorted(self.time_ns, self.time_ns[i] + within_ns, side="right"))
        before, after = range(i - 1, first - 1, -1), range(i + 1, end)
        return sorted(_thinned(before, max_per_side) + _thinned(after, max_per_side))

    def at(self, i: int, later_s: float) -> int | None:
        """Return the sweep nearest to ``later_s`` after sweep i, None if no sweep is on that side.

        A negative ``later_s`` searches the sweeps before i.
        """
        side = range(i + 1, len(self.time_ns)) if later_s > 0 else range(i - 1, -1, -1)
        wanted_ns = self.time_ns[i] + later_s * 1e9
        return min(side, key=lambda j: abs(self.time_ns[j] - wanted_ns), default=None)

    def nearest(self, j: int, among: Iterable[int]) -> int:
        """Return the candidate nearest in time to sweep j, the earlier candidate of two."""
        return min(among, key=lambda k: (abs(self.time_ns[k] - self.time_ns[j]), k))

    def from_end_s(self, i: int) -> float:
        """Return the seconds from sweep i to the first or the last sweep, whichever is nearer."""
        from_end_ns = min(self.time_ns[i] - self.time_ns[0], self.time_ns[-1] - self.time_ns[i])
        return float(from_end_ns) / 1e9

    def _slack_ns(self, reach_s: float) -> float:
        return reach_s * 1e9 + 0.5 * self.period_ns


def num_in_batch(period_s: float) -> int:
    """Return the number of sweeps in one batch of `Clock.batches` at this sweep period."""
    return max(1, int(np.ceil(_BATCH_S / period_s + 0.5)) - 1)


def _thinned(side: range, max_sweeps: int) -> list[int]:
    if len(side) <= max_sweeps:
        return list(side)
    return [side[k] for k in np.rint(np.linspace(0, len(side) - 1, max_sweeps)).astype(int)]
