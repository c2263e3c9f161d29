# SPDX-License-Identifier: MIT
"""What the directions and firing times of a scanner's returns tell of its rays: rings, steps and
gaps, and whether it turns.

Angles are seen from where the scanner stood when it fired, in radians, float32 (N,).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from densify.geometry.arrays import Float, Float32

_RING_BIN_RAD = np.deg2rad(0.02)
_MIN_PROMINENCE = 0.5
_MIN_RETURNS_PER_RING = 30
_MIN_RING_SHARE = 0.8
_NEAR_RING = 0.2  # of the gap to the next
_SECTOR_RAD = np.deg2rad(1.0)
_MAX_GAP_RAD = np.deg2rad(4.0)
_STRIP_RAD = np.deg2rad(0.5)
_LEAST_GAP_RAD = np.deg2rad(0.08)
_BAND_RAD = np.deg2rad(0.1)
_EVEN = 0.2  # of the usual gap
_COLUMN_RAD = np.deg2rad(1.0)
_MIN_PER_COLUMN = 5
_AT_ONCE = 0.03  # of a sweep's duration
_STRAIGHT = 0.02  # of a turn
_DEFAULT_BETWEEN_RAD = np.deg2rad(0.4)
_DEFAULT_ALONG_RAD = np.deg2rad(0.2)


def find_rings(elevation: Float32) -> Float | None:
    """(K,) ascending elevations of the scanner's beams; None where the returns do not lie on rings:
    several scanners taken for one, clouds already processed, scanners that have none, and lasers
    that do not share an origin (KITTI's HDL-64E, whose near returns smear).

    The peaks of a fine histogram, if they stand alone and hold nearly all returns; each is then the
    mean of the returns close to it.
    """
    of_return = ((elevation + 0.5 * np.pi) / _RING_BIN_RAD).astype(np.int64)
    returns = np.bincount(of_return, minlength=int(np.pi / _RING_BIN_RAD) + 2).astype(float)
    count = ndimage.gaussian_filter1d(returns, 1.0)
    peaks, found = signal.find_peaks(count, prominence=0)
    peaks = peaks[found["prominences"] >= _MIN_PROMINENCE * count[peaks]]
    if not 3 <= len(peaks) <= len(elevation) / _MIN_RETURNS_PER_RING:
        return None
    rings: Float = (peaks + 0.5) * _RING_BIN_RAD - 0.5 * np.pi
    nearest = np.searchsorted(0.5 * (rings[1:] + rings[:-1]), elevation)
    close = np.abs(elevation - rings[nearest]) < _NEAR_RING * np.gradient(rings)[nearest]
    if close.mean() < _MIN_RING_SHARE:
        return None
    total = np.bincount(nearest[close], elevation[close].astype(float), len(rings))
    return total / np.bincount(nearest[close], minlength=len(rings))


def step_between(azimuth: Float32, elevation: Float32) -> float:
    """Median elevation between rings, where rings are not distinct."""
    # A strip half a degree wide crosses every ring a few times: large gaps in elevation part rings.
    gap = gaps(np.floor(azimuth / _STRIP_RAD), elevation)
    between = gap[gap > max(_LEAST_GAP_RAD, 0.25 * float(np.percentile(gap, 95)))]
    return float(np.median(between)) if len(between) else _DEFAULT_BETWEEN_RAD


def step_along(azimuth: Float32, ring: NDArray[Any]) -> float:
    """Median azimuth between neighbours on a ring."""
    along = gaps(ring, azimuth)
    along = along[along > np.deg2rad(0.02)]
    return float(np.median(along)) if len(along) else _DEFAULT_ALONG_RAD


def gaps(group: NDArray[Any], angle: Float32) -> Float:
    """Between neighbouring angles of the same group; group: (N,) whole numbers."""
    apart = 4 * np.pi  # more than angles of one group can be
    found: Float = np.diff(np.sort(group * apart + angle.astype(np.float64)))
    return found[found < 2 * np.pi]


def even_step(azimuth: Float32, elevation: Float32) -> tuple[float, float]:
    """The usual azimuth between returns of about the same elevation, and which share of all follow
    at that distance: more than half of a turning scanner's, a fifth of strewn ones."""
    gap = gaps(np.floor(elevation / _BAND_RAD), azimuth)
    gap = gap[gap > 1e-4]
    if not len(gap):
        return _DEFAULT_ALONG_RAD, 0.0
    usual = float(np.median(gap))
    return usual, float(np.mean(np.abs(gap - usual) < _EVEN * usual))


def gaps_between(azimuth: Float32, elevation: Float32, least_rad: float) -> tuple[Float, Float]:
    """Gaps between returns that follow each other in elevation within a sector of 1 degree, and
    their middles; those of one ring and those over missing returns left out."""
    sector = np.floor(azimuth / _SECTOR_RAD)
    order = np.lexsort((elevation, sector))
    gap = np.diff(elevation[order].astype(float))
    middle = elevation[order][:-1] + gap / 2
    kept = (np.diff(sector[order]) == 0) & (gap > max(least_rad, 1e-4)) & (gap < _MAX_GAP_RAD)
    return gap[kept], middle[kept]


class Order(NamedTuple):
    """by_azimuth: all returns of a column are fired within a moment, or nobody knows when. turn: 1
    left (counter-clockwise from above), -1 right, 0 unknown. period_s: of a turn, None unknown."""

    by_azimuth: bool
    turn: int
    period_s: float | None


def firing_order(azimuth: Float32, offset_s: Float32) -> Order:
    """The order told by one sweep's returns and their firing times."""
    duration_s = float(np.ptp(offset_s)) if len(offset_s) else 0.0
    if duration_s == 0.0:
        return Order(True, 0, None)
    column = ((azimuth + np.pi) / _COLUMN_RAD).astype(np.int64)
    num = np.bincount(column)
    mean_s = np.bincount(column, offset_s) / np.maximum(num, 1)
    spread_s = np.sqrt(np.bincount(column, (offset_s - mean_s[column]) ** 2) / np.maximum(num, 1))
    seen = num >= _MIN_PER_COLUMN
    at_once = np.flatnonzero(seen & (spread_s < _AT_ONCE * duration_s))
    if 2 * len(at_once) <= seen.sum():
        return Order(not seen.any(), 0, None)
    in_time = at_once[np.argsort(mean_s[at_once])]
    turned = np.unwrap(in_time * _COLUMN_RAD)
    if len(in_time) < 3:
        return Order(True, 0, None)
    rate, start = np.polyfit(mean_s[in_time], turned, 1)
    off = np.abs(turned - start - rate * mean_s[in_time])
    if rate == 0.0 or np.median(off) > _STRAIGHT * 2 * np.pi:
        return Order(True, 0, None)
    return Order(True, 1 if rate > 0 else -1, float(2 * np.pi / abs(rate)))
