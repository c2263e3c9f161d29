# SPDX-License-Identifier: MIT
"""Answer which sweeps are near each other in time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.geometry.types import Float, Int, Stretch

_BATCH_S = 0.1


@dataclass(frozen=True, eq=False)
class Clock:
    """Reference times of W sweeps, at any rate and with gaps.

    Sweeps are addressed by their index.

    Attributes:
        time_ns: (W,) int64, ascending.
    """

    time_ns: Int

    @staticmethod
    def of(stretch: Stretch) -> Clock:
        """Return the clock of a stretch; times count from its first sweep."""
        stamp_ns = np.array([s.sweep.stamp_ns for s in stretch.sweeps], np.int64)
        return Clock(stamp_ns - stamp_ns[:1])

    @cached_property
    def time_s(self) -> Float:
        """The (W,) `time_ns` in seconds."""
        return np.asarray(self.time_ns * 1e-9, np.float64)

    @cached_property
    def period_ns(self) -> float:
        """The median time between two sweeps, infinite for fewer than two."""
        return float(np.median(np.diff(self.time_ns))) if len(self.time_ns) > 1 else np.inf

    def near(self, i: int, j: int, reach_s: float) -> bool:
        """Return True if two sweeps are at most ``reach_s`` and half a period apart."""
        return bool(abs(self.time_ns[i] - self.time_ns[j]) <= self._slack_ns(reach_s))

    def num_in(self, duration_s: float) -> int:
        """Return the number of periods in the duration, at least 1."""
        return max(1, round(duration_s * 1e9 / self.period_ns))

    def batches(self) -> tuple[tuple[int, ...], ...]:
        """Return groups of consecutive sweeps within less than 0.1 s, to the nearest sweep.

        A faster scanner has fewer points in a sweep, and objects move less between sweeps. A batch
        holds as much evidence as one sweep at 10 Hz, where each batch is one sweep.
        """
        groups: list[list[int]] = []
        for j, time_ns in enumerate(self.time_ns.tolist()):
            since_ns = time_ns - self.time_ns[groups[-1][0]] if groups else np.inf
            if since_ns + 0.5 * self.period_ns < _BATCH_S * 1e9:
                groups[-1].append(j)
            else:
                groups.append([j])
        return tuple(map(tuple, groups))

    def around(self, i: int, reach_s: float, most: int) -> list[int]:
        """Return the other sweeps within ``reach_s`` and half a period of sweep i, ascending.

        Args:
            most: Number of sweeps on each side. A larger number is thinned out evenly.
        """
        within_ns = self._slack_ns(reach_s)
        first = int(np.searchsorted(self.time_ns, self.time_ns[i] - within_ns))
        end = int(np.searchsorted(self.time_ns, self.time_ns[i] + within_ns, side="right"))
        before, after = range(i - 1, first - 1, -1), range(i + 1, end)
        return sorted(_thinned(before, most) + _thinned(after, most))

    def at(self, i: int, later_s: float) -> int | None:
        """Return the sweep nearest to ``later_s`` after sweep i, or before it if negative.

        Only sweeps on that side count. Without any, return None.
        """
        side = range(i + 1, len(self.time_ns)) if later_s > 0 else range(i - 1, -1, -1)
        wanted_ns = self.time_ns[i] + later_s * 1e9
        return min(side, key=lambda j: abs(self.time_ns[j] - wanted_ns), default=None)

    def nearest(self, j: int, among: Iterable[int]) -> int:
        """Return the one of these sweeps that is nearest to sweep j, the earlier of two."""
        return min(among, key=lambda k: (abs(self.time_ns[k] - self.time_ns[j]), k))

    def from_end_s(self, i: int) -> float:
        """Return the time to the nearer end."""
        from_end_ns = min(self.time_ns[i] - self.time_ns[0], self.time_ns[-1] - self.time_ns[i])
        return float(from_end_ns) / 1e9

    def _slack_ns(self, reach_s: float) -> float:
        return reach_s * 1e9 + 0.5 * self.period_ns


def num_in_batch(period_s: float) -> int:
    """Return the number of sweeps in a batch, see `Clock.batches`."""
    return max(1, int(np.ceil(_BATCH_S / period_s + 0.5)) - 1)


def _thinned(side: range, most: int) -> list[int]:
    if len(side) <= most:
        return list(side)
    return [side[k] for k in np.rint(np.linspace(0, len(side) - 1, most)).astype(int)]
