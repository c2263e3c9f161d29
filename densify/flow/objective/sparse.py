# SPDX-License-Identifier: MIT
"""Sparse symmetric matrices in compressed rows: made from lists of neighbours, multiplied, and
solved by conjugate gradients for three right sides at once."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.compiled import Kernel
from densify.geometry.types import Float, Int

Index = NDArray[np.int32]
_TINY = 1e-300  # keeps 0 / 0 at 0


class Rows(NamedTuple):
    """The (n,n) matrix A with ``A[i, columns[e]] = values[e]`` for ``starts[i] <= e <
    starts[i + 1]``; columns ascend within a row. starts: (n+1,), columns, values: (e,)."""

    starts: Index
    columns: Index
    values: NDArray[Any]


def symmetric_union(listed: Int, values: Float) -> Rows:
    """The symmetric matrix that has an entry where either point lists the other.

    listed: (n,k) distinct rows per point, -1 for none, itself among them. values: (n,k), the same
    from either end.
    """
    n = len(listed)
    counts = np.zeros(n + 1, np.int64)
    lonely = np.zeros(listed.shape, np.bool_)
    _find_one_sided.over_rows(n, listed, lonely)
    _count(listed, lonely, counts)
    starts = np.cumsum(counts)
    columns = np.empty(starts[-1], np.int32)
    filled = np.empty(starts[-1], values.dtype)
    _scatter(listed, values, lonely, starts[:-1].copy(), columns, filled)
    narrow = starts.astype(np.int32)
    _sort_rows.over_rows(n, narrow, columns, filled)
    return Rows(narrow, columns, filled)


def product(matrix: Rows, x: NDArray[Any]) -> NDArray[Any]:
    """A x for x (n,3), summed in float64 along each row."""
    out = np.empty_like(x)
    _multiply.over_rows(len(x), *matrix, x, out)
    return out


def conjugate_gradients(
    matrix: Rows,
    scale: float,
    diagonal: Float,
    preconditioner: Float,
    rhs: Float,
    residual_drop: float,
    max_products: int,
) -> Float:
    """Solve ``(diag(diagonal) + scale A) X = rhs`` roughly, from X = 0, for (n,3) rhs.

    diagonal, preconditioner: (n,), the latter about the inverse of the whole diagonal; positive.
    Ends when each axis's residual has fallen to ``residual_drop`` of the first, or after
    ``max_products``. Every product brings X nearer in the norm of the matrix.
    """
    solution, residual = np.zeros_like(rhs), rhs.copy()
    direction = preconditioner[:, None] * rhs
    image = np.empty_like(rhs)
    slope = (rhs * direction).sum(axis=0)
    enough = residual_drop**2 * (rhs * rhs).sum(axis=0)
    for _ in range(max_products):
        _multiply.over_rows(len(rhs), *matrix, direction, image)
        slope, left = _descend(
            image, scale, diagonal, preconditioner, slope, direction, solution, residual
        )
        if (left <= enough).all():
            break
    return solution


@Kernel
def _find_one_sided(begin: int, end: int, listed: Int, lonely: NDArray[np.bool_]) -> None:
    for i in range(begin, end):
        for a in range(listed.shape[1]):
            j = listed[i, a]
            if j < 0:
                continue
            lonely[i, a] = True
            for b in range(listed.shape[1]):
                if listed[j, b] == i:
                    lonely[i, a] = False
                    break


@Kernel
def _count(listed: Int, lonely: NDArray[np.bool_], counts: Int) -> None:
    for i in range(len(listed)):
        for a in range(listed.shape[1]):
            if listed[i, a] >= 0:
                counts[i + 1] += 1
                if lonely[i, a]:
                    counts[listed[i, a] + 1] += 1


@Kernel
def _scatter(
    listed: Int,
    values: Float,
    lonely: NDArray[np.bool_],
    free: Int,
    columns: Index,
    filled: Float,
) -> None:
    """free: (n,) the next free entry of each row."""
    for i in range(len(listed)):
        for a in range(listed.shape[1]):
            j = listed[i, a]
            if j < 0:
                continue
            columns[free[i]], filled[free[i]] = j, values[i, a]
            free[i] += 1
            if lonely[i, a]:
                columns[free[j]], filled[free[j]] = i, values[i, a]
                free[j] += 1


@Kernel
def _sort_rows(begin: int, end: int, starts: Index, columns: Index, filled: Float) -> None:
    """Sorts by insertion: rows are short, and numba's own sort takes seconds to compile."""
    for i in range(begin, end):
        for e in range(starts[i] + 1, starts[i + 1]):
            column, value, at = columns[e], filled[e], e
            while at > starts[i] and columns[at - 1] > column:
                columns[at], filled[at] = columns[at - 1], filled[at - 1]
                at -= 1
            columns[at], filled[at] = column, value


@Kernel
def _multiply(
    begin: int,
    end: int,
    starts: Index,
    columns: Index,
    values: NDArray[Any],
    x: NDArray[Any],
    out: NDArray[Any],
) -> None:
    for i in range(begin, end):
        a = b = c = 0.0
        for e in range(starts[i], starts[i + 1]):
            j, value = columns[e], values[e]
            a += value * x[j, 0]
            b += value * x[j, 1]
            c += value * x[j, 2]
        out[i, 0], out[i, 1], out[i, 2] = a, b, c


@Kernel
def _descend(
    image: Float,
    scale: float,
    diagonal: Float,
    preconditioner: Float,
    slope: Float,
    direction: Float,
    solution: Float,
    residual: Float,
) -> tuple[Float, Float]:
    """One step in place. image: A times the direction. Returns the next slope and the squared
    residual, (3,) each."""
    n = len(diagonal)
    curvature = np.zeros(3)
    for i in range(n):
        for axis in range(3):
            image[i, axis] = scale * image[i, axis] + diagonal[i] * direction[i, axis]
            curvature[axis] += direction[i, axis] * image[i, axis]
    # An axis without residual has direction 0: it stays where it is.
    length = slope / np.maximum(curvature, _TINY)
    left, next_slope = np.zeros(3), np.zeros(3)
    for i in range(n):
        for axis in range(3):
            solution[i, axis] += length[axis] * direction[i, axis]
            residual[i, axis] -= length[axis] * image[i, axis]
            squared = residual[i, axis] * residual[i, axis]
            left[axis] += squared
            next_slope[axis] += preconditioner[i] * squared
    growth = next_slope / np.maximum(slope, _TINY)
    for i in range(n):
        for axis in range(3):
            conditioned = preconditioner[i] * residual[i, axis]
            direction[i, axis] = conditioned + growth[axis] * direction[i, axis]
    return next_slope, left
