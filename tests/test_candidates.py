# SPDX-License-Identifier: MIT
"""Candidates: points that other sweeps saw through, and sweeps that are taken together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.flow.tracking.candidates import Batch, Obstacles, Strips, find_candidates
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.free_space.range_image import FreeSpace
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.types import RegisteredSweep, Stretch
from tests.found_motion import motion_in
from tests.scenes import SWEEP_S, Arc, Scanner, Scene, World, car, street

KEY, FAST = 5, 2
MS = 1_000_000


@pytest.fixture(scope="module")
def scene() -> Scene:
    movers = car(14, -1.6, 10, 1), car(8, 1.6, 30, FAST)
    return Scene(World((*street(), *movers)), Arc(0, -1.5, 0, 6.0), Scanner(sigma_m=0.01))


@pytest.fixture(scope="module")
def stretch(scene) -> Stretch:
    return scene.stretch(KEY, 4)


@pytest.fixture(scope="module")
def space(stretch) -> FreeSpace:
    return FreeSpace.of(stretch)


@pytest.fixture(scope="module")
def obstacles(stretch, space) -> tuple[Obstacles, ...]:
    return find_candidates(stretch, space, ground(stretch))


def test_obstacles_are_the_points_above_the_ground(scene, stretch, obstacles):
    heights = ground(stretch)
    for i, (registered, c) in enumerate(zip(stretch.sweeps, obstacles, strict=True)):
        placed = poses.transform(registered.T_world_lidar, registered.sweep.points)
        above = heights.above(placed) >= ABOVE_GROUND_M
        np.testing.assert_array_equal(c.row, np.flatnonzero(above))
        np.testing.assert_allclose(c.points, placed[c.row])
        fired_s = i * SWEEP_S + registered.sweep.offset_ns[c.row] * 1e-9
        np.testing.assert_allclose(c.time_s, fired_s, atol=1e-9)
        assert set(np.unique(c.cluster[c.candidate])) == set(range(c.num_clusters))
        frame = registered.frame
        truly = (scene.height_m(frame) > ABOVE_GROUND_M + 0.1) & (scene.scan(frame).box >= 0)
        truly &= np.linalg.norm(registered.sweep.points, axis=1) < 35
        assert np.isin(np.flatnonzero(truly), c.row).mean() > 0.99


def test_candidates_are_few_and_moving_objects_are_among_them(scene, stretch, obstacles):
    for frame, c in zip(stretch.frames, obstacles, strict=True):
        assert 0 < c.candidate.sum() < 0.1 * len(stretch[frame].sweep)
        assert c.candidate[c.seed].mean() > 0.5
    c, instance = obstacles[stretch.frames.index(KEY)], scene.scan(KEY).instance
    for mover in (1, FAST):
        mine = instance[c.row] == mover
        assert mine.sum() > 100 and c.candidate[mine].mean() > 0.8


def test_strips_find_what_a_mask_finds():
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (1000, 3))
    low, high = np.array([-1.0, -2, -3]), np.array([1.0, 4, 2])
    inside = ((points > low) & (points < high)).all(1)
    np.testing.assert_array_equal(Strips(points).rows_inside(low, high), np.flatnonzero(inside))
    assert Strips(points[:0]).rows_inside(low, high).shape == (0,)


# --- sweeps taken together ------------------------------------------------------------------------


def line(x_m=(), cluster=(), time_s=0.0) -> Obstacles:
    n, label = len(x_m), np.array(cluster, np.int64)
    points = np.zeros((n, 3))
    points[:, 0] = x_m
    num = int(label.max(initial=-1)) + 1
    return Obstacles(np.arange(n), points, np.full(n, time_s), label >= 0, label, num)


@pytest.mark.parametrize(
    ("time_ms", "together"),
    [
        ((0, 97, 194, 290), ((0,), (1,), (2,), (3,))),
        ((0, 200, 400), ((0,), (1,), (2,))),
        ((0, 54, 97, 150, 203, 246), ((0, 1), (2, 3), (4, 5))),
        ((0, 33, 67, 100, 133, 167), ((0, 1, 2), (3, 4, 5))),
        ((0, 50, 200, 250, 300, 350, 500), ((0, 1), (2, 3), (4, 5), (6,))),
        ((0,), ((0,),)),
    ],
    ids=["10 Hz", "5 Hz", "20 Hz, jitter", "30 Hz", "holes", "alone"],
)
def test_sweeps_within_a_tenth_of_a_second_are_one_batch(time_ms, together):
    clock = Clock(np.array(time_ms, np.int64) * MS)
    assert clock.batches() == together
    for sweeps in together:
        batch = Batch.of(sweeps, [line() for _ in time_ms], clock)
        first, last = time_ms[sweeps[0]], time_ms[sweeps[-1]]
        assert batch.time_ns == (first + last) * MS // 2
        assert batch.half_s == pytest.approx((last - first) / 2000)


def test_clusters_that_come_close_in_another_sweep_are_one():
    """The second sweep's first cluster bridges two of the first's. Its second is far from all."""
    first = line([0.0, 1.0, 5.0, 1.5], [0, 1, 2, -1])
    second = line([0.5, 9.0, 4.5, 2.0], [0, 1, 2, -1])
    merged = Batch.of((0, 1), [first, second], Clock(np.array([0, 50]) * MS)).obstacles
    a, b, c, nothing, bridge, far, near_c, nor_this = merged.cluster.tolist()
    assert a == b == bridge and c == near_c and len({a, c, far}) == 3
    assert nothing == nor_this == -1
    assert merged.num_clusters == 3 and {a, c, far} == {0, 1, 2}


def at_20_hz(scene: Scene, frames: range) -> Stretch:
    """The sweeps in half the time: everything is twice as fast."""

    def fast(registered: RegisteredSweep) -> RegisteredSweep:
        sweep = registered.sweep
        assert sweep.offset_ns is not None
        stamp_ns, offset_ns = sweep.stamp_ns // 2, sweep.offset_ns // 2
        return replace(registered, sweep=replace(sweep, stamp_ns=stamp_ns, offset_ns=offset_ns))

    middle = frames[len(frames) // 2]
    return Stretch(tuple(fast(s) for s in scene.stretch(middle, len(frames) // 2).sweeps))


def test_two_sweeps_show_what_is_too_small_in_one():
    """Six points a sweep are too few to start a track."""
    mover = car(36, 7, 3.0, 1, yaw=-np.pi / 2, size_m=(1.0, 1.0, 1.6))
    scanner = Scanner(num_beams=32, num_azimuths=400, sigma_m=0.01)
    scene = Scene(World((*street(), mover)), Arc(0, -1.5, 0, 2.0), scanner)
    frames = range(9, 20)
    on = {f: scene.scan(f).instance == 1 for f in frames}
    assert np.median([rows.sum() for rows in on.values()]) == 6
    stretch = at_20_hz(scene, frames)
    motion = motion_in(stretch, ground(stretch))
    errors_m = []
    for f in frames[:-1]:
        flow = motion.flow(f, f + 1)
        assert flow.moving[on[f]].mean() > 0.6 and not flow.moving[scene.scan(f).instance < 0].any()
        off = np.linalg.norm(flow.displacement - scene.displacement(f, f + 1), axis=1)
        errors_m.append(off[on[f] & flow.moving])
    assert np.concatenate(errors_m).mean() < 0.1  # of 0.3
