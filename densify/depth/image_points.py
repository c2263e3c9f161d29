# SPDX-License-Identifier: MIT
"""Collect the accumulated points within one image, with their surface patches and occlusion."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from densify.depth.exposure import Exposure, InView
from densify.geometry.cameras import pixels_per_metre
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.poses import rotate
from densify.geometry.types import Bool, Camera, Cloud, Float, Float32, Int, Patches

HIDDEN_M, HIDDEN_FRACTION = 0.2, 0.06
"""Least distance of an occluded point behind the nearest surface: metres plus share of depth."""
FOOTPRINT = 0.35
"""Half size of a patch, and of the spot of a laser, in spacings of neighbouring rays."""
_SLACK_M = 0.05  # added to the footprint, for errors of registration and flow
_SAME_AGE_NS = 10_000_000


@dataclass(frozen=True)
class PointsInImage:
    """The K points of a cloud in an image."""

    index: Int  # (K,) indices of the points in the cloud
    uv: Float  # (K,2) column and row in px
    depth: Float32  # (K,) depth in m
    focal_px: Float  # (K,2) local scale, px per metre at a depth of 1 m
    # (K,2) slope of the tangent plane's inverse depth to the right and down, 1/m per px
    slope: Float
    spacing_px: Float  # (K,2) spacing of neighbouring rays, across and down
    frame: np.ndarray  # (K,) frame number of the source sweep
    age_ns: Int  # (K,) time between the source sweep and the key sweep, see `_ages_ns`
    far: Bool  # (K,) True for points of sweeps beyond the window

    def select(self, keep: Bool) -> PointsInImage:
        """Return the points where ``keep`` (K,) is True."""
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        return PointsInImage(
            **{f.name: getattr(self, f.name).take(rows, axis=0) for f in fields(self)}
        )

    def at(self, rows: Int) -> Int:
        """Return the indices, among these K points, of the points at ``rows`` of the cloud."""
        index_of = np.zeros(int(self.index.max(initial=-1)) + 1, np.int64)
        index_of[self.index] = np.arange(len(self.index))
        indices: Int = index_of[rows]
        return indices

    @property
    def inverse(self) -> Float:
        """The (K,) inverse depths in 1/m."""
        return 1 / self.depth.astype(np.float64)


def points_in_image(cloud: Cloud, view: InView, patches: Patches) -> PointsInImage:
    """Return the points of the cloud in the view, with the patches' size and slope in pixels."""
    by_row = np.argsort(np.rint(view.uv[:, 1]).astype(np.uint16), kind="stable")
    exposure, index = view.exposure, view.rows[by_row]
    points_cam = view.points_cam.take(by_row, axis=0)
    depth = exposure.depth_m(points_cam).astype(np.float32)
    normal = rotate(exposure.T_cam_key, patches.normal.take(index, axis=0).astype(np.float64))
    plain = exposure.camera.is_rectified and exposure.measure == "z"
    focal_px, slope, spacing_px = (_pinhole if plain else _any_lens)(
        exposure, points_cam, depth, normal, patches.spacing_m.take(index, axis=0)
    )
    frame, far = cloud.frame[index], cloud.far[index]
    return PointsInImage(
        index=index,
        uv=view.uv.take(by_row, axis=0),
        depth=depth,
        focal_px=focal_px,
        slope=np.nan_to_num(slope, posinf=0.0, neginf=0.0),
        spacing_px=spacing_px,
        frame=frame,
        age_ns=_ages_ns(cloud.since_key_ns[index], frame, far),
        far=far,
    )


def _pinhole(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> tuple[Float, Float, Float]:
    """Return focal_px, slope and spacing_px of `PointsInImage` for z depth in a rectified image."""
    focal_px = exposure.camera.K[[0, 1], [0, 1]]
    # On the plane n · p = d the inverse depth is n · ray / d: linear over the image.
    d = np.einsum("ij,ij->i", normal, points_cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = normal[:, :2] / (d[:, None] * focal_px)
    everywhere = np.broadcast_to(focal_px, points_cam[:, :2].shape)
    # Patches count as facing the camera.
    return everywhere, slope, spacing_m * focal_px / depth[:, None]


def _any_lens(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> tuple[Float, Float, Float]:
    """Return focal_px, slope and spacing_px of `PointsInImage` for any lens and measure."""
    # If a point moves on the plane n · p = d until the image moves by one pixel, p moves by
    # δ = J⁺ - p (n · J⁺) / d, the inverse depth by -δ_z / z², and the inverse range by -p · δ / r³.
    J = pixels_per_metre(exposure.camera, points_cam)
    focal_px = np.linalg.norm(J, axis=2) * depth[:, None]
    d = np.einsum("ij,ij->i", normal, points_cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = J.transpose(0, 2, 1) @ np.linalg.inv(J @ J.transpose(0, 2, 1))
        along = -np.einsum("ij,ijk->ik", normal, across) / d[:, None]
        if exposure.measure == "z":
            z = points_cam[:, 2:]
            slope = -(across[:, 2] + along * z) / z**2
        else:
            slope = -along / np.linalg.norm(points_cam, axis=1, keepdims=True)
    # Rays of a scanner are spaced in azimuth and in elevation, about the key's upward axis.
    azimuth_axis = np.cross(exposure.T_cam_key[:3, 2], points_cam)
    azimuth_axis /= np.maximum(np.linalg.norm(azimuth_axis, axis=1, keepdims=True), 1e-9)
    elevation_axis = np.cross(points_cam, azimuth_axis)
    elevation_axis /= np.linalg.norm(elevation_axis, axis=1, keepdims=True)
    px_per_m = [np.einsum("ijk,ik->ij", J, axis) for axis in (azimuth_axis, elevation_axis)]
    spacing_px = np.hypot(px_per_m[0] * spacing_m[:, :1], px_per_m[1] * spacing_m[:, 1:])
    return focal_px, slope, spacing_px


def _ages_ns(since_key_ns: Int, frame: np.ndarray, far: Bool) -> Int:
    """Return the (K,) times between the points' sweeps and the key sweep."""
    ages_ns, in_window = np.abs(since_key_ns), np.flatnonzero(~far)
    first = int(frame[in_window].min(initial=np.iinfo(np.int32).max))
    sweep_ages_ns = np.zeros(max(0, int(frame[in_window].max(initial=-1)) + 1 - first), np.int64)
    sweep_ages_ns[frame[in_window] - first] = ages_ns[in_window]
    for younger, older in pairwise(np.argsort(sweep_ages_ns, kind="stable")):
        # Else clock jitter would decide between the sweeps before and after the key sweep.
        if sweep_ages_ns[older] - sweep_ages_ns[younger] < _SAME_AGE_NS:
            sweep_ages_ns[older] = sweep_ages_ns[younger]
    ages_ns[in_window] = sweep_ages_ns[frame[in_window] - first]
    return ages_ns


def distance_behind(points: PointsInImage, camera: Camera) -> Float:
    """Return the (K,) distance of each point behind the nearest patch over its pixel.

    The distance is a share of the tolerance: above 1 the point is occluded.
    """
    slack_px = _SLACK_M * points.focal_px / points.depth[:, None]
    half_px = np.maximum(FOOTPRINT * points.spacing_px + slack_px, 0.5)
    nearest = np.zeros((camera.height_px, camera.width_px), np.float32)
    paint(points.uv, points.inverse, points.slope, half_px, nearest)
    column, row = np.rint(points.uv).astype(np.int64).T
    occluder = nearest[row, column].astype(np.float64)
    covered = occluder > 0
    np.divide(1, occluder, out=occluder, where=covered)
    off = np.where(covered, points.depth - occluder, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(off / (HIDDEN_M + HIDDEN_FRACTION * occluder), posinf=np.inf)


@Kernel
def paint(uv, inverse, slope, half_px, canvas):  # type: ignore[no-untyped-def]
    """Raise ``canvas`` (H,W) float32 in place to the greatest inverse depth of the patches there.

    A patch covers the pixel centres within ``half_px`` (K,2) of its point uv (K,2). Its inverse
    depth is ``inverse + slope · offset``, between half of ``inverse`` and all of it: no patch is
    nearer than its point. ``inverse`` (K,) is in 1/m, ``slope`` (K,2) in 1/m per px.
    """
    height, width = canvas.shape
    for i in range(len(inverse)):
        w = inverse[i]
        left = max(int(np.ceil(uv[i, 0] - half_px[i, 0])), 0)
        right = min(int(np.floor(uv[i, 0] + half_px[i, 0])), width - 1)
        top = max(int(np.ceil(uv[i, 1] - half_px[i, 1])), 0)
        bottom = min(int(np.floor(uv[i, 1] + half_px[i, 1])), height - 1)
        for v in range(top, bottom + 1):
            tilt_v = slope[i, 1] * (v - uv[i, 1])
            covered = canvas[v, left : right + 1]
            for k in range(len(covered)):
                tilt = tilt_v + slope[i, 0] * (left + k - uv[i, 0])
                on_patch = w + min(max(tilt, -0.5 * w), 0.0)
                covered[k] = max(covered[k], np.float32(on_patch))


def sorted_by_pixel(points: PointsInImage, rank: Int, camera: Camera) -> tuple[Int, Int]:
    """Sort the points by pixel, the best point of each pixel first.

    The lowest ``rank`` (K,) comes first, then the nearest point. Returns ``start`` (H·W+1,) and
    ``order`` (K,): the points of pixel p are ``order[start[p]:start[p + 1]]``.
    """
    column, row = np.rint(points.uv).astype(np.int64).T
    start = np.empty(camera.height_px * camera.width_px + 1, np.int64)
    order = np.empty(len(rank), np.int64)
    pixel = row * camera.width_px + column
    _by_pixel(pixel, rank, points.depth, points.frame, points.uv, start, order)
    return start, order


@inlined
def _before(a, b, rank, depth, frame, uv):  # type: ignore[no-untyped-def]
    """Return True if point a wins a pixel over b. Equal points may come in any order."""
    if rank[a] != rank[b]:
        return rank[a] < rank[b]
    if depth[a] != depth[b]:
        return depth[a] < depth[b]
    if frame[a] != frame[b]:
        return frame[a] < frame[b]
    if uv[a, 0] != uv[b, 0]:
        return uv[a, 0] < uv[b, 0]
    return uv[a, 1] < uv[b, 1]


@Kernel
def _by_pixel(pixel, rank, depth, frame, uv, start, order):  # type: ignore[no-untyped-def]
    """Fill start (num_pixels + 1,) and order (K,) of `sorted_by_pixel`."""
    start[:] = 0
    for p in pixel:
        start[p + 1] += 1
    for p in range(len(start) - 1):
        start[p + 1] += start[p]
    filled = np.empty(len(start) - 1, np.int32)
    filled[:] = 0
    for i in range(len(pixel)):
        p = pixel[i]
        at = start[p] + filled[p]
        while at > start[p] and _before(i, order[at - 1], rank, depth, frame, uv):
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
        filled[p] += 1
