# SPDX-License-Identifier: MIT
"""Nearest neighbours by a tree of boxes, which keeps its shape while the points move: only the
boxes are fitted anew, in a tenth of the time that building takes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Float, Int

_MAX_LEAF = 10  # points; 8 to 16 answer alike
_MAX_DEPTH = 64
_ABOVE, _TINY = 1.0 + 1e-9, 1e-300  # rounding must not cut the k-th neighbour off, nor 0 do it


class _Tree(NamedTuple):
    """points: (m,3) in the tree's order. order: (m,) the row that each was given as. starts, stops,
    boxes: of each node, its points and their least and greatest x y z; node i has the children
    2i+1 and 2i+2."""

    points: Float
    order: Int
    starts: Int
    stops: Int
    boxes: Float


class BoxTree:
    """Search in (m,3) points, m at least 1, finite."""

    def __init__(self, points: Float) -> None:
        depth = 0
        while (len(points) - 1) >> depth >= _MAX_LEAF:
            depth += 1
        starts = np.zeros((2 << depth) - 1, np.int64)
        stops, order = np.zeros_like(starts), np.arange(len(points))
        _split(points, depth, starts, stops, order)
        self._tree = _Tree(points, order, starts, stops, np.empty((len(starts), 6)))
        self.move(points)

    def move(self, points: Float) -> None:
        """The same points elsewhere. Always exact; the less they stay neighbours, the slower."""
        self._tree = self._tree._replace(points=points[self._tree.order])
        _fit_boxes(self._tree)

    def nearest(self, queries: Float, within_m: float = np.inf) -> tuple[Float, Int]:
        """(q,) metres to the nearest point, and (q,) its row; inf and -1 where none is closer than
        ``within_m``.

        queries: (q,3).
        """
        distance_m, row = np.empty(len(queries)), np.empty(len(queries), np.int64)
        _nearest.over_rows(len(queries), queries, self._tree, float(within_m), distance_m, row)
        return distance_m, row

    def nearest_k(self, queries: Float, k: int) -> tuple[Float, Int]:
        """(q,k) metres to the k nearest points, nearest first, and (q,k) their rows; 1 <= k <= m.

        Faster where queries follow their neighbours, as in the order of a scan.
        """
        distance_m = np.empty((len(queries), k))
        row = np.empty((len(queries), k), np.int64)
        _nearest_k.over_rows(len(queries), queries, self._tree, distance_m, row)
        return distance_m, row

    def align(
        self,
        queries: Float,
        information: Float,
        centre: Float,
        predicted: Float,
        prior: Float,
        gates_m: Float,
        max_weight: float,
        min_matches: int,
    ) -> Float | None:
        """Where (q,3) queries were seen of the body that the points are of: (4,) x y z displacement
        (m) and yaw (rad) about ``centre`` (3,).

        For each of the gates, in turn: a Gauss-Newton step of x, y and yaw that lowers the
        distances to the nearest points within the gate. None where fewer than ``min_matches`` have
        one.

        information: (m,5) xx xy yy xz yz of each point's inverse covariance, 1/m². predicted: (4,)
        where to start. prior: (3,) inverse variance of the predicted x, y and yaw. max_weight: all
        together the distances count at most as so many.
        """
        state = predicted.copy()
        matched = _align(
            queries,
            self._tree,
            information,
            centre,
            prior,
            gates_m,
            max_weight,
            min_matches,
            state,
        )
        return state if matched else None


@Kernel
def _split(points: Float, depth: int, starts: Int, stops: Int, order: Int) -> None:
    """Halve every node's points along its longest side, see `_Tree`."""
    starts[0], stops[0] = 0, len(order)
    for node in range((1 << depth) - 1):
        start, stop = starts[node], stops[node]
        middle = (start + stop) // 2
        starts[2 * node + 1], stops[2 * node + 1] = start, middle
        starts[2 * node + 2], stops[2 * node + 2] = middle, stop
        axis, longest = 0, -1.0
        for candidate in range(3):
            low = high = points[order[start], candidate]
            for i in range(start + 1, stop):
                value = points[order[i], candidate]
                low, high = min(low, value), max(high, value)
            if high - low > longest:
                axis, longest = candidate, high - low
        _select(points[:, axis], order, start, stop - 1, middle)


@inlined
def _select(values: Float, order: Int, left: int, right: int, middle: int) -> None:
    """Hoare's quickselect: no value of order[:middle] is above, none of order[middle:] below."""
    while left < right:
        pivot = values[order[(left + right) // 2]]
        i, j = left, right
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@Kernel
def _fit_boxes(tree: _Tree) -> None:
    boxes, first_leaf = tree.boxes, len(tree.starts) // 2
    for node in range(len(tree.starts) - 1, -1, -1):
        for axis in range(3):
            if node < first_leaf:
                low = min(boxes[2 * node + 1, axis], boxes[2 * node + 2, axis])
                high = max(boxes[2 * node + 1, 3 + axis], boxes[2 * node + 2, 3 + axis])
            else:
                low, high = np.inf, -np.inf
                for i in range(tree.starts[node], tree.stops[node]):
                    value = tree.points[i, axis]
                    low, high = min(low, value), max(high, value)
            boxes[node, axis], boxes[node, 3 + axis] = low, high


@inlined
def _squared_to_box(boxes: Float, node: int, x: float, y: float, z: float) -> float:
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@inlined
def _descend(boxes, node, x, y, z, best, waiting, squared_to, top):  # type: ignore[no-untyped-def]
    """From a box down to the leaf nearest to a point, -1 where none is closer than ``best``; the
    boxes passed by that are wait, with their squared distances. Returns how many wait, too."""
    first_leaf = len(boxes) // 2
    while node < first_leaf:
        near, far = 2 * node + 1, 2 * node + 2
        to_near = _squared_to_box(boxes, near, x, y, z)
        to_far = _squared_to_box(boxes, far, x, y, z)
        if to_far < to_near:
            near, far, to_near, to_far = far, near, to_far, to_near
        if to_far < best:
            waiting[top], squared_to[top] = far, to_far
            top += 1
        if to_near >= best:
            return -1, top
        node = near
    return node, top


@inlined
def _closer(tree, x, y, z, best, found, waiting, squared_to):  # type: ignore[no-untyped-def]
    """The squared distance and the place of the nearest point, or ``best`` and ``found`` where none
    is closer. waiting, squared_to: (_MAX_DEPTH,) to work in."""
    waiting[0], squared_to[0], top = 0, 0.0, 1
    while top > 0:
        top -= 1
        if squared_to[top] >= best:
            continue
        leaf, top = _descend(tree.boxes, waiting[top], x, y, z, best, waiting, squared_to, top)
        if leaf < 0:
            continue
        for i in range(tree.starts[leaf], tree.stops[leaf]):
            dx, dy, dz = tree.points[i, 0] - x, tree.points[i, 1] - y, tree.points[i, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared < best:
                best, found = squared, i
    return best, found


@Kernel
def _nearest(
    begin: int,
    end: int,
    queries: Float,
    tree: _Tree,
    within_m: float,
    distance_m: Float,
    row: Int,
) -> None:
    waiting, squared_to = np.empty(_MAX_DEPTH, np.int64), np.empty(_MAX_DEPTH)
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        nobody = np.int64(-1)  # a number of this type, or the search is compiled twice
        squared, found = _closer(tree, x, y, z, within_m * within_m, nobody, waiting, squared_to)
        distance_m[q] = np.sqrt(squared) if found >= 0 else np.inf
        row[q] = tree.order[found] if found >= 0 else -1


@Kernel
def _nearest_k(
    begin: int, end: int, queries: Float, tree: _Tree, distance_m: Float, row: Int
) -> None:
    k = distance_m.shape[1]
    waiting, squared_to = np.empty(_MAX_DEPTH, np.int64), np.empty(_MAX_DEPTH)
    nearest, found = np.empty(k), np.empty(k, np.int64)
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        # The k neighbours of the query before are no farther than its k-th and the way from there.
        nearest[:] = np.inf
        if q > begin:
            dx, dy, dz = queries[q - 1, 0] - x, queries[q - 1, 1] - y, queries[q - 1, 2] - z
            reach = distance_m[q - 1, k - 1] + np.sqrt(dx * dx + dy * dy + dz * dz)
            nearest[:] = reach * reach * _ABOVE + _TINY
        waiting[0], squared_to[0], top = 0, 0.0, 1
        while top > 0:
            top -= 1
            if squared_to[top] >= nearest[k - 1]:
                continue
            leaf, top = _descend(
                tree.boxes, waiting[top], x, y, z, nearest[k - 1], waiting, squared_to, top
            )
            if leaf < 0:
                continue
            for i in range(tree.starts[leaf], tree.stops[leaf]):
                dx, dy, dz = tree.points[i, 0] - x, tree.points[i, 1] - y, tree.points[i, 2] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared < nearest[k - 1]:
                    j = k - 1
                    while j > 0 and nearest[j - 1] > squared:
                        nearest[j], found[j] = nearest[j - 1], found[j - 1]
                        j -= 1
                    nearest[j], found[j] = squared, tree.order[i]
        for j in range(k):
            distance_m[q, j], row[q, j] = np.sqrt(nearest[j]), found[j]


@inlined
def _match(queries, tree, centre, state, gate_m, found, at, squared):  # type: ignore[no-untyped-def]
    """Undo the state: ``at``, and find the nearest points closer than the gate: ``found``, -1 for
    none, and ``squared``. Returns how many there are. found: as the step before left it."""
    waiting, squared_to = np.empty(_MAX_DEPTH, np.int64), np.empty(_MAX_DEPTH)
    cos, sin, num = np.cos(state[3]), np.sin(state[3]), 0
    for q in range(len(queries)):
        dx, dy = queries[q, 0] - centre[0] - state[0], queries[q, 1] - centre[1] - state[1]
        x, y = cos * dx + sin * dy + centre[0], cos * dy - sin * dx + centre[1]
        z = queries[q, 2] - state[2]
        best, last = gate_m * gate_m, found[q]
        if last >= 0:  # mostly still the nearest: little is left to search
            dx = tree.points[last, 0] - x
            dy, dz = tree.points[last, 1] - y, tree.points[last, 2] - z
            known = dx * dx + dy * dy + dz * dz
            best, last = (known, last) if known < best else (best, -1)
        best, last = _closer(tree, x, y, z, best, last, waiting, squared_to)
        at[q, 0], at[q, 1], at[q, 2], squared[q], found[q] = x, y, z, best, last
        num += last >= 0
    return num


@inlined
def _add_up(H, g, at, found, squared, tree, information, centre, yaw, gate_m):  # type: ignore[no-untyped-def]
    """The normal equations ``H step = g`` of what was matched, by Tukey's weights."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    H[:], g[:] = 0.0, 0.0
    for q in range(len(found)):
        if found[q] < 0:
            continue
        A, i = information[tree.order[found[q]]], found[q]
        weight = (1 - squared[q] / (gate_m * gate_m)) ** 2
        u, v = at[q, 0] - centre[0], at[q, 1] - centre[1]
        for k in range(3):
            # How the point at the model yields to x, y and yaw.
            if k == 0:
                px, py = weight * cos, -weight * sin
            elif k == 1:
                px, py = weight * sin, weight * cos
            else:
                px, py = -weight * v, weight * u
            ax, ay = px * A[0] + py * A[1], px * A[1] + py * A[2]
            H[k, 0] += ax * cos - ay * sin
            H[k, 1] += ax * sin + ay * cos
            H[k, 2] += ay * u - ax * v
            g[k] += ax * (at[q, 0] - tree.points[i, 0]) + ay * (at[q, 1] - tree.points[i, 1])
            g[k] += (px * A[3] + py * A[4]) * (at[q, 2] - tree.points[i, 2])


@Kernel
def _align(
    queries: Float,
    tree: _Tree,
    information: Float,
    centre: Float,
    prior: Float,
    gates_m: Float,
    max_weight: float,
    min_matches: int,
    state: Float,
) -> bool:
    """See `BoxTree.align`; changes the state in place."""
    found, predicted = np.full(len(queries), -1), state.copy()
    at, squared = np.empty((len(queries), 3)), np.empty(len(queries))
    H, g = np.empty((3, 3)), np.empty(3)
    for gate_m in gates_m:
        num = _match(queries, tree, centre, state, gate_m, found, at, squared)
        if num < min_matches:
            return False
        _add_up(H, g, at, found, squared, tree, information, centre, state[3], gate_m)
        scale = min(1.0, max_weight / num)
        for k in range(3):
            axis = k + k // 2  # x, y, yaw
            g[k] = scale * g[k] + prior[k] * (predicted[axis] - state[axis])
            for m in range(3):
                H[k, m] = scale * H[k, m] + prior[k] * (k == m)
        dx, dy, turn = _solved(H, g)
        state[0] += dx
        state[1] += dy
        state[3] += turn
    return True


@inlined
def _solved(H, g):  # type: ignore[no-untyped-def]
    """Three equations with a symmetric, positive matrix, by its factors L D Lᵀ."""
    yx, wx = H[0, 1] / H[0, 0], H[0, 2] / H[0, 0]
    d, e = H[1, 1] - yx * H[0, 1], H[1, 2] - wx * H[0, 1]
    wy = e / d
    gy = g[1] - yx * g[0]
    w = (g[2] - wx * g[0] - wy * gy) / (H[2, 2] - wx * H[0, 2] - wy * e)
    y = gy / d - wy * w
    return g[0] / H[0, 0] - yx * y - wx * w, y, w
