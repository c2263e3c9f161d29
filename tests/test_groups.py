# SPDX-License-Identifier: MIT
"""Moving groups: what moves is found and moved right, and nothing else moves at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.found_motion import KEY, NOISE, Found, motion_in, toward_key
from tests.scenes import SWEEP_S, Arc, Box, Scanner, Scene, World, car, street

SPARSE = Scanner(32, 1080, (-30.7, 10.7), 0.01)
FOLIAGE = [
    Box((6, 1.5, 2.0), Arc(x, y), solid=0.5) for x, y in ((8, 5.5), (15, -6), (-6, 6), (20, 4.6))
]


@pytest.mark.parametrize(
    ("extra", "scanner", "ego"),
    [
        ((), Scanner(), Arc(0, -1.5, 0, 12.0, 0.2)),
        ((), NOISE, Arc(0, -1.5)),
        (FOLIAGE, Scanner(32, 900, (-25.0, 5.0), 0.02), Arc(0, -1.5, 0, 8.0, 0.1)),
    ],
    ids=["turning", "standing", "foliage, 32 beams"],
)
def test_a_static_world_has_no_flow_to_the_last_bit(extra, scanner, ego):
    found = Found.of((), ego, size=3, scanner=scanner, extra=extra)
    for flow in found.fields:
        assert not flow.moving.any() and not flow.lost.any()
        assert not flow.total.any() and not flow.velocity_m_s.any()
        assert (flow.instance == -1).all()


def test_guard_rails_seen_between_rings_stay():
    """They lie 6.5 and 7 m beside a vehicle at 25 m/s; 5 to 11 % of them moved with it."""
    rails = [Box((200.0, 0.08, 0.28), Arc(60.0, y), base_m=0.45) for y in (-7.0, 6.5)]
    posts = [Box((0.1, 0.1, 0.7), Arc(x, y)) for x in range(-40, 160, 4) for y in (-7.0, 6.5)]
    poles = [Box((0.3, 0.3, 6.0), Arc(x, y)) for x in range(-40, 160, 17) for y in (-16.0, 15.0)]
    highway = Scene(World((*rails, *posts, *poles)), Arc(0, 0, 0, 25.0), SPARSE)
    found = Found.around(8, highway, 5)
    assert not any(flow.moving.any() for flow in found.fields)


CAR, FAST, WALKER = 1, 2, 3
FLAT_BACK = Scanner(32, 540)


@pytest.fixture(scope="module")
def traffic() -> Found:
    return Found.of(
        [
            car(14, -1.6, 10, CAR),
            car(8, 1.6, 30, FAST),
            car(12, 3.4, 1.5, WALKER, yaw=-np.pi / 2, size_m=(0.5, 0.5, 1.7)),
        ]
    )


@pytest.mark.parametrize("instance", [CAR, FAST, WALKER], ids=["10 m/s", "30 m/s", "walker"])
def test_movers_are_found_and_moved_right(traffic, instance):
    assert traffic.share_moving(instance) > 0.7
    errors = traffic.errors_m(instance)
    assert np.median(errors) < 0.05
    assert np.quantile(errors, 0.9) < 0.08


def test_only_what_moves_is_displaced_and_nothing_to_its_own_sweep(traffic):
    for frame, flow in zip(traffic.stretch.frames, traffic.fields, strict=True):
        own = traffic.motion.flow(frame, frame)
        assert np.abs(own.displacement).max() < 1e-12
        assert np.array_equal(own.moving, flow.moving) and own.moving.any()
        assert np.linalg.norm(own.velocity_m_s[own.moving], axis=1).min() > 0.5
        for vectors in (flow.displacement, flow.to_reference, flow.velocity_m_s, own.displacement):
            assert not vectors[~flow.moving].any()
        assert np.array_equal(flow.moving, flow.instance >= 0)
        assert not flow.lost.any()


SIXTY_FOUR = Scanner(64, 1800, (-24.8, 2.0), 0.01)
TRUCK_M = (16.0, 2.5, 2.8)
PASSING_S = 7 * SWEEP_S  # until the middle sweep of the passing truck
TURNING = car(26, 1.5, 5, 1, yaw=np.pi * 0.75, turn_rad_s=0.4, size_m=(9.0, 2.4, 3.0))


@pytest.mark.parametrize(
    ("box", "speed_m_s", "scanner", "middle", "size", "expected"),
    [
        # its ends go different ways
        (TURNING, 3.0, NOISE, KEY, 4, (3, 0.6, 0.5, 0.05)),
        # a flat back that is followed for long: only its ends tell where it is, and errors add up
        (car(10, -1.5, 6, 1), 4.0, FLAT_BACK, 8, 6, (3, 0.95, 0.9, 0.03)),
        # most of a long side that passes does not tell how fast: from farther away its front does
        (
            car(24 * PASSING_S, 3, 24, 1, yaw=np.pi, size_m=TRUCK_M),
            0.0,
            Scanner(32, 540, (-24.8, 2.0), 0.01),
            7,
            6,
            (6, 0.95, 0.9, 0.3),
        ),
        # a truck 25 m ahead in the next lane, on which columns of rays lie more than a metre apart
        (car(33, 2.2, 13, 1, size_m=TRUCK_M), 12.0, SIXTY_FOUR, KEY, 5, (3, 0.97, 0.95, 0.1)),
        # a bus beside the scanner: only its ends are ever seen through
        (car(4, 2.6, 3, 1, size_m=(18.0, 2.5, 3.0)), 6.0, NOISE, KEY, 4, (4, 0.99, 0.99, 0.08)),
    ],
    ids=["turning truck", "flat back", "passing truck", "wide columns", "bus"],
)
def test_a_surface_that_hardly_shows_its_motion_is_one_object_and_does_not_slide(
    box, speed_m_s, scanner, middle, size, expected
):
    """expected: sweeps around the key, share that moves, quantile of the errors and its bound."""
    reach, least_moving, quantile, error_m = expected
    scene = Scene(World((*street(), box)), Arc(0, -1.5, 0, speed_m_s), scanner)
    found = Found.around(middle, scene, size)
    assert found.share_moving(1, reach) > least_moving
    assert np.quantile(found.errors_m(1, reach), quantile) < error_m
    assert found.false_share() < 2e-4


def test_same_bytes_every_time(traffic):
    motion = motion_in(traffic.stretch, traffic.ground)
    for frame, a in zip(traffic.stretch.frames, traffic.fields, strict=True):
        b = motion.flow(frame, toward_key(frame))
        assert a.total.tobytes() == b.total.tobytes()
        assert a.velocity_m_s.tobytes() == b.velocity_m_s.tobytes()
        assert a.instance.tobytes() == b.instance.tobytes()


def test_the_trailer_of_a_turning_truck_is_found():
    """Its long side slides along itself: nothing but the tractor tells how fast. Half of it is seen
    to move and goes where it does not point; the other half lies where it points."""
    tractor, lag_rad, wheelbase_m = Arc(20, 1.0, np.pi * 0.75, 4.0, 0.4), 0.45, 9.0
    at_key_s = KEY * SWEEP_S
    x, y, yaw = tractor.at(at_key_s)
    kingpin = np.array([x - 1.5 * np.cos(yaw), y - 1.5 * np.sin(yaw)])
    speed_m_s = tractor.speed_m_s * np.cos(lag_rad)
    turn_rad_s = tractor.speed_m_s * np.sin(lag_rad) / wheelbase_m
    yaw -= lag_rad
    begin = Arc(0.0, 0.0, yaw - turn_rad_s * at_key_s, speed_m_s, turn_rad_s)
    x, y = kingpin - 5.5 * np.array([np.cos(yaw), np.sin(yaw)]) - begin.at(at_key_s)[:2]
    trailer = replace(begin, x=x, y=y)
    boxes = [Box((5.5, 2.5, 3.2), tractor, 0.5, 1), Box((10.5, 2.5, 3.0), trailer, 0.9, 2)]
    found = Found.of(boxes, Arc(0, -1.5, 0, 2.0), 5, Scanner(64, 1800, (-24.8, 2.0), 0.01))
    assert found.share_moving(1) > 0.9
    assert found.share_moving(2) > 0.75
    assert np.median(found.errors_m(2)) < 0.05
    assert np.quantile(found.errors_m(2), 0.9) < 0.12
    assert found.false_share() < 1e-3


def test_a_flat_front_that_turns_does_not_slide_aside():
    """It goes where its heading does, and the front alone hardly tells where that is."""
    middle, turn_rad_s = 8, 0.4
    ego = Arc(0, -1.5, 0, 10)
    turning = Arc(0, 0, 0.15 - turn_rad_s * middle * SWEEP_S, 12, turn_rad_s)
    x, y, _ = np.array(ego.at(middle * SWEEP_S)) - turning.at(middle * SWEEP_S)
    box = Box((4.4, 1.8, 1.5), replace(turning, x=x - 14, y=y), 0.25, 1)
    scene = Scene(World((*street(60.0), box)), ego, FLAT_BACK)
    found = Found.around(middle, scene, 6)
    assert found.share_moving(1, reach=6) > 0.9
    assert np.quantile(found.errors_m(1, reach=6), 0.9) < 0.1


def test_cars_in_a_row_keep_their_own_motion():
    found = Found.of([car(8, 2.0, 11, 1), car(23, 2.0, 8, 2)], Arc(0, -1.5, 0, 8.0))
    assert found.track_of(1) != found.track_of(2)
    for instance in (1, 2):
        assert found.share_moving(instance) > 0.7
        assert np.quantile(found.errors_m(instance), 0.9) < 0.08


def test_a_car_that_passes_behind_a_pillar():
    standing = Box((0.8, 0.8, 5.0), Arc(15, -1.2))
    car_behind = car(22, 3, 9, 1, yaw=-np.pi / 2)
    pillar = Found.of([car_behind], Arc(0, -1.5, 0, 3.0), extra=[standing])
    assert pillar.share_moving(1) > 0.7
    # on both sides of the pillar it is the same car
    before = [f.instance[(s.instance == 1) & f.moving] for k, s, f in pillar.near_key() if k < KEY]
    after = [f.instance[(s.instance == 1) & f.moving] for k, s, f in pillar.near_key() if k > KEY]
    same = np.bincount(np.concatenate(before)).argmax()
    assert same == np.bincount(np.concatenate(after)).argmax()
    assert pillar.false_share() < 2e-4
    on_pillar = [f.moving[s.box == len(street())] for _, s, f in pillar.near_key()]
    assert not np.concatenate(on_pillar).any()


def test_two_walkers_who_meet_are_both_followed():
    """While they meet, they are one cluster, larger than before, that no rigid motion explains."""
    size_m = (0.5, 0.5, 1.7)
    there = car(9.25, -5.5, 1.5, 1, size_m=size_m)
    back = car(10.7, -4.5, 1.4, 2, yaw=np.pi, size_m=size_m)
    meeting = Found.of([there, back], size=5)
    for walker in (1, 2):
        assert meeting.share_moving(walker) > 0.95
        assert meeting.errors_m(walker).mean() < 0.06
    assert meeting.false_share() < 5e-4


def test_a_stretch_of_one_sweep_has_no_flow():
    found = Found.of([car(14, -1.6, 10, 1)], size=0)
    assert len(found.fields) == 1
    assert not found.fields[0].displacement.any() and not found.fields[0].moving.any()


@pytest.mark.parametrize(("frame", "target"), [(1, 9), (8, 1), (3, 4)])
def test_over_several_sweeps_it_stays_right(traffic, frame, target):
    """Truth goes from each point's firing over the time between the sweeps."""
    flow = traffic.motion.flow(frame, target)
    true = traffic.scene.displacement(frame, target)
    hops = abs(target - frame)
    for instance in (CAR, FAST, WALKER):
        on = (traffic.scene.scan(frame).instance == instance) & flow.moving & ~flow.lost
        off_m = (flow.displacement - true)[on]  # the lidar is level here
        assert np.median(np.linalg.norm(off_m[:, :2], axis=1)) < 0.015 + 0.003 * hops
        # the walker comes close to the kerb, about which the map of the ground is not sharp
        assert np.abs(off_m[:, 2]).max() < (0.025 if instance == WALKER else 0.005)
        assert np.linalg.norm(flow.displacement[on], axis=1).min() > 0.12 * hops


@pytest.mark.parametrize(("instance", "speed_m_s"), [(CAR, 10), (FAST, 30), (WALKER, 1.5)])
def test_velocity_is_the_derivative_and_true(traffic, instance, speed_m_s):
    for frame in (KEY - 1, KEY, KEY + 2):
        on = traffic.scene.scan(frame).instance == instance
        for target in (KEY - 1, KEY, KEY + 1):
            before, flow, after = (traffic.motion.flow(frame, target + i) for i in (-1, 0, 1))
            mine = on & flow.moving
            slope = (after.displacement - before.displacement)[mine] / (2 * SWEEP_S)
            # the path's own velocity at the middle of two sweeps; a soft path bends in between
            np.testing.assert_allclose(flow.velocity_m_s[mine], slope, atol=0.15)
            speeds_m_s = np.linalg.norm(flow.velocity_m_s[mine], axis=1)
            assert np.median(speeds_m_s) == pytest.approx(speed_m_s, abs=0.3)
