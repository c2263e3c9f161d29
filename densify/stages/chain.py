# SPDX-License-Identifier: MIT
"""Chaining: flow between neighbouring sweeps becomes flow to the key, k -> k±1 -> … -> key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify import poses
from densify.config import ChainSettings
from densify.types import Bool, Float, FlowField, Window

_NUM_NEIGHBORS = 3


def chain(
    window: Window, steps: Sequence[FlowField], settings: ChainSettings
) -> tuple[FlowField, ...]:
    """Flow of each sweep to the key.

    steps: flow of each sweep to the next one towards the key. The flow of that next sweep is looked
    up at the moved point: an object's points all share its rigid motion there plus what the nearest
    of them deviate from it; a point without an object takes the mean of the nearest moving ones.
    A point is lost where its object has no points in the next sweep, or no moving point lies
    within ``max_gap_m``. Points that do not move stay exactly where they are.
    """
    key = window.frames.index(window.key)
    chained: list[FlowField] = list(steps)
    for direction in (-1, 1):
        nearer = key + direction
        i = nearer + direction  # the key's neighbours reach it in one step already
        while 0 <= i < len(steps):
            chained[i] = _follow(window, i, steps[i], nearer, chained[nearer], settings.max_gap_m)
            nearer, i = i, i + direction
    return tuple(chained)


def _follow(
    window: Window, i: int, step: FlowField, nearer: int, onward: FlowField, max_gap_m: float
) -> FlowField:
    """One step of sweep i, then the flow of the nearer sweep from there on to the key."""
    here, there = window.sweeps[i], window.sweeps[nearer]
    T_there_here = poses.inverse(there.T_key_lidar) @ here.T_key_lidar
    displacement, lost = step.displacement.copy(), step.lost.copy()
    for instance in np.unique(step.instance[step.moving]):
        mine = np.flatnonzero(step.moving & (step.instance == instance))
        theirs = np.flatnonzero(onward.moving & ~onward.lost & (onward.instance == instance))
        arrived = poses.transform(T_there_here, here.sweep.points[mine] + step.total[mine])
        gap_m = np.inf if instance >= 0 else max_gap_m
        known_at = there.sweep.points[theirs] + (onward.total - onward.displacement)[theirs]
        flow, found = _look_up(arrived, known_at, onward.displacement[theirs], instance >= 0, gap_m)
        displacement[mine] += flow @ T_there_here[:3, :3]  # back into this sweep's lidar frame
        lost[mine[~found]] = True
    return replace(step, displacement=displacement, lost=lost)


def _look_up(
    at: Float, points: Float, displacement: Float, is_object: bool, max_gap_m: float
) -> tuple[Float, Bool]:
    """Displacement at (N,3) places from that of (M,3) points, and where there was any."""
    if not len(points):
        return np.zeros_like(at), np.zeros(len(at), bool)
    flow = np.zeros_like(at)
    rest = displacement
    if is_object:
        R, t = _rigid_fit(points, points + displacement)
        flow = at @ R.T + t - at
        rest = displacement - (points @ R.T + t - points)
    k = min(_NUM_NEIGHBORS, len(points))
    distance, nearest = cKDTree(points).query(at, k)
    distance = np.reshape(distance, (len(at), k))
    nearest = np.reshape(nearest, (len(at), k))
    weight = 1 / (distance + 1e-3)
    weight /= weight.sum(1, keepdims=True)
    return flow + np.einsum("nk,nkj->nj", weight, rest[nearest]), distance[:, 0] <= max_gap_m


def _rigid_fit(source: Float, target: Float) -> tuple[Float, Float]:
    """Least-squares rotation and translation (Kabsch 1976); a translation for fewer than 3 points
    or points on a line."""
    a, b = source.mean(0), target.mean(0)
    x = source - a
    if len(source) < 3 or np.linalg.matrix_rank(x, tol=0.05) < 2:
        return np.eye(3), b - a
    U, _, Vt = np.linalg.svd(x.T @ (target - b))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    R = Vt.T @ D @ U.T
    return R, b - R @ a
