# SPDX-License-Identifier: MIT
"""Tracked objects: their motion, the flow that follows from it, shape, path, and alignment."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from densify.flow.surface_matching import GATES_M, MIN_FIT, Model, apply, undo
from densify.flow.tracking.groups import GroupMotion
from densify.flow.tracking.objects import MovingObject, Observation, Path, Shape, Track
from densify.free_space.ground import HeightMap
from densify.geometry import poses
from tests.scenes import SWEEP_S, Arc, Scanner, Scene, World, street

CENTRE = np.array([10.0, 5.0, 0.0])


def pose(time_s: float) -> np.ndarray:
    """(4,4) 3 m/s ahead and slower, 0.2 rad/s about the object's own centre."""
    ahead = poses.exp(np.array([0, 0, 0.2 * time_s, *CENTRE]))
    ahead[0, 3] += 1 + 3 * time_s - 0.5 * time_s**2
    return ahead


@pytest.fixture(scope="module")
def track() -> Track:
    t = 0.1 * np.arange(6)
    track = Track(CENTRE)
    states = np.stack([1 + 3 * t - 0.5 * t**2, 0 * t, 0 * t, 0.2 * t], 1)
    track.path = Path.fit(t, states, np.ones(6))
    return track


def test_a_track_carries_points_along_its_smooth_motion(track):
    points = CENTRE + np.random.default_rng(0).uniform(-3, 3, (8, 3))
    for a, b in [(0.0, 0.5), (0.42, 0.07), (0.3, 0.3)]:
        expected = poses.transform(pose(b) @ poses.inverse(pose(a)), points)
        np.testing.assert_allclose(track.carry(points, a, b), expected, atol=1e-6)
        many = track.carry(np.vstack([points, expected]), np.repeat([a, b], 8), b)
        np.testing.assert_allclose(many, np.vstack([expected, expected]), atol=1e-6)
    about_m_s = 0.2 * np.stack([CENTRE[1] - points[:, 1], points[:, 0] - CENTRE[0] - 1], 1)
    expected = np.column_stack([[3.0, 0] + about_m_s, np.zeros(8)])
    np.testing.assert_allclose(track.velocity_m_s(points, 0.0), expected, atol=2e-3)


@pytest.fixture(scope="module")
def alone(track) -> GroupMotion:
    """Half of the points of each of frames 2 to 8 are on the track, observed in frame 5."""
    ego = Arc(0, -1.5, 0.3, 6.0, 0.4)
    stretch = Scene(World(street()), ego, Scanner(8, 60)).stretch(5, 3)
    track.claimed[3] = np.arange(5)
    instance = tuple(np.arange(len(s.sweep), dtype=np.int32) % 2 - 1 for s in stretch.sweeps)
    return GroupMotion(stretch, (track,), instance, {}, np.zeros(1, np.int64))


@pytest.mark.parametrize(("frame", "target"), [(2, 7), (6, 3), (4, 4)])
def test_flow_in_the_sweeps_own_coordinates(alone, frame, target):
    """From where a point was measured, at its own time, to the target's reference time."""
    flow, registered = alone.flow(frame, target), alone.stretch[frame]
    on = np.flatnonzero(flow.moving)
    assert len(on) == len(flow.moving) // 2 > 100
    assert not flow.total[~flow.moving].any() and not flow.velocity_m_s[~flow.moving].any()
    R_lidar_world = registered.T_world_lidar[:3, :3].T
    for i in on[::40]:
        fired_s = (frame - 2) * SWEEP_S + registered.sweep.offset_ns[i] * 1e-9
        if not 0 <= fired_s <= 0.5:
            continue
        at = poses.transform(registered.T_world_lidar, registered.sweep.points[[i]])
        there = [
            poses.transform(pose(s) @ poses.inverse(pose(fired_s)), at)[0]
            for s in ((frame - 2) * SWEEP_S, (target - 2) * SWEEP_S, (target - 2) * SWEEP_S - 1e-4)
        ]
        found = flow.to_reference[i], flow.displacement[i], flow.velocity_m_s[i]
        expected = there[0] - at[0], there[1] - there[0], (there[1] - there[2]) / 1e-4
        for k, atol in enumerate((1e-6, 1e-6, 1e-2)):
            np.testing.assert_allclose(found[k], R_lidar_world @ expected[k], atol=atol)


def test_lost_three_sweeps_before_and_after_the_observations(alone):
    for frame in alone.stretch.frames:
        for target in alone.stretch.frames:
            flow = alone.flow(frame, target)
            assert np.array_equal(flow.lost, flow.moving & (abs(target - 5) > 2))


def test_the_ground_rises_under_a_track():
    x, y = np.meshgrid(np.arange(-20, 20, 0.25), np.arange(-20, 20, 0.25))
    points = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], 1)
    ground = HeightMap.of([points])
    track = Track(np.array([-5.0, 2.0, 9.0]))
    for dx, dy in ((10, 0), (-6, 3), (0, 5)):
        rise_m = track.rise_m(ground, np.array([dx, dy, 77.0, 0.3]))
        assert rise_m == pytest.approx(0.1 * dx, abs=0.005)


# --- shapes ---------------------------------------------------------------------------------------


def test_the_outline_is_that_of_all_points_seen_from_above() -> None:
    """A triangle, 5 cm beyond its sides allowed. A line has no outline."""
    corners = np.array([[0.0, 0, 0], [4, 0, 1], [0, 3, 9]])
    rng = np.random.default_rng(0)
    shape = Shape.of(np.concatenate([corners, rng.dirichlet(np.ones(3), 500) @ corners]))
    asked = rng.uniform(-1, 5, (3000, 3)) * [1, 1, 50]
    x, y, _ = asked.T
    beyond = np.max([-x, -y, (3 * x + 4 * y - 12) / 5], axis=0)
    np.testing.assert_array_equal(shape.within_outline(asked), beyond < 0.05)
    line = np.linspace(0, 1, 30)[:, None] * [1.0, 2.0, 3.0]
    for points in (line[:1], line[:2], line):
        assert not Shape.of(points).within_outline(line).any()
        np.testing.assert_array_equal(Shape.of(points).rim, points)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0])
def test_the_rim_reaches_as_far_as_all_points_however_turned(yaw: float) -> None:
    points = np.random.default_rng(1).normal(size=(4000, 3)) * [4, 1, 0.7]
    shape = Shape.of(points)
    assert len(shape.rim) < 60
    state, centre = np.array([30.0, -4.0, 0.5, yaw]), np.array([1.0, 2.0, 3.0])
    everything, rim = apply(state, points, centre), apply(state, shape.rim, centre)
    np.testing.assert_array_equal(rim.min(0), everything.min(0))
    np.testing.assert_array_equal(rim.max(0), everything.max(0))


def two_sides(length_m: float, width_m: float, yaw_rad: float) -> np.ndarray:
    """(N,3) an upright rectangle seen from one corner, with 2 cm of noise: as many points on the
    short side as on the long one."""
    rng = np.random.default_rng(3)
    along = np.stack([rng.uniform(0, length_m, 300), np.zeros(300), rng.uniform(0, 2, 300)], 1)
    across = np.stack([np.zeros(300), rng.uniform(0, width_m, 300), rng.uniform(0, 2, 300)], 1)
    points = np.concatenate([along, across]) + rng.normal(0, 0.02, (600, 3))
    return apply(np.array([5.0, -3.0, 0.0, yaw_rad]), points, np.zeros(3))


@pytest.mark.parametrize("yaw_deg", [0, 31, 44, 89, 200])
@pytest.mark.parametrize("size_m", [(13.0, 2.5), (4.5, 1.8), (6.0, 0.01)])
def test_sides_are_found_however_the_object_is_turned(yaw_deg: float, size_m: tuple) -> None:
    shape = Shape.of(two_sides(*size_m, np.deg2rad(yaw_deg)))
    off_deg = (np.rad2deg(shape.side_rad) - yaw_deg + 45) % 90 - 45
    assert abs(off_deg) <= 0.75


@pytest.mark.parametrize(
    ("length_m", "aside_deg", "heading_deg"), [(6.0, 25, 40), (6.0, -30, 40), (2.4, 25, 65)]
)
def test_a_long_object_heads_along_its_side_and_a_short_one_where_it_moves(
    length_m: float, aside_deg: float, heading_deg: float
) -> None:
    """It is turned by 40 degrees and moves aside of that; at 45 it would be its other side."""
    shape = Shape.of(two_sides(length_m, 1.0, np.deg2rad(40)))
    way = np.deg2rad(40 + aside_deg)
    track = Track(np.zeros(3))
    for i in range(5):
        state = np.array([0.5 * i * np.cos(way), 0.5 * i * np.sin(way), 0.0, 0.0])
        track.observations[i] = Observation(state, 0.1 * i, i * 100_000_000, (i,))
        track.claimed[i] = np.arange(8)
    track.smooth()
    x, y = MovingObject(track, shape).heading(0.2)
    assert np.hypot(x, y) == pytest.approx(1)
    assert np.rad2deg(np.arctan2(y, x)) == pytest.approx(heading_deg, abs=1)


# --- paths ----------------------------------------------------------------------------------------


STEP_S = 0.1
NOISE_M = 0.03
SEEDS = range(10)


def times_of(num: int, begin_s: float = 0.37) -> np.ndarray:
    """Not quite even: an object is seen a little earlier or later as the scanner comes by."""
    return begin_s + STEP_S * np.arange(num) + np.random.default_rng(num).uniform(0, 0.01, num)


def polynomial(times_s: np.ndarray, degree: int) -> np.ndarray:
    """(m,4) x y z yaw."""
    rng = np.random.default_rng(degree)
    return np.vander(np.asarray(times_s), degree + 1) @ rng.uniform(-8, 8, (degree + 1, 4))


def fitted(times_s: np.ndarray, states: np.ndarray) -> Path:
    return Path.fit(times_s, states, np.ones(len(times_s)))


def rms(off: np.ndarray) -> float:
    """In the plane."""
    return float(np.sqrt((off[:, :2] ** 2).sum(1).mean()))


@pytest.mark.parametrize(("degree", "num"), [(1, 4), (2, 5), (2, 40)])
def test_constant_acceleration_is_recovered_exactly_and_of_few_sweeps_constant_velocity(
    degree, num
):
    t = times_of(num)
    path = fitted(t, polynomial(t, degree))
    within = np.linspace(t[0], t[-1], 50)
    np.testing.assert_allclose(path(within), polynomial(within, degree), atol=1e-5)
    assert path.residual_m < 1e-5


def from_rest(times_s: np.ndarray) -> np.ndarray:
    """Stands for half a second, then sets off at 5 m/s²."""
    x = 2.5 * np.maximum(times_s - times_s[0] - 0.5, 0) ** 2
    return np.stack([x, 0.5 * x, 0 * x, 0.02 * x], 1)


def to_a_stop(times_s: np.ndarray) -> np.ndarray:
    """6 m/s, brakes at 8 m/s², stands."""
    after_s = np.clip(times_s - times_s[0] - 0.2, 0, 0.75)
    x = 6 * (np.minimum(times_s - times_s[0], 0.2) + after_s) - 4 * after_s**2
    return np.stack([x, -0.3 * x, 0 * x, 0 * x], 1)


def noisy(states: np.ndarray, seed: int) -> np.ndarray:
    return states + np.random.default_rng(seed).normal(0, NOISE_M, states.shape)


@pytest.mark.parametrize("motion", [from_rest, to_a_stop])
def test_starts_and_stops_are_followed_better_than_by_a_quadratic(motion):
    t = times_of(15)
    path_m, quadratic_m = [], []
    for seed in SEEDS:
        measured = noisy(motion(t), seed)
        path_m.append(rms(fitted(t, measured)(t) - motion(t)))
        quadratic = np.vander(t - t[0], 3)
        coefficients = np.linalg.lstsq(quadratic, measured, rcond=None)[0]
        quadratic_m.append(rms(quadratic @ coefficients - motion(t)))
    assert np.mean(path_m) < 0.75 * np.mean(quadratic_m)
    assert np.mean(path_m) < NOISE_M * np.sqrt(2)  # better than the single sweep


def test_a_quadratic_with_noise_stays_one():
    """What softness could explain is only noise: the third derivative remains nothing."""
    t = times_of(11)
    num_stiff = 0
    for seed in SEEDS:
        rate = fitted(t, noisy(polynomial(t, 2), seed)).rate(np.linspace(t[0], t[-1], 9))
        num_stiff += np.abs(np.diff(rate, 2, axis=0)).max() < 1e-3
    assert num_stiff >= 0.75 * len(SEEDS)


@pytest.mark.parametrize("num", [3, 4])
def test_four_sweeps_do_not_tell_an_acceleration(num):
    t = times_of(num)
    rate = fitted(t, polynomial(t, 2)).rate(np.linspace(t[0], t[-1], 9))
    assert np.ptp(rate, axis=0).max() < 1e-3
    t = times_of(5)
    rate = fitted(t, polynomial(t, 2)).rate(np.linspace(t[0], t[-1], 9))
    assert np.ptp(rate, axis=0).max() > 1


@pytest.mark.parametrize("num", [5, 11])
def test_the_residual_of_noise_is_about_the_noise(num):
    """Though the fit swallows some of it."""
    t = times_of(num)
    found_m = [fitted(t, noisy(polynomial(t, 2), seed)).residual_m for seed in range(60)]
    expected_m = NOISE_M * np.sqrt(2)  # of two coordinates
    assert 0.75 * expected_m < np.sqrt(np.mean(np.square(found_m))) < 1.3 * expected_m


def test_beyond_the_ends_it_goes_on_at_constant_velocity():
    t = times_of(15)
    soft = fitted(t, from_rest(t))
    for end_s, sign in ((soft.begin_s, -1), (soft.end_s, 1)):
        velocity = soft.rate(end_s)
        for beyond_s in (0.01, 0.2, 3.0):
            there = soft(end_s + sign * beyond_s)
            np.testing.assert_allclose(there, soft(end_s) + sign * beyond_s * velocity, atol=1e-9)
            np.testing.assert_allclose(soft.rate(end_s + sign * beyond_s), velocity)
    assert soft.rate(soft.end_s + 1)[0] > 3 and abs(soft.rate(soft.begin_s - 1)[0]) < 1


def test_rounding_of_the_last_knot_leaves_the_last_state_on_the_path():
    """0.1 s times the number of spans may end a rounding error before the last time."""
    for times_s in np.sort(np.random.default_rng(0).uniform(-1, 1, (300, 2)), axis=1):
        assert np.isfinite(fitted(times_s, np.ones((2, 4))).residual_m)


# --- alignment ------------------------------------------------------------------------------------


MIDDLE = np.array([12.0, -3.0, 0.8])
STD = np.array([0.3, 0.3, 0.06])


def corner(num_points: int, seed: int) -> np.ndarray:
    """Two sides of a car, as seen from one place."""
    rng = np.random.default_rng(seed)
    along, up = rng.uniform([-2, 0], [2, 1.4], (num_points, 2)).T
    side = np.arange(num_points) % 3 > 0
    x, y = np.where(side, along, -2.0), np.where(side, -0.9, along * 0.45)
    return MIDDLE + np.stack([x, y, up], 1) + rng.normal(0, 0.01, (num_points, 3))


def slow_information(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(N,3,3) as the formulas say, with an inverse of numpy."""
    x = points[near] - points[near].mean(1, keepdims=True)
    covariance = 10 * np.einsum("nki,nkj->nij", x, x) / near.shape[1]
    mean_variance = np.trace(covariance, axis1=1, axis2=2)[:, None, None] / 3
    return np.linalg.inv(covariance + (0.05**2 + 0.02 * mean_variance) * np.eye(3))


def slow_align(model: Model, points, predicted) -> np.ndarray | None:
    """Gauss-Newton with numerical derivatives, neighbours from another tree."""
    tree = cKDTree(model.points)
    _, near = tree.query(model.points, min(12, len(model.points)))
    information = slow_information(model.points, near.reshape(len(model.points), -1))
    state, points = predicted.copy(), points[:: max(1, len(points) // 250)]
    for gate_m in GATES_M:
        at_model = undo(state, points, MIDDLE)
        distance, row = tree.query(at_model, distance_upper_bound=gate_m)
        near = np.isfinite(distance)
        if near.sum() < MIN_FIT:
            return None
        weight = (1 - (distance[near] / gate_m) ** 2) ** 2 * min(1, 60 / near.sum())
        A = information[row[near]] * weight[:, None, None]
        r = at_model[near] - model.points[row[near]]
        J = np.zeros((near.sum(), 3, 3))
        for k, axis in enumerate((0, 1, 3)):
            h = np.zeros(4)
            h[axis] = 1e-6
            ahead, behind = (undo(state + s * h, points[near], MIDDLE) for s in (1, -1))
            J[:, :, k] = (ahead - behind) / 2e-6
        H = np.einsum("nik,nij,njl->kl", J, A, J) + np.diag(1 / STD**2)
        g = np.einsum("nik,nij,nj->k", J, A, r) - (predicted - state)[[0, 1, 3]] / STD**2
        state[[0, 1, 3]] -= np.linalg.solve(H, g)
    return state


@pytest.mark.parametrize("num_points", [MIN_FIT - 1, MIN_FIT, 40, 600])
@pytest.mark.parametrize("num_in_model", [8, 900, 2500])
@pytest.mark.parametrize("flat", [False, True])
def test_the_alignment_is_its_slow_twin(flat: bool, num_in_model: int, num_points: int) -> None:
    rng = np.random.default_rng(0)
    shape = corner(num_in_model, 0)
    model = Model(np.where(np.arange(3) == 1, MIDDLE, shape) if flat else shape)
    true = np.array([*rng.normal(0, 0.5, 2), rng.normal(0, 0.1), rng.normal(0, 0.3)])
    points = apply(true, corner(num_points, 50), MIDDLE)
    predicted = true + [*rng.normal(0, 0.2, 2), 0.0, rng.normal(0, 0.04)]
    found, expected = (
        model.align(points, MIDDLE, predicted, STD),
        slow_align(model, points, predicted),
    )
    assert (found is None) == (expected is None) and (num_points >= MIN_FIT or found is None)
    if found is not None:
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert found[2] == predicted[2]


def test_the_prediction_holds_what_the_points_leave_open() -> None:
    """A single flat side may slide along itself: it stays where it is expected."""
    rng = np.random.default_rng(3)
    wall = MIDDLE + np.column_stack([rng.uniform(-9, 9, 800), np.zeros(800), np.zeros(800)])
    seen = MIDDLE + np.column_stack([rng.uniform(-1, 1, 80), np.zeros(80), np.zeros(80)])
    predicted = np.array([0.3, 0.2, 0.0, 0.0])
    found = Model(wall).align(seen, MIDDLE, predicted, np.array([0.01, 0.3, 0.06]))
    assert abs(found[0] - 0.3) < 0.02 and abs(found[1]) < 0.02
