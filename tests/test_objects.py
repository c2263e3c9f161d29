# SPDX-License-Identifier: MIT
"""Tracked objects: their motion, the flow that follows from it, and their shape."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.surface_matching import apply
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
