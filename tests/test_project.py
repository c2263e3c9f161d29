# SPDX-License-Identifier: MIT
"""Projection and visibility: analytic scenes and slow twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from densify.config import ProjectSettings
from densify.depth.exposure import Exposure
from densify.depth.patches import paint
from densify.geometry.types import Patches, Reason
from tests.depth_scenes import KEY, at_pixel, depth_map, make_camera, make_cloud, view

PLAIN = ProjectSettings(visibility=False)
SWEEPS = range(KEY - 4, KEY + 5)


def z_buffer_twin(cloud, camera):
    """One point at a time: least depth, then least frame."""
    best = {}
    for p, frame, confidence in zip(cloud.points, cloud.frame, cloud.confidence, strict=True):
        if p[2] <= 0.1:
            continue
        u, v = np.rint((camera.K @ p)[:2] / p[2]).astype(int).tolist()
        if 0 <= u < camera.width_px and 0 <= v < camera.height_px:
            rank = (float(np.float32(p[2])), int(frame), -float(confidence))
            best[v, u] = min(best.get((v, u), rank), rank)
    return best


def random_cloud(rng, num):
    points = rng.uniform([-6, -5, -2], [6, 5, 9], (num, 3))
    points[: num // 4] = points[num // 4 : 2 * (num // 4)]  # duplicates from other sweeps
    frame = rng.integers(KEY - 3, KEY + 4, num)
    return make_cloud(points, frame, 1 / (1 + np.abs(frame - KEY)))


@given(st.integers(0, 2**32 - 1), st.integers(0, 400))
@settings(max_examples=25, deadline=None)
def test_without_visibility_pixels_equal_those_of_a_slow_twin(seed, num):
    cloud, camera = random_cloud(np.random.default_rng(seed), num), make_camera(24, 18, 20.0)
    depth = view(cloud, camera, np.eye(4), PLAIN)
    twin = z_buffer_twin(cloud, camera)
    assert set(zip(*np.nonzero(depth.depth_m), strict=True)) == set(twin)
    assert (depth.reason == Reason.KEPT).sum() == len(twin)
    for pixel, (z, frame, confidence) in twin.items():
        assert depth.depth_m[pixel] == np.float32(z)
        assert depth.frame[pixel] == frame
        assert depth.confidence[pixel] == np.float32(-confidence)


@given(st.integers(0, 2**32 - 1))
@example(9816)  # a point measured twice
@settings(max_examples=15, deadline=None)
def test_order_of_the_points_changes_no_byte(seed):
    rng = np.random.default_rng(seed)
    cloud, camera = random_cloud(rng, 600), make_camera(24, 18, 20.0)
    origins = {frame: rng.normal(size=(1, 3)) for frame in range(KEY - 3, KEY + 4)}
    knobs = ProjectSettings(rims="keep")
    one = view(cloud, camera, np.eye(4), knobs, origins)
    order = rng.permutation(len(cloud))
    other = view(cloud.select(order), camera, np.eye(4), knobs, origins)
    assert (one.depth_m > 0).any()
    for name in ("depth_m", "filled_m", "confidence", "frame"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    assert (one.reason[order] == other.reason).mean() > 0.95  # equal points may change places


def see(camera, points_cam, frame, settings=None, spacing_px=(1.0, 1.0), **columns):
    """The map of points in the camera's frame, which is the key's, with patches as given.

    columns: ``normal`` of the patches, which face the camera without it, ``filled``, and columns of
    the cloud.
    """
    points_cam = np.asarray(points_cam, float).reshape(-1, 3)
    normal = columns.pop("normal", np.broadcast_to([0, 0, 1.0], points_cam.shape))
    filled = columns.pop("filled", True)
    spacing_m = np.asarray(spacing_px, float) * points_cam[:, 2:] / camera.K[0, 0]
    cloud = replace(make_cloud(points_cam, frame), **columns)
    surface = Patches(np.array(normal, np.float32), np.array(spacing_m, np.float32))
    return depth_map(cloud, Exposure(camera, np.eye(4)), surface, settings, filled=filled)


def on_every_pixel(camera, z, step=1):
    v, u = np.mgrid[0 : camera.height_px : step, 0 : camera.width_px : step]
    return at_pixel(camera, u, v, z)


def test_back_wall_does_not_shine_through_the_gaps_of_the_front_wall():
    """A front wall at 10 m, sampled more coarsely than pixels, hides the left half of another."""
    camera = make_camera(120, 90, 300.0)
    v, u = np.mgrid[0:90:3, 0:60:2]
    front, back = at_pixel(camera, u, v, 10.0), on_every_pixel(camera, 20.0)
    points = np.vstack([front, back])
    frame = [KEY + 4] * len(front) + [KEY] * len(back)
    spacing = np.vstack([np.tile([2.0, 3.0], (len(front), 1)), np.ones((len(back), 2))])
    depth = see(camera, points, frame, None, spacing)
    left, right = depth.depth_m[:88, :58], depth.depth_m[:, 62:]
    assert not (left > 15).any()
    np.testing.assert_allclose(right, 20, rtol=1e-6)  # and nothing is lost beside it
    assert (depth.reason[len(front) :] == Reason.HIDDEN).sum() > 58 * 88
    plain = see(camera, points, frame, PLAIN, spacing)
    assert (plain.depth_m[:88, :58] == 20).mean() > 0.5  # what the test removes


def test_slanted_ground_does_not_hide_itself():
    camera = make_camera(200, 100, 300.0)
    camera.K[1, 2] = 10.0  # the horizon near the top
    v, u = np.mgrid[16:100:2, 0:200:2]
    ground = at_pixel(camera, u, v, 300.0 * 1.6 / (v - 10.0))
    up = np.tile([0, 1.0, 0], (len(ground), 1))
    tilted = see(camera, ground, KEY, None, (8.0, 8.0), normal=up)
    assert (tilted.reason == Reason.KEPT).all()
    assert (see(camera, ground, KEY, None, (8.0, 8.0)).reason == Reason.HIDDEN).mean() > 0.1


def test_patches_are_painted_like_a_slow_twin():
    rng = np.random.default_rng(6)
    uv, inverse = rng.uniform([-0.4, -0.4], [19.4, 14.4], (40, 2)), rng.uniform(0.05, 0.3, 40)
    slope, half_px = rng.normal(0, 0.03, (40, 2)), rng.uniform(0.5, 4.0, (40, 2))
    truth = np.zeros((15, 20))
    for p, w, (su, sv), (hu, hv) in zip(uv, inverse, slope, half_px, strict=True):
        for v, u in np.ndindex(15, 20):
            if abs(u - p[0]) <= hu and abs(v - p[1]) <= hv:
                there = w + su * (u - p[0]) + sv * (v - p[1])
                truth[v, u] = max(truth[v, u], min(max(there, w / 2), w))
    canvas = np.zeros((15, 20), np.float32)
    paint(uv, inverse, slope, half_px, canvas)
    np.testing.assert_allclose(canvas, truth, rtol=1e-6)


def wall(camera, z, frames, noise_m=0.0, step=2):
    """A wall seen by several sweeps, each on its own grid of pixels."""
    rng = np.random.default_rng(9)
    parts = []
    for k in range(len(frames)):
        v, u = np.mgrid[k % step : camera.height_px : step, k % step : camera.width_px : step]
        parts.append(at_pixel(camera, u, v, z + noise_m * rng.normal(size=u.shape)))
    return np.vstack(parts), np.repeat(frames, [len(part) for part in parts])


def test_depth_is_the_planes_in_the_middle_of_the_pixel():
    """Of points anywhere in their pixels on a slanted plane: exact, where a point's own is not."""
    camera = make_camera(80, 60, 100.0)
    rng = np.random.default_rng(10)
    n = np.array([0.5, 1.2, 0.4])  # inverse depth is n · ray
    uv = rng.uniform([0, 0], [79, 59], (9000, 2))
    ray = at_pixel(camera, uv[:, 0], uv[:, 1], 1.0)
    keep = ray @ n > 0.05
    points = (ray / (ray @ n)[:, None])[keep]
    frame = rng.choice(SWEEPS, len(points))
    normal = np.tile(n, (len(points), 1))
    depth = see(camera, points, frame, None, (2.0, 2.0), normal=normal, filled=False).depth_m
    row, column = np.nonzero(depth)
    truth = 1 / (at_pixel(camera, column, row, 1.0) @ n)
    assert len(row) > 1500
    np.testing.assert_allclose(depth[row, column], truth, rtol=1e-5)


def test_nearest_in_time_wins_among_the_visible_only():
    camera = make_camera()
    points, frame = wall(camera, 10.0, SWEEPS)
    spot = at_pixel(camera, 30, 20, 10.0)
    here = np.linalg.norm(points[:, :2] / points[:, 2:] - spot[0, :2] / 10, axis=1) < 1e-6
    points, frame = points[~here], frame[~here]
    # the key's own point is hidden; of 10.08 and 10 m the one nearer in time, here the farther
    points = np.vstack([points, spot * 1.5, spot, spot * 1.008, spot * 1.009])
    frame = np.append(frame, [KEY, KEY + 3, KEY - 2, KEY + 2])
    depth = see(camera, points, frame, None, (2.0, 2.0))
    assert depth.frame[20, 30] == KEY - 2
    chosen = [Reason.HIDDEN, Reason.NOT_CHOSEN, Reason.KEPT, Reason.NOT_CHOSEN]
    assert depth.reason[-4:].tolist() == chosen


@pytest.mark.parametrize(
    ("since_key_ms", "winner"),
    [([210, -40], KEY - 3), ([-40, 210], KEY + 1), ([103, -105], KEY - 3), ([103, -140], KEY + 1)],
)
def test_stamps_not_numbers_say_which_sweep_is_nearest_in_time(since_key_ms, winner):
    """And where they differ by a jitter, the nearer surface wins."""
    camera = make_camera()
    points, frame = wall(camera, 10.0, [KEY + 1, KEY - 3], step=1)
    ray = at_pixel(camera, 30, 20, 1.0)
    there = (np.abs(points / points[0, 2] - ray) < 1e-6).all(1) & (frame == KEY + 1)
    points[there] *= 1.008
    since_key_ns = np.where(frame == KEY + 1, *since_key_ms) * 1_000_000
    depth = see(camera, points, frame, since_key_ns=since_key_ns)
    assert depth.frame[20, 30] == winner


def test_of_the_sweeps_with_rays_there_the_one_nearest_to_the_key_vouches():
    camera = make_camera(60, 40)

    def kept(frames, key_sees_m=None):
        points, frame = wall(camera, 10.0, frames)
        num = len(points)
        if key_sees_m is not None:
            seen, by_key = wall(camera, key_sees_m, [KEY])
            points, frame = np.vstack([points, seen]), np.append(frame, by_key)
        depth = see(camera, points, frame, None, (2.0, 2.0))
        return (depth.reason[:num] == Reason.KEPT).any()

    others = [KEY + 1, KEY + 2, KEY + 3, KEY + 4]
    assert kept([KEY, KEY + 1]) and kept([KEY])
    assert kept(others) and kept(others, 10.0)  # lost packets of the key sweep are no evidence
    assert not kept(others, 10.5)  # what it measured behind the wall is


def test_no_point_is_believed_at_the_edge_of_its_surface():
    """A panel before a wall: its outline is as wide as the beams, its inside stays."""
    camera = make_camera(120, 90, 300.0)
    back, back_frame = wall(camera, 20.0, SWEEPS)
    front, front_frame = wall(camera, 10.0, SWEEPS)
    u = np.rint(front[:, 0] / front[:, 2] * 300 + camera.K[0, 2])
    panel = (u >= 40) & (u < 80)
    points = np.vstack([front[panel], back])
    frame = np.concatenate([front_frame[panel], back_frame])
    depth = see(camera, points, frame, None, (6.0, 6.0), filled=False)
    fat = see(camera, points, frame, ProjectSettings(rims="keep"), (6.0, 6.0), filled=False)
    # 0.35 spacings and 0.015 m from the edge
    for maps, ends in ((depth, (43, 76)), (fat, (40, 79))):
        columns = np.flatnonzero((np.abs(maps.depth_m - 10) < 1)[20:70].any(axis=0))
        assert (columns.min(), columns.max()) == ends
    reasons = {Reason.KEPT, Reason.NOT_CHOSEN, Reason.EDGE}
    assert set(np.unique(depth.reason[: panel.sum()])) == reasons


def test_threads_change_no_byte():
    camera = make_camera(400, 300, 300.0)  # enough pixels for two threads
    points, frame = wall(camera, 10.0, SWEEPS, noise_m=0.05)

    def maps():
        depth = see(camera, points, frame, None, (2.0, 2.0))
        return depth.depth_m.tobytes() + depth.filled_m.tobytes() + depth.confidence.tobytes()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("numba.config.NUMBA_NUM_THREADS", 1)
        one = maps()
        patch.setattr("numba.config.NUMBA_NUM_THREADS", 2)
        assert maps() == one
