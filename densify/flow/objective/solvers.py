# SPDX-License-Identifier: MIT
"""Two solvers of the scene flow objective: ``adam``, the published protocol (Pontes, Hays, Lucey,
3DV 2020), and ``pcg``, which alternates nearest neighbours with preconditioned conjugate gradients
and reaches the same or a lower energy in a small part of the time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from densify.config.errors import InputError
from densify.flow.objective import graph
from densify.flow.objective.energy import Energy, energy, match, matched_energy
from densify.flow.objective.neighbors import NeighborIndex, require_points
from densify.flow.objective.sparse import conjugate_gradients
from densify.geometry.types import Float

SOLVERS = ("pcg", "adam")
_LEVEL_FACTOR = 10 ** (2 / 3)  # the most alpha falls from one level to the next
_LEAST_ALPHA = 0.1  # where the levels end for alpha = 0
_MAX_ALTERNATIONS = 4  # on the levels before the last: more cost a third more, for 1-2 % of energy
_MAX_LAST_ALTERNATIONS = 100
_MAX_PRODUCTS = 20  # per alternation: the matches are provisional, a full solve is wasted
_RESIDUAL_DROP = 0.2
_TINY = 1e-300  # keeps 0 / 0 at 0


@dataclass(frozen=True)
class SolverSettings:
    """What is minimised and how; the defaults are the paper's, but for the solver.

    solver: "pcg" or "adam".
    alpha: weight of smoothness, at least 0; larger moves neighbours more alike.
    num_neighbors: k of the graph; more is stiffer and slower.
    radius_m: joins points within this radius instead, at most the num_neighbors nearest; None off.
    laplacian: "symmetric" (the paper's) or "row-sum-zero" (leaves a constant flow free).
    adam_num_steps: the lowest energy is usually reached within 200 steps, later ones wander.
    adam_learning_rate: metres a point may move per step.
    pcg_alpha_start: alpha falls from here; higher finds larger motions as a whole, slower. Not
        above alpha: no continuation. Ignored with an initial flow.
    pcg_tolerance: a level ends when an alternation lowers its energy by a smaller part than this.

    Raises InputError for a value out of range.
    """

    solver: str = "pcg"
    alpha: float = 10.0
    num_neighbors: int = 50
    radius_m: float | None = None
    laplacian: str = "symmetric"
    adam_num_steps: int = 1500
    adam_learning_rate: float = 0.1
    pcg_alpha_start: float = 1000.0
    pcg_tolerance: float = 2e-3

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise InputError(f"solver: got {self.solver!r}, expected one of {', '.join(SOLVERS)}")
        if self.laplacian not in graph.LAPLACIANS:
            raise InputError(
                f"laplacian: got {self.laplacian!r}, expected one of {', '.join(graph.LAPLACIANS)}"
            )
        for name in ("alpha", "pcg_alpha_start", "pcg_tolerance"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise InputError(f"{name}: got {value}, expected a finite number, at least 0")
        for name in ("adam_learning_rate", "radius_m"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name}: got {value}, expected a finite number above 0")
        for name in ("num_neighbors", "adam_num_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, expected at least 1")


@dataclass(frozen=True)
class Solution:
    """A flow and what it costs, by `densify.flow.objective.energy.energy` at the alpha asked for.

    flow: (n,3) float64 metres. energy = data + alpha * smoothness.
    num_steps: Adam's steps, or pcg's alternations over all levels.
    energies: the energy before each step and after the last. Adam's rises at times and its minimum
        is ``energy``; pcg's never rises on the last level, nor at all without continuation.
    seconds: when each of ``energies`` was known, since `solve` was called, the graph included.
    """

    flow: Float
    energy: float
    data: float
    smoothness: float
    num_steps: int
    energies: tuple[float, ...]
    seconds: tuple[float, ...]


def solve(
    source: ArrayLike,
    target: ArrayLike,
    settings: SolverSettings | None = None,
    initial: ArrayLike | None = None,
    device: str = "cpu",
) -> Solution:
    """The flow that moves ``source`` onto ``target`` smoothly: a minimum of the objective.

    source: (n,3), target: (m,3), metres, in one coordinate frame. settings: None means the
    defaults. initial: (n,3) flow to start from, otherwise 0; pcg then works at the final alpha at
    once, and stays near it. device: "cpu", "cuda" or "cuda:N".

    Same input, same bytes on the same CPU with any number of threads. Everything is done in float64
    about the source's mean, so that map coordinates lose nothing. 130,000 points against 130,000
    with 50 neighbours need about 1 GB.

    Raises InputError for no points, wrong shapes, NaN, or a device that is not there.
    """
    trace = _Trace(time.perf_counter())
    settings = settings or SolverSettings()
    _require_device(device)
    moving = _cloud(source, "source")
    fixed = _cloud(target, "target")
    start = np.zeros_like(moving) if initial is None else _cloud(initial, "initial")
    if start.shape != moving.shape:
        raise InputError(f"initial: got shape {start.shape}, expected the source's {moving.shape}")
    origin = moving.mean(axis=0)
    problem = _pose(moving - origin, fixed - origin, settings, device)
    flow = torch.from_numpy(start).to(device)
    if settings.solver == "adam":
        return _adam(problem, flow, trace)
    alpha_start = settings.pcg_alpha_start if initial is None else settings.alpha
    return _pcg(problem, flow, _levels(alpha_start, settings.alpha), trace)


@dataclass(frozen=True)
class _Problem:
    """One pair on its device. moved: the source where the flow takes it. diagonal: (n,1) of the
    Laplacian."""

    source: Tensor
    moved: NeighborIndex
    target: NeighborIndex
    laplacian: Tensor
    diagonal: Tensor
    settings: SolverSettings


def _pose(source: Float, target: Float, settings: SolverSettings, device: str) -> _Problem:
    if settings.radius_m is None:
        weights = graph.knn_graph(source, settings.num_neighbors)
    else:
        weights = graph.radius_graph(source, settings.radius_m, settings.num_neighbors)
    laplacian = graph.laplacian(weights, settings.laplacian)
    points = torch.from_numpy(source).to(device)
    return _Problem(
        source=points,
        moved=NeighborIndex(points),
        target=NeighborIndex(torch.from_numpy(target).to(device)),
        laplacian=graph.sparse_tensor(laplacian, torch.float64, device),
        diagonal=torch.from_numpy(laplacian.diagonal()[:, None]).to(device),
        settings=settings,
    )


def _adam(problem: _Problem, flow: Tensor, trace: _Trace) -> Solution:
    """The published protocol, but for keeping the best flow of all steps instead of the last."""
    settings = problem.settings
    flow.requires_grad_()
    optimizer = torch.optim.Adam([flow], lr=settings.adam_learning_rate)
    value = energy(flow, problem.source, problem.target, problem.laplacian, settings.alpha)
    trace.add(value)
    best_flow, best = flow.detach().clone(), value
    for _ in range(settings.adam_num_steps):
        optimizer.zero_grad()
        value.total.backward()
        optimizer.step()
        value = energy(flow, problem.source, problem.target, problem.laplacian, settings.alpha)
        if value.total.item() < best.total.item():
            best_flow, best = flow.detach().clone(), value
        trace.add(value)
    return _solution(best_flow, best, trace)


def _pcg(problem: _Problem, flow: Tensor, levels: list[float], trace: _Trace) -> Solution:
    """Majorise and minimise: with the matches fixed the energy is a quadratic that touches it from
    above, so any step that lowers the quadratic lowers the energy. Started at the final alpha the
    points are caught by their first neighbours; large alphas first let whole surfaces slide."""
    alpha = problem.settings.alpha
    flow, value, num_matched = _evaluate(problem, flow)
    trace.add(value)
    for level in levels:
        num_alternations = _MAX_ALTERNATIONS if level != alpha else _MAX_LAST_ALTERNATIONS
        for _ in range(num_alternations):
            quadratic = value.data + level * value.smoothness
            (gradient,) = torch.autograd.grad(quadratic, flow)
            step = _minimize_quadratic(problem, -0.5 * gradient, 1.0 + num_matched, level)
            flow, value, num_matched = _evaluate(problem, flow.detach() + step)
            trace.add(value)
            reached = (value.data + level * value.smoothness).item()
            if quadratic.item() - reached <= problem.settings.pcg_tolerance * reached:
                break
    return _solution(flow, value, trace)


def _evaluate(problem: _Problem, flow: Tensor) -> tuple[Tensor, Energy, Tensor]:
    """The flow as a leaf, its energy, and (n,1) how many target points matched each point."""
    flow = flow.detach().requires_grad_()
    source, target = problem.source, problem.target
    problem.moved.move(source + flow)
    matches = match(problem.moved, target)
    value = matched_energy(
        flow, source, target.points, problem.laplacian, problem.settings.alpha, matches
    )
    num_matched = torch.bincount(matches.source_of_target, minlength=len(source))
    return flow, value, num_matched[:, None].to(flow.dtype)


def _minimize_quadratic(problem: _Problem, rhs: Tensor, data: Tensor, alpha: float) -> Tensor:
    """Solve ``(diag(data) + alpha L) X = rhs`` roughly by conjugate gradients from X = 0, with
    Jacobi's preconditioner, for the three axes at once; every product lowers the quadratic.

    rhs: (n,3). data: (n,1), at least 1.
    """
    preconditioner = 1.0 / (data + alpha * problem.diagonal)
    if not rhs.is_cuda:
        step = conjugate_gradients(
            graph.rows_of(problem.laplacian),
            alpha,
            data[:, 0].numpy(),
            preconditioner[:, 0].numpy(),
            rhs.numpy(),
            _RESIDUAL_DROP,
            _MAX_PRODUCTS,
        )
        return torch.from_numpy(step)
    return _conjugate_gradients(problem.laplacian, alpha, data, preconditioner, rhs)


def _conjugate_gradients(
    laplacian: Tensor, alpha: float, data: Tensor, preconditioner: Tensor, rhs: Tensor
) -> Tensor:
    """`densify.flow.objective.sparse.conjugate_gradients` on any device."""
    solution = torch.zeros_like(rhs)
    residual = rhs
    enough = _RESIDUAL_DROP**2 * (rhs * rhs).sum(dim=0)
    conditioned = preconditioner * residual
    direction = conditioned
    slope = (residual * conditioned).sum(dim=0)
    for _ in range(_MAX_PRODUCTS):
        product = data * direction + alpha * (laplacian @ direction)
        # An axis without residual has direction 0: it stays where it is.
        length = slope / (direction * product).sum(dim=0).clamp_min(_TINY)
        solution = solution + length * direction
        residual = residual - length * product
        if bool(((residual * residual).sum(dim=0) <= enough).all()):
            break
        conditioned = preconditioner * residual
        previous, slope = slope, (residual * conditioned).sum(dim=0)
        direction = conditioned + slope / previous.clamp_min(_TINY) * direction
    return solution


def _levels(start: float, alpha: float) -> list[float]:
    """Alphas from ``start`` down to ``alpha``, equal steps in the logarithm."""
    least = max(alpha, _LEAST_ALPHA)
    if start <= least:
        return [alpha]
    num_steps = math.ceil(math.log(start / least) / math.log(_LEVEL_FACTOR) - 1e-9)
    return [*np.geomspace(start, least, num_steps + 1)[:-1].tolist(), alpha]


@dataclass(frozen=True)
class _Trace:
    """What each step reached, and when."""

    start_s: float
    energies: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, value: Energy) -> None:
        self.energies.append(value.total.item())
        self.seconds.append(time.perf_counter() - self.start_s)


def _solution(flow: Tensor, value: Energy, trace: _Trace) -> Solution:
    return Solution(
        flow=flow.detach().cpu().numpy(),
        energy=value.total.item(),
        data=value.data.item(),
        smoothness=value.smoothness.item(),
        num_steps=len(trace.energies) - 1,
        energies=tuple(trace.energies),
        seconds=tuple(trace.seconds),
    )


def _cloud(values: ArrayLike, name: str) -> Float:
    try:
        cloud = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected (n,3) numbers, metres; {error}") from error
    require_points(torch.from_numpy(cloud), name)
    return cloud


def _require_device(device: str) -> None:
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise InputError(f"device: got {device!r}, expected cpu, cuda or cuda:N")
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device: got {device}, but torch finds no CUDA device; use cpu")
