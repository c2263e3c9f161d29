# SPDX-License-Identifier: MIT
"""The first known pixel in sixteen directions, and planes through pixels, by slow twins."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth.neighbours import DIRECTIONS, NONE, first_known, plane
from densify.geometry.compiled import Kernel


def twin(known, row, column, direction):
    """One step after the other."""
    if known[row, column]:
        return 0
    single, double = DIRECTIONS[direction]
    for k in range(1, NONE):
        u, v = (column, row) + (k // 2) * double + (k % 2) * single
        if not (0 <= u < known.shape[1] and 0 <= v < known.shape[0]):
            return NONE
        if known[v, u]:
            return k
    return NONE


def test_directions_go_once_round_in_steps_to_neighbours():
    angle = np.rad2deg(np.arctan2(DIRECTIONS[:, 1, 1], DIRECTIONS[:, 1, 0])) % 360
    np.testing.assert_allclose(angle, np.arange(16) * 22.5, atol=4.1)
    for step in (DIRECTIONS[:, 0], DIRECTIONS[:, 1] - DIRECTIONS[:, 0]):
        assert (np.abs(step).max(axis=1) == 1).all()


@pytest.mark.parametrize(("share", "size"), [(0.02, (23, 31)), (0.3, (9, 40)), (0.0, (5, 4))])
def test_steps_equal_those_of_a_slow_twin(share, size):
    known = np.random.default_rng(3).random(size) < share
    steps = first_known(known)
    for d, row, column in np.ndindex(steps.shape):
        assert steps[d, row, column] == twin(known, row, column, d), (d, row, column)


def test_pixels_too_far_away_are_not_known():
    known = np.zeros((1, 400), bool)
    known[0, 0] = True
    assert first_known(known)[8, 0, [0, 1, 254, 255, 399]].tolist() == [0, 1, 254, NONE, NONE]


def test_planes_are_those_of_weighted_least_squares():
    rng = np.random.default_rng(4)
    (u, v, w), weight = rng.normal(size=(3, 30)), rng.uniform(0.1, 1, 30)
    sums = [(weight * a).sum() for a in (1, u, v, u * u, u * v, v * v, w, u * w, v * w)]
    root = np.sqrt(weight)
    expected = np.linalg.lstsq(np.stack([root, root * u, root * v], 1), root * w, rcond=None)[0]
    found = np.zeros(3)
    _plane(np.array(sums), found)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@Kernel
def _plane(m, found):
    found[0], found[1], found[2] = plane(m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], 0.0)
