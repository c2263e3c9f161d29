# SPDX-License-Identifier: MIT
"""Align surfaces with small_gicp: generalized ICP, and point to plane.

Segal et al., "Generalized-ICP", RSS 2009; Koide et al., "Voxelized GICP for Fast and Accurate 3D
Point Cloud Registration", ICRA 2021; Koide, "small_gicp: Efficient and parallel algorithms for
point cloud registration", JOSS 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, RegisteredSweep, Sweep

_MANY_POINTS = 30_000  # number of points before thinning to voxels
_GOLDEN = 0.6180339887498949  # its multiples, modulo 1, are even for any order of the rings
_VOXEL_M, _LEAF_M, _NUM_NEIGHBORS = 0.5, 1.0, 10
_HELD_AT_M = 10.0
_MISFIT_M = 1.0  # poses with larger errors are detected by `check_overlap`
_NORMAL_M = 0.0447  # standard deviation of two surfaces along the normal in small_gicp


def subsample(sweep: Sweep, most: int = _MANY_POINTS) -> Sweep:
    """Return about ``most`` points of a larger sweep, spread evenly over its rings."""
    num = len(sweep)
    if num <= most:
        return sweep
    place = np.arange(num) * _GOLDEN
    place -= np.floor(place)
    return sweep.select(place < most / num)


class Surface(NamedTuple):
    """Points thinned to voxels, with the covariance of each point's neighbours (small_gicp).

    Attributes:
        points: Points with covariances, a ``PointCloud`` of small_gicp, in metres.
        tree: The k-d tree of these points.
    """

    points: Any
    tree: Any

    @staticmethod
    def of(
        points: Float, voxel_m: float = _VOXEL_M, num_neighbors: int = _NUM_NEIGHBORS
    ) -> Surface:
        """Return the surface of a point cloud, in the frame of the points.

        Args:
            points: (N,3) positions in metres.
            voxel_m: Side of a voxel in metres; one point per voxel stays.
            num_neighbors: Number of neighbours for the covariance of a point.
        """
        import small_gicp

        return Surface(*small_gicp.preprocess_points(points, voxel_m, num_neighbors, 1))

    @staticmethod
    def of_sweep(sweep: Sweep) -> Surface:
        """Return the surface of a deskewed sweep, in its lidar frame."""
        return Surface.of(subsample(sweep).points)

    @staticmethod
    def joined(surfaces: Sequence[Surface], T_joined_surface: Float) -> Surface:
        """Return the surface of n surfaces, each with its pose (n,4,4) in the joint frame."""
        moved = zip(T_joined_surface, surfaces, strict=True)
        return Surface.of(
            np.concatenate([poses.transform(T, s.points.points()[:, :3]) for T, s in moved])
        )


class Alignment(NamedTuple):
    """The alignment of a source surface with a target surface.

    Attributes:
        T_target_source: (4,4) pose of the source in the target's frame.
        overlap: Share of the source's points with a match in the target.
        information: (6,6) matrix for a small motion x (rad, m) of the source in its own frame.
            ``x @ information @ x`` is the mean square distance in m² by which x moves the source
            off the target's surface.
    """

    T_target_source: Float
    overlap: float
    information: Float

    @staticmethod
    def of(found: Any, source: Surface) -> Alignment:
        """Convert ``found``, the result of ``small_gicp.align`` for the surface ``source``."""
        num = int(found.num_inliers)
        return Alignment(
            T_target_source=np.asarray(found.T_target_source),
            overlap=num / max(int(source.points.size()), 1),
            information=np.asarray(found.H) * (_NORMAL_M**2 / max(num, 1)),
        )


class SurfaceMap:
    """A map of several surfaces in one common frame, the map frame.

    Each cubic voxel, 1 m wide, holds the mean and the covariance of its points (Koide et al., ICRA
    2021). Further surfaces can be aligned with the map by generalized ICP.
    """

    def __init__(self) -> None:
        """Begin with an empty map."""
        import small_gicp

        self._voxels = small_gicp.GaussianVoxelMap(_LEAF_M)

    def insert(self, surface: Surface, T_map_surface: Float) -> None:
        """Add a surface to the map; ``T_map_surface`` (4,4) is its pose in the map frame."""
        self._voxels.insert(surface.points, T_map_surface)

    def align(self, source: Surface, T_map_source: Float, match_m: float) -> Alignment:
        """Align a surface with the map, and return its pose in the map frame.

        Args:
            source: Surface in its own frame.
            T_map_source: (4,4) initial pose of the surface in the map frame.
            match_m: Greatest distance in metres between corresponding points.
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
    """Align a source surface with a target surface; arguments as in `SurfaceMap.align`."""
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
    """The difference between a sweep's given pose and the pose that aligns it with another sweep.

    Attributes:
        off_m: Translation in metres.
        off_deg: Rotation in degrees.
        lift_m: Root mean square distance between the two sweeps' surfaces at the given pose.
    """

    off_m: float
    off_deg: float
    lift_m: float


def find_misfit(target: RegisteredSweep, source: RegisteredSweep) -> Misfit:
    """Return the error of the given relative pose of two deskewed sweeps, found by alignment."""
    onto, moved = (Surface.of_sweep(s.sweep) for s in (target, source))
    T = poses.inverse(target.T_world_lidar) @ source.T_world_lidar
    found = align(onto, moved, T, _MISFIT_M)
    off = poses.log(poses.inverse(T) @ found.T_target_source)
    lift_m = np.sqrt(max(float(off @ found.information @ off), 0.0))
    off_m, off_rad = np.linalg.norm(off[3:]), np.linalg.norm(off[:3])
    return Misfit(float(off_m), float(np.rad2deg(off_rad)), float(lift_m))


def align_with_planes(
    target: Surface, points: Float, voxel_m: float, match_m: float, hold: float
) -> Float:
    """Return the (4,4) motion of points that aligns them with the target, by point-to-plane ICP.

    Args:
        target: Surface in the frame of the points.
        points: (N,3) metres, approximately aligned with the target already.
        voxel_m: Side of the voxels to which the points are thinned.
        match_m: Greatest distance between corresponding points.
        hold: Weight, as a share of the matches, of points 10 m away that stay where they are. It
            limits the motion in directions that few planes constrain, as along a straight road.
            0 applies the full ICP motion.
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
