# SPDX-License-Identifier: MIT
"""Moving groups: what moves is found and moved right, as a whole, and nothing else moves at all."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.tracking.candidates import Strips
from densify.flow.tracking.extent import find_shape
from densify.flow.tracking.groups import join_pieces
from densify.flow.tracking.objects import Observation, Track
from densify.free_space.range_image import FreeSpace
from densify.geometry import poses
from densify.geometry.clock import Clock
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
        (TURNING, 3.0, NOISE, KEY, 4, (3, 0.6, 0.5, 0.05, 2e-4)),
        # a flat back that is followed for long: only its ends tell where it is, and errors add up
        (car(10, -1.5, 6, 1), 4.0, FLAT_BACK, 8, 6, (3, 0.95, 0.9, 0.03, 1e-3)),
        # most of a long side that passes does not tell how fast: from farther away its front does
        (
            car(24 * PASSING_S, 3, 24, 1, yaw=np.pi, size_m=TRUCK_M),
            0.0,
            Scanner(32, 540, (-24.8, 2.0), 0.01),
            7,
            6,
            (6, 0.95, 0.9, 0.3, 1e-3),
        ),
        # a truck 25 m ahead in the next lane, on which columns of rays lie more than a metre apart
        (car(33, 2.2, 13, 1, size_m=TRUCK_M), 12.0, SIXTY_FOUR, KEY, 5, (3, 0.97, 0.95, 0.1, 1e-3)),
        # a bus beside the scanner: only its ends are ever seen through
        (
            car(4, 2.6, 3, 1, size_m=(18.0, 2.5, 3.0)),
            6.0,
            NOISE,
            KEY,
            4,
            (4, 0.99, 0.99, 0.08, 1e-4),
        ),
    ],
    ids=["turning truck", "flat back", "passing truck", "wide columns", "bus"],
)
def test_a_surface_that_hardly_shows_its_motion_is_one_object_and_does_not_slide(
    box, speed_m_s, scanner, middle, size, expected
):
    """expected: sweeps around the key, least share that moves, quantile and bound of the errors,
    greatest share of static points that move."""
    reach, least_moving, quantile, error_m, false_share = expected
    scene = Scene(World((*street(), box)), Arc(0, -1.5, 0, speed_m_s), scanner)
    found = Found.around(middle, scene, size)
    assert found.share_moving(1, reach) > least_moving
    assert np.quantile(found.errors_m(1, reach), quantile) < error_m
    assert found.false_share() < false_share


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


# --- extent ---------------------------------------------------------------------------------------


EXTRA = len(street())  # number of the first box that a test adds
PARKED_M = (4.2, 1.8, 1.4)


def marked(found: Found, box: int) -> np.ndarray:
    """Which of the box's returns, of all sweeps, move."""
    return np.concatenate([f.moving[s.box == box] for _, s, f in found.near_key(4)])


def test_a_parked_car_in_line_stays():
    """As wide and as high as the one that leaves, and at first so close behind it."""
    rear, y, speed_m_s = 14.0, 2.2, 4.0
    leaving = car(rear + 0.5 * PARKED_M[0] - 0.1 * speed_m_s, y, speed_m_s, 1, size_m=PARKED_M)
    parked = Box(PARKED_M, Arc(rear - 0.4 - 0.5 * PARKED_M[0], y), 0.15)
    found = Found.of([leaving], extra=[parked])
    still = marked(found, EXTRA)
    assert len(still) > 10_000 and not still.any()
    assert found.share_moving(1, 4) > 0.85
    assert np.quantile(found.errors_m(1, 4), 0.9) < 0.05


def test_a_wall_that_somebody_walks_along_stays():
    """It goes on from him without a hole and nothing is ever seen through it, but it is still there
    where he has been."""
    wall = Box((16.0, 0.2, 1.9), Arc(12.0, 3.42))
    found = Found.of([car(9, 3.0, 1.6, 1, size_m=(0.8, 0.6, 1.75))], extra=[wall])
    still = marked(found, EXTRA)
    assert found.share_moving(1, 4) > 0.9
    assert len(still) > 20_000 and still.mean() < 0.04  # an arm's length of it


def test_the_wall_behind_a_walker_is_no_part_of_the_shape():
    """Every sweep claims 2.6 m of the wall along with the walker."""
    body = np.random.default_rng(0).uniform((-0.2, -0.2, 0), (0.2, 0.2, 1.7), (120, 3))
    x, z = np.meshgrid(np.arange(-3, 6, 0.1), np.arange(0, 2.4, 0.1))
    wall = np.stack([x.ravel(), np.full(x.size, 0.6), z.ravel()], 1)
    track, obstacles, clock = Track(np.zeros(3)), [], Clock(np.arange(9) * 100_000_000)
    for i in range(9):
        state = np.array([0.12 * i, 0.0, 0.0, 0.0])
        points = np.concatenate([body + state[:3], wall])
        beside = np.abs(wall[:, 0] - state[0]) < 1.3
        track.observations[i] = Observation(state, 0.1 * i, i * 100_000_000, (i,))
        track.claimed[i] = np.flatnonzero(np.append(np.ones(120, bool), beside))
        seed, time_s = np.arange(len(points)) < 120, np.full(len(points), 0.1 * i)
        sweep = SimpleNamespace(points=points, time_s=time_s, seed=seed, strips=Strips(points))
        obstacles.append(sweep)
    track.smooth()
    space = SimpleNamespace(gap_m=lambda *_: 0.05, clock=clock)
    shape = find_shape(track, obstacles, space)
    assert len(shape.points) > 0.9 * 9 * 120 and shape.points[:, 1].max() < 0.3


@pytest.fixture(scope="module")
def hill() -> Found:
    """One car drives ahead, one comes towards."""
    movers = car(12, -1.6, 10, 1), car(25, 1.6, 14, 2, yaw=np.pi)
    world = World((*street(), *movers), -0.08)
    return Found.around(KEY, Scene(world, Arc(0, -1.5, 0, 6.0), NOISE), 4)


def test_what_moves_rises_and_falls_with_the_ground(hill):
    for frame, target in [(1, 9), (8, 1), (4, 6)]:
        flow, true = hill.motion.flow(frame, target), hill.scene.displacement(frame, target)
        for instance in (1, 2):
            on = (hill.scene.scan(frame).instance == instance) & flow.moving
            assert np.abs(true[on, 2]).min() > 0.09
            np.testing.assert_allclose(flow.displacement[on, 2], true[on, 2], atol=0.015)


def test_an_object_is_one_object_on_a_hill(hill):
    """Downhill its roof is hit by rings more than a metre apart, each of which, followed alone,
    would stay behind."""
    assert len(hill.motion.tracks) == 2
    for instance in (1, 2):
        assert hill.share_moving(instance, 4) > 0.9
        assert np.quantile(hill.errors_m(instance, 4), 0.99) < 0.02


# --- pieces of one object -------------------------------------------------------------------------


AHEAD = car(9, 1.8, 8, 1)


@cache
def found(*gaps_m: float) -> tuple[Found, FreeSpace]:
    """A car ahead at 8 m/s, and others as fast, so far ahead of it in its lane."""
    movers = [AHEAD, *(car(9 + 4.3 + gap, 1.8, 8, 2 + n) for n, gap in enumerate(gaps_m))]
    scene = Found.of(movers)
    return scene, FreeSpace.of(scene.stretch)


def numbers(part_of: Callable[[np.ndarray], np.ndarray], *speeds_m_s: float) -> np.ndarray:
    """The numbers of the pieces of the car ahead.

    part_of: function of (N,) metres ahead of the middle of its points that returns the piece of
    each point, -1 for none. speeds_m_s: by how much the pieces' own paths are too fast.
    """
    scene, space = found()
    motion, pieces = scene.motion, []
    k = scene.track_of(1)
    track = motion.tracks[k]
    every = []
    for registered, instance in zip(scene.stretch.sweeps, motion.track_of_point, strict=True):
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        own = motion.object_of_track[instance] == motion.object_of_track[k]
        every.append((points, own & (instance >= 0)))
    times_s = space.clock.time_s
    along = [track.undo(points, s)[:, 0] for (points, _), s in zip(every, times_s, strict=True)]
    middle = np.median(np.concatenate([x[own] for x, (_, own) in zip(along, every, strict=True)]))
    for x, (_, own) in zip(along, every, strict=True):
        pieces.append(np.where(own, part_of(x - middle), -1).astype(np.int32))
    tracks = []
    for too_fast_m_s in speeds_m_s:
        path, wrong = track.path, copy(track)
        mid_s = (path.begin_s + path.end_s) / 2
        off = np.array([too_fast_m_s, 0, 0, 0])
        # The coefficients of a straight line are its values, from one span before the path on.
        num = len(path.coefficients)
        at_s = path.begin_s + (path.end_s - path.begin_s) / (num - 3) * np.arange(-1, num - 1)
        coefficients = path.coefficients + (at_s - mid_s)[:, None] * off
        wrong.path = type(path)(coefficients, path.begin_s, path.end_s, path.residual_m)
        tracks.append(wrong)
    object_of_track, _ = join_pieces(scene.stretch, tracks, pieces, space)
    return object_of_track


def halves(x: np.ndarray) -> np.ndarray:
    return (x > 0).astype(int)


def apart(hole_m: float) -> Callable[[np.ndarray], np.ndarray]:
    """Pieces behind and ahead of a hole without points."""
    return lambda x: np.where(x < 0.5 - hole_m / 2, 0, np.where(x > 0.5 + hole_m / 2, 1, -1))


def inside(x: np.ndarray) -> np.ndarray:
    return ((x > 1.0) & (x < 1.5)).astype(int)


@pytest.mark.parametrize(
    ("part_of", "too_fast_m_s", "num_objects"),
    [
        (halves, 0, 1),
        (apart(1.0), 0, 1),  # nothing was seen between
        (halves, 0.5, 1),  # followed badly
        (halves, 4.0, 2),  # another motion
        (inside, 4.0, 1),  # whatever its path
    ],
)
def test_pieces_that_touch_and_move_alike_are_one(part_of, too_fast_m_s, num_objects) -> None:
    assert len(set(numbers(part_of, 0, too_fast_m_s))) == num_objects


def test_the_number_is_that_of_the_largest_piece() -> None:
    assert numbers(lambda x: (x < 0.2).astype(int), 0, 0).tolist() == [1, 1]


def test_cars_in_a_queue_stay_apart() -> None:
    scene, _ = found(3.0)
    assert scene.track_of(1) != scene.track_of(2)
    assert scene.share_moving(1) > 0.9 and scene.share_moving(2) > 0.5


def test_flow_names_one_object_for_all_pieces() -> None:
    scene, _ = found()
    for _, scan, flow in scene.near_key():
        on = (scan.instance == 1) & flow.moving
        assert len(np.unique(flow.instance[on])) == 1
