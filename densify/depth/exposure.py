# SPDX-License-Identifier: MIT
"""Select the images that belong to a key sweep, and project points and patches into an image."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, ProjectSettings
from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.cameras import NEAREST_M, depth_along, image_points, pixels_per_metre
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
_JITTER = 1.5  # greatest ratio of a used half period to half the shorter neighbouring period
_NUM_ROW_STEPS = 4  # of the search for the row that observes a point
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
    """Return the `Shot` of each depth map of a key sweep, by the name of the map.

    By default each camera has one map, with its name. It shows the image exposed nearest to the key
    sweep, the earlier of two. With ``project.per=image`` there is a map CAMERA/NUMBER for each
    image nearer to the key sweep than to any other. Without an image within about half a period the
    default map shows the time of the sweep.
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
        elif images_ns:
            number = min(images_ns, key=lambda n: (abs(images_ns[n] - stamp_ns), images_ns[n]))
            shown_ns = images_ns[number] if settings.at == "camera" else stamp_ns
            shots[camera.name] = Shot(camera, number, shown_ns)
        else:
            shots[camera.name] = Shot(camera, None, stamp_ns)
        if settings.per == "image" and not images_ns:
            _log.warning(
                "key %d: %s has no image of %s within %.0f ms of the sweep: no depth map",
                key,
                sequence.name,
                camera.name,
                (end_ns - begin_ns) / 2e6,
            )
    return shots


def load_images(sequence: LidarSequence, shots: Mapping[str, Shot]) -> dict[str, NDArray[np.uint8]]:
    """Return the (H,W,3) RGB images of the shots that show an image, by the name of the map."""
    images = {n: (s.camera.name, s.number) for n, s in shots.items() if s.number is not None}
    if hasattr(sequence, "prepare"):
        sequence.prepare((), list(images.values()))
    return {name: sequence.image(*image) for name, image in images.items()}


def _own_time_ns(sequence: LidarSequence, key: int) -> tuple[int, int]:
    """Return start and end, in ns, of the time nearer to the key sweep than to another sweep."""
    frames = list(sequence.frames)
    row = frames.index(key)
    stamps_ns = {}
    for frame in frames[max(0, row - 1) : row + 2]:
        try:
            stamps_ns[frame] = sequence.stamp_ns(frame)
        except InputError:  # the image of another key
            if frame == key:
                raise
    if len(stamps_ns) < 2:
        return np.iinfo(np.int64).min, np.iinfo(np.int64).max
    every_ns, key_ns = [*stamps_ns.values()], stamps_ns[key]
    most_period_ns = int(_JITTER * np.diff(every_ns).min())
    before_ns = max([key_ns - most_period_ns, *(s for s in every_ns if s < key_ns)])
    after_ns = min([key_ns + most_period_ns, *(s for s in every_ns if s > key_ns)])
    return (before_ns + key_ns) // 2, (key_ns + after_ns) // 2


def pixel_of(uv: Float) -> tuple[Int, Int]:
    """Return the (K,) rows and the (K,) columns of the pixels at image coordinates (K,2)."""
    column, row = np.rint(uv).astype(np.int64).T
    return row, column


class InView(NamedTuple):
    """The K points of a cloud that lie in an image."""

    exposure: Exposure  # camera and time of the image
    rows: Int  # (K,) indices of the points in the cloud, ascending
    points_cam: Float  # (K,3) positions as in `Sight`
    uv: Float  # (K,2) pixel coordinates as in `Sight`

    def joined(self, appended: InView, num: int) -> InView:
        """Return the points of this cloud (``num`` points) with those of another one appended."""
        return InView(
            self.exposure,
            np.concatenate([self.rows, num + appended.rows]),
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

        The camera pose is the recorded pose of the image. Without one it is extrapolated from the
        key sweep with the vehicle's twist. ``output.optical_flow`` adds the ``neighbours``.
        """
        exposure = _exposure(sequence, stretch, key, key, shot, settings)
        if not settings.output.optical_flow or shot.number is None:
            return exposure
        neighbours: dict[str, Exposure] = {}
        stamps_ns = sequence.image_stamps_ns(shot.camera.name)
        numbers = list(stamps_ns)
        index = numbers.index(shot.number)
        sweeps_ns = np.array([s.sweep.stamp_ns for s in stretch.sweeps])
        for name, row in (("previous", index - 1), ("next", index + 1)):
            if not 0 <= row < len(numbers):
                continue
            exposed_ns = stamps_ns[numbers[row]]
            frame = stretch.frames[int(np.argmin(np.abs(sweeps_ns - exposed_ns)))]
            begin_ns, end_ns = _own_time_ns(sequence, frame)
            if begin_ns < exposed_ns <= end_ns:
                if settings.project.at == "sweep":
                    exposed_ns = stretch[frame].sweep.stamp_ns
                neighbour = Shot(shot.camera, numbers[row], exposed_ns)
                neighbours[name] = _exposure(sequence, stretch, key, frame, neighbour, settings)
        return replace(exposure, neighbours=neighbours)

    def see(self, points: Float, velocity_m_s: Float | Float32) -> Sight:
        """Project points (N,3) to the image; metres, key sweep's lidar frame at its reference time.

        Moving points advance by their velocity, (N,3) or (3,) for all, ego-motion removed, to the
        exposure. With a rolling shutter each row or column has its own exposure time. Points beside
        or behind a wide lens have no z and are not inside.
        """
        late = points + self.late_s * velocity_m_s if velocity_m_s.any() else points
        points_cam = poses.transform(self.T_cam_key, late)
        uv, inside = image_points(self.camera, points_cam)
        exposed_cam = points_cam
        last = np.array([self.camera.width_px - 1, self.camera.height_px - 1])
        time_s = np.array([self.camera.column_time_s, self.camera.row_time_s])
        for _ in range(_NUM_ROW_STEPS if self.camera.is_rolling else 0):
            pixel = np.where(np.isnan(uv), last / 2, np.clip(uv, 0, last))
            row_s = ((pixel - last / 2) * time_s).sum(axis=1, keepdims=True)
            velocity_cam = poses.rotate(self.T_cam_key, velocity_m_s.astype(np.float64))
            turn = np.hstack([-row_s * self.twist[:3], np.zeros((len(points), 3))])
            ahead = points_cam + row_s * (velocity_cam - self.twist[3:])
            exposed_cam = poses.transform_each(turn, ahead)
            uv, inside = image_points(self.camera, exposed_cam)
        return Sight(exposed_cam, uv, inside & (self.depth_m(exposed_cam) > NEAREST_M))

    def sees(self, cloud: Cloud) -> InView:
        """Return the points in the image of a cloud at the key sweep's reference time."""
        chunks = []
        for first in range(0, max(1, len(cloud)), AT_ONCE):
            chunk = slice(first, first + AT_ONCE)
            sight = self.see(cloud.points[chunk], cloud.velocity_m_s[chunk])
            inside = np.flatnonzero(sight.inside)
            columns = (column.take(inside, axis=0) for column in (sight.points_cam, sight.uv))
            chunks.append((first + inside, *columns))
        return InView(self, *(np.concatenate(column) for column in zip(*chunks, strict=True)))

    def depth_m(self, points_cam: Float) -> Float:
        """Return the (N,) depth of points (N,3), camera frame: z or range, by ``measure``."""
        return depth_along(points_cam, self.measure)


def _exposure(
    sequence: LidarSequence,
    stretch: Stretch,
    key: int,
    frame: int,
    shot: Shot,
    settings: Config,
) -> Exposure:
    """Return the exposure of a shot (as `Exposure.of`), extrapolated from sweep ``frame``."""
    camera, registered = shot.camera, stretch[frame]
    late_s = float(shot.stamp_ns - registered.sweep.stamp_ns) * 1e-9
    twist = registered.twist_before if late_s < 0 else registered.twist_after
    T_cam_lidar = camera.T_cam_lidar @ poses.inverse(poses.exp(late_s * twist))
    at_image = settings.project.at == "camera" and shot.number is not None
    if at_image and hasattr(sequence, "T_world_cam"):
        T_cam_world = poses.inverse(sequence.T_world_cam(camera.name, shot.number or 0))
        T_cam_lidar = T_cam_world @ sequence.T_world_lidar(frame)
    measure = settings.project.depth
    return Exposure(
        camera=camera,
        T_cam_key=T_cam_lidar @ stretch.T_target_source(frame, key),
        late_s=float(shot.stamp_ns - stretch[key].sweep.stamp_ns) * 1e-9,
        twist=poses.carried(camera.T_cam_lidar, twist),
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
    age_ns: Int  # (K,) time between the source sweep and the key sweep, see `_ages_ns`
    far: Bool  # (K,) True for points of sweeps beyond the window

    def take(self, rows: Int) -> PointsInImage:
        """Return the points at these indices, in their order."""
        columns: Any = (column.take(rows, axis=0) for column in self)
        return PointsInImage(*columns)


def points_in_image(cloud: Cloud, view: InView, patches: Patches) -> PointsInImage:
    """Return the points of the cloud in the view, with the patches' size and slope in pixels."""
    by_row = np.argsort(np.rint(view.uv[:, 1]).astype(np.uint16), kind="stable")
    exposure, rows = view.exposure, view.rows[by_row]
    points_cam = view.points_cam.take(by_row, axis=0)
    depth = exposure.depth_m(points_cam).astype(np.float32)
    normal = poses.rotate(exposure.T_cam_key, patches.normal.take(rows, axis=0).astype(np.float64))
    plain = exposure.camera.is_rectified and exposure.measure == "z"
    focal_px, slope, spacing_px = (_pinhole if plain else _any_lens)(
        exposure, points_cam, depth, normal, patches.spacing_m.take(rows, axis=0)
    )
    frame, far = cloud.frame[rows], cloud.far[rows]
    return PointsInImage(
        rows=rows,
        uv=view.uv.take(by_row, axis=0),
        depth=depth,
        inverse=1 / depth.astype(np.float64),
        focal_px=focal_px,
        slope=np.nan_to_num(slope, posinf=0.0, neginf=0.0),
        spacing_px=spacing_px,
        frame=frame,
        age_ns=_ages_ns(cloud.since_key_ns[rows], frame, far),
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
