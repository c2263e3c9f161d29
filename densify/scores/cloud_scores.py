# SPDX-License-Identifier: MIT
"""Score an accumulated cloud by its ghosts, without ground truth; undefined numbers are None."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.free_space.range_image import RangeImage
from densify.geometry.types import Bool, Cloud
from densify.scores.depth_metrics import mean_or_none, shares_by_motion

_GHOST_MARGIN_M, _GHOST_MARGIN_FRACTION, _MIN_FILLED = 0.5, 0.02, 6


def ghosts(cloud: Cloud, key_image: RangeImage, key: int) -> tuple[Bool, Bool]:
    """Return (M,) True for ghosts, and (M,) True for points that the key sweep cannot judge.

    At a ghost's position, all returns of the key sweep in its cell and the eight around it, at
    least six, are farther by more than max(0.5 m, 2 % of its range). Dark paint and glass hide
    ghosts. Points of the key sweep and of sweeps beyond the window are False in both masks.
    """
    ghost, unjudged = np.zeros((2, len(cloud)), bool)
    rows = np.flatnonzero(_others(cloud, key))
    margins_m = (_GHOST_MARGIN_M, _GHOST_MARGIN_FRACTION)
    beyond = key_image.count_beyond(
        cloud.points[rows], margins_m, _MIN_FILLED, cloud.velocity_m_s[rows]
    )
    ghost[rows] = (beyond >= _MIN_FILLED).any(axis=0)
    unjudged[rows] = (beyond == 0).all(axis=0)
    return ghost, unjudged


def ghost_rate(cloud: Cloud, key_image: RangeImage, key: int) -> float | None:
    """Return the share of `ghosts` among the window's points of other sweeps, None without any."""
    return mean_or_none(ghosts(cloud, key_image, key)[0][_others(cloud, key)])


def ghost_scores(cloud: Cloud, key_image: RangeImage, key: int) -> dict[str, Any]:
    """Return the shares of `ghosts` among the ``num_points`` points of the window's other sweeps.

    They are for ``all``, ``moving`` and ``static`` points, by frames (``by_distance["3"]``) and
    seconds (``by_seconds["0.30"]``) from the key sweep. ``unjudged`` has the shares that it cannot
    judge.
    """
    rows = np.flatnonzero(_others(cloud, key))
    ghost, unjudged = (mask[rows] for mask in ghosts(cloud, key_image, key))
    moving = cloud.moving[rows]
    distance = np.abs(cloud.frame[rows] - key)
    hundredths = np.rint(np.abs(cloud.since_key_ns[rows]) / 1e7).astype(np.int64)
    return {
        "num_points": len(rows),
        **shares_by_motion(ghost, moving),
        "unjudged": shares_by_motion(unjudged, moving),
        "by_distance": {str(steps): rate for steps, rate in _rates(ghost, distance).items()},
        "by_seconds": {f"{h / 100:.2f}": rate for h, rate in _rates(ghost, hundredths).items()},
    }


def _others(cloud: Cloud, key: int) -> Bool:
    """Return (M,) True for points of the window that are not from the key sweep."""
    return (cloud.frame != key) & ~cloud.far


def _rates(ghost: Bool, group: NDArray[np.integer]) -> dict[int, float]:
    """Return the share of ghosts in each group number (N,) that has points, ascending."""
    num, num_ghosts = np.bincount(group), np.bincount(group, ghost)
    return {g: float(num_ghosts[g] / num[g]) for g in np.flatnonzero(num).tolist()}
