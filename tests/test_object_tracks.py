# SPDX-License-Identifier: MIT
"""Where moving objects were: exact for exact flow, near the truth on a street."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.geometry import poses
from densify.geometry.types import FlowField, Stretch
from densify.pipeline.accumulate import object_tracks
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
