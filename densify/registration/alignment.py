# SPDX-License-Identifier: MIT
"""Align surfaces with small_gicp: generalized ICP, and point to plane.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import small_gicp

from densify.geometry import poses
from densify.geometry.types import Float, Sweep

MANY_POINTS = 30_000  # points of a sweep that makes a surface
FEW_POINTS = 15_000  # points of a sweep that is aligned
# The multiples of the golden ratio, modulo 1, are spread evenly in [0, 1). Points below a threshold
# are therefore an even sample of each ring, in any order of the rings.
_GOLDEN = 0.6180339887498949
_VOXEL_M = 0.5  # voxel in which a surface keeps one point
_LEAF_M = 1.0  # voxel of a map
_NUM_NEIGHBORS = 10  # neighbours that give a normal
_NORMAL_M = 0.0447  # standard deviation of two surfaces along the normal in generalized ICP


def subsample(sweep: Sweep, max_points: int = MANY_POINTS) -> Sweep:
    """Return about ``max_points`` points of a larger sweep, spread evenly over its rings."""
    num = len(sweep)
    if num <= max_points:
        return sweep
    fraction = np.arange(num) * _GOLDEN
    fraction -= np.floor(fraction)
    return sweep.select(fraction < max_points / num)


class Surface(NamedTuple):
    """Points thinned to voxels, with the normal and covariance of each point's neighbours."""

    points: Any  # a ``PointCloud`` of small_gicp, in metres
    tree: Any  # the k-d tree of these points

    @staticmethod
    def of(
        points: Float, voxel_m: float = _VOXEL_M, num_neighbors: int = _NUM_NEIGHBORS
    ) -> Surface:
        """Return the surface of points (N,3), one per voxel, with normals, in their frame."""
        return Surface(*small_gicp.preprocess_points(points, voxel_m, num_neighbors, 1))

    @staticmethod
    def of_sweep(sweep: Sweep) -> Surface:
        """Return the surface of a deskewed sweep, in its lidar frame."""
        return Surface.of(subsample(sweep).points)

    @staticmethod
    def joined(surfaces: Sequence[Surface], T_joined_surface: Float) -> Surface:
        """Return the union of n surfaces, each with its pose (n,4,4) in the common frame."""
        clouds = [
            poses.transform(T, surface.points.points()[:, :3])  # without the homogeneous column
            for T, surface in zip(T_joined_surface, surfaces, strict=True)
        ]
        return Surface.of(np.concatenate(clouds))


class Alignment(NamedTuple):
    """The alignment of a source with a target surface."""

    T_target_source: Float  # (4,4) pose of the source in the target's frame
    overlap: float  # share of the source's points with a match in the target
    # (6,6) matrix of a quadratic form. For a small motion x (rad, m) of the source in its own
    # frame, ``x @ information @ x`` is the mean square distance (m²) of the source from the target.
    information: Float


def thin(points: Float, voxel_m: float) -> Any:
    """Return (N,3) points, thinned to one per voxel, as a ``PointCloud`` of small_gicp."""
    return small_gicp.voxelgrid_sampling(points, voxel_m)


def make_map() -> Any:
    """Return an empty map of surfaces, a ``GaussianVoxelMap`` of small_gicp with 1 m voxels.

    Koide et al., "Voxelized GICP for Fast and Accurate 3D Point Cloud Registration", ICRA 2021.
    """
    return small_gicp.GaussianVoxelMap(_LEAF_M)


def align(target: Any, source: Any, T_target_source: Float, match_m: float) -> Alignment:
    """Align a source with a target, and return the alignment.

    A source `Surface` is aligned by generalized ICP, other points are aligned point to plane.

    Args:
        target: A `Surface`, or a map (`make_map`) of surfaces.
        source: A `Surface`, or points without covariances (`thin`), in its own frame.
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
    # surfaces along the normal.
    num_matches = max(int(fit.num_inliers), 1)
    scale_m2 = _NORMAL_M**2 if is_surface else 1.0
    information = np.asarray(fit.H) * scale_m2 / num_matches
    overlap = fit.num_inliers / max(int(points.size()), 1)
    return Alignment(np.asarray(fit.T_target_source), overlap, information)
