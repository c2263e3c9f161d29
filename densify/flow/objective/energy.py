# SPDX-License-Identifier: MIT
"""The scene flow objective of Pontes, Hays and Lucey, "Scene Flow from Point Clouds with or without
Learning" (3DV 2020): symmetric Chamfer distance plus alpha times the graph Laplacian's quadratic
form of the flow. Without learning alpha = 10 on a graph of 50 neighbours; as a training loss 4."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from densify.config.errors import InputError
from densify.flow.objective.graph import multiply
from densify.flow.objective.neighbors import NeighborIndex, require_points


class Energy(NamedTuple):
    """0-d tensors that carry the gradient: ``total = data + alpha * smoothness``.

    data: E_d in m². smoothness: tr(FᵀLF) in m², before alpha.
    """

    total: Tensor
    data: Tensor
    smoothness: Tensor


class Matches(NamedTuple):
    """Nearest neighbours both ways.

    target_of_source: (n,) int64 row of the target nearest to each moved source point.
    source_of_target: (m,) int64 row of the moved source point nearest to each target point.
    """

    target_of_source: Tensor
    source_of_target: Tensor


def energy(
    flow: Tensor,
    source: Tensor,
    target: Tensor | NeighborIndex,
    laplacian: Tensor,
    alpha: float,
) -> Energy:
    """E(F) of a flow, differentiable with respect to it.

    ::

        E(F)   = E_d(F) + alpha tr(Fᵀ L F)
        E_d(F) = Σ_p min_q |p + f_p - q|² + Σ_q min_p |p + f_p - q|²

    flow: (n,3) metres. source: (n,3) P. target: (m,3) Q, or a `NeighborIndex` of it when the same
    target is used again. laplacian: (n,n) sparse tensor of ``densify.flow.objective.graph``.
    alpha: the smaller, the freer each point. All on one device and of one dtype, float32 or
    float64.

    Nearest neighbours are found without gradient, the distances to them carry it: the exact
    gradient wherever no two neighbours tie. For a batch, loop and add up. Sums, not means: the
    energy grows with the number of points. Deterministic on CPU and CUDA, once differentiable.

    Raises InputError for wrong shapes, mixed dtypes, no points, or NaN.
    """
    require_points(source, "source")
    if flow.shape != source.shape:
        raise InputError(
            f"flow: got shape {tuple(flow.shape)}, expected the source's {tuple(source.shape)}"
        )
    if laplacian.shape != (len(source), len(source)):
        raise InputError(
            f"laplacian: got shape {tuple(laplacian.shape)}, expected "
            f"({len(source)},{len(source)}) for a source of {len(source)} points"
        )
    if not laplacian.dtype == source.dtype == flow.dtype:
        raise InputError(
            f"flow, source, laplacian: got {flow.dtype}, {source.dtype}, {laplacian.dtype}, "
            f"expected one dtype"
        )
    index = target if isinstance(target, NeighborIndex) else NeighborIndex(target)
    matches = match(NeighborIndex(source + flow), index)
    return matched_energy(flow, source, index.points, laplacian, alpha, matches)


def match(moved: NeighborIndex, target: NeighborIndex) -> Matches:
    """Nearest neighbours of the moved source points in the target and the other way round."""
    return Matches(
        target.nearest(moved.points).row[:, 0],
        moved.nearest(target.points).row[:, 0],
    )


def matched_energy(
    flow: Tensor,
    source: Tensor,
    target: Tensor,
    laplacian: Tensor,
    alpha: float,
    matches: Matches,
) -> Energy:
    """`energy` for given matches: quadratic in the flow, and nowhere below `energy`.

    Its Hessian is ``2 (diag(1 + c) + alpha L)`` for each axis, where ``c_p`` counts the target
    points matched to p.
    """
    moved = source + flow
    forward = moved - target[matches.target_of_source]
    backward = take(moved, matches.source_of_target) - target
    data = _SumOfSquares.apply(forward) + _SumOfSquares.apply(backward)
    smoothness = _QuadraticForm.apply(flow, laplacian)
    return Energy(data + alpha * smoothness, data, smoothness)


def take(values: Tensor, index: Tensor) -> Tensor:
    """``values[index]`` for (n,3) values, with a gradient whose bytes do not depend on threads."""
    taken: Tensor = _Gather.apply(values, index)
    return taken


class _Gather(torch.autograd.Function):
    """See `take`."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.num_values = len(values)
        return values[index]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        if gradient.is_cuda:  # sorts, where bincount would add atomically
            sums = gradient.new_zeros(ctx.num_values, 3)
            return sums.index_put_((index,), gradient, accumulate=True), None
        columns = [torch.bincount(index, column, ctx.num_values) for column in gradient.T]
        return torch.stack(columns, dim=1), None


class _SumOfSquares(torch.autograd.Function):
    """Σ x² with bytes that do not depend on threads."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return _sum(values * values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        return 2.0 * gradient * values


class _QuadraticForm(torch.autograd.Function):
    """tr(FᵀLF) for a symmetric sparse L, with one product for value and gradient together."""

    @staticmethod
    def forward(ctx: Any, flow: Tensor, laplacian: Tensor) -> Tensor:
        product = multiply(laplacian, flow)
        ctx.save_for_backward(product)
        return _sum(flow * product)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (product,) = ctx.saved_tensors
        return 2.0 * gradient * product, None


def _sum(values: Tensor) -> Tensor:
    """Sum of all values: torch splits a long sum on the CPU by its threads, numpy does not."""
    return values.sum() if values.is_cuda else torch.tensor(values.numpy().sum())
