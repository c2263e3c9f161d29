# SPDX-License-Identifier: MIT
"""Where tracks start, and the test that confirms them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.tracking import proof
from densify.flow.tracking.candidates import Obstacles, find_candidates
from densify.flow.tracking.following import find_starts
from densify.flow.tracking.objects import MovingObject, Observation, Shape, Track
from densify.flow.tracking.proof import Places, PlacesLeft, find_places_left, violations_left
from densify.free_space.ground import ground
from densify.free_space.seen_through import FreeSpace
from densify.geometry.clock import Clock
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


# --- the proof, by its figures --------------------------------------------------------------------

EMPTY, FENCE, NOTHING = ((0, 100), (0, 100)), ((953, 34), (689, 0)), ((0, 0), (0, 0))


@pytest.mark.parametrize(
    ("step_m", "num_states", "gap_m", "counts", "places", "confirmed"),
    [
        (0.9, 8, 0.1, (200, 0, 300), EMPTY, True),
        (0.9, 2, 0.1, (200, 0, 300), EMPTY, False),  # two states
        (0.02, 8, 0.1, (200, 0, 300), EMPTY, False),  # a short way
        (0.24, 3, 0.5, (100, 0, 300), EMPTY, True),
        (0.24, 3, 1.8, (100, 0, 300), EMPTY, False),  # short, between rings far apart
        (0.9, 8, 0.1, (10, 0, 600), EMPTY, False),  # few violations if static
        (0.9, 8, 0.1, (200, 120, 700), EMPTY, False),  # the motion does not explain them
        (0.2, 8, 0.05, (200, 80, 700), ((0, 30), (0, 30)), True),  # limbs
        (0.2, 8, 0.05, (200, 80, 700), ((1, 30), (0, 30)), False),
        (0.9, 8, 0.1, (200, 0, 300), FENCE, False),  # a fence goes on, on both sides
        (0.9, 8, 0.1, (200, 0, 300), ((100, 0), (0, 100)), True),  # the rest of a long object
        (0.9, 8, 0.1, (200, 0, 300), NOTHING, True),
        (0.9, 3, 0.1, (100, 20, 300), EMPTY, False),  # three positions of a tree's crown
        (0.9, 3, 0.1, (100, 2, 300), EMPTY, True),
        (1.2, 8, 0.1, (280, 98, 700), ((0, 1639), (2, 11)), True),  # far, empty on one side
        (1.2, 8, 0.1, (280, 98, 700), ((0, 80), (2, 11)), False),
        (0.12, 10, 0.4, (108, 16, 1920), ((14, 15), (42, 0)), False),  # rings glide on a parked car
        (0.12, 10, 0.4, (300, 16, 1920), ((14, 15), (42, 0)), True),
    ],
)
def test_what_is_confirmed(step_m, num_states, gap_m, counts, places, confirmed, monkeypatch):
    """counts: violations if static, violations left, tests. places: taken and empty, before and
    after."""
    track = Track(np.array([20.0, 0, 0]))
    for n in range(num_states):
        state = np.array([step_m * n, 0, 0, 0])
        track.observations[n] = Observation(state, 0.1 * n, n * PERIOD_NS, (n,))
        track.claimed[n] = np.arange(8)
    space = SimpleNamespace(
        gap_m=lambda *_: gap_m, clock=SimpleNamespace(time_s=0.1 * np.arange(11))
    )
    monkeypatch.setattr(proof, "count_violations", lambda *_: counts)
    left = PlacesLeft(*(Places(*side) for side in places))
    monkeypatch.setattr(proof, "find_places_left", lambda *_: left)
    assert np.isfinite(violations_left(track, [], space, [])) == confirmed


@pytest.mark.parametrize(
    ("along_deg", "static", "rail"),
    [(0, 25, True), (34, 25, True), (90, 25, False), (0, 35, False)],
)
def test_a_line_that_moves_along_itself_may_be_a_rail(along_deg, static, rail, monkeypatch):
    offset_m = np.linspace(-1.2, 1.2, 20)
    way = np.array([np.cos(np.deg2rad(along_deg)), np.sin(np.deg2rad(along_deg)), 0])
    track, obstacles = Track(np.zeros(3)), []
    for n in range(5):
        state = np.append(2.5 * n * way, 0)
        track.observations[n] = Observation(state, 0.1 * n, n * PERIOD_NS, (n,))
        track.claimed[n] = np.arange(20)
        line = np.stack([offset_m, 0 * offset_m, 0 * offset_m], 1) + state[:3]
        obstacles.append(SimpleNamespace(points=line, time_s=np.full(20, 0.1 * n)))
    track.smooth()
    monkeypatch.setattr(proof, "count_violations", lambda *_: (static, 0, 100))
    left = PlacesLeft(Places(9, 30), Places(0, 30))
    monkeypatch.setattr(proof, "find_places_left", lambda *_: left)
    assert proof.is_rail(track, obstacles, SimpleNamespace(), []) == rail


# --- the proof, in scenes -------------------------------------------------------------------------

SPEED_M_S, KEY = 6.0, 6
EGO = Arc(0.0, -1.5, 0.0, 9.0)
CARS = [car(x, -4.0, SPEED_M_S, n) for n, x in enumerate((8.7, 2.0, -4.7))]


class Seen:
    """A scene as the proof sees it, and what seems to go through it at `SPEED_M_S`."""

    def __init__(self, *boxes: Box) -> None:
        self.scene = Scene(World((*street(), *boxes)), EGO, Scanner(sigma_m=0.01))
        stretch = self.scene.stretch(KEY, 5)
        self.space = FreeSpace.of(stretch)
        found = find_candidates(stretch, self.space, ground(stretch))
        self.obstacles = [Obstacles.of(stretch, i, c) for i, c in enumerate(found)]

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
        return np.array(find_places_left(track, self.obstacles, self.space, objects))


def test_a_fence_does_not_move(monkeypatch):
    """It stops half of the rays, wherever a piece of it seems to be."""
    fence = Seen(Box((60.0, 0.06, 1.6), Arc(0.0, -4.0), solid=0.5))
    piece = fence.track([0], -7.0)
    places = fence.places(piece)
    assert (places[:, 0] > 10 * places[:, 1]).all()
    monkeypatch.setattr(proof, "count_violations", lambda *_: (1000, 0, 3000))
    assert np.isinf(violations_left(piece, fence.obstacles, fence.space, []))


def test_a_car_moves_though_others_go_close_before_and_behind():
    """Three cars in a row, 2.5 m from each other, none of them known."""
    row = Seen(*CARS)
    first, middle, last = (row.track([n], car.path.x - 2.1) for n, car in enumerate(CARS))
    taken = [row.places(middle, *known)[:, 0] for known in ((), (first,), (first, last))]
    assert (taken[0] > 20 * taken[2]).all() and taken[1].sum() > 20 * taken[2].sum()
    assert np.isfinite(violations_left(middle, row.obstacles, row.space, []))
