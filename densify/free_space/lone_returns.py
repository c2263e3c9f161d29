# SPDX-License-Identifier: MIT
"""Returns without others around them: snow, rain and dust.

As in Charron et al., "De-noising of Lidar Point Clouds Corrupted by Snowfall", CRV 2018, the space
around a return grows with its range. Here it is a cell of direction and of the logarithm of range,
so that no neighbours have to be searched.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.geometry.types import Int, Sweep

_CELL_RAD, _OF_POINTS = np.deg2rad(2.0), 120_000  # some 50 rays of a sweep of so many points
_CELL_DEPTH = 0.08  # of the range
_LEAST = 1000  # returns of a sweep that tell
_FEW = 5  # returns that are no surface
_MANY = 0.007  # returns alone in a cell; real sweeps in good weather had up to 0.004


def without_lone(sweep: Sweep) -> Sweep:
    """Return the sweep without its lone returns if it has as many as in snow, rain or dust."""
    if len(sweep) < _LEAST:
        return sweep
    num = count_around(sweep)
    lone = num <= _FEW
    is_noise = 2 * np.count_nonzero(lone) > len(sweep)
    if np.count_nonzero(num == 1) <= _MANY * len(sweep) or is_noise:
        return sweep
    return replace(sweep.select(~lone), num_lone=int(lone.sum()))


def count_around(sweep: Sweep) -> Int:
    """Return (N,) the number of returns around each return, with itself.

    Two grids, half a cell apart, are looked at, because a surface may lie on the border of a cell.
    """
    around = np.zeros(len(sweep), np.int64)
    for lidar in np.unique(sweep.lidar).tolist():
        mine = sweep.lidar == lidar
        x, y, z = (sweep.points[mine] - sweep.origin_m(lidar)).T
        range_m = np.sqrt(x * x + y * y + z * z)
        cell_rad = _CELL_RAD * np.sqrt(_OF_POINTS / len(range_m))
        elevation_rad = np.arcsin(np.clip(z / np.maximum(range_m, 1e-9), -1, 1))
        depth = np.log(np.maximum(range_m, 1e-3)) / _CELL_DEPTH
        place = np.stack([np.arctan2(y, x) / cell_rad, elevation_rad / cell_rad, depth])
        num = np.zeros(len(range_m), np.int64)
        for shift in (0.0, 0.5):
            cell = np.floor(place + shift).astype(np.int64)
            cell -= cell.min(axis=1, keepdims=True)
            flat = np.ravel_multi_index(tuple(cell), tuple(cell.max(axis=1) + 1))
            num = np.maximum(num, np.bincount(flat)[flat])
        around[mine] = num
    return around
