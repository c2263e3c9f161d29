# SPDX-License-Identifier: MIT
"""Remove returns without other returns around them: snow, rain and dust.

The volume searched around a return grows with its range (Charron et al., "De-noising of Lidar Point
Clouds Corrupted by Snowfall", CRV 2018). It is a cell of direction and logarithm of range.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.geometry.types import Int, Sweep

_CELL_RAD, _OF_POINTS = np.deg2rad(2.0), 120_000  # some 50 rays of a sweep of so many points
_CELL_DEPTH = 0.08  # of the range
_LEAST = 1000  # least number of returns of a tested sweep
_FEW = 5  # greatest number of returns in the cell of a lone return
_MANY = 0.007  # returns alone in a cell; real sweeps in good weather had up to 0.004


def without_lone(sweep: Sweep) -> Sweep:
    """Remove lone returns, counting ``num_lone``, if their number suggests snow, rain or dust."""
    if len(sweep) < _LEAST:
        return sweep
    num = count_around(sweep)
    lone = num <= _FEW
    is_noise = 2 * np.count_nonzero(lone) > len(sweep)
    if np.count_nonzero(num == 1) <= _MANY * len(sweep) or is_noise:
        return sweep
    return replace(sweep.select(~lone), num_lone=int(lone.sum()))


def count_around(sweep: Sweep) -> Int:
    """Return the (N,) number of returns around each return, itself included."""
    # The larger count of two grids, half a cell apart: a surface may lie on a cell border.
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
