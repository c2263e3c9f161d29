# SPDX-License-Identifier: MIT
"""Solve the scene flow objective of Pontes, Hays, Lucey (3DV 2020) between two clouds.

``adam`` is the published protocol. ``pcg`` alternates nearest neighbours with preconditioned
conjugate gradients, and reaches the same or a lower energy in a fraction of the time. The engine
``paper`` solves it between neighbouring sweeps, above the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from densify.config import Config, ObjectiveSettings
from densify.config.errors import InputError
from densify.flow.engines import ChainedMotion, Scene
from densify.flow.graph import checked_cloud, knn_graph, laplacian
from densify.flow.pair_groups import MIN_MOTION_M, PairCloud, RigidMotion, judge
from densify.flow.tracking.candidates import LINK_M
from densify.free_space.ground import ABOVE_GROUND_M
from densify.geometry import poses
from densify.geometry.nearest import link
from densify.geometry.types import Float, FlowField, Motion

_ADAM_STEPS = 1500  # 200 usually reach the lowest energy
_FIRST_ALPHA = 1000.0  # whole surfaces move together at this alpha
_LEVEL_TOLERANCE = 2e-3  # a level ends when an alternation lowers the energy by a smaller share
_MAX_ALTERNATIONS, _MAX_LAST_ALTERNATIONS = 4, 100  # of each level before the last, of the last


@dataclass(frozen=True)
class Solution:
    """A flow and its energy at the requested alpha."""

    flow: Float  # (n,3) float64 metres, in the frame of the clouds
    energy: float  # value of the objective ``data + alpha * smoothness``, m²
    data: float  # data term of the objective, m²
    smoothness: float  # smoothness term tr(FᵀLF), m²
    # Energy before each step and after the last step. A step is an Adam step or an alternation of
    # pcg. Adam's energy may rise; its minimum is ``energy``. Pcg's never rises on the last level.
    energies: tuple[float, ...]


def solve(
    source: ArrayLike,
    target: ArrayLike,
    settings: ObjectiveSettings | None = None,
    initial: ArrayLike | None = None,
) -> Solution:
    """Return the smooth flow that moves ``source`` onto ``target``.

    The flow is a local minimum of the objective, computed in float64. The same input gives the same
    bytes on the same CPU.

    Args:
        source: (n,3) metres.
        target: (m,3) metres, in the same frame.
        settings: Solver, weight and graph of the objective; None for the defaults.
        initial: (n,3) flow in metres to start from, None for 0. With it, pcg uses the final alpha
            at once.

    Raises:
        InputError: A shape does not fit, or a cloud is empty or not finite.
    """
    settings = settings or ObjectiveSettings()
    points = checked_cloud(source, "source")
    target_points = checked_cloud(target, "target")
    start = np.zeros_like(points) if initial is None else checked_cloud(initial, "initial")
    if start.shape != points.shape:
        raise InputError(f"initial: got shape {start.shape}, expected the source's {points.shape}")
    L = laplacian(knn_graph(points, settings.num_neighbors))
    # Relative to the mean, large coordinates of a map lose no accuracy.
    origin = points.mean(axis=0)
    points, target_points = points - origin, target_points - origin
    if settings.solver == "adam":
        return _solve_by_adam(points, target_points, L, start, settings.alpha)
    problem = _Problem(points, target_points, cKDTree(target_points), L, settings.alpha)
    # A given flow needs no large alphas, which would move whole surfaces again.
    first_alpha = settings.alpha if initial is not None else _FIRST_ALPHA
    return _solve_by_pcg(problem, start, _descending_alphas(first_alpha, settings.alpha))


def _solve_by_adam(
    source: Float, target: Float, L: csr_array, start: Float, alpha: float
) -> Solution:
    """Return the flow of least energy among all steps of Adam, the published protocol."""
    import torch

    from densify.flow.energy import energy, on_one_thread

    with on_one_thread():
        flow = torch.from_numpy(start).requires_grad_()
        points = torch.from_numpy(source)
        target_points = torch.from_numpy(target)
        optimizer = torch.optim.Adam([flow], lr=0.1)  # metres, as published
        current = energy(flow, points, target_points, L, alpha)
        best_flow, best = flow.detach().clone(), current
        energies = [current.total.item()]
        for _ in range(_ADAM_STEPS):
            optimizer.zero_grad()
            current.total.backward()
            optimizer.step()
            current = energy(flow, points, target_points, L, alpha)
            if current.total.item() < best.total.item():
                best_flow, best = flow.detach().clone(), current
            energies.append(current.total.item())
    terms = (best.total.item(), best.data.item(), best.smoothness.item())
    return Solution(best_flow.numpy(), *terms, tuple(energies))


class _Value:
    """The energy of a flow, with the matches that give its gradient."""

    def __init__(self, problem: _Problem, flow: Float) -> None:
        """Match the clouds under a flow (n,3), and compute the energy."""
        moved = problem.source + flow
        forward_m, to_target = problem.target_tree.query(moved)
        backward_m, to_source = cKDTree(moved).query(problem.target)
        self.flow = flow
        self.data = float(np.sum(forward_m**2) + np.sum(backward_m**2))  # E_d, m²
        self.laplacian_flow = problem.laplacian @ flow  # (n,3) L F
        self.smoothness = float((flow * self.laplacian_flow).sum())  # tr(FᵀLF), m²
        self.total = self.at(problem.alpha)
        # (n,3) sums of the vectors from each moved point to its matches, in both directions. They
        # are minus half the gradient of E_d.
        offset = problem.target - moved[to_source]
        backward_sum = [np.bincount(to_source, offset[:, axis], len(moved)) for axis in range(3)]
        self.pull = problem.target[to_target] - moved + np.stack(backward_sum, axis=1)
        # (n,) number of matches of each point, in both directions
        self.num_matches = 1.0 + np.bincount(to_source, minlength=len(moved))

    def at(self, alpha: float) -> float:
        """Return the energy (m²) of the same flow with another alpha."""
        return self.data + alpha * self.smoothness


class _Problem(NamedTuple):
    """A pair of clouds relative to the mean of the source, with the Laplacian and alpha."""

    source: Float  # (n,3) metres
    target: Float  # (m,3) metres
    target_tree: cKDTree  # search tree of the target
    laplacian: csr_array  # (n,n) Laplacian of the source's graph
    alpha: float  # weight of smoothness


def _solve_by_pcg(problem: _Problem, start: Float, levels: list[float]) -> Solution:
    """Return the flow by majorisation and minimisation, over ``levels`` of descending alpha."""
    # At large alphas whole surfaces move together. At a small alpha from the start, points would
    # stay with their first neighbours.
    value = _Value(problem, start)
    energies = [value.total]
    for number, alpha in enumerate(levels):
        is_last = number == len(levels) - 1
        for _ in range(_MAX_LAST_ALTERNATIONS if is_last else _MAX_ALTERNATIONS):
            previous_energy = value.at(alpha)
            # With fixed matches the energy is a quadratic. It is never below the true energy, and
            # equals it at the current flow: a step that lowers the quadratic lowers the energy.
            value = _Value(problem, value.flow + _step(problem, value, alpha))
            energies.append(value.total)
            if previous_energy - value.at(alpha) <= _LEVEL_TOLERANCE * value.at(alpha):
                break
    return Solution(value.flow, value.total, value.data, value.smoothness, tuple(energies))


def _step(problem: _Problem, value: _Value, alpha: float) -> Float:
    """Return the (n,3) step X of the flow that roughly minimises the quadratic bound."""
    # With C = diag(num_matches) the step solves (C + alpha L) X = -gradient / 2. All three columns
    # are one vector for the solver, which has a Jacobi preconditioner.
    shape = problem.source.shape
    diagonal = value.num_matches[:, None]
    inverse = 1.0 / (diagonal + alpha * problem.laplacian.diagonal()[:, None])

    def multiply(vector: Float) -> Float:
        flow = vector.reshape(shape)
        product: Float = diagonal * flow + alpha * (problem.laplacian @ flow)
        return product.ravel()

    def precondition(vector: Float) -> Float:
        return (inverse * vector.reshape(shape)).ravel()

    size = (problem.source.size, problem.source.size)
    step, _ = cg(
        LinearOperator(size, multiply),
        (value.pull - alpha * value.laplacian_flow).ravel(),
        rtol=0.2,  # matches are provisional: no full solution is needed
        maxiter=20,
        M=LinearOperator(size, precondition),
    )
    return step.reshape(shape)


def _descending_alphas(first_alpha: float, alpha: float) -> list[float]:
    """Return alphas from ``first_alpha`` to ``alpha``, in equal factors of at most 10^(2/3)."""
    lowest_alpha = max(alpha, 0.1)  # no factor leads to alpha = 0
    if first_alpha <= lowest_alpha:
        return [alpha]
    # Without the 1e-9, rounding could add a step where the number is an integer.
    num_steps = math.ceil(math.log(first_alpha / lowest_alpha) / math.log(10 ** (2 / 3)) - 1e-9)
    return [*np.geomspace(first_alpha, lowest_alpha, num_steps + 1)[:-1].tolist(), alpha]


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Return the motion by the published objective, above the ground; ``argument`` is not used."""

    def step(i: int, j: int) -> FlowField:
        source, target = scene.stretch.sweeps[i], scene.stretch.sweeps[j]
        points = poses.transform(source.T_world_lidar, source.sweep.points)
        target_points = poses.transform(target.T_world_lidar, target.sweep.points)
        above = scene.ground.above(points) >= ABOVE_GROUND_M
        target_above = scene.ground.above(target_points) >= ABOVE_GROUND_M
        field = FlowField.zero(len(above))  # 0 on the ground
        if above.any() and target_above.any():
            pair = flow_between(points[above], target_points[target_above], settings.objective)
            # From the world to the axes of the source's lidar
            field.displacement[above] = pair.displacement @ source.T_world_lidar[:3, :3]
            field.moving[above] = pair.moving
        return field

    return ChainedMotion(scene.stretch, step)


def flow_between(
    source: ArrayLike,
    target: ArrayLike,
    settings: ObjectiveSettings,
    initial: ArrayLike | None = None,
) -> FlowField:
    """Return the flow of one cloud to another by the published objective, in their common frame.

    Args:
        source: (N,3) metres.
        target: (M,3) metres, in the same frame.
        settings: Settings of the solver. With ``static_prior`` only groups of points that certainly
            move have flow, and each group is an instance. Without ``static_prior`` every point is
            moving, with instance -1.
        initial: (N,3) flow to start from, metres; None starts from 0.

    Raises:
        InputError: A setting or a shape does not fit, or a cloud is empty or not finite.
    """
    flow = solve(source, target, settings, initial).flow
    if settings.static_prior:
        return _keep_moving_groups(np.asarray(source, float), np.asarray(target, float), flow)
    field = FlowField.zero(len(flow))
    return replace(field, displacement=flow, moving=np.ones(len(flow), bool))


def _keep_moving_groups(source_points: Float, target_points: Float, flow: Float) -> FlowField:
    """Return a flow field with the flow (N,3) of groups that certainly move, 0 elsewhere."""
    # The objective knows no firing times. All points of the source count as measured before the
    # motion (share 0 of it), all points of the target after it (share 1).
    source = PairCloud(source_points, share=np.zeros(len(source_points)))
    target = PairCloud(target_points, share=np.ones(len(target_points)))
    field = FlowField.zero(len(flow))
    long_flow = np.flatnonzero(np.linalg.norm(flow, axis=1) > MIN_MOTION_M)
    num_groups, group = link(source_points[long_flow], LINK_M)
    for k in range(num_groups):
        members = long_flow[group == k]
        # A group is judged by its common translation: the flow of single points always brings them
        # closer to the target.
        translation, no_yaw = np.median(flow[members], axis=0), 0.0
        motion = RigidMotion(np.append(translation, no_yaw), source_points[members].mean(0))
        if judge(group=k, members=members, motion=motion, source=source, target=target).moves():
            field.displacement[members] = flow[members]
            field.moving[members] = True
            field.instance[members] = field.instance.max() + 1
    return field
