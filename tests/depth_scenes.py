# SPDX-License-Identifier: MIT
"""Cameras, clouds and map records for the tests of depth maps."""

from __future__ import annotations

import numpy as np

from densify.config import ProjectSettings
from densify.depth.exposure import Exposure, PointsInImage
from densify.depth.fill import to_lab
from densify.depth.measured_pixels import ALL_ROUND, MapInputs, MapRecord
from densify.depth.patches import find_patches
from densify.depth.project import project
from densify.free_space.sensor import Sensors
from densify.geometry.types import Camera, Cloud, RegisteredSweep, Sweep

KEY, PERIOD_NS = 10, 100_000_000
T_CAM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # axes only
NO_POINTS = PointsInImage(
    *(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0)),
    np.zeros((0, 2)),
    *(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int), np.zeros(0, bool)),
)


def record_of(
    filled_m,
    measured=None,
    boundary_m=None,
    spacing_px=(3.0, 3.0),
    tilt=(0.0, 0.0),
    image=None,
    points=NO_POINTS,
) -> MapRecord:
    """A record as after a fill. measured: (H,W) bool, all that is filled if None."""
    filled_m = np.array(filled_m, np.float32)
    shape, known = filled_m.shape, filled_m > 0
    depth_m = np.where(known if measured is None else known & measured, filled_m, np.float32(0))
    zero, two = np.zeros(shape, np.float32), (*shape, 2)
    return MapRecord(
        depth_m=depth_m,
        boundary_m=zero.copy() if boundary_m is None else np.array(boundary_m, np.float32),
        filled_m=filled_m,
        rejected_m=zero.copy(),
        confidence=zero.copy(),
        point=np.where(depth_m > 0, np.arange(known.size).reshape(shape), -1).astype(np.int32),
        tilt=np.broadcast_to(np.float32(tilt), two).copy(),
        spacing_px=np.broadcast_to(np.float32(spacing_px), two).copy(),
        votes=np.ones(shape, np.float32),
        edge=np.full(shape, np.float32(ALL_ROUND)),
        on_body=np.zeros(shape, bool),
        lab=np.zeros((0, 0, 3), np.float32) if image is None else to_lab(image),
        points=points,
        reason=np.zeros(known.size, np.uint8),
    )


def make_camera(width=64, height=48, focal=60.0, distortion=()) -> Camera:
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera("cam", width, height, K, np.eye(4), tuple(distortion))


def make_cloud(points, frame=KEY, confidence=1.0) -> Cloud:
    points = np.asarray(points, float).reshape(-1, 3)
    n = len(points)
    frame = np.full(n, frame, np.int32)
    return Cloud(
        points=points,
        rigid_points=points,
        frame=frame,
        since_key_ns=(frame.astype(np.int64) - KEY) * PERIOD_NS,
        row=np.arange(n),
        lidar=np.zeros(n, np.uint8),
        moving=np.zeros(n, bool),
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.full(n, confidence, np.float32),
        intensity=np.zeros(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
        far=np.zeros(n, bool),
    )


def patches_of(cloud, origins=None):
    """Patches of one scanner's cloud, whose own points tell how it samples directions.

    origins: (1,3) of the scanner by frame; the key frame's origin without it.
    """
    frames = np.unique(cloud.frame).tolist()
    origins = origins or dict.fromkeys(frames, np.zeros((1, 3)))
    sweeps = [
        registered(f, cloud.points[cloud.frame == f] - origins[f][0], np.eye(4), np.zeros(6))
        for f in frames
    ]
    return find_patches(cloud, Sensors.of(sweeps), origins)


def depth_map(cloud, exposure, surface, settings=None, **inputs):
    """The depth map of a cloud with its patches in the view of an exposure."""
    settings = settings or ProjectSettings()
    return project(MapInputs(cloud, surface, exposure.view_of(cloud), settings, **inputs))


def view(cloud, camera, T_cam_key, settings, origins=None):
    """The depth map of a cloud with the patches of its own scanners."""
    return depth_map(cloud, Exposure(camera, T_cam_key), patches_of(cloud, origins), settings)


def at_pixel(camera, u, v, z):
    """Camera-frame points seen at image coordinates (u, v) with depth z."""
    u, v, z = np.broadcast_arrays(np.asarray(u, float), v, z)
    x = (u - camera.K[0, 2]) / camera.K[0, 0] * z
    y = (v - camera.K[1, 2]) / camera.K[1, 1] * z
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def pixel_rays(camera) -> np.ndarray:
    """(H,W,3) rays of a camera's pixels, one metre forwards (x) in the lidar's axes."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    left, up = (camera.K[0, 2] - u) / camera.K[0, 0], (camera.K[1, 2] - v) / camera.K[1, 1]
    return np.stack([np.ones(u.shape), left, up], axis=-1)


def scanner_rays(azimuth_deg, elevation_deg) -> np.ndarray:
    """(N,3) rays of a scanner, one metre forwards (x)."""
    a, e = (g.ravel() for g in np.deg2rad(np.meshgrid(azimuth_deg, elevation_deg)))
    return np.stack([np.ones_like(a), np.tan(a), np.tan(e) / np.cos(a)], axis=1)


def registered(frame, points, pose, twist, offset_ns=None) -> RegisteredSweep:
    """A sweep of one scanner that moves by ``twist`` before its time, and by twice that after."""
    nothing = np.zeros(len(points))
    sweep = Sweep(
        *(frame, 0, points, nothing.astype(np.float32), offset_ns),
        *(nothing.astype(np.uint8), np.arange(len(points))),
    )
    return RegisteredSweep(sweep, pose, twist, 2 * twist)
