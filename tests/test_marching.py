# SPDX-License-Identifier: MIT
"""Steps to the first known pixel in sixteen directions, by a slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth.marching import DIRECTIONS, NONE, first_known


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
    rest = DIRECTIONS[:, 1] - DIRECTIONS[:, 0]
    for step in (DIRECTIONS[:, 0], rest):
        assert (np.abs(step).max(axis=1) == 1).all()


@pytest.mark.parametrize(("share", "size"), [(0.02, (23, 31)), (0.3, (9, 40)), (0.0, (5, 4))])
def test_steps_equal_those_of_a_slow_twin(share, size):
    known = np.random.default_rng(3).random(size) < share
    steps = first_known(known)
    for d, row, column in np.ndindex(steps.shape):
        assert steps[d, row, column] == twin(known, row, column, d), (d, row, column)


def test_what_is_too_far_away_is_not_known():
    known = np.zeros((1, 400), bool)
    known[0, 0] = True
    assert first_known(known)[8, 0, [0, 1, 254, 255, 399]].tolist() == [0, 1, 254, NONE, NONE]
