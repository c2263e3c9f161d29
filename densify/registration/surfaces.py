# SPDX-License-Identifier: MIT
"""Register sweeps point to plane on the surfaces of the last second.

Point-to-point registration (`densify.registration.odometry`) matches a sweep with the scan pattern
of earlier sweeps. A rosette pattern that turns 7 degrees a sweep turns the poses with it. The
surface normals of one second do not depend on the pattern (Chen, Medioni, "Object modelling by
registration of multiple range images", IVC 1992).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, Sweep
from densify.registration.alignment import FEW_POINTS, Surface, align, subsample, thin
from densify.registration.deskew import deskew_points
from densify.registration.odometry import search_twist

_REACH_NS = 1_050_000_000
_NUM_IN_REACH = 10  # sweeps of the last second; a larger number is thinned evenly
_FRESH_NS = 350_000_000  # age of the latest sweep up to which a surface serves the next sweeps too
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
            if abs(self.stamp_ns[i] - self.stamp_ns[nearest]) < _FRESH_NS:
                return surface, T_world_surface
        T_world_surface = self._T[i].copy()
        chosen = neighbours[:: max(1, round(len(neighbours) / _NUM_IN_REACH))]
        points = np.concatenate([self._points[j] for j in chosen])
        points = poses.transform(poses.inverse(T_world_surface), points)
        surface = Surface.of(points, _VOXEL_M, self._num_neighbors)
        self._surface = surface, T_world_surface, neighbours[0]
        return surface, T_world_surface
