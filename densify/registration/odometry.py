# SPDX-License-Identifier: MIT
"""Align surfaces by small_gicp, and register sweeps on the surfaces of the preceding second.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024. KISS-ICP (Vizzo et al.,
RA-L 2023) predicts the motion of dense sweeps. It matches a sweep with the scan pattern of earlier
ones: a rosette that turns 7 degrees a sweep turns these poses with it. Surface normals of one
second do not depend on the pattern (Chen, Medioni, "Object modelling by registration of multiple
range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int, Sweep
from densify.registration.deskew import deskew_points

MANY_POINTS = 30_000  # points of a sweep that makes a surface
FEW_POINTS = 15_000  # points of a sweep that is aligned
_SURFACE_NS = 1_050_000_000  # 1 s, with a tolerance for irregular stamps
# A pattern that does not repeat fills its field of view in this time. The surface of one sweep
# therefore serves the sweeps of this time too.
FRESH_NS = 350_000_000
MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
_NUM_START = 3  # sweeps that make the first surface, at their predicted poses
_VOXEL_M = 0.25  # voxel in which surfaces and aligned sweeps keep one point
# Damping: the information of one match in a hundred, 10 m away, for a motion of zero. It keeps a
# sweep in place along highways, where one plane in fifty constrains the motion.
_DAMPING = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def subsample(sweep: Sweep, max_points: int = MANY_POINTS) -> Sweep:
    """Return about ``max_points`` points of a larger sweep, spread evenly over its rings."""
    num_points = len(sweep)
    if num_points <= max_points:
        return sweep
    # The multiples of the golden ratio, modulo 1, are spread evenly in [0, 1). Points below a
    # threshold are therefore an even sample of each ring, in any order of the rings.
    fraction = np.arange(num_points) * 0.6180339887498949
    fraction -= np.floor(fraction)
    return sweep.select(fraction < max_points / num_points)


class Surface(NamedTuple):
    """Points thinned to voxels, with the normal and covariance of each point's neighbours."""

    points: Any  # a ``PointCloud`` of small_gicp, in metres
    tree: Any  # the k-d tree of these points

    @staticmethod
    def of(points: Float, voxel_m: float = 0.5, num_neighbors: int = 10) -> Surface:
        """Return the surface of points (N,3), metres, thinned to one per voxel, in their frame.

        ``num_neighbors`` is the number of neighbours that give a point's normal.
        """
        return Surface(*small_gicp.preprocess_points(points, voxel_m, num_neighbors, 1))

    @staticmethod
    def of_sweep(sweep: Sweep) -> Surface:
        """Return the surface of a deskewed sweep, in its lidar frame."""
        return Surface.of(subsample(sweep).points)


class Alignment(NamedTuple):
    """The alignment of a source with a target surface."""

    T_target_source: Float  # (4,4) pose of the source in the target's frame
    overlap: float  # share of the source's points with a match in the target
    # (6,6) matrix of a quadratic form. For a small motion x (rad, m) of the source in its own
    # frame, ``x @ information @ x`` is the mean square distance (m²) of the source from the target.
    information: Float


def make_map() -> Any:
    """Return an empty map of surfaces, a ``GaussianVoxelMap`` of small_gicp with 1 m voxels.

    Koide et al., "Voxelized GICP for Fast and Accurate 3D Point Cloud Registration", ICRA 2021.
    """
    return small_gicp.GaussianVoxelMap(1.0)


def align(target: Any, source: Any, T_target_source: Float, match_m: float) -> Alignment:
    """Align a source with a target from an initial pose.

    A source `Surface` is aligned by generalized ICP, other points are aligned point to plane.

    Args:
        target: A `Surface`, or a map (`make_map`) of surfaces.
        source: A `Surface`, or a ``PointCloud`` without covariances, in its own frame.
        T_target_source: (4,4) initial pose of the source.
        match_m: Greatest distance in metres between corresponding points.
    """
    is_surface = isinstance(source, Surface)
    points = source.points if is_surface else source
    options: dict[str, Any] = {"max_correspondence_distance": match_m, "num_threads": 1}
    if isinstance(target, Surface):
        kind = "GICP" if is_surface else "PLANE_ICP"
        fit = small_gicp.align(target.points, points, target.tree, T_target_source, kind, **options)
    else:
        fit = small_gicp.align(target, points, T_target_source, **options)
    # H is a sum over matches. Generalized ICP divides squared distances by the variance of both
    # surfaces along the normal, whose standard deviation is 0.0447 m.
    num_matches = max(int(fit.num_inliers), 1)
    scale_m2 = 0.0447**2 if is_surface else 1.0
    information = np.asarray(fit.H) * scale_m2 / num_matches
    overlap = fit.num_inliers / max(int(points.size()), 1)
    return Alignment(np.asarray(fit.T_target_source), overlap, information)


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
        T_first_lidar: (S,4,4) poses in the lidar frame of the first sweep.
        points: For each sweep at most about 15,000 deskewed points (N,3), metres, in that frame.
    """
    series = _SweepSeries(sweeps, twists)
    if twists is not None:
        return series.register(twists[0])
    if len(sweeps) == 1:
        return series.register(np.zeros(6))
    # The searched velocity may be wrong by some m/s. The first second is therefore registered once
    # to measure the velocity, and registered again with all sweeps.
    searched_twist = search_twist(series.stamp_ns, [sweep.points for sweep in sweeps])
    end_ns = series.stamp_ns[0] + _SURFACE_NS
    num_in_second = int(np.searchsorted(series.stamp_ns, end_ns, side="right"))
    T, _ = _SweepSeries(sweeps[:num_in_second], None).register(searched_twist)
    # The first step between two sweeps that were both aligned with earlier ones
    first_aligned_step = min(_NUM_START + 1, len(T) - 1)
    return series.register(poses.twist_to(T, series.stamp_ns, first_aligned_step))


class _PosedSurface(NamedTuple):
    """A surface that sweeps are aligned with."""

    surface: Surface  # the surface, in its own frame
    T_world_surface: Float  # (4,4) its pose
    nearest: int  # index of the surface's sweep that is nearest in time to the aligned sweeps


class _SweepSeries:
    """Raw sweeps, ascending in time, that are aligned with each other."""

    def __init__(self, sweeps: Sequence[Sweep], twists: Float | None) -> None:
        """Prepare S sweeps, with predicted velocities (S,6) of the steps to them, if known."""
        self.stamp_ns = np.array([sweep.stamp_ns for sweep in sweeps], np.int64)
        self._sweeps = [subsample(sweep, FEW_POINTS) for sweep in sweeps]
        self._twists = twists
        # Greatest distance of a match in each round of alignment. Constant velocity is up to 0.3 m
        # off after 0.1 s. The last is narrow, because points outside the target have no match.
        self._match_m = (0.9, 0.5, 0.2) if twists is None else (0.5, 0.2)
        # Neighbours must include the next rings. Points of one ring give normals of noise, which
        # lean towards the scanner and tilt the vehicle by 0.03 degrees a sweep.
        self._num_neighbors = 50 if twists is None else 20
        self._T: Float = np.tile(np.eye(4), (len(sweeps), 1, 1))  # (S,4,4) poses in the world
        # (N,3) deskewed points, in the world, of the sweeps aligned at least once
        self._points: dict[int, Float] = {}
        self._surface: _PosedSurface | None = None  # the surface in use

    def register(self, twist: Float) -> tuple[Float, list[Float]]:
        """Return poses (S,4,4) and deskewed points (N,3) of each sweep, in the first sweep's frame.

        ``twist`` (6,), rad/s and m/s, is the velocity at the first sweep, lidar frame.
        """
        # The first sweeps have too few sweeps before them for a surface. They keep their
        # predictions, until the sweeps after them are aligned.
        num_sweeps = len(self._sweeps)
        num_start = min(_NUM_START, num_sweeps // 2)
        self._points[0] = deskew_points(self._sweeps[0], twist)
        for i in range(1, num_sweeps):
            twist = self._align_sweep(i, i - 1, twist, is_predicted=i < num_start)
        if num_sweeps > 2:
            # The step to sweep num_start + 1 is the first one between two aligned sweeps.
            twist = poses.twist_to(self._T, self.stamp_ns, num_start + 1)
            self._surface = None  # the surface in use is of later sweeps
            for i in range(num_start - 1, -1, -1):
                twist = self._align_sweep(i, i + 1, twist)
        # From the world of the alignment to the frame of the first sweep, whose pose is exactly I
        T_first_world = poses.inverse(self._T[0])
        points = [poses.transform(T_first_world, self._points[i]) for i in range(num_sweeps)]
        return np.stack([np.eye(4), *(T_first_world @ T for T in self._T[1:])]), points

    def _align_sweep(
        self, i: int, adjacent: int, twist: Float, is_predicted: bool = False
    ) -> Float:
        """Align sweep i with sweeps on the side of an adjacent one, and return its velocity (6,).

        Args:
            i: Index of the sweep.
            adjacent: Index of the sweep before or after it, which has a pose already.
            twist: (6,) velocity of the last step, the prediction if there is no other.
            is_predicted: True keeps the prediction.
        """
        # The velocity is that of the step between both sweeps.
        step_end = max(i, adjacent)
        twist = twist if self._twists is None else self._twists[step_end]
        seconds = (self.stamp_ns[i] - self.stamp_ns[adjacent]) * 1e-9
        self._T[i] = self._T[adjacent] @ poses.exp(twist * seconds)
        if not is_predicted:
            self._surface = self._surface_for(i, adjacent)
            surface, T_world_surface, _ = self._surface
            T_surface_lidar = poses.inverse(T_world_surface) @ self._T[i]
            # Each round deskews the points by the velocity that the previous round found.
            for match_m in self._match_m:
                points = deskew_points(self._sweeps[i], twist)
                T_surface_lidar = _align_once(surface, points, T_surface_lidar, match_m)
                self._T[i] = T_world_surface @ T_surface_lidar
                twist = poses.twist_to(self._T, self.stamp_ns, step_end)
        self._points[i] = poses.transform(self._T[i], deskew_points(self._sweeps[i], twist))
        return twist

    def _surface_for(self, i: int, adjacent: int) -> _PosedSurface:
        """Return a surface to align sweep i with: the one in use, or one of the nearest second."""
        since_ns = np.abs(self.stamp_ns - self.stamp_ns[i])
        if self._surface is not None and since_ns[self._surface.nearest] < FRESH_NS:
            return self._surface
        # The nearest sweep first, at any distance in time. About 10 sweeps, a second at the usual
        # rate, suffice: a faster scanner's sweeps are thinned to save time.
        side = range(i - 1, -1, -1) if adjacent < i else range(i + 1, len(self._sweeps))
        neighbours = [j for j in side if j == adjacent or since_ns[j] <= _SURFACE_NS]
        chosen = neighbours[:: max(1, round(len(neighbours) / 10))]
        points = np.concatenate([self._points[j] for j in chosen])
        # The surface has the frame of sweep i's prediction.
        T_world_surface = self._T[i].copy()
        points = poses.transform(poses.inverse(T_world_surface), points)
        surface = Surface.of(points, _VOXEL_M, self._num_neighbors)
        return _PosedSurface(surface, T_world_surface, adjacent)


def _align_once(surface: Surface, points: Float, T_surface_lidar: Float, match_m: float) -> Float:
    """Return the pose (4,4) after one alignment of points (N,3) with a surface, damped."""
    source = small_gicp.voxelgrid_sampling(points, _VOXEL_M)
    T_aligned, _, information = align(surface, source, T_surface_lidar, match_m)
    # A damped Gauss-Newton step towards the aligned pose: directions that few matches constrain
    # hardly move. The step solves (information + damping) step = information · undamped step.
    undamped = poses.log(poses.inverse(T_surface_lidar) @ T_aligned)
    step = np.linalg.solve(information + _DAMPING, information @ undamped)
    return np.asarray(T_surface_lidar @ poses.exp(np.asarray(step, np.float64)))


def find_odometry(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """Return approximate velocities (S,6), rad/s and m/s, of S >= 2 raw sweeps, by KISS-ICP.

    Each is that of the step from the preceding sweep, in the lidar frame. The first equals the
    second. Only points above the ground are used: rings on flat ground look the same at any speed.
    KISS-ICP assumes a start at rest. Therefore a grid search gives it the first velocity, and
    sweeps of a fast scanner are registered about 0.1 s apart.
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
    # Change of a pose (rad, m) at which KISS-ICP stops: 3 mm in 0.1 s bend a sweep by 1.5 mm.
    config.registration.convergence_criterion = 3e-3
    # One thread: the order of a parallel sum, and with it the last bits, change between runs.
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    no_times = np.empty(0)

    odometry.register_frame(points[0], no_times)
    twists = [search_twist(chosen_ns, [sweeps[i].points for i in chosen])]
    for sweep_points, step_s in zip(points[1:], np.diff(chosen_ns) * 1e-9, strict=True):
        # KISS-ICP predicts the motion of the last step again. The steps may differ in duration.
        odometry.last_delta = poses.exp(twists[-1] * step_s)
        odometry.register_frame(sweep_points, no_times)
        twists.append(poses.log(odometry.last_delta) / step_s)
    # Velocity k is that of the step to chosen sweep k. Number 0 is only the searched velocity. Each
    # sweep gets the velocity of the step during which it was measured.
    step = np.searchsorted(chosen_ns, stamp_ns).clip(1, len(chosen) - 1)
    return np.stack(twists)[step]


def search_twist(stamp_ns: Int, points: Sequence[Float]) -> Float:
    """Return the initial velocity (6,), rad/s and m/s, lidar frame, from a grid without rotation.

    This velocity best aligns the points above the ground in the first three sweeps. The grid moves
    the second sweep by steps of 1 m, then by 0.5 m around the best position. The steps are shorter
    for sweeps less than 0.1 s apart.

    Args:
        stamp_ns: (S,) reference times of the sweeps.
        points: (N,3) of each sweep, metres, in its own lidar frame.
    """
    # Durations of the steps between the first three sweeps, which may differ
    step_s = np.diff(stamp_ns[:3]) * 1e-9
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(map(above_ground, points[:3]))):
        # At most 800 points, spread evenly over voxels of 1 m, suffice for the speed.
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)
        sample = later[rows[:: len(rows) // 800 + 1]]
        # Neighbouring rays are about 0.01 rad apart.
        ray_gap_m = 0.01 * np.linalg.norm(sample, axis=1)
        pairs.append(_SweepPair(tree_of(earlier), sample, step_s[i] / step_s[0], ray_gap_m))

    def find_best_step(centre_m: Float, reach_m: float, step_m: float) -> Float:
        num_steps = np.ceil(reach_m / step_m)
        span_m = np.arange(-num_steps, num_steps + 1) * step_m
        x, y = np.meshgrid(centre_m[0] + span_m, centre_m[1] + span_m, indexing="ij")
        steps_m = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
        chunks = np.array_split(steps_m, len(steps_m) // 1000 + 1)  # limits the memory
        cost_m = np.concatenate([_step_cost_m(chunk, pairs) for chunk in chunks])
        return np.asarray(steps_m[np.argmin(cost_m)])

    step_m = 0.5 * min(1.0, step_s[0] / 0.1)
    reach_m = min(MAX_SPEED_M_S * step_s[0], 60.0)  # sweeps farther apart hardly overlap
    coarse_m = find_best_step(np.zeros(3), reach_m, 2 * step_m)
    fine_m = find_best_step(coarse_m, 2 * step_m, step_m)
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
    # Distances above 1 m count as 1 m.
    cost_m = 1e-3 * np.linalg.norm(steps_m, axis=1)
    for pair in pairs:
        moved = (pair.sample + pair.duration_ratio * steps_m[:, None, :]).reshape(-1, 3)
        distance_m, _ = pair.tree.query(moved, distance_upper_bound=1.0, workers=-1)
        distance_m = np.minimum(distance_m, 1.0).reshape(len(steps_m), -1)
        cost_m += np.maximum(distance_m - pair.ray_gap_m, 0.0).mean(1)
    return np.asarray(cost_m)


def above_ground(points: Float) -> Float:
    """Return the points that are more than 0.4 m above the lowest point of their 1 m cell.

    If no point is, all points are returned. ``points`` are (N,3) metres with z up.
    """
    if not len(points):
        return points
    x, y, z = np.ascontiguousarray(points.T)
    cell = np.floor([x, y]).astype(np.int64)
    cell -= cell.min(axis=1, keepdims=True)
    number = np.ravel_multi_index(tuple(cell), tuple(cell.max(axis=1) + 1))
    lowest = np.full(number.max() + 1, np.inf)
    np.minimum.at(lowest, number, z)
    above = points.take(np.flatnonzero(z > lowest[number] + 0.4), axis=0)
    return above if len(above) else points
