# SPDX-License-Identifier: MIT
"""Where moving objects were: exact for exact flow; their boxes, completed where no ray passed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth.rays import Rays, complete_boxes, grow_box
from densify.free_space.ground import HeightMap
from densify.geometry import poses
from densify.geometry.types import FlowField, ObjectTrack, RegisteredSweep, Stretch, Sweep
from densify.pipeline.accumulate import accumulate, object_tracks
from tests.exact_motion import CAR, FRAMES, KEY, T_world_lidar, scene, turning
from tests.exported import street_result
from tests.small_street import CAR as STREET_CAR
from tests.small_street import KEY as STREET_KEY


def exact_fields(motion, body=turning) -> list[FlowField]:
    """The flow of every sweep to the key, its points known from where they are."""
    fields = []
    for registered in motion.stretch.sweeps:
        frame = registered.frame
        world = poses.transform(registered.T_world_lidar, registered.sweep.points)
        moving = np.arange(len(world)) >= 20
        T = body(KEY) @ poses.inverse(body(frame))
        moved = np.where(moving[:, None], poses.transform(T, world) - world, 0)
        R_lidar_world = registered.T_world_lidar[:3, :3].T
        velocity = np.where(moving[:, None], np.array([11.0, -2.0, 0.2]), 0)
        fields.append(
            FlowField(
                displacement=moved @ R_lidar_world.T,
                moving=moving,
                instance=np.where(moving, CAR, -1).astype(np.int32),
                lost=np.zeros(len(world), bool),
                velocity_m_s=velocity @ R_lidar_world.T,
            )
        )
    return fields


def test_poses_of_a_turning_object_are_exact():
    motion = scene()
    (track,) = object_tracks(motion.stretch, exact_fields(motion), KEY)
    assert track.instance == CAR and track.frames == tuple(FRAMES)
    assert track.stamp_ns.tolist() == [s.sweep.stamp_ns for s in motion.stretch.sweeps]
    T_key_world = poses.inverse(T_world_lidar(KEY))
    T_key_object = track.T_key_object[track.frames.index(KEY)]
    for frame, T in zip(track.frames, track.T_key_object, strict=True):
        true = T_key_world @ turning(frame) @ poses.inverse(turning(KEY)) @ T_world_lidar(KEY)
        np.testing.assert_allclose(T, true @ T_key_object, atol=1e-4)
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(track.size_m, 4.0, rtol=0.3)
    assert (track.num_points == 15).all()


def test_points_are_taken_where_they_are_at_the_reference_time():
    motion = scene()
    fields = exact_fields(motion)
    (right,) = object_tracks(motion.stretch, fields, KEY)
    shift = np.array([0.5, 0.1, 0.0])
    sweeps, late = [], []
    for registered, flow in zip(motion.stretch.sweeps, fields, strict=True):
        moved = shift * flow.moving[:, None]
        sweep = replace(registered.sweep, points=registered.sweep.points - moved)
        sweeps.append(replace(registered, sweep=sweep))
        late.append(replace(flow, to_reference=moved))
    (track,) = object_tracks(Stretch(tuple(sweeps)), late, KEY)
    np.testing.assert_allclose(track.T_key_object, right.T_key_object, atol=1e-12)


def test_sweeps_with_few_points_of_it_are_left_out_and_the_key_never():
    sizes = {**dict.fromkeys(FRAMES, 8), 100: 2, KEY: 0}
    motion = scene(sizes=sizes)
    (track,) = object_tracks(motion.stretch, exact_fields(motion), KEY)
    assert track.frames == tuple(f for f in FRAMES if f != 100)
    assert track.num_points.tolist() == [sizes[f] for f in track.frames]
    motion = scene(sizes={**dict.fromkeys(FRAMES, 0), 100: 2, 101: 2})
    assert object_tracks(motion.stretch, exact_fields(motion), KEY) == ()


def test_the_street_car_is_followed():
    """Truth: 8 m/s along x."""
    result = street_result()
    track = max(result.tracks, key=lambda t: t.num_points.sum())
    assert track.frames == (STREET_KEY - 1, STREET_KEY, STREET_KEY + 1)
    steps = np.diff(track.T_key_object[:, :3, 3], axis=0)
    np.testing.assert_allclose(steps, [[0.8, 0, 0]] * 2, atol=0.05)
    np.testing.assert_allclose(track.velocity_m_s, [[8, 0, 0]] * 3, atol=0.5)
    heading = np.arctan2(*track.T_key_object[1, :2, 0][::-1])
    assert abs(np.rad2deg(heading)) < 3
    assert (track.size_m < np.array(STREET_CAR.size_m) + 0.2).all() and track.size_m[0] > 0.8
    mine = result.cloud.instance == track.instance
    own = poses.transform(poses.inverse(track.T_key_object[1]), result.cloud.points[mine])
    assert (np.abs(own) <= track.size_m / 2 + 0.15).mean() > 0.97
    assert not result.baselines["icp"].tracks


# --- boxes: completed where no ray passed, and only there -----------------------------------------

AT_M, WIDE_M, TALL_M, GROUND_M = 10.0, 1.8, 1.5, -1.7
GROUND = HeightMap(np.full((2, 2), GROUND_M), np.array([-100.0, -100.0]), 200.0)
LENGTH_M = 2.4 * WIDE_M  # of a car this wide


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def rear(wide_m: float = WIDE_M, clear_m: float = 0.3) -> np.ndarray:
    """The rear of an object that drives ahead, its lowest points above the road."""
    z = np.linspace(GROUND_M + clear_m, GROUND_M + TALL_M, 25)
    return grid(np.array([AT_M, AT_M + 0.02]), np.linspace(-wide_m / 2, wide_m / 2, 31), z)


def around(wide_m: float = WIDE_M) -> np.ndarray:
    """A wall far behind and the road: rays pass on both sides of the object, and above it."""
    wall = grid(np.array([60.0]), np.arange(-30, 30.1, 0.3), np.arange(-1.5, 6, 0.3))
    road = grid(np.arange(12, 30, 0.5), np.arange(-10, 10, 0.1), np.array([GROUND_M]))
    points = np.concatenate([wall, road])
    beside = abs(points[:, 1]) / points[:, 0] > (wide_m / 2 + 0.02) / AT_M
    above = points[:, 2] / points[:, 0] > (GROUND_M + TALL_M + 0.02) / AT_M
    return points[beside | above]


def across(x_m: float) -> np.ndarray:
    """Returns of a second scanner beside the road, whose rays cross the lane at x."""
    return grid(np.array([x_m]), np.array([25.0]), np.linspace(GROUND_M, 0.5, 45))


def track_of(
    moving: np.ndarray, others: np.ndarray, beside: np.ndarray | None = None
) -> ObjectTrack:
    """The track of an object at 10 m/s along x, completed; ``beside``: by the second scanner."""
    beside = np.zeros((0, 3)) if beside is None else beside
    points = np.concatenate([moving, others, beside])
    num, is_mover = len(points), np.arange(len(points)) < len(moving)
    second = np.array([beside[0, 0] if len(beside) else 0.0, -25.0, GROUND_M + 0.4])
    sweep = Sweep(
        frame=3,
        stamp_ns=0,
        points=points,
        intensity=np.zeros(num, np.float32),
        offset_ns=None,
        lidar=(np.arange(num) >= num - len(beside)).astype(np.uint8),
        row=np.arange(num),
        scanner_origins=np.stack([np.zeros(3), second]),
    )
    flow = FlowField(
        displacement=np.zeros((num, 3)),
        moving=is_mover,
        instance=np.where(is_mover, 5, -1).astype(np.int32),
        lost=np.zeros(num, bool),
        velocity_m_s=is_mover[:, None] * np.array([10.0, 0.0, 0.0]),
    )
    stretch = Stretch((RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6)),))
    tracks = object_tracks(stretch, [flow], 3)
    cloud = accumulate(stretch, [flow], 3, True)
    (track,) = complete_boxes(tracks, cloud, Rays(stretch, 3), GROUND)
    return track


def ends_m(track: ObjectTrack, axis: int) -> np.ndarray:
    """Lower and upper end of the box along an axis of the key's frame."""
    middle = track.T_key_object[track.frames.index(3), axis, 3]
    return middle + np.array([-0.5, 0.5]) * track.size_m[axis]


def test_a_car_seen_from_behind_is_as_long_as_cars_are() -> None:
    track = track_of(rear(), around())
    np.testing.assert_allclose(track.seen_size_m, [0.02, WIDE_M, TALL_M - 0.3], atol=0.01)
    np.testing.assert_allclose(track.size_m[:2], [LENGTH_M, WIDE_M], atol=0.02)
    np.testing.assert_allclose(ends_m(track, 0), [AT_M, AT_M + LENGTH_M], atol=0.02)
    assert set(track.sides_seen) == {"rear", "left", "right", "top"}


def test_it_grows_only_as_far_as_no_ray_passed() -> None:
    for free_m in (1.5, 3.0):
        track = track_of(rear(), around(), across(AT_M + 0.02 + free_m))
        np.testing.assert_allclose(ends_m(track, 0), [AT_M, AT_M + 0.02 + free_m], atol=0.02)
        assert "front" not in track.sides_seen
    track = track_of(rear(), around(), across(AT_M + 0.2))
    assert track.size_m[0] == pytest.approx(0.02, abs=0.01) and "front" in track.sides_seen


def test_it_grows_away_from_the_side_that_was_seen() -> None:
    """The right side of a car to the left: its width is that of cars as long."""
    side = grid(np.linspace(AT_M, AT_M + 4.4, 60), np.array([2.0]), np.linspace(-1.4, -0.2, 20))
    points = around(0.0)
    track = track_of(side, points[points[:, 1] / points[:, 0] < 1.95 / (AT_M + 4.4)])
    assert track.seen_size_m[1] < 0.01
    low_m, high_m = ends_m(track, 1)
    assert low_m == pytest.approx(2.0, abs=0.02) and high_m == pytest.approx(
        2.0 + 4.4 / 2.4, abs=0.05
    )
    assert "right" in track.sides_seen and "left" not in track.sides_seen


def test_people_and_bicycles_keep_their_size() -> None:
    track = track_of(rear(0.6), around(0.6))
    np.testing.assert_allclose(track.size_m[:2], track.seen_size_m[:2])


def test_a_box_stands_on_the_ground() -> None:
    track = track_of(rear(clear_m=0.7), around())
    np.testing.assert_allclose(ends_m(track, 2), [GROUND_M, GROUND_M + TALL_M], atol=0.01)
    assert track.seen_size_m[2] == pytest.approx(TALL_M - 0.7, abs=0.01)


def test_growing_keeps_the_other_end_at_every_pose() -> None:
    track = track_of(rear(), around())
    longer = grow_box(track, 0, 0.0, 1.0)
    lower = [t.T_key_object @ [-t.size_m[0] / 2, 0, 0, 1] for t in (track, longer)]
    np.testing.assert_allclose(*lower, atol=1e-12)
