# SPDX-License-Identifier: MIT
"""The one door of the flow objective for nearest-neighbour search: a compiled tree on the CPU,
chunked brute force on CUDA, with the same answer up to ties."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from densify.config.errors import InputError
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Float

_MAX_CHUNK = 1 << 24  # distances held at once by brute force: two float32 buffers of 64 MB


class Neighbors(NamedTuple):
    """The k nearest points of q queries, nearest first.

    distance_m: (q,k) in the queries' dtype. row: (q,k) int64. Concretely, ``row[i, j] = p`` means
    that ``points[p]`` is the j-th nearest point of ``queries[i]``, counted from 0.
    """

    distance_m: Tensor
    row: Tensor


class NeighborIndex:
    """Search in points: to be made once, asked often, and moved along where they move.

    points: (m,3) floating-point tensor, metres; the search runs on its device, CPU or CUDA.

    Raises InputError for no points, a wrong shape, or NaN and infinite coordinates.
    """

    def __init__(self, points: Tensor) -> None:
        require_points(points, "points")
        self.points = points.detach()
        self._tree = None if points.is_cuda else BoxTree(_contiguous(points))

    def __len__(self) -> int:
        return len(self.points)

    def move(self, points: Tensor) -> None:
        """The same points elsewhere, (m,3): cheaper than a new index, and as exact.

        Raises InputError like the constructor, and for another number of points.
        """
        require_points(points, "points")
        if points.shape != self.points.shape:
            raise InputError(
                f"points: got {len(points)}, expected the {len(self)} that the index was made of"
            )
        self.points = points.detach()
        if self._tree is not None:
            self._tree.move(_contiguous(points))

    def nearest(self, queries: Tensor, num_neighbors: int = 1) -> Neighbors:
        """The nearest ``num_neighbors`` (at most m) points of each query.

        queries: (q,3) on the same device; no gradient flows through the search.

        Raises InputError like the constructor, and if there are fewer points than asked for.
        """
        require_points(queries, "queries")
        if not 1 <= num_neighbors <= len(self):
            raise InputError(
                f"num_neighbors: got {num_neighbors}, expected 1 to {len(self)}, the number of "
                f"points searched"
            )
        queries = queries.detach()
        if self._tree is None:
            return nearest_by_brute_force(queries, self.points, num_neighbors)
        if num_neighbors == 1:
            distance_m, row = (x[:, None] for x in self._tree.nearest(_contiguous(queries)))
        else:
            distance_m, row = self._tree.nearest_k(_contiguous(queries), num_neighbors)
        return Neighbors(torch.from_numpy(distance_m).to(queries.dtype), torch.from_numpy(row))


def nearest_by_brute_force(
    queries: Tensor, points: Tensor, num_neighbors: int, max_chunk: int = _MAX_CHUNK
) -> Neighbors:
    """All distances, ``max_chunk`` at a time: what CUDA is good at. Runs on any device.

    queries: (q,3), points: (m,3), metres. Distances are taken in float32 about the points' mean:
    within 100 m neighbours whose distances differ by less than 0.01 mm may swap. ``max_chunk``
    bounds the memory (8 bytes each), whatever q and m; one row of m distances is the least.
    """
    origin = points.mean(dim=0)
    centred = (points - origin).float()
    num_rows = max(1, max_chunk // len(points))
    distances, found = [], []
    for chunk in (queries - origin).float().split(num_rows):
        squared = torch.zeros(len(chunk), len(points), device=points.device)
        difference = torch.empty_like(squared)
        for axis in range(3):
            torch.sub(chunk[:, axis, None], centred[:, axis], out=difference)
            squared.addcmul_(difference, difference)
        if num_neighbors == 1:
            nearest, row = squared.min(dim=1, keepdim=True)
        else:
            nearest, row = squared.topk(num_neighbors, dim=1, largest=False)
        distances.append(nearest.sqrt_())
        found.append(row)
    return Neighbors(torch.cat(distances).to(queries.dtype), torch.cat(found))


def require_points(points: Tensor, name: str) -> None:
    """Raise InputError unless ``points`` is a (n,3) tensor of at least one finite point."""
    if points.ndim > 0 and len(points) == 0:
        raise InputError(f"{name}: got no points, expected at least 1")
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise InputError(
            f"{name}: got shape {tuple(points.shape)} of {points.dtype}, expected (n,3) of a "
            f"floating-point type"
        )
    invalid = ~torch.isfinite(points.detach()).all(dim=1)
    if invalid.any():
        first = int(invalid.nonzero()[0, 0])
        raise InputError(
            f"{name}: {int(invalid.sum())} of {len(points)} rows are NaN or infinite, the first is "
            f"row {first}; expected finite metres, drop those rows"
        )


def _contiguous(points: Tensor) -> Float:
    return points.detach().double().contiguous().numpy()
