# SPDX-License-Identifier: MIT
"""Where camera-frame points land in an image, and which ray each place of the image looks along.

Every model first takes a point's direction to a plane, then bends that plane with one radial and
tangential distortion, then scales it to pixels by ``K``:

pinhole
    plane (x/z, y/z); OpenCV's 0, 4, 5, 8 (rational), 12 (thin prism) or 14 (tilted sensor)
    coefficients (docs.opencv.org, calib3d).
fisheye
    plane θ (x, y) / hypot(x, y), θ the angle off the axis; OpenCV's four coefficients k1 to k4
    (docs.opencv.org, fisheye; Kannala and Brandt, "A generic camera model and calibration method
    for conventional, wide-angle, and fish-eye lenses", PAMI 2006).
mei
    plane (x, y) / (z + ξ r), r the range; ξ k1 k2 p1 p2 (Mei and Rives, "Single view point
    omnidirectional camera calibration from planar grids", ICRA 2007), as KITTI-360's fisheyes;
    gamma1, gamma2, u0, v0 stand in ``K``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from densify.config.errors import InputError
from densify.geometry.types import Bool, Camera, Float, Float32

NEAREST_M = 0.1
_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_STEP = 1e-6  # of differences, in radians or on the plane
_NUM_ANGLES = 4096
_NUM_STEPS = 10  # of Newton's method
_CONVERGED = 1e-10


def image_points(camera: Camera, points_cam: Float) -> tuple[Float, Bool]:
    """Project points into a camera's image.

    points_cam: (N,3) metres, camera frame (x right, y down, z forward).

    Returns (N,2) image coordinates u, v in pixels (a pixel's centre is an integer; NaN where a
    point has none) and (N,) bool: not too near (z, or range where the lens sees more than a half
    space, over 0.1 m), inside the lens's valid field of view and on one of the image's pixels after
    ``rint``.

    A distortion polynomial is only fitted inside the image; beyond the angle where the distorted
    radius stops growing it folds far-off points back in, so those count as unseen, as does what is
    more than the camera's ``max_angle_deg`` off its axis. Raises InputError for an unknown model or
    another number of coefficients than it has.
    """
    lens = _lens(camera)
    uv, seen = np.full((len(points_cam), 2), np.nan), np.zeros(len(points_cam), bool)
    away = points_cam[:, 2] if camera.model == "pinhole" else np.linalg.norm(points_cam, axis=1)
    ahead = np.flatnonzero(away > NEAREST_M)
    there = points_cam.take(ahead, axis=0)
    in_view = np.flatnonzero(_in_view(camera, lens, there))
    ahead, there = ahead[in_view], there.take(in_view, axis=0)
    uv[ahead] = _pixels(camera, lens, *_plane(camera, there))
    u, v = np.rint(uv.take(ahead, axis=0)).T
    with np.errstate(invalid="ignore"):
        seen[ahead] = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    return uv, seen


def rays(camera: Camera, uv: Float) -> Float:
    """(N,2) image coordinates -> (N,3) unit vectors in the camera frame, the inverse of
    `image_points`; NaN where the lens sees nothing. Raises InputError as `image_points`."""
    lens = _lens(camera)
    if camera.is_rectified:
        ray = np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(camera.K).T
    else:
        ray = _unbent(camera, lens, uv)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        ray[~_in_view(camera, lens, ray)] = np.nan
    return ray


def pixels_per_metre(camera: Camera, points_cam: Float) -> Float:
    """(N,3) points that are seen -> (N,2,3): by how much u and v change as a point moves by a metre
    along x, y and z of the camera frame (the Jacobian of the projection)."""
    lens = _lens(camera)
    range_m = np.linalg.norm(points_cam, axis=1, keepdims=True)
    ray = points_cam / range_m
    least = np.eye(3)[np.argmin(np.abs(ray), axis=1)]
    aside = np.cross(ray, least)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    change = np.zeros((len(ray), 2, 3))
    for axis in (aside, np.cross(ray, aside)):  # along the ray nothing changes
        there, back = (
            _pixels(camera, lens, *_plane(camera, ray + step * axis)) for step in (_STEP, -_STEP)
        )
        change += ((there - back) / (2 * _STEP))[:, :, None] * axis[:, None, :]
    return change / range_m[:, :, None]


def depth_along(points_cam: Float, measure: str) -> Float:
    """(N,3) -> (N,) metres: camera z, or the range from the lens."""
    return points_cam[:, 2] if measure == "z" else np.linalg.norm(points_cam, axis=1)


def converted(camera: Camera, depth_m: Float32, given: str, wanted: str) -> Float32:
    """(H,W) depth from one measure (``z`` or ``range``) to the other; 0 where it has no z > 0."""
    if given == wanted:
        return depth_m
    v, u = np.divmod(np.arange(depth_m.size, dtype=np.float64), camera.width_px)
    z = rays(camera, np.column_stack([u, v]))[:, 2].reshape(depth_m.shape)
    ahead = (z > 0) & (depth_m > 0)
    per = z if wanted == "z" else 1 / np.where(ahead, z, 1.0)
    return np.where(ahead, depth_m * per, 0.0).astype(np.float32)


class _Lens(NamedTuple):
    """How the plane is bent. numerator, denominator: of the radial factor, polynomials in the
    squared radius. tangential: p1 p2. prism: s1 s2 s3 s4. tilt: (3,3) homography of the sensor.
    limit: squared radius up to which the distorted radius grows."""

    numerator: Polynomial
    denominator: Polynomial
    tangential: Float
    prism: Float
    tilt: Float
    limit: float


def _lens(camera: Camera) -> _Lens:
    given = camera.distortion
    if camera.model not in _COEFFICIENTS:
        raise InputError(
            f"camera {camera.name}: model: got {camera.model!r}, expected one of "
            f"{', '.join(_COEFFICIENTS)}; rectify the images if the lens is another"
        )
    lengths = _COEFFICIENTS[camera.model]
    if len(given) not in lengths or not np.isfinite(given).all():
        *but_last, last = map(str, lengths)
        expected = f"{', '.join(but_last)} or {last}" if but_last else last
        raise InputError(
            f"camera {camera.name}: distortion: expected {expected} finite coefficients of a "
            f"{camera.model} lens in their usual order, got {list(given)}; correct the calibration "
            f"or rectify the images"
        )
    nothing = np.zeros(4)
    if camera.model == "fisheye":
        numerator = Polynomial([1.0, *given])
        limit = min(_stops_growing(numerator, Polynomial([1.0])), np.pi**2)
        return _Lens(numerator, Polynomial([1.0]), nothing[:2], nothing, np.eye(3), limit)
    if camera.model == "mei":
        numerator = Polynomial([1.0, *given[1:3]])
        limit = _stops_growing(numerator, Polynomial([1.0]))
        tangential = np.array(given[3:])
        return _Lens(numerator, Polynomial([1.0]), tangential, nothing, np.eye(3), limit)
    full = np.zeros(14)
    full[: len(given)] = given
    k1, k2, p1, p2, k3, k4, k5, k6 = full[:8]
    numerator, denominator = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
    limit = _stops_growing(numerator, denominator)
    tilt = _tilt(*full[12:])
    return _Lens(numerator, denominator, np.array([p1, p2]), full[8:12], tilt, limit)


def _stops_growing(n: Polynomial, d: Polynomial) -> float:
    """Squared radius up to which the distorted one grows.

    With s = r² and the factor n(s)/d(s), the distorted radius r n/d stops growing at the first
    positive root of n d + 2 s (n' d - n d'), and means nothing beyond a pole, the first root of d.
    """
    growth = n * d + Polynomial([0.0, 2.0]) * (n.deriv() * d - n * d.deriv())
    roots = np.concatenate([growth.trim(1e-15).roots(), d.trim(1e-15).roots()])
    stops = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(stops.min(initial=np.inf))


def _tilt(tau_x: float, tau_y: float) -> Float:
    """(3,3) homography onto a sensor tilted by these angles (rad), as OpenCV's
    ``computeTiltProjectionMatrix``."""
    sin_x, cos_x, sin_y, cos_y = np.sin(tau_x), np.cos(tau_x), np.sin(tau_y), np.cos(tau_y)
    about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
    about_y = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
    turned: Float = about_y @ about_x
    onto = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]])
    return onto @ turned


def _in_view(camera: Camera, lens: _Lens, points_cam: Float) -> Bool:
    """(N,) whether the lens sees that way, in the image or not."""
    x, y, z = points_cam.T
    range_m = np.sqrt(x * x + y * y + z * z)  # norm takes three times as long over rows of three
    seen: Bool = z >= range_m * np.cos(np.radians(camera.max_angle_deg))
    if camera.model == "pinhole":
        seen &= z > 0
    elif camera.model == "mei":
        # On the sphere the radius sin θ / (cos θ + ξ) grows until cos θ = -1/ξ, or has a pole.
        xi = camera.distortion[0]
        seen &= z > -range_m * (min(xi, 1 / xi) if xi > 0 else 0)
    if np.isfinite(lens.limit):
        ahead = np.flatnonzero(seen)
        x, y = _plane(camera, points_cam[ahead])
        seen[ahead] = x**2 + y**2 < lens.limit
    return seen


def _plane(camera: Camera, points_cam: Float) -> tuple[Float, Float]:
    """Coordinates on the plane, before any distortion."""
    x, y, z = points_cam.T
    if camera.model == "pinhole":
        return x / z, y / z
    if camera.model == "mei":
        depth = z + camera.distortion[0] * np.linalg.norm(points_cam, axis=1)
        return x / depth, y / depth
    aside = np.hypot(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        on_axis = np.where(z > 0, 1.0, np.nan)  # straight behind the lens there is no direction
        stretch = np.where(aside > 0, np.arctan2(aside, z) / aside, on_axis)
    return stretch * x, stretch * y


def _direction(camera: Camera, x: Float, y: Float) -> Float:
    """(N,3) inverse of `_plane`, of any length."""
    if camera.model == "pinhole":
        return np.column_stack([x, y, np.ones(len(x))])
    squared = x**2 + y**2
    if camera.model == "mei":
        xi = camera.distortion[0]
        with np.errstate(invalid="ignore"):
            stretch = (xi + np.sqrt(1 + (1 - xi**2) * squared)) / (1 + squared)
        return np.column_stack([stretch * x, stretch * y, stretch - xi])
    angle = np.sqrt(squared)
    stretch = np.sinc(angle / np.pi)
    return np.column_stack([stretch * x, stretch * y, np.cos(angle)])


def _bent(lens: _Lens, x: Float, y: Float) -> tuple[Float, Float]:
    """Coordinates on the plane behind the lens."""
    p1, p2 = lens.tangential
    s1, s2, s3, s4 = lens.prism
    s = x**2 + y**2
    factor = lens.numerator(s) / lens.denominator(s)
    bent_x = factor * x + 2 * p1 * x * y + p2 * (s + 2 * x**2) + s1 * s + s2 * s**2
    bent_y = factor * y + p1 * (s + 2 * y**2) + 2 * p2 * x * y + s3 * s + s4 * s**2
    if np.array_equal(lens.tilt, np.eye(3)):
        return bent_x, bent_y
    tilted = np.column_stack([bent_x, bent_y, np.ones(len(x))]) @ lens.tilt.T
    return tilted[:, 0] / tilted[:, 2], tilted[:, 1] / tilted[:, 2]


def _pixels(camera: Camera, lens: _Lens, x: Float, y: Float) -> Float:
    """(N,2) image coordinates of places on the plane."""
    if not camera.is_rectified:
        x, y = _bent(lens, x, y)
    u = camera.K[0, 0] * x + camera.K[0, 1] * y + camera.K[0, 2]
    return np.column_stack([u, camera.K[1, 1] * y + camera.K[1, 2]])


def _unbent(camera: Camera, lens: _Lens, uv: Float) -> Float:
    """(N,3) directions: the radial part is looked up, then Newton's method takes in the rest; NaN
    where it finds nothing."""
    onto_plane = np.linalg.inv(camera.K @ lens.tilt)
    wanted = np.column_stack([uv, np.ones(len(uv))]) @ onto_plane.T
    wanted = wanted[:, :2] / wanted[:, 2:]
    upright = lens._replace(tilt=np.eye(3))
    # Evenly in angle, since the plane of a lens that sees half of all directions has no end.
    radius = np.tan(np.linspace(0, np.arctan(np.sqrt(lens.limit)), _NUM_ANGLES))
    radius = radius[radius < 1e3]
    bent = radius * lens.numerator(radius**2) / lens.denominator(radius**2)
    far = np.hypot(*wanted.T)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        shrink = np.where(far > 0, np.interp(far, bent, radius) / far, 1.0)
        xy = wanted * shrink[:, None]
        left, found = np.arange(len(uv)), np.zeros(len(uv), bool)
        for _ in range(_NUM_STEPS):
            here = xy[left]
            off = np.column_stack(_bent(upright, *here.T)) - wanted[left]
            done = (np.abs(off) < _CONVERGED * (1 + far[left, None])).all(axis=1)
            found[left[done]] = True
            left, here, off = left[~done], here[~done], off[~done]
            (a, b), (c, d) = (_change(upright, here, axis) for axis in np.eye(2))
            step = np.stack([d * off[:, 0] - c * off[:, 1], a * off[:, 1] - b * off[:, 0]], axis=1)
            xy[left] -= step / (a * d - b * c)[:, None]
        found &= (xy**2).sum(axis=1) < lens.limit
    ray = np.full((len(uv), 3), np.nan)
    ray[found] = _direction(camera, *xy[found].T)
    return ray


def _change(lens: _Lens, xy: Float, axis: Float) -> Float:
    """(2,N) by how much the bent coordinates change along an axis of the plane."""
    step = _STEP * np.maximum(1.0, np.abs(xy).max(axis=1, keepdims=True))
    there, back = (np.stack(_bent(lens, *(xy + s * axis).T)) for s in (step, -step))
    return (there - back) / (2 * step[:, 0])
