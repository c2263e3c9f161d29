# SPDX-License-Identifier: MIT
"""Align surfaces with small_gicp: generalized ICP, and point to plane.

Segal et al., "Generalized-ICP", RSS 2009; Koide et al., "Voxelized GICP for Fast and Accurate 3D
Point Cloud Registration", ICRA 2021; Koide, "small_gicp: Efficient and parallel algorithms for
point cloud registration", JOSS 2024.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, RegisteredSweep, Sweep

_MANY_POINTS = 30_000  # number of points before thinning to voxels
_GOLDEN = 0.6180339887498949  # its multiples, modulo 1, are even for any order of the rings
_VOXEL_M, _LEAF_M, _NUM_NEIGHBORS = 0.5, 1.0, 10
_HELD_AT_M = 10.0
_MISFIT_M = 1.0  # farther off, poses are found by their overlap
_NORMAL_M = 0.0447  # two surfaces' spread along the normal, as small_gicp weighs: sqrt(2 · 1e-3)


def subsample(sweep: Sweep, most: int = _MANY_POINTS) -> Sweep:
    """Return about ``most`` points of a larger sweep, from all of its rings alike."""
    num = len(sweep)
    if num <= most:
        return sweep
    place = np.arange(num) * _GOLDEN
    place -= np.floor(place)
    return sweep.select(place < most / num)


class Surface(NamedTuple):
    """Points thinned to voxels, each with the covariance of its neighbours; of small_gicp."""

    points: Any
    tree: Any

    @staticmethod
    def of(
        points: Float, voxel_m: float = _VOXEL_M, num_neighbors: int = _NUM_NEIGHBORS
    ) -> Surface:
        """Return a surface of points (N,3).

        Args:
            num_neighbors: Number of points for a covariance.
        """
        import small_gicp

        return Surface(*small_gicp.preprocess_points(points, voxel_m, num_neighbors, 1))


class Alignment(NamedTuple):
    """The alignment of a source surface with a target.

    Attributes:
        overlap: Share of the source's points with a match in the target.
        information: (6,6) of rotation and translation of the source, in its frame. ``x @
            information @ x`` is the mean square in m² by which a small motion x (rad, m) moves the
            source off the target.
    """

    T_target_source: Float
    overlap: float
    information: Float

    @staticmethod
    def of(found: Any, source: Surface) -> Alignment:
        """Return the alignment that small_gicp found."""
        num = int(found.num_inliers)
        return Alignment(
            T_target_source=np.asarray(found.T_target_source),
            overlap=num / max(int(source.points.size()), 1),
            information=np.asarray(found.H) * (_NORMAL_M**2 / max(num, 1)),
        )


class SurfaceMap:
    """Several surfaces in one frame."""

    def __init__(self) -> None:
        import small_gicp

        self._voxels = small_gicp.GaussianVoxelMap(_LEAF_M)

    def insert(self, surface: Surface, T_map_surface: Float) -> None:
        """Add a surface at its pose."""
        self._voxels.insert(surface.points, T_map_surface)

    def align(self, source: Surface, T_map_source: Float, match_m: float) -> Alignment:
        """Align a surface with the map, starting from ``T_map_source``.

        Args:
            match_m: Greatest distance between corresponding points.
        """
        import small_gicp

        # One thread: the order of a parallel sum changes from run to run.
        found = small_gicp.align(
            self._voxels,
            source.points,
            T_map_source,
            max_correspondence_distance=match_m,
            num_threads=1,
        )
        return Alignment.of(found, source)


def align(target: Surface, source: Surface, T_target_source: Float, match_m: float) -> Alignment:
    """Align a surface with another one, as `SurfaceMap.align`."""
    import small_gicp

    found = small_gicp.align(
        target.points,
        source.points,
        target.tree,
        T_target_source,
        max_correspondence_distance=match_m,
        num_threads=1,
    )
    return Alignment.of(found, source)


class Misfit(NamedTuple):
    """The distance of a sweep from the pose at which it fits on another.

    Attributes:
        off_m: Metres.
        off_deg: Degrees.
        lift_m: Root mean square distance by which it lifts surfaces off those of the other.
    """

    off_m: float
    off_deg: float
    lift_m: float


def find_misfit(target: RegisteredSweep, source: RegisteredSweep) -> Misfit:
    """Return the distance of two deskewed sweeps from the poses at which their surfaces fit."""
    onto, moved = (Surface.of(subsample(s.sweep).points) for s in (target, source))
    T = poses.inverse(target.T_world_lidar) @ source.T_world_lidar
    found = align(onto, moved, T, _MISFIT_M)
    off = poses.log(poses.inverse(T) @ found.T_target_source)
    lift_m = np.sqrt(max(float(off @ found.information @ off), 0.0))
    off_m, off_rad = np.linalg.norm(off[3:]), np.linalg.norm(off[:3])
    return Misfit(float(off_m), float(np.rad2deg(off_rad)), float(lift_m))


def align_with_planes(
    target: Surface, points: Float, voxel_m: float, match_m: float, hold: float
) -> Float:
    """Return ``T_target_source``, near the identity, of points (N,3) on the target's planes.

    Args:
        points: (N,3) metres.
        match_m: Greatest distance between corresponding points.
        hold: Share of the matches that is held in place by points 10 m away. Where few planes
            constrain the motion, as along a straight road, the source then hardly moves. 0 lets it
            slide.
    """
    import small_gicp

    found = small_gicp.align(
        target.points,
        small_gicp.voxelgrid_sampling(points, voxel_m),
        target.tree,
        registration_type="PLANE_ICP",
        max_correspondence_distance=match_m,
        num_threads=1,
    )
    information = np.asarray(found.H) / max(int(found.num_inliers), 1)
    held = np.diag(hold * np.repeat([_HELD_AT_M**2, 1.0], 3))
    slid = poses.log(np.asarray(found.T_target_source))
    motion = np.linalg.solve(information + held, information @ slid)
    return poses.exp(np.asarray(motion, np.float64))
