# SPDX-License-Identifier: MIT
"""Points as one image has them: where they are, and how the surface around each of them shows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.depth.exposure import Exposure, InView
from densify.geometry.cameras import pixels_per_metre
from densify.geometry.poses import rotate
from densify.geometry.types import Bool, Cloud, Float, Float32, Int, Patches

_MAX_TILT = 0.25  # of the inverse depth per pixel; a plane seen edge-on has no slope
_SAME_AGE_NS = 10_000_000
_MOST_SWEEPS = 63  # that are told apart when they are counted


@dataclass(frozen=True)
class PointsInImage:
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

    def select(self, keep: Bool) -> PointsInImage:
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        return PointsInImage(
            **{f.name: getattr(self, f.name).take(rows, axis=0) for f in fields(self)}
        )

    def at(self, rows: Int) -> Int:
        """Where rows of the cloud, all in the image, are among these."""
        place = np.zeros(int(self.index.max(initial=-1)) + 1, np.int64)
        place[self.index] = np.arange(len(self.index))
        found: Int = place[rows]
        return found

    @property
    def inverse(self) -> Float:
        return 1 / self.depth.astype(np.float64)


class _Local(NamedTuple):
    """How surface shows around each of K points; see `PointsInImage`."""

    focal_px: Float
    slope: Float
    spacing_px: Float


def in_image(cloud: Cloud, view: InView, patches: Patches, vetoed: bool) -> PointsInImage:
    """The points of ``cloud`` that are in the ``view``. vetoed: without those that the key sweep
    saw through."""
    row = np.rint(view.uv[:, 1]).astype(np.uint16)
    kept = np.argsort(row, kind="stable")
    if vetoed:
        kept = kept[~patches.free[view.rows[kept]]]
    exposure, index = view.exposure, view.rows[kept]
    points_cam = view.points_cam.take(kept, axis=0)
    depth = exposure.depth_m(points_cam).astype(np.float32)
    normal = rotate(exposure.T_cam_key, patches.normal.take(index, axis=0).astype(np.float64))
    plain = exposure.camera.is_rectified and exposure.measure == "z"
    local = (_pinhole if plain else _any_lens)(
        exposure, points_cam, depth, normal, patches.spacing_m.take(index, axis=0)
    )
    most, far = _MAX_TILT / depth[:, None], patches.place >= 0
    slope = np.nan_to_num(local.slope, posinf=0.0, neginf=0.0)
    return PointsInImage(
        index=index,
        uv=view.uv.take(kept, axis=0),
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
