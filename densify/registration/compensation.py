# SPDX-License-Identifier: MIT
"""Sweeps whose motion is compensated already.

The rings of a spinning scanner are cones about its own axis only if the points are seen from where
it stood, as they were fired.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, Int, Sweep

LEAST_SHARPNESS = 4.0  # of a scanner with distinct rings
CLEARLY = 1.25  # sharper by that factor
LEAST_SPEED_M_S = 1.5  # that smears rings
COMPENSATED_M = 25.0  # nearer returns show a motion within the sweep
# KITTI's HDL-64E, whose two blocks of lasers stand apart, is sharpest from 0.2 m higher.
_HEIGHTS_M = np.linspace(-0.3, 0.3, 13)
_NEAR_M = 3.0
_NUM_POINTS = 20_000
_WINDOW_CELLS, _LEAST_SHARE = 100, 0.01
_BIN_RAD = np.deg2rad(0.02)


class Rings(NamedTuple):
    """The sharpness of the rings of a sweep.

    Attributes:
        as_stored: Of the points as they are.
        undone: With a compensation of the motion to ``moment`` undone.
        done: With the motion compensated.
        moment: Of the sweep, in words.
    """

    as_stored: float
    undone: float
    done: float
    moment: str

    @property
    def are_distinct(self) -> bool:
        """Return True if the scanner has rings that tell."""
        return max(self.as_stored, self.undone) >= LEAST_SHARPNESS

    @property
    def are_compensated(self) -> bool:
        """Return True if the motion within the sweep is compensated already."""
        return self.are_distinct and self.undone > CLEARLY * self.as_stored


def sharpness(points: Float, origin_m: Float, bins: int = 1) -> float:
    """Return how much the elevations at an origin are concentrated in rings, 1 for an even spread.

    In each window of elevation it is the chance that two returns share a cell of ``bins`` times
    0.02 degrees, relative to an even spread. The result is the mean over the windows, each counted
    alike, because from a place on the ground all of a flat ground is in one of them.
    """
    x, y, z = (points - origin_m).T
    elevation = np.arctan2(z, np.hypot(x, y))
    cell = ((elevation + 0.5 * np.pi) / (bins * _BIN_RAD)).astype(np.int64)
    width = max(8, _WINDOW_CELLS // bins)
    length = -(-int(np.pi / (bins * _BIN_RAD) + 1) // width)
    count = np.bincount(cell, minlength=length * width).astype(np.float64).reshape(length, width)
    held = count.sum(axis=1)
    enough = held > _LEAST_SHARE * len(points)
    if not enough.any():
        return 1.0
    return float(np.median((count[enough] ** 2).sum(axis=1) / held[enough] ** 2) * width)


def rings_by_motion(
    points: Float, offset_s: Float, twist: Float, R: Float, origins_m: Sequence[Float]
) -> Rings:
    """Return the sharpness of the rings of a sweep, seen from the best of the origins.

    Args:
        points: (N,3) raw, metres, lidar frame.
        offset_s: (N,) firing times since the stamp.
        twist: (6,) of the lidar, per second.
        R: (3,3) into the axes of the scanner.
        origins_m: Possible positions of the scanner, (3,) in its axes.
    """

    def sharpest(moved: Float) -> float:
        return max(sharpness(moved @ R.T, origin_m) for origin_m in origins_m)

    def carried(since_s: Float) -> Float:
        return poses.transform_each(since_s[:, None] * twist, points)

    # The moment they were compensated to may be any of the sweep's.
    moments_s = {
        "its stamp": 0.0,
        "its first point": float(offset_s.min()),
        "its last point": float(offset_s.max()),
    }
    undone_to = {name: sharpest(carried(at_s - offset_s)) for name, at_s in moments_s.items()}
    moment = max(undone_to, key=lambda name: undone_to[name])
    return Rings(sharpest(points), undone_to[moment], sharpest(carried(offset_s)), moment)


def sample_rows(sweep: Sweep, far_m: float) -> Int:
    """Return the rows of at most 20,000 returns of a sweep from 3 m to ``far_m`` away."""
    range_m = np.linalg.norm(sweep.points, axis=1)
    rows = np.flatnonzero((range_m > _NEAR_M) & (range_m < far_m))
    return rows[:: len(rows) // _NUM_POINTS + 1]


def turning_s(points: Float, period_s: float) -> Float:
    """Return (N,) firing times of a scanner that turns clockwise and faces forward at the stamp."""
    turn: Float = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    return turn * period_s


def find_compensated(sweep: Sweep, twist: Float, period_s: float) -> Rings | None:
    """Return the rings of a raw sweep whose motion is compensated already; else None.

    Args:
        twist: (6,) of the lidar, per second.
        period_s: Duration of a sweep without times of points.
    """
    if np.linalg.norm(twist[3:]) < LEAST_SPEED_M_S:
        return None
    for lidar in np.unique(sweep.lidar).tolist():
        mine = sweep.select(sweep.lidar == lidar)
        near, R = sample_rows(mine, COMPENSATED_M), mine.axes(lidar)
        if not len(near):
            continue
        if mine.offset_ns is None:
            offset_s = turning_s(mine.points[near], period_s)
        else:
            offset_s = np.asarray(mine.offset_ns[near] * 1e-9, np.float64)
        origins_m = [R @ mine.origin_m(lidar) + [0.0, 0.0, height_m] for height_m in _HEIGHTS_M]
        rings = rings_by_motion(mine.points[near], offset_s, twist, R, origins_m)
        if rings.are_compensated:
            return rings
    return None
