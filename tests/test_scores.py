# SPDX-License-Identifier: MIT
"""Scores against numbers worked out by hand, and ghosts that were planted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from densify.errors import InputError
from densify.range_image import RangeImage
from densify.scores import (
    depth_errors,
    depth_scores,
    ghost_rate,
    ghost_scores,
    image_density,
)
from densify.types import Camera, Cloud, DepthMap, RegisteredSweep, Sweep

KEY = 7


def image(values):
    return np.array([values], np.float32)


def test_depth_errors_by_hand():
    # f B = 700 * 0.5 = 350
    truth = image([10.0, 10.0, 50.0, 50.0, 5.0, 0.0, 20.0])
    found = image([11.0, 10.5, 52.0, 80.0, 5.0, 9.0, 0.0])
    # disparities: 35 -> 31.8 (3.2 px, 9 %: wrong); 35 -> 33.3 (1.7 px); 7 -> 6.73;
    # 7 -> 4.375 (2.6 px, 38 %: not wrong, both limits count); exact; no truth; not covered
    errors = depth_errors(found, truth, focal_px=700.0, baseline_m=0.5)
    assert errors.num_pixels == 6 and errors.num_compared == 5
    assert errors.coverage == pytest.approx(5 / 6)
    assert errors.mae_m == pytest.approx((1 + 0.5 + 2 + 30 + 0) / 5)
    assert errors.rmse_m == pytest.approx(np.sqrt((1 + 0.25 + 4 + 900) / 5))
    assert errors.outliers == pytest.approx(1 / 5)


def test_outliers_need_five_percent_too():
    # f B = 3500: d = 700 -> 696.5 at 5.025 m is 3.5 px but half a percent
    truth, found = image([5.0]), image([5.025])
    assert depth_errors(found, truth, focal_px=3500.0, baseline_m=1.0).outliers == 0
    # d = 35, 38.1 and 31.9: 3.1 px and 9 %; 37.9: 2.9 px
    truth, found = image([100.0] * 3), image([3500 / 38.1, 3500 / 31.9, 3500 / 37.9])
    assert depth_errors(found, truth, focal_px=3500.0, baseline_m=1.0).outliers == pytest.approx(
        2 / 3
    )


def test_five_percent_are_of_the_true_disparity():
    # d = 100: 105.1 is 5.1 px off, more than 5 % of 100 and less than 5 % of itself
    errors = depth_errors(image([1000 / 105.1]), image([10.0]), focal_px=1000.0, baseline_m=1.0)
    assert errors.outliers == 1


def test_kittis_baseline_is_the_default():
    truth, found = image([10.0]), image([11.0])
    # 100 * 0.54 / 10 = 5.4 px: 0.49 px off
    assert depth_errors(found, truth, focal_px=100.0).outliers == 0
    # 620 * 0.54 = 334.8: 3.04 px off; 600 * 0.54 = 324: 2.95 px off
    assert depth_errors(found, truth, focal_px=620.0).outliers == 1
    assert depth_errors(found, truth, focal_px=600.0).outliers == 0


def test_nothing_to_compare_is_none_not_nan():
    empty = np.zeros((2, 3), np.float32)
    errors = depth_errors(empty, empty, focal_px=700.0)
    assert (errors.num_pixels, errors.coverage, errors.mae_m) == (0, None, None)
    errors = depth_errors(empty, empty + 1, focal_px=700.0)
    assert (errors.num_pixels, errors.coverage, errors.mae_m, errors.outliers) == (6, 0, None, None)
    assert errors.rmse_m is None


def test_depth_errors_names_a_wrong_shape():
    a, b = np.ones((2, 3), np.float32), np.ones((3, 2), np.float32)
    with pytest.raises(InputError, match=r"truth: expected .* \(2, 3\), got \(3, 2\)"):
        depth_errors(a, b, focal_px=700.0)
    with pytest.raises(InputError, match="mask"):
        depth_errors(a, a, b > 0, focal_px=700.0)


def test_image_density():
    assert image_density(image([0, 1, 2, 0])) == 0.5
    assert image_density(image([])) == 0


def test_depth_scores_split_measured_filled_moving_static():
    truth = image([10.0, 10.0, 10.0, 10.0])
    moving = np.array([[True, True, False, False]])
    depth = DepthMap(
        camera="cam",
        depth_m=image([12.0, 0, 10.0, 0]),
        filled_m=image([12.0, 14.0, 10.0, 0]),
        confidence=image([1, 0.5, 1, 0]),
        frame=np.array([[KEY, -1, KEY, -1]], np.int32),
    )
    camera = Camera("cam", 4, 1, np.diag([700.0, 700, 1]), np.eye(4))
    scores = depth_scores(depth, truth, moving, camera)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    mae = {(p, m): scores[p][m]["mae_m"] for p in scores for m in scores[p]}
    assert mae == {
        ("measured", "all"): 1.0,
        ("measured", "moving"): 2.0,
        ("measured", "static"): 0.0,
        ("filled", "all"): 2.0,
        ("filled", "moving"): 3.0,
        ("filled", "static"): 0.0,
    }
    assert scores["measured"]["moving"]["coverage"] == 0.5
    assert scores["filled"]["moving"]["coverage"] == 1.0
    assert scores["filled"]["moving"]["outliers"] == 1.0
    nothing = depth_scores(depth, truth, moving & False, camera)["filled"]["moving"]
    assert nothing["num_pixels"] == 0 and nothing["coverage"] is None


# --- ghosts ---------------------------------------------------------------------------------------


def room(range_m=20.0):
    """A key sweep standing in a sphere of ``range_m``: 0.5 x 1 degree steps."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-180, 180, 0.5)), np.radians(range(-15, 16))
    )
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    points = range_m * np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    n = len(points)
    sweep = Sweep(
        frame=KEY,
        stamp_ns=0,
        points=points,
        intensity=np.zeros(n, np.float32),
        offset_ns=None,
        lidar=np.zeros(n, np.uint8),
        row=np.arange(n),
    )
    return RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))


def cloud_of(*parts):
    """parts: (points, frame, moving)."""
    points = np.vstack([p for p, _, _ in parts])
    n = len(points)
    return Cloud(
        points=points,
        rigid_points=points,
        frame=np.concatenate([np.full(len(p), f, np.int32) for p, f, _ in parts]),
        row=np.arange(n),
        moving=np.concatenate([np.full(len(p), m) for p, _, m in parts]),
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.ones(n, np.float32),
        intensity=np.zeros(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
    )


def panel(distance_m, num=10):
    y, z = np.meshgrid(np.linspace(-1, 1, num), np.linspace(-1, 1, num))
    return np.column_stack([np.full(num * num, distance_m), y.ravel(), z.ravel()])


def test_a_planted_plane_is_all_ghosts_and_counts_over_the_other_sweeps_only():
    key = room()
    wall, seen = key.sweep.points, RangeImage.of(key)
    cloud = cloud_of((wall, KEY, False), (wall[::7], KEY - 1, False), (panel(10.0), KEY + 2, False))
    expected = 100 / (len(wall[::7]) + 100)
    assert ghost_rate(cloud, seen, KEY) == pytest.approx(expected)


def test_ghosts_need_the_margin():
    seen = RangeImage.of(room())
    rates = [ghost_rate(cloud_of((panel(d), KEY + 1, False)), seen, KEY) for d in (19.2, 20.5, 40)]
    assert rates == [1, 0, 0]
    # 2 % of 100 m counts beyond half a metre
    far = RangeImage.of(room(100.0))
    near_wall = cloud_of((panel(98.5), KEY + 1, False))
    before = cloud_of((panel(97.0), KEY + 1, False))
    assert ghost_rate(near_wall, far, KEY) == 0
    assert ghost_rate(before, far, KEY) == 1


def test_the_key_sweep_itself_and_an_unseen_direction_hold_no_ghosts():
    key = room()
    seen = RangeImage.of(key)
    assert ghost_rate(cloud_of((key.sweep.points, KEY + 1, False)), seen, KEY) == 0
    above = panel(1.0)[:, [1, 2, 0]] * [0.1, 0.1, 5.0]
    assert ghost_rate(cloud_of((above, KEY + 1, False)), seen, KEY) == 0
    assert ghost_rate(cloud_of((panel(10.0), KEY, False)), seen, KEY) is None


def test_ghost_scores_by_kind_and_distance():
    key = room()
    seen = RangeImage.of(key)
    cloud = cloud_of(
        (panel(10.0), KEY - 2, True),
        (panel(20.5), KEY + 2, True),
        (key.sweep.points, KEY + 1, False),
        (panel(10.0), KEY, False),
    )
    scores = ghost_scores(cloud, seen, KEY)
    n = len(key.sweep)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    assert scores == {
        "num_points": n + 200,
        "all": pytest.approx(100 / (n + 200)),
        "moving": 0.5,
        "static": 0.0,
        "by_distance": {"1": 0.0, "2": 0.5},
    }
