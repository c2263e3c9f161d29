# SPDX-License-Identifier: MIT
"""Where tracks start and how fast, and the test that confirms them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.tracking.candidates import Obstacles, find_candidates
from densify.flow.tracking.following import DistanceField, Group, find_starts, vote
from densify.flow.tracking.likelihood import (
    Evidence,
    Places,
    Violations,
    count_vacated_places,
    fitted_weights,
    judge,
)
from densify.flow.tracking.objects import MovingObject, Observation, Shape, Track
from densify.flow.tracking.tracks import find_tracks
from densify.free_space.ground import ground
from densify.free_space.range_image import FreeSpace
from densify.geometry.clock import Clock
from densify.geometry.types import Float
from tests.scenes import SWEEP_S, Arc, Box, Scanner, Scene, World, car, street

PERIOD_NS = 100_000_000


def clusters(sizes: list[int], seed_share: float = 1.0) -> Obstacles:
    """Clusters of these sizes, and as many points again that are no candidates."""
    cluster = np.repeat([*range(len(sizes)), -1], [*sizes, sum(sizes)])
    n = len(cluster)
    nth = np.concatenate([np.arange(s) for s in [*sizes, sum(sizes)]])
    size = np.repeat([*sizes, 1], [*sizes, sum(sizes)])
    seed = (cluster >= 0) & (nth < seed_share * size)
    return Obstacles(np.arange(n), np.zeros((n, 3)), np.zeros(n), seed, cluster, len(sizes))


def starts(sweeps: list[Obstacles]) -> list[tuple[int, int]]:
    """(sweep, size) in the order they are tried."""
    found = find_starts(sweeps, Clock(PERIOD_NS * np.arange(len(sweeps))))
    for i, members in found:
        assert len(set(sweeps[i].cluster[members])) == 1 and sweeps[i].candidate[members].all()
    return [(i, len(members)) for i, members in found]


def test_starts_in_the_middle_come_before_larger_ones_at_the_ends():
    """A factor 0.7 for every sweep nearer than five to an end."""
    rng = np.random.default_rng(0)
    sweeps = [clusters(rng.integers(10, 300, 3).tolist()) for _ in range(15)]
    worth = [n * 0.7 ** max(0, 5 - min(i, 14 - i)) for i, n in starts(sweeps)]
    assert len(worth) == 45 and worth == sorted(worth, reverse=True)


@pytest.mark.parametrize(
    ("size", "seed_share", "starts_one"), [(8, 1, 1), (7, 1, 0), (40, 0.35, 0), (0, 1, 0)]
)
def test_few_points_or_few_seeds_start_nothing(size, seed_share, starts_one):
    assert len(starts([clusters([size], seed_share)])) == starts_one


# --- the odds, by their figures -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("evidence", "moves"),
    [
        # free behind and ahead of it, and a motion that explains all violations
        (((200, 0, 300), (0, 100), (0, 100), 30.0, 0.1, 1.0), True),
        # few violations if static; a short way; off the smooth path
        (((10, 0, 300), (0, 100), (0, 100), 1.0, 1.0, 1.0), False),
        # limbs swing: violations are left
        (((200, 80, 700), (0, 30), (0, 30), 7.0, 0.1, 1.0), True),
        # the rest of a long object is there, on either side
        (((200, 0, 300), (100, 0), (0, 100), 30.0, 0.1, 1.0), True),
        (((200, 0, 300), (0, 0), (0, 0), 30.0, 0.1, 1.0), True),
        # far, and empty on one side
        (((280, 98, 700), (0, 1639), (2, 11), 40.0, 0.1, 1.0), True),
        # rings glide on a parked car
        (((108, 16, 1920), (14, 15), (42, 0), 5.4, 0.1, 1.0), False),
        # a guard rail seen between rings
        (((221, 0, 920), (111, 165), (349, 41), 92.0, 0.02, 6.7), False),
        # a tree's crown, a hedge: the motion leaves as many violations as there were
        (((56, 130, 400), (79, 30), (91, 10), 9.5, 0.3, 1.9), False),
        (((369, 415, 3190), (0, 0), (0, 0), 0.3, 0.13, 1.5), False),
    ],
)
def test_what_is_confirmed(evidence, moves):
    violations, before, after, *rest = evidence
    found = Evidence(Violations(*violations), Places(*before), Places(*after), *rest)
    assert (found.log_odds(fitted_weights()) > 0) == moves


def test_two_states_confirm_nothing():
    track = Track(np.zeros(3))
    for n in range(2):
        track.observations[n] = Observation(np.zeros(4), 0.1 * n, n * PERIOD_NS, (n,))
    assert not judge(track, [], SimpleNamespace(), []).moves


def test_the_weights_separate_the_tracks_of_a_street_that_had_no_part_in_the_fit():
    movers = car(6, 1.8, 9, 1), car(45, 1.8, 8, 2, yaw=np.pi), car(12, -1.6, 6, 3)
    walker = car(16, 3.6, 1.5, 4, yaw=-np.pi / 2, size_m=(0.5, 0.5, 1.7))
    leaves = [
        Box((6, 1.5, 2.0), Arc(x, y), solid=0.5) for x, y in ((8, 5.5), (15, -6), (-6, 6), (20, 5))
    ]
    scanner = Scanner(32, 900, (-25.0, 5.0), 0.02)
    scene = Scene(World((*street(), *leaves, *movers, walker)), EGO, scanner)
    stretch = scene.stretch(KEY, 5)
    space, heights = FreeSpace.of(stretch), ground(stretch)
    obstacles = find_candidates(stretch, space, heights)
    shares, log_odds = [], []

    def record(track, evidence):
        on = [
            scene.scan(KEY - 5 + i).instance[obstacles[i].row[rows]] >= 0
            for i, rows in track.claimed.items()
        ]
        shares.append(np.concatenate(on).mean())
        log_odds.append(evidence.log_odds(fitted_weights()))

    find_tracks(obstacles, space, heights, record=record)
    share, moves = np.array(shares), np.array(log_odds) > 0
    assert (share > 0.9).sum() > 5 and (share < 0.1).sum() > 5
    assert not moves[share < 0.1].any() and moves[share > 0.9].mean() > 0.8


# --- the odds, in scenes --------------------------------------------------------------------------

SPEED_M_S, KEY = 6.0, 6
EGO = Arc(0.0, -1.5, 0.0, 9.0)
CARS = [car(x, -4.0, SPEED_M_S, n) for n, x in enumerate((8.7, 2.0, -4.7))]


class Seen:
    """A scene as the judge sees it, and what seems to go through it at `SPEED_M_S`."""

    def __init__(self, *boxes: Box) -> None:
        self.scene = Scene(World((*street(), *boxes)), EGO, Scanner(sigma_m=0.01))
        stretch = self.scene.stretch(KEY, 5)
        self.space = FreeSpace.of(stretch)
        self.obstacles = find_candidates(stretch, self.space, ground(stretch))

    def track(self, boxes: list[int], begin_m: float) -> Track:
        """The returns of these boxes in a frame of 4.4 m that moves along; begin_m: where it begins
        at time 0, world."""
        track = Track(np.array([begin_m, -4.0, 1.0]))
        for i, c in enumerate(self.obstacles):
            scan, at_s = self.scene.scan(KEY - 5 + i), (KEY - 5 + i) * SWEEP_S
            ahead_m = scan.world[c.row, 0] - begin_m - SPEED_M_S * at_s
            on = np.isin(scan.box[c.row], np.array(boxes) + len(street()))
            track.claimed[i] = np.flatnonzero(on & (ahead_m > 0) & (ahead_m < 4.4))
            state = np.array([SPEED_M_S * SWEEP_S * i, 0.0, 0.0, 0.0])
            track.observations[i] = Observation(state, SWEEP_S * i, i * PERIOD_NS, (i,))
        track.smooth()
        return track

    def places(self, track: Track, *known: Track) -> np.ndarray:
        """[before, after] × [taken, empty]"""
        objects = [MovingObject(t, Shape.of(t.points_in(self.obstacles, t.claimed))) for t in known]
        return np.array(count_vacated_places(track, self.obstacles, self.space, objects, 0.2))


def test_a_fence_does_not_move():
    """It stops half of the rays, wherever a piece of it seems to be."""
    fence = Seen(Box((60.0, 0.06, 1.6), Arc(0.0, -4.0), solid=0.5))
    piece = fence.track([0], -7.0)
    places = fence.places(piece)
    assert (places[:, 0] > 10 * places[:, 1]).all()
    assert not judge(piece, fence.obstacles, fence.space, []).moves


def test_a_car_moves_though_others_go_close_before_and_behind():
    """Three cars in a row, 2.5 m from each other, none of them known."""
    row = Seen(*CARS)
    first, middle, last = (row.track([n], car.path.x - 2.1) for n, car in enumerate(CARS))
    taken = [row.places(middle, *known)[:, 0] for known in ((), (first,), (first, last))]
    assert (taken[0] > 20 * taken[2]).all() and taken[1].sum() > 20 * taken[2].sum()
    assert judge(middle, row.obstacles, row.space, []).moves


# --- votes ----------------------------------------------------------------------------------------


def _nearness(field: DistanceField, group: Group, velocities: Float) -> Float:
    found = np.zeros((len(velocities), len(group.points)), np.uint8)
    field.raise_nearness(found, group, velocities)
    return found / 255


def test_the_field_is_the_distance_between_voxels() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 4, (300, 3)) + [100, -50, 0]
    field = DistanceField.of(points, np.ones(300))
    asked = rng.uniform(-2, 6, (3000, 3)) + [100, -50, 0]
    voxel, occupied = (np.floor((p - field.low) / 0.2) for p in (asked, points))
    distance_m = 0.2 * np.linalg.norm(voxel[:, None] - occupied[None], axis=2).min(1)
    share = np.round(255 * np.minimum(distance_m / 0.6, 1)) / 255
    assert (share < 1).mean() > 0.1
    # A second before the points of the field, from the origin.
    found = _nearness(field, Group.of(np.zeros((1, 3)), np.zeros(1)), asked)
    np.testing.assert_allclose(1 - found[:, 0], share, atol=1e-12)
    together = Group.of(asked[:7] - asked[0], np.zeros(7))
    np.testing.assert_allclose(1 - _nearness(field, together, asked[:1])[0], share[:7], atol=1e-12)


@pytest.mark.parametrize("num_together", [1, 2])
@pytest.mark.parametrize("early_s", [0.0, 0.008])
def test_what_passes_is_measured_earlier_or_later_in_each_sweep(
    num_together: int, early_s: float
) -> None:
    """A car passes at 27 m/s, and each sweep measures it a little earlier in its turn than the one
    before: by the sweeps' own times it would be 2.2 m/s slower. Points of one sweep, and sweeps of
    one look, have times of their own too."""
    body = np.random.default_rng(3).uniform([-2.2, -0.9, 0], [2.2, 0.9, 1.4], (240, 3))
    body[:, 1] = np.where(np.abs(body[:, 0]) < 2.1, 0.9, body[:, 1])  # a side and both ends
    period_s, velocity = 0.1 / num_together, np.array([27.0, 0.4, 0.0])
    time_s = [
        period_s * i - early_s / num_together * (i - 5 * num_together) + 0.002 * body[:, 0]
        for i in range(11 * num_together)
    ]
    seen = [body + t[:, None] * velocity for t in time_s]
    of_sweeps = [DistanceField.of(p, t) for p, t in zip(seen, time_s, strict=True)]
    looks = [range(n * num_together, (n + 1) * num_together) for n in range(11)]
    middle_ns = [round(np.mean([period_s * j for j in look]) * 1e9) for look in looks]
    group = Group.of(*(np.concatenate([part[j] for j in looks[5]]) for part in (seen, time_s)))
    found = vote(
        group, 5, [[of_sweeps[j] for j in look] for look in looks], Clock(np.array(middle_ns))
    )
    np.testing.assert_allclose(found, velocity, atol=0.25)
