# SPDX-License-Identifier: MIT
"""Scene flow of two clouds: exactly nothing where nothing moved, and the motion where it did."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.flow.pair_groups import (
    MISSING,
    PairCloud,
    RigidMotion,
    _is_ambiguous,
    judge,
    surface_cost,
)
from densify.flow.two_clouds import estimate_flow

MOVED = np.array([0.8, 0.1, 0.0])
EVERYTHING = {"objective": {"static_prior": False}}
PAPER = {"flow": {"engine": "paper"}}


def walls(rng: np.random.Generator) -> np.ndarray:
    """Two walls 12 m apart and a pole, the same places every time but for noise."""
    x, z = np.meshgrid(np.arange(-8, 8, 0.4), np.arange(0, 3, 0.3))
    flat = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], 1)
    pole = np.stack([np.full(20, 6.0), np.zeros(20), np.linspace(0, 4, 20)], 1)
    world = np.vstack([flat + [0, 6, 0], flat - [0, 6, 0], pole])
    return world + 0.01 * rng.standard_normal(world.shape)


def box(rng: np.random.Generator, num_points: int = 400) -> np.ndarray:
    """A car's rear and side, sampled anew every time."""
    rear, side = rng.uniform(0, 1, (2, num_points // 2, 2))
    a = np.stack([np.full(len(rear), -1.0), 1.8 * rear[:, 0] - 0.9, 1.4 * rear[:, 1]], 1)
    b = np.stack([4 * side[:, 0] - 1, np.full(len(side), -0.9), 1.4 * side[:, 1]], 1)
    return np.vstack([a, b]) + 0.01 * rng.standard_normal((num_points, 3))


def clouds(seed: int, before, after) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target, and which source points are on boxes; before, after: where boxes stand."""
    rng = np.random.default_rng(seed)
    still = walls(rng)
    source = np.vstack([still, *(box(rng) + place for place in before)])
    target = np.vstack([walls(rng), *(box(rng) + place for place in after)])
    return source, target, np.arange(len(source)) >= len(still)


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return clouds(0, [np.zeros(3)], [MOVED])


@pytest.mark.parametrize("config", [None, PAPER], ids=["groups", "paper"])
def test_a_box_moves_between_walls_that_do_not(pair, config):
    source, target, moved = pair
    field, again = (estimate_flow(source, target, config) for _ in range(2))
    assert not field.displacement[~moved].any() and not field.moving[~moved].any()
    assert field.moving[moved].mean() > 0.9
    error = np.linalg.norm(field.displacement - MOVED, axis=1)[moved & field.moving]
    assert np.median(error) < 0.1
    assert len(np.unique(field.instance[field.moving])) == 1 and field.instance.dtype == np.int32
    assert np.array_equal(field.instance >= 0, field.moving)
    assert field.displacement.tobytes() == again.displacement.tobytes()
    assert field.instance.tobytes() == again.instance.tobytes()


def test_two_boxes_get_two_numbers():
    left = np.array([-6.5, 0, 0])
    source, target, _ = clouds(3, [np.zeros(3), left], [MOVED, left - MOVED])
    field = estimate_flow(source, target)
    first, second = np.arange(len(source))[-800:].reshape(2, 400)
    assert field.moving[first].mean() > 0.8 and field.moving[second].mean() > 0.8
    numbers = [set(field.instance[rows][field.moving[rows]].tolist()) for rows in (first, second)]
    assert not numbers[0] & numbers[1]
    assert np.median(field.displacement[first][:, 0]) > 0.6
    assert np.median(field.displacement[second][:, 0]) < -0.6


def test_what_vanished_does_not_jump_onto_what_stayed(pair):
    """It would come nearer to the target, but explain nothing there that stands unexplained."""
    stays = np.array([0.0, 1.8, 0])
    source, target, _ = clouds(8, [stays, stays - [0.8, 0, 0]], [stays])
    for cloud, other in ((source[:-200], target), (pair[0], pair[0])):
        field = estimate_flow(cloud, other)
        assert not field.moving.any() and not field.displacement.any() and not field.lost.any()
        assert (field.instance == -1).all()


def test_without_the_prior_everything_may_move(pair):
    field = estimate_flow(*pair[:2], EVERYTHING)
    assert field.moving.all() and (field.instance == -1).all() and not field.lost.any()
    assert np.linalg.norm(field.displacement, axis=1).min() > 0


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_initial_is_where_it_starts(sense):
    """Two places are equally far; the start decides."""
    far = np.array([5.0, 0, 0])
    source, target, moved = clouds(5, [np.zeros(3)], [far, -far])
    initial = np.where(moved[:, None], sense * (far - [0.2, 0, 0]), 0.0)
    field = estimate_flow(source, target, initial=initial)
    assert field.moving[moved].mean() > 0.85 and not field.moving[~moved].any()
    assert np.abs(np.median(field.displacement[moved], 0) - sense * far).max() < 0.2


# --- what proves that a group moved ---------------------------------------------------------------


def bar(num: int, length_m: float, yaw: float = 0.0) -> np.ndarray:
    """A level bar .3 m high and 5 cm thick."""
    x, y, z = np.random.default_rng(0).uniform(-0.5, 0.5, (3, num))
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return np.outer(length_m * x, along) + np.outer(0.05 * y, across) + np.outer(0.3 * z, [0, 0, 1])


@pytest.mark.parametrize("yaw", [0.0, 1.1])
@pytest.mark.parametrize(
    ("num", "length_m", "direction", "slides"),
    [
        (30, 1.7, np.pi / 2, False),  # the back of a car, far away, and it drives away
        (30, 1.7, np.pi / 2 + 0.1, False),
        (30, 1.7, 0.0, True),  # a rail along itself,
        (30, 1.7, 1.2, True),  # or to the rail beside
        (30, 4.0, np.pi / 2, True),  # no car is so wide
        (150, 1.7, np.pi / 2, True),  # or so low, so near
    ],
)
def test_a_level_bar_moves_only_as_the_back_of_a_far_car_does(
    num, length_m, direction, slides, yaw
):
    way = np.array([np.cos(yaw + direction), np.sin(yaw + direction), 0.0])
    assert _is_ambiguous(bar(num, length_m, yaw), way) == slides


WAY = np.array([1.3, -0.2, 0.0])


def corner(num: int, seed: int) -> np.ndarray:
    """The rear and the side of a car, noise of 1 cm."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 1, (2, num))
    rear = np.arange(num) % 2 == 0
    x, y = np.where(rear, 0.0, 3 * u), np.where(rear, 1.8 * u, 0.0)
    return np.column_stack([x, y, 1.3 * v]) + 0.01 * rng.standard_normal((num, 3))


def judged(target: np.ndarray, way: np.ndarray):
    source, cloud = corner(600, 1), PairCloud(target, np.ones(len(target)))
    motion = RigidMotion(np.append(way, 0.0), source.mean(0))
    return judge(0, np.arange(600), motion, PairCloud(source, np.zeros(600)), cloud)


@pytest.mark.parametrize("moved", [True, False])
def test_both_clouds_tell_whether_a_group_moved(moved):
    """The source shows where it was, the target where it is and that its old position is free."""
    gain = {}
    for share in (0.5, 1.0, 1.5):
        proposal = judged(corner(600, 2) + WAY * moved, share * WAY)
        assert proposal.moves() or not (moved and share == 1.0)
        assert moved or not proposal.moves()
        gain[share] = proposal.gain
    assert gain[1.0] > max(gain[0.5], gain[1.5]) + 50 if moved else max(gain.values()) < 0


def test_a_group_whose_old_position_is_still_taken_did_not_move():
    """As a static car with a second one where the first could have gone."""
    assert not judged(np.concatenate([corner(600, 2), corner(600, 3) + WAY]), WAY).moves()


def test_cost_is_that_of_a_normal_distribution():
    """The slow twin: the neighbours of one point after another."""
    cloud, points = corner(300, 4), corner(60, 5) + 0.05
    expected = []
    for point in points:
        far_m = np.linalg.norm(cloud - point, axis=1)
        near = cloud[np.argsort(far_m)[:12]]
        near = near[np.linalg.norm(near - point, axis=1) < 1.0]
        covariance = np.cov(near.T, ddof=0) + 0.1**2 * np.eye(3)
        off = point - near.mean(0)
        expected.append(min(off @ np.linalg.inv(covariance) @ off / 2, MISSING))
    np.testing.assert_allclose(surface_cost(cloud, points), expected, rtol=1e-6)
    assert 0.1 < np.mean(expected) < 2


def test_what_hangs_above_the_road_does_not_drive():
    """A crown 5 m up that the wind has moved, and the same as a bush on the ground."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-15, 15, (2, 4000))
    ground = np.column_stack([x, y, 0.01 * rng.standard_normal(4000)])
    bush = corner(900, 3) + [5.0, 2.0, 0.3]
    low, high = (
        estimate_flow(
            np.vstack([ground, bush + [0, 0, up]]), np.vstack([ground, bush + [0.7, 0, up]])
        )
        for up in (0.0, 5.0)
    )
    assert low.moving[4000:].mean() > 0.9 and not high.moving.any()


# --- bad input ------------------------------------------------------------------------------------

CLOUD, INTS = np.random.default_rng(0).normal(size=(60, 3)), np.arange(60)
NAN, INFINITE = CLOUD.copy(), CLOUD.copy()
NAN[7, 1], INFINITE[9] = np.nan, np.inf


@pytest.mark.parametrize(
    ("source", "target", "initial", "message"),
    [
        (np.empty((0, 3)), CLOUD, None, "source: got no points"),
        (CLOUD, np.empty((0, 3)), None, "target: got no points"),
        (CLOUD[:, :2], CLOUD, None, r"source: got shape \(60, 2\)"),
        (CLOUD, CLOUD[0], None, r"target: got shape \(3,\)"),
        (NAN, CLOUD, None, "source: 1 of 60 rows are NaN or infinite, the first is row 7"),
        (CLOUD, INFINITE, None, "target: 1 of 60 .*row 9"),
        (CLOUD, CLOUD, CLOUD[:-1], r"initial: got shape \(59, 3\)"),
        (CLOUD, CLOUD, NAN, "initial: 1 of 60"),
        ("points.bin", CLOUD, None, r"source: expected \(n,3\) numbers"),
    ],
)
@pytest.mark.parametrize("config", [None, EVERYTHING])
def test_bad_clouds_are_refused(source, target, initial, config, message):
    with pytest.raises(InputError, match=message) as caught:
        estimate_flow(source, target, config, initial)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["offset_ns", "lidar"])
@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (INTS, None, "target_{}: not given"),
        (None, INTS, "source_{}: not given"),
        (INTS[:-1], INTS, r"source_{}: got shape \(59,\)"),
        (INTS, INTS[:, None], r"target_{}: got shape \(60, 1\)"),
        (INTS, INTS * 1e-3, "target_{}: .*float64"),
        (["a"] * 60, INTS, "source_{}: .*expected .60,. whole numbers"),
    ],
)
def test_bad_columns_are_refused(name, source, target, message):
    columns = {f"source_{name}": source, f"target_{name}": target}
    with pytest.raises(InputError, match=message.format(name)) as caught:
        estimate_flow(CLOUD, CLOUD, **columns)
    assert "\n" not in str(caught.value)


def test_an_engine_of_recordings_is_refused():
    with pytest.raises(InputError, match="got 'npz:there', expected groups or paper"):
        estimate_flow(CLOUD, CLOUD, {"flow": {"engine": "npz:there"}})
