# SPDX-License-Identifier: MIT
"""Poses of sweeps beyond a window, one after another and in one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float, Int, RegisteredSweep, Sweep
from densify.registration.alignment import Surface, SurfaceMap, subsample
from densify.registration.deskew import placed

_MATCH_M = 2.0
_KNOWN_NS = 550_000_000  # the sweeps of the window within it make the map to begin with
_LONGEST_GAP_S = 0.4  # between two sweeps of the chain
_TOGETHER = 6  # sweeps that are chosen at the same speed
_MAX_ACCELERATION_M_S2, _POSE_NOISE_M = 30.0, 0.5


def follow(
    known: Sequence[RegisteredSweep],
    frames: Sequence[int],
    stamp_ns: Int,
    read: Callable[[int], Sweep],
    prepare: Callable[[Sequence[int]], None],
    reach_m: float,
    step_m: float,
    settings: RegisterSettings,
) -> Iterator[tuple[Sweep, Float, Float, Float]]:
    """Raw sweeps along the drive, ``T_world_lidar`` (4,4) in the world of those known, and the
    (6,) twists per second before and after its reference time, by which it is to be deskewed.

    known: registered sweeps, the nearest to the others last. frames, stamp_ns: the others,
    ascending or descending in time, beginning beside the last known one. read: a raw sweep.
    prepare: called with frames that are read next. reach_m: of travel. step_m: about from one sweep
    to the next; those between are not read.

    Every sweep is laid on a map of Gaussian voxels made of the sweeps before it, from where it
    would be at constant velocity. The chain ends where a sweep cannot be read, is too sparse, does
    not lie on the map or moves as no vehicle does.
    """
    backwards = len(frames) > 0 and int(stamp_ns[0]) < known[-1].sweep.stamp_ns
    end, travel_m, row = _End(known, backwards, settings), 0.0, 0
    while travel_m < reach_m and row < len(frames):
        rows = _next_rows(stamp_ns, row, end.stamp_ns, step_m, end.speed_m_s)
        prepare([frames[r] for r in rows])
        for r in rows:
            try:
                sweep = read(frames[r])
            except InputError:
                return
            before_ns = end.stamp_ns
            if not end.moved_to(sweep):
                return
            travel_m += end.speed_m_s * abs(end.stamp_ns - before_ns) * 1e-9
            yield sweep, end.T_world_lidar, end.twist, end.twist
            if travel_m >= reach_m:
                return
        row = rows[-1] + 1


class _End:
    """The end of the chain: the map of all sweeps so far, and place, time and twist of the last."""

    def __init__(
        self, known: Sequence[RegisteredSweep], backwards: bool, settings: RegisterSettings
    ) -> None:
        self._settings, self._map, last = settings, SurfaceMap(), known[-1]
        for s in (s for s in known if abs(s.sweep.stamp_ns - last.sweep.stamp_ns) <= _KNOWN_NS):
            self._map.insert(Surface.of(subsample(s.sweep).points), s.T_world_lidar)
        self.T_world_lidar, self.stamp_ns = last.T_world_lidar, last.sweep.stamp_ns
        self.twist = last.twist_before if backwards else last.twist_after

    @property
    def speed_m_s(self) -> float:
        return float(np.linalg.norm(self.twist[3:]))

    def moved_to(self, sweep: Sweep) -> bool:
        """Lay the next sweep on the map; False where it cannot be."""
        settings = self._settings
        if len(sweep) < settings.min_num_points:
            return False
        step_s = (sweep.stamp_ns - self.stamp_ns) * 1e-9
        straight = placed(subsample(sweep), self.T_world_lidar, self.twist, self.twist).sweep
        surface = Surface.of(straight.points)
        guess = self.T_world_lidar @ poses.exp(self.twist * step_s)
        found = self._map.lay(surface, guess, _MATCH_M)
        twist = poses.log(poses.inverse(self.T_world_lidar) @ found.T_target_source) / step_s
        if found.overlap < settings.min_overlap:
            return False
        if not _plausible(self.twist, twist, step_s, settings):
            return False
        self.T_world_lidar, self.stamp_ns = found.T_target_source, sweep.stamp_ns
        self.twist = twist
        self._map.insert(surface, self.T_world_lidar)
        return True


def _next_rows(stamp_ns: Int, row: int, last_ns: int, step_m: float, speed_m_s: float) -> list[int]:
    """The next few sweeps, about ``step_m`` apart at this speed."""
    gap_ns = 1e9 * min(_LONGEST_GAP_S, step_m / max(speed_m_s, 1e-3))
    rows: list[int] = []
    for r in range(row, len(stamp_ns)):
        # One more sweep would be nearer to the gap wanted than this one.
        beyond = abs(int(stamp_ns[min(r + 1, len(stamp_ns) - 1)]) - last_ns)
        if (abs(int(stamp_ns[r]) - last_ns) + beyond) / 2 >= gap_ns:
            rows.append(r)
            last_ns = int(stamp_ns[r])
        if len(rows) == _TOGETHER:
            break
    return rows or [len(stamp_ns) - 1]


def _plausible(before: Float, after: Float, step_s: float, settings: RegisterSettings) -> bool:
    slack_m_s = _POSE_NOISE_M / abs(step_s)
    change_m_s = float(np.linalg.norm(after[3:] - before[3:]))
    return bool(
        np.isfinite(after).all()
        and np.linalg.norm(after[3:]) <= settings.max_speed_m_s + slack_m_s
        and change_m_s <= _MAX_ACCELERATION_M_S2 * abs(step_s) + slack_m_s
    )
