# SPDX-License-Identifier: MIT
"""Compute with rigid motions: (4,4) float64 matrices named ``T_target_source``.

Twists are (6,) vectors: rotation vector (rad), then translation (m), or both per second.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.arrays import Float, Int

_ROWS = 8192  # rows of a product; for more, OpenBLAS wakes threads that spin longer than they work
_HOLD = 1e-9  # relative weight of no rotation, which decides where points do not determine it


def inverse(T_a_b: Float) -> Float:
    """Return the inverse ``T_b_a`` (...,4,4) of poses ``T_a_b`` (...,4,4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros(T_a_b.shape)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3:] = -R_b_a @ T_a_b[..., :3, 3:]
    T_b_a[..., 3, 3] = 1
    return T_b_a


def transform(T_a_b: Float, points_b: Float) -> Float:
    """Return points (N,3), metres, that are given in frame b, in frame a."""
    points_a = rotate(T_a_b, points_b)
    points_a += T_a_b[:3, 3]
    return points_a


def rotate(T_a_b: Float, vectors_b: Float) -> Float:
    """Return vectors (N,3) that are given in the axes of frame b, in the axes of frame a."""
    R_b_a = T_a_b[:3, :3].T
    vectors_a = np.empty(vectors_b.shape)
    for begin in range(0, len(vectors_b), _ROWS):
        rows = slice(begin, begin + _ROWS)
        np.matmul(vectors_b[rows], R_b_a, out=vectors_a[rows])
    return vectors_a


def log(T_a_b: Float) -> Float:
    """Return the twists (...,6) of poses (...,4,4): rotation vector (rad), own translation (m)."""
    rotation = Rotation.from_matrix(T_a_b[..., :3, :3]).as_rotvec()
    return np.concatenate([rotation, T_a_b[..., :3, 3]], axis=-1)


def exp(twist: Float) -> Float:
    """Return the poses (...,4,4) of twists (...,6) in rad and m; the inverse of `log`."""
    T_a_b = np.zeros((*twist.shape[:-1], 4, 4))
    T_a_b[..., :3, :3] = Rotation.from_rotvec(twist[..., :3]).as_matrix()
    T_a_b[..., :3, 3] = twist[..., 3:]
    T_a_b[..., 3, 3] = 1
    return T_a_b


def twist_between(T_world_a: Float, T_world_b: Float, seconds: float) -> Float:
    """Return the velocity (6,), rad/s and m/s in frame a, from pose a to pose b in ``seconds``."""
    return log(inverse(T_world_a) @ T_world_b) / seconds


def twist_to(T_world_lidar: Float, stamp_ns: Int, i: int) -> Float:
    """Return the velocity (6,), rad/s and m/s, from pose i - 1 of (n,4,4) to i, in frame i - 1."""
    seconds = (stamp_ns[i] - stamp_ns[i - 1]) * 1e-9
    return twist_between(T_world_lidar[i - 1], T_world_lidar[i], seconds)


def transform_twist(T_a_b: Float, twist_b: Float) -> Float:
    """Return in frame a the twists (...,6) of a rigid body that are given in frame b (adjoint)."""
    R_a_b = T_a_b[..., :3, :3]
    rotation = np.einsum("...ij,...j->...i", R_a_b, twist_b[..., :3])
    translation = np.einsum("...ij,...j->...i", R_a_b, twist_b[..., 3:])
    lever = np.cross(T_a_b[..., :3, 3], rotation)  # motion of a's origin by the rotation about b's
    return np.concatenate([rotation, translation + lever], axis=-1)


def interpolate(T_world_a: Float, T_world_b: Float, fraction: float) -> Float:
    """Return the pose (4,4) between pose a (fraction 0) and pose b (fraction 1), or beyond."""
    return T_world_a @ exp(fraction * log(inverse(T_world_a) @ T_world_b))


def fit_rigid(source: Float, target: Float) -> Float:
    """Return the rigid motion (4,4) that maps source (N,3) to target points (N,3) in least squares.

    A rotation that the points do not determine is zero (Kabsch 1976).
    """
    source_mean = source.mean(axis=0)
    target_mean = target.mean(axis=0)
    # einsum and not BLAS: its sums do not depend on the number of threads.
    covariance = np.einsum("ni,nj->ij", target - target_mean, source - source_mean)
    covariance += _HOLD * np.square(source - source_mean).sum() * np.eye(3)
    left, _, right = np.linalg.svd(covariance)
    T = np.eye(4)
    # The determinant turns a reflection into a rotation.
    T[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    T[:3, 3] = target_mean - T[:3, :3] @ source_mean
    return T
