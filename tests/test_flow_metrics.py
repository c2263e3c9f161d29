# SPDX-License-Identifier: MIT
"""Flow metrics against numbers worked out by hand and slow twins written from the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

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


def test_nothing_gives_nan():
    values = [
        metrics.end_point_error(NOTHING, NOTHING),
        metrics.end_point_error(along_x(1), along_x(1), np.array([False])),
        metrics.accuracy(NOTHING, NOTHING, metrics.STRICT),
        metrics.angle_error_rad(along_x(1), along_x(0)),
    ]
    assert all(math.isnan(v) for v in values), values
