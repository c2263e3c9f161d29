# SPDX-License-Identifier: MIT
"""Align surfaces with small_gicp: generalized ICP, and point to plane.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import small_gicp

from densify.geometry.types import Float, Sweep

MANY_POINTS = 30_000  # points of a sweep that makes a surface
FEW_POINTS = 15_000  # points of a sweep that is aligned


def subsample(sweep: Sweep, max_points: int = MANY_POINTS) -> Sweep:
    """Return about ``max_points`` points of a larger sweep, spread evenly over its rings."""
    num = len(sweep)
    if num <= max_points:
        return sweep
    # The multiples of the golden ratio, modulo 1, are spread evenly in [0, 1). Points below a
    # threshold are therefore an even sample of each ring, in any order of the rings.
    fraction = np.arange(num) * 0.6180339887498949
    fraction -= np.floor(fraction)
    return sweep.select(fraction < max_points / num)


class Surface(NamedTuple):
    """Points thinned to voxels, with the normal and covariance of each point's neighbours."""

    points: Any  # a ``PointCloud`` of small_gicp, in metres
    tree: Any  # the k-d tree of these points

    @staticmethod
    def of(points: Float, voxel_m: float = 0.5, num_neighbors: int = 10) -> Surface:
        """Return the surface of points (N,3), one per voxel, with normals, in their frame."""
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


def align(target: Any, source: Any, T_target_source: Float, match_m: float) -> Alignment:
    """Align a source with a target, and return the alignment.

    A source `Surface` is aligned by generalized ICP, other points are aligned point to plane.

    Args:
        target: A `Surface`, or a ``GaussianVoxelMap`` of surfaces.
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
