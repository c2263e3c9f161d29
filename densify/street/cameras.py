# SPDX-License-Identifier: MIT
"""Render the images of the vehicle's cameras, with their lenses and exposures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.geometry.cameras import rays
from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float, Float32
from densify.street.lidar import T_ego_lidar
from densify.street.materials import (
    COLOUR,
    GLOSS,
    Material,
    shade_factor,
    smooth_noise,
)
from densify.street.motion import Driving, poses_at
from densify.street.world import PASSES, STOPS, Hits, Optics, Rays, World

# mount of KITTI's cameras: axes turned, slightly misaligned, below and in front of the scanner
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_TILT = Rotation.from_rotvec([0.008, -0.012, 0.007]).as_matrix()
T_RECTIFIED_LIDAR = np.eye(4)
T_RECTIFIED_LIDAR[:3, :3] = _TILT @ _AXES
T_RECTIFIED_LIDAR[:3, 3] = [-0.004, -0.076, -0.272]
FOCAL_PX, CENTRE_PX = 721.5, (609.5, 172.75)
# metres to the right of the rectified origin
_LEFT, _RIGHT = -0.06, 0.48
T_FISHEYE_LIDAR = np.array(  # on the left of the roof, facing left
    [[1.0, 0.0, 0.0, 0.3], [0.0, 0.0, -1.0, -0.2], [0.0, 1.0, 0.0, -0.6], [0.0, 0.0, 0.0, 1.0]]
)


class Shutter(NamedTuple):
    """The exposure times of a camera."""

    delay_ns: int  # exposure of the first image minus frame 0's reference time
    period_ns: int | None = None  # time between images; None for one image per sweep


def _pinhole(name: str, right_m: float, share: float = 1.0, row_time_s: float = 0.0) -> Camera:
    """Return a pinhole camera with ``share`` of KITTI's resolution."""
    T_cam_lidar = T_RECTIFIED_LIDAR.copy()
    T_cam_lidar[0, 3] -= right_m
    f, (u, v) = FOCAL_PX * share, ((c + 0.5) * share - 0.5 for c in CENTRE_PX)
    K = np.array([[f, 0, u], [0, f, v], [0, 0, 1.0]])
    size_px = round(1242 * share), round(375 * share)
    return Camera(name, *size_px, K, T_cam_lidar, row_time_s=row_time_s)


_FISHEYE_K = np.array([[124.0, 0, 199.5], [0, 124.0, 199.5], [0, 0, 1.0]])
CAMERAS = {
    "image_02": _pinhole("image_02", _LEFT),
    "image_03": _pinhole("image_03", _RIGHT),
    "fast": _pinhole("fast", _LEFT, 1 / 3),
    "rolling": _pinhole("rolling", _LEFT, 1 / 2, 100e-6),
    "fisheye": Camera(
        "fisheye", 400, 400, _FISHEYE_K, T_FISHEYE_LIDAR, (-0.02, 0.003, -0.001, 0.0001),
        model="fisheye", max_angle_deg=95.0,
    ),
}  # fmt: skip
"""The cameras, beside a level mount."""

SHUTTERS = {
    "image_02": Shutter(0),
    "image_03": Shutter(15_000_000),
    "fast": Shutter(7_000_000, 33_333_333),
    "rolling": Shutter(20_000_000, 100_000_000),
    "fisheye": Shutter(-20_000_000, 100_000_000),
}

USUAL = ("image_02", "image_03")
"""Those that are there unless others are asked for."""


def T_level_lidar(tilt_deg: float) -> Float:
    """Return the (4,4) pose of a lidar with a tilted mount in the frame of a level mount."""
    return inverse(T_ego_lidar()) @ T_ego_lidar(tilt_deg)


def cameras_beside(tilt_deg: float, names: tuple[str, ...] = USUAL) -> dict[str, Camera]:
    """Return the cameras, which do not tilt, with poses relative to the tilted lidar."""
    T = T_level_lidar(tilt_deg)
    return {n: replace(CAMERAS[n], T_cam_lidar=CAMERAS[n].T_cam_lidar @ T) for n in names}


MAX_DEPTH_M = 120.0
_SUN = np.array([-0.45, 0.55, 0.70]) / np.linalg.norm([-0.45, 0.55, 0.70])


@dataclass(frozen=True)
class Picture:
    """One exposure of (H,W) pixels."""

    image: NDArray[np.uint8]  # (H,W,3) uint8 RGB
    # (H,W) float32 depth of the nearest surface, glass included, by the camera's ``measure``. 0 for
    # pixels without a surface within 120 m, or outside the lens's view.
    depth_m: Float32
    body: NDArray[np.int32]  # (H,W) int32 index of the visible body, -1 for sky


def expose(world: World, ego: Driving, camera: Camera, time_s: float) -> Picture:
    """Render the picture of a camera, each row at its own time, the middle one at ``time_s``.

    ``camera``'s pose is relative to a level lidar, ``time_s`` in seconds since frame 0.
    """
    h, w = camera.height_px, camera.width_px
    v, u = np.divmod(np.arange(h * w, dtype=np.float64), w)
    ray = rays(camera, np.column_stack([u, v]))
    seen = np.flatnonzero(np.isfinite(ray[:, 0]))
    ray = ray[seen]
    cast = _in_world(ego, camera, ray, time_s, v[seen] - (h - 1) / 2)
    hits = world.cast(cast, lambda met: np.full(len(met.ray), STOPS))
    colour = _colours(world, cast, hits)
    is_glass = world.triangles.material[hits.triangle] == Material.GLASS
    glass = np.flatnonzero((hits.triangle >= 0) & is_glass)
    if len(glass):
        through = Rays(*(column[glass] for column in cast))
        behind = world.cast(through, through_glass(world))
        colour[glass] = 0.07 * _sky(through.direction) + 0.6 * _colours(world, through, behind)
    depth_m = hits.range_m * ray[:, 2] if camera.measure == "z" else hits.range_m
    solid = np.isfinite(depth_m) & (depth_m <= MAX_DEPTH_M)
    image, depth = np.zeros((h * w, 3), np.uint8), np.zeros(h * w, np.float32)
    body = np.full(h * w, -1, np.int32)
    image[seen] = np.rint(255 * np.clip(colour, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    depth[seen] = np.where(solid, depth_m, 0.0)
    body[seen] = np.where(hits.triangle >= 0, world.triangles.body[hits.triangle], -1)
    return Picture(image.reshape(h, w, 3), depth.reshape(h, w), body.reshape(h, w))


def _in_world(ego: Driving, camera: Camera, ray: Float, time_s: float, row: Float) -> Rays:
    """Return rays in the world frame, each at the exposure time of its row below the middle."""
    time = time_s + row * camera.row_time_s
    poses, T_ego_cam = poses_at(ego, time), T_ego_lidar() @ inverse(camera.T_cam_lidar)
    origin = poses.apply(np.broadcast_to(T_ego_cam[:3, 3], ray.shape))
    return Rays(origin, poses.turn(ray @ T_ego_cam[:3, :3].T), time)


def through_glass(world: World) -> Optics:
    """Return the optics of light: it passes vehicle glass and stops at all other surfaces."""
    is_glass = world.triangles.material == Material.GLASS
    return lambda met: np.where(is_glass[met.triangle], PASSES, STOPS)


def _colours(world: World, rays: Rays, hits: Hits) -> Float:
    """Return (N,3) linear RGB of the ray hits: sun with shadows, sky light and haze."""
    colour, is_hit = np.empty(rays.direction.shape), hits.triangle >= 0
    colour[~is_hit] = _sky(rays.direction[~is_hit])
    rows = np.flatnonzero(is_hit)
    triangle, direction, normal = hits.triangle[rows], rays.direction[rows], hits.normal[rows]
    material, range_m = world.triangles.material[triangle], hits.range_m[rows, None]
    a, b = hits.barycentric[rows].astype(np.float64).T[:, :, None]
    uv = world.triangles.uv[triangle]
    at = uv[:, 0] * (1 - a - b) + uv[:, 1] * a + uv[:, 2] * b
    texture = shade_factor(material, at)[:, None]
    painted = COLOUR[material] * world.triangles.tint[triangle] * texture
    facing = np.einsum("ni,ni->n", normal, direction)
    normal = np.where(facing[:, None] > 0, -normal, normal)
    towards_sun = normal @ _SUN
    leafy = material == Material.LEAF  # light shines through leaves too
    towards_sun = np.where(leafy, 0.35 + 0.4 * np.abs(towards_sun), np.maximum(towards_sun, 0.0))
    sunny = np.flatnonzero(towards_sun > 0)
    point = rays.origin[rows] + direction * range_m + 0.015 * normal
    shadow_rays = Rays(point[sunny], np.tile(_SUN, (len(sunny), 1)), rays.time_s[rows[sunny]])
    lit = np.zeros(len(rows))
    lit[sunny] = ~np.isfinite(world.cast(shadow_rays, through_glass(world)).range_m)
    sun = 1.15 * (lit * towards_sun)[:, None] * np.array([1.0, 0.95, 0.86])
    ambient = (0.34 + 0.16 * normal[:, 2:]) * np.array([0.88, 0.95, 1.08])
    shiny = np.flatnonzero(GLOSS[material])
    direction, normal = direction[shiny], normal[shiny]
    mirrored = direction - 2 * np.einsum("ni,ni->n", direction, normal)[:, None] * normal
    light = np.clip(painted, 0, 1) ** 2.2 * (sun + ambient)
    light[shiny] += GLOSS[material[shiny], None] * _sky(mirrored)
    haze = np.exp(-range_m / 700.0)
    colour[rows] = light * haze + (1 - haze) * np.array([0.62, 0.72, 0.82])
    return colour


def _sky(direction: Float) -> Float:
    """Return (N,3) linear RGB of the sky in (N,3) directions."""
    up = np.clip(direction[:, 2], 0.0, 1.0)[:, None]
    blue = np.array([0.72, 0.80, 0.88]) * (1 - up) ** 3 + np.array([0.20, 0.38, 0.72]) * (
        1 - (1 - up) ** 3
    )
    flat = direction[:, :2] / (direction[:, 2:] + 0.12).clip(0.05) * 3.0
    cloud = sum(smooth_noise(flat + 7 * i, 0.5**i) / 2**i for i in range(3)) / 1.75
    cover = np.clip((cloud - 0.52) * 4.0, 0, 0.8)[:, None] * np.clip(up * 12, 0, 1)
    return blue * (1 - cover) + 0.92 * cover
