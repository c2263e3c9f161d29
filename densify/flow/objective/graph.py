# SPDX-License-Identifier: MIT
"""The graph of a point cloud and its Laplacian, the smoothness term of the flow objective (Pontes,
Hays, Lucey, "Scene Flow from Point Clouds with or without Learning", 3DV 2020, section 3)."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array

from densify.config.errors import InputError
from densify.flow.objective import sparse
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Float

if TYPE_CHECKING:  # who needs the graph alone does not wait for torch
    import torch
    from torch import Tensor

LAPLACIANS = ("symmetric", "row-sum-zero")


def knn_graph(points: Float, num_neighbors: int) -> csr_array:
    """Weights W of the undirected k-nearest-neighbour graph.

    points: (n,3) metres. num_neighbors: k, not counting the point itself, cut to n - 1; the more,
    the farther the flow of one point pulls on others.

    Returns the (n,n) symmetric float64 matrix with ``W[i, j] = exp(-|p_i - p_j|² / 1 m²)`` where
    either point is among the k nearest of the other, 1 on the diagonal, 0 elsewhere.

    Raises InputError for no points, NaN, or k < 1.
    """
    return _weights(points, num_neighbors, np.inf)


def radius_graph(points: Float, radius_m: float, max_neighbors: int) -> csr_array:
    """Weights as in `knn_graph`, with edges only up to ``radius_m``.

    max_neighbors: a point lists at most so many, the nearest; it bounds the memory where the cloud
    is dense (a lidar's near field has thousands of points per cubic metre). An edge exists if
    either end lists it. A point with nobody in reach keeps only its own weight of 1.

    Raises InputError as `knn_graph` does, and for a radius that is not positive.
    """
    if not radius_m > 0:
        raise InputError(f"radius_m: got {radius_m:g}, expected a positive number of metres")
    return _weights(points, max_neighbors, radius_m)


def _weights(points: Float, num_neighbors: int, radius_m: float) -> csr_array:
    if num_neighbors < 1:
        raise InputError(f"num_neighbors: got {num_neighbors}, expected at least 1")
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        import torch

        from densify.flow.objective.neighbors import require_points

        require_points(torch.from_numpy(points), "points")  # says what is wrong
    distance_m, index = BoxTree(points).nearest_k(points, min(num_neighbors + 1, len(points)))
    # Among more than k duplicates a point may not find itself: it takes the last place.
    own = np.arange(len(points))
    lost = ~(index == own[:, None]).any(axis=1)
    index[lost, -1], distance_m[lost, -1] = own[lost], 0.0

    index[distance_m > radius_m] = -1
    starts, columns, values = sparse.symmetric_union(index, np.exp(-(distance_m**2)))
    return csr_array((values, columns, starts), shape=(len(points), len(points)))


def laplacian(weights: csr_array, kind: str = "symmetric") -> csr_array:
    """The (n,n) Laplacian L of a graph: symmetric, positive semi-definite, float64.

    weights: W from `knn_graph` or `radius_graph`. D is diagonal and holds the row sums of W, the
    self-weight ``W_ii = 1`` **included**, as the paper reads; a point without neighbours therefore
    has D = 1 and a zero row, and nothing divides by zero.

    kind:
        "symmetric" (the paper's): ``L = D^-1/2 (D - W) D^-1/2``. Eigenvalues in [0, 2). Its null
        space is ``D^1/2 · 1``, so a constant flow is punished where the density changes.
        "row-sum-zero": ``L = (D - W) / mean(D)``. Its null space is the constant flows (of each
        connected part). Dividing by the mean degree gives alpha about the same stiffness as in the
        symmetric form, but dense parts are stiffer than sparse ones.

    Raises InputError for another kind.
    """
    if kind not in LAPLACIANS:
        raise InputError(f"laplacian: got {kind!r}, expected one of {', '.join(LAPLACIANS)}")
    num_points = weights.shape[0]
    degree = weights.sum(axis=1)
    row = np.repeat(np.arange(num_points), np.diff(weights.indptr))
    column = weights.indices
    degree_at_diagonal = np.where(row == column, degree[row], 0.0)
    values = degree_at_diagonal - weights.data
    if kind == "symmetric":
        scale = 1.0 / np.sqrt(degree)
        values *= scale[row] * scale[column]
    else:
        values /= degree.mean()
    return csr_array((values, column, weights.indptr), shape=weights.shape)


def sparse_tensor(matrix: csr_array, dtype: torch.dtype, device: str | torch.device) -> Tensor:
    """The same matrix as a torch CSR tensor, as `densify.flow.objective.energy.energy` takes it."""
    import torch

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int32)),
            torch.from_numpy(matrix.indices.astype(np.int32)),
            torch.from_numpy(matrix.data).to(dtype),
            size=matrix.shape,
            check_invariants=True,
        ).to(device)


def multiply(matrix: Tensor, values: Tensor) -> Tensor:
    """A `sparse_tensor` times (n,3); on the CPU the same bytes with any number of threads."""
    import torch

    if matrix.is_cuda:
        return matrix @ values
    return torch.from_numpy(sparse.product(rows_of(matrix), values.detach().numpy()))


def rows_of(matrix: Tensor) -> sparse.Rows:
    """The arrays of a CPU `sparse_tensor`, not copied."""
    parts = (matrix.crow_indices(), matrix.col_indices(), matrix.values())
    return sparse.Rows(*(part.detach().numpy() for part in parts))
