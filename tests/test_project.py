# SPDX-License-Identifier: MIT
"""Projection, visibility and fill: analytic scenes, OpenCV, and slow twins."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.config import ProjectSettings
from densify.depth_fill import fill_between, fit_planes
from densify.errors import InputError
from densify.pinhole import image_points
from densify.poses import exp, inverse, transform
from densify.stages.project import _paint, _spacing_px, project
from densify.types import Camera, Cloud

KEY = 10
# hides only what is more than 10 m + its own depth behind a point in the same pixel
PLAIN = ProjectSettings(footprint=0, slack_m=0, hidden_m=10, hidden_fraction=1)
T_CAM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # axes only


def make_camera(width=64, height=48, focal=60.0, distortion=()):
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera("cam", width, height, K, np.eye(4), tuple(distortion))


def make_cloud(points, frame=KEY, confidence=1.0):
    points = np.asarray(points, float).reshape(-1, 3)
    n = len(points)
    return Cloud(
        points=points,
        rigid_points=points,
        frame=np.broadcast_to(np.asarray(frame, np.int32), n).copy(),
        row=np.arange(n),
        moving=np.zeros(n, bool),
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.broadcast_to(np.asarray(confidence, np.float32), n).copy(),
        intensity=np.zeros(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
    )


def take(cloud, index):
    return Cloud(**{name: column[index] for name, column in vars(cloud).items()})


def at_pixel(camera, u, v, z):
    """Camera-frame points seen at image coordinates (u, v) with depth z."""
    u, v, z = np.broadcast_arrays(np.asarray(u, float), v, z)
    x = (u - camera.K[0, 2]) / camera.K[0, 0] * z
    y = (v - camera.K[1, 2]) / camera.K[1, 1] * z
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def on_every_pixel(camera, z, step=1):
    v, u = np.mgrid[0 : camera.height_px : step, 0 : camera.width_px : step]
    return at_pixel(camera, u, v, z)


# --- pixels ---------------------------------------------------------------------------------------


def test_tilted_plane_from_a_known_pose_has_its_analytic_depth():
    camera = make_camera()
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-6, 6, 20000), rng.uniform(-5, 5, 20000), np.zeros(20000)])
    T_cam_key = exp(np.array([0.3, -0.2, 0.1, 0.4, -0.1, 9.0]))
    depth = project(make_cloud(plane), camera, T_cam_key, PLAIN, KEY)
    normal, point = T_cam_key[:3, 2], T_cam_key[:3, 3]
    row, column = np.nonzero(depth.depth_m)
    assert len(row) > 2500
    ray = at_pixel(camera, column, row, 1.0)
    truth = normal @ point / (ray @ normal)
    # a point lies up to half a pixel from the centre
    half_px = 0.5 / 60 * np.abs(normal[:2]).sum() / (ray @ normal) * truth
    assert np.all(np.abs(depth.depth_m[row, column] - truth) <= half_px + 1e-4)
    assert np.array_equal(depth.frame >= 0, depth.depth_m > 0)
    assert np.all(depth.frame[depth.depth_m > 0] == KEY)


def test_image_edges_and_points_behind_the_camera():
    camera = make_camera(width=10, height=6)
    uv = [(-0.4, 0), (9.4, 1), (9.6, 2), (-0.6, 3), (9.5, 4), (4, -0.49), (5, 5.49), (5, 5.51)]
    points = at_pixel(camera, [u for u, _ in uv], [v for _, v in uv], 5.0)
    behind = [[0, 0, -5.0], [0, 0, 0.0], [0, 0, 0.09]]
    depth = project(make_cloud(np.vstack([points, behind])), camera, np.eye(4), PLAIN, KEY)
    row, column = np.nonzero(depth.depth_m)
    assert set(zip(column.tolist(), row.tolist(), strict=True)) == {(0, 0), (9, 1), (4, 0), (5, 5)}
    assert np.all(depth.depth_m[row, column] == 5)


def test_empty_cloud_gives_an_empty_map():
    depth = project(make_cloud([]), make_camera(), np.eye(4), ProjectSettings(), KEY)
    assert not depth.depth_m.any() and not depth.filled_m.any() and not depth.confidence.any()
    assert (depth.frame == -1).all()
    assert depth.depth_m.shape == (48, 64)
    types = [depth.depth_m.dtype, depth.filled_m.dtype, depth.confidence.dtype, depth.frame.dtype]
    assert types == [np.float32, np.float32, np.float32, np.int32]


# --- lens -----------------------------------------------------------------------------------------

LENSES = [
    (-0.3, 0.1, 1e-3, -5e-4),
    (-0.37, 0.19, 9e-4, 1e-3, -0.06),
    (0.4, -0.2, 5e-4, 1e-3, 0.02, 0.7, -0.1, 0.05),
    (-0.3, 0.1, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.0, 1e-3, -2e-3, 5e-4, 1e-3),
]


@pytest.mark.parametrize("lens", LENSES, ids=len)
def test_distortion_equals_opencv(lens):
    camera = make_camera(distortion=lens)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (500, 2)), np.ones(500)])
    points *= rng.uniform(0.5, 80, (500, 1))
    uv, _ = image_points(camera, points)
    truth, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array(lens))
    np.testing.assert_allclose(uv, truth[:, 0], atol=1e-9)


def test_far_off_axis_points_do_not_fold_back_into_the_image():
    k1, k2 = -0.3, 0.0
    camera = make_camera(distortion=(k1, k2, 0, 0))
    limit = np.sqrt(-1 / (3 * k1))  # d/dr (r + k1 r^3) = 0
    radius = np.array([0.0, 0.2, limit - 1e-6, limit + 1e-6, np.sqrt(-1 / k1), 3.0])
    points = np.column_stack([radius, np.zeros(6), np.ones(6)])
    folded, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.K, np.array([k1, k2, 0, 0])
    )
    assert 0 < folded[4, 0, 0] < camera.width_px  # OpenCV alone would paint it
    uv, seen = image_points(make_camera(width=100, distortion=(k1, k2, 0, 0)), points)
    assert np.isfinite(uv[:, 0]).tolist() == [True, True, True, False, False, False]
    assert seen.tolist() == [True, True, True, False, False, False]


def test_field_of_view_ends_before_a_pole_of_the_rational_model():
    # 1 / (1 - r^2/4): grows towards the pole at r = 2 and is negative beyond
    camera = make_camera(width=4000, height=4000, distortion=(0, 0, 0, 0, 0, -0.25, 0, 0))
    points = np.array([[1.9, 0, 1.0], [2.1, 0, 1.0], [5.0, 0, 1.0]])
    assert image_points(camera, points)[1].tolist() == [True, False, False]


@pytest.mark.parametrize("lens", [(0.1,), (0.1,) * 6, (np.nan,) * 4], ids=["one", "six", "nan"])
def test_bad_distortion_is_named(lens):
    with pytest.raises(InputError, match="camera cam: distortion: expected 0, 4, 5, 8 or 12"):
        image_points(make_camera(distortion=lens), np.ones((1, 3)))


# --- which point wins a pixel ---------------------------------------------------------------------


def z_buffer_twin(cloud, camera):
    """One point at a time: least |frame - key|, then least depth, then least frame."""
    best = {}
    for p, frame, confidence in zip(cloud.points, cloud.frame, cloud.confidence, strict=True):
        if p[2] <= 0.1:
            continue
        u = int(np.rint(camera.K[0, 0] * p[0] / p[2] + camera.K[0, 2]))
        v = int(np.rint(camera.K[1, 1] * p[1] / p[2] + camera.K[1, 2]))
        if 0 <= u < camera.width_px and 0 <= v < camera.height_px:
            rank = (abs(int(frame) - KEY), float(np.float32(p[2])), int(frame), -float(confidence))
            best[v, u] = min(best.get((v, u), rank), rank)
    return best


def random_cloud(rng, num):
    points = rng.uniform([-6, -5, -2], [6, 5, 9], (num, 3))
    points[: num // 4] = points[num // 4 : 2 * (num // 4)]  # duplicates from other sweeps
    return make_cloud(points, rng.integers(KEY - 3, KEY + 4, num), rng.uniform(0.1, 1, num))


@given(st.integers(0, 2**32 - 1), st.integers(0, 400))
@settings(max_examples=25, deadline=None)
def test_pixels_equal_those_of_a_slow_twin(seed, num):
    cloud, camera = random_cloud(np.random.default_rng(seed), num), make_camera(24, 18, 20.0)
    depth = project(cloud, camera, np.eye(4), PLAIN, KEY)
    twin = z_buffer_twin(cloud, camera)
    assert set(zip(*np.nonzero(depth.depth_m), strict=True)) == set(twin)
    for pixel, (_, z, frame, confidence) in twin.items():
        assert depth.depth_m[pixel] == np.float32(z)
        assert depth.frame[pixel] == frame
        assert depth.confidence[pixel] == np.float32(-confidence)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_order_of_the_points_changes_no_byte(seed):
    rng = np.random.default_rng(seed)
    cloud, camera = random_cloud(rng, 600), make_camera(24, 18, 20.0)
    origins = {frame: rng.normal(size=3) for frame in range(KEY - 3, KEY + 4)}
    one = project(cloud, camera, np.eye(4), ProjectSettings(), KEY, origins)
    shuffled = take(cloud, rng.permutation(len(cloud)))
    other = project(shuffled, camera, np.eye(4), ProjectSettings(), KEY, origins)
    for name in ("depth_m", "filled_m", "confidence", "frame"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def test_nearest_in_time_wins_among_the_visible_only():
    camera = make_camera()
    point = at_pixel(camera, 30, 20, 10.0)
    # the key's own point is hidden behind a later sweep's; of 10.0 and 10.1 m the nearer in time
    points = np.vstack([point * 1.5, point, point * 1.01, point * 1.02])
    cloud = make_cloud(points, [KEY, KEY + 3, KEY - 2, KEY + 2])
    depth = project(cloud, camera, np.eye(4), ProjectSettings(), KEY)
    assert depth.depth_m[20, 30] == np.float32(10.1)
    assert depth.frame[20, 30] == KEY - 2


# --- visibility -----------------------------------------------------------------------------------


def see(camera, points_cam, frame, knobs, origins_cam=None):
    """`project` of points given in the camera's frame, the key frame having a lidar's axes."""
    T_key_cam = inverse(T_CAM_LIDAR)
    origins = None
    if origins_cam is not None:
        origins = {f: transform(T_key_cam, o[None])[0] for f, o in origins_cam.items()}
    cloud = make_cloud(transform(T_key_cam, points_cam), frame)
    return project(cloud, camera, T_CAM_LIDAR, knobs, KEY, origins)


def test_back_wall_does_not_shine_through_the_gaps_of_the_front_wall():
    """A front wall at 10 m, sampled more coarsely than pixels, hides the left half of another."""
    camera = make_camera(120, 90, 300.0)
    jitter = np.random.default_rng(2).uniform(-0.3, 0.3, (30, 30))
    v, u = np.mgrid[0:90:3, 0:60:2]
    front = at_pixel(camera, u + jitter, v, 10.0)
    back = on_every_pixel(camera, 20.0)
    points = np.vstack([front, back])
    frame = [KEY + 4] * len(front) + [KEY] * len(back)
    knobs = ProjectSettings(slack_m=0.05, footprint=0.4)
    depth = see(camera, points, frame, knobs)
    left, right = depth.depth_m[:88, :58], depth.depth_m[:, 62:]
    assert (left > 0).mean() > 0.1 and (left[left > 0] == 10).all()
    assert (right == 20).all()  # and nothing is lost beside it
    plain = see(camera, points, frame, PLAIN)
    assert (plain.depth_m[:88, :58] == 20).mean() > 0.5  # what the test removes


def test_patch_grows_with_the_source_range_and_slack():
    camera = make_camera(121, 91, 300.0)
    spot = at_pixel(camera, 60, 45, 10.0)
    back = on_every_pixel(camera, 20.0)  # measures the spacing: a pixel each way

    def hole(distance_m, slack_m):
        origins = {KEY: np.zeros(3), KEY + 1: spot[0] - [0, 0, distance_m]}
        knobs = ProjectSettings(footprint=1.0, slack_m=slack_m)
        frame = [KEY + 1] + [KEY] * len(back)
        depth = see(camera, np.vstack([spot, back]), frame, knobs, origins)
        rows, columns = np.nonzero(depth.depth_m != 20)
        assert depth.depth_m[45, 60] == 10
        return int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1

    assert hole(0.1, 0.0) == (1, 1)
    assert hole(0.1, 0.1) == (7, 7)  # 0.1 m at 10 m is 3 px
    assert hole(25.0, 0.0) == (5, 5)  # 25 m / 10 m times one pixel, each side
    assert hole(45.0, 0.0) == (9, 9)
    assert hole(1e6, 0.0) == (49, 49)  # it never hides the whole image


def test_slanted_ground_does_not_hide_itself():
    camera = make_camera(200, 100, 300.0)
    camera.K[1, 2] = 10.0  # the horizon near the top
    v, u = np.mgrid[16:100:2, 0:200:2]
    ground = at_pixel(camera, u, v, 300.0 * 1.6 / (v - 10.0))
    knobs = ProjectSettings(footprint=1.5, hidden_m=0.2, hidden_fraction=0.06)
    assert np.count_nonzero(see(camera, ground, KEY, knobs).depth_m) == len(ground)
    with pytest.MonkeyPatch.context() as patch:  # facing patches would
        patch.setattr("densify.stages.project._PLANE_RESIDUAL", 0.0)
        assert np.count_nonzero(see(camera, ground, KEY, knobs).depth_m) < 0.9 * len(ground)


def test_a_patch_is_never_nearer_than_its_point():
    """A wall coming nearer to the right does not hide the panel it would meet if it went on."""
    camera = make_camera(100, 60, 100.0)
    wall_v, wall_u = np.mgrid[0:60, 0:48]
    wall_z = 1 / (0.05 + 0.002 * wall_u)
    panel_v, panel_u = np.mgrid[0:60, 48:60]
    end_z = wall_z.min()
    panel = at_pixel(camera, panel_u, panel_v, end_z * 1.01)
    points = np.vstack([at_pixel(camera, wall_u, wall_v, wall_z), panel])
    knobs = ProjectSettings(footprint=3.0, slack_m=0.0, hidden_m=0.0, hidden_fraction=0.011)
    depth = see(camera, points, KEY, knobs)
    assert (depth.depth_m[:, 48:60] == np.float32(end_z * 1.01)).all()


def test_slanted_patches_are_painted_like_a_slow_twin():
    rng = np.random.default_rng(6)
    uv, inverse = rng.uniform([-0.4, -0.4], [19.4, 14.4], (40, 2)), rng.uniform(0.05, 0.3, 40)
    slope, half_px = rng.normal(0, 0.03, (40, 2)), rng.uniform(0.5, 4.0, (40, 2))
    truth = np.zeros((15, 20))
    for p, w, (su, sv), (hu, hv) in zip(uv, inverse, slope, half_px, strict=True):
        for v, u in np.ndindex(15, 20):
            if abs(u - p[0]) <= hu and abs(v - p[1]) <= hv:
                there = w + su * (u - p[0]) + sv * (v - p[1])
                truth[v, u] = max(truth[v, u], min(max(there, w / 2), w))
    np.testing.assert_allclose(_paint(uv, inverse, slope, half_px, (15, 20)), truth, rtol=1e-12)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_flat_patches_equal_a_slow_twin(seed):
    """Too few points for planes: rectangles of known size, painted one pixel at a time."""
    rng = np.random.default_rng(seed)
    camera = make_camera(40, 30, 50.0)
    uv = rng.uniform([-0.4, -0.4], [39.4, 29.4], (30, 2))
    z = rng.uniform(3, 30, 30)
    half = np.clip(50.0 * 0.3 / z, 0.5, None)
    nearest = np.full((30, 40), np.inf)
    for (u, v), depth, h in zip(uv, z, half, strict=True):
        for row in range(30):
            for column in range(40):
                if abs(column - u) <= h and abs(row - v) <= h:
                    nearest[row, column] = min(nearest[row, column], depth)
    row, column = np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)
    visible = z <= 0.2 + 1.06 * nearest[row, column]
    truth = np.zeros((30, 40))
    for i in np.flatnonzero(visible)[np.argsort(-z[visible])]:
        truth[row[i], column[i]] = z[i]
    knobs = ProjectSettings(footprint=0.0, slack_m=0.3, hidden_m=0.2, hidden_fraction=0.06)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("densify.stages.project._PLANE_RESIDUAL", 0.0)
        depth = see(camera, at_pixel(camera, uv[:, 0], uv[:, 1], z), KEY, knobs)
    np.testing.assert_allclose(depth.depth_m, truth, rtol=1e-6)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0.18, 0.42), (0.2, 1.33), (0.4, 2.0)])
def test_spacing_is_measured_on_the_sweep_nearest_the_key(azimuth_deg, elevation_deg):
    def sweep(azimuth_deg, elevation_deg, origin):
        turns, beams = np.arange(0, 90, azimuth_deg), np.arange(-16, 4, elevation_deg)
        az, el = (np.radians(a.ravel()) for a in np.meshgrid(turns, beams))
        # the lasers sit beside each other: a beam's elevation is not exactly constant
        el = el + np.radians(rng.uniform(-0.02, 0.02, len(el)))
        r = np.minimum(30.0, 1.7 / np.maximum(1e-3, -np.sin(el)))  # ground and a round wall
        ray = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=1)
        return origin + r[:, None] * ray

    rng = np.random.default_rng(7)
    origins = {KEY + 1: np.array([3.0, 1.0, 0.2]), KEY + 2: np.zeros(3)}
    one = sweep(azimuth_deg, elevation_deg, origins[KEY + 1])
    other = sweep(1.0, 1.0, origins[KEY + 2])
    cloud = make_cloud(np.vstack([other, one]), [KEY + 2] * len(other) + [KEY + 1] * len(one))
    camera = make_camera(focal=100.0)
    expected = 100 * np.radians([azimuth_deg, elevation_deg])
    np.testing.assert_allclose(_spacing_px(cloud, camera, KEY, origins), expected, rtol=0.1)


# --- fill -----------------------------------------------------------------------------------------


def ground_map(rng, share=0.4):
    v, u = np.mgrid[0:40, 0:50]
    depth = (1 / (0.02 + 0.002 * v + 0.0003 * u)).astype(np.float32)
    return depth, np.where(rng.uniform(size=depth.shape) < share, depth, 0).astype(np.float32)


def test_planes_are_linear_in_inverse_depth():
    _, sparse = ground_map(np.random.default_rng(3))
    planes = fit_planes(sparse, (2, 3))
    v, u = np.mgrid[0:40, 0:50]
    good = planes.num_px >= 8
    good[:3], good[-3:], good[:, :2], good[:, -2:] = False, False, False, False
    np.testing.assert_allclose(planes.slope_v[good], 0.002, rtol=1e-3)
    np.testing.assert_allclose(planes.slope_u[good], 0.0003, rtol=1e-2)
    truth = 0.02 + 0.002 * v + 0.0003 * u
    np.testing.assert_allclose(planes.centre[good], truth[good], rtol=1e-4)
    assert planes.residual[good].max() < 1e-5


def test_fill_of_a_plane_is_exact_and_keeps_what_was_measured():
    depth, sparse = ground_map(np.random.default_rng(4))
    filled, confidence = fill_between(
        sparse, (sparse > 0) * np.float32(0.8), (2, 3), 0.3, 0.06, 0.5
    )
    measured = sparse > 0
    assert np.array_equal(filled[measured], sparse[measured])
    added = (filled > 0) & ~measured
    assert added.sum() > 0.9 * (~measured[4:-4, 4:-4]).sum()
    # held within what was measured around it, a filled pixel can be off by a few pixels' worth
    assert np.median(np.abs(filled[added] / depth[added] - 1)) < 1e-3
    assert np.abs(filled[added] / depth[added] - 1).max() < 0.1
    assert np.allclose(confidence[added], 0.4) and np.allclose(confidence[measured], 0.8)


def two_sided_twin(measured, reach_u, reach_v):
    result = np.zeros(measured.shape, bool)
    for v, u in zip(*np.nonzero(~measured), strict=True):
        around = [
            (q - u, p - v)
            for p in range(max(0, v - reach_v), min(len(measured), v + reach_v + 1))
            for q in range(max(0, u - reach_u), min(measured.shape[1], u + reach_u + 1))
            if measured[p, q]
        ]
        du, dv = {d for d, _ in around}, {d for _, d in around}
        result[v, u] = min(du, default=0) < 0 < max(du, default=0) and (
            min(dv, default=0) < 0 < max(dv, default=0)
        )
    return result


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.6), st.sampled_from([(2, 3), (1, 1), (3, 1)]))
@settings(max_examples=25, deadline=None)
def test_two_sided_rule_equals_a_slow_twin(seed, share, reach):
    measured = np.random.default_rng(seed).uniform(size=(20, 25)) < share
    depth = measured.astype(np.float32) * 7
    filled, confidence = fill_between(depth, depth / 7, reach, 0.3, 0.06, 0.5)
    assert np.array_equal((filled > 0) & ~measured, two_sided_twin(measured, *reach))
    assert np.allclose(filled[filled > 0], 7)
    assert np.array_equal(confidence > 0, filled > 0)


def test_nothing_is_filled_outside_the_measured_block():
    depth = np.zeros((30, 30), np.float32)
    depth[10:20:2, 10:20:2] = 5
    filled, _ = fill_between(depth, (depth > 0) * np.float32(1), (2, 3), 0.3, 0.06, 0.5)
    row, column = np.nonzero(filled)
    assert (row.min(), row.max(), column.min(), column.max()) == (10, 18, 10, 18)


@pytest.mark.parametrize("step", [1.3, 2.0, 5.0])
def test_no_depth_is_invented_between_two_surfaces(step):
    rng = np.random.default_rng(5)
    depth = np.where(np.arange(40) < 20, 10.0, 10.0 * step) * np.ones((30, 1))
    sparse = np.where(rng.uniform(size=depth.shape) < 0.5, depth, 0).astype(np.float32)
    filled, _ = fill_between(sparse, (sparse > 0) * np.float32(1), (2, 3), 0.3, 0.06, 0.5)
    assert set(np.unique(np.round(filled, 3))) <= {0.0, 10.0, np.float32(10 * step)}
    assert (filled[5:25, 5:15] > 0).mean() > 0.95


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_filled_depth_and_confidence_stay_within_those_around(seed):
    rng = np.random.default_rng(seed)
    depth = (rng.uniform(4, 6, (16, 20)) * (rng.uniform(size=(16, 20)) < 0.2)).astype(np.float32)
    given_confidence = (rng.uniform(0.2, 1, depth.shape) * (depth > 0)).astype(np.float32)
    filled, confidence = fill_between(depth, given_confidence, (2, 3), 3.0, 0.06, 0.5)
    for v, u in zip(*np.nonzero((depth == 0) & (filled > 0)), strict=True):
        window = np.s_[max(0, v - 3) : v + 4, max(0, u - 2) : u + 3]
        around = depth[window][depth[window] > 0]
        assert around.min() * 0.999 <= filled[v, u] <= around.max() * 1.001
        assert 0 < confidence[v, u] <= 0.5 * given_confidence[window].max()


def test_confidence_is_the_points_own_and_never_zero_where_there_is_depth():
    camera = make_camera()
    points = transform(inverse(T_CAM_LIDAR), on_every_pixel(camera, 6.0, step=2))
    own = np.where(np.arange(len(points)) % 2, 0.6, 0.0)
    knobs = ProjectSettings(fill_reach=1.0)
    depth = project(make_cloud(points, KEY, own), camera, T_CAM_LIDAR, knobs, KEY)
    assert np.array_equal(depth.confidence > 0, depth.filled_m > 0)
    assert (depth.filled_m > 0).sum() > 3 * (depth.depth_m > 0).sum()
    measured = depth.confidence[depth.depth_m > 0]
    assert set(np.unique(measured)) == {np.float32(1 / 255), np.float32(0.6)}


# --- real -----------------------------------------------------------------------------------------


def kitti_calibration(path):
    rows = (line.partition(":") for line in path.read_text().splitlines())
    return {name: text.split() for name, _, text in rows}


def test_real_sweep_hides_what_its_camera_cannot_see():
    data = os.environ.get("DENSIFY_TEST_DATA")
    if not data:
        pytest.skip("DENSIFY_TEST_DATA is not set")
    day = Path(data) / "kitti/2011_09_26"
    camera_text = kitti_calibration(day / "calib_cam_to_cam.txt")
    lidar_text = kitti_calibration(day / "calib_velo_to_cam.txt")
    P = np.array(camera_text["P_rect_02"], float).reshape(3, 4)
    T_cam_lidar, T_rect = np.eye(4), np.eye(4)
    T_cam_lidar[:3, :3] = np.array(lidar_text["R"], float).reshape(3, 3)
    T_cam_lidar[:3, 3] = np.array(lidar_text["T"], float)
    T_rect[:3, :3] = np.array(camera_text["R_rect_00"], float).reshape(3, 3)
    T_rect[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    T_cam_lidar = T_rect @ T_cam_lidar
    camera = Camera("image_02", 1242, 375, P[:, :3], T_cam_lidar)
    sweep = day / "2011_09_26_drive_0013_sync/velodyne_points/data/0000000120.bin"
    points = np.fromfile(sweep, np.float32).reshape(-1, 4)[:, :3].astype(float)
    cloud = make_cloud(points[np.linalg.norm(points, axis=1) > 3])

    plain = project(cloud, camera, T_cam_lidar, PLAIN, KEY)
    depth = project(cloud, camera, T_cam_lidar, ProjectSettings(), KEY)
    measured = depth.depth_m > 0
    # the scanner sits above the camera, so a little of what it sees is hidden, and only a little
    assert 0.9 < measured.sum() / (plain.depth_m > 0).sum() < 1.0
    assert 0.035 < measured.mean() < 0.045
    assert 2.5 < (depth.filled_m > 0).sum() / measured.sum() < 5
    # every depth is a real point's, seen back in its pixel
    row, column = np.nonzero(measured)
    z = depth.depth_m[row, column].astype(float)
    back = transform(inverse(T_cam_lidar), at_pixel(camera, column, row, z))
    from scipy.spatial import cKDTree

    assert (cKDTree(cloud.points).query(back)[0] < 0.001 * z + 0.001).all()
