# SPDX-License-Identifier: MIT
"""How a lidar is mounted: by how much its axes lean against the ground it stands on, and whether
they are upside down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.types import Float, Sweep

_NUM_SWEEPS = 5
_NEAR_M = 30.0
_NUM_POINTS, _NUM_TRIES = 1000, 200
_CLOSE_M, _BELOW_M = 0.1, 0.3
_MAX_SHARE_BELOW = 0.03  # of the points; more lie below a wall's or a roof's plane
_LEAST_SHARE = 0.1
_UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
_ASIDE = {s + a: (-1.0 if s else 1.0) * np.eye(3)["xyz".index(a)] for a in "yx" for s in ("-", "")}
_MAX_RAD, _LEAST_RAD = np.deg2rad([50.0, 6.0])  # less is the road's slope, or load


def upright(sweeps: Sequence[Sweep]) -> Float:
    """(3,3) ``R_level_lidar``, which turns the lidar's axes so that z is up as the vehicle stands.

    The ground is the plane that most points within 30 m of the lidar lie on and hardly any below
    (Fischler, Bolles, "Random sample consensus", 1981), the median over at most five of the sweeps,
    evenly spread. A lidar hangs upside down, or its z axis points down, where no sweep shows a
    ground below and some do above. The identity where the lidar leans by less than 6 degrees, or no
    sweep shows a ground: a height map follows such slopes. Same input, same result.
    """
    chosen = sweeps[:: max(1, len(sweeps) // _NUM_SWEEPS)][:_NUM_SWEEPS]
    for R_hung_lidar in (np.eye(3), _UPSIDE_DOWN):
        turned = (sweep.points @ R_hung_lidar.T for sweep in chosen)
        normals = [n for n in map(_ground_normal, turned) if n is not None]
        if normals:
            return _level(np.median(normals, axis=0)) @ R_hung_lidar
    return np.eye(3)


def _level(up: Float) -> Float:
    """(3,3) the smallest rotation that turns this direction (3,) to z; the identity for less than 6
    degrees."""
    up = up / np.linalg.norm(up)
    turn = np.cross(up, [0.0, 0.0, 1.0])
    lean_rad = float(np.arccos(np.clip(up[2], -1, 1)))
    if lean_rad < _LEAST_RAD:
        return np.eye(3)
    R: Float = Rotation.from_rotvec(turn / np.linalg.norm(turn) * lean_rad).as_matrix()
    return R


def ground_aside(sweep: Sweep) -> str:
    """Which axis points up, such as ``-y`` of a camera's, where a ground is seen from it and none
    from z or -z; "" otherwise."""
    if any(_ground_normal(sweep.points @ R.T) is not None for R in (np.eye(3), _UPSIDE_DOWN)):
        return ""
    for name, up in _ASIDE.items():
        forward = np.roll(up, 1)
        R_hung_lidar = np.stack([forward, np.cross(up, forward), up])
        if _ground_normal(sweep.points @ R_hung_lidar.T) is not None:
            return name
    return ""


def _ground_normal(points: Float) -> Float | None:
    """(3,) unit, up; None where no plane is the ground."""
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    points = points[:: len(points) // _NUM_POINTS + 1]
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(len(points), size=(_NUM_TRIES, 3))].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal, a = normal[length > 0] / length[length > 0, None], a[length > 0]
    normal *= np.where(normal[:, 2] < 0, -1, 1)[:, None]
    level = normal[:, 2] > np.cos(_MAX_RAD)
    normal, a = normal[level], a[level]
    above = points @ normal.T - np.einsum("ij,ij->i", normal, a)
    close = (np.abs(above) < _CLOSE_M).mean(axis=0)
    close[(above < -_BELOW_M).mean(axis=0) > _MAX_SHARE_BELOW] = 0.0
    if not len(close) or close.max() < _LEAST_SHARE:
        return None
    best = int(np.argmax(close))
    ground = points[np.abs(above[:, best]) < _CLOSE_M]
    _, _, axes = np.linalg.svd(ground - ground.mean(axis=0), full_matrices=False)
    fitted: Float = axes[2] * np.sign(axes[2, 2])
    return fitted
