# SPDX-License-Identifier: MIT
"""Depth maps of lenses that are no pinholes: what depth is, how large patches are at the rim."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth.exposure import Exposure
from densify.geometry.cameras import convert_depth, rays
from densify.geometry.types import Camera, Patches, Reason
from tests.depth_scenes import depth_map, make_camera, make_cloud

K = np.array([[124.0, 0, 199.5], [0, 124.0, 199.5], [0, 0, 1]])
FISHEYE = Camera(
    *("fish", 400, 400, K, np.eye(4), (-0.02, 0.003, -0.001, 0.0001), "fisheye"), max_angle_deg=95.0
)


def seen_from(camera, points, normal, spacing_m, measure):
    """Points in the camera's own frame, each with its patch."""
    n = len(points)
    patches = Patches(
        np.broadcast_to(np.asarray(normal, np.float32), (n, 3)).copy(),
        np.broadcast_to(np.asarray(spacing_m, np.float32), (n, 2)).copy(),
    )
    exposure = Exposure(camera, np.eye(4), measure=measure)
    return depth_map(make_cloud(points), exposure, patches, filled=False)


def pixels(camera, step=1):
    v, u = np.mgrid[0 : camera.height_px : step, 0 : camera.width_px : step]
    return np.column_stack([u.ravel(), v.ravel()]).astype(float)


def ground(camera, down_m=1.6, step=2, reach_m=30.0):
    """The points of a plane below the camera on every other pixel."""
    ray = rays(camera, pixels(camera, step))
    ray = ray[ray[:, 1] > 0.05]
    points = ray * (down_m / ray[:, 1])[:, None]
    return points[np.linalg.norm(points, axis=1) < reach_m]


@pytest.mark.parametrize("measure", ["range", "z"])
def test_ground_hides_itself_nowhere_in_a_fisheye(measure):
    """As it would if its slope were taken for that in a pinhole's image."""
    points = ground(FISHEYE)
    maps = seen_from(FISHEYE, points, [0, 1.0, 0], (0.5, 0.5), measure)
    assert maps.measure == measure
    ahead = points[:, 2] > 1.0 if measure == "z" else np.ones(len(points), bool)
    hidden = maps.reason[ahead] == Reason.HIDDEN
    assert hidden.mean() < 0.002
    facing = points / np.sum(points**2, axis=1, keepdims=True)
    steep = seen_from(FISHEYE, points, facing, (0.5, 0.5), measure)
    assert (steep.reason[ahead] == Reason.HIDDEN).mean() > 0.25  # what the slope prevents


@pytest.mark.parametrize("measure", ["range", "z"])
def test_depth_of_a_plane_is_that_in_the_middle_of_the_pixel(measure):
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-9, 9, 60_000), np.full(60_000, 1.6)])
    points = np.column_stack([points, rng.uniform(-1, 9, 60_000)])
    maps = seen_from(FISHEYE, points, [0, 1.0, 0], (0.05, 0.05), measure)
    row, column = np.nonzero(maps.depth_m)
    assert len(row) > 8_000
    ray = rays(FISHEYE, np.column_stack([column, row]).astype(float))
    truth = 1.6 / ray[:, 1] * (ray[:, 2] if measure == "z" else 1.0)
    assert (maps.depth_m >= 0).all() and np.isfinite(maps.depth_m).all()
    # z vanishes towards the side: what is near in it is not near
    error = np.abs(maps.depth_m[row, column] - truth) / np.maximum(truth, 1.0)
    error = error[np.isfinite(error)]  # the middle of a pixel at the rim may lie beyond the lens
    assert len(error) > 0.99 * len(row)
    assert np.median(error) < 1e-3 and np.quantile(error, 0.99) < 0.025
    behind = np.linalg.norm([column - 199.5, row - 199.5], axis=0) > 124 * 1.52
    assert (behind.sum() > 100) == (measure == "range")  # beyond 90 degrees there is no z


def test_depth_turns_from_one_measure_into_the_other():
    for camera in (FISHEYE, make_camera(40, 30, 25.0)):
        ray = rays(camera, pixels(camera)).reshape(camera.height_px, camera.width_px, 3)
        known = np.isfinite(ray[..., 2]) & (ray[..., 2] > 0)
        range_m = np.where(np.isfinite(ray[..., 2]), 7.0, 0).astype(np.float32)
        z = convert_depth(camera, range_m, "range", "z")
        np.testing.assert_allclose(z[known], 7 * ray[known][:, 2], rtol=1e-6)
        assert not z[~known].any()
        back = convert_depth(camera, z, "z", "range")
        np.testing.assert_allclose(back[known], 7.0, rtol=1e-5)
        assert convert_depth(camera, z, "z", "z") is z
