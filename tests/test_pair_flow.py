# SPDX-License-Identifier: MIT
"""Scene flow of two clouds: exactly nothing where nothing moved, and the motion where it did."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import InputError
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


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target, and which source points are the box that moved."""
    rng = np.random.default_rng(0)
    still = walls(rng)
    source = np.vstack([still, box(rng)])
    target = np.vstack([walls(rng), box(rng) + MOVED])
    return source, target, np.arange(len(source)) >= len(still)


def check_types(field, num_points):
    assert field.displacement.shape == (num_points, 3)
    assert field.displacement.dtype == np.float64
    assert field.moving.shape == field.instance.shape == field.lost.shape == (num_points,)
    assert field.moving.dtype == field.lost.dtype == bool
    assert field.instance.dtype == np.int32


def test_identical_clouds_do_not_move_at_all(pair):
    source, *_ = pair
    field = estimate_flow(source, source)
    check_types(field, len(source))
    assert not field.displacement.any()
    assert not field.moving.any() and (field.instance == -1).all() and not field.lost.any()


@pytest.mark.parametrize("config", [None, PAPER], ids=["groups", "paper"])
def test_a_box_moves_between_walls_that_do_not(pair, config):
    source, target, moved = pair
    field = estimate_flow(source, target, config)
    check_types(field, len(source))
    assert not field.displacement[~moved].any() and not field.moving[~moved].any()
    assert field.moving[moved].mean() > 0.9
    error = np.linalg.norm(field.displacement - MOVED, axis=1)[moved & field.moving]
    assert np.median(error) < 0.1
    assert len(np.unique(field.instance[field.moving])) == 1
    assert np.array_equal(field.instance >= 0, field.moving)


def test_two_boxes_get_two_numbers(pair):
    rng = np.random.default_rng(3)
    still = walls(rng)
    source = np.vstack([still, box(rng), box(rng) - [6.5, 0, 0]])
    target = np.vstack([walls(rng), box(rng) + MOVED, box(rng) - [6.5, 0, 0] - MOVED])
    field = estimate_flow(source, target)
    first, second = np.arange(len(source))[-800:].reshape(2, 400)
    assert field.moving[first].mean() > 0.8 and field.moving[second].mean() > 0.8
    numbers = [set(field.instance[rows][field.moving[rows]].tolist()) for rows in (first, second)]
    assert not numbers[0] & numbers[1]
    assert np.median(field.displacement[first][:, 0]) > 0.6
    assert np.median(field.displacement[second][:, 0]) < -0.6


def test_what_vanished_does_not_jump_onto_what_stayed(pair):
    """It would come nearer to the target, but explain nothing there that stands unexplained."""
    rng = np.random.default_rng(8)
    stays = np.array([0.0, 1.8, 0])
    source = np.vstack([walls(rng), box(rng) + stays, box(rng)[:200] + stays - [0.8, 0, 0]])
    target = np.vstack([walls(rng), box(rng) + stays])
    field = estimate_flow(source, target)
    assert not field.moving.any() and not field.displacement.any()


def test_without_the_prior_everything_may_move(pair):
    source, target, _ = pair
    field = estimate_flow(source, target, EVERYTHING)
    check_types(field, len(source))
    assert field.moving.all() and (field.instance == -1).all() and not field.lost.any()
    assert np.linalg.norm(field.displacement, axis=1).min() > 0


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_initial_is_where_it_starts(sense):
    """Two places are equally far; the start decides."""
    rng = np.random.default_rng(5)
    far = np.array([5.0, 0, 0])
    still = walls(rng)
    source = np.vstack([still, box(rng)])
    target = np.vstack([walls(rng), box(rng) + far, box(rng) - far])
    moved = np.arange(len(source)) >= len(still)
    initial = np.where(moved[:, None], sense * (far - [0.2, 0, 0]), 0.0)
    field = estimate_flow(source, target, initial=initial)
    assert field.moving[moved].mean() > 0.85 and not field.moving[~moved].any()
    assert np.abs(np.median(field.displacement[moved], 0) - sense * far).max() < 0.2


def test_same_bytes_every_time(pair):
    source, target, _ = pair
    a, b = (estimate_flow(source, target) for _ in range(2))
    assert a.displacement.tobytes() == b.displacement.tobytes()
    assert a.instance.tobytes() == b.instance.tobytes()


CLOUD = np.random.default_rng(0).normal(size=(60, 3))
NAN = CLOUD.copy()
NAN[7, 1] = np.nan
INFINITE = CLOUD.copy()
INFINITE[9] = np.inf


@pytest.mark.parametrize(
    ("source", "target", "initial", "message"),
    [
        (np.empty((0, 3)), CLOUD, None, "source: .*no points"),
        (CLOUD, np.empty((0, 3)), None, "target: .*no points"),
        (CLOUD[:, :2], CLOUD, None, r"source: .*\(60, 2\)"),
        (CLOUD, CLOUD[0], None, r"target: .*\(3,\)"),
        (NAN, CLOUD, None, "source: .*row 7"),
        (CLOUD, INFINITE, None, "target: .*row 9"),
        (CLOUD, CLOUD, CLOUD[:-1], "initial"),
        (CLOUD, CLOUD, NAN, "initial"),
        ("points.bin", CLOUD, None, "source"),
    ],
)
def test_bad_clouds_are_refused(source, target, initial, message):
    with pytest.raises(InputError, match=message) as caught:
        estimate_flow(source, target, initial=initial)
    assert "\n" not in str(caught.value)


def test_an_engine_of_recordings_is_refused():
    with pytest.raises(InputError, match="got 'npz:there', expected groups or paper"):
        estimate_flow(CLOUD, CLOUD, {"flow": {"engine": "npz:there"}})
