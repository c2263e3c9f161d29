# SPDX-License-Identifier: MIT
"""Camera models against OpenCV, against the published formula, and against their own inverse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry.cameras import image_points, pixels_per_metre, rays
from densify.geometry.types import Camera

PINHOLES = [
    (),
    (-0.3, 0.1, 1e-3, -5e-4),
    (-0.37, 0.19, 9e-4, 1e-3, -0.06),
    (0.4, -0.2, 5e-4, 1e-3, 0.02, 0.7, -0.1, 0.05),
    (-0.3, 0.1, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0),
]
FISHEYE = (-0.02, 0.003, -1e-3, 1e-4)
# image_02 of KITTI-360, and one whose mirror is flatter than a sphere
MEI = [(2.2134, 0.0168, 1.6548, 4.2e-4, 4.2e-4), (0.8, -0.1, 0.02, 4e-4, -3e-4)]


def make_camera(distortion=(), model="pinhole", width=640, height=480, focal=300.0):
    focal *= 1 + distortion[0] if model == "mei" else 1
    K = np.array([[focal, 0.5, (width - 1) / 2], [0, 1.1 * focal, (height - 1) / 2], [0, 0, 1]])
    return Camera("cam", width, height, K, np.eye(4), tuple(distortion), model)


ALL = [
    *(make_camera(lens) for lens in PINHOLES),
    make_camera(FISHEYE, "fisheye", focal=120.0),
    *(make_camera(lens, "mei", focal=120.0) for lens in MEI),
]


def anywhere(num=3000, seed=1):
    return np.random.default_rng(seed).normal(size=(num, 3)) * 9


@pytest.mark.parametrize("lens", PINHOLES, ids=len)
def test_a_pinhole_with_distortion_equals_opencv(lens):
    camera = replace(make_camera(lens), K=make_camera().K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]])
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (500, 2)), np.ones(500)])
    points *= rng.uniform(0.5, 80, (500, 1))
    uv, _ = image_points(camera, points)
    coefficients = np.array(lens) if lens else None
    truth, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, coefficients)
    np.testing.assert_allclose(uv, truth[:, 0], atol=1e-9)
    by_translation = jacobian[:, 3:6].reshape(-1, 2, 3)
    np.testing.assert_allclose(pixels_per_metre(camera, points), by_translation, atol=1e-5)


def test_a_fisheye_equals_opencv():
    camera = make_camera(FISHEYE, "fisheye")
    points = anywhere()
    points = points[points[:, 2] > 0.2]  # OpenCV's own knows nothing beside the lens
    uv, _ = image_points(camera, points)
    alpha = camera.K[0, 1] / camera.K[0, 0]
    truth, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.K, np.array(FISHEYE), alpha=alpha
    )
    np.testing.assert_allclose(uv, truth[:, 0], atol=1e-9)


def published_mei(camera, point):
    """One point by the formulas of KITTI-360's projection.yaml, as its development kit has them,
    with the tangential terms of Mei and Rives."""
    xi, k1, k2, p1, p2 = camera.distortion
    X, Y, Z = point / np.sqrt(point @ point)
    x, y = X / (Z + xi), Y / (Z + xi)
    rho2 = x * x + y * y
    radial = 1 + k1 * rho2 + k2 * rho2 * rho2
    dx = x * radial + 2 * p1 * x * y + p2 * (rho2 + 2 * x * x)
    dy = y * radial + p1 * (rho2 + 2 * y * y) + 2 * p2 * x * y
    return camera.K[:2] @ [dx, dy, 1]


@pytest.mark.parametrize("lens", MEI)
def test_mei_is_the_published_formula(lens):
    camera = make_camera(lens, "mei", 1400, 1400, 300.0)
    points = anywhere()
    uv, seen = image_points(camera, points)
    assert seen.sum() > 500
    truth = np.array([published_mei(camera, p) for p in points[seen]])
    np.testing.assert_allclose(uv[seen], truth, atol=1e-9)


@pytest.mark.parametrize("camera", ALL, ids=lambda c: f"{c.model}-{len(c.distortion)}")
def test_rays_are_the_inverse(camera):
    v, u = np.mgrid[0 : camera.height_px : 7, 0 : camera.width_px : 7]
    uv = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    ray = rays(camera, uv)
    known = np.isfinite(ray).all(axis=1)
    assert known.mean() > 0.3
    np.testing.assert_allclose(np.linalg.norm(ray[known], axis=1), 1)
    again, seen = image_points(camera, ray[known] * 7.0)
    assert seen.all()
    np.testing.assert_allclose(again, uv[known], atol=1e-6)
    points = anywhere()
    uv, seen = image_points(camera, points)
    unit = points[seen] / np.linalg.norm(points[seen], axis=1, keepdims=True)
    off = np.linalg.norm(rays(camera, uv[seen]) - unit, axis=1)
    # at the rim of a rational lens its tangential part folds over a point or two
    assert (off < 1e-9).mean() > 0.99 and off.max() < 0.01

    # the Jacobian by its differences
    points = points[seen][:200]
    change = pixels_per_metre(camera, points)
    for axis in np.eye(3):
        there, back = (image_points(camera, points + s * 1e-4 * axis)[0] for s in (1, -1))
        difference = (there - back) / 2e-4
        known = np.isfinite(difference).all(axis=1)
        assert known.mean() > 0.9
        np.testing.assert_allclose(
            (change @ axis)[known], difference[known], atol=1e-4 * np.abs(change).max()
        )


def test_far_off_axis_points_do_not_fold_back_into_the_image():
    k1, k2 = -0.3, 0.0
    limit = np.sqrt(-1 / (3 * k1))  # d/dr (r + k1 r^3) = 0
    radius = np.array([0.0, 0.2, limit - 1e-6, limit + 1e-6, np.sqrt(-1 / k1), 3.0])
    points = np.column_stack([radius, np.zeros(6), np.ones(6)])
    camera = make_camera((k1, k2, 0, 0), width=100, height=48, focal=60.0)
    folded, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion)
    )
    assert 0 < folded[4, 0, 0] < camera.width_px  # OpenCV alone would paint it
    uv, seen = image_points(camera, points)
    assert np.isfinite(uv[:, 0]).tolist() == [True, True, True, False, False, False]
    assert seen.tolist() == [True, True, True, False, False, False]


def at_angles(degrees, about=0.4):
    """Points 5 m away at these angles off the axis."""
    angle = np.radians(degrees)
    flat = np.sin(angle)[:, None] * [np.cos(about), np.sin(about)]
    return 5 * np.column_stack([flat, np.cos(angle)])


def test_a_fisheye_sees_behind_its_image_plane():
    camera = make_camera((0.0, 0.0, 0.0, 0.0), "fisheye", 2000, 2000, 300.0)
    angles = [0, 60, 89, 91, 120, 179]
    uv, seen = image_points(camera, at_angles(angles))
    assert seen.all()
    plane = (uv - 999.5) @ np.linalg.inv(camera.K[:2, :2]).T
    np.testing.assert_allclose(np.hypot(*plane.T), np.radians(angles), atol=1e-9)
    narrow = replace(camera, max_angle_deg=95.0)
    assert image_points(narrow, at_angles(angles))[1].tolist() == [True] * 4 + [False] * 2
    assert image_points(camera, np.array([[0, 0, -3.0], [0.05, 0, 0.0]]))[1].tolist() == [False] * 2
    k1 = -1 / (3 * np.radians(100) ** 2)  # the polynomial grows up to 100 degrees
    bent = replace(camera, distortion=(k1, 0.0, 0.0, 0.0))
    seen = image_points(bent, at_angles([95, 99.9, 100.1, 150]))[1]
    assert seen.tolist() == [True, True, False, False]


@pytest.mark.parametrize("xi, ends_deg", [(2.0, 120.0), (0.5, 120.0), (0.0, 90.0)])
def test_the_sphere_of_mei_ends_where_its_radius_does(xi, ends_deg):
    """At cos = -1/xi the radius stops growing, at cos = -xi it has a pole."""
    camera = make_camera((xi, 0.0, 0.0, 0.0, 0.0), "mei", 10**7, 10**7, 300.0)
    seen = image_points(camera, at_angles([20, ends_deg - 0.5, ends_deg + 0.5]))[1]
    assert seen.tolist() == [True, True, False]
    bent = make_camera((xi, -0.3, 0.0, 0.0, 0.0), "mei", 10**7, 10**7, 300.0)
    radius = np.sqrt(1 / 0.9)  # of the plane, where r - 0.3 r^3 stops growing
    angles = np.linspace(1, 89, 500)
    on_plane = np.sin(np.radians(angles)) / (np.cos(np.radians(angles)) + xi)
    seen = image_points(bent, at_angles(angles))[1]
    assert np.array_equal(seen, on_plane < radius)


@pytest.mark.parametrize(
    ("model", "lens", "message"),
    [
        ("pinhole", (0.1,), "distortion: expected 0 or 4 or 5 or 8"),
        ("pinhole", (np.nan,) * 4, "distortion: expected 0 or 4 or 5 or 8"),
        ("pinhole", (0.1,) * 12, "distortion: expected 0 or 4 or 5 or 8"),  # thin prism
        ("bowl", (), "model: got 'bowl', expected one of pinhole, fisheye, mei"),
    ],
)
def test_a_bad_lens_is_named(model, lens, message):
    with pytest.raises(InputError, match=f"camera cam: {message}"):
        image_points(make_camera(lens, model), np.ones((1, 3)))
