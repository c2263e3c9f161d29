# SPDX-License-Identifier: MIT
"""Where the search for tracks starts, and the ground under them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.tracking import proof, tracks
from densify.flow.tracking.candidates import Obstacles, find_candidates
from densify.flow.tracking.left_places import LeftPlaces, Places, left_places
from densify.flow.tracking.shapes import Body, Shape
from densify.flow.tracking.sightings import Sighting, Track
from densify.flow.tracking.starts import groups_to_start, is_part, velocities_of_traffic
from densify.free_space.ground import HeightMap, ground
from densify.free_space.seen_through import FreeSpace
from densify.geometry.clock import Clock
from tests.scenes import SWEEP_S, Arc, Box, Scanner, Scene, World, car, street

PERIOD_NS = 100_000_000


def standing(sizes: list[int], seed_share: float = 1.0) -> Obstacles:
    """Clusters of these sizes, and as many points again that are no candidates."""
    cluster = np.repeat([*range(len(sizes)), -1], [*sizes, sum(sizes)])
    n = len(cluster)
    nth = np.concatenate([np.arange(s) for s in [*sizes, sum(sizes)]])
    size = np.repeat([*sizes, 1], [*sizes, sum(sizes)])
    seed = (cluster >= 0) & (nth < seed_share * size)
    return Obstacles(np.arange(n), np.zeros((n, 3)), np.zeros(n), seed, cluster, len(sizes))


def starts(sweeps: list[Obstacles]) -> list[tuple[int, int]]:
    """(sweep, size) in the order they are tried."""
    found = groups_to_start(sweeps, Clock(PERIOD_NS * np.arange(len(sweeps))))
    for i, members in found:
        assert len(set(sweeps[i].cluster[members])) == 1 and sweeps[i].candidate[members].all()
    return [(i, len(members)) for i, members in found]


def followed(
    pose: Callable[[int], list[float]], num_sweeps: int, place: list[float], num_points: int
) -> Track:
    """At 10 Hz, with so many points in each sweep. pose: of the sweep's number."""
    sighted = {
        n: Sighting(np.array(pose(n)), 0.1 * n, n * 100_000_000, (n,)) for n in range(num_sweeps)
    }
    return Track(np.array(place), sighted, {n: np.arange(num_points) for n in range(num_sweeps)})


def places_left(told: tuple[tuple[int, int], tuple[int, int]]) -> LeftPlaces:
    """Places taken and empty, before an object came and after it left."""
    return LeftPlaces(*(Places(*side) for side in told))


RINGS = SimpleNamespace(scattered=False)


def is_proven(
    track: Track,
    space: SimpleNamespace,
    looks: tuple[int, int, int],
    told: tuple[tuple[int, int], tuple[int, int]],
    like_a_rail: bool = False,
) -> bool:
    """Whether a track is proven by so many looks, through it standing still, moved, and asked, and
    of places taken and empty, before it came and after it left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "_as_fast_as_measured", lambda *_: True)
        patch.setattr(proof, "_like_a_rail", lambda *_: like_a_rail)
        patch.setattr(proof, "contradictions", lambda *_: looks)
        patch.setattr(proof, "left_places", lambda *_: places_left(told))
        return proof.left_contradicted(track, [], space, []) is not None


def test_starts_in_the_middle_of_the_stretch_come_before_larger_ones_at_its_ends():
    """A factor 0.7 for every sweep nearer than five to an end."""
    rng = np.random.default_rng(0)
    sweeps = [standing(rng.integers(10, 300, 3).tolist()) for _ in range(15)]
    worth = [n * 0.7 ** max(0, 5 - min(i, 14 - i)) for i, n in starts(sweeps)]
    assert len(worth) == 45 and worth == sorted(worth, reverse=True)
    same = starts([standing([100])] * 15)
    assert [i for i, _ in same[:5]] == [5, 6, 7, 8, 9]  # far enough from either end: alike
    assert {i for i, _ in same[-2:]} == {0, 14}
    # 0.7 ** 5 = 0.17: from 6 times as many points the end wins
    assert starts([standing([594]), *[standing([100])] * 10])[0][0] != 0
    assert starts([standing([596]), *[standing([100])] * 10])[0][0] == 0


@pytest.mark.parametrize(
    ("size", "seed_share", "starts_one"), [(8, 1, 1), (7, 1, 0), (40, 0.35, 0)]
)
def test_few_points_or_few_seeds_start_nothing(size, seed_share, starts_one):
    assert len(starts([standing([size], seed_share)])) == starts_one


def test_no_candidates_no_starts():
    assert starts([standing([]), standing([])]) == []


def test_who_is_seen_well_once_only_may_drive_as_others_do():
    """Each velocity once, and no walker's."""
    bodies = []
    for speed_m_s in (30.0, -22.0, 30.6, 1.4):
        sighted = {
            n: Sighting(np.array([0.1 * speed_m_s * n, 0, 0, 0]), 0.1 * n, n * 100_000_000, (n,))
            for n in range(3)
        }
        track = Track(np.zeros(3), sighted, {n: np.arange(8) for n in range(3)})
        track.smooth()
        bodies.append(Body(track, Shape.of(np.eye(3))))
    found = list(velocities_of_traffic(SimpleNamespace(time_ns=100_000_000), bodies))
    np.testing.assert_allclose(found, [[30.0, 0, 0], [-22.0, 0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("left", "tried", "found"), [(np.inf, [4], 0.01), (0.1, [0, 4], 0.01), (0.001, [], 0.001)]
)
def test_a_front_that_slides_is_followed_from_where_its_side_shows(left, tried, found):
    """An unproven one from there only: 20 points where it starts, 8 in its first look, 30 in its
    last."""
    claimed = {2: np.arange(20), 0: np.arange(8), 1: np.arange(9), 3: np.arange(20)}
    claimed[4] = np.arange(30)
    sighted = {
        n: Sighting(np.array([1.3 * n, 0, 0, 0]), 0.1 * n, round(0.1 * n * 1e9), (n,))
        for n in claimed
    }
    side = np.stack([np.linspace(0, 3, 30), np.zeros(30), np.zeros(30)], 1)
    looks = [
        SimpleNamespace(seen=SimpleNamespace(points=side), sweeps=[n], begins=[0]) for n in range(5)
    ]
    asked = []

    def follow(rows, n, velocity, weight):
        asked.append(n)
        return Track(np.zeros(3), sighted, claimed), 0.01 if n == 4 else None

    search = SimpleNamespace(looks=looks, _follow=follow, _velocity_of=lambda *_: np.zeros(3))
    track = Track(np.zeros(3), sighted, claimed)
    _, contradicted = tracks._Search._again_from_its_ends(search, track, left, 1.0)
    assert asked == tried and contradicted == found


@pytest.mark.parametrize(
    ("gap_m", "scattered", "weights"),
    [(0.2, False, [1.0]), (0.7, False, [1.0, 0.5]), (0.7, True, [1.0])],
)
def test_heights_count_less_where_rings_lie_far_apart(gap_m, scattered, weights):
    sensors = SimpleNamespace(scattered=scattered)
    search = SimpleNamespace(_space=SimpleNamespace(sensors=sensors))
    np.testing.assert_allclose(tracks._Search._height_weights(search, gap_m), weights)


@pytest.mark.parametrize(("aside_m", "part"), [(0.0, True), (0.6, True), (1.4, False)])
def test_what_lies_close_to_a_proven_track_is_a_part_of_it(aside_m, part):
    """In half a second the body has gone 5 m; its points 0.5 m apart, what is close 0.7 m away."""
    body = np.stack([0.5 * np.arange(6), np.zeros(6), np.zeros(6)], 1)
    track = followed(lambda n: [1.0 * n, 0, 0, 0], 8, [0.0, 0, 0], 6)
    track.smooth()
    seen = SimpleNamespace(points=body + [5.0, aside_m, 0.0], time_s=np.full(6, 0.5))
    bodies = [Body(track, Shape.of(body))]
    assert is_part(bodies, SimpleNamespace(seen=seen), np.arange(6), 0.7) == part


@pytest.mark.parametrize(
    ("left", "bare", "asked", "proven"),
    [
        ({1.0: 0.001, 0.5: 0.0}, True, [1.0], 1.0),  # hardly contradicted
        ({1.0: 0.1, 0.3: 0.01}, True, [1.0, 0.3], None),  # not with all that it gathers
        ({1.0: 0.1, 0.5: 0.01}, True, [1.0, 0.5], 0.5),
        ({1.0: 0.1, 0.4: 0.01}, True, [1.0, 0.4], 1.0),  # which loses a point
        ({1.0: 0.1, 0.5: 0.09}, True, [1.0, 0.5], 1.0),  # about as well as before
        ({1.0: np.inf, 0.5: 0.0}, True, [1.0], None),  # left over for later
        ({0.5: 0.1}, True, [0.5], 0.5),
        ({0.5: 0.0}, False, [0.5], None),  # rings that glide over something parked
    ],
)
def test_doubtful_tracks_are_followed_again_with_heights_that_count_less(
    left, bare, asked, proven, monkeypatch
):
    tried, which = [], {}

    def follow(members, n, weight):
        tried.append(weight)
        track = Track(np.zeros(3), {}, {0: np.arange(19 if weight == 0.4 else 20)})
        which[id(track)] = weight, track
        return track, left[weight]

    for name in ("_gather", "_refine", "take_back_slides", "go_with_the_rest", "_claim_rays"):
        monkeypatch.setattr(tracks, name, lambda *_: None)
    monkeypatch.setattr(tracks, "may_be_a_rail", lambda *_: False)
    held = {0.3: None}
    monkeypatch.setattr(
        tracks, "share_contradicted", lambda track, *_: held.get(which[id(track)][0], 0.0)
    )
    places = LeftPlaces(Places(0 if bare else 9, 30), Places(0, 30))
    monkeypatch.setattr(tracks, "left_places", lambda *_: places)
    parts = dict.fromkeys(("_standing", "_space", "_ground", "free", "bodies"))
    search = SimpleNamespace(_followed=follow, **parts)
    track, found = tracks._Search._track_of(search, np.arange(8), 0, list(left))
    assert tried == asked and found == (proven is not None)
    assert not found or which[id(track)][0] == proven


def test_the_ground_rises_under_a_track():
    x, y = np.meshgrid(np.arange(-20, 20, 0.25), np.arange(-20, 20, 0.25))
    points = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], 1)
    ground = HeightMap.of([points])
    track = Track(np.array([-5.0, 2.0, 9.0]))
    for dx, dy in ((10, 0), (-6, 3), (0, 5)):
        rise_m = track.rise_m(ground, np.array([dx, dy, 77.0, 0.3]))
        assert rise_m == pytest.approx(0.1 * dx, abs=0.005)


@pytest.mark.parametrize(
    ("looks", "told", "num_seen", "proven"),
    [
        ((18, 0, 600), ((0, 0), (0, 18)), 10, True),  # a car far away, behind which there is sky
        ((18, 0, 600), ((1, 0), (0, 18)), 10, False),  # something stands where it was
        ((18, 0, 600), ((0, 0), (0, 7)), 10, False),
        ((18, 0, 600), ((0, 0), (0, 18)), 4, False),  # for a third of a second
        ((7, 0, 600), ((0, 0), (0, 18)), 10, False),
        ((18, 0, 2000), ((0, 0), (0, 18)), 10, False),  # of a hundred looks not one
        ((96, 20, 1480), ((0, 6), (0, 5)), 10, True),  # limbs of a walker
        ((96, 20, 1480), ((1, 6), (0, 5)), 10, False),
        ((96, 40, 1480), ((0, 6), (0, 5)), 10, False),
    ],
)
def test_less_proves_where_nothing_was_ever_seen_before_or_after(looks, told, num_seen, proven):
    track = followed(lambda n: [0.9 * n, 0, 0, 0], num_seen, [60.0, 0, 0], 8)
    clock = SimpleNamespace(time_s=0.1 * np.arange(11))
    space = SimpleNamespace(gap_m=lambda *_: 0.1, clock=clock, sensors=RINGS)
    assert is_proven(track, space, looks, told) == proven


@pytest.mark.parametrize(("num_seen", "proven"), [(3, False), (4, True)])
def test_three_places_prove_nothing_where_no_sweep_meets_the_points_of_the_last(num_seen, proven):
    """Crowns of trees far up, seen in every second look, may lie on a line."""
    track = followed(lambda n: [0.9 * n, 0, 0, 0], num_seen, [30.0, 0, 0], 8)
    sensors = SimpleNamespace(scattered=True)
    space = SimpleNamespace(
        gap_m=lambda *_: 0.1, clock=SimpleNamespace(time_s=0.1 * np.arange(11)), sensors=sensors
    )
    assert is_proven(track, space, (100, 0, 300), ((0, 100), (0, 100))) == proven


def test_a_short_way_far_from_the_scanner_proves_nothing():
    """Three places on a line may be chance where rings are a metre apart: a tree's leaves."""
    track = followed(lambda n: [0.24 * n, 0, 0, 0], 3, [44.0, 0, 0], 8)
    for gap_m, proven in ((0.5, True), (1.8, False)):
        space = SimpleNamespace(gap_m=lambda *_, gap_m=gap_m: gap_m, sensors=RINGS)
        assert is_proven(track, space, (100, 0, 300), ((0, 100), (0, 100))) == proven


@pytest.mark.parametrize(
    ("num_seen", "num_sweeps", "still", "proven"),
    [
        (3, 11, 100, False),
        (8, 11, 100, True),
        (3, 3, 100, True),
        (5, 11, 100, True),
        (5, 11, 50, False),  # hardly anything says that it does not stand
        (8, 11, 50, True),
    ],
)
def test_what_is_seen_for_long_may_be_contradicted_more(num_seen, num_sweeps, still, proven):
    track = followed(lambda n: [0.9 * n, 0, 0, 0], num_seen, [14.0, 0, 0], 8)
    clock = SimpleNamespace(time_s=0.1 * np.arange(num_sweeps))
    space = SimpleNamespace(gap_m=lambda *_: 0.1, clock=clock, sensors=RINGS)
    for moved in (still // 50, still // 5):
        found = is_proven(track, space, (still, moved, 300), ((0, 100), (0, 100)))
        assert found == (proven or moved == still // 50)


@pytest.mark.parametrize(
    ("still", "moved", "told", "proven"),
    [
        (185, 10, ((0, 12), (2, 9)), True),
        (185, 12, ((0, 12), (2, 9)), False),
        (168, 18, ((0, 140), (0, 4)), True),  # nothing was in a hundred of its places
        (168, 18, ((20, 140), (0, 4)), False),
        (168, 24, ((0, 140), (0, 4)), False),
    ],
)
def test_what_leaves_bare_places_may_be_seen_for_a_moment(still, moved, told, proven):
    """An oncoming car of which three sweeps see a few rings."""
    track = followed(lambda n: [-3.0 * n, 0, 0, 0], 3, [-14.0, 11, 0], 40)
    clock = SimpleNamespace(time_s=0.1 * np.arange(11))
    space = SimpleNamespace(gap_m=lambda *_: 0.3, clock=clock, sensors=RINGS)
    assert is_proven(track, space, (still, moved, 800), told) == proven


@pytest.mark.parametrize(("num_asked", "proven"), [(930, True), (500, False)])
def test_stray_looks_do_not_undo_what_is_seen_for_a_moment(num_asked, proven):
    """A far car at 33 m/s that four sweeps see; at most one look of 200 is an echo at its rim."""
    track = followed(lambda n: [-3.3 * n, 0, 0, 0], 4, [-33.0, 11, 0], 18)
    clock = SimpleNamespace(time_s=0.1 * np.arange(11))
    space = SimpleNamespace(gap_m=lambda *_: 0.3, clock=clock, sensors=RINGS)
    assert is_proven(track, space, (59, 4, num_asked), ((0, 45), (0, 45))) == proven


@pytest.mark.parametrize(
    ("told", "proven"),
    [
        (((953, 34), (689, 0)), False),  # a fence goes on on both sides
        (((92, 80), (0, 0)), True),  # others come and go where it was
        (((100, 0), (0, 100)), True),  # the rest of a long object is on one side
        (((0, 0), (0, 0)), True),
    ],
)
def test_what_is_mostly_still_there_does_not_move(told, proven):
    track = followed(lambda n: [0.9 * n, 0, 0, 0], 8, [14.0, 0, 0], 8)
    space = SimpleNamespace(gap_m=lambda *_: 0.1, clock=SimpleNamespace(time_s=np.arange(8) / 10))
    assert is_proven(track, space, (200, 0, 300), told) == proven


@pytest.mark.parametrize(
    ("told", "moved", "like_a_rail", "proven"),
    [
        (((0, 30), (0, 30)), 80, False, True),  # legs swing; the walker comes from and leaves bare
        (((1, 30), (0, 30)), 80, False, False),  # places
        (((0, 30), (0, 2)), 80, False, False),  # hardly anybody looked there
        (((0, 216), (8, 113)), 0, True, True),  # a long car that comes towards the scanner
        (((7, 30), (0, 30)), 0, True, False),
        (((0, 15), (0, 2)), 0, True, False),
    ],
)
def test_what_leaves_its_places_bare_may_swing_or_look_like_a_rail(
    told, moved, like_a_rail, proven
):
    track = followed(lambda n: [0.2 * n, 0, 0, 0], 8, [8.0, 0, 0], 8)
    space = SimpleNamespace(gap_m=lambda *_: 0.05, clock=SimpleNamespace(time_s=np.arange(8) / 10))
    assert is_proven(track, space, (200, moved, 700), told, like_a_rail) == proven
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "_like_a_rail", lambda *_: like_a_rail)
        patch.setattr(proof, "contradictions", lambda *_: (200, moved, 700))
        patch.setattr(proof, "left_places", lambda *_: places_left(told))
        assert proof.may_be_a_rail(track, [], space, []) == (like_a_rail and not proven)


@pytest.mark.parametrize(
    ("speed_m_s", "told", "proven"),
    [
        (12.0, ((0, 1639), (2, 11)), True),  # a long car beside the scanner, which turns
        (12.0, ((0, 80), (2, 11)), False),
        (12.0, ((0, 120), (9, 11)), False),
        (0.6, ((4, 0), (0, 276)), False),  # a bush
    ],
)
def test_bare_places_on_one_side_tell_of_what_goes_far(speed_m_s, told, proven):
    """A third of the looks that contradict standing still contradict its motion, too."""
    track = followed(lambda n: [0.1 * speed_m_s * n, 0, 0, 0], 8, [8.0, 0, 0], 8)
    space = SimpleNamespace(gap_m=lambda *_: 0.1, clock=SimpleNamespace(time_s=np.arange(8) / 10))
    assert is_proven(track, space, (280, 98, 700), told) == proven


@pytest.mark.parametrize(
    ("aside_m", "scattered", "told", "proven"),
    [
        (0.02, False, ((34, 37), (0, 0)), True),
        (0.15, False, ((0, 900), (0, 900)), False),
        (0.15, True, ((31, 0), (0, 410)), True),  # each sweep meets other places of a car
        (0.15, True, ((34, 26), (0, 11)), False),  # or of a hedge
        (0.4, True, ((0, 900), (0, 900)), False),
    ],
)
def test_without_rings_what_leaves_its_places_may_waver(aside_m, scattered, told, proven):
    track = followed(lambda n: [0.7 * n, aside_m * (-1) ** n, 0, 0], 10, [19.0, 4, 0], 8)
    clock = SimpleNamespace(time_s=np.arange(10) / 10)
    sensors = SimpleNamespace(scattered=scattered)
    space = SimpleNamespace(gap_m=lambda *_: 0.17, clock=clock, sensors=sensors)
    assert is_proven(track, space, (300, 0, 700), told) == proven


@pytest.mark.parametrize("still", [30, 80])
@pytest.mark.parametrize("told", [((0, 0), (0, 0)), ((0, 30), (0, 0))])
def test_a_ring_that_glides_over_a_bonnet_does_not_move_it(still, told):
    """Half a metre in a second, which one look of twenty contradicts."""
    track = followed(lambda n: [0.06 * n, 0, 0, 0], 9, [29.0, 0, 0], 20)
    space = SimpleNamespace(gap_m=lambda *_: 0.6, clock=SimpleNamespace(time_s=np.arange(9) / 10))
    proven = still == 80 or told[0] == (0, 30)
    assert is_proven(track, space, (still, 0, 700), told) == proven


@pytest.mark.parametrize(
    ("still", "moved", "told", "proven"),
    [
        (108, 16, ((14, 15), (42, 0)), False),
        (108, 16, ((2, 15), (0, 42)), True),  # it has left its places
        (293, 50, ((0, 0), (41, 73)), False),  # which something takes as often as not
        (108, 5, ((14, 15), (42, 0)), True),  # its motion explains what was seen
        (300, 16, ((14, 15), (42, 0)), True),  # many looks contradict that it stands
    ],
)
def test_rings_that_glide_over_a_parked_car_do_not_move_it(still, moved, told, proven):
    """A metre in a second, two rings of a car of which the rest is still there."""
    track = followed(lambda n: [0.12 * n, 0, 0, 0], 10, [18.0, 0, 0], 8)
    space = SimpleNamespace(gap_m=lambda *_: 0.4, clock=SimpleNamespace(time_s=np.arange(10) / 10))
    assert is_proven(track, space, (still, moved, 1920), told) == proven


@pytest.mark.parametrize(("along_rad", "rail"), [(0.0, True), (0.6, True), (np.pi / 2, False)])
def test_a_line_across_its_way_is_no_rail(along_rad, rail):
    """One ring on the back of a car ahead: its ends do not tell more, but the line itself does."""
    offset_m = np.linspace(-1.2, 1.2, 20)
    way = np.array([np.cos(along_rad), np.sin(along_rad), 0])
    sighted, standing = {}, []
    for n in range(5):
        state = np.append(2.5 * n * way, 0)
        sighted[n] = Sighting(state, 0.1 * n, n * 100_000_000, (n,))
        line = np.stack([offset_m, 0 * offset_m, 0 * offset_m], 1) + state[:3]
        standing.append(SimpleNamespace(points=line, time_s=np.full(20, 0.1 * n)))
    track = Track(np.zeros(3), sighted, {n: np.arange(20) for n in range(5)})
    track.smooth()
    for still in (25, 35):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(proof, "contradictions", lambda *_, still=still: (still, 0, 100))
            patch.setattr(proof, "left_places", lambda *_: places_left(((9, 30), (0, 30))))
            found = proof.may_be_a_rail(track, standing, SimpleNamespace(), [])
        assert found == (rail and still < 30)  # a third of all looks is no chance


SPEED_M_S, KEY = 6.0, 6
EGO = Arc(0.0, -1.5, 0.0, 9.0)
FENCE = Box((60.0, 0.06, 1.6), Arc(0.0, -4.0), solid=0.5)
CARS = [car(x, -4.0, SPEED_M_S, n) for n, x in enumerate((8.7, 2.0, -4.7))]


class Seen:
    """A scene as the proof sees it, and what seems to go through it at `SPEED_M_S`."""

    def __init__(self, *boxes: Box) -> None:
        self.scene = Scene(World((*street(), *boxes)), EGO, Scanner(sigma_m=0.01))
        stretch = self.scene.stretch(KEY, 5)
        heights = ground(stretch)
        self.space = FreeSpace.of(stretch)
        found = find_candidates(stretch, self.space, heights, 0.2)
        self.standing = [Obstacles.of(stretch, i, c) for i, c in enumerate(found)]

    def track(self, boxes: list[int], begin_m: float) -> Track:
        """What the sweeps saw of these boxes of the scene in a frame of 4.4 m that goes along;
        begin_m: where it begins at time 0, world."""
        track = Track(np.array([begin_m, -4.0, 1.0]))
        for i, c in enumerate(self.standing):
            scan, at_s = self.scene.scan(KEY - 5 + i), (KEY - 5 + i) * SWEEP_S
            ahead_m = scan.world[c.row, 0] - begin_m - SPEED_M_S * at_s
            on = np.isin(scan.box[c.row], np.array(boxes) + len(street()))
            track.claimed[i] = np.flatnonzero(on & (ahead_m > 0) & (ahead_m < 4.4))
            state = np.array([SPEED_M_S * SWEEP_S * i, 0.0, 0.0, 0.0])
            track.sightings[i] = Sighting(state, SWEEP_S * i, i * PERIOD_NS, (i,))
        track.smooth()
        return track

    def told(self, track: Track, *proven: Track) -> np.ndarray:
        """[coming, gone] × [taken, empty]"""
        bodies = [Body(t, Shape.of(t.seen_in(self.standing, t.claimed))) for t in proven]
        return np.array(left_places(track, self.standing, self.space, bodies))


def test_what_is_still_there_when_it_is_gone_does_not_move():
    """A wire fence stops half of the rays, wherever a piece of it seems to be."""
    fence = Seen(FENCE)
    piece = fence.track([0], -7.0)
    told = fence.told(piece)
    assert (told[:, 0] > 10 * told[:, 1]).all()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "contradictions", lambda *_: (1000, 0, 3000))
        assert proof.left_contradicted(piece, fence.standing, fence.space, []) is None


def test_what_leaves_its_places_moves_though_others_go_close_before_and_behind():
    """Three cars in a row, 2.5 m from each other, none of them known."""
    row = Seen(*CARS)
    first, middle, last = (row.track([n], car.path.x - 2.1) for n, car in enumerate(CARS))
    taken = [row.told(middle, *known)[:, 0] for known in ((), (first,), (first, last))]
    assert (taken[0] > 20 * taken[2]).all() and taken[1].sum() > 20 * taken[2].sum()
    assert proof.left_contradicted(middle, row.standing, row.space, []) is not None
