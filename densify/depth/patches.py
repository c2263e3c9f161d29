# SPDX-License-Identifier: MIT
"""What each accumulated point stands for, before any camera looks: a patch of surface as large as
the gap to the neighbouring rays of its own sweep, slanted as its neighbours there tell; and whether
the key sweep saw through the place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from densify.config import ProjectSettings
from densify.geometry.range_image import RangeImage
from densify.kernels import visibility as kernels
from densify.types import Cloud, Float, Float32, Int, Patches

# Spacing of a 64-beam scanner, taken where the cloud is too small to measure it.
_DEFAULT_SPACING_RAD = (np.radians(0.18), np.radians(0.40))
_BIN_RAD = np.radians(0.5)
_SECTOR_RAD = np.radians(1.0)
_MAX_GAP_RAD = np.radians(4.0)
_MIN_GAPS = 100
_MIN_GAPS_PER_BIN = 30
_MIN_FILLED = 6


def patches(
    cloud: Cloud,
    key: int,
    settings: ProjectSettings,
    origins: Mapping[int, Float] | None = None,
    key_image: RangeImage | None = None,
) -> Patches:
    """The patches of ``cloud``, of any use to every camera.

    origins: (3,) where each source sweep's lidar stood, key frame, by frame; without it all count
    as measured from the key's. key_image: what the key sweep saw; without it nothing is ``free``.

    The tangent plane is from the neighbours in azimuth and elevation in the same sweep; where they
    tell of no single surface the patch faces the scanner. A point of another sweep is free where
    the key sweep saw through it and all around (`RangeImage.sees_through`): by more than ``veto_m``
    and ``veto_fraction`` in at least six of the nine cells around. Only the key's rays count: other
    sweeps rightly saw through the place where a mover was not yet.
    """
    frames, inverse = np.unique(cloud.frame, return_inverse=True)
    sweep: NDArray[np.int32] = inverse.ravel().astype(np.int32)
    places = np.zeros((len(frames), 3))
    if origins is not None and len(frames):
        places = np.array([origins[int(f)] for f in frames])
    seen = np.empty((3, len(cloud)), np.float32)
    kernels.look.over_rows(len(cloud), cloud.rigid_points, places, sweep, seen)
    members = np.split(np.argsort(sweep, kind="stable"), np.cumsum(np.bincount(sweep))[:-1])
    normal = np.empty((len(cloud), 3), np.float32)
    spacing_m = np.empty((len(cloud), 2), np.float32)
    if len(cloud):
        nearest = int(np.argmin(np.abs(frames - key)))
        _tangents(seen, members, seen[:, members[nearest]], normal, spacing_m)
    free = np.zeros(len(cloud), bool)
    other = np.flatnonzero(cloud.frame != key)
    if key_image is not None and len(other):
        free[other] = key_image.sees_through(
            cloud.points[other],
            settings.veto_m,
            settings.veto_fraction,
            _MIN_FILLED,
            cloud.velocity_m_s[other].astype(np.float64),
        )
    return Patches(normal, spacing_m, free, sweep)


def _tangents(
    seen: Float32, members: list[Int], one_sweep: Float32, normal: Float32, spacing_m: Float32
) -> None:
    """Fill the columns, sweep by sweep."""
    step_rad, low_rad, ring_of = _sensor_grid(*one_sweep[:2])
    num_rows = int(ring_of[-1]) + 2
    grid = np.empty((num_rows, round(2 * np.pi / step_rad)), np.int32)
    for mine in members:
        kernels.nearest_in_cells(seen, mine, ring_of, low_rad, _BIN_RAD, grid)
        scanner = (ring_of, low_rad, _BIN_RAD, np.array([step_rad, 0.0]), grid)
        kernels.tangents.over_rows(len(mine), mine, seen, *scanner, normal, spacing_m)


def _sensor_grid(azimuth: Float32, elevation: Float32) -> tuple[float, float, Float]:
    """How a sensor samples directions: its azimuth step (rad), the lowest elevation (rad), and
    (B,) the count of rings, a fraction at will, from there up to each half degree.

    From the gaps between successive returns, medians: of azimuth within thin bands of elevation, of
    elevation within thin sectors, by elevation since the rings of many sensors lie closer near the
    horizon. Needs no distinct rings.
    """
    step_rad, ring_rad = _DEFAULT_SPACING_RAD
    gap, _ = _gaps(azimuth, elevation, np.radians(0.1), 1e-4)
    if len(gap) >= _MIN_GAPS:
        step_rad = float(np.median(gap))
    low = float(elevation.min()) - _BIN_RAD
    num_bins = int((float(elevation.max()) + _BIN_RAD - low) / _BIN_RAD) + 2
    gap, middle = _gaps(elevation, azimuth, _SECTOR_RAD, step_rad / 2)
    ring_rads = np.full(num_bins, ring_rad)
    if len(gap) >= _MIN_GAPS:
        ring_rads[:] = np.median(gap)
        in_bin = ((middle - low) / _BIN_RAD).astype(np.int64)
        order = np.argsort(in_bin, kind="stable")
        count = np.bincount(in_bin, minlength=num_bins)
        bins = np.flatnonzero(count >= _MIN_GAPS_PER_BIN)
        ends = np.cumsum(count)
        medians = [np.median(gap[order[ends[b] - count[b] : ends[b]]]) for b in bins]
        if len(bins):
            ring_rads = np.interp(np.arange(num_bins), bins, medians)
    ring_of = np.concatenate([[0.0], np.cumsum(_BIN_RAD / ring_rads)])
    return step_rad, low, ring_of


def _gaps(
    angle: Float32, across: Float32, band_rad: float, least_rad: float
) -> tuple[Float, Float]:
    """Gaps between successive angles that share a band of the other angle, and their middles; those
    of one ring and those over missing returns left out."""
    band = np.floor(across / band_rad)
    order = np.lexsort((angle, band))
    gap = np.diff(angle[order].astype(float))
    middle = angle[order][:-1] + gap / 2
    kept = (np.diff(band[order]) == 0) & (gap > max(least_rad, 1e-4)) & (gap < _MAX_GAP_RAD)
    return gap[kept], middle[kept]
