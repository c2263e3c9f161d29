# SPDX-License-Identifier: MIT
"""The accumulated cloud seen from a camera: which points it sees, and the depth map they make.

Points that the camera cannot see are found by occlusion: every point stands for the patch of
surface between it and the neighbouring rays of the sweep that measured it, and hides what lies
clearly behind that patch. Of the points left in a pixel the one measured nearest in time to the key
is taken. Nothing depends on the order of the points.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import numpy as np

from densify.config import ProjectSettings
from densify.depth_fill import fill_between, fit_planes
from densify.pinhole import image_points
from densify.poses import transform
from densify.types import Camera, Cloud, DepthMap, Float, Float32, Int

# Spacing of a 64-beam scanner, taken when the cloud is too small to measure it.
_DEFAULT_SPACING_RAD = (np.radians(0.18), np.radians(0.40))
_MAX_HALF_PX = 24.0  # a point just before the lens must not hide the whole image
_CELLS_AT_ONCE = 1_000_000  # bounds the memory of painting
_PLANE_REACH_PX = (2, 3)
_PLANE_RESIDUAL = 0.03  # of the inverse depth; beyond it a window shows more than one surface
_LEAST_CONFIDENCE = 1 / 255  # 0 means no depth once written as 8 bits


def project(
    cloud: Cloud,
    camera: Camera,
    T_cam_key: Float,
    settings: ProjectSettings,
    key: int,
    origins: Mapping[int, Float] | None = None,
) -> DepthMap:
    """The depth map that ``camera`` sees of ``cloud``.

    T_cam_key: (4,4), with the ego motion from the key's reference time to the camera's own.
    settings: knobs, see `densify.config.ProjectSettings`.
    key: the key frame; the source sweep nearest to it in time wins a pixel.
    origins: (3,) where each source sweep's lidar stood, key frame, by frame, so that a point's
        patch has the size its own sweep saw; without it all count as measured from the key's.

    Points with z ≤ 0.1 m, outside the image or outside the lens's valid field of view are dropped.
    ``depth_m`` is the camera z of a real point. ``filled_m`` adds pixels interpolated between
    measured ones (`densify.depth_fill.fill_between`). ``confidence`` ranks only.
    """
    points_cam = transform(T_cam_key, cloud.points)
    uv, seen = image_points(camera, points_cam)
    index = np.flatnonzero(seen)
    # Depth as it is stored, so that equal depths tie here as they do in the map.
    uv, depth = uv[index], points_cam[index, 2].astype(np.float32)
    spacing_px = _spacing_px(cloud, camera, key, origins)
    half_px = _half_px(cloud, index, depth, spacing_px, camera, settings, origins)
    visible = ~_hidden(uv, depth, half_px, camera, settings)
    index, uv, depth = index[visible], uv[visible], depth[visible]

    shape = (camera.height_px, camera.width_px)
    column, row = np.rint(uv).astype(np.int64).T
    pixel = row * camera.width_px + column
    frame = cloud.frame[index]
    confidence = np.clip(cloud.confidence[index], _LEAST_CONFIDENCE, 1.0)
    best = _best_per_pixel(pixel, (np.abs(frame - key), depth, frame, -confidence))
    depth_m = np.zeros(shape, np.float32)
    measured_confidence = np.zeros(shape, np.float32)
    source = np.full(shape, -1, np.int32)
    depth_m.flat[pixel[best]] = depth[best]
    measured_confidence.flat[pixel[best]] = confidence[best]
    source.flat[pixel[best]] = frame[best]

    reach_px = np.maximum(1, np.rint(settings.fill_reach * spacing_px)).astype(int)
    filled_m, filled_confidence = fill_between(
        depth_m,
        measured_confidence,
        (int(reach_px[0]), int(reach_px[1])),
        settings.edge_m,
        settings.edge_fraction,
        settings.fill_confidence,
    )
    filled_confidence[filled_m > 0] = np.maximum(
        filled_confidence[filled_m > 0], np.float32(_LEAST_CONFIDENCE)
    )
    return DepthMap(camera.name, depth_m, filled_m, filled_confidence, source)


def _spacing_px(
    cloud: Cloud, camera: Camera, key: int, origins: Mapping[int, Float] | None
) -> Float:
    """(2,) pixels between neighbouring rays, horizontally and vertically, seen from the scanner.

    Measured on the sweep nearest the key: the medians of the gaps in azimuth within thin bands of
    elevation, and of the gaps in elevation within thin sectors (those too small for another beam
    left out).
    """
    azimuth_rad, elevation_rad = _DEFAULT_SPACING_RAD
    if len(cloud):
        nearest = _best_per_pixel(np.zeros(len(cloud), np.int64), (np.abs(cloud.frame - key),))
        frame = cloud.frame[nearest].min()
        origin = np.zeros(3) if origins is None else origins[int(frame)]
        x, y, z = (cloud.rigid_points[cloud.frame == frame] - origin).T
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
        azimuth_rad = _median_gap(azimuth, elevation, np.radians(0.1), 0.0, azimuth_rad)
        elevation_rad = _median_gap(
            elevation, azimuth, np.radians(1.0), azimuth_rad / 2, elevation_rad
        )
    return np.array([camera.K[0, 0] * azimuth_rad, camera.K[1, 1] * elevation_rad])


def _median_gap(
    angle: Float, across: Float, band_rad: float, least_rad: float, default_rad: float
) -> float:
    """Median gap between successive angles that share a band of the other angle."""
    band = np.floor(across / band_rad)
    order = np.lexsort((angle, band))
    gap = np.diff(angle[order])[np.diff(band[order]) == 0]
    gap = gap[(gap > max(least_rad, 1e-4)) & (gap < np.radians(4.0))]
    return float(np.median(gap)) if len(gap) >= 100 else default_rad


def _half_px(
    cloud: Cloud,
    index: Int,
    depth: Float32,
    spacing_px: Float,
    camera: Camera,
    settings: ProjectSettings,
    origins: Mapping[int, Float] | None,
) -> Float:
    """(K,2) half size of each point's patch in the image."""
    offset = cloud.rigid_points[index]
    if origins is not None:
        frames, which = np.unique(cloud.frame[index], return_inverse=True)
        offset = offset - np.array([origins[int(f)] for f in frames]).reshape(-1, 3)[which]
    ray_px = spacing_px * (np.linalg.norm(offset, axis=1) / depth)[:, None]
    slack_px = settings.slack_m * camera.K[[0, 1], [0, 1]] / depth[:, None]
    return np.clip(settings.footprint * ray_px + slack_px, 0.5, _MAX_HALF_PX)


def _hidden(
    uv: Float, depth: Float32, half_px: Float, camera: Camera, settings: ProjectSettings
) -> np.ndarray:
    """(K,) bool, behind some other point's patch.

    A patch is slanted like the surface around it where the nearest points of the pixels around lie
    on one plane, otherwise it faces the camera; either way it is never nearer than its own point.
    """
    column, row = np.rint(uv).astype(np.int64).T
    nearest = np.full((camera.height_px, camera.width_px), np.inf, np.float32)
    np.minimum.at(nearest, (row, column), depth)
    nearest[np.isinf(nearest)] = 0
    planes = fit_planes(nearest, _PLANE_REACH_PX)
    one = planes.residual[row, column] < _PLANE_RESIDUAL * planes.centre[row, column]
    slope = np.stack([planes.slope_u[row, column], planes.slope_v[row, column]], axis=1)
    shape = (camera.height_px, camera.width_px)
    inverse = 1 / depth.astype(float)
    occluder = 1 / _paint(uv, inverse, slope * one[:, None], half_px, shape)[row, column]
    return depth > occluder + settings.hidden_m + settings.hidden_fraction * occluder


def _paint(
    uv: Float, inverse: Float, slope: Float, half_px: Float, shape: tuple[int, int]
) -> Float:
    """(H,W) greatest inverse depth of the patches that cover a pixel, 0 none.

    uv, slope, half_px: (K,2); inverse: (K,). A patch covers the pixel centres within ``half_px`` of
    its point, with inverse depth ``inverse + slope · offset``, between half of ``inverse``
    and all of it.
    """
    border = int(_MAX_HALF_PX) + 1
    width = shape[1] + 2 * border
    canvas = np.zeros((shape[0] + 2 * border) * width)
    first = np.ceil(uv - half_px).astype(np.int64)
    count = np.floor(uv + half_px).astype(np.int64) - first + 1
    for group in _same_size(count):
        steps_u, steps_v = (np.arange(n) for n in count[group[0]])
        corner = (first[group] - uv[group]) * slope[group]
        tilt_u = corner[:, :1] + slope[group, :1] * steps_u
        tilt_v = corner[:, 1:] + slope[group, 1:] * steps_v
        tilt = np.minimum(tilt_v[:, :, None] + tilt_u[:, None, :], 0.0)
        tilt = np.maximum(tilt, -0.5 * inverse[group, None, None])
        start = (first[group, 1] + border) * width + first[group, 0] + border
        cell = start[:, None, None] + steps_v[:, None] * width + steps_u
        np.maximum.at(canvas, cell.ravel(), (inverse[group, None, None] + tilt).ravel())
    return canvas.reshape(-1, width)[border:-border, border:-border]


def _same_size(count: Int) -> Iterator[Int]:
    """Groups of patches of one width and height, few enough to be painted in one piece."""
    size = count[:, 0] * 64 + count[:, 1]  # no patch has more than 49 pixels a side
    order = np.argsort(size, kind="stable")
    changes = np.flatnonzero(np.diff(size[order], prepend=-1))
    for start, end in itertools.pairwise([*changes, len(order)]):
        most = max(1, _CELLS_AT_ONCE // int(count[order[start]].prod()))
        for piece in range(start, end, most):
            yield order[piece : min(piece + most, end)]


def _best_per_pixel(pixel: Int, ranks: tuple[np.ndarray, ...]) -> Int:
    """Indices of the points that win their pixel: least in the first rank, then the next, …

    Points equal in every rank all win.
    """
    winner = np.arange(len(pixel))
    for rank in ranks:
        least = np.full(int(pixel.max(initial=-1)) + 1, np.inf)
        np.minimum.at(least, pixel[winner], rank[winner].astype(float))
        winner = winner[rank[winner] == least[pixel[winner]]]
    return winner
