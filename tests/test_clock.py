# SPDX-License-Identifier: MIT
"""Which sweeps are near each other in time, at any rate and with holes."""

from __future__ import annotations

import numpy as np
import pytest

from densify.free_space.ground import ground
from densify.free_space.seen_through import REACH_S
from densify.geometry.clock import Clock
from densify.geometry.types import Stretch
from tests.found_motion import KEY, NOISE, motion_in
from tests.scenes import Arc, Scene, World, car, street

MS = 1_000_000


def regular(hz: float, num: int = 61) -> Clock:
    return Clock(np.rint(np.arange(num) * 1e9 / hz).astype(np.int64))


@pytest.mark.parametrize(("hz", "num_each_side"), [(2, 2), (9.66, 10), (10.3, 10), (25, 10)])
def test_a_second_around_is_asked_to_the_nearest_sweep_and_evenly(hz, num_each_side):
    clock, i = regular(hz), 30
    around = clock.around(i, REACH_S, 10)
    assert around == sorted(around) and i not in around
    apart = np.array(around) - i
    assert (-apart[::-1] == apart).all() and (apart > 0).sum() == num_each_side
    assert apart[-1] == round(hz * REACH_S) and np.ptp(np.diff(apart[apart > 0])) <= 1
    assert {i - 1, i + 1} < set(around)


def test_holes_and_jitter():
    """At 0, 100, 201, 298, then none for three periods, 598, 700 ms."""
    clock = Clock(np.array([0, 100, 201, 298, 598, 700]) * MS)
    assert clock.period_ns == 101 * MS
    assert clock.around(3, 0.3, 10) == [0, 1, 2, 4] and clock.around(3, 0.2, 10) == [1, 2]
    assert clock.near(2, 3, 0.1) and not clock.near(3, 4, 0.2) and clock.near(3, 4, 0.3)
    assert [clock.at(3, s) for s in (-0.2, -0.1, 0.1, 0.2, 0.4)] == [1, 2, 4, 4, 5]
    assert clock.at(5, 0.1) is None and clock.at(0, -0.1) is None
    assert clock.nearest(3, [0, 4, 5]) == 0 and clock.nearest(4, [2, 3, 5]) == 5
    assert clock.from_end_s(3) == pytest.approx(0.298) and clock.from_end_s(4) == 0.102
    assert clock.time_s[4] == pytest.approx(0.598)


def test_a_recording_with_sweeps_missing_is_one_that_is_slower_there():
    frames, movers = (0, 1, 2, 5, 6, 7, 8), (car(14, -1.6, 10, 1), car(-6, 3.0, 20, 2))
    scene = Scene(World((*street(), *movers)), Arc(0, -1.5, 0, 6.0), NOISE)
    whole = scene.stretch(KEY, 5)
    stretch = Stretch(tuple(whole[f] for f in frames))
    motion = motion_in(stretch, ground(stretch))
    for frame in frames:
        flow, scan = motion.flow(frame, KEY), scene.scan(frame)
        for mover in (1, 2):
            on = scan.instance == mover
            assert flow.moving[on].mean() > 0.8 and not flow.lost[on].any()
            off = flow.displacement - scene.displacement(frame, KEY)
            assert np.linalg.norm(off[on & flow.moving], axis=1).mean() < 0.15
        assert flow.moving[scan.instance < 0].mean() < 1e-3
