# SPDX-License-Identifier: MIT
"""Surfaces laid on each other: generalized ICP. The one door to small_gicp.

Segal et al., "Generalized-ICP", RSS 2009; Koide et al., "Voxelized GICP for Fast and Accurate 3D
Point Cloud Registration", ICRA 2021; Koide, "small_gicp: Efficient and parallel algorithms for
point cloud registration", JOSS 2024.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, Sweep

_MANY_POINTS = 30_000  # before they are thinned to voxels
_GOLDEN = 0.6180339887498949  # its multiples, modulo 1, fall evenly whatever the order of the rings
_VOXEL_M, _LEAF_M, _NUM_NEIGHBORS = 0.5, 1.0, 10
_HELD_AT_M = 10.0
_NORMAL_M = 0.0447  # two surfaces' spread along the normal, as small_gicp weighs: sqrt(2 · 1e-3)


def subsample(sweep: Sweep, most: int = _MANY_POINTS) -> Sweep:
    """About ``most`` of the points of a sweep that holds more, of all its rings alike."""
    num = len(sweep)
    if num <= most:
        return sweep
    place = np.arange(num) * _GOLDEN
    place -= np.floor(place)
    return sweep.select(place < most / num)


class Surface(NamedTuple):
    """Points thinned to voxels, with the covariance of their neighbours; of small_gicp."""

    points: Any
    tree: Any

    @staticmethod
    def of(
        points: Float, voxel_m: float = _VOXEL_M, num_neighbors: int = _NUM_NEIGHBORS
    ) -> Surface:
        """points: (N,3). voxel_m: smaller ones keep more of them, and cost more. num_neighbors:
        that tell the covariance; of few, such as lie on one ring, it is that of their noise."""
        import small_gicp

        return Surface(*small_gicp.preprocess_points(points, voxel_m, num_neighbors, 1))

    def __len__(self) -> int:
        return int(self.points.size())


class Lay(NamedTuple):
    """How a source surface lies on a target.

    overlap: share of the source's points that met the target. rms_m: what is left between those,
    along the surface. num_matches: of them. information: (6,6) of rotation and translation of the
    source, in its frame: ``x @ information @ x`` is the mean square in m² by which a small motion x
    (rad, m) lifts the source off the target.
    """

    T_target_source: Float
    overlap: float
    rms_m: float
    num_matches: int
    information: Float


class SurfaceMap:
    """Surfaces put together in one frame."""

    def __init__(self) -> None:
        import small_gicp

        self._voxels = small_gicp.GaussianVoxelMap(_LEAF_M)

    def insert(self, surface: Surface, T_map_surface: Float) -> None:
        self._voxels.insert(surface.points, T_map_surface)

    def lay(self, source: Surface, T_map_source: Float, match_m: float) -> Lay:
        """Lay a surface on the map. T_map_source: about. match_m: nothing farther apart is taken
        for the same."""
        import small_gicp

        found = small_gicp.align(
            self._voxels,
            source.points,
            T_map_source,
            max_correspondence_distance=match_m,
            num_threads=1,  # the order of a parallel sum changes from run to run
        )
        return _lay(found, source)


def lay(target: Surface, source: Surface, T_target_source: Float, match_m: float) -> Lay:
    """As `SurfaceMap.lay`, on one surface."""
    import small_gicp

    found = small_gicp.align(
        target.points,
        source.points,
        target.tree,
        T_target_source,
        max_correspondence_distance=match_m,
        num_threads=1,
    )
    return _lay(found, source)


def lay_on_planes(
    target: Surface, points: Float, voxel_m: float, match_m: float, hold: float
) -> tuple[Float, float]:
    """``T_target_source``, near the identity, that lays points (N,3), thinned to voxels, on the
    planes of the target, and the share of them that met it. match_m: nothing farther apart is taken
    for the same. hold: share of the matches that as many points, 10 m away, hold in place: where
    fewer planes tell, as along a straight road, the source hardly moves; 0 lets it slide.
    """
    import small_gicp

    source = small_gicp.voxelgrid_sampling(points, voxel_m)
    found = small_gicp.align(
        target.points,
        source,
        target.tree,
        registration_type="PLANE_ICP",
        max_correspondence_distance=match_m,
        num_threads=1,
    )
    num = int(found.num_inliers)
    told = np.asarray(found.H) / max(num, 1)
    held = np.diag(hold * np.repeat([_HELD_AT_M**2, 1.0], 3))
    slid = poses.log(np.asarray(found.T_target_source))
    motion = np.linalg.solve(told + held, told @ slid)
    return poses.exp(np.asarray(motion, np.float64)), num / max(source.size(), 1)


def _lay(found: Any, source: Surface) -> Lay:
    num = int(found.num_inliers)
    square = _NORMAL_M**2 / max(num, 1)
    return Lay(
        T_target_source=np.asarray(found.T_target_source),
        overlap=num / max(len(source), 1),
        rms_m=float(np.sqrt(2 * found.error * square)),
        num_matches=num,
        information=np.asarray(found.H) * square,
    )
