# SPDX-License-Identifier: MIT
"""Find the directions in which sweeps lack returns: lost packets and blind sectors.

Around a vehicle there is ground or an obstacle in every direction. A degree of azimuth without a
return was therefore not measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.geometry.types import Bool, Float, Int, Sweep

LOST_DEG = 2.0
"""Lost width of a sweep that is told: a packet of a fast scanner. Complete sweeps lack none."""
_NUM_BINS = 360
_FEW = 0.2  # of the mean number of returns of a bin; with fewer a bin may be empty by chance
_BLIND_DEG = (3, 90)  # wider gaps are the limits of a scanner's field of view


def lost_deg(sweeps: Sequence[Sweep]) -> Float:
    """Return the (n,) width in degrees of azimuth that each sweep lacks and the others measured.

    A degree counts as measured if half of the sweeps have returns in it, not just single ones.
    """
    returns = _histograms(sweeps)
    usual = np.median(returns, axis=0)
    measured = usual > _FEW * usual.mean()
    lost = (returns == 0) & measured
    width_deg: Float = lost.sum(axis=1) * (360.0 / _NUM_BINS)
    return width_deg


def blind_sector(sweeps: Sequence[Sweep]) -> tuple[int, int] | None:
    """Return the first and last azimuth (deg, counterclockwise from x) that no sweep measured.

    It is the widest gap of 3 to 90 degrees, and None without one. Wider gaps are the limits of the
    scanner's field of view.
    """
    empty = ~_histograms(sweeps).any(axis=0)
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


def _histograms(sweeps: Sequence[Sweep]) -> Int:
    """Return the (n,360) number of returns of each sweep by azimuth, from -180 deg."""
    edges_rad = np.linspace(-np.pi, np.pi, _NUM_BINS + 1)
    azimuths = (np.arctan2(s.points[:, 1], s.points[:, 0]) for s in sweeps)
    return np.stack([np.histogram(azimuth, edges_rad)[0] for azimuth in azimuths])


def _runs(true: Bool) -> tuple[Int, Int]:
    """Return the first index of each run of True, and the index behind its last."""
    change = np.diff(np.concatenate([[False], true, [False]]).astype(np.int8))
    return np.flatnonzero(change > 0), np.flatnonzero(change < 0)
