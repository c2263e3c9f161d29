# SPDX-License-Identifier: MIT
"""Project camera-frame points into images, and find the viewing ray of image coordinates.

Every model maps a direction to a plane, distorts the plane radially and tangentially, and scales
it to pixels by ``K``:

pinhole
    plane (x/z, y/z); OpenCV's 0, 4, 5 or 8 (rational) coefficients (docs.opencv.org, calib3d).
    Thin prism and tilted sensor terms must be 0.
fisheye
    plane θ (x, y) / hypot(x, y), θ the angle off the axis; OpenCV's four coefficients k1 to k4
    (docs.opencv.org, fisheye; Kannala and Brandt, "A generic camera model and calibration method
    for conventional, wide-angle, and fish-eye lenses", PAMI 2006).
mei
    plane (x, y) / (z + ξ r), r the range; ξ k1 k2 p1 p2 (Mei and Rives, "Single view point
    omnidirectional camera calibration from planar grids", ICRA 2007), as KITTI-360's fisheyes;
    ``K`` holds gamma1, gamma2, u0, v0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from densify.config.errors import InputError
from densify.geometry.types import Bool, Camera, Float, Float32

NEAREST_M = 0.1
"""Least depth of a visible point, in metres."""
# Possible numbers of coefficients of each model
_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_NUM_RATIONAL = 8  # coefficients k1 k2 p1 p2 k3 k4 k5 k6 of a pinhole; all others are 0
_STEP_RAD = np.cbrt(np.finfo(float).eps)  # step of central differences with the least error
# Relative residual before the last step of Newton's method, which squares it: then it is exact.
_CONVERGED = np.sqrt(np.finfo(float).eps)


def image_points(camera: Camera, points_cam: Float) -> tuple[Float, Bool]:
    """Return the image coordinates of points, and a mask of the visible points.

    A distortion polynomial is valid only inside the image. Beyond the angle at which the distorted
    radius stops growing, it would fold points back into the image. Such points, and points more
    than the camera's ``max_angle_deg`` off its axis, are invisible.

    Args:
        points_cam: (N,3) points in metres, camera frame.

    Returns:
        uv: (N,2) image coordinates in pixels, integers at pixel centres. NaN for a point that is
            too near or outside the view of the lens.
        visible: (N,) True for a point in the view of the lens that falls on a pixel after ``rint``
            and is farther than 0.1 m: in z for a pinhole, in range for other lenses.

    Raises:
        InputError: If the lens model is unknown, or its coefficients are wrong in number or value.
    """
    lens = _lens(camera.name, camera.model, tuple(camera.distortion))
    uv = np.full((len(points_cam), 2), np.nan)
    visible = np.zeros(len(points_cam), bool)
    rows_ahead = np.flatnonzero(depth_along(points_cam, camera.measure) > NEAREST_M)
    points_ahead = points_cam.take(rows_ahead, axis=0)
    in_view = np.flatnonzero(_in_view(camera, lens, points_ahead))
    rows = rows_ahead[in_view]
    uv[rows] = _pixels(camera, lens, points_ahead.take(in_view, axis=0))
    u, v = np.rint(uv.take(rows, axis=0)).T
    with np.errstate(invalid="ignore"):
        visible[rows] = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    return uv, visible


def rays(camera: Camera, uv: Float) -> Float:
    """Return the viewing rays of image coordinates: unit vectors (N,3), camera frame.

    A pixel outside the view of the lens has NaN. ``uv`` (N,2) are in pixels, integers at pixel
    centres. Raise InputError for an unknown lens model or wrong coefficients.
    """
    lens = _lens(camera.name, camera.model, tuple(camera.distortion))
    plane_xy = (np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(camera.K).T)[:, :2]
    if not camera.is_rectified:
        plane_xy = _undistort(lens, plane_xy)
    ray = _direction(camera, *plane_xy.T)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        ray[~_in_view(camera, lens, ray)] = np.nan
    return ray


def pixels_per_metre(camera: Camera, points_cam: Float) -> Float:
    """Return the Jacobian (N,2,3) of the projection at visible points (N,3), metres, camera frame.

    Element [n, i, j] is the change of u (i = 0) or v (i = 1) in pixels per metre along axis j.
    """
    lens = _lens(camera.name, camera.model, tuple(camera.distortion))
    range_m = np.linalg.norm(points_cam, axis=1, keepdims=True)
    ray = points_cam / range_m
    # An axis perpendicular to each ray: its product with the coordinate axis farthest from the ray.
    normal = np.cross(ray, np.eye(3)[np.argmin(np.abs(ray), axis=1)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    jacobian = np.zeros((len(ray), 2, 3))
    # Central differences along the two axes across each ray: along the ray nothing changes.
    for axis in (normal, np.cross(ray, normal)):
        uv_ahead = _pixels(camera, lens, ray + _STEP_RAD * axis)
        uv_behind = _pixels(camera, lens, ray + -_STEP_RAD * axis)
        jacobian += ((uv_ahead - uv_behind) / (2 * _STEP_RAD))[:, :, None] * axis[:, None, :]
    return jacobian / range_m[:, :, None]


def depth_along(points_cam: Float, measure: str) -> Float:
    """Return the depths (N,) in metres of points (N,3), metres, camera frame.

    The ``measure`` is ``z``, along the optical axis, or ``range``, distance from the lens.
    """
    return points_cam[:, 2] if measure == "z" else np.linalg.norm(points_cam, axis=1)


def convert_depth(camera: Camera, depth_m: Float32, from_measure: str, to_measure: str) -> Float32:
    """Return a depth map in another measure of depth.

    Pixels whose ray has z <= 0 become 0. If both measures are the same, the result is ``depth_m``
    itself, no copy.

    Args:
        depth_m: (H,W) depth in metres, 0 for no depth.
        from_measure: ``z``, depth along the optical axis, or ``range``, distance from the lens.
        to_measure: ``z`` or ``range``.
    """
    if from_measure == to_measure:
        return depth_m
    v, u = np.divmod(np.arange(depth_m.size, dtype=np.float64), camera.width_px)
    z = rays(camera, np.column_stack([u, v]))[:, 2].reshape(depth_m.shape)  # of unit vectors
    has_depth = (z > 0) & (depth_m > 0)
    factor = z if to_measure == "z" else 1 / np.where(has_depth, z, 1.0)
    return np.where(has_depth, depth_m * factor, 0.0).astype(np.float32)


class _Lens(NamedTuple):
    """The distortion of a lens, which moves points of the plane in the module's docstring."""

    # The radial factor is numerator / denominator, both polynomials of the squared radius.
    numerator: Polynomial
    denominator: Polynomial
    p1: float  # tangential coefficients of OpenCV
    p2: float
    limit: float  # squared radius up to which the distorted radius grows


@lru_cache
def _lens(name: str, model: str, coef: tuple[float, ...]) -> _Lens:
    """Return the lens of a camera; raise InputError for an unknown model or bad coefficients."""
    if model not in _COEFFICIENTS:
        raise InputError(
            f"camera {name}: model: got {model!r}, expected one of "
            f"{', '.join(_COEFFICIENTS)}; rectify the images if the lens is another"
        )
    lengths = _COEFFICIENTS[model]
    if len(coef) not in lengths or not np.isfinite(coef).all() or any(coef[_NUM_RATIONAL:]):
        expected = " or ".join(str(n) for n in lengths if n <= _NUM_RATIONAL)
        raise InputError(
            f"camera {name}: distortion: expected {expected} finite coefficients of a "
            f"{model} lens in their usual order, any others 0, got {list(coef)}; correct "
            f"the calibration or rectify the images"
        )
    denominator_terms: tuple[float, ...] = (1.0,)
    p1 = p2 = 0.0
    if model == "fisheye":
        numerator_terms = (1.0, *coef)
    elif model == "mei":
        _, k1, k2, p1, p2 = coef
        numerator_terms = (1.0, k1, k2)
    else:
        k1, k2, p1, p2, k3, *k4_to_k6 = (*coef, *[0.0] * _NUM_RATIONAL)[:_NUM_RATIONAL]
        numerator_terms = (1.0, k1, k2, k3)
        denominator_terms = (1.0, *k4_to_k6)
    numerator, denominator = Polynomial(numerator_terms), Polynomial(denominator_terms)
    limit = _growth_limit(numerator, denominator)
    if model == "fisheye":
        limit = min(limit, np.pi**2)  # the angle off the axis is at most pi
    return _Lens(numerator, denominator, p1, p2, limit)


def _growth_limit(n: Polynomial, d: Polynomial) -> float:
    """Return the squared radius up to which the distorted radius grows."""
    # The radial factor of radius r is n(s)/d(s) with s = r², and n', d' are derivatives by s. The
    # distorted radius r n/d stops growing at the first positive root of n d + 2 s (n' d - n d').
    # Beyond the first root of d it has no meaning.
    growth = n * d + Polynomial([0.0, 2.0]) * (n.deriv() * d - n * d.deriv())
    roots = np.concatenate([growth.trim(1e-15).roots(), d.trim(1e-15).roots()])
    positive_roots = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(positive_roots.min(initial=np.inf))


def _in_view(camera: Camera, lens: _Lens, points_cam: Float) -> Bool:
    """Return (N,) True for directions in the view of the lens, inside or outside the image."""
    x, y, z = points_cam.T
    range_m = np.sqrt(x * x + y * y + z * z)  # norm takes three times as long
    in_view: Bool = z >= range_m * np.cos(np.radians(camera.max_angle_deg))
    if camera.model == "pinhole":
        in_view &= z > 0
    elif camera.model == "mei":
        # On the sphere the radius sin θ / (cos θ + ξ) grows until cos θ = -1/ξ, or has a pole.
        xi = camera.distortion[0]
        in_view &= z > -range_m * (min(xi, 1 / xi) if xi > 0 else 0)
    if np.isfinite(lens.limit):
        rows = np.flatnonzero(in_view)
        x, y = _plane(camera, points_cam[rows])
        in_view[rows] = x**2 + y**2 < lens.limit
    return in_view


def _plane(camera: Camera, points_cam: Float) -> tuple[Float, Float]:
    """Return (N,) x and y on the plane, before distortion, of points (N,3) in the camera frame."""
    x, y, z = points_cam.T
    if camera.model == "pinhole":
        return x / z, y / z
    if camera.model == "mei":
        depth = z + camera.distortion[0] * np.linalg.norm(points_cam, axis=1)
        return x / depth, y / depth
    off_axis = np.hypot(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        on_axis = np.where(z > 0, 1.0, np.nan)  # limit ahead; straight behind there is no direction
        factor = np.where(off_axis > 0, np.arctan2(off_axis, z) / off_axis, on_axis)
    return factor * x, factor * y


def _direction(camera: Camera, x: Float, y: Float) -> Float:
    """Return (N,3) directions, of any length, from (N,) x and y on the plane; inverts `_plane`."""
    if camera.model == "pinhole":
        return np.column_stack([x, y, np.ones(len(x))])
    squared_radius = x**2 + y**2
    if camera.model == "mei":
        # The factor z + ξ of a unit vector: its length must be 1.
        xi = camera.distortion[0]
        with np.errstate(invalid="ignore"):
            factor = (xi + np.sqrt(1 + (1 - xi**2) * squared_radius)) / (1 + squared_radius)
        return np.column_stack([factor * x, factor * y, factor - xi])
    angle = np.sqrt(squared_radius)
    factor = np.sinc(angle / np.pi)  # sin(angle) / angle
    return np.column_stack([factor * x, factor * y, np.cos(angle)])


def _distort(lens: _Lens, x: Float, y: Float) -> tuple[Float, Float]:
    """Return (N,) distorted x and y on the plane."""
    s = x**2 + y**2
    factor = lens.numerator(s) / lens.denominator(s)
    distorted_x = factor * x + 2 * lens.p1 * x * y + lens.p2 * (s + 2 * x**2)
    distorted_y = factor * y + lens.p1 * (s + 2 * y**2) + 2 * lens.p2 * x * y
    return distorted_x, distorted_y


def _pixels(camera: Camera, lens: _Lens, points_cam: Float) -> Float:
    """Return (N,2) image coordinates of points (N,3) in the view of the lens."""
    x, y = _plane(camera, points_cam)
    if not camera.is_rectified:
        x, y = _distort(lens, x, y)
    K = camera.K
    return np.column_stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]])


def _undistort(lens: _Lens, distorted: Float) -> Float:
    """Return the (N,2) inverse of `_distort`, NaN where the inverse does not exist."""
    # Start from the radial distortion alone, tabulated. The table is even in angle, because the
    # plane of a lens with a half-space view is infinite. Its radius 1e3 is 89.94 degrees off axis.
    radius = np.tan(np.linspace(0, np.arctan(np.sqrt(lens.limit)), 4096))
    radius = radius[radius < 1e3]
    distorted_radius = radius * lens.numerator(radius**2) / lens.denominator(radius**2)
    target_radius = np.hypot(*distorted.T)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        start_radius = np.interp(target_radius, distorted_radius, radius)
        xy = distorted * np.where(target_radius > 0, start_radius / target_radius, 1.0)[:, None]

        # Newton's method: xy -= J⁻¹ residual. J is symmetric, J⁻¹ = (columns below) / determinant.
        unsolved = np.arange(len(distorted))
        error = np.full(len(distorted), np.inf)
        for _ in range(10):
            residual = np.stack(_distort(lens, *xy[unsolved].T)) - distorted[unsolved].T
            x_by_x, x_by_y, y_by_y = _slopes_of(lens, *xy[unsolved].T)
            column_x, column_y = np.stack([y_by_y, -x_by_y]), np.stack([-x_by_y, x_by_x])
            step = column_x * residual[0] + column_y * residual[1]
            xy[unsolved] -= (step / (x_by_x * y_by_y - x_by_y**2)).T
            error[unsolved] = np.abs(residual).max(axis=0) / (1 + target_radius[unsolved])
            unsolved = unsolved[~(error[unsolved] < _CONVERGED)]  # NaN stays unsolved
        is_solved = (error < _CONVERGED) & ((xy**2).sum(axis=1) < lens.limit)
    return np.where(is_solved[:, None], xy, np.nan)


def _slopes_of(lens: _Lens, x: Float, y: Float) -> tuple[Float, Float, Float]:
    """Return derivatives of `_distort` at (N,) x and y: of x by x, of x by y and y by x, y by y."""
    s = x**2 + y**2
    numerator, denominator = lens.numerator(s), lens.denominator(s)
    factor = numerator / denominator
    # twice the derivative of the factor by s
    growth = 2 * (lens.numerator.deriv()(s) - factor * lens.denominator.deriv()(s)) / denominator
    x_by_x = factor + growth * x**2 + 2 * lens.p1 * y + 6 * lens.p2 * x
    x_by_y = growth * x * y + 2 * (lens.p1 * x + lens.p2 * y)
    y_by_y = factor + growth * y**2 + 6 * lens.p1 * y + 2 * lens.p2 * x
    return x_by_x, x_by_y, y_by_y
