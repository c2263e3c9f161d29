# SPDX-License-Identifier: MIT
"""Depth scores against numbers worked out by hand and against slow twins."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.geometry.types import DepthMap
from densify.scores.metrics import (
    DepthErrors,
    depth_edges,
    depth_errors,
    depth_scores,
    mean_errors,
)
from tests.depth_scenes import make_camera


def image(values):
    return np.array([values], np.float32)


def test_kittis_baseline_is_the_default():
    # 620 * 0.54 = 334.8: 3.04 px off; 600 * 0.54 = 324: 2.95 px off
    for focal_px, share in ((620.0, 1), (600.0, 0)):
        assert depth_errors(image([11.0]), image([10.0]), focal_px=focal_px).outliers == share


def test_depth_scores_split_measured_filled_moving_static():
    truth, moving = image([10.0] * 4), np.array([[True, True, False, False]])
    measured_m, filled_m = image([12.0, 0, 10.0, 0]), image([12.0, 14.0, 10.0, 0])
    depth = DepthMap("cam", measured_m, filled_m, image([1, 0.5, 1, 0]), np.zeros((1, 4), np.int32))
    camera = make_camera(4, 1, 700.0)
    scores = depth_scores(depth, truth, moving, camera)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    mae_m = {
        product: {group: errors["mae_m"] for group, errors in groups.items()}
        for product, groups in scores.items()
    }
    assert mae_m == {
        "measured": {"all": 1.0, "moving": 2.0, "static": 0.0},
        "filled": {"all": 2.0, "moving": 3.0, "static": 0.0},
    }
    assert scores["measured"]["moving"]["coverage"] == 0.5
    assert scores["filled"]["moving"]["outliers"] == 1.0
    nothing = depth_scores(depth, truth, moving & False, camera)["filled"]["moving"]
    assert nothing["num_pixels"] == 0 and nothing["coverage"] is None


depth_lists = st.lists(
    st.tuples(*[st.just(0.0) | st.floats(0.5, 200.0, width=32)] * 2), min_size=1, max_size=30
)


def slow_errors(pixels, fb):
    """The kit's loop, pixel by pixel, over (predicted, true) that both exist."""
    sums = dict.fromkeys([f.name for f in fields(DepthErrors)][3:], 0.0)
    for z, t in pixels:
        inverse_per_km = abs(1 / t - 1 / z) * 1000
        off_px = abs(fb / z - fb / t)
        sums["mae_m"] += abs(t - z)
        sums["rmse_m"] += (t - z) ** 2
        sums["imae_per_km"] += inverse_per_km
        sums["irmse_per_km"] += inverse_per_km**2
        sums["abs_rel"] += abs(t - z) / t
        sums["sq_rel"] += (t - z) ** 2 / (t * t)
        for n in (1, 2, 3):
            sums[f"delta_{n}"] += max(z / t, t / z) < 1.25**n
        sums["outliers"] += off_px > 3 and off_px > 0.05 * fb / t
        sums["outliers_1_px"] += off_px > 1
    means = {name: total / len(pixels) for name, total in sums.items()}
    for name in ("rmse_m", "irmse_per_km"):
        means[name] = math.sqrt(means[name])
    logs = [math.log(z / t) for z, t in pixels]
    mean = sum(logs) / len(logs)
    means["silog"] = math.sqrt(sum((log - mean) ** 2 for log in logs) / len(logs))
    return means


@given(depth_lists)
@settings(deadline=None, max_examples=60)
def test_lists_and_maps_agree_with_the_slow_twin(pixels):
    predicted, truth = np.array(pixels, np.float32).T
    errors = depth_errors(predicted, truth, focal_px=700.0, baseline_m=0.5)
    assert errors == depth_errors(predicted[None], truth[None], focal_px=700.0, baseline_m=0.5)
    both = [(z, t) for z, t in pixels if z > 0 and t > 0]
    assert errors.num_pixels == sum(t > 0 for _, t in pixels)
    assert errors.num_compared == len(both)
    values = asdict(errors)
    if both:
        for name, expected in slow_errors(both, 350.0).items():
            assert values[name] == pytest.approx(expected, rel=1e-9, abs=1e-12), name
    else:
        assert all(value is None for value in list(values.values())[3:])


def slow_edges(truth, fb, reach=3):
    edges = np.zeros(truth.shape, bool)
    height, width = truth.shape
    for v, u in np.argwhere(truth > 0):
        d = fb / truth[v, u]
        for row in range(max(0, v - reach), min(height, v + reach + 1)):
            for column in range(max(0, u - reach), min(width, u + reach + 1)):
                if truth[row, column] > 0:
                    off_px = abs(fb / truth[row, column] - d)
                    edges[v, u] |= off_px > 3 and off_px > 0.05 * d
    return edges


@pytest.mark.parametrize("density", [1.0, 0.3])
def test_depth_edges_agree_with_the_slow_twin(density):
    rng = np.random.default_rng(3)
    truth = np.full((30, 40), 30.0, np.float32)
    truth[8:20, 10:25] = 12.0
    truth[25:, :] = 4.0
    truth *= rng.uniform(0.97, 1.03, truth.shape)
    truth[rng.random(truth.shape) > density] = 0
    edges = depth_edges(truth, focal_px=700.0, baseline_m=0.5)
    assert np.array_equal(edges, slow_edges(truth.astype(float), 350.0))
    assert 0.1 < edges[truth > 0].mean() < 0.9


def test_means_are_over_images_not_pixels():
    few = depth_errors(image([12.0]), image([10.0]), focal_px=700.0)
    many = depth_errors(image([10.0] * 9 + [0.0]), image([10.0] * 10), focal_px=700.0)
    empty = depth_errors(image([0.0]), image([10.0]), focal_px=700.0)
    no_truth = depth_errors(image([5.0]), image([0.0]), focal_px=700.0)
    mean = mean_errors([few, many, empty, no_truth])
    assert (mean.num_pixels, mean.num_compared) == (12, 10)
    assert mean.mae_m == pytest.approx(1.0) and mean.rmse_m == pytest.approx(1.0)
    assert mean.outliers == pytest.approx(0.5) and mean.delta_1 == 1
    assert mean.coverage == pytest.approx((1 + 0.9 + 0) / 3)
    assert mean_errors([few]) == few
    assert mean_errors([empty]) == empty
