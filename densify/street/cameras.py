# SPDX-License-Identifier: MIT
"""Render the images of the cameras in cameras.yaml, with their lenses, exposures and light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.geometry.cameras import rays
from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float, Float32, Int
from densify.street import read_table
from densify.street.lidar import T_ego_lidar
from densify.street.mesh import COLOUR, GLOSS, Material, noise
from densify.street.motion import Driving, poses_at
from densify.street.world import PASSES, STOPS, Hits, Optics, Rays, World

_TABLES = read_table("cameras")
# Rotations from lidar axes to the axes of cameras that look forward and to the left
_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_MAX_DEPTH_M = 120.0
_GAMMA = 2.2  # gamma of the display
_OFF_SURFACE_M = 0.015  # distance from a surface to the origin of its ray to the sun
_NUM_OCTAVES, _OCTAVE_SHIFT = 3, 7  # octaves of the noise of clouds, and the shift between them
_GRAIN = 0.4  # share of the grains in a texture; blotches have the rest
_DARKEST, _CONTRAST = 0.82, 0.36  # brightness of the darkest brick, and range of brightness


def _pose(R_cam_lidar: Float, lidar_m: Float) -> Float:
    """Return the (4,4) pose of a lidar at the position ``lidar_m`` of the camera's frame."""
    T_cam_lidar = np.eye(4)
    T_cam_lidar[:3, :3] = R_cam_lidar
    T_cam_lidar[:3, 3] = lidar_m
    return T_cam_lidar


def _intrinsics(focal_px: float, u: float, v: float) -> Float:
    """Return the (3,3) camera matrix for a focal length and a principal point in pixels."""
    return np.array([[focal_px, 0, u], [0, focal_px, v], [0, 0, 1.0]])


_RECTIFIED, _FISHEYE = _TABLES.rectified, _TABLES.fisheye
T_RECTIFIED_LIDAR = _pose(
    Rotation.from_rotvec(_RECTIFIED.tilt_rad).as_matrix() @ _FORWARD, _RECTIFIED.lidar_m
)


def _pinhole(name: str, row: Any) -> Camera:
    """Return a pinhole camera with a fraction of KITTI's resolution, from its row of the table."""
    scale = 1 / getattr(row, "one_in", 1)
    # The centre of the first pixel is at 0, and its outer corner at -0.5.
    u, v = ((coordinate + 0.5) * scale - 0.5 for coordinate in _RECTIFIED.centre_px)
    K = _intrinsics(_RECTIFIED.focal_px * scale, u, v)
    T_cam_lidar = T_RECTIFIED_LIDAR.copy()
    T_cam_lidar[0, 3] -= row.right_m
    width_px, height_px = (round(size * scale) for size in _RECTIFIED.size_px)
    row_time_s = getattr(row, "row_time_s", 0.0)
    return Camera(name, width_px, height_px, K, T_cam_lidar, row_time_s=row_time_s)


CAMERAS = {name: _pinhole(name, row) for name, row in vars(_TABLES.pinhole).items()}
_WIDTH_PX, _HEIGHT_PX = _FISHEYE.size_px
CAMERAS["fisheye"] = Camera(
    "fisheye",
    _WIDTH_PX,
    _HEIGHT_PX,
    _intrinsics(_FISHEYE.focal_px, (_WIDTH_PX - 1) / 2, (_HEIGHT_PX - 1) / 2),
    _pose(_LEFT, _FISHEYE.lidar_m),
    tuple(_FISHEYE.distortion),
    model="fisheye",
    max_angle_deg=_FISHEYE.max_angle_deg,
)
"""The cameras by name; their poses are relative to a lidar on a level mount."""

EXPOSURES: dict[str, Any] = {**vars(_TABLES.pinhole), "fisheye": _FISHEYE}
"""The rows of cameras.yaml that tell when a camera exposes."""

USUAL = ("image_02", "image_03")
"""Names of the cameras that a recording has by default."""


def T_level_lidar(tilt_deg: float) -> Float:
    """Return the (4,4) pose of a lidar tilted nose down in the frame of a level lidar."""
    return inverse(T_ego_lidar()) @ T_ego_lidar(tilt_deg)


def cameras_beside(tilt_deg: float, names: tuple[str, ...] = USUAL) -> dict[str, Camera]:
    """Return the cameras by name, which are level, with poses relative to the tilted lidar."""
    T = T_level_lidar(tilt_deg)
    return {
        name: replace(CAMERAS[name], T_cam_lidar=CAMERAS[name].T_cam_lidar @ T) for name in names
    }


@dataclass(frozen=True)
class Picture:
    """One exposure of a camera with (H,W) pixels."""

    image: NDArray[np.uint8]  # (H,W,3) uint8 RGB
    # (H,W) float32 depth of the nearest surface, glass included, by the camera's ``measure``. 0 for
    # pixels without a surface within 120 m, or outside the lens's view.
    depth_m: Float32
    body: NDArray[np.int32]  # (H,W) int32 index of the visible body, -1 for sky


def expose(world: World, ego: Driving, camera: Camera, time_s: float) -> Picture:
    """Render the picture of a camera with a rolling shutter: each row at its own time.

    Pixels outside the view of the lens are black, with depth 0 and body -1.

    Args:
        world: Bodies to render.
        ego: Motion of the ego vehicle.
        camera: Camera whose pose is relative to a lidar on a level mount.
        time_s: Exposure of the middle row, in seconds since frame 0.
    """
    height, width = camera.height_px, camera.width_px
    v, u = np.divmod(np.arange(height * width, dtype=np.float64), width)
    ray = rays(camera, np.column_stack([u, v]))
    # Pixels outside the view of the lens have no ray and stay black.
    in_view = np.flatnonzero(np.isfinite(ray[:, 0]))
    ray = ray[in_view]
    # Rays in the world at the exposure of their rows
    exposed_s = time_s + (v[in_view] - (height - 1) / 2) * camera.row_time_s
    poses = poses_at(ego, exposed_s)
    T_ego_cam = T_ego_lidar() @ inverse(camera.T_cam_lidar)
    origin = poses.apply(np.broadcast_to(T_ego_cam[:3, 3], ray.shape))
    cast = Rays(origin, poses.turn(ray @ T_ego_cam[:3, :3].T), exposed_s)
    hits = world.cast(cast, lambda met: np.full(len(met.ray), STOPS))
    colour = _colours(world, cast, hits)
    # Glass shows the mirrored sky and the surface behind it.
    is_glass = world.triangles.material[hits.triangle] == Material.GLASS
    rows = np.flatnonzero((hits.triangle >= 0) & is_glass)
    if len(rows):
        through, glass = cast.rows(rows), _TABLES.light.glass
        behind = _colours(world, through, world.cast(through, through_glass(world)))
        colour[rows] = glass.mirrors * _sky(through.direction) + glass.passes * behind

    depth_m = hits.range_m * ray[:, 2] if camera.measure == "z" else hits.range_m
    is_near = np.isfinite(depth_m) & (depth_m <= _MAX_DEPTH_M)
    image = np.zeros((height * width, 3), np.uint8)
    image[in_view] = np.rint(255 * np.clip(colour, 0, 1) ** (1 / _GAMMA)).astype(np.uint8)
    depth = np.zeros(height * width, np.float32)
    depth[in_view] = np.where(is_near, depth_m, 0.0)
    body = np.full(height * width, -1, np.int32)
    body[in_view] = np.where(hits.triangle >= 0, world.triangles.body[hits.triangle], -1)
    size = height, width
    return Picture(image.reshape(*size, 3), depth.reshape(size), body.reshape(size))


def through_glass(world: World) -> Optics:
    """Return the optics of light: it passes vehicle glass and stops at all other surfaces."""
    is_glass = world.triangles.material == Material.GLASS
    return lambda met: np.where(is_glass[met.triangle], PASSES, STOPS)


def _colours(world: World, rays: Rays, hits: Hits) -> Float:
    """Return the (N,3) linear RGB that rays show: sunlight, shadows, light of the sky, and haze."""
    light = _TABLES.light
    is_hit = hits.triangle >= 0
    colour = np.empty(rays.direction.shape)
    colour[~is_hit] = _sky(rays.direction[~is_hit])
    rows = np.flatnonzero(is_hit)
    triangle = hits.triangle[rows]
    material = world.triangles.material[triangle]
    direction = rays.direction[rows]
    range_m = hits.range_m[rows, None]
    # Normals of triangles have either sign, and are turned towards the camera.
    normal = hits.normal[rows]
    facing = np.einsum("ni,ni->n", normal, direction)
    normal = np.where(facing[:, None] > 0, -normal, normal)

    # Light that the surface scatters
    point = rays.origin[rows] + direction * range_m + _OFF_SURFACE_M * normal
    sunlight = _sunlight(world, Rays(point, normal, rays.time_s[rows]), material)
    sun = light.sun.strength * sunlight[:, None] * np.array(light.sun.colour)
    ambient = light.ambient.sideways + light.ambient.upwards * normal[:, 2:]
    ambient = ambient * np.array(light.ambient.colour)
    painted = np.clip(_painted(world, triangle, hits.barycentric[rows]), 0, 1) ** _GAMMA
    reflected = painted * (sun + ambient)

    # Mirrored sky on glossy surfaces, then haze over the distance
    shiny = np.flatnonzero(GLOSS[material])
    direction, normal = direction[shiny], normal[shiny]
    mirrored = direction - 2 * np.einsum("ni,ni->n", direction, normal)[:, None] * normal
    reflected[shiny] += GLOSS[material[shiny], None] * _sky(mirrored)
    haze = np.exp(-range_m / light.haze.range_m)
    colour[rows] = reflected * haze + (1 - haze) * np.array(light.haze.colour)
    return colour


def _sunlight(world: World, surface: Rays, material: Int) -> Float:
    """Return the (N,) strengths of sunlight at ``surface``, whose directions are normals."""
    light = _TABLES.light
    sun = np.array(light.towards_sun) / np.linalg.norm(light.towards_sun)
    cosine = surface.direction @ sun
    through_leaf = light.leaf.least + light.leaf.facing * np.abs(cosine)
    strength = np.where(material == Material.LEAF, through_leaf, np.maximum(cosine, 0.0))
    sunny = np.flatnonzero(strength > 0)
    towards = np.tile(sun, (len(sunny), 1))
    shadow = Rays(surface.origin[sunny], towards, surface.time_s[sunny])
    lit = np.zeros(len(strength))  # 1 in the sun, 0 in a shadow
    lit[sunny] = ~np.isfinite(world.cast(shadow, through_glass(world)).range_m)
    return lit * strength


def _sky(direction: Float) -> Float:
    """Return the (N,3) linear RGB of the sky in (N,3) unit directions."""
    sky, cloud = _TABLES.light.sky, _TABLES.light.cloud
    up = np.clip(direction[:, 2], 0.0, 1.0)[:, None]
    horizon_share = (1 - up) ** 3
    blue = np.array(sky.horizon) * horizon_share + np.array(sky.zenith) * (1 - horizon_share)
    # Clouds are noise on a plane at height 1, which each direction meets at ``flat``.
    height = (direction[:, 2:] + cloud.above_horizon).clip(cloud.least)
    flat = direction[:, :2] / height * cloud.size
    # Octave i has half the size and half the weight of the octave before.
    octaves = [_smooth_noise(flat + _OCTAVE_SHIFT * i, 0.5**i) / 2**i for i in range(_NUM_OCTAVES)]
    density = sum(octaves) / sum(0.5**i for i in range(_NUM_OCTAVES))
    cover = np.clip((density - cloud.begins) * cloud.contrast, 0, cloud.most)[:, None]
    cover = cover * np.clip(up * cloud.fade, 0, 1)  # clouds fade out towards the horizon
    return blue * (1 - cover) + cloud.brightness * cover


def _painted(world: World, triangle: Int, barycentric: Float32) -> Float:
    """Return the (N,3) colours of points on triangles: material, tint and texture."""
    uv = world.triangles.uv[triangle]
    material = world.triangles.material[triangle]
    # position = (1 - b - c) uv_0 + b uv_1 + c uv_2, with the barycentric coordinates b and c
    weight_1, weight_2 = barycentric.astype(np.float64).T[:, :, None]
    position = uv[:, 0] * (1 - weight_1 - weight_2) + uv[:, 1] * weight_1 + uv[:, 2] * weight_2
    brightness = np.ones(len(material))
    for name, texture in vars(_TABLES.textures).items():
        rows = np.flatnonzero(material == Material[name])
        pattern = _bricks if hasattr(texture, "brick_m") else _grains
        brightness[rows] = pattern(position[rows], texture)
    return COLOUR[material] * world.triangles.tint[triangle] * brightness[:, None]


def _grains(uv: Float, texture: Any) -> Float:
    """Return the (N,) brightness, around 1, of grains and blotches at (N,2) positions in metres."""
    grain = noise(*np.floor(uv.T / texture.grain_m).astype(np.int64))
    mix = _GRAIN * grain + (1 - _GRAIN) * _smooth_noise(uv, texture.blotch_m)
    return 1 + texture.contrast * (2 * mix - 1)


def _bricks(uv: Float, texture: Any) -> Float:
    """Return the (N,) brightness, around 1, of bricks in courses at (N,2) positions in metres."""
    length_m, height_m = texture.brick_m
    row = np.floor(uv[:, 1] / height_m)
    # Every second course is shifted by half a brick.
    in_bricks = uv[:, 0] / length_m + 0.5 * (row % 2)
    column = np.floor(in_bricks)
    from_left_m = (in_bricks - column) * length_m
    from_bottom_m = uv[:, 1] - row * height_m
    is_joint = (from_left_m < texture.joint_m) | (from_bottom_m < texture.joint_m)
    brick = noise(column.astype(np.int64), row.astype(np.int64))
    return np.where(is_joint, texture.joint, _DARKEST + _CONTRAST * brick)


def _smooth_noise(uv: Float, cell_m: float) -> Float:
    """Return (N,) numbers in [0, 1) at (N,2) positions, smooth over cells of ``cell_m``."""
    x, y = uv.T / cell_m
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    # Positions within the cell, with slope 0 at its sides (smoothstep)
    x, y = x - i, y - j
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    # Bilinear interpolation between the random numbers of the cell's corners
    low, high = noise(i, j), noise(i, j + 1)
    low += (noise(i + 1, j) - low) * x
    high += (noise(i + 1, j + 1) - high) * x
    return low + (high - low) * y
