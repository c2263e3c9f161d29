# SPDX-License-Identifier: MIT
"""Local planes of a sparse depth map and the pixels that may be interpolated from them.

A plane in space is linear in *inverse* depth over the image, so planes are fitted there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

from densify.types import Bool, Float, Float32

# A slanted plane follows part of a depth step: what is left of it in the residuals is smaller.
_TILTED_SPREAD = 0.7
_MIN_TILTED_PX = 6


@dataclass(frozen=True)
class Planes:
    """Inverse depth around each pixel: ``centre + du·slope_u + dv·slope_v``; all (H,W), 1/m.

    residual: weighted root mean square. num_px: measured pixels in the window; where 0 the rest is
    0 too. Pixels on one line leave the slope across it 0.
    """

    centre: Float
    slope_u: Float
    slope_v: Float
    residual: Float
    num_px: Float


def fit_planes(depth_m: Float32, reach_px: tuple[int, int]) -> Planes:
    """Weighted least-squares planes in inverse depth around every pixel.

    depth_m: (H,W) metres, 0 none. reach_px: half size (horizontal, vertical) of the window; the
    weight falls linearly from the centre to zero just outside it. Least squares by moments.
    """
    measured = depth_m > 0
    inverse = np.divide(1.0, depth_m, out=np.zeros(depth_m.shape), where=measured)
    mask = measured.astype(float)
    taps_u, taps_v = _taps(reach_px[0]), _taps(reach_px[1])

    def moments(image: Float, orders: tuple[tuple[int, int], ...]) -> list[Float]:
        across = {i: correlate1d(image, taps_u[i], axis=1, mode="constant") for i, _ in orders}
        return [correlate1d(across[i], taps_v[j], axis=0, mode="constant") for i, j in orders]

    n, u, v, uu, uv, vv = moments(mask, ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)))
    w, uw, vw = moments(inverse, ((0, 0), (1, 0), (0, 1)))
    (ww,) = moments(inverse**2, ((0, 0),))
    n_safe = np.where(n > 0, n, 1.0)
    u, v, w = u / n_safe, v / n_safe, w / n_safe
    # The tiny ridge gives the slope of least norm where the pixels lie on one line.
    uu, vv, uv = uu / n_safe - u * u + 1e-7, vv / n_safe - v * v + 1e-7, uv / n_safe - u * v
    uw, vw = uw / n_safe - u * w, vw / n_safe - v * w
    determinant = uu * vv - uv * uv
    slope_u = (vv * uw - uv * vw) / determinant
    slope_v = (uu * vw - uv * uw) / determinant
    variance = ww / n_safe - w * w - slope_u * uw - slope_v * vw
    box_u, box_v = np.ones(2 * reach_px[0] + 1), np.ones(2 * reach_px[1] + 1)
    return Planes(
        centre=w - slope_u * u - slope_v * v,
        slope_u=slope_u,
        slope_v=slope_v,
        residual=np.sqrt(np.maximum(variance, 0.0)),
        num_px=_box(mask, box_u, box_v),
    )


def fill_between(
    depth_m: Float32,
    confidence: Float32,
    reach_px: tuple[int, int],
    edge_m: float,
    edge_fraction: float,
    factor: float,
) -> tuple[Float32, Float32]:
    """Interpolate empty pixels that have measured pixels on both sides.

    Concretely, an empty pixel is filled when, within a window around it, measured pixels lie in a
    column to the left and one to the right and in a row above and one below, and no depth edge runs
    through them: their depths spread by no more than max(``edge_m``, ``edge_fraction`` * the
    nearest), or at least six of them deviate little enough from a slanted plane. It gets the
    plane's depth (`fit_planes`), held between the least and the greatest depth measured in the
    window: nothing is extrapolated, in the image or in depth. The window grows in thirds to the
    half size ``reach_px`` (horizontal, vertical) and the smallest that serves is taken.

    depth_m, confidence: (H,W), 0 none. Returns both with the filled pixels added; a filled pixel's
    confidence is ``factor`` * the least of the measured ones in its window.
    """
    filled_m, filled_confidence = depth_m.copy(), confidence.copy()
    windows = [
        (max(1, round(reach_px[0] * share / 3)), max(1, round(reach_px[1] * share / 3)))
        for share in (1, 2, 3)
    ]
    for window in sorted(set(windows)):
        empty = filled_m == 0
        row, column, depth = _interpolate(depth_m, empty, window, edge_m, edge_fraction)
        filled_m[row, column] = depth
        known = np.where(depth_m > 0, confidence, np.inf)
        least = minimum_filter(known, _size(window), mode="constant", cval=np.inf)
        filled_confidence[row, column] = factor * least[row, column]
    return filled_m, filled_confidence


def _interpolate(
    depth_m: Float32,
    empty: Bool,
    reach_px: tuple[int, int],
    edge_m: float,
    edge_fraction: float,
) -> tuple[np.ndarray, np.ndarray, Float]:
    """Rows, columns and depths of the ``empty`` pixels which one size of window can fill."""
    measured = depth_m > 0
    known = np.where(measured, depth_m, np.inf)
    nearest = minimum_filter(known, _size(reach_px), mode="constant", cval=np.inf)
    farthest = maximum_filter(depth_m, _size(reach_px), mode="constant", cval=0.0)
    row, column = np.nonzero(empty & _two_sided(measured, reach_px))
    z_near = nearest[row, column].astype(float)
    z_far = farthest[row, column].astype(float)
    allowed = np.maximum(edge_m, edge_fraction * z_near)

    planes = fit_planes(depth_m, reach_px)
    whole = z_far - z_near <= allowed
    slanted = ~whole & (planes.num_px[row, column] >= _MIN_TILTED_PX)
    spread = _residual_spread(depth_m, planes, row[slanted], column[slanted], reach_px)
    whole[slanted] = spread <= _TILTED_SPREAD * allowed[slanted]
    row, column = row[whole], column[whole]
    centre = np.clip(planes.centre[row, column], 1 / z_far[whole], 1 / z_near[whole])
    return row, column, 1 / centre


def _size(reach_px: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) of a window."""
    return 2 * reach_px[1] + 1, 2 * reach_px[0] + 1


def _taps(reach: int) -> tuple[Float, Float, Float]:
    """Weights times the zeroth, first and second power of the offset."""
    offset = np.arange(-reach, reach + 1, dtype=float)
    weight = 1 - np.abs(offset) / (reach + 1)
    return weight, weight * offset, weight * offset**2


def _box(mask: Float, taps_u: np.ndarray, taps_v: np.ndarray) -> Float:
    across = correlate1d(mask, taps_u, axis=1, mode="constant")
    return correlate1d(across, taps_v, axis=0, mode="constant")


def _two_sided(measured: Bool, reach_px: tuple[int, int]) -> Bool:
    """Has measured pixels left and right, above and below, within the window."""
    mask = measured.astype(float)
    offset_u = np.arange(-reach_px[0], reach_px[0] + 1)
    offset_v = np.arange(-reach_px[1], reach_px[1] + 1)
    both = np.ones(measured.shape, bool)
    for sign in (-1, 1):
        both &= _box(mask, (sign * offset_u > 0) * 1.0, np.ones(len(offset_v))) > 0.5
        both &= _box(mask, np.ones(len(offset_u)), (sign * offset_v > 0) * 1.0) > 0.5
    return both


def _residual_spread(
    depth_m: Float32,
    planes: Planes,
    row: np.ndarray,
    column: np.ndarray,
    reach_px: tuple[int, int],
) -> Float:
    """(K,) metres between the farthest and the nearest deviation from the plane, of given pixels.

    Deviations in inverse depth are turned into metres at the plane's depth in the centre.
    """
    reach_u, reach_v = reach_px
    padded = np.pad(depth_m, ((reach_v, reach_v), (reach_u, reach_u)))
    centre = planes.centre[row, column]
    slope_u, slope_v = planes.slope_u[row, column], planes.slope_v[row, column]
    least = np.full(len(row), np.inf)
    most = np.full(len(row), -np.inf)
    for dv in range(-reach_v, reach_v + 1):
        for du in range(-reach_u, reach_u + 1):
            depth = padded[row + reach_v + dv, column + reach_u + du].astype(float)
            with np.errstate(divide="ignore"):
                deviation = 1 / depth - (centre + du * slope_u + dv * slope_v)
            np.minimum(least, deviation, out=least, where=depth > 0)
            np.maximum(most, deviation, out=most, where=depth > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(centre > 0, (most - least) / centre**2, np.inf)
