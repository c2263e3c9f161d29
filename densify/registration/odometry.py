# SPDX-License-Identifier: MIT
"""Register sweeps, point to plane, on the surfaces of the preceding second.

KISS-ICP (Vizzo et al., RA-L 2023) predicts the motion of dense sweeps. It matches a sweep with the
scan pattern of earlier ones: a rosette that turns 7 degrees a sweep turns these poses with it.
Surface normals of one second do not depend on the pattern (Chen, Medioni, "Object modelling by
registration of multiple range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int, Sweep
from densify.registration.alignment import FEW_POINTS, Surface, align, subsample, thin
from densify.registration.deskew import deskew_points

_SURFACE_NS = 1_050_000_000  # 1 s, with a tolerance for irregular stamps
_MAX_SURFACE_SWEEPS = 10  # sweeps of the preceding second; a larger number is thinned evenly
# A pattern that does not repeat fills its field of view in this time. The surface of one sweep
# therefore serves the sweeps of this time too.
FRESH_NS = 350_000_000
_NUM_START = 3  # sweeps that make the first surface, at their predicted poses
_VOXEL_M = 0.25  # voxel in which surfaces and aligned sweeps keep one point
# Neighbours must include the next rings. Points of one ring give normals of noise, which lean
# towards the scanner and tilt the vehicle by 0.03 degrees a sweep.
_NUM_NEIGHBORS, _NUM_NEIGHBORS_OF_FEW = 20, 50
# One distance per round. The last is narrow, because points outside the target have no match.
_MATCH_M = (0.5, 0.2)
_MATCH_UNPREDICTED_M = (0.9, *_MATCH_M)  # constant velocity is up to 0.3 m off after 0.1 s
# Damping: the information of one match in a hundred, 10 m away, for a motion of zero. It keeps a
# sweep in place along highways, where one plane in fifty constrains the motion.
_DAMPING = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def register_on_surfaces(
    sweeps: Sequence[Sweep], twists: Float | None = None
) -> tuple[Float, list[Float]]:
    """Register raw sweeps, each with the sweeps of the preceding 1 s.

    The first sweeps are registered with the sweeps of the following 1 s.

    Args:
        sweeps: S raw sweeps, ascending in time.
        twists: (S,6) predicted velocities (rad/s, m/s), each from the preceding sweep to this one,
            in the lidar frame, from `find_odometry`. None predicts constant velocity.

    Returns:
        The (S,4,4) poses in the frame of the first sweep, and (N,3) deskewed points of each sweep
            in that frame, at most about 15,000.
    """
    if twists is not None:
        return _SweepSeries(sweeps, _NUM_NEIGHBORS, _MATCH_M).register(twists[0], twists)
    series = _SweepSeries(sweeps, _NUM_NEIGHBORS_OF_FEW, _MATCH_UNPREDICTED_M)
    if len(sweeps) == 1:
        return series.register(np.zeros(6))
    # The searched velocity may be wrong by some m/s. The first second is therefore registered once
    # to measure the velocity, and registered again with all sweeps.
    searched_twist = search_twist(series.stamp_ns, [sweep.points for sweep in sweeps])
    end_ns = series.stamp_ns[0] + _SURFACE_NS
    num = int(np.searchsorted(series.stamp_ns, end_ns, side="right"))
    first_second = _SweepSeries(sweeps[:num], _NUM_NEIGHBORS_OF_FEW, _MATCH_UNPREDICTED_M)
    T, _ = first_second.register(searched_twist)
    # The first step between two sweeps that were both aligned with earlier ones
    first_aligned_step = min(_NUM_START + 1, len(T) - 1)
    return series.register(poses.twist_to(T, series.stamp_ns, first_aligned_step))


class _PosedSurface(NamedTuple):
    """A surface that sweeps are aligned with."""

    surface: Surface  # the surface, in its own frame
    T_world_surface: Float  # (4,4) its pose
    latest: int  # index of the surface's sweep that is nearest to the aligned sweeps


class _SweepSeries:
    """Raw sweeps, ascending in time, that are aligned with each other."""

    def __init__(
        self, sweeps: Sequence[Sweep], num_neighbors: int, match_m: Sequence[float]
    ) -> None:
        """Prepare the sweeps, with matches up to ``match_m`` for each round of alignment."""
        self._sweeps = [subsample(sweep, FEW_POINTS) for sweep in sweeps]
        self.stamp_ns = np.array([sweep.stamp_ns for sweep in sweeps], np.int64)
        self._step_s = np.diff(self.stamp_ns) * 1e-9
        self._num_neighbors = num_neighbors
        self._match_m = match_m
        self._T: Float = np.tile(np.eye(4), (len(sweeps), 1, 1))  # (S,4,4) poses in the world
        # (N,3) deskewed points, in the world, of the sweeps aligned at least once
        self._points: dict[int, Float] = {}
        self._surface: _PosedSurface | None = None  # the surface in use

    def register(self, twist: Float, twists: Float | None = None) -> tuple[Float, list[Float]]:
        """Return the poses and points of `register_on_surfaces`, from an initial velocity (6,)."""
        # The first sweeps have too few sweeps before them for a surface. They keep their
        # predictions, until the sweeps after them are aligned.
        num = len(self._sweeps)
        num_start = min(_NUM_START, num // 2)
        self._register_forwards(num_start, twist, twists)
        if num > 2:
            self._reregister_start(num_start, twists)
        # From the world of the alignment to the frame of the first sweep, whose pose is exactly I
        T_first_world = poses.inverse(self._T[0])
        points = [poses.transform(T_first_world, self._points[i]) for i in range(num)]
        return np.stack([np.eye(4), *(T_first_world @ T for T in self._T[1:])]), points

    def _register_forwards(self, num_start: int, twist: Float, twists: Float | None) -> None:
        """Predict the first sweeps, and align the later ones with the sweeps before them."""
        self._points[0] = deskew_points(self._sweeps[0], twist)
        for i in range(1, len(self._sweeps)):
            twist = twist if twists is None else twists[i]
            T_guess = self._T[i - 1] @ poses.exp(twist * self._step_s[i - 1])
            # The sweeps of the preceding second, at least one, the nearest first
            begin_ns = self.stamp_ns[i] - _SURFACE_NS
            first = min(int(np.searchsorted(self.stamp_ns, begin_ns)), i - 1)
            neighbours = range(i - 1, first - 1, -1) if i >= num_start else range(0)
            twist = self._align_sweep(i, i, T_guess, twist, neighbours)

    def _reregister_start(self, num_start: int, twists: Float | None) -> None:
        """Align the first sweeps, the last one first, with the sweeps after them."""
        # The step to sweep num_start + 1 is the first one between two aligned sweeps.
        twist = poses.twist_to(self._T, self.stamp_ns, num_start + 1)
        self._surface = None  # the surface in use is of later sweeps
        for i in range(num_start - 1, -1, -1):
            # ``twists[i + 1]`` is the velocity of the step from sweep i to the next sweep.
            twist = twist if twists is None else twists[i + 1]
            T_guess = self._T[i + 1] @ poses.exp(-twist * self._step_s[i])
            end_ns = self.stamp_ns[i] + _SURFACE_NS
            end = int(np.searchsorted(self.stamp_ns, end_ns, side="right"))
            neighbours = range(i + 1, max(end, i + 2))  # the next sweep, at any distance in time
            twist = self._align_sweep(i, i + 1, T_guess, twist, neighbours)

    def _align_sweep(
        self, i: int, step_end: int, T_guess: Float, twist: Float, neighbours: range
    ) -> Float:
        """Align sweep i with ``neighbours``, nearest first, and return its velocity (6,)."""
        # The velocity is that of the step that ends at sweep ``step_end``, between sweep i and the
        # adjacent sweep that has a pose already.
        self._T[i] = T_guess  # without neighbours the sweep keeps its prediction
        if neighbours:
            surface, T_world_surface = self._surface_for(i, neighbours)
            T_surface_lidar = poses.inverse(T_world_surface) @ T_guess
            # Each round deskews the points by the velocity that the previous round found.
            for match_m in self._match_m:
                points = deskew_points(self._sweeps[i], twist)
                T_surface_lidar = _align_once(surface, points, T_surface_lidar, match_m)
                self._T[i] = T_world_surface @ T_surface_lidar
                twist = poses.twist_to(self._T, self.stamp_ns, step_end)
        self._points[i] = poses.transform(self._T[i], deskew_points(self._sweeps[i], twist))
        return twist

    def _surface_for(self, i: int, neighbours: range) -> tuple[Surface, Float]:
        """Return a surface to align sweep i with, and the (4,4) pose of this surface."""
        if self._surface is not None:
            surface, T_world_surface, latest = self._surface
            if abs(self.stamp_ns[i] - self.stamp_ns[latest]) < FRESH_NS:
                return surface, T_world_surface
        T_world_surface = self._T[i].copy()
        # The surface has the frame of sweep i's prediction.
        chosen = neighbours[:: max(1, round(len(neighbours) / _MAX_SURFACE_SWEEPS))]
        points = np.concatenate([self._points[j] for j in chosen])
        points = poses.transform(poses.inverse(T_world_surface), points)
        surface = Surface.of(points, _VOXEL_M, self._num_neighbors)
        self._surface = _PosedSurface(surface, T_world_surface, neighbours[0])
        return surface, T_world_surface


def _align_once(surface: Surface, points: Float, T_surface_lidar: Float, match_m: float) -> Float:
    """Return the pose (4,4) after one alignment of points (N,3) with a surface, damped."""
    source = thin(points, _VOXEL_M)
    T_aligned, _, information = align(surface, source, T_surface_lidar, match_m)
    # A damped Gauss-Newton step towards the aligned pose: directions that few matches constrain
    # hardly move.
    gradient = information @ poses.log(poses.inverse(T_surface_lidar) @ T_aligned)
    motion = np.linalg.solve(information + _DAMPING, gradient)
    return np.asarray(T_surface_lidar @ poses.exp(np.asarray(motion, np.float64)))


_MAX_STEP_M = 60.0  # sweeps farther apart hardly overlap
_MAX_STEPS_AT_ONCE = 1000  # motions of the grid that are tried at once
MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
# Change of a pose (rad and m) below which KISS-ICP stops. 3 mm in 0.1 s bend a sweep by 1.5 mm.
_CONVERGED = 3e-3

_STEP_M, _STEP_S = 0.5, 0.1  # steps of the speed search; smaller in proportion for shorter times
_NUM_SAMPLES = 800
_MAX_DISTANCE_M = 1.0  # greatest distance that counts
_RAY_GAP_RAD = 0.01  # angle between rays; objects along the road meet the same rays at any speed
_ABOVE_GROUND_M = 0.4


def find_odometry(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """Return the (S,6) approximate velocities (rad/s, m/s) of S >= 2 raw sweeps, by KISS-ICP.

    Each is that of the step from the preceding sweep, in the lidar frame. The first equals the
    second. Only points above the ground are used: rings on flat ground look the same at any speed.
    KISS-ICP assumes a start at rest. Therefore `search_twist` starts it, and sweeps of a fast
    scanner are registered about 0.1 s apart.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    # One sweep of each 0.1 s, at least two
    stamp_ns = np.array([sweep.stamp_ns for sweep in sweeps], np.int64)
    chosen = [batch[0] for batch in Clock(stamp_ns).batches()]
    if len(chosen) == 1:
        chosen = [0, len(sweeps) - 1]
    chosen_ns = stamp_ns[chosen]
    points = [above_ground(subsample(sweeps[i]).points) for i in chosen]

    config = KISSConfig.model_construct()  # unlike KISSConfig(), without environment variables
    config.data.max_range, config.data.min_range = settings.max_range_m, settings.min_range_m
    config.data.deskew = False  # KISS-ICP aborts the process on equal times of points
    config.mapping.voxel_size = settings.voxel_size_m
    config.registration.convergence_criterion = _CONVERGED
    # One thread: the order of a parallel sum, and with it the last bits, change between runs.
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    no_times = np.empty(0)

    odometry.register_frame(points[0], no_times)
    twists = [search_twist(chosen_ns, [sweeps[i].points for i in chosen])]
    for sweep_points, seconds in zip(points[1:], np.diff(chosen_ns) * 1e-9, strict=True):
        # KISS-ICP predicts the motion of the last step again. The steps may differ in duration.
        odometry.last_delta = poses.exp(twists[-1] * seconds)
        odometry.register_frame(sweep_points, no_times)
        twists.append(poses.log(odometry.last_delta) / seconds)
    # Velocity k is that of the step to chosen sweep k. Number 0 is only the searched velocity. Each
    # sweep gets the velocity of the step that it lies in.
    step = np.searchsorted(chosen_ns, stamp_ns).clip(1, len(chosen) - 1)
    return np.stack(twists)[step]


def search_twist(stamp_ns: Int, points: Sequence[Float]) -> Float:
    """Return the (6,) initial velocity (rad/s, m/s), without rotation, by a grid search.

    It is the velocity that best aligns the points above the ground in the first three sweeps. The
    grid moves the second sweep by steps of 1 m, then by 0.5 m around the best position. The steps
    are shorter for sweeps less than 0.1 s apart.

    Args:
        stamp_ns: (S,) reference times of the sweeps.
        points: (N,3) of each sweep, metres, in its own lidar frame.
    """
    # The first two steps, of which the second may have another duration
    step_s = np.diff(stamp_ns[:3]) * 1e-9
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(map(above_ground, points[:3]))):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _NUM_SAMPLES + 1]]
        ray_gap_m = _RAY_GAP_RAD * np.linalg.norm(sample, axis=1)
        pairs.append(_SweepPair(tree_of(earlier), sample, step_s[i] / step_s[0], ray_gap_m))

    def find_best_step(steps_m: Float) -> Float:
        chunks = np.array_split(steps_m, len(steps_m) // _MAX_STEPS_AT_ONCE + 1)
        cost_m = np.concatenate([_step_cost_m(chunk, pairs) for chunk in chunks])
        return np.asarray(steps_m[np.argmin(cost_m)])

    step_m = _STEP_M * min(1.0, step_s[0] / _STEP_S)
    reach_m = min(MAX_SPEED_M_S * step_s[0], _MAX_STEP_M)
    coarse_m = find_best_step(_grid(np.zeros(2), reach_m, 2 * step_m))
    fine_m = find_best_step(_grid(coarse_m[:2], 2 * step_m, step_m))
    return np.append(np.zeros(3), fine_m / step_s[0])


class _SweepPair(NamedTuple):
    """Two consecutive sweeps that a velocity must align."""

    tree: cKDTree  # search tree of the earlier sweep's points
    sample: Float  # (K,3) sampled points of the later sweep, its lidar frame
    duration_ratio: float  # time between the sweeps, relative to that between the first two
    ray_gap_m: Float  # (K,) distance between neighbouring rays at the sampled points


def _step_cost_m(steps_m: Float, pairs: Sequence[_SweepPair]) -> Float:
    """Return the (n,) sums of the pairs' mean distances for motions (n,3) of the second sweep."""
    # Distances below the gap between rays count as 0: a guard rail looks the same from a vehicle at
    # rest and from a vehicle that moves along the rail. Of equal motions the shortest is best.
    cost_m = 1e-3 * np.linalg.norm(steps_m, axis=1)
    for pair in pairs:
        moved = (pair.sample + pair.duration_ratio * steps_m[:, None, :]).reshape(-1, 3)
        distance_m, _ = pair.tree.query(moved, distance_upper_bound=_MAX_DISTANCE_M, workers=-1)
        distance_m = np.minimum(distance_m, _MAX_DISTANCE_M).reshape(len(steps_m), -1)
        cost_m += np.maximum(distance_m - pair.ray_gap_m, 0.0).mean(1)
    return np.asarray(cost_m)


def _grid(centre: Float, reach_m: float, step_m: float) -> Float:
    """Return (n,3) horizontal motions on a square grid around a centre (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(centre[0] + span, centre[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def above_ground(points: Float) -> Float:
    """Return those of (N,3) points over 0.4 m above the lowest point of their 1 m cell.

    Returns all points if none is.
    """
    if not len(points):
        return points
    x, y, z = points.T
    row = np.floor(x).astype(np.int64)
    row = row - row.min()
    column = np.floor(y).astype(np.int64)
    column = column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    above = points.take(np.flatnonzero(z > lowest[cell] + _ABOVE_GROUND_M), axis=0)
    return above if len(above) else points
