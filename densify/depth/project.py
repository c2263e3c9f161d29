# SPDX-License-Identifier: MIT
"""The accumulated cloud seen from a camera: which points it sees, and the depth map they make.

Points that the camera cannot see are found by occlusion: every point hides what lies clearly behind
its patch (`densify.depth.patches`). Of the points left in a pixel the one measured nearest in time
to the key is taken, if enough sweeps agree with it and no depth edge is too close to tell on which
side of it the pixel lies: those are its rims, which `densify.depth.rims` decides upon. Its depth is
that of the plane through the points that agree, in the middle of the pixel. Nothing depends on the
order of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.exposure import Exposure, InView
from densify.depth.fill import fill
from densify.depth.glass import close_windows
from densify.depth.layers import Layers
from densify.depth.rims import MOST_CONFIDENCE, decide
from densify.depth.star import fill_stars
from densify.geometry.cameras import pixels_per_metre
from densify.geometry.poses import rotate
from densify.kernels import visibility as kernels
from densify.types import Bool, Camera, Cloud, DepthMap, Float, Float32, Int, Patches, Reason

_MAX_HALF_PX = 24.0  # a point just before the lens must not hide the whole image
_MAX_TILT = 0.25  # of the inverse depth per pixel; a plane seen edge-on has no slope
_SAME_AGE_NS = 10_000_000
_BLOCK_PX = 16  # over which rays lie about equally dense
_MOST_SWEEPS = 63  # that are told apart when they are counted
_EDGE_WINDOW_PX = 1.5  # beyond the edge, where points must show that a surface goes on
# Of pixels that sweeps beyond the window give: these vouch that a surface goes on where something
# nearer begins, so both are stricter.
_FAR_SUPPORT, _FAR_EDGE = 6, 1.5
_LEAST_CONFIDENCE = 1 / 255  # 0 means no depth once written as 8 bits
# What takes how much of a pixel's confidence, at most: few sweeps, few points, an edge close by,
# a rough fit, being nearly hidden. Set by hand, in the order of what was most often wrong.
_DOUBTS = np.array([0.45, 0.25, 0.20, 0.10, 0.10])
_MANY_POINTS = 20
_ROUGH_M = 0.10


@dataclass(frozen=True)
class _InImage:
    """The K points in the image. index: rows of the cloud. uv: (K,2) px. depth: (K,) m, as it is
    stored. focal_px: (K,2) local scale, px per metre at a depth of 1 m. slope: (K,2) of the tangent
    plane's inverse depth, 1/m per px. spacing_px: (K,2) between neighbouring rays. moving: (K,).
    frame, sweep: (K,) source, see `_witness`. age_ns: (K,) see `_ages_ns`. far: (K,) from a sweep
    beyond the window."""

    index: Int
    uv: Float
    depth: Float32
    focal_px: Float
    slope: Float
    spacing_px: Float
    moving: Bool
    frame: np.ndarray
    sweep: np.ndarray
    age_ns: Int
    far: Bool

    def select(self, keep: Bool) -> _InImage:
        if keep.all():
            return self
        return _InImage(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    @property
    def inverse(self) -> Float:
        return 1 / self.depth.astype(np.float64)


@dataclass(frozen=True)
class _Pixels:
    """P measured pixels. pixel: (P,) row by row. winner: (P,) which of the points in the image.
    depth_m, confidence: (P,). tilt: (P,2) of the inverse depth, 1/m per px. inside: (P,) no depth
    edge near. veiled: (P,) behind another point's patch."""

    pixel: Int
    winner: Int
    depth_m: Float32
    confidence: Float32
    tilt: Float
    inside: Bool
    veiled: Bool

    def select(self, keep: Bool | Int) -> _Pixels:
        return _Pixels(**{name: column[keep] for name, column in vars(self).items()})

    def replaced(self, others: _Pixels) -> _Pixels:
        """With other pixels of the same points, which count where both know one."""
        kept = self.select(~np.isin(self.pixel, others.pixel))
        more = vars(others)
        both = _Pixels(**{n: np.concatenate([c, more[n]]) for n, c in vars(kept).items()})
        return both.select(np.argsort(both.pixel))


def project(
    cloud: Cloud,
    view: InView,
    settings: ProjectSettings,
    patches: Patches,
    filled: bool = True,
    lab: Float32 | None = None,
) -> DepthMap:
    """The depth map of ``cloud``, at the key's moment, as a camera sees it at its exposure.

    view: of the cloud (`densify.depth.exposure.Exposure.sees`).
    settings: knobs, see `densify.config.ProjectSettings`; with ``visibility`` off the nearest point
    of each pixel is taken as it is; else the source sweep nearest in time to the key wins a pixel.
    patches: of the cloud, at the key's moment (`densify.depth.patches.patches`). filled: False
    leaves out the filling, which takes its time. lab: (H,W,3) the image, as `densify.depth.picture`
    makes it; without it nothing that needs one is done.

    Points nearer than 0.1 m, outside the image or outside the lens's valid field of view are
    dropped. Planes are fitted in inverse depth, or inverse range where depth is the range: linear
    over the image of a pinhole in the first case, nearly so over a surface's few pixels otherwise.
    ``filled_m`` adds pixels interpolated between measured ones (`densify.depth.fill`).
    ``confidence`` ranks only: the point's own, less where few sweeps or points agree, a depth edge
    is close, the surface rough, or the point nearly hidden. ``reason`` says of every point why it
    is not in the map.
    """
    camera = view.exposure.camera
    points = _in_image(cloud, view, patches, settings.visibility)
    own = np.clip(cloud.confidence[points.index], _LEAST_CONFIDENCE, 1.0)
    reason = np.full(len(cloud), Reason.OUTSIDE, np.uint8)
    if settings.visibility:
        reason[patches.free] = Reason.VETOED
        seen = _visible(points, own, camera, settings, reason)
    else:
        seen = _nearest(points, own, camera, reason)

    layers = decide(_measured(seen, points, camera, lab), settings)
    if filled:
        layers = fill(layers, settings)
        if settings.visibility and settings.glass == "plane":
            layers = close_windows(layers, camera.focal_px, settings)
        if settings.star_reach > 0:
            layers = fill_stars(layers, settings)
    return _finished(layers, cloud, view.exposure, reason)


def _nearest(points: _InImage, own: Float32, camera: Camera, reason: NDArray[np.uint8]) -> _Pixels:
    """Each pixel's nearest point, as it is; fills in the ``reason`` of the others."""
    start, order = _by_pixel(points, np.zeros(len(own), np.int64), own, camera)
    pixel = np.flatnonzero(np.diff(start))
    nearest = order[start[pixel]]
    reason[points.index] = Reason.NOT_CHOSEN
    everywhere = np.ones(len(pixel), bool)
    tilt = points.slope[nearest]
    return _Pixels(
        pixel, nearest, points.depth[nearest], own[nearest], tilt, everywhere, ~everywhere
    )


def _measured(seen: _Pixels, points: _InImage, camera: Camera, lab: Float32 | None) -> Layers:
    """What is measured away from depth edges is accepted, what is at them to be decided."""
    shape = (camera.height_px, camera.width_px)
    depth_m, rim_m, confidence = (np.zeros(shape, np.float32) for _ in range(3))
    tilt = np.zeros((*shape, 2), np.float32)
    point = np.full(shape, -1, np.int32)
    depth_m.flat[seen.pixel] = np.where(seen.inside, seen.depth_m, 0)
    rim_m.flat[seen.pixel] = np.where(seen.inside, 0, seen.depth_m)
    confidence.flat[seen.pixel] = np.maximum(seen.confidence, _LEAST_CONFIDENCE)
    tilt.reshape(-1, 2)[seen.pixel] = seen.tilt
    point.flat[seen.pixel] = points.index[seen.winner]
    veiled = np.zeros(shape, bool)
    veiled.flat[seen.pixel] = seen.veiled
    spacing_px = _spacing_px(points if points.far.all() else points.select(~points.far), shape)
    return Layers(depth_m, rim_m, veiled, depth_m, confidence, point, tilt, spacing_px, lab)


def _spacing_px(points: _InImage, shape: tuple[int, int]) -> Float32:
    """(H,W,2) between neighbouring rays: their mean over blocks, the nearest block's where there
    are no points."""
    height, width = (-(-size // _BLOCK_PX) for size in shape)
    column, row = np.rint(points.uv).astype(np.int64).T // _BLOCK_PX
    block = row * width + column
    num = np.bincount(block, minlength=height * width)
    if not num.any():
        return np.ones((*shape, 2), np.float32)
    sums = [np.bincount(block, s, height * width) for s in points.spacing_px.T]
    mean = (np.stack(sums, axis=1) / np.maximum(num, 1)[:, None]).astype(np.float32)
    empty = (num == 0).reshape(height, width)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    blocks = mean.reshape(height, width, 2)[tuple(nearest)]
    every = blocks.repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
    return np.ascontiguousarray(every[: shape[0], : shape[1]])


def _finished(
    layers: Layers, cloud: Cloud, exposure: Exposure, reason: NDArray[np.uint8]
) -> DepthMap:
    measured, rim = layers.depth_m > 0, (layers.rim_m > 0) & ~layers.veiled
    reason[layers.point[rim]] = Reason.EDGE
    reason[layers.point[measured]] = Reason.KEPT
    if layers.glass is not None:
        reason[layers.point[layers.glass]] = Reason.GLASS
    frame = np.full(measured.shape, -1, np.int32)
    frame[measured] = cloud.frame[layers.point[measured]]
    shown = layers.filled_m > 0
    confidence = np.where(shown, np.maximum(layers.confidence, np.float32(_LEAST_CONFIDENCE)), 0)
    return DepthMap(
        camera=exposure.camera.name,
        depth_m=layers.depth_m,
        filled_m=layers.filled_m,
        confidence=confidence,
        frame=frame,
        reason=reason,
        measure=exposure.measure,
        warnings=layers.warnings,
    )


class _Local(NamedTuple):
    """How surface shows around each of K points; see `_InImage`."""

    focal_px: Float
    slope: Float
    spacing_px: Float


def _in_image(cloud: Cloud, view: InView, patches: Patches, vetoed: bool) -> _InImage:
    kept = ~patches.free[view.rows] if vetoed else np.ones(len(view.rows), bool)
    exposure, index, points_cam = view.exposure, view.rows[kept], view.points_cam[kept]
    depth = exposure.depth_m(points_cam).astype(np.float32)
    normal = rotate(exposure.T_cam_key, patches.normal[index].astype(np.float64))
    plain = exposure.camera.is_rectified and exposure.measure == "z"
    local = (_pinhole if plain else _any_lens)(
        exposure, points_cam, depth, normal, patches.spacing_m[index]
    )
    most, far = _MAX_TILT / depth[:, None], patches.place >= 0
    slope = np.nan_to_num(local.slope, posinf=0.0, neginf=0.0)
    return _InImage(
        index=index,
        uv=view.uv[kept],
        depth=depth,
        focal_px=local.focal_px,
        slope=np.clip(slope, -most, most),
        spacing_px=local.spacing_px,
        moving=cloud.moving[index],
        frame=cloud.frame[index],
        sweep=_witness(patches, far)[index],
        age_ns=_ages_ns(cloud.since_key_ns[index], patches.sweep[index], far[index]),
        far=far[index],
    )


def _pinhole(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> _Local:
    """Scale for the camera z of a rectified image, where patches count as facing the image
    plane."""
    focal_px = exposure.camera.K[[0, 1], [0, 1]]
    # On the plane n · p = d the inverse depth is n · ray / d: linear over the image.
    d = np.einsum("ij,ij->i", normal, points_cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = normal[:, :2] / (d[:, None] * focal_px)
    everywhere = np.broadcast_to(focal_px, points_cam[:, :2].shape)
    return _Local(everywhere, slope, spacing_m * focal_px / depth[:, None])


def _any_lens(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> _Local:
    """Scale by the Jacobian J (2,3) of the projection at each point p.

    Moving on the plane n · p = d so that the image moves by one pixel, p moves by
    δ = J⁺ - p (n · J⁺) / d, and the inverse depth by -δ_z / z², the inverse range by -p · δ / r³.
    """
    J = pixels_per_metre(exposure.camera, points_cam)
    focal_px = np.linalg.norm(J, axis=2) * depth[:, None]
    d = np.einsum("ij,ij->i", normal, points_cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = _pseudo_inverse(J)
        along = -np.einsum("ij,ijk->ik", normal, across) / d[:, None]
        if exposure.measure == "z":
            z = points_cam[:, 2:]
            slope = -(across[:, 2] + along * z) / z**2
        else:
            slope = -along / np.linalg.norm(points_cam, axis=1, keepdims=True)
    # Rays of a scanner lie apart in azimuth and in elevation, about the key's upward axis.
    level = np.cross(exposure.T_cam_key[:3, 2], points_cam)
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    rise = np.cross(points_cam, level)
    rise /= np.linalg.norm(rise, axis=1, keepdims=True)
    sides = [np.einsum("ijk,ik->ij", J, axis) for axis in (level, rise)]
    spacing_px = np.hypot(sides[0] * spacing_m[:, :1], sides[1] * spacing_m[:, 1:])
    return _Local(focal_px, slope, spacing_px)


def _pseudo_inverse(J: Float) -> Float:
    """(K,2,3) -> (K,3,2) of full rank, Jᵀ (J Jᵀ)⁻¹."""
    u, v = J[:, 0], J[:, 1]
    uu, uv, vv = (np.einsum("ij,ij->i", a, b)[:, None] for a, b in ((u, u), (u, v), (v, v)))
    across: Float = np.stack([vv * u - uv * v, uu * v - uv * u], axis=2)
    return across / (uu * vv - uv**2)[:, :, None]


def _witness(patches: Patches, far: Bool) -> NDArray[np.int32]:
    """(M,) which of 63 a point's sweep is when those that agree are counted: a number for each
    sweep of the window, and for each stretch of road beyond it; distant stretches may share one."""
    num_near = min(int(patches.sweep[~far].max(initial=-1)) + 1, _MOST_SWEEPS - 1)
    shared = num_near + patches.place % (_MOST_SWEEPS - num_near)
    return np.where(far, shared, np.minimum(patches.sweep, _MOST_SWEEPS - 1)).astype(np.int32)


def _ages_ns(since_key_ns: Int, sweep: NDArray[np.int32], far: Bool) -> Int:
    """(K,) times between the key and the points' sweeps. Sweeps of the window less than 10 ms
    apart count as equally old: clocks that jitter do not decide between the sweeps before and after
    the key."""
    near = ~far
    of_sweep = np.zeros(int(sweep[near].max(initial=-1)) + 1, np.int64)
    of_sweep[sweep[near]] = np.abs(since_key_ns[near])
    for younger, older in pairwise(np.argsort(of_sweep, kind="stable")):
        if of_sweep[older] - of_sweep[younger] < _SAME_AGE_NS:
            of_sweep[older] = of_sweep[younger]
    ages_ns = np.abs(since_key_ns)
    ages_ns[near] = of_sweep[sweep[near]]
    return ages_ns


def _visible(
    points: _InImage,
    own: Float32,
    camera: Camera,
    settings: ProjectSettings,
    reason: np.ndarray,
) -> _Pixels:
    """The pixels that the points not hidden measure; fills in the ``reason`` of the others.

    What sweeps beyond the window measured comes second. It gives pixels where the window has none
    away from depth edges, and vouches there for what the window saw too rarely.
    """
    near = ~points.far
    pixels, why = _settled(points.select(near), own[near], camera, settings)
    pixels = replace(pixels, winner=np.flatnonzero(near)[pixels.winner])
    reason[points.index[near]] = why
    if near.all():
        return pixels
    taken = pixels.pixel[pixels.inside]
    others, why = _settled(points, own, camera, settings, taken)
    reason[points.index[~near]] = why[~near]
    return pixels.replaced(others.select(others.inside))


def _settled(
    points: _InImage,
    own: Float32,
    camera: Camera,
    settings: ProjectSettings,
    taken: Int | None = None,
) -> tuple[_Pixels, NDArray[np.uint8]]:
    """The pixels that points measure, and of every point the `Reason`.

    taken: where given, pixels to leave alone; for the others the stricter rules hold of what sweeps
    beyond the window measured.
    """
    behind = _behind(points, camera, settings)
    edge_px = settings.edge_slack_m * points.focal_px[:, 0] * points.inverse
    hidden = behind > 1
    reason = np.where(hidden, Reason.HIDDEN, Reason.NOT_CHOSEN).astype(np.uint8)
    last = int(points.age_ns.max(initial=0)) + 1
    start, order = _by_pixel(points, np.where(hidden, last, points.age_ns), own, camera)
    found = np.zeros((6, len(start) - 1), np.float32)
    done = np.zeros(len(start) - 1, bool)
    if taken is not None:
        done[taken] = True
    visible = kernels.Visible(
        start=start,
        order=order,
        uv=points.uv,
        inverse=points.inverse,
        slope=points.slope,
        spacing_px=points.spacing_px,
        edge_px=edge_px,
        sweep=points.sweep,
        hidden=hidden,
        moving=points.moving,
        age_ns=points.age_ns,
    )
    shape = (camera.height_px, camera.width_px)
    kernels.settle.over_rows(len(done), visible, _reaches(settings), shape, done, found)
    pixel = np.flatnonzero(found[0])
    winner = order[start[pixel]]
    veiled = hidden[winner]
    depth_m, num_sweeps, youngest_ns, num_points, residual_m, edge = found[:, pixel]
    if taken is None:
        many = int(points.sweep.max(initial=0)) + 1
        nearest_ns = np.float32(points.age_ns.min(initial=last))
        supported = num_sweeps >= min(settings.support, max(1, many // 2))
        supported &= youngest_ns <= nearest_ns
        inside = edge >= 1
    else:
        many, supported, inside = 2 * _FAR_SUPPORT, num_sweeps >= _FAR_SUPPORT, edge >= _FAR_EDGE
        reason[winner[~inside & ~veiled]] = Reason.EDGE
    reason[winner[~supported & ~veiled]] = Reason.UNSUPPORTED
    doubts = np.stack(
        [
            1 - np.minimum(num_sweeps / many, 1),
            1 - np.minimum(num_points / _MANY_POINTS, 1),
            np.clip(3 - edge, 0, 2) / 2,
            np.minimum(residual_m / _ROUGH_M, 1),
            np.clip(behind[winner], 0, 1),
        ]
    )
    confidence = np.maximum(own[winner] * (1 - _DOUBTS @ doubts), MOST_CONFIDENCE)
    confidence, tilt = confidence.astype(np.float32), points.slope[winner]
    inside &= ~veiled
    every = _Pixels(pixel, winner, depth_m, confidence, tilt, inside, veiled)
    return every.select(supported), reason


def _reaches(settings: ProjectSettings) -> kernels.Reaches:
    return kernels.Reaches(
        support=float(settings.support_reach),
        plane=float(settings.plane_reach),
        agree_m=float(settings.agree_m),
        agree_fraction=float(settings.agree_fraction),
        behind_m=float(settings.hidden_m),
        behind_fraction=float(settings.hidden_fraction),
        edge=float(settings.edge_reach),
        edge_window_px=_EDGE_WINDOW_PX,
    )


def _behind(points: _InImage, camera: Camera, settings: ProjectSettings) -> Float:
    """(K,) how far each point lies behind the nearest patch over its pixel, as a share of what is
    allowed; above 1 it is hidden."""
    slack_px = settings.slack_m * points.focal_px / points.depth[:, None]
    half_px = np.clip(settings.footprint * points.spacing_px + slack_px, 0.5, _MAX_HALF_PX)
    nearest = np.zeros((camera.height_px, camera.width_px), np.float32)
    kernels.paint(points.uv, points.inverse, points.slope, half_px, nearest)
    column, row = np.rint(points.uv).astype(np.int64).T
    occluder = 1 / nearest[row, column].astype(np.float64)
    allowed = settings.hidden_m + settings.hidden_fraction * occluder
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num((points.depth - occluder) / allowed, posinf=np.inf)


def _by_pixel(points: _InImage, rank: Int, own: Float32, camera: Camera) -> tuple[Int, Int]:
    """The points of pixel p are ``order[start[p]:start[p + 1]]``, the least in rank first, then the
    nearest."""
    column, row = np.rint(points.uv).astype(np.int64).T
    start = np.empty(camera.height_px * camera.width_px + 1, np.int64)
    order = np.empty(len(rank), np.int64)
    pixel = row * camera.width_px + column
    kernels.by_pixel(pixel, rank, points.depth, points.frame, points.uv, own, start, order)
    return start, order
