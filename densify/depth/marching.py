# SPDX-License-Identifier: MIT
"""The first known pixel in each of sixteen directions, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool
from densify.geometry.compiled import Kernel

NONE = 255
"""Steps where there is no known pixel within 254."""


def _directions() -> NDArray[np.int64]:
    """(16,2,2) columns and rows: see `DIRECTIONS`."""
    axis, diagonal = (1, 0), (1, 1)
    quarter = [
        (axis, (2, 0)),
        (axis, (2, 1)),
        (diagonal, (2, 2)),
        ((0, 1), (1, 2)),
    ]
    turn = np.array([[0, -1], [1, 0]])
    table = [np.array(quarter) @ np.linalg.matrix_power(turn, k).T for k in range(4)]
    return np.concatenate(table).astype(np.int64)


DIRECTIONS = _directions()
"""(16,2,2) of (columns, rows), once round from the right by way of below: of each direction the
first step and the first two together. After k steps one is ``k // 2`` times the second and
``k % 2`` times the first away; each step goes to one of the eight neighbours."""


def first_known(known: Bool) -> NDArray[np.uint8]:
    """(H,W) -> (16,H,W): steps to the first known pixel in each of `DIRECTIONS`, 0 at a known pixel
    itself, `NONE` where there is none."""
    padded = np.full((len(DIRECTIONS), known.shape[0] + 4, known.shape[1] + 4), NONE, np.uint8)
    steps = padded[:, 2:-2, 2:-2]
    steps[:] = np.where(known, np.uint8(0), np.uint8(NONE))
    _march(DIRECTIONS, padded)
    return steps


@Kernel
def _march(directions, steps):  # type: ignore[no-untyped-def]
    """steps: (16,H,W), 0 where known, with a border of two pixels that stays as it is."""
    height, width = steps.shape[1:]
    for d in range(len(directions)):
        u1, v1, u2, v2 = directions[d].ravel()
        for i in range(2, height - 2):
            row = height - 1 - i if v2 > 0 else i  # what lies two steps on is done before
            here = steps[d, row, 2 : width - 2]
            if v2 == 0:
                for j in range(len(here)):
                    column = len(here) - 1 - j if u2 > 0 else j
                    before = steps[d, row, 2 + column + u1]
                    here[column] = 0 if here[column] == 0 else min(before, 254) + 1
                continue
            first = steps[d, row + v1, 2 + u1 : width - 2 + u1]
            second = steps[d, row + v2, 2 + u2 : width - 2 + u2]
            for j in range(len(here)):
                beyond = min(second[j], np.uint8(253)) + np.uint8(2)
                beyond = np.uint8(1) if first[j] == 0 else np.uint8(beyond)
                here[j] = np.uint8(0) if here[j] == 0 else beyond
