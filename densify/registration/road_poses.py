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
from densify.registration.deskew import deskew_points
from densify.registration.odometry import FEW_POINTS, Alignment, Surface, align, make_map, subsample
from densify.registration.trajectory import MIN_NUM_POINTS, MIN_OVERLAP, find_jump

_PAIR_DISTANCES = (1, 4, 8)  # of the aligned pairs, in submaps
_USUAL_M = 0.02  # usual error of a pair; a pair with a much larger error has less weight


def follow_road(
    window_sweeps: Sequence[RegisteredSweep],
    window_surfaces: Sequence[Surface],
    frames: Sequence[int],
    stamp_ns: Int,
    read: Callable[[int], Sweep],
    reach_m: float,
    step_m: float,
) -> Iterator[tuple[RegisteredSweep, Surface]]:
    """Register raw sweeps along the road one after another, and yield each with its surface.

    Each sweep is aligned with a map of the sweeps before, from a pose predicted at constant
    velocity. The chain ends at a sweep that cannot be read, is too sparse, does not fit the map, or
    needs an implausible vehicle motion. Surfaces are deskewed, in their sweep's lidar frame.

    Args:
        window_sweeps: Registered sweeps of the window, the one next to ``frames`` last.
        window_surfaces: Surfaces of these sweeps.
        frames: Frame numbers along the road, ascending or descending in time, nearest first.
        stamp_ns: (n,) reference times of ``frames``.
        read: Returns the raw sweep of a frame.
        reach_m: Distance along the road to cover.
        step_m: Distance along the road between the sweeps that are read.
    """
    chain = make_map()
    for registered, surface in zip(window_sweeps, window_surfaces, strict=True):
        chain.insert(surface.points, registered.T_world_lidar)
    end_of_window = window_sweeps[-1]  # and first end of the chain
    T_world_lidar, end_ns = end_of_window.T_world_lidar, end_of_window.sweep.stamp_ns
    is_backwards = len(frames) > 0 and stamp_ns[0] < end_ns
    twist = end_of_window.twist_before if is_backwards else end_of_window.twist_after
    travel_m = 0.0
    # The sweep nearest to the wanted gap is registered: a sweep is skipped if even the middle
    # between this and the next sweep lies within the gap, because the next one is then nearer.
    middles_ns = stamp_ns + np.diff(stamp_ns, append=stamp_ns[-1:]) / 2
    for frame, frame_ns, middle_ns in zip(frames, stamp_ns.tolist(), middles_ns, strict=True):
        # Even a slow vehicle's sweeps are at most about 0.4 s apart, for the prediction's sake.
        gap_s = min(0.4, step_m / max(float(np.linalg.norm(twist[3:])), 1e-3))
        is_near = abs(middle_ns - end_ns) < 1e9 * gap_s and frame != frames[-1]
        if travel_m >= reach_m or is_near:
            continue
        try:
            sweep = read(frame)
        except InputError:
            return
        if len(sweep) < MIN_NUM_POINTS:
            return
        step_s = (frame_ns - end_ns) * 1e-9
        # Constant velocity predicts the pose, and deskews the sweep for the alignment.
        T_guess = T_world_lidar @ poses.exp(twist * step_s)
        guessed_surface = Surface.of(deskew_points(subsample(sweep, FEW_POINTS), twist))
        T_aligned, overlap, _ = align(chain, guessed_surface, T_guess, match_m=2.0)
        previous_twist = twist
        twist = poses.twist_between(T_world_lidar, T_aligned, step_s)
        if overlap < MIN_OVERLAP or find_jump(twist, previous_twist, abs(step_s)):
            return
        surface = Surface.of(deskew_points(subsample(sweep), twist))  # by the measured velocity
        chain.insert(surface.points, T_aligned)
        T_world_lidar, end_ns = T_aligned, frame_ns
        travel_m += float(np.linalg.norm(twist[3:])) * abs(step_s)
        yield RegisteredSweep(sweep, T_world_lidar, twist, twist), surface


class Relaxed(NamedTuple):
    """Consistent poses of n sweeps."""

    T_world_lidar: Float  # (n,4,4) poses
    # (n,) True if reliable alignments connect the sweep to the sweeps with known poses
    is_reliable: Bool


def num_in_submap(num_points: float) -> int:
    """Return the number of sweeps in a submap, 1 to 5, for sweeps with this number of points."""
    # The rings of fewer than 80,000 points slide onto each other.
    return int(np.clip(np.ceil(80_000 / max(num_points, 1)), 1, 5))


def relax_poses(
    surfaces: Sequence[Surface], T_world_lidar: Float, is_known: Bool, num_sweeps: int
) -> Relaxed:
    """Return poses of n consecutive sweeps, corrected until their surfaces agree.

    A pose is reliable if no unreliable gap separates its submap from the known ones. A gap between
    neighbouring submaps is unreliable if they overlap by less than half, or if more than a quarter
    of the alignments across the gap are wrong by more than 0.1 m. Good alignments are wrong by at
    most 0.03 m. A slide along a road without landmarks cannot be detected.

    Args:
        surfaces: Surface of each sweep, in its lidar frame.
        T_world_lidar: (n,4,4) approximate poses.
        is_known: (n,) True for poses that stay fixed; at least one, and consecutive.
        num_sweeps: Number of sweeps in a submap. Relative poses within a submap stay fixed.
    """
    submap_of_sweep, middle = _group_into_submaps(is_known, num_sweeps)
    T = T_world_lidar[middle]
    is_fixed = is_known[middle]
    # Pairs (target, source) of submaps; two fixed submaps need no alignment.
    pairs = [
        (i, i + distance)
        for i in range(len(middle))
        for distance in _PAIR_DISTANCES
        if i + distance < len(middle) and not (is_fixed[i] and is_fixed[i + distance])
    ]
    needed_submaps = sorted({i for pair in pairs for i in pair})

    def make_submap(i: int) -> Surface:
        sweeps = np.flatnonzero(submap_of_sweep == i).tolist()
        if len(sweeps) == 1:
            return surfaces[sweeps[0]]
        T_submap_lidar = poses.inverse(T[i]) @ T_world_lidar[sweeps]
        clouds = [
            poses.transform(pose, surfaces[sweep].points.points()[:, :3])
            for sweep, pose in zip(sweeps, T_submap_lidar, strict=True)
        ]
        return Surface.of(np.concatenate(clouds))

    def align_pair(pair: tuple[int, int]) -> Alignment:
        i, j = pair
        return align(submaps[i], submaps[j], poses.inverse(T[i]) @ T[j], match_m=0.6)

    with ThreadPoolExecutor(num_threads()) as pool:
        submaps = dict(zip(needed_submaps, pool.map(make_submap, needed_submaps), strict=True))
        alignments = list(pool.map(align_pair, pairs))
    graph = _Graph(np.array(pairs, int).reshape(-1, 2), is_fixed, alignments)
    T_relaxed = graph.relax(T)
    # The sweeps of a submap move with its middle sweep. Known poses stay as they are, to the bit.
    T_correction = T_relaxed @ poses.inverse(T)
    T_moved = T_correction[submap_of_sweep] @ T_world_lidar
    T_sweeps = np.where(is_known[:, None, None], T_world_lidar, T_moved)
    return Relaxed(T_sweeps, graph.are_connected(T_relaxed)[submap_of_sweep])


def _group_into_submaps(is_known: Bool, num_sweeps: int) -> tuple[Int, Int]:
    """Return (n,) the ascending submap of each sweep, and (m,) the middle sweep of each submap."""
    # A submap has either known sweeps or others. Submaps are counted from the known sweeps.
    # Therefore incomplete submaps lie at both ends of the road and after the last known sweep.
    first, last = np.flatnonzero(is_known)[[0, -1]]
    row = np.arange(len(is_known))
    after_known = (last - first) // num_sweeps + 1 + (row - last - 1) // num_sweeps
    submap = np.where(row <= last, (row - first) // num_sweeps, after_known)
    submap_of_sweep = submap - submap[0]
    num_submaps = submap_of_sweep[-1] + 1
    middle = [int(np.median(np.flatnonzero(submap_of_sweep == i))) for i in range(num_submaps)]
    return submap_of_sweep, np.array(middle)


class _Graph:
    """A pose graph: m submaps as nodes, and p alignments between two submaps as edges."""

    def __init__(self, ends: Int, is_fixed: Bool, alignments: Sequence[Alignment]) -> None:
        """Build the graph of alignments with target and source submap (p,2), fixed ones (m,)."""
        self._ends = ends
        self._is_fixed = is_fixed
        T_target_source = np.array([pair.T_target_source for pair in alignments])
        self._T_source_target = np.linalg.inv(T_target_source.reshape(-1, 4, 4))
        information = np.array([pair.information for pair in alignments])
        self._information = information.reshape(-1, 6, 6)
        self._overlap = np.array([pair.overlap for pair in alignments])

    def relax(self, T_world_submap: Float) -> Float:
        """Return the submap poses (m,4,4) that fit the alignments best, by Gauss-Newton."""
        T = T_world_submap.copy()
        is_free = ~self._is_fixed
        if is_free.any():
            for _ in range(10):
                T[is_free] = T[is_free] @ poses.exp(self._step(T))
        return T

    def are_connected(self, T: Float) -> Bool:
        """Return (m,) True for submaps that reliable gaps connect to fixed ones, at T (m,4,4)."""
        target, source = self._ends.T  # submap numbers; a target is below its source
        is_wrong = self._error_m(self._residual(T)) > 0.1  # good alignments: at most 0.03 m
        # Gap k lies between submaps k and k + 1. A single wrong alignment does not break the gap.
        gap = np.arange(len(self._is_fixed) - 1)
        spans = (target[:, None] <= gap) & (source[:, None] > gap)
        is_reliable = (is_wrong[:, None] & spans).sum(axis=0) <= 0.25 * spans.sum(axis=0)
        # Neighbouring submaps that share less than half of their surface show different places.
        is_adjacent = source - target == 1
        is_reliable[target[is_adjacent]] &= self._overlap[is_adjacent] >= 0.5
        # A submap is connected if all gaps on its way to the fixed submaps are reliable.
        first_fixed, last_fixed = np.flatnonzero(self._is_fixed)[[0, -1]]
        connected = np.ones(len(self._is_fixed), bool)
        gaps_before, gaps_after = is_reliable[:first_fixed], is_reliable[last_fixed:]
        connected[:first_fixed] = np.logical_and.accumulate(gaps_before[::-1])[::-1]
        connected[last_fixed + 1 :] = np.logical_and.accumulate(gaps_after)
        return connected

    def _T_target_source(self, T: Float) -> Float:
        """Return (p,4,4) poses of sources in their target's frame, from submap poses (m,4,4)."""
        return poses.inverse(T[self._ends[:, 0]]) @ T[self._ends[:, 1]]

    def _residual(self, T: Float) -> Float:
        """Return (p,6) the motion (rad, m) of each source away from its aligned pose."""
        return poses.log(self._T_source_target @ self._T_target_source(T))

    def _error_m(self, residual: Float) -> Float:
        """Return the (p,) RMS distances (m) of source and target surfaces for (p,6) residuals."""
        square = np.einsum("pi,pij,pj->p", residual, self._information, residual)
        return np.sqrt(np.maximum(square, 0))

    def _step(self, T: Float) -> Float:
        """Return (f,6) the next Gauss-Newton step of each free submap, in its own frame."""
        # The step x minimises Σ w (r + J x)ᵀ Ω (r + J x) over the alignments, with residual r,
        # Jacobian J, information Ω, and Cauchy weight w, which limits wrong alignments.
        residual = self._residual(T)
        weight = 1 / (1 + (self._error_m(residual) / _USUAL_M) ** 2)
        # The first six columns of J are minus the target's motion, seen in the source's frame, the
        # last six the source's own. Row k of ``images``, of unit twist k, is minus column k of J.
        T_source_target = poses.inverse(self._T_target_source(T))
        images = poses.transform_twist(T_source_target[:, None], np.eye(6))
        jacobian = np.zeros((len(residual), 6, 12))
        jacobian[:, :, :6] = -images.transpose(0, 2, 1)
        jacobian[:, :, 6:] = np.eye(6)
        weighted = jacobian.transpose(0, 2, 1) @ (weight[:, None, None] * self._information)
        return self._solve(weighted @ jacobian, weighted @ residual[:, :, None])

    def _solve(self, matrices: Float, gradients: Float) -> Float:
        """Solve the normal equations, sums of (p,12,12) matrices and (p,12,1) gradients; (f,6)."""
        # Each free submap has 6 unknowns. Fixed submaps share 6 more at the end, which are cut off.
        is_free = ~self._is_fixed
        num_unknowns = 6 * int(is_free.sum())
        first_unknown = np.where(is_free, 6 * (np.cumsum(is_free) - 1), num_unknowns)
        unknown = (first_unknown[self._ends][:, :, None] + np.arange(6)).reshape(-1, 12)
        row, column = np.broadcast_arrays(unknown[:, :, None], unknown[:, None, :])
        matrix = sparse.csc_matrix((matrices.ravel(), (row.ravel(), column.ravel())))
        gradient = np.bincount(unknown.ravel(), gradients.ravel())
        step = -spsolve(matrix[:num_unknowns, :num_unknowns], gradient[:num_unknowns])
        return step.reshape(-1, 6)
