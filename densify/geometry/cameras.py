# SPDX-License-Identifier: MIT
"""Where camera-frame points land in an image, with OpenCV's lens distortion."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import Polynomial

from densify.errors import InputError
from densify.types import Bool, Camera, Float

NEAREST_M = 0.1
_LENGTHS = (0, 4, 5, 8, 12)


def image_points(camera: Camera, points_cam: Float) -> tuple[Float, Bool]:
    """Project points into a camera's image.

    points_cam: (N,3) metres, camera frame (x right, y down, z forward).

    Returns (N,2) image coordinates u, v in pixels (a pixel's centre is an integer; NaN where a
    point has none) and (N,) bool: in front of the camera (z > 0.1 m), inside the lens's valid field
    of view and on one of the image's pixels after ``rint``.

    Distortion is OpenCV's radial-tangential model with 4, 5, 8 (rational) or 12 (thin prism)
    coefficients (docs.opencv.org, calib3d). A distortion polynomial is only fitted inside the
    image; beyond the angle where the distorted radius stops growing it folds far-off points back
    in, so those count as unseen. Raises InputError for another number of coefficients.
    """
    depth = points_cam[:, 2]
    ahead = np.flatnonzero(depth > NEAREST_M)
    x = points_cam[ahead, 0] / depth[ahead]
    y = points_cam[ahead, 1] / depth[ahead]
    if camera.distortion:
        valid = x**2 + y**2 < _field_of_view_squared(camera)
        ahead, x, y = ahead[valid], x[valid], y[valid]
        x, y = _distort(x, y, camera)
    uv = np.full((len(points_cam), 2), np.nan)
    uv[ahead, 0] = camera.K[0, 0] * x + camera.K[0, 1] * y + camera.K[0, 2]
    uv[ahead, 1] = camera.K[1, 1] * y + camera.K[1, 2]
    with np.errstate(invalid="ignore"):
        pixel = np.rint(uv)
        seen = ((pixel >= 0) & (pixel < (camera.width_px, camera.height_px))).all(axis=1)
    return uv, seen


def _coefficients(camera: Camera) -> Float:
    """(12,) k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, missing ones 0."""
    given = camera.distortion
    if len(given) not in _LENGTHS or not np.isfinite(given).all():
        raise InputError(
            f"camera {camera.name}: distortion: expected 0, 4, 5, 8 or 12 finite coefficients in "
            f"OpenCV's order, got {list(given)}; correct the calibration or rectify the images"
        )
    full = np.zeros(12)
    full[: len(given)] = given
    return full


def _radial(camera: Camera) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of the radial factor, polynomials in the squared radius."""
    k1, k2, _, _, k3, k4, k5, k6 = _coefficients(camera)[:8]
    return Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])


def _distort(x: Float, y: Float, camera: Camera) -> tuple[Float, Float]:
    """Normalised image coordinates behind the lens."""
    p1, p2 = _coefficients(camera)[2:4]
    s1, s2, s3, s4 = _coefficients(camera)[8:]
    numerator, denominator = _radial(camera)
    s = x**2 + y**2
    factor = numerator(s) / denominator(s)
    return (
        factor * x + 2 * p1 * x * y + p2 * (s + 2 * x**2) + s1 * s + s2 * s**2,
        factor * y + p1 * (s + 2 * y**2) + 2 * p2 * x * y + s3 * s + s4 * s**2,
    )


def _field_of_view_squared(camera: Camera) -> float:
    """Squared radius (tangent of the off-axis angle) up to which the radial part grows.

    With s = r² and the factor n(s)/d(s), the distorted radius r n/d stops growing at the first
    positive root of n d + 2 s (n' d - n d'), and means nothing beyond a pole, the first root of d.
    """
    n, d = _radial(camera)
    growth = n * d + Polynomial([0.0, 2.0]) * (n.deriv() * d - n * d.deriv())
    roots = np.concatenate([growth.trim(1e-15).roots(), d.trim(1e-15).roots()])
    stops = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(stops.min(initial=np.inf))
