# SPDX-License-Identifier: MIT
"""Estimate poses of the sweeps along the road, before and after a window.

A chain registers one sweep after another on a map of Gaussian voxels. A pose graph then aligns
submaps with several submaps before them (Grisetti et al., "A Tutorial on Graph-Based SLAM", ITS
Magazine 2010). Cauchy weights keep an outlier among these alignments from bending the road.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.compiled import num_threads
from densify.geometry.types import Bool, Float, Int, RegisteredSweep, Sweep
from densify.registration.alignment import (
    FEW_POINTS,
    Alignment,
    Surface,
    align,
    make_map,
    subsample,
)
from densify.registration.deskew import deskew_points
from densify.registration.trajectory import MIN_NUM_POINTS, MIN_OVERLAP, find_jump

_CHAIN_MATCH_M = 2.0
_LONGEST_GAP_S = 0.4  # greatest time between two sweeps of the chain

_LEAST_POINTS = 80_000  # points of a submap; rings of fewer points slide onto each other
_MOST_SWEEPS = 5
_APART = (1, 4, 8)  # distances of the pairs, in submaps
_MATCH_M = 0.6
_USUAL_M = 0.02  # usual error of a pair; a pair with a much larger error has less weight
_NUM_STEPS = 10  # of Gauss-Newton
_LEAST_OVERLAP, _MOST_LEFT_M, _MOST_WRONG = 0.5, 0.1, 0.25


def follow_road(
    known: Sequence[RegisteredSweep],
    surfaces: Sequence[Surface],
    frames: Sequence[int],
    stamp_ns: Int,
    read: Callable[[int], Sweep],
    reach_m: float,
    step_m: float,
) -> Iterator[tuple[RegisteredSweep, Surface]]:
    """Register raw sweeps along the road one after another, and yield each with its surface.

    Each sweep is aligned with a map of the sweeps before it, starting at constant velocity. The
    chain ends at a sweep that cannot be read, is too sparse, does not fit the map, or would need an
    implausible vehicle motion. Surfaces are deskewed, in the lidar frame of their sweep.

    Args:
        known, surfaces: Sweeps of the window, the one next to ``frames`` last, and their surfaces.
        frames: Frame numbers along the road, ascending or descending in time, nearest first.
        stamp_ns: (n,) reference times of ``frames``.
        read: Returns the raw sweep of a frame.
        reach_m, step_m: Distances along the road: to cover, and between the sweeps that are read.
    """
    chain, T_world_lidar, last_ns = make_map(), known[-1].T_world_lidar, known[-1].sweep.stamp_ns
    for s, surface in zip(known, surfaces, strict=True):
        chain.insert(surface.points, s.T_world_lidar)
    is_backwards = len(frames) > 0 and stamp_ns[0] < last_ns
    twist = known[-1].twist_before if is_backwards else known[-1].twist_after
    speed_m_s, travel_m = float(np.linalg.norm(twist[3:])), 0.0
    middle_ns = stamp_ns + np.diff(stamp_ns, append=stamp_ns[-1:]) / 2
    for frame, time_ns, until_ns in zip(frames, stamp_ns.tolist(), middle_ns, strict=True):
        gap_s = min(_LONGEST_GAP_S, step_m / max(speed_m_s, 1e-3))
        is_near = abs(until_ns - last_ns) < 1e9 * gap_s and frame != frames[-1]
        if travel_m >= reach_m or is_near:
            continue  # the next sweep is nearer to the wanted gap
        try:
            sweep = read(frame)
        except InputError:
            return
        if len(sweep) < MIN_NUM_POINTS:
            return
        step_s, twist_before = (time_ns - last_ns) * 1e-9, twist
        T_guess = T_world_lidar @ poses.exp(twist * step_s)
        surface = Surface.of(deskew_points(subsample(sweep, FEW_POINTS), twist))
        T_aligned, overlap, _ = align(chain, surface, T_guess, _CHAIN_MATCH_M)
        twist = poses.twist_between(T_world_lidar, T_aligned, step_s)
        if overlap < MIN_OVERLAP or find_jump(twist, twist_before, abs(step_s)):
            return
        surface = Surface.of(deskew_points(subsample(sweep), twist))  # by the velocity found
        chain.insert(surface.points, T_aligned)
        T_world_lidar, last_ns = T_aligned, time_ns
        speed_m_s = float(np.linalg.norm(twist[3:]))
        travel_m += speed_m_s * abs(step_s)
        yield RegisteredSweep(sweep, T_world_lidar, twist, twist), surface


class Relaxed(NamedTuple):
    """Consistent poses of n sweeps."""

    T_world_lidar: Float  # (n,4,4) poses
    holds: Bool  # (n,) True if reliable alignments connect the sweep to the sweeps with known poses


def num_in_submap(num_points: float) -> int:
    """Return the number of sweeps in a submap for sweeps with this number of points."""
    return int(np.clip(np.ceil(_LEAST_POINTS / max(num_points, 1)), 1, _MOST_SWEEPS))


def relax_poses(
    surfaces: Sequence[Surface], T_world_lidar: Float, known: Bool, num_sweeps: int
) -> Relaxed:
    """Return poses of n consecutive sweeps, corrected until their surfaces agree.

    A pose is reliable if no unreliable place separates its submap from the known ones. At such a
    place neighbouring submaps overlap by less than half, or more than a quarter of the alignments
    across it are off by more than 0.1 m. Good alignments are off by at most 0.03 m. A slide along a
    road without landmarks cannot be detected.

    Args:
        T_world_lidar: (n,4,4) approximate poses.
        known: (n,) True for poses that stay fixed; at least one, and consecutive.
        num_sweeps: Number of sweeps in a submap. Relative poses within a submap stay fixed.
    """
    member, middle = _submaps(known, num_sweeps)
    T, fixed = T_world_lidar[middle], known[middle]
    pairs = [
        (i, i + num_apart)
        for i in range(len(middle))
        for num_apart in _APART
        if i + num_apart < len(middle) and not (fixed[i] and fixed[i + num_apart])
    ]
    used = sorted({i for pair in pairs for i in pair})

    def submap(i: int) -> Surface:
        rows = np.flatnonzero(member == i).tolist()
        if len(rows) == 1:
            return surfaces[rows[0]]
        return Surface.joined(
            [surfaces[r] for r in rows], poses.inverse(T[i]) @ T_world_lidar[rows]
        )

    with ThreadPoolExecutor(num_threads()) as pool:
        submaps = dict(zip(used, pool.map(submap, used), strict=True))

        def aligned(pair: tuple[int, int]) -> Alignment:
            i, j = pair
            return align(submaps[i], submaps[j], poses.inverse(T[i]) @ T[j], _MATCH_M)

        graph = _Graph(np.array(pairs, int).reshape(-1, 2), fixed, list(pool.map(aligned, pairs)))
    T_relaxed = graph.relaxed(T)
    change = T_relaxed @ poses.inverse(T)
    T_sweeps = np.where(known[:, None, None], T_world_lidar, change[member] @ T_world_lidar)
    return Relaxed(T_sweeps, graph.holds(T_relaxed)[member])


def _submaps(known: Bool, num_sweeps: int) -> tuple[Int, Int]:
    """Return (n,) the ascending submap of each sweep, and (m,) the middle sweep of each submap."""
    # A submap has either known sweeps or others; incomplete ones are the farthest from the known.
    begin, end = np.flatnonzero(known)[[0, -1]] + (0, 1)
    row = np.arange(len(known))
    before, after = begin - 1 - row[:begin], row[end:] - end
    submap = np.concatenate(
        [
            -1 - before // num_sweeps,
            row[: end - begin] // num_sweeps,
            (end - begin - 1) // num_sweeps + 1 + after // num_sweeps,
        ]
    )
    member = submap - submap[0]
    middle = [int(np.median(np.flatnonzero(member == i))) for i in range(member[-1] + 1)]
    return member, np.array(middle)


class _Graph:
    """A pose graph: m submaps as nodes, and p alignments between two submaps as edges."""

    def __init__(self, ends: Int, fixed: Bool, pairs: Sequence[Alignment]) -> None:
        """Build the graph of p alignments between target and source submaps ``ends`` (p,2)."""
        self._ends, self._fixed = ends, fixed
        T_target_source = np.array([a.T_target_source for a in pairs]).reshape(-1, 4, 4)
        self._T_source_target = np.linalg.inv(T_target_source)
        self._information = np.array([a.information for a in pairs]).reshape(-1, 6, 6)
        self._overlap = np.array([a.overlap for a in pairs])

    def relaxed(self, T_world_submap: Float) -> Float:
        """Return the submap poses (m,4,4) that fit the alignments best, by Gauss-Newton."""
        T, free = T_world_submap.copy(), ~self._fixed
        if not free.any():
            return T
        for _ in range(_NUM_STEPS):
            T[free] = T[free] @ poses.exp(self._step(T))
        return T

    def holds(self, T: Float) -> Bool:
        """Return (m,) True for submaps that reliable alignments connect to fixed ones."""
        target, source = self._ends.T
        is_off = self.off_m(self._apart(T)) > _MOST_LEFT_M
        # per gap from a submap to the next: alignments across it that are off, and all of them
        counts = np.zeros((2, len(self._fixed)))
        for gap in range(len(self._fixed) - 1):
            spans = (target <= gap) & (source > gap)
            counts[:, gap] = is_off[spans].sum(), spans.sum()
        gap_holds = counts[0] <= _MOST_WRONG * counts[1]
        is_adjacent = source - target == 1
        gap_holds[target[is_adjacent]] &= self._overlap[is_adjacent] >= _LEAST_OVERLAP
        first, last = np.flatnonzero(self._fixed)[[0, -1]]
        connected = np.ones(len(self._fixed), bool)
        connected[:first] = np.logical_and.accumulate(gap_holds[:first][::-1])[::-1]
        connected[last + 1 :] = np.logical_and.accumulate(gap_holds[last:-1])
        return connected

    def _between(self, T: Float) -> Float:
        """Return (p,4,4) poses of sources in their target's frame, from submap poses (m,4,4)."""
        return poses.inverse(T[self._ends[:, 0]]) @ T[self._ends[:, 1]]

    def _apart(self, T: Float) -> Float:
        """Return (p,6) the motion (rad, m) of each source away from its aligned pose."""
        return poses.log(self._T_source_target @ self._between(T))

    def off_m(self, residual: Float) -> Float:
        """Return the (p,) RMS distance (m) of two surfaces, the source moved by (p,6) rad, m."""
        square = np.einsum("pi,pij,pj->p", residual, self._information, residual)
        return np.sqrt(np.maximum(square, 0))

    def _step(self, T: Float) -> Float:
        """Return (free,6) the next Gauss-Newton step of each free submap, in its own frame."""
        residual = self._apart(T)
        weight = 1 / (1 + (self.off_m(residual) / _USUAL_M) ** 2)
        adjoint = poses.carried(poses.inverse(self._between(T))[:, None], np.eye(6))
        slope = np.zeros((len(residual), 6, 12))  # by the motions of target and source
        slope[:, :, :6], slope[:, :, 6:] = -adjoint.transpose(0, 2, 1), np.eye(6)
        weighted = slope.transpose(0, 2, 1) @ (weight[:, None, None] * self._information)
        # Unknowns of fixed submaps come after all others, and are cut off.
        num = 6 * int((~self._fixed).sum())
        first = np.where(self._fixed, num, 6 * (np.cumsum(~self._fixed) - 1))
        unknown = (first[self._ends][:, :, None] + np.arange(6)).reshape(-1, 12)
        row, column = np.broadcast_arrays(unknown[:, :, None], unknown[:, None, :])
        matrix = sparse.csc_matrix(((weighted @ slope).ravel(), (row.ravel(), column.ravel())))
        gradient = np.bincount(unknown.ravel(), (weighted @ residual[:, :, None]).ravel())
        return -spsolve(matrix[:num, :num], gradient[:num]).reshape(-1, 6)
