# SPDX-License-Identifier: MIT
"""Remove returns without other returns around them: snow, rain and dust.

The volume searched around a return grows with its range (Charron et al., "De-noising of Lidar Point
Clouds Corrupted by Snowfall", CRV 2018). It is a cell of direction and logarithm of range.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.geometry.types import Float, Int, Sweep

_CELL_RAD, _OF_POINTS = np.deg2rad(2.0), 120_000  # some 50 rays of a sweep of so many points
_CELL_DEPTH = 0.08  # of the range
_LEAST = 1000  # least number of returns of a tested sweep
_FEW = 5  # greatest number of returns in the cell of a lone return
_MANY = 0.007  # returns alone in a cell; real sweeps in good weather had up to 0.004


def without_lone(sweep: Sweep) -> Sweep:
    """Remove lone returns, counting ``num_lone``, if their number suggests snow, rain or dust."""
    if len(sweep) < _LEAST:
        return sweep
    coordinates, max_alone = _places(sweep), _MANY * len(sweep)
    num = _count_in_cells(coordinates)
    if np.count_nonzero(num == 1) <= max_alone:
        return sweep
    # The larger count of two grids, half a cell apart: a surface may lie on a cell border.
    num = np.maximum(num, _count_in_cells(coordinates + [[0.0], [0.5], [0.5], [0.5]]))
    lone = num <= _FEW
    is_noise = 2 * np.count_nonzero(lone) > len(sweep)
    if np.count_nonzero(num == 1) <= max_alone or is_noise:
        return sweep
    return replace(sweep.select(~lone), num_lone=int(lone.sum()))


def _places(sweep: Sweep) -> Float:
    """Return the (4,N) scanner, azimuth, elevation and log range of the returns, in cells."""
    origins_m, lidar = sweep.scanner_origins, sweep.lidar
    points = sweep.points if origins_m is None else sweep.points - origins_m[lidar]
    x, y, z = np.ascontiguousarray(points.T)
    range_m = np.sqrt(x * x + y * y + z * z)
    num = np.bincount(lidar)
    per_rad = np.sqrt(num / _OF_POINTS) / _CELL_RAD
    elevation_rad = np.arcsin(np.clip(z / np.maximum(range_m, 1e-9), -1, 1))
    depth = np.log(np.maximum(range_m, 1e-3)) / _CELL_DEPTH
    scale = per_rad[lidar] if len(num) > 1 else per_rad[0]
    return np.stack([lidar, np.arctan2(y, x) * scale, elevation_rad * scale, depth])


def _count_in_cells(coordinates: Float) -> Int:
    """Return the (N,) number of returns in each return's cell, from `_places` (4,N)."""
    cell = np.floor(coordinates).astype(np.int64)
    cell -= cell.min(axis=1, keepdims=True)
    flat = np.ravel_multi_index(tuple(cell), tuple(cell.max(axis=1) + 1))
    num: Int = np.bincount(flat)[flat]
    return num
