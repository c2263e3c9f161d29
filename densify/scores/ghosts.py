# SPDX-License-Identifier: MIT
"""How good an accumulated cloud is without any truth: its ghosts. Depth against truth is scored in
`densify.scores.depth_metrics`, flow in `densify.scores.flow_metrics`.

Every ``*_scores`` dictionary holds plain numbers ready for JSON; what is undefined (a rate over no
points) is None, never NaN.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.free_space.range_image import RangeImage
from densify.geometry.types import Bool, Cloud

_GHOST_MARGIN_M = 0.5
_GHOST_MARGIN_FRACTION = 0.02


def ghosts(cloud: Cloud, key_image: RangeImage, key: int) -> Bool:
    """(M,) bool: points of other sweeps of the window standing where the key sweep saw through.

    A point is a ghost when it lies clearly in front of what the key sweep measured in its direction
    and in all 8 neighbouring directions, by more than max(0.5 m, 2 % of its range); directions
    without a return say nothing, but six of the nine must have one.
    """
    ghost = np.zeros(len(cloud), bool)
    other = np.flatnonzero(_others(cloud, key))
    ghost[other] = key_image.sees_through(
        cloud.points.take(other, axis=0),
        _GHOST_MARGIN_M,
        _GHOST_MARGIN_FRACTION,
        min_filled=6,
        velocity_m_s=cloud.velocity_m_s.take(other, axis=0),
    )
    return ghost


def ghost_rate(cloud: Cloud, key_image: RangeImage, key: int) -> float | None:
    """Fraction of the accumulated points that are `ghosts`, over all of the window's that are not
    from the key sweep."""
    return _mean(ghosts(cloud, key_image, key)[_others(cloud, key)])


def ghost_scores(cloud: Cloud, key_image: RangeImage, key: int) -> dict[str, Any]:
    """Needs no truth: ``num_points`` of other sweeps of the window and the `ghost_rate` of ``all``
    of them, of those the flow calls ``moving`` and of the ``static`` rest, by distance in frames
    from the key (``by_distance["3"]``: frames key-3 and key+3), and by time from the key, to 10 ms
    (``by_seconds["0.30"]``)."""
    other = np.flatnonzero(_others(cloud, key))
    ghost, moving = ghosts(cloud, key_image, key)[other], cloud.moving[other]
    distance = np.abs(cloud.frame[other] - key)
    hundredths = np.rint(np.abs(cloud.since_key_ns[other]) / 1e7).astype(np.int64)
    return {
        "num_points": len(other),
        "all": _mean(ghost),
        "moving": _mean(ghost[moving]),
        "static": _mean(ghost[~moving]),
        "by_distance": {str(steps): rate for steps, rate in _rates(ghost, distance).items()},
        "by_seconds": {f"{h / 100:.2f}": rate for h, rate in _rates(ghost, hundredths).items()},
    }


def _others(cloud: Cloud, key: int) -> Bool:
    """(M,) the points of the window that are not from the key sweep."""
    return (cloud.frame != key) & ~cloud.far


def _rates(ghost: Bool, group: NDArray[np.integer]) -> dict[int, float]:
    """The share of ghosts in every group (N,) that has points, ascending."""
    num, num_ghosts = np.bincount(group), np.bincount(group, ghost)
    return {g: float(num_ghosts[g] / num[g]) for g in np.flatnonzero(num).tolist()}


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None
