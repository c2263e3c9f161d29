# SPDX-License-Identifier: MIT
"""Select the images that belong to a key sweep, and project points and patches into an image."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, ProjectSettings
from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.cameras import NEAREST_M, depth_along, image_points, pixels_per_metre
from densify.geometry.twists import move_with_twists
from densify.geometry.types import (
    Bool,
    Camera,
    Cloud,
    Float,
    Float32,
    Int,
    LidarSequence,
    Patches,
    Stretch,
)

_log = logging.getLogger("densify")
_USUAL = ProjectSettings()
# Greatest period to a neighbouring sweep that bounds a sweep's own time, as a multiple of the
# shorter one of the two: sweeps jitter, gaps are longer
_JITTER = 1.5
_NUM_ROW_STEPS = 4  # number of iterations of the search for the row that observes a point
_SAME_AGE_NS = 10_000_000  # ages of two sweeps that differ by less are equal, for clock jitter
AT_ONCE = 1 << 16
"""Number of points that are projected together: their columns fit into the cache of a core."""


@dataclass(frozen=True)
class Shot:
    """The camera, image and time that a depth map shows."""

    camera: Camera  # camera whose view the map has
    number: int | None  # number of the image, None if no image belongs to the map
    stamp_ns: int  # time that the map shows: exposure of the image, or time of the key sweep


def key_shots(
    sequence: LidarSequence,
    cameras: Sequence[Camera],
    key: int,
    settings: ProjectSettings = _USUAL,
) -> dict[str, Shot]:
    """Return the camera, image and time of each depth map of a key sweep, by name of the map.

    By default each camera has one map, with the camera's name. The map shows the image exposed
    nearest to the key sweep, the earlier of two. With ``project.per=image`` each image that is
    nearer to the key sweep than to other sweeps has a map CAMERA/NUMBER. Without an image within
    about half a period the default map shows the time of the sweep. ``key`` is the frame number of
    the key sweep.
    """
    stamp_ns = sequence.stamp_ns(key)
    begin_ns, end_ns = _own_time_ns(sequence, key)
    shots = {}
    for camera in cameras:
        images_ns = {
            number: exposed_ns
            for number, exposed_ns in sequence.image_stamps_ns(camera.name).items()
            if begin_ns < exposed_ns <= end_ns
        }
        if settings.per == "image":
            for number, exposed_ns in images_ns.items():
                shots[f"{camera.name}/{number:06d}"] = Shot(camera, number, exposed_ns)
            if not images_ns:
                _log.warning(
                    "key %d: %s has no image of %s within %.0f ms of the sweep: no depth map",
                    key,
                    sequence.name,
                    camera.name,
                    (end_ns - begin_ns) / 2e6,  # half of the interval, in ms
                )
        elif images_ns:
            _, exposed_ns, nearest_number = min(
                (abs(exposed_ns - stamp_ns), exposed_ns, number)
                for number, exposed_ns in images_ns.items()
            )
            shown_ns = exposed_ns if settings.at == "camera" else stamp_ns
            shots[camera.name] = Shot(camera, nearest_number, shown_ns)
        else:
            shots[camera.name] = Shot(camera, None, stamp_ns)
    return shots


def load_images(sequence: LidarSequence, shots: Mapping[str, Shot]) -> dict[str, NDArray[np.uint8]]:
    """Return the RGB images (H,W,3) of the shots that show an image, by name of the map."""
    camera_and_number = {
        name: (shot.camera.name, shot.number)
        for name, shot in shots.items()
        if shot.number is not None
    }
    if hasattr(sequence, "prepare"):
        sequence.prepare((), list(camera_and_number.values()))
    return {name: sequence.image(*image) for name, image in camera_and_number.items()}


def _own_time_ns(sequence: LidarSequence, key: int) -> tuple[int, int]:
    """Return start and end (ns) of the time nearer to the key sweep than to any other sweep."""
    # Towards a gap or an end of the recording the time is at most 1.5 times as long as on the other
    # side. The time has no limits if neither neighbour has a stamp.
    frames = list(sequence.frames)
    index = frames.index(key)
    key_ns = sequence.stamp_ns(key)
    stamps_ns = [key_ns]
    for frame in (*frames[max(0, index - 1) : index], *frames[index + 1 : index + 2]):
        with suppress(InputError):  # a neighbouring sweep may have no readable stamp
            stamps_ns.append(sequence.stamp_ns(frame))
    if len(stamps_ns) < 2:
        return np.iinfo(np.int64).min, np.iinfo(np.int64).max
    max_period_ns = int(_JITTER * np.diff(sorted(stamps_ns)).min())
    before_ns = max([key_ns - max_period_ns, *(t_ns for t_ns in stamps_ns if t_ns < key_ns)])
    after_ns = min([key_ns + max_period_ns, *(t_ns for t_ns in stamps_ns if t_ns > key_ns)])
    return (before_ns + key_ns) // 2, (key_ns + after_ns) // 2


def pixel_of(uv: Float) -> tuple[Int, Int]:
    """Return the rows (K,) and the columns (K,) of the pixels at image coordinates uv (K,2)."""
    column, row = np.rint(uv).astype(np.int64).T
    return row, column


class InView(NamedTuple):
    """The K points of a cloud that lie in an image."""

    exposure: Exposure  # camera and time of the image
    rows: Int  # (K,) indices of the points in the cloud, ascending
    points_cam: Float  # (K,3) positions as in `Sight`
    uv: Float  # (K,2) pixel coordinates as in `Sight`

    def joined(self, appended: InView, num_points: int) -> InView:
        """Return the points in view of this cloud of ``num_points`` with another one appended."""
        return InView(
            self.exposure,
            np.concatenate([self.rows, num_points + appended.rows]),
            np.concatenate([self.points_cam, appended.points_cam]),
            np.concatenate([self.uv, appended.uv]),
        )


class Sight(NamedTuple):
    """N points projected to an image."""

    points_cam: Float  # (N,3) positions in metres, camera frame, at the exposure
    uv: Float  # (N,2) column and row in px, NaN if a point has no projection
    inside: Bool  # (N,) True for points on the image that have a depth


@dataclass(frozen=True)
class Exposure:
    """A camera at the time that a depth map shows."""

    camera: Camera
    # (4,4) from the key sweep's lidar frame to the camera at that time, with ego-motion
    T_cam_key: Float
    late_s: float = 0.0  # seconds from the key sweep's reference time to that time
    # (6,) angular and linear velocity of the camera, rad/s and m/s in its own frame
    twist: Float = field(default_factory=lambda: np.zeros(6))
    number: int | None = None  # number of the image, None if the map shows no image
    measure: str = "z"  # kind of depth, camera ``z`` or ``range``
    # Exposures of the "previous" and "next" image, if the window covers them
    neighbours: Mapping[str, Exposure] = field(default_factory=dict)

    @staticmethod
    def of(
        sequence: LidarSequence, stretch: Stretch, key: int, shot: Shot, settings: Config
    ) -> Exposure:
        """Return the camera of a depth map at the map's time, relative to the key sweep.

        The camera's pose is the recorded pose of the image. Without a recorded pose it is
        extrapolated from the key sweep with the vehicle's twist. ``output.optical_flow`` adds the
        exposures of the neighbouring images. ``key`` is the frame number of the key sweep.
        """
        exposure = _exposure(sequence, stretch, key, key, shot, settings)
        if not settings.output.optical_flow or shot.number is None:
            return exposure
        neighbours: dict[str, Exposure] = {}
        images = list(sequence.image_stamps_ns(shot.camera.name).items())
        index = next(i for i, (number, _) in enumerate(images) if number == shot.number)
        sweeps_ns = np.array([registered.sweep.stamp_ns for registered in stretch.sweeps])
        for name, neighbour_index in (("previous", index - 1), ("next", index + 1)):
            if not 0 <= neighbour_index < len(images):
                continue
            number, exposed_ns = images[neighbour_index]
            frame = stretch.frames[int(np.argmin(np.abs(sweeps_ns - exposed_ns)))]
            begin_ns, end_ns = _own_time_ns(sequence, frame)
            # Sweeps of the window are too far for the pose of an image nearer to a sweep outside.
            if begin_ns < exposed_ns <= end_ns:
                at_sweep = settings.project.at == "sweep"
                shown_ns = stretch[frame].sweep.stamp_ns if at_sweep else exposed_ns
                neighbour = Shot(shot.camera, number, shown_ns)
                neighbours[name] = _exposure(sequence, stretch, key, frame, neighbour, settings)
        return replace(exposure, neighbours=neighbours)

    def see(self, points: Float, velocity_m_s: Float | Float32) -> Sight:
        """Return N points projected to the image, in the order given.

        Moving points advance by their velocity to the exposure. With a rolling shutter each row or
        column has its own exposure time. Points beside or behind a wide lens have no z and are not
        inside.

        Args:
            points: (N,3) positions in metres, key sweep's lidar frame, at its reference time.
            velocity_m_s: (N,3) velocities without ego-motion, same frame, or (3,) for all points.
        """
        at_shown_time = points + self.late_s * velocity_m_s if velocity_m_s.any() else points
        points_cam = poses.transform(self.T_cam_key, at_shown_time)
        uv, inside = image_points(self.camera, points_cam)
        if not self.camera.is_rolling:
            return Sight(points_cam, uv, inside & (self.depth_m(points_cam) > NEAREST_M))

        # The row that observes a point depends on its position at that row's exposure time, which
        # depends on the row. Both are found by iteration, from the row without a rolling shutter.
        exposed_cam = points_cam
        last_pixel = np.array([self.camera.width_px - 1, self.camera.height_px - 1])
        pixel_time_s = np.array([self.camera.column_time_s, self.camera.row_time_s])
        velocity_cam = poses.rotate(self.T_cam_key, velocity_m_s.astype(np.float64))
        rotation = np.append(self.twist[:3], np.zeros(3))  # the twist without its translation
        for _ in range(_NUM_ROW_STEPS):
            pixel = np.where(np.isnan(uv), last_pixel / 2, np.clip(uv, 0, last_pixel))
            # The middle row is exposed at the time that the map shows.
            row_s = ((pixel - last_pixel / 2) * pixel_time_s).sum(axis=1)
            # The camera moves by its twist, so the points move by its inverse in the camera frame.
            translated = points_cam + row_s[:, None] * (velocity_cam - self.twist[3:])
            exposed_cam = move_with_twists(translated, -row_s, rotation, rotation)
            uv, inside = image_points(self.camera, exposed_cam)
        return Sight(exposed_cam, uv, inside & (self.depth_m(exposed_cam) > NEAREST_M))

    def view_of(self, cloud: Cloud) -> InView:
        """Return the points of a cloud (at the key sweep's reference time) in the image."""
        rows, points_cam, uv = [], [], []
        for begin in range(0, max(1, len(cloud)), AT_ONCE):
            chunk = slice(begin, begin + AT_ONCE)
            sight = self.see(cloud.points[chunk], cloud.velocity_m_s[chunk])
            inside = np.flatnonzero(sight.inside)
            rows.append(begin + inside)
            points_cam.append(sight.points_cam.take(inside, axis=0))
            uv.append(sight.uv.take(inside, axis=0))
        return InView(self, np.concatenate(rows), np.concatenate(points_cam), np.concatenate(uv))

    def depth_m(self, points_cam: Float) -> Float:
        """Return the depths (N,) in metres of points (N,3), camera frame: z or range."""
        return depth_along(points_cam, self.measure)


def _exposure(
    sequence: LidarSequence, stretch: Stretch, key: int, frame: int, shot: Shot, settings: Config
) -> Exposure:
    """Return the exposure of a shot without neighbours, extrapolated from sweep ``frame``."""
    camera = shot.camera
    registered = stretch[frame]
    since_sweep_s = float(shot.stamp_ns - registered.sweep.stamp_ns) * 1e-9
    twist = registered.twist_before if since_sweep_s < 0 else registered.twist_after
    # From the lidar at the sweep's reference time to the camera at the shot's time
    T_cam_lidar = camera.T_cam_lidar @ poses.inverse(poses.exp(since_sweep_s * twist))
    at_exposure = settings.project.at == "camera" and shot.number is not None
    if at_exposure and hasattr(sequence, "T_world_cam"):
        T_cam_world = poses.inverse(sequence.T_world_cam(camera.name, shot.number or 0))
        T_cam_lidar = T_cam_world @ sequence.T_world_lidar(frame)
    measure = settings.project.depth
    return Exposure(
        camera=camera,
        T_cam_key=T_cam_lidar @ stretch.T_target_source(frame, key),
        late_s=float(shot.stamp_ns - stretch[key].sweep.stamp_ns) * 1e-9,
        twist=poses.transform_twist(camera.T_cam_lidar, twist),
        number=shot.number,
        measure=camera.measure if measure == "auto" else measure,
    )


class PointsInImage(NamedTuple):
    """The K points of a cloud in an image."""

    rows: Int  # (K,) indices of the points in the cloud
    uv: Float  # (K,2) column and row in px
    depth: Float32  # (K,) depth in m
    inverse: Float  # (K,) inverse depth in 1/m
    focal_px: Float  # (K,2) local scale, px per metre at a depth of 1 m
    # (K,2) slope of the tangent plane's inverse depth to the right and down, 1/m per px
    slope: Float
    spacing_px: Float  # (K,2) spacing of neighbouring rays, across and down
    frame: np.ndarray  # (K,) frame number of the source sweep
    age_ns: Int  # (K,) time between source and key sweep, equal if it differs by less than 10 ms
    far: Bool  # (K,) True for points of sweeps beyond the window


def points_in_image(cloud: Cloud, view: InView, patches: Patches) -> PointsInImage:
    """Return the points of a cloud in an image, with size and slope of their patches in pixels.

    The points are ordered by the rows of the image. A patch that is seen edge-on has the slope 0.
    """
    # In the order of the image's rows, points that are used together lie together in memory.
    order = np.argsort(np.rint(view.uv[:, 1]).astype(np.uint16), kind="stable")
    exposure = view.exposure
    rows = view.rows[order]
    points_cam = view.points_cam.take(order, axis=0)
    depth = exposure.depth_m(points_cam).astype(np.float32)
    normal = poses.rotate(exposure.T_cam_key, patches.normal.take(rows, axis=0).astype(np.float64))
    is_pinhole = exposure.camera.is_rectified and exposure.measure == "z"
    scale = _pinhole_scale if is_pinhole else _lens_scale
    focal_px, slope, spacing_px = scale(
        exposure, points_cam, depth, normal, patches.spacing_m.take(rows, axis=0)
    )
    frame, far = cloud.frame[rows], cloud.far[rows]
    return PointsInImage(
        rows=rows,
        uv=view.uv.take(order, axis=0),
        depth=depth,
        inverse=1 / depth.astype(np.float64),
        focal_px=focal_px,
        slope=np.nan_to_num(slope, posinf=0.0, neginf=0.0),
        spacing_px=spacing_px,
        frame=frame,
        age_ns=_ages_ns(cloud.since_key_ns[rows], frame, far),
        far=far,
    )


def _pinhole_scale(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> tuple[Float, Float, Float]:
    """Return ``focal_px``, ``slope`` and ``spacing_px`` of `PointsInImage`, (K,2) each.

    Images are rectified, depths are z. Points and normals (K,3) are in the camera frame, spacings
    (K,2) along azimuth and elevation. The slope is not finite where a patch is seen edge-on.
    """
    focal_px = exposure.camera.K[[0, 1], [0, 1]]
    # On the plane n · p = d the inverse depth is n · ray / d: linear over the image.
    distance = np.einsum("ij,ij->i", normal, points_cam)  # d
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = normal[:, :2] / (distance[:, None] * focal_px)
    all_focal_px = np.broadcast_to(focal_px, points_cam[:, :2].shape)
    # Patches count as facing the camera.
    return all_focal_px, slope, spacing_m * focal_px / depth[:, None]


def _lens_scale(
    exposure: Exposure, points_cam: Float, depth: Float32, normal: Float, spacing_m: Float32
) -> tuple[Float, Float, Float]:
    """Return the values of `_pinhole_scale` for any lens and measure of depth."""
    # J (K,2,3): px that a point moves right and down in the image, per metre that it moves in space
    J = pixels_per_metre(exposure.camera, points_cam)
    focal_px = np.linalg.norm(J, axis=2) * depth[:, None]
    slope = _lens_slope(exposure.measure, points_cam, normal, J)
    return focal_px, slope, _ray_spacing_px(exposure, points_cam, spacing_m, J)


def _lens_slope(measure: str, points_cam: Float, normal: Float, J: Float) -> Float:
    """Return the (K,2) slope of inverse depth (1/m per px) of planes through points (K,3)."""
    # A point p moves on its plane n · p = d until it has moved by one pixel, by
    # δ = J⁺ - p (n · J⁺) / d. The pseudoinverse J⁺ (K,3,2) moves the point across its ray by one
    # pixel, the second term moves it along the ray back to the plane. The inverse depth changes by
    # -δ_z / z², and the inverse range by -p · δ / r³, where p · J⁺ is 0.
    distance = np.einsum("ij,ij->i", normal, points_cam)  # d
    with np.errstate(divide="ignore", invalid="ignore"):
        metres_per_px = J.transpose(0, 2, 1) @ np.linalg.inv(J @ J.transpose(0, 2, 1))  # J⁺
        # (K,2) relative change of the range per pixel, -(n · J⁺) / d
        range_share = -np.einsum("ij,ijk->ik", normal, metres_per_px) / distance[:, None]
        if measure == "z":
            z = points_cam[:, 2:]
            return -(metres_per_px[:, 2] + range_share * z) / z**2
        return -range_share / np.linalg.norm(points_cam, axis=1, keepdims=True)


def _ray_spacing_px(exposure: Exposure, points_cam: Float, spacing_m: Float32, J: Float) -> Float:
    """Return the (K,2) spacing of rays right and down in px, from (K,2) metres."""
    # Rays of a scanner are spaced in azimuth and elevation, about the key's upward axis.
    azimuth_axis = np.cross(exposure.T_cam_key[:3, 2], points_cam)
    azimuth_axis /= np.maximum(np.linalg.norm(azimuth_axis, axis=1, keepdims=True), 1e-9)
    elevation_axis = np.cross(points_cam, azimuth_axis)
    elevation_axis /= np.linalg.norm(elevation_axis, axis=1, keepdims=True)
    azimuth_px, elevation_px = (
        np.einsum("ijk,ik->ij", J, axis) * spacing_m[:, [column]]
        for column, axis in enumerate((azimuth_axis, elevation_axis))
    )
    return np.hypot(azimuth_px, elevation_px)


def _ages_ns(since_key_ns: Int, frame: np.ndarray, far: Bool) -> Int:
    """Return the times (K,) in ns between the points' sweeps and the key sweep."""
    # Ages of two sweeps of the window that differ by less than 10 ms are made equal. Otherwise
    # clock jitter would decide between a sweep before the key sweep and one after.
    ages_ns = np.abs(since_key_ns)
    in_window = np.flatnonzero(~far)
    if not len(in_window):
        return ages_ns
    # A table of ages by frame number, from the first frame of the window
    row = frame[in_window] - frame[in_window].min()
    sweep_ages_ns = np.zeros(row.max() + 1, np.int64)
    sweep_ages_ns[row] = ages_ns[in_window]
    for younger, older in pairwise(np.argsort(sweep_ages_ns, kind="stable")):
        if sweep_ages_ns[older] - sweep_ages_ns[younger] < _SAME_AGE_NS:
            sweep_ages_ns[older] = sweep_ages_ns[younger]
    ages_ns[in_window] = sweep_ages_ns[row]
    return ages_ns
