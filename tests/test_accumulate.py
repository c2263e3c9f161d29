# SPDX-License-Identifier: MIT
"""Accumulation of motions that are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.flow.engines import ChainedMotion
from densify.geometry import poses
from densify.geometry.types import FlowField
from densify.pipeline.accumulate import accumulate
from tests.exact_motion import (
    CAR,
    FRAMES,
    KEY,
    NUM_MOVING,
    NUM_STATIC,
    T_world_lidar,
    drifting,
    scene,
    turning,
)


def to_key(motion: ChainedMotion) -> list[FlowField]:
    """Of every sweep; the key's own movers are marked."""
    fields = [motion.flow(f, KEY) for f in FRAMES]
    own = motion.step(KEY - FRAMES[0], KEY - FRAMES[0] + 1)
    fields[KEY - FRAMES[0]] = replace(own, displacement=np.zeros_like(own.displacement))
    return fields


def test_a_moved_object_comes_together_at_the_key():
    motion = scene()
    cloud = accumulate(motion.stretch, to_key(motion), KEY, drop_lost=True)
    on = cloud.instance == CAR
    assert on.sum() == NUM_MOVING * len(FRAMES)
    world = poses.transform(T_world_lidar(KEY), cloud.points[on])
    body = poses.transform(poses.inverse(turning(KEY)), world)
    assert np.abs(body).max() <= 2 + 1e-9  # within the object's size
    assert np.abs(cloud.rigid_points[on] - cloud.points[on]).max() > 2


def test_nothing_moves_rigid_to_the_last_bit():
    motion = scene()
    zero = [FlowField.zero(len(s.sweep)) for s in motion.stretch.sweeps]
    rigid = accumulate(motion.stretch, zero, KEY, drop_lost=True)
    stretch = motion.stretch
    placed = np.concatenate(
        [poses.transform(stretch.T_target_source(KEY, f), stretch[f].sweep.points) for f in FRAMES]
    )
    assert rigid.points.tobytes() == placed.tobytes() == rigid.rigid_points.tobytes()
    assert not rigid.displaced.any() and not rigid.moving.any() and not rigid.velocity_m_s.any()
    flow = accumulate(motion.stretch, to_key(motion), KEY, drop_lost=True)
    still = ~flow.moving
    assert still.sum() == NUM_STATIC * len(FRAMES)
    assert flow.points[still].tobytes() == rigid.points[still].tobytes()
    assert flow.rigid_points.tobytes() == rigid.points.tobytes()


@pytest.mark.parametrize("key", [FRAMES[0], KEY, FRAMES[-1]])
def test_the_key_sweep_stays_where_it_is(key):
    motion = scene()
    fields = [motion.flow(f, key) for f in FRAMES]
    cloud = accumulate(motion.stretch, fields, key, drop_lost=True)
    own = cloud.frame == key
    assert cloud.points[own].tobytes() == motion.stretch[key].sweep.points.tobytes()
    assert not cloud.displaced[own].any()
    assert cloud.confidence[own].min() > cloud.confidence[~own].max()


def test_lost_points_are_dropped_or_kept_rigid():
    motion = scene(sizes={f: 0 if f == KEY - 1 else NUM_MOVING for f in FRAMES})
    fields = to_key(motion)
    num_lost = sum(int(f.lost.sum()) for f in fields)
    assert num_lost == 2 * NUM_MOVING
    dropped, kept = (accumulate(motion.stretch, fields, KEY, drop) for drop in (True, False))
    assert len(kept) - len(dropped) == num_lost
    lost = kept.moving & (kept.frame < KEY - 1)
    assert lost.sum() == num_lost
    assert kept.points[lost].tobytes() == kept.rigid_points[lost].tobytes()
    assert not kept.velocity_m_s[lost].any()
    rest = ~lost
    for name in ("points", "frame", "row", "instance", "confidence", "intensity"):
        assert np.array_equal(getattr(kept, name)[rest], getattr(dropped, name)), name
    # rows still name the return in its file, not its place in the cloud
    for frame in FRAMES:
        mine, sweep = dropped.frame == frame, motion.stretch[frame].sweep
        kept_here = np.isin(sweep.row, dropped.row[mine])
        assert kept_here.sum() == mine.sum()
        assert np.array_equal(dropped.intensity[mine], sweep.intensity[kept_here])


def test_movers_know_their_velocity_at_the_key():
    motion = scene(drifting)
    fields = to_key(motion)
    cloud = accumulate(motion.stretch, fields, KEY, drop_lost=True)
    assert not cloud.velocity_m_s[~cloud.moving].any()
    assert not cloud.velocity_m_s[cloud.frame == KEY].any()  # of which its field says nothing
    on = cloud.moving & (cloud.frame != KEY)
    expected = np.array([15.0, -5.0, 1.0]) @ T_world_lidar(KEY)[:3, :3]  # key frame
    assert np.ptp(cloud.velocity_m_s[on], axis=0).max() < 1e-4
    np.testing.assert_allclose(cloud.velocity_m_s[on].mean(0), expected, atol=1e-4)
