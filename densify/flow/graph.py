# SPDX-License-Identifier: MIT
"""Build the graph of a point cloud and its Laplacian, the smoothness term of the objective.

Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or without Learning", 3DV 2020, section 3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.spatial import cKDTree

from densify.config.errors import InputError
from densify.geometry.types import Float


def checked_cloud(values: ArrayLike, name: str) -> Float:
    """Return a copy of a cloud as (n,3) float64 metres; ``name`` is for messages.

    Raises:
        InputError: The values are no numbers, have another shape, are empty or not finite.
    """
    try:
        points = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected (n,3) numbers, metres; {error}") from error
    if points.ndim > 0 and len(points) == 0:
        raise InputError(f"{name}: got no points, expected at least 1")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name}: got shape {points.shape}, expected (n,3) metres")
    invalid = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(invalid):
        raise InputError(
            f"{name}: {len(invalid)} of {len(points)} rows are NaN or infinite, the first is row "
            f"{invalid[0]}; expected finite metres, drop those rows"
        )
    return points


def knn_graph(points: Float, num_neighbors: int, within_m: float = np.inf) -> csr_array:
    """Return the weights W of the undirected graph of nearest neighbours.

    W is (n,n) symmetric float64, with ``W[i, j] = exp(-|p_i - p_j|² / 1 m²)`` where either point is
    among the k nearest of the other, 1 on the diagonal, 0 elsewhere.

    Args:
        points: (n,3) metres.
        num_neighbors: Number k of neighbours, without the point itself. At most n - 1 are used. A
            larger k couples the flow of points farther apart.
        within_m: Greatest distance of a neighbour.

    Raises:
        InputError: k is below 1, or the points have another shape, are empty or not finite.
    """
    if num_neighbors < 1:
        raise InputError(f"num_neighbors: got {num_neighbors}, expected at least 1")
    points = checked_cloud(points, "points")
    num_points = len(points)
    num_nearest = min(num_neighbors, num_points - 1) + 1  # with the point itself
    distance_m, neighbour = cKDTree(points).query(
        points, np.arange(1, num_nearest + 1), distance_upper_bound=within_m
    )
    row = np.repeat(np.arange(num_points), num_nearest)
    column = np.ravel(neighbour)  # n for a neighbour that is too far away
    # With more than k duplicates, the point itself may be missing among the nearest.
    is_edge = (column != row) & (column < num_points)
    edge_weight = np.exp(-(np.ravel(distance_m)[is_edge] ** 2))
    edges = row[is_edge], column[is_edge]
    directed = csr_array((edge_weight, edges), shape=(num_points, num_points))
    weights = csr_array(directed.maximum(directed.T) + eye_array(num_points))
    weights.sort_indices()
    return weights


def laplacian(weights: csr_array) -> csr_array:
    """Return the graph Laplacian ``L = D^-1/2 (D - W) D^-1/2``.

    L is (n,n) symmetric, positive semi-definite float64. D is diagonal, with the row sums of the
    (n,n) ``weights`` W, whose diagonal is 1 as in the paper. The null space of L is
    ``D^1/2 · 1``: constant flow costs energy where density changes.
    """
    degree = weights.sum(axis=1)
    scale = diags_array(1.0 / np.sqrt(degree))
    return csr_array(scale @ (diags_array(degree) - weights) @ scale)
