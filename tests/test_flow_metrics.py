# SPDX-License-Identifier: MIT
"""Flow metrics against numbers worked out by hand and slow twins written from the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.scores import flow_metrics as metrics

NOTHING = np.zeros((0, 3))


@pytest.fixture(scope="module")
def flows() -> tuple[np.ndarray, np.ndarray]:
    """Estimated and true flow of 500 points, a third of which stand still."""
    rng = np.random.default_rng(5)
    true = rng.normal(0, 1.0, (500, 3)) * rng.uniform(0, 1.5, (500, 1))
    true[::3] = 0.0
    return true + rng.normal(0, 0.1, true.shape) * rng.integers(0, 2, (500, 1)), true


def along_x(*lengths: float) -> np.ndarray:
    return np.array([[x, 0.0, 0.0] for x in lengths])


def test_end_point_error_by_hand():
    flow, true = np.array([[3.0, 4, 0], [1, 1, 1], [0, 0, 2]]), np.array([[0.0, 0, 0]] * 3)
    assert metrics.end_point_errors(flow, true).tolist() == pytest.approx([5, math.sqrt(3), 2])
    mask = np.array([True, False, True])
    assert metrics.end_point_error(flow, true, mask) == pytest.approx(3.5)
    assert metrics.end_point_error(flow, true) == pytest.approx((7 + math.sqrt(3)) / 3)


def test_accuracy_as_a_loop(flows):
    flow, true = flows
    for limit in (metrics.STRICT, metrics.RELAXED):
        good = 0
        for f, t in zip(flow, true, strict=True):
            off = math.dist(f, t)
            good += off < limit or (math.hypot(*t) > 0 and off / math.hypot(*t) < limit)
        assert metrics.accuracy(flow, true, limit) == pytest.approx(good / len(flow))


def test_angles_by_hand():
    flow = np.array([[1.0, 1, 0], [0, 0, 0], [-2, 0, 0], [5, 5, 5]])
    true = np.array([[1.0, 0, 0], [0, 3, 0], [1, 0, 0], [0, 0, 0]])
    # 45 degrees, nothing where something was, the wrong way, and no direction to compare with
    expected = (math.pi / 4 + math.pi / 2 + math.pi) / 3
    assert metrics.angle_error_rad(flow, true) == pytest.approx(expected)


def test_three_ways_weigh_the_same():
    flow, true = along_x(1.0, 0.2, 0.4, 0.01, 0.03, 7.0), along_x(0, 0, 0, 0, 0, 0)
    moving = np.array([1, 0, 0, 0, 0, 1], bool)
    foreground = np.array([1, 1, 1, 0, 0, 0], bool)  # the last moves without being an object
    error = metrics.three_way_error(flow, true, moving, foreground)
    assert error[:3] == pytest.approx((1.0, 0.3, 0.02))
    assert error.mean_m == pytest.approx(1.32 / 3)


def test_segmentation_by_hand():
    called, moving = np.array([1, 1, 1, 0, 0], bool), np.array([1, 1, 0, 1, 0], bool)
    assert metrics.share_found(called, moving) == pytest.approx(2 / 3)


def test_errors_by_hops():
    errors = metrics.errors_by_hops(along_x(1, 2, 6), along_x(0, 0, 0), np.array([1, 5, 5]))
    assert errors == {1: pytest.approx(1), 5: pytest.approx(4)}
    assert metrics.errors_by_hops(NOTHING, NOTHING, np.zeros(0, int)) == {}


# --- accumulated surfaces -------------------------------------------------------------------------


def plane(rng: np.random.Generator, num: int = 4000, sigma_m: float = 0.0) -> np.ndarray:
    """2 m x 1 m, tilted, with noise across."""
    points = np.column_stack([rng.uniform(0, 2, num), rng.uniform(0, 1, num), np.zeros(num)])
    points[:, 2] = sigma_m * rng.standard_normal(num)
    c, s = math.cos(0.7), math.sin(0.7)
    return points @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + [30.0, -5, 1]


def test_points_drawn_onto_lines_cover_and_extend_less():
    points = plane(np.random.default_rng(4))
    x = points.copy()
    x[:, 0] = np.round(points[:, 0] / 0.5) * 0.5  # five scan lines
    assert metrics.coverage(points, points) == 1
    assert metrics.coverage(x, points) == pytest.approx(0.4, abs=0.03)  # 0.1 m to both sides
    assert metrics.coverage(x, points, 0.3) == 1


# --- nothing, and nonsense ------------------------------------------------------------------------


def test_nothing_gives_nan():
    none = np.zeros(0, bool)
    values = [
        metrics.end_point_error(NOTHING, NOTHING),
        metrics.end_point_error(along_x(1), along_x(1), np.array([False])),
        metrics.accuracy(NOTHING, NOTHING, metrics.STRICT),
        metrics.angle_error_rad(along_x(1), along_x(0)),
        *metrics.three_way_error(NOTHING, NOTHING, none, none),
        metrics.share_found(np.array([True]), np.array([False])),
    ]
    assert all(math.isnan(v) for v in values), values


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: metrics.end_point_error(along_x(1, 2), along_x(1)), "2 estimated and 1 true"),
        (lambda: metrics.accuracy(np.zeros(3), along_x(1), 0.1), r"estimated flow: got .*\(3,\)"),
        (lambda: metrics.angle_error_rad(along_x(1), np.zeros((1, 4))), "true flow"),
        (lambda: metrics.end_point_error(along_x(1), along_x(1), np.array([1])), "mask: got int64"),
        (
            lambda: metrics.three_way_error(
                along_x(1), along_x(1), np.ones(1, bool), np.ones(2, bool)
            ),
            r"foreground: got bool of shape \(2,\)",
        ),
        (lambda: metrics.share_found(np.ones(2, bool), np.ones(3, bool)), "estimated_moving"),
        (lambda: metrics.share_found(np.ones(2, bool), np.ones(2)), "moving: got float64"),
        (lambda: metrics.errors_by_hops(along_x(1), along_x(1), np.ones(1)), "hops: got float64"),
        (lambda: metrics.errors_by_hops(along_x(1), along_x(1), np.ones(2, int)), "hops"),
        (lambda: metrics.coverage(along_x(1), np.zeros(3)), "true_points"),
    ],
)
def test_shapes_that_do_not_fit_are_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
