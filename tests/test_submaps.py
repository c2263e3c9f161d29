# SPDX-License-Identifier: MIT
"""The graph of submaps: poses that agree, what is left out, and the solver beside a slow twin."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize

from densify.geometry import poses
from densify.geometry.types import Sweep
from densify.registration import road_poses
from densify.registration.odometry import Alignment, Surface, subsample
from densify.registration.road_poses import relax_poses
from tests.scenes import Arc, Scanner, Scene, World, street

NUM, KNOWN = 14, np.arange(14) < 4
EGO = Arc(0, -1.5, 0, 8.0, 0.02)


@cache
def true():
    """Frames 1.6 m apart, surfaces as if the lidar stood still, and true poses."""
    scene = Scene(World(street(60.0)), EGO, Scanner(48, 720, sigma_m=0.01))
    stretch = scene.stretch(NUM, NUM)
    sweeps = stretch.sweeps[: 2 * NUM : 2]
    T_world_lidar = np.stack([s.T_world_lidar for s in sweeps])
    return [s.frame for s in sweeps], [Surface.of_sweep(s.sweep) for s in sweeps], T_world_lidar


def displaced(step_m: float, begin: int = 9):
    """Poses that drift a little, and at one sweep by much."""
    rng, (_, _, T) = np.random.default_rng(0), true()
    found, drift = [], np.eye(4)
    for i, pose in enumerate(T):
        if not KNOWN[i]:
            drift = drift @ poses.exp(
                np.concatenate([rng.normal(0, 1e-3, 3), rng.normal(0, 0.02, 3)])
            )
        if i == begin:
            drift = drift @ poses.exp(np.array([0, 0, 0, 0.8, 0.6, 0]) * step_m)
        found.append(pose @ drift)
    return np.stack(found)


def errors(T_world_lidar):
    """(n,) m, (n,) degrees off the truth."""
    turn, shift = np.split(poses.log(poses.inverse(true()[2]) @ T_world_lidar), 2, axis=1)
    return np.linalg.norm(shift, axis=1), np.rad2deg(np.linalg.norm(turn, axis=1))


@pytest.mark.parametrize(("step_m", "num_sweeps"), [(0.0, 1), (0.7, 1), (0.0, 2)])
def test_drift_and_a_step_are_mended(step_m, num_sweeps):
    _, surfaces, _ = true()
    given = displaced(step_m)
    found = relax_poses(surfaces, given, KNOWN, num_sweeps)
    before, after = errors(given), errors(found.T_world_lidar)
    if num_sweeps == 1:
        assert before[0].max() > 0.08 and after[0].max() < 0.02
        assert before[1].max() > 0.1 and after[1].max() < 0.05
    else:  # within a submap the drift stays
        assert after[0].max() < 0.6 * before[0].max()
    assert found.is_reliable.all()
    assert found.T_world_lidar[KNOWN].tobytes() == given[KNOWN].tobytes()


def test_what_cannot_be_mended_is_left_out():
    _, surfaces, _ = true()
    found = relax_poses(surfaces, displaced(7.0), KNOWN, 1)
    assert found.is_reliable[:9].all() and not found.is_reliable[9:].any()
    assert errors(found.T_world_lidar)[0][:9].max() < 0.02


def test_the_solver_finds_what_a_slow_one_does():
    """The least sum of log(1 + lift² / s²), by an optimiser that knows nothing of slopes."""
    rng = np.random.default_rng(4)
    T = np.stack([poses.exp(np.append(rng.normal(0, 0.3, 3), [2.0 * i, 0, 0])) for i in range(4)])
    ends = np.array([[0, 1], [1, 2], [2, 3], [0, 2], [1, 3]])
    lays = []
    for i, j in ends:
        noise = np.append(rng.normal(0, 2e-3, 3), rng.normal(0, 0.02, 3))
        root = rng.normal(0, 1, (6, 6)) + np.diag([5.0] * 3 + [2.0] * 3)
        M = poses.inverse(T[i]) @ T[j] @ poses.exp(noise)
        lays.append(Alignment(M, 1.0, root.T @ root))
    graph = road_poses._Graph(ends, np.array([True, False, False, False]), lays)

    def moved(x):
        return [T[0], *(a @ poses.exp(m) for a, m in zip(T[1:], x.reshape(3, 6), strict=True))]

    def cost(x):
        now, total = moved(x), 0.0
        for (i, j), a in zip(ends, lays, strict=True):
            off = poses.log(poses.inverse(a.T_target_source) @ poses.inverse(now[i]) @ now[j])
            total += np.log1p(off @ a.information @ off / road_poses._USUAL_M**2)
        return total

    found = graph.relax(T)
    x = np.concatenate(
        [poses.log(poses.inverse(a) @ b) for a, b in zip(T[1:], found[1:], strict=True)]
    )
    slow = minimize(cost, x, method="Nelder-Mead", options={"maxiter": 2000})
    assert cost(x) < 0.8 * cost(np.zeros(18))
    assert cost(x) < slow.fun + 1e-3
    assert all((cost(x + d) >= cost(x) - 1e-7) for d in 1e-4 * np.eye(18))
    assert found[0].tobytes() == T[0].tobytes()


@pytest.mark.parametrize("num_rings", [16, 64])
def test_thinning_takes_of_every_ring_alike(num_rings):
    num = 200_000
    nothing = np.zeros(num)
    sweep = Sweep(0, 0, np.zeros((num, 3)), nothing, None, nothing.astype(np.uint8), np.arange(num))
    kept = subsample(sweep)
    assert abs(len(kept) - 30_000) < 10
    of_ring = np.bincount(kept.row % num_rings, minlength=num_rings)
    assert of_ring.min() > 0.9 * of_ring.max()
