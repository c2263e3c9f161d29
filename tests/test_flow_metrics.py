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


def test_a_point_is_accurate_in_metres_or_in_parts():
    # 4 cm of nothing; 6 cm of 2 m (3 %); 6 cm of 1 m (6 %); 20 cm of 1 m
    flow, true = along_x(0.04, 2.06, 1.06, 1.2), along_x(0, 2, 1, 1)
    assert metrics.accuracy(flow, true, metrics.STRICT) == pytest.approx(2 / 4)
    assert metrics.accuracy(flow, true, metrics.RELAXED) == pytest.approx(3 / 4)
    assert metrics.accuracy(along_x(0.05), along_x(0), 0.05) == 0  # the limit itself is too much


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


def test_space_time_angle_by_hand():
    # (0.1, 0, 0, 0.1) against (0, 0, 0, 0.1): 45 degrees; nothing and nothing: 0
    flow, true = along_x(0.1, 0.0), along_x(0.0, 0.0)
    assert metrics.space_time_angle_error_rad(flow, true, 0.1) == pytest.approx(math.pi / 8)
    assert metrics.space_time_angle_error_rad(flow, true, 0.2) == pytest.approx(math.atan(0.5) / 2)


def test_space_time_angle_as_a_loop(flows):
    angles = []
    for f, t in zip(*flows, strict=True):
        a, b = (*f, 0.1), (*t, 0.1)
        dot = sum(x * y for x, y in zip(a, b, strict=True))
        angles.append(math.acos(min(1.0, dot / math.hypot(*a) / math.hypot(*b))))
    assert metrics.space_time_angle_error_rad(*flows, 0.1) == pytest.approx(np.mean(angles))


def test_perfect_flow_has_no_angle_error(flows):
    _, true = flows
    assert metrics.angle_error_rad(true, true) == pytest.approx(0, abs=1e-7)
    assert metrics.angle_error_rad(-true, true) == pytest.approx(math.pi)


def test_three_ways_weigh_the_same():
    flow, true = along_x(1.0, 0.2, 0.4, 0.01, 0.03, 7.0), along_x(0, 0, 0, 0, 0, 0)
    moving = np.array([1, 0, 0, 0, 0, 1], bool)
    foreground = np.array([1, 1, 1, 0, 0, 0], bool)  # the last moves without being an object
    error = metrics.three_way_error(flow, true, moving, foreground)
    assert error[:3] == pytest.approx((1.0, 0.3, 0.02))
    assert error.mean_m == pytest.approx(1.32 / 3)


def test_three_ways_without_movers_say_so():
    still, parked = np.zeros(2, bool), np.array([True, False])
    error = metrics.three_way_error(along_x(0.2, 0.1), along_x(0, 0), still, parked)
    assert math.isnan(error.foreground_dynamic_m) and math.isnan(error.mean_m)
    assert error[1:3] == pytest.approx((0.2, 0.1))


def test_segmentation_by_hand():
    called, moving = np.array([1, 1, 1, 0, 0], bool), np.array([1, 1, 0, 1, 0], bool)
    assert metrics.dynamic_iou(called, moving) == pytest.approx(2 / 4)
    assert metrics.share_found(called, moving) == pytest.approx(2 / 3)


def test_buckets_by_hand():
    # static below 0.04 m; buckets 0.4 to 0.8 m/s and 10 to 10.4 m/s; the second has two points
    true = along_x(0.0, 0.03, 0.06, 1.01, 1.03)
    flow = along_x(0.01, 0.0, 0.03, 1.01, 0.83)
    error = metrics.bucketed_error(flow, true, 0.1)
    assert error.static_m == pytest.approx(0.02)
    assert error.dynamic == pytest.approx((0.5 + 0.1 / 1.02) / 2)
    # Twice as long: 0.06 m is static, 1.01 and 1.03 m are 5.05 and 5.15 m/s.
    slower = metrics.bucketed_error(flow, true, np.full(5, 0.2))
    assert slower.static_m == pytest.approx(0.07 / 3)
    assert slower.dynamic == pytest.approx(0.1 / 1.02)


def test_doing_nothing_earns_one_in_every_bucket(flows):
    _, true = flows
    error = metrics.bucketed_error(np.zeros_like(true), 5 * true, 0.1)
    assert error.dynamic == pytest.approx(1)


def test_buckets_as_a_loop(flows):
    flow, true = (2 * f for f in flows)
    buckets: dict[int, list[tuple[float, float]]] = {}
    for f, t in zip(flow, true, strict=True):
        speed_m_s = math.hypot(*t) / 0.1
        number = 50 if speed_m_s >= 20 else int(speed_m_s / 0.4 + 1e-9)
        buckets.setdefault(number, []).append((math.dist(f, t), math.hypot(*t)))
    parts = [np.mean(b, 0)[0] / np.mean(b, 0)[1] for n, b in buckets.items() if n]
    error = metrics.bucketed_error(flow, true, 0.1)
    assert 50 in buckets and len(buckets) > 20
    assert error.dynamic == pytest.approx(np.mean(parts))
    assert error.static_m == pytest.approx(np.mean(buckets[0], 0)[0])


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


@pytest.mark.parametrize("sigma_m", [0.0, 0.01, 0.03])
def test_plane_residual_is_the_noise_across(sigma_m):
    points = plane(np.random.default_rng(1), sigma_m=sigma_m)
    assert metrics.plane_residual_m(points) == pytest.approx(sigma_m, rel=0.05, abs=1e-6)


def test_plane_residual_as_a_loop():
    points = plane(np.random.default_rng(2), 300, 0.02)
    expected = []
    for p in points:
        near = points[np.linalg.norm(points - p, axis=1) <= 0.3]
        if len(near) >= 8:
            _, scale, _ = np.linalg.svd(near - near.mean(0))
            expected.append(scale[2] / math.sqrt(len(near)))
    assert 0 < len(expected) <= 300
    assert metrics.plane_residual_m(points) == pytest.approx(np.mean(expected))


def test_two_copies_that_do_not_meet_are_thick():
    points = plane(np.random.default_rng(3), 2000)
    normal = np.array([0, -math.sin(0.7), math.cos(0.7)])
    doubled = np.vstack([points, points + 0.1 * normal])
    assert metrics.plane_residual_m(doubled) == pytest.approx(0.05, rel=0.02)


def test_points_drawn_onto_lines_cover_and_extend_less():
    points = plane(np.random.default_rng(4))
    x = points.copy()
    x[:, 0] = np.round(points[:, 0] / 0.5) * 0.5  # five scan lines
    assert metrics.coverage(points, points) == 1
    assert metrics.coverage(x, points) == pytest.approx(0.4, abs=0.03)  # 0.1 m to both sides
    assert metrics.coverage(x, points, 0.3) == 1
    assert metrics.extent_m2(x) < 0.5 * metrics.extent_m2(points)


def test_extent_counts_cells():
    at = np.array([[0.05, 0.05, 0.05], [0.06, 0.05, 0.05], [0.15, 0.05, 0.05], [-0.05, 0, 0]])
    assert metrics.extent_m2(at) == pytest.approx(0.03)
    assert metrics.extent_m2(at, 1.0) == pytest.approx(2)


def test_coverage_without_points():
    assert metrics.coverage(NOTHING, np.zeros((2, 3))) == 0
    assert math.isnan(metrics.coverage(np.zeros((2, 3)), NOTHING))


# --- nothing, and nonsense ------------------------------------------------------------------------


def test_nothing_gives_nan():
    none = np.zeros(0, bool)
    values = [
        metrics.end_point_error(NOTHING, NOTHING),
        metrics.end_point_error(along_x(1), along_x(1), np.array([False])),
        metrics.accuracy(NOTHING, NOTHING, metrics.STRICT),
        metrics.angle_error_rad(along_x(1), along_x(0)),
        metrics.space_time_angle_error_rad(NOTHING, NOTHING, 0.1),
        *metrics.three_way_error(NOTHING, NOTHING, none, none),
        metrics.dynamic_iou(none, none),
        metrics.share_found(np.array([True]), np.array([False])),
        *metrics.bucketed_error(NOTHING, NOTHING, 0.1),
        metrics.plane_residual_m(NOTHING),
        metrics.plane_residual_m(along_x(0, 0.1, 0.2)),
    ]
    assert all(math.isnan(v) for v in values), values
    assert metrics.extent_m2(NOTHING) == 0


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
        (lambda: metrics.dynamic_iou(np.ones(2, bool), np.ones(3, bool)), "estimated_moving"),
        (lambda: metrics.share_found(np.ones(2, bool), np.ones(2)), "moving: got float64"),
        (lambda: metrics.errors_by_hops(along_x(1), along_x(1), np.ones(1)), "hops: got float64"),
        (lambda: metrics.errors_by_hops(along_x(1), along_x(1), np.ones(2, int)), "hops"),
        (lambda: metrics.plane_residual_m(np.zeros((2, 2))), "points"),
        (lambda: metrics.bucketed_error(along_x(1), along_x(1), 0.0), "duration_s"),
        (lambda: metrics.bucketed_error(along_x(1), along_x(1), [0.1, 0.1]), "duration_s"),
        (lambda: metrics.coverage(along_x(1), np.zeros(3)), "true_points"),
    ],
)
def test_shapes_that_do_not_fit_are_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
