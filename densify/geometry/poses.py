# SPDX-License-Identifier: MIT
"""Rigid motions as (4,4) float64 matrices named ``T_target_source``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.types.rigid import inverse as inverse

if TYPE_CHECKING:
    from densify.geometry.arrays import Float

_ROWS = 8192  # at once: for more, OpenBLAS wakes threads that spin longer than the work takes


def transform(T_a_b: Float, points_b: Float) -> Float:
    """(4,4), (N,3) -> (N,3) points in a."""
    points_a = _product(points_b, T_a_b[:3, :3])
    points_a += T_a_b[:3, 3]
    return points_a


def rotate(T_a_b: Float, vectors_b: Float) -> Float:
    """(4,4), (N,3) -> (N,3) vectors in a."""
    return _product(vectors_b, T_a_b[:3, :3])


def _product(vectors: Float, R: Float) -> Float:
    """(N,3), (3,3) -> (N,3)."""
    product = np.empty(vectors.shape)
    for i in range(0, len(vectors), _ROWS):
        np.matmul(vectors[i : i + _ROWS], R.T, out=product[i : i + _ROWS])
    return product


def log(T_a_b: Float) -> Float:
    """(4,4) -> (6,) rotation vector (rad) and translation (m).

    The translation is the plain one, not the screw's: at the turn of a vehicle within a sweep
    (≤ 0.1 rad) the two paths differ by millimetres, and rotation and translation stay separate.
    """
    return np.concatenate([Rotation.from_matrix(T_a_b[:3, :3]).as_rotvec(), T_a_b[:3, 3]])


def exp(twist: Float) -> Float:
    """(6,) -> (4,4); inverse of `log`."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    T_a_b[:3, 3] = twist[3:]
    return T_a_b


def carried(T_a_b: Float, twist_b: Float) -> Float:
    """(4,4), (6,) -> (6,): the twist of a frame b, rad/s and m/s in b, as that of a frame a that is
    fixed to it (the adjoint)."""
    turn = T_a_b[:3, :3] @ twist_b[:3]
    return np.concatenate([turn, T_a_b[:3, :3] @ twist_b[3:] + np.cross(T_a_b[:3, 3], turn)])


def transform_each(twist: Float, points: Float) -> Float:
    """(N,6), (N,3) -> (N,3): every point moved by its own ``exp(twist)``."""
    moved: Float = Rotation.from_rotvec(twist[:, :3]).apply(points)
    moved += twist[:, 3:]
    return moved


def interpolate(T_world_a: Float, T_world_b: Float, fraction: float) -> Float:
    """The pose ``fraction`` of the way from a to b (0 gives a, 1 gives b; outside extrapolates)."""
    return T_world_a @ exp(fraction * log(inverse(T_world_a) @ T_world_b))
