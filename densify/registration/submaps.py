# SPDX-License-Identifier: MIT
"""Poses along a stretch of road by a graph of submaps, each laid on several before it.

Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE Intelligent Transportation Systems Magazine
2010. Pairs are weighed by the Cauchy function, so that a wrong one does not bend the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.threads import num_threads
from densify.geometry.types import Bool, Float, Int, Links
from densify.registration.alignment import Lay, Surface, lay

_LEAST_POINTS = 80_000  # of a submap: rings of fewer slide onto each other
_MOST_SWEEPS = 5
_APART = (1, 2, 4, 8)  # submaps from one to the other of a pair
_MATCH_M = 0.6
_USUAL_M = 0.02  # between what pairs say; what is far more than that counts less
_MOST_STEPS, _CONVERGED = 10, 1e-6
_LEAST_OVERLAP, _MOST_LEFT_M, _MOST_WRONG = 0.5, 0.1, 0.25


class Relaxed(NamedTuple):
    """Poses that agree. T_world_lidar: (n,4,4). holds: (n,) False for sweeps that only bad pairs
    join to those known."""

    T_world_lidar: Float
    holds: Bool
    links: Links


def num_in_submap(num_points: float) -> int:
    """How many sweeps of so many points make a submap."""
    return int(np.clip(np.ceil(_LEAST_POINTS / max(num_points, 1)), 1, _MOST_SWEEPS))


def relax(
    frames: Sequence[int],
    points: Sequence[Float],
    T_world_lidar: Float,
    known: Bool,
    num_sweeps: int,
) -> Relaxed:
    """Poses of sweeps that agree with how their surfaces lie on each other.

    frames: n neighbours along the drive. points: (N,3) of each, deskewed, lidar frame; some
    suffice. T_world_lidar: (n,4,4), about. known: (n,) whose poses stay, one or more neighbours.
    num_sweeps: of a submap, that keep their places to each other.

    Submaps hold to those known up to where neighbours overlap by less than half, or more than a
    quarter of the pairs across are lifted by more than 0.1 m: up to 0.03 m were found on simulated
    drives. Steps of up to 1 m or 3 degrees in the poses given are mended where a scanner is dense.
    What slides along a road without landmarks cannot be told.
    """
    member, middle = _submaps(known, num_sweeps)
    T, fixed = T_world_lidar[middle], known[middle]
    pairs = [
        (i, i + apart)
        for i in range(len(middle))
        for apart in _APART
        if i + apart < len(middle) and not (fixed[i] and fixed[i + apart])
    ]
    used = sorted({i for pair in pairs for i in pair})

    def surface(i: int) -> Surface:
        T_submap_world = poses.inverse(T[i])
        rows = np.flatnonzero(member == i).tolist()
        parts = [poses.transform(T_submap_world @ T_world_lidar[r], points[r]) for r in rows]
        return Surface.of(np.concatenate(parts))

    with ThreadPoolExecutor(num_threads()) as pool:
        surfaces = dict(zip(used, pool.map(surface, used), strict=True))

        def laid(pair: tuple[int, int]) -> Lay:
            i, j = pair
            return lay(surfaces[i], surfaces[j], poses.inverse(T[i]) @ T[j], _MATCH_M)

        lays = list(pool.map(laid, pairs))
    graph = _Graph(np.array(pairs, np.int64).reshape(-1, 2), fixed, lays)
    relaxed = graph.relaxed(T)
    links = graph.links(T, relaxed, np.array([frames[m] for m in middle], np.int32))
    change = relaxed @ _inverses(T)
    found = np.where(known[:, None, None], T_world_lidar, change[member] @ T_world_lidar)
    return Relaxed(found, graph.holds(links)[member], links)


def _submaps(known: Bool, num_sweeps: int) -> tuple[Int, Int]:
    """(n,) the submap of each sweep, ascending; (m,) the sweep in the middle of each. No submap
    holds known sweeps and others; the incomplete ones are those farthest from where they meet."""
    begin, end = np.flatnonzero(known)[[0, -1]] + (0, 1)
    row = np.arange(len(known))
    before, after = begin - 1 - row[:begin], row[end:] - end
    part = np.concatenate(
        [
            -1 - before // num_sweeps,
            row[: end - begin] // num_sweeps,
            (end - begin - 1) // num_sweeps + 1 + after // num_sweeps,
        ]
    )
    member = part - part[0]
    middle = [int(np.median(np.flatnonzero(member == i))) for i in range(member[-1] + 1)]
    return member, np.array(middle)


class _Graph:
    """Submaps and the pairs of them that were laid on each other.

    ends: (p,2) target and source of each pair. fixed: (m,) submaps that stay.
    """

    def __init__(self, ends: Int, fixed: Bool, lays: Sequence[Lay]) -> None:
        self.ends, self.fixed, self.lays = ends, fixed, lays
        T_target_source = np.array([a.T_target_source for a in lays]).reshape(-1, 4, 4)
        self._T_source_target = np.linalg.inv(T_target_source)
        self._information = np.array([a.information for a in lays]).reshape(-1, 6, 6)

    def relaxed(self, T_world_submap: Float) -> Float:
        """(m,4,4), by Gauss-Newton."""
        T, free = T_world_submap.copy(), ~self.fixed
        if not free.any():
            return T
        for _ in range(_MOST_STEPS):
            step = self._step(T)
            T[free] = T[free] @ _motions(step)
            if abs(step).max() < _CONVERGED:
                break
        return T

    def links(self, before: Float, after: Float, frames: NDArray[np.int32]) -> Links:
        """before, after: (m,4,4) ``T_world_submap``. frames: (m,) of the submaps."""
        change = _logs(_inverses(self._between(before)) @ self._between(after))
        return Links(
            frames=frames[self.ends],
            overlap=np.array([a.overlap for a in self.lays]),
            rms_m=np.array([a.rms_m for a in self.lays]),
            num_matches=np.array([a.num_matches for a in self.lays], np.int64),
            correction_m=np.linalg.norm(change[:, 3:], axis=1),
            correction_deg=np.rad2deg(np.linalg.norm(change[:, :3], axis=1)),
            left_m=self._lift_m(self._apart(after)),
        )

    def holds(self, links: Links) -> Bool:
        """(m,) which submaps good pairs join to fixed ones."""
        target, source = self.ends.T
        wrong, across = links.left_m > _MOST_LEFT_M, np.zeros((2, len(self.fixed)))
        for gap in range(len(self.fixed) - 1):  # from this submap to the next
            spans = (target <= gap) & (source > gap)
            across[:, gap] = wrong[spans].sum(), spans.sum()
        good = across[0] <= _MOST_WRONG * across[1]
        beside = source - target == 1
        good[target[beside]] &= links.overlap[beside] >= _LEAST_OVERLAP
        first, last = np.flatnonzero(self.fixed)[[0, -1]]
        found = np.ones(len(self.fixed), bool)
        found[:first] = np.logical_and.accumulate(good[:first][::-1])[::-1]
        found[last + 1 :] = np.logical_and.accumulate(good[last:-1])
        return found

    def _between(self, T: Float) -> Float:
        """(p,4,4) from each source to its target, by poses (m,4,4)."""
        return _inverses(T[self.ends[:, 0]]) @ T[self.ends[:, 1]]

    def _apart(self, T: Float) -> Float:
        """(p,6) how far each source stands off where the pair laid it."""
        return _logs(self._T_source_target @ self._between(T))

    def _lift_m(self, apart: Float) -> Float:
        """(p,) how far that is for the surfaces, root mean square."""
        square = np.einsum("pi,pij,pj->p", apart, self._information, apart)
        return np.sqrt(np.maximum(square, 0))

    def _step(self, T: Float) -> Float:
        """(free,6) the next motion of every submap that is free, in its own frame."""
        apart = self._apart(T)
        weight = 1 / (1 + (self._lift_m(apart) / _USUAL_M) ** 2)
        slope = np.zeros((len(apart), 6, 12))  # by the motions of target and source
        slope[:, :, :6], slope[:, :, 6:] = -_adjoints(_inverses(self._between(T))), np.eye(6)
        pull = slope.transpose(0, 2, 1) @ (weight[:, None, None] * self._information)
        # A fixed submap's unknowns are put behind all others, and cut off.
        num = 6 * int((~self.fixed).sum())
        first = np.where(self.fixed, num, 6 * (np.cumsum(~self.fixed) - 1))
        at = (first[self.ends][:, :, None] + np.arange(6)).reshape(-1, 12)
        row, column = np.broadcast_arrays(at[:, :, None], at[:, None, :])
        left = sparse.csc_matrix(((pull @ slope).ravel(), (row.ravel(), column.ravel())))
        right = np.bincount(at.ravel(), (pull @ apart[:, :, None]).ravel())
        return -spsolve(left[:num, :num], right[:num]).reshape(-1, 6)


def _inverses(T: Float) -> Float:
    """(n,4,4) of rigid motions."""
    R = T[:, :3, :3].transpose(0, 2, 1)
    back = np.zeros_like(T)
    back[:, :3, :3], back[:, 3, 3] = R, 1
    back[:, :3, 3:] = -R @ T[:, :3, 3:]
    return back


def _logs(T: Float) -> Float:
    """(n,4,4) -> (n,6), as `densify.geometry.poses.log`."""
    turn = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    return np.concatenate([turn, T[:, :3, 3]], axis=1)


def _motions(twist: Float) -> Float:
    """(n,6) -> (n,4,4), the inverse."""
    T = np.tile(np.eye(4), (len(twist), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(twist[:, :3]).as_matrix(), twist[:, 3:]
    return T


def _adjoints(T: Float) -> Float:
    """(n,4,4) -> (n,6,6) that carry twists along, as `densify.geometry.poses.carried`."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    cross = np.zeros_like(R)
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -t[:, 2], t[:, 1], -t[:, 0]
    cross -= cross.transpose(0, 2, 1)
    found = np.zeros((len(T), 6, 6))
    found[:, :3, :3], found[:, 3:, 3:], found[:, 3:, :3] = R, R, cross @ R
    return found
