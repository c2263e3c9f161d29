# SPDX-License-Identifier: MIT
"""Fast sweeps taken together: which, and what is seen then that single ones do not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import GroundSettings
from densify.flow.tracking import groups
from densify.flow.tracking.evidence import FreeSpace, Standing
from densify.flow.tracking.extent import Seen
from densify.flow.tracking.looks import looks_of
from densify.free_space.ground import ground
from densify.free_space.range_image import RangeImage
from densify.geometry.clock import Clock
from densify.geometry.poses import transform
from densify.geometry.types import RegisteredSweep, Stretch
from tests.found_motion import motion_in
from tests.scenes import Arc, Box, Scanner, Scene, World, car, street

MS = 1_000_000


def standing(x_m=(), cluster=(), time_s=0.0) -> Standing:
    """Points on a line."""
    n, label = len(x_m), np.array(cluster, np.int64)
    points = np.zeros((n, 3))
    points[:, 0] = x_m
    return Standing(
        np.arange(n), points, np.full(n, time_s), label >= 0, label, int(label.max(initial=-1)) + 1
    )


@pytest.mark.parametrize(
    ("time_ms", "together"),
    [
        ((0, 100, 201, 298, 398), ((0,), (1,), (2,), (3,), (4,))),
        ((0, 97, 194, 290), ((0,), (1,), (2,), (3,))),
        ((0, 200, 400), ((0,), (1,), (2,))),
        ((0, 50, 100, 150, 200), ((0, 1), (2, 3), (4,))),
        ((0, 54, 97, 150, 203, 246), ((0, 1), (2, 3), (4, 5))),
        ((0, 33, 67, 100, 133, 167), ((0, 1, 2), (3, 4, 5))),
        ((0, 50, 200, 250, 300, 350, 500), ((0, 1), (2, 3), (4, 5), (6,))),
        ((0,), ((0,),)),
    ],
    ids=["10 Hz", "10.3 Hz", "5 Hz", "20 Hz", "jitter", "30 Hz", "holes", "alone"],
)
def test_sweeps_within_a_tenth_of_a_second_are_one_look(time_ms, together):
    seen = [standing() for _ in time_ms]
    found = looks_of(seen, Clock(np.array(time_ms, np.int64) * MS))
    assert tuple(look.sweeps for look in found) == together
    for look in found:
        first, last = time_ms[look.sweeps[0]], time_ms[look.sweeps[-1]]
        assert look.time_ns == (first + last) * MS // 2
        assert look.half_s == pytest.approx((last - first) / 2000)
        if len(look.sweeps) == 1:
            assert look.seen is seen[look.sweeps[0]]


def test_rows_go_to_the_look_and_back():
    sizes = 4, 0, 3
    seen = [standing(np.arange(n), np.zeros(n, int), n) for n in sizes]
    (look,) = looks_of(seen, Clock(np.array([0, 33, 66]) * MS))
    assert look.seen.time_s.tolist() == [4, 4, 4, 4, 3, 3, 3]
    free = [np.array(c, bool) for c in ([1, 0, 1, 1], [], [0, 1, 0])]
    assert look.gather(free).tolist() == [1, 0, 1, 1, 0, 1, 0]
    own = look.split(np.array([0, 2, 4, 6]))
    assert {j: rows.tolist() for j, rows in own.items()} == {0: [0, 2], 2: [0, 2]}
    assert list(look.split(np.array([5]))) == [2]


def test_clusters_that_come_close_in_another_sweep_are_one():
    """The second sweep's first cluster bridges two of the first's; its second is far from all; what
    is no candidate bridges nothing."""
    first = standing([0.0, 1.0, 5.0, 1.5], [0, 1, 2, -1])
    second = standing([0.5, 9.0, 4.5, 2.0], [0, 1, 2, -1])
    (look,) = looks_of([first, second], Clock(np.array([0, 50]) * MS))
    a, b, c, nothing, bridge, far, near_c, nor_this = look.seen.cluster.tolist()
    assert a == b == bridge and c == near_c and len({a, c, far}) == 3
    assert nothing == nor_this == -1
    assert look.seen.num_clusters == 3 and {a, c, far} == {0, 1, 2}
    assert look.seen.seed.tolist() == [*first.seed, *second.seed]


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
    """Six points a sweep: too few to start from."""
    mover = car(36, 7, 3.0, 1, yaw=-np.pi / 2, size_m=(1.0, 1.0, 1.6))
    scanner = Scanner(num_beams=32, num_azimuths=400, sigma_m=0.01)
    scene = Scene(World((*street(), mover)), Arc(0, -1.5, 0, 2.0), scanner)
    frames = range(8, 21)
    on = {f: scene.scan(f).instance == 1 for f in frames}
    assert np.median([rows.sum() for rows in on.values()]) == 6
    stretch = at_20_hz(scene, frames)
    motion = motion_in(stretch, ground(stretch, GroundSettings()))
    errors_m = []
    for f in frames[:-1]:
        flow = motion.flow(f, f + 1)
        assert flow.moving[on[f]].mean() > 0.6 and not flow.moving[scene.scan(f).instance < 0].any()
        off = np.linalg.norm(flow.displacement - scene.displacement(f, f + 1), axis=1)
        errors_m.append(off[on[f] & flow.moving])
    assert np.concatenate(errors_m).mean() < 0.1  # of 0.3


def test_two_sweeps_of_half_the_columns_see_through_more_than_one_of_them():
    """Beside a post in front of a wall, nearly as close to the post as one sweep of all columns."""
    post, wall = Box((0.3, 0.3, 4.0), Arc(12, 0.7)), Box((0.5, 30, 8), Arc(20, 0))
    y_m, z_m = np.meshgrid(np.linspace(0, 1.4, 400), np.linspace(-0.5, 1.0, 4))
    beside = np.stack([np.full(y_m.size, 12.0), y_m.ravel(), z_m.ravel()], 1)
    free = {}
    for num_azimuths in (800, 400):
        scanner = Scanner(num_beams=32, num_azimuths=num_azimuths, sigma_m=0.01)
        scene = Scene(World((post, wall)), Arc(0, 0), scanner)
        stretch = scene.stretch(2, 2)
        if num_azimuths == 400:
            stretch = at_20_hz(scene, range(5))
        space = FreeSpace.of(stretch)
        T_world_lidar = stretch.sweeps[2].T_world_lidar
        free[num_azimuths] = space.seen_through(transform(T_world_lidar, beside), 2)
        own = stretch.sweeps[0].sweep.points
        standing = transform(stretch.sweeps[0].T_world_lidar, own)
        assert not space.seen_through(standing, 2).any()
    alone = RangeImage.of(stretch.sweeps[2]).sees_through(beside, 0.4, 0.015)
    one, half_and_half = free[800].sum(), free[400].sum()
    assert 1.05 * alone.sum() < half_and_half < one < 1.1 * half_and_half


def test_what_sweeps_of_a_look_see_near_objects_is_put_together():
    rng = np.random.default_rng(4)
    parts = [
        Seen(
            row=np.arange(n),
            points=rng.normal(size=(n, 3)),
            time_s=rng.random(n),
            height_m=rng.random(n).astype(np.float32),
            gap_m=rng.random(n),
            reach_m=rng.random(n),
            seed=rng.random(n) < 0.5,
        )
        for n in (3, 5)
    ]
    assert Seen.together(parts[:1]) is parts[0]
    together = Seen.together(parts)
    for name in ("row", "points", "time_s", "height_m", "gap_m", "reach_m", "seed"):
        column = getattr(together, name)
        np.testing.assert_array_equal(column[:3], getattr(parts[0], name))
        np.testing.assert_array_equal(column[3:], getattr(parts[1], name))
        assert column.dtype == getattr(parts[0], name).dtype
    low = parts[1].points[2]
    assert together.strips.rows_inside(low - 1e-9, low + 1e-9).tolist() == [5]


def test_objects_are_lengthened_by_what_the_sweeps_of_a_look_see_together(monkeypatch):
    asked = []

    def lengthen(instance, seen, *_):
        asked.append(len(seen.row))
        assert len(instance) == len(seen.row)

    scene = Scene(World((*street(), car(14, -1.6, 10, 1))), Arc(0, -1.5, 0, 6.0), Scanner(32, 360))
    stretch = scene.stretch(3, 2)
    heights = ground(stretch, GroundSettings())
    monkeypatch.setattr(groups, "lengthen", lengthen)
    motion_in(stretch, heights)
    alone, asked = asked, []
    monkeypatch.setattr(Clock, "looks", lambda _: ((0, 1), (2, 3), (4,)))
    motion = motion_in(stretch, heights)
    assert len(alone) == 5 and len(asked) == 3 and sum(asked) == sum(alone)
    for sweep, instance in zip(stretch.sweeps, motion.instance, strict=True):
        assert len(instance) == len(sweep.sweep) and (instance >= 0).any()
