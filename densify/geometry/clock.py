# SPDX-License-Identifier: MIT
"""Find sweeps that are near each other in time, and when a spinning scanner fired within one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.geometry.types import Float, Int, Stretch

_BATCH_S = 0.1  # time of a sweep at the usual rate


@dataclass(frozen=True, eq=False)
class Clock:
    """Reference times of W sweeps, at any rate, with gaps. Methods take indices 0 to W - 1."""

    time_ns: Int  # (W,) int64, ascending

    @staticmethod
    def of(stretch: Stretch) -> Clock:
        """Return the clock of a stretch of sweeps; time 0 is its first sweep's reference time."""
        stamps_ns = [registered.sweep.stamp_ns for registered in stretch.sweeps]
        stamp_ns = np.array(stamps_ns, np.int64)
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
        reach_ns = reach_s * 1e9 + 0.5 * self.period_ns
        return bool(abs(self.time_ns[i] - self.time_ns[j]) <= reach_ns)

    def num_in(self, duration_s: float) -> int:
        """Return the number of sweep periods in a duration, rounded, at least 1."""
        return max(1, round(duration_s * 1e9 / self.period_ns))

    def batches(self) -> tuple[tuple[int, ...], ...]:
        """Return the sweeps' indices in groups of 0.1 s; a slower scanner has one sweep in each."""
        groups: list[list[int]] = []
        for i, time_ns in enumerate(self.time_ns.tolist()):
            since_first_ns = time_ns - self.time_ns[groups[-1][0]] if groups else np.inf
            # The middle of the sweep must lie within the batch.
            if since_first_ns + 0.5 * self.period_ns < _BATCH_S * 1e9:
                groups[-1].append(i)
            else:
                groups.append([i])
        return tuple(map(tuple, groups))

    def at(self, i: int, later_s: float) -> int | None:
        """Return the index of the sweep nearest to ``later_s`` after sweep i; None at the end."""
        candidates = range(i + 1, len(self.time_ns)) if later_s > 0 else range(i - 1, -1, -1)
        wanted_ns = self.time_ns[i] + later_s * 1e9
        return min(candidates, key=lambda j: abs(self.time_ns[j] - wanted_ns), default=None)

    def nearest(self, j: int, among: Iterable[int]) -> int:
        """Return the index in ``among`` that is nearest in time to sweep j, of two the earlier."""
        return min(among, key=lambda k: (abs(self.time_ns[k] - self.time_ns[j]), k))

    def from_end_s(self, i: int) -> float:
        """Return the seconds from sweep i to the first or the last sweep, whichever is nearer."""
        from_end_ns = min(self.time_ns[i] - self.time_ns[0], self.time_ns[-1] - self.time_ns[i])
        return float(from_end_ns) / 1e9


def share_of_turn(points: Float, middle_rad: float = 0.0, clockwise: bool = True) -> Float:
    """Return the (N,) shares of a turn, -0.5 to 0.5, from facing ``middle_rad`` to each firing.

    Args:
        points: (N,3) points relative to the scanner, as fired, with z along its spin axis.
        middle_rad: Azimuth that the scanner faces in the middle of a sweep, anticlockwise from x.
        clockwise: True if the scanner turns clockwise, seen from above.
    """
    azimuth_rad = np.arctan2(points[:, 1], points[:, 0])
    share = (middle_rad - azimuth_rad) / (2 * np.pi)
    share = share if clockwise else -share
    return np.asarray(share - np.rint(share), np.float64)
