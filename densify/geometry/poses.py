# SPDX-License-Identifier: MIT
"""Compute with rigid motions: (4,4) float64 matrices named ``T_target_source``.

Some functions take (...,4,4).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.arrays import Float, Int

_ROWS = 8192  # at once; for more rows OpenBLAS wakes threads that spin longer than the work takes
_HOLD = 1e-9  # keeps points on a line from turning about it


def inverse(T_a_b: Float) -> Float:
    """Return ``T_b_a`` of poses (...,4,4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros(T_a_b.shape)
    T_b_a[..., :3, :3], T_b_a[..., 3, 3] = R_b_a, 1
    T_b_a[..., :3, 3:] = -R_b_a @ T_a_b[..., :3, 3:]
    return T_b_a


def transform(T_a_b: Float, points_b: Float) -> Float:
    """Return points (N,3) of frame b in frame a."""
    points_a = rotate(T_a_b, points_b)
    points_a += T_a_b[:3, 3]
    return points_a


def rotate(T_a_b: Float, vectors_b: Float) -> Float:
    """Return vectors (N,3) of frame b in frame a."""
    R, vectors_a = T_a_b[:3, :3].T, np.empty(vectors_b.shape)
    for i in range(0, len(vectors_b), _ROWS):
        np.matmul(vectors_b[i : i + _ROWS], R, out=vectors_a[i : i + _ROWS])
    return vectors_a


def log(T_a_b: Float) -> Float:
    """Return the (...,6) rotation vector (rad) and translation (m) of poses (...,4,4).

    The translation is the plain one, not that of the screw. At the turn of a vehicle within a sweep
    (≤ 0.1 rad) the two paths differ by millimetres, and rotation and translation stay separate.
    """
    turn = Rotation.from_matrix(T_a_b[..., :3, :3]).as_rotvec()
    return np.concatenate([turn, T_a_b[..., :3, 3]], axis=-1)


def exp(twist: Float) -> Float:
    """Return the poses (...,4,4) of (...,6), the inverse of `log`."""
    T_a_b = np.zeros((*twist.shape[:-1], 4, 4))
    T_a_b[..., :3, :3] = Rotation.from_rotvec(twist[..., :3]).as_matrix()
    T_a_b[..., :3, 3], T_a_b[..., 3, 3] = twist[..., 3:], 1
    return T_a_b


def twist_between(T_world_a: Float, T_world_b: Float, seconds: float) -> Float:
    """Return the (6,) twist per second (rad/s, m/s) from a to b, in the frame of a."""
    return log(inverse(T_world_a) @ T_world_b) / seconds


def twist_to(T_world_lidar: Float, stamp_ns: Int, i: int) -> Float:
    """Return the (6,) twist per second from pose i - 1 to pose i, of (n,4,4) at (n,) times."""
    seconds = (stamp_ns[i] - stamp_ns[i - 1]) * 1e-9
    return twist_between(T_world_lidar[i - 1], T_world_lidar[i], seconds)


def carried(T_a_b: Float, twist_b: Float) -> Float:
    """Return (...,6) twists of frames b as those of frames a fixed to them (the adjoint)."""
    R_a_b = T_a_b[..., :3, :3]
    turn = np.einsum("...ij,...j->...i", R_a_b, twist_b[..., :3])
    along = np.einsum("...ij,...j->...i", R_a_b, twist_b[..., 3:])
    return np.concatenate([turn, along + np.cross(T_a_b[..., :3, 3], turn)], axis=-1)


def transform_each(twist: Float, points: Float) -> Float:
    """Return points (N,3), each moved by its own ``exp(twist)``, (N,6)."""
    moved: Float = Rotation.from_rotvec(twist[:, :3]).apply(points)
    moved += twist[:, 3:]
    return moved


def interpolate(T_world_a: Float, T_world_b: Float, fraction: float) -> Float:
    """Return the pose ``fraction`` of the way from a (0) to b (1), extrapolated outside."""
    return T_world_a @ exp(fraction * log(inverse(T_world_a) @ T_world_b))


def fit_rigid(source: Float, target: Float) -> Float:
    """Return the (4,4) pose that moves (N,3) points nearest to others (Kabsch 1976).

    Points on a line do not turn about it, and a single point does not turn.
    """
    from_m, to_m = source.mean(axis=0), target.mean(axis=0)
    # einsum and not BLAS: its sums do not depend on the number of threads.
    spread = np.einsum("ni,nj->ij", target - to_m, source - from_m)
    spread += _HOLD * np.square(source - from_m).sum() * np.eye(3)
    left, _, right = np.linalg.svd(spread)
    T = np.eye(4)
    T[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    T[:3, 3] = to_m - T[:3, :3] @ from_m
    return T
