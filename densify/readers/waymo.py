# SPDX-License-Identifier: MIT
"""Read the Waymo Open Dataset, perception, version 2 (Sun et al., CVPR 2020), without TensorFlow.

    ROOT/{lidar,lidar_calibration,vehicle_pose}/CONTEXT.parquet
    ROOT/{camera_image,camera_calibration,lidar_box}/CONTEXT.parquet    optional

ROOT is ``training``, ``validation`` or ``testing``. A segment is named by ``#CONTEXT``. Frames are
numbered from 0 in the order of time. An image has the number of its frame. Lidars 0 to 4 are TOP,
FRONT, SIDE_LEFT, SIDE_RIGHT, REAR. A return is a pixel of a range image: column is azimuth, row is
inclination (range_image_utils.py of the data set). First returns precede second returns. Points are
in the vehicle's frame (x forward, y left, z up) *when fired*, without compensation. The columns of
TOP are spread evenly over the frame's period from ``frame_timestamp_micros``. The other lidars'
returns are assumed to be at the sweep's stamp. Intensity has no upper bound and is mapped by tanh.

``vehicle_pose`` is the pose at the middle of the spin and equals the pose of the FRONT image (issue
464 of waymo-open-dataset). The sweep's stamp is the ``pose_timestamp`` of this image, or without
images half a period after the frame's stamp. Cameras have distortion (k1 k2 p1 p2 k3) and rolling
shutters, usually sideways. An image's pose is moved to the middle of its exposure. Coordinate 0 of
the calibration is the left edge of the first pixel. Built on published formulas; not tried on real
files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import described_in
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers import checks
from densify.readers.arrow_columns import read_parquet
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.recorded_poses import PoseTrack

_NOMINAL_PERIOD_NS = 100_000_000
OBJECT = "key.laser_object_id"
BOX_CENTRE = tuple(f"[LiDARBoxComponent].box.center.{axis}" for axis in "xyz")
BOX_SIZE = tuple(f"[LiDARBoxComponent].box.size.{axis}" for axis in "xyz")  # length, width, height
BOX_HEADING = "[LiDARBoxComponent].box.heading"
LASERS = ("TOP", "FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")
CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
STAMP, LASER, CAMERA = "key.frame_timestamp_micros", "key.laser_name", "key.camera_name"
T_OPTICAL_WAYMO = np.array(  # Waymo's camera frame is x forward, y left, z up
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
DOWN, RIGHT, UP, LEFT = 1, 2, 3, 4
"""Readout directions of a rolling shutter, as numbered in the data set."""

_LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Components:
    """The Parquet tables of the segment named ``context``; ``root`` is the split's folder."""

    root: Path
    context: str

    def file(self, component: str) -> Path:
        """Return the Parquet file of a component, such as ``lidar_box``."""
        return self.root / component / f"{self.context}.parquet"

    def read(
        self, component: str, columns: Mapping[str, str], where: Mapping[str, int] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return columns of a component; see `densify.readers.arrow_columns.read_parquet`."""
        return read_parquet(self.file(component), columns, "Waymo recordings", where)


class Laser(NamedTuple):
    """The calibration of a lidar."""

    T_vehicle_laser: Float  # (4,4) pose of the lidar in the vehicle's frame
    # (H,) inclinations of the beams, from the lowest beam up; None for beams spread evenly between
    # ``bounds_rad``
    inclinations_rad: Float | None
    # Inclinations of the lower and upper limit of the field of view
    bounds_rad: tuple[float, float]

    def directions(self, size: tuple[int, ...]) -> Float:
        """Return the ray directions of an (H,W) range image, (H,W,3) unit vectors, lidar frame."""
        (height, width), beams = size, self.inclinations_rad
        if beams is None:
            low, high = self.bounds_rad
            beams = (np.arange(height) + 0.5) / height * (high - low) + low
        T = self.T_vehicle_laser
        turned_rad = np.arctan2(T[1, 0], T[0, 0])
        azimuth = ((np.arange(width, 0, -1) - 0.5) / width * 2 - 1) * np.pi - turned_rad
        rise = beams[::-1, None]
        x, y = np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise)
        return np.stack([x, y, np.broadcast_to(np.sin(rise), x.shape)], axis=2)


class Image(NamedTuple):
    """The times and the pose of an image."""

    pose_ns: int  # time of the pose ``T_world_vehicle``
    exposed_ns: int  # exposure time of the middle row or column
    readout_s: float  # time between the exposures of the first and the last row or column
    T_world_vehicle: Float  # (4,4) pose of the vehicle in the world


def read_lasers(files: Components) -> dict[int, Laser]:
    """Return the lidars' calibrations by Waymo's number, from 1 (TOP)."""
    head = "[LiDARCalibrationComponent]"
    extrinsic, beams = f"{head}.extrinsic.transform", f"{head}.beam_inclination"
    columns = {LASER: "i", extrinsic: "l", f"{beams}.values": "l"}
    rows = files.read("lidar_calibration", {**columns, f"{beams}.min": "m", f"{beams}.max": "m"})
    lasers = {}
    for row, laser in enumerate(rows[LASER].tolist()):
        where = f"{files.file('lidar_calibration')}: lidar {laser}"
        values = rows[f"{beams}.values"][row]
        low, high = float(rows[f"{beams}.min"][row]), float(rows[f"{beams}.max"][row])
        beams_rad = None if values is None or not len(values) else values.astype(np.float64)
        if not np.isfinite((low, high) if beams_rad is None else beams_rad).all():
            raise InputError(f"{where}: got beams that are not finite, expected rad")
        lasers[laser] = Laser(checks.rigid(rows[extrinsic][row], where), beams_rad, (low, high))
    return lasers


def read_boxes(files: Components) -> dict[int, Boxes]:
    """Return boxes by ``frame_timestamp_micros``, in the vehicle's frame at ``vehicle_pose``."""
    numbers = (*BOX_CENTRE, *BOX_SIZE, BOX_HEADING)
    rows = files.read("lidar_box", {STAMP: "i", OBJECT: "s", **dict.fromkeys(numbers, "n")})
    centre_m, size_m = (
        np.stack([rows[name].astype(np.float64) for name in names], axis=1)
        for names in (BOX_CENTRE, BOX_SIZE)
    )
    T_vehicle_box = checks.upright_poses(centre_m, rows[BOX_HEADING].astype(np.float64))
    path, boxes = files.file("lidar_box"), {}
    for us in np.unique(rows[STAMP]).tolist():
        in_sweep = rows[STAMP] == us
        where = f"{path}: frame_timestamp_micros {us}"
        boxes[us] = checks.boxes(
            rows[OBJECT][in_sweep], T_vehicle_box[in_sweep], size_m[in_sweep], where
        )
    return boxes


def read_images(files: Components, starts_us: Int) -> dict[str, dict[int, Image]]:
    """Return times and poses of images by camera name and frame number; ``starts_us`` is (n,)."""
    head = "[CameraImageComponent]"
    pose, shutter = f"{head}.pose.transform", f"{head}.rolling_shutter_params"
    times = [f"{shutter}.{name}" for name in ("camera_trigger_time", "camera_readout_done_time")]
    numbers = [f"{head}.pose_timestamp", *times, f"{shutter}.shutter"]
    columns = {STAMP: "i", CAMERA: "i", pose: "l", **dict.fromkeys(numbers, "n")}
    rows, images_of_camera = files.read("camera_image", columns), dict[str, dict[int, Image]]()
    frame_of = {int(us): number for number, us in enumerate(starts_us)}
    name_of = dict(enumerate(CAMERAS, 1))
    for row in np.argsort(rows[STAMP], kind="stable").tolist():
        name, frame = name_of[int(rows[CAMERA][row])], frame_of.get(int(rows[STAMP][row]))
        if frame is None:
            continue
        pose_s, trigger_s, done_s, shutter_s = (float(rows[name][row]) for name in numbers)
        T = checks.rigid(rows[pose][row], f"{files.file('camera_image')}: {name}, frame {frame}")
        exposed_ns = _whole_us((trigger_s + done_s) / 2)
        image = Image(_whole_us(pose_s), exposed_ns, max(done_s - trigger_s - shutter_s, 0.0), T)
        images_of_camera.setdefault(name, {})[frame] = image
    return {name: images_of_camera[name] for name in CAMERAS if name in images_of_camera}


def read_cameras(files: Components, images: Mapping[str, Mapping[int, Image]]) -> dict[str, Camera]:
    """Return the calibrated cameras that have images, by name, with their rolling shutters."""
    head = "[CameraCalibrationComponent]"
    lens = [f"{head}.intrinsic.{n}" for n in _LENS]
    size = [f"{head}.{n}" for n in ("width", "height", "rolling_shutter_direction")]
    extrinsic = f"{head}.extrinsic.transform"
    columns = {CAMERA: "i", extrinsic: "l", **dict.fromkeys(lens, "n")}
    rows = files.read("camera_calibration", {**columns, **dict.fromkeys(size, "i")})
    cameras = {}
    for name, camera_images in images.items():
        where = f"{files.file('camera_calibration')}: {name}"
        row = rows[CAMERA].tolist().index(CAMERAS.index(name) + 1)
        f_u, f_v, c_u, c_v, *distortion = (float(rows[n][row]) for n in lens)
        width, height, direction = (int(rows[n][row]) for n in size)
        readout_s = float(np.median([image.readout_s for image in camera_images.values()]))
        T_cam_vehicle = T_OPTICAL_WAYMO @ inverse(checks.rigid(rows[extrinsic][row], where))
        cameras[name] = checks.pinhole(
            name,
            (width, height),
            (f_u, f_v, c_u - 0.5, c_v - 0.5),
            T_cam_vehicle,
            where,
            distortion=tuple(distortion) if any(distortion) else (),
            row_time_s={DOWN: 1.0, UP: -1.0}.get(direction, 0.0) * readout_s / max(height, 1),
            column_time_s={RIGHT: 1.0, LEFT: -1.0}.get(direction, 0.0) * readout_s / max(width, 1),
        )
    return cameras


def _whole_us(seconds: float) -> int:
    """Convert seconds since 1970 to ns in whole µs; float64 resolves about 0.25 µs."""
    return round(seconds * 1e6) * 1000


def open_recording(path: Path, scene: str | None) -> Waymo:
    """Open a segment (CONTEXT) of the folder of a split, such as ``training``."""
    names = sorted(file.stem for file in (path / "lidar").glob("*.parquet"))
    none = (
        "no segments; expected files such as lidar/10017090168044687777_6380_000_6400_000.parquet"
    )
    return Waymo(path, checks.chosen_scene("waymo", path, scene, names, none))


class Waymo(FileSequence):
    """A Waymo segment in the vehicle's frame, stamped at the recorded pose, about mid-spin."""

    def __init__(self, root: Path, context: str) -> None:
        files = self._parts = Components(root, context)
        self._starts_us = np.unique(files.read("lidar", {STAMP: "i"})[STAMP])
        if not len(self._starts_us):
            raise InputError(f"{files.file('lidar')}: holds no frames")
        starts_ns = self._starts_us * 1000
        steps = np.diff(starts_ns)
        self._period_ns = int(np.median(steps)) if len(steps) else _NOMINAL_PERIOD_NS
        has_images = files.file("camera_image").is_file()
        with described_in(root, f"calibration and images of {context} in the data set's own form"):
            self._lasers = read_lasers(files)
            self._images = read_images(files, self._starts_us) if has_images else {}
            cameras = read_cameras(files, self._images) if has_images else {}
        front = self._images.get(CAMERAS[0], {})
        self._stamps_ns = [
            front[number].pose_ns if number in front else int(ns) + self._period_ns // 2
            for number, ns in enumerate(starts_ns)
        ]
        super().__init__(
            context,
            root,
            range(len(starts_ns)),
            cameras,
            {
                name: {n: i.exposed_ns for n, i in shots.items()}
                for name, shots in self._images.items()
            },
            checks.truth_beside(root),
        )

    def _pose(self, frame: int) -> Float:
        return self._T_world_vehicle[frame]

    def boxes(self, frame: int) -> Boxes | None:
        """Return a sweep's boxes in the vehicle's frame; None if not annotated (test split)."""
        self.check_frame(frame)
        return self._boxes.get(int(self._starts_us[frame]))

    @cached_property
    def _boxes(self) -> dict[int, Boxes]:
        return read_boxes(self._parts) if self._parts.file("lidar_box").is_file() else {}

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the pose T_world_cam (4,4) at the middle of the exposure of image ``number``."""
        image = self._images[camera][number]
        T_world_vehicle = image.T_world_vehicle
        if len(self.frames) > 1:
            before, after = (self._track.at(ns) for ns in (image.pose_ns, image.exposed_ns))
            T_world_vehicle = T_world_vehicle @ inverse(before) @ after
        return T_world_vehicle @ inverse(self.cameras[camera].T_cam_lidar)

    def _returns(self, frame: int) -> Returns:
        points, intensity, offset_ns, lidar = [], [], [], []
        for (number, _), image in self._range_images(frame).items():
            laser = self._lasers[number]
            away = laser.directions(image.shape[:2]) * image[..., :1]
            met = transform(laser.T_vehicle_laser, away.reshape(-1, 3))
            points.append(np.where(image[..., 0].ravel()[:, None] > 0, met, np.nan))
            intensity.append(np.tanh(image[..., 1].ravel()))
            offset_ns.append(self._offset_ns(frame, number, image.shape).ravel())
            lidar.append(np.full(len(met), number - 1, np.uint8))
        T = np.tile(np.eye(4), (len(LASERS), 1, 1))
        for number, laser in self._lasers.items():
            T[number - 1] = laser.T_vehicle_laser
        return Returns(
            np.concatenate(points),
            np.concatenate(intensity).astype(np.float32),
            np.concatenate(offset_ns),
            np.concatenate(lidar),
            T[:, :3, 3],
            checks.scanner_axes(T),
        )

    def _range_images(self, frame: int) -> dict[tuple[int, int], Float]:
        """Return (H,W,4) by lidar and return, from 1; channels: range (m), intensity, 2 unused."""
        names = {number: f"[LiDARComponent].range_image_return{number}" for number in (1, 2)}
        columns = {f"{name}.{key}": "l" for name in names.values() for key in ("values", "shape")}
        start_us = int(self._starts_us[frame])
        rows = self._parts.read("lidar", {LASER: "i", **columns}, {STAMP: start_us})
        range_images = {}
        for row in np.argsort(rows[LASER], kind="stable"):
            for number, name in names.items():
                values, shape = rows[f"{name}.values"][row], rows[f"{name}.shape"][row]
                if values is not None and len(values):
                    height, width, num = shape.tolist()
                    image = values.reshape(height, width, num).astype(np.float64)
                    range_images[int(rows[LASER][row]), number] = image
        return range_images

    def _offset_ns(self, frame: int, laser: int, size: tuple[int, ...]) -> Int:
        """Return firing times (H,W) in ns since the sweep's stamp, 0 for lidars other than TOP."""
        height, width = size[:2]
        if laser != 1:
            return np.zeros((height, width), np.int64)
        begin_ns = int(self._starts_us[frame]) * 1000 - self._stamps_ns[frame]
        column_ns = begin_ns + (np.arange(width) + 0.5) / width * self._period_ns
        return np.broadcast_to(np.rint(column_ns).astype(np.int64), (height, width))

    @cached_property
    def _T_world_vehicle(self) -> dict[int, Float]:
        """Poses T_world_vehicle (4,4) of the vehicle at the sweeps' stamps, by frame."""
        name = "[VehiclePoseComponent].world_from_vehicle.transform"
        rows, where = (
            self._parts.read("vehicle_pose", {STAMP: "i", name: "l"}),
            self._parts.file("vehicle_pose"),
        )
        poses = {
            int(us): checks.rigid(values, f"{where}: frame_timestamp_micros {us}")
            for us, values in zip(rows[STAMP], rows[name], strict=True)
        }
        T_of = {number: poses[int(us)] for number, us in enumerate(self._starts_us) if us in poses}
        return {frame: checks.of_frame(T_of, frame, "vehicle pose", where) for frame in self.frames}

    @cached_property
    def _track(self) -> PoseTrack:
        T = np.stack([self._T_world_vehicle[frame] for frame in self.frames])
        path = self._parts.file("vehicle_pose")
        return PoseTrack(str(path), np.array(self._stamps_ns, np.int64), T)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        name = "[CameraImageComponent].image"
        where = {STAMP: int(self._starts_us[number]), CAMERA: CAMERAS.index(camera) + 1}
        rows = self._parts.read("camera_image", {name: "b"}, where)
        return self._parts.file("camera_image"), rows[name][0]
