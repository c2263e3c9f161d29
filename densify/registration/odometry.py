# SPDX-License-Identifier: MIT
"""Register sweeps point to plane on the surfaces of the last second, predicted by KISS-ICP.

KISS-ICP (Vizzo et al., RA-L 2023) matches a sample of a sweep with the scan pattern of earlier
sweeps. A rosette pattern that turns 7 degrees a sweep turns these poses with it. The surface
normals of one second do not depend on the pattern (Chen, Medioni, "Object modelling by registration
of multiple range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from densify.config import RegisterSettings
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.nearest import tree_of
from densify.geometry.types import Float, Int, Sweep
from densify.registration.alignment import FEW_POINTS, Surface, align, subsample, thin
from densify.registration.deskew import deskew_points

_REACH_NS = 1_050_000_000
_NUM_IN_REACH = 10  # sweeps of the last second; a larger number is thinned evenly
# A pattern that does not repeat fills its field of view in this time. So long a surface serves the
# next sweeps too.
FRESH_NS = 350_000_000
_NUM_START = 3  # sweeps of the first surfaces, at their expected poses
_VOXEL_M = 0.25
# Neighbours must include the next rings. Points of one ring give normals of noise, which lean
# towards the scanner and tilt the vehicle by 0.03 degrees a sweep.
_NUM_NEIGHBORS, _NUM_NEIGHBORS_OF_FEW = 20, 50
# One distance per round. The last is narrow, because points outside the target have no match.
_MATCH_M = (0.5, 0.2)
_MATCH_GUESSED_M = (0.9, *_MATCH_M)  # constant velocity is up to 0.3 m off after 0.1 s
# Information, in the mean of the matches, of one point in a hundred that stays, 10 m away. It holds
# a sweep along highways, where one plane in fifty constrains the motion.
_HELD = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def register_on_surfaces(
    sweeps: Sequence[Sweep], twists: Float | None = None
) -> tuple[Float, list[Float]]:
    """Register raw sweeps, each with the sweeps of the second before it.

    The first sweeps are registered with the sweeps after them. ``twists`` (S,6) are velocities
    (rad/s, m/s) before each sweep, by odometry. Without them each sweep starts at constant
    velocity, and the first second is registered twice: from `search_twist`, which is some metres
    per second off, then from the velocity found.

    Returns:
        The (S,4,4) poses in the frame of the first sweep, and (N,3) deskewed points of each sweep
            in that frame, at most about 15,000.
    """
    if twists is not None:
        return _SweepRow(sweeps, _NUM_NEIGHBORS, _MATCH_M).register(twists[0], twists)
    row = _SweepRow(sweeps, _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
    if len(sweeps) == 1:
        return row.register(np.zeros(6))
    twist = search_twist(row.stamp_ns, [s.points for s in sweeps])
    num = int(np.searchsorted(row.stamp_ns, row.stamp_ns[0] + _REACH_NS, side="right"))
    start = _SweepRow(sweeps[:num], _NUM_NEIGHBORS_OF_FEW, _MATCH_GUESSED_M)
    T, _ = start.register(twist)
    return row.register(poses.twist_to(T, row.stamp_ns, min(_NUM_START + 1, len(T) - 1)))


class _SweepRow:
    """Raw sweeps, ascending in time, that are aligned with each other."""

    def __init__(
        self, sweeps: Sequence[Sweep], num_neighbors: int, match_m: Sequence[float]
    ) -> None:
        """Prepare the sweeps; ``match_m``: greatest distance of a match, for each round."""
        self._sweeps = [subsample(sweep, FEW_POINTS) for sweep in sweeps]
        self.stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
        self._num_neighbors, self._match_m = num_neighbors, match_m
        self._T: Float = np.tile(np.eye(4), (len(sweeps), 1, 1))
        self._points: list[Float] = []  # of the sweeps aligned so far, in the world
        # The surface in use, its pose in the world, and the index of its latest sweep
        self._surface: tuple[Surface, Float, int] | None = None

    def register(self, twist: Float, twists: Float | None = None) -> tuple[Float, list[Float]]:
        """Return poses and points of `register_on_surfaces`, from an initial velocity (6,)."""
        num, stamp_ns = len(self._sweeps), self.stamp_ns
        num_start, step_s = min(_NUM_START, num // 2), np.diff(stamp_ns) * 1e-9
        self._points = [deskew_points(self._sweeps[0], twist)]
        for i in range(1, num):
            twist = twist if twists is None else twists[i]
            T_guess = self._T[i - 1] @ poses.exp(twist * step_s[i - 1])
            first = min(int(np.searchsorted(stamp_ns, stamp_ns[i] - _REACH_NS)), i - 1)
            neighbours = range(i - 1, first - 1, -1) if i >= num_start else range(0)
            twist = self._place(i, i, T_guess, twist, neighbours)
        if num > 2:
            twist, self._surface = poses.twist_to(self._T, stamp_ns, num_start + 1), None
            for i in range(num_start - 1, -1, -1):
                twist = twist if twists is None else twists[i + 1]
                T_guess = self._T[i + 1] @ poses.exp(-twist * step_s[i])
                end = int(np.searchsorted(stamp_ns, stamp_ns[i] + _REACH_NS, side="right"))
                twist = self._place(i, i + 1, T_guess, twist, range(i + 1, max(end, i + 2)))
        T_first_world = poses.inverse(self._T[0])
        points = [poses.transform(T_first_world, p) for p in self._points]
        return np.stack([np.eye(4), *(T_first_world @ T for T in self._T[1:])]), points

    def _place(self, i: int, step: int, T_guess: Float, twist: Float, neighbours: range) -> Float:
        """Align sweep i with ``neighbours``, nearest first; return the velocity before ``step``."""
        self._T[i] = T_guess  # without neighbours the sweep keeps its prediction
        if neighbours:
            surface, T_world_surface = self._surface_for(i, neighbours)
            T = poses.inverse(T_world_surface) @ T_guess
            for match_m in self._match_m:
                source = thin(deskew_points(self._sweeps[i], twist), _VOXEL_M)
                T_aligned, _, information = align(surface, source, T, match_m)
                gradient = information @ poses.log(poses.inverse(T) @ T_aligned)
                motion = np.linalg.solve(information + _HELD, gradient)
                T = T @ poses.exp(np.asarray(motion, np.float64))
                self._T[i] = T_world_surface @ T
                twist = poses.twist_to(self._T, self.stamp_ns, step)
        points = poses.transform(self._T[i], deskew_points(self._sweeps[i], twist))
        self._points[i : i + 1] = [points]
        return twist

    def _surface_for(self, i: int, neighbours: range) -> tuple[Surface, Float]:
        """Return a surface to align sweep i with, and its pose in the world (4,4)."""
        if self._surface is not None:
            surface, T_world_surface, nearest = self._surface
            if abs(self.stamp_ns[i] - self.stamp_ns[nearest]) < FRESH_NS:
                return surface, T_world_surface
        T_world_surface = self._T[i].copy()
        chosen = neighbours[:: max(1, round(len(neighbours) / _NUM_IN_REACH))]
        points = np.concatenate([self._points[j] for j in chosen])
        points = poses.transform(poses.inverse(T_world_surface), points)
        surface = Surface.of(points, _VOXEL_M, self._num_neighbors)
        self._surface = surface, T_world_surface, neighbours[0]
        return surface, T_world_surface


_MOST_STEP_M = 60.0  # sweeps farther apart hardly overlap
_MOST_STEPS = 1000  # of the grid, that are tried at once
MAX_SPEED_M_S = 60.0  # a faster step between two sweeps is an error of registration
# Change of a pose (rad and m) below which KISS-ICP stops. 3 mm in 0.1 s bend a sweep by 1.5 mm.
_CONVERGED = 3e-3

_STEP_M, _STEP_S = 0.5, 0.1  # steps of the speed search; smaller in proportion for shorter times
_NUM_SAMPLES = 800
_CLOSE_M = 1.0
_RAYS_RAD = 0.01  # angle between rays; objects along the road meet the same rays at any speed
_ABOVE_GROUND_M = 0.4


def find_odometry(sweeps: Sequence[Sweep], settings: RegisterSettings) -> Float:
    """Return the (S,6) approximate velocity (rad/s, m/s) before each of S raw sweeps, by KISS-ICP.

    A sample of the points above the ground is registered: with rings on flat ground, a highway of
    64 rings looks as if the vehicle were at rest. Prediction starts from `search_twist`, and sweeps
    of a fast scanner are registered about 0.1 s apart, because KISS-ICP assumes a start at rest. S
    is at least 2. The first velocity is that before the second sweep.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)
    rows = [batch[0] for batch in Clock(stamp_ns).batches()]
    rows = rows if len(rows) > 1 else [0, len(sweeps) - 1]
    points = [above_ground(subsample(sweeps[row]).points) for row in rows]
    config = KISSConfig.model_construct()  # unlike KISSConfig(), without environment variables
    config.data.max_range, config.data.min_range = settings.max_range_m, settings.min_range_m
    config.data.deskew = False  # KISS-ICP aborts the process on equal times of points
    config.mapping.voxel_size = settings.voxel_size_m
    config.registration.convergence_criterion = _CONVERGED
    # One thread: the order of a parallel sum, and with it the last bits, change between runs.
    config.registration.max_num_threads = 1
    odometry, no_times = KissICP(config), np.empty(0)
    odometry.register_frame(points[0], no_times)
    twists = [search_twist(stamp_ns[rows], [sweeps[row].points for row in rows])]
    for sweep_points, seconds in zip(points[1:], np.diff(stamp_ns[rows]) * 1e-9, strict=True):
        odometry.last_delta = poses.exp(twists[-1] * seconds)
        odometry.register_frame(sweep_points, no_times)
        twists.append(poses.log(odometry.last_delta) / seconds)
    step = np.searchsorted(stamp_ns[rows], stamp_ns).clip(1, len(rows) - 1)
    return np.stack(twists)[step]


def search_twist(stamp_ns: Int, points: Sequence[Float]) -> Float:
    """Return the (6,) initial velocity (rad/s, m/s), without rotation, by a grid search.

    It best aligns the points above the ground in the first three sweeps. Distances below the
    spacing of neighbouring rays count as 0, because a guard rail looks the same from a vehicle at
    rest and from a vehicle that moves along the rail. The grid moves the second sweep by steps of 1
    m, then by 0.5 m around the best position, or less for sweeps less than 0.1 s apart. Each
    sweep's points (N,3) are in its lidar frame.
    """
    step_s = np.diff(stamp_ns[:3]) * 1e-9
    step_m = _STEP_M * min(1.0, step_s[0] / _STEP_S)
    points_above = [above_ground(p) for p in points[:3]]
    pairs = []
    for i, (earlier, later) in enumerate(pairwise(points_above)):
        _, rows = np.unique(np.floor(later), axis=0, return_index=True)  # even over 1 m voxels
        sample = later[rows[:: len(rows) // _NUM_SAMPLES + 1]]
        ratio = step_s[i] / step_s[0]
        apart_m = _RAYS_RAD * np.linalg.norm(sample, axis=1)
        pairs.append((tree_of(earlier), sample, ratio, apart_m))

    def cost(steps_m: Float) -> Float:
        chunks = np.array_split(steps_m, len(steps_m) // _MOST_STEPS + 1)
        return np.concatenate([cost_of_few(chunk) for chunk in chunks])

    def cost_of_few(steps_m: Float) -> Float:
        cost_m = 1e-3 * np.linalg.norm(steps_m, axis=1)
        for tree, sample, ratio, apart_m in pairs:
            moved = (sample + ratio * steps_m[:, None, :]).reshape(-1, 3)
            distance_m, _ = tree.query(moved, distance_upper_bound=_CLOSE_M, workers=-1)
            distance_m = np.minimum(distance_m, _CLOSE_M).reshape(len(steps_m), -1)
            cost_m += np.maximum(distance_m - apart_m, 0.0).mean(1)
        return cost_m

    coarse_m = _grid(np.zeros(2), min(MAX_SPEED_M_S * step_s[0], _MOST_STEP_M), 2 * step_m)
    coarse = coarse_m[np.argmin(cost(coarse_m))]
    fine_m = _grid(coarse[:2], 2 * step_m, step_m)
    return np.append(np.zeros(3), fine_m[np.argmin(cost(fine_m))] / step_s[0])


def _grid(center: Float, reach_m: float, step_m: float) -> Float:
    """Return (n,3) horizontal motions on a square grid around a centre (2,)."""
    span = np.arange(-np.ceil(reach_m / step_m), np.ceil(reach_m / step_m) + 1) * step_m
    x, y = np.meshgrid(center[0] + span, center[1] + span, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def above_ground(points: Float) -> Float:
    """Return the points over 0.4 m above the lowest in their 1 m grid cell; all if none is."""
    if not len(points):
        return points
    x, y, z = points.T
    row, column = (np.floor(coordinate).astype(np.int64) for coordinate in (x, y))
    row, column = row - row.min(), column - column.min()
    cell = row * (column.max() + 1) + column
    lowest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(lowest, cell, z)
    above = points.take(np.flatnonzero(z > lowest[cell] + _ABOVE_GROUND_M), axis=0)
    return above if len(above) else points
