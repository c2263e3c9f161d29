# SPDX-License-Identifier: MIT
"""Find the directions in which sweeps lack returns: lost packets and blind sectors.

Ground or obstacles surround a vehicle: a degree of azimuth without a return was not measured.
"""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Bool, Float, Int, Sweep

LOST_DEG = 2.0
"""Width without returns from which a sweep is reported, a packet of a fast scanner."""
_NUM_BINS = 360
_FEW = 0.2  # of the mean number of returns of a bin; with fewer a bin may be empty by chance
_BLIND_DEG = (3, 90)  # wider gaps are the limits of a scanner's field of view


def by_azimuth(sweep: Sweep) -> Int:
    """Return the (360,) number of returns of a raw sweep in each degree of azimuth from -180."""
    edges_rad = np.linspace(-np.pi, np.pi, _NUM_BINS + 1)
    return np.histogram(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]), edges_rad)[0]


def lost_deg(returns: Int) -> Float:
    """Return the (n,) degrees of azimuth that each sweep lacks and half of the sweeps measured.

    A degree counts as measured if a quarter of the sweeps have returns in it, not just single ones.
    ``returns`` are the (n,360) numbers of `by_azimuth` of each sweep.
    """
    usual = np.quantile(returns, 0.75, axis=0)
    measured = usual > _FEW * usual.mean()
    lost = (returns == 0) & measured
    width_deg: Float = lost.sum(axis=1) * (360.0 / _NUM_BINS)
    return width_deg


def blind_sector(returns: Int) -> tuple[int, int] | None:
    """Return the first and last azimuth (deg, counterclockwise from x) that no sweep measured.

    It is the widest gap of 3 to 90 degrees, else None: wider gaps limit the scanner's field of
    view.
    """
    empty = ~returns.any(axis=0)
    if empty.all() or not empty.any():
        return None
    start = int(np.flatnonzero(~empty)[0])  # a direction with returns, so that no gap wraps round
    first, last = _runs(np.roll(empty, -start))
    width = last - first
    width[width > _BLIND_DEG[1]] = 0
    widest = int(np.argmax(width))
    if width[widest] < _BLIND_DEG[0]:
        return None
    begin = int(first[widest] + start) % _NUM_BINS - 180
    return begin, begin + int(width[widest])


def _runs(true: Bool) -> tuple[Int, Int]:
    """Return the first index of each run of True, and the index behind its last."""
    change = np.diff(np.concatenate([[False], true, [False]]).astype(np.int8))
    return np.flatnonzero(change > 0), np.flatnonzero(change < 0)
