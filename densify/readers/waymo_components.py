# SPDX-License-Identifier: MIT
"""The component tables of Waymo's version 2: calibration of lidars and cameras, poses and times of
the images, boxes. See `densify.readers.waymo`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers.arrow_columns import read_parquet
from densify.readers.file_sequence import checked_boxes, pinhole, rigid, upright_poses

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
"""Directions of a rolling shutter."""

_LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Components:
    """The tables of one segment. root: folder of the split."""

    root: Path
    context: str

    def file(self, component: str) -> Path:
        return self.root / component / f"{self.context}.parquet"

    def read(
        self, component: str, columns: Mapping[str, str], where: Mapping[str, int] | None = None
    ) -> dict[str, NDArray[Any]]:
        """See `densify.readers.arrow_columns.read_parquet`."""
        return read_parquet(self.file(component), columns, "Waymo recordings", where)


class Laser(NamedTuple):
    """T_vehicle_laser: (4,4). inclinations_rad: from the lowest beam up, or None for beams spread
    evenly between ``bounds_rad``."""

    T_vehicle_laser: Float
    inclinations_rad: Float | None
    bounds_rad: tuple[float, float]

    def directions(self, size: tuple[int, ...], where: str) -> Float:
        """Return (H,W,3) unit vectors in the laser's frame of the pixels of a range image."""
        (height, width), beams = size, self.inclinations_rad
        if beams is None:
            low, high = self.bounds_rad
            beams = (np.arange(height) + 0.5) / height * (high - low) + low
        if len(beams) != height:
            raise InputError(
                f"{where}: got {height} rows, expected {len(beams)} as lidar_calibration has beams"
            )
        T = self.T_vehicle_laser
        turned_rad = np.arctan2(T[1, 0], T[0, 0])
        azimuth = ((np.arange(width, 0, -1) - 0.5) / width * 2 - 1) * np.pi - turned_rad
        rise = beams[::-1, None]
        x, y = np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise)
        return np.stack([x, y, np.broadcast_to(np.sin(rise), x.shape)], axis=2)


class Image(NamedTuple):
    """pose_ns: time of T_world_vehicle (4,4). exposed_ns: of its middle. readout_s: from the first
    row or column to the last."""

    pose_ns: int
    exposed_ns: int
    readout_s: float
    T_world_vehicle: Float


def read_lasers(parts: Components) -> dict[int, Laser]:
    """Return the lidars by number, from 1. Raises InputError if one is malformed."""
    head = "[LiDARCalibrationComponent]"
    extrinsic, beams = f"{head}.extrinsic.transform", f"{head}.beam_inclination"
    columns = {LASER: "i", extrinsic: "l", f"{beams}.values": "l"}
    rows = parts.read("lidar_calibration", {**columns, f"{beams}.min": "m", f"{beams}.max": "m"})
    lasers = {}
    for row, laser in enumerate(rows[LASER].tolist()):
        where = f"{parts.file('lidar_calibration')}: lidar {laser}"
        values = rows[f"{beams}.values"][row]
        low, high = float(rows[f"{beams}.min"][row]), float(rows[f"{beams}.max"][row])
        given = values is not None and len(values) > 0
        if not (np.isfinite(values).all() if given else -np.inf < low < high < np.inf):
            raise InputError(
                f"{where}: got beams from {low:g} to {high:g}, expected inclinations in rad"
            )
        T_vehicle_laser = transform_of(rows[extrinsic][row], where)
        beams_rad = values.astype(np.float64) if given else None
        lasers[laser] = Laser(T_vehicle_laser, beams_rad, (low, high))
    return lasers


def read_boxes(parts: Components) -> dict[int, Boxes]:
    """Return the boxes by the frame's stamp in µs, in the vehicle's frame at its pose. Frames
    without boxes are not there. Raises InputError if the component is malformed."""
    numbers = (*BOX_CENTRE, *BOX_SIZE, BOX_HEADING)
    rows = parts.read("lidar_box", {STAMP: "i", OBJECT: "s", **dict.fromkeys(numbers, "n")})
    centre_m, size_m = (
        np.stack([rows[name].astype(np.float64) for name in names], axis=1)
        for names in (BOX_CENTRE, BOX_SIZE)
    )
    T_vehicle_box = upright_poses(centre_m, rows[BOX_HEADING].astype(np.float64))
    path, found = parts.file("lidar_box"), {}
    for us in np.unique(rows[STAMP]).tolist():
        mine = rows[STAMP] == us
        where = f"{path}: frame_timestamp_micros {us}"
        found[us] = checked_boxes(rows[OBJECT][mine], T_vehicle_box[mine], size_m[mine], where)
    return found


def read_images(parts: Components, starts_us: Int) -> dict[str, dict[int, Image]]:
    """Return times and poses of the images, without pixels, by camera and frame number.

    starts_us: (n,) stamps of the frames. Raises InputError if a row is malformed.
    """
    head = "[CameraImageComponent]"
    pose, shutter = f"{head}.pose.transform", f"{head}.rolling_shutter_params"
    times = [f"{shutter}.{name}" for name in ("camera_trigger_time", "camera_readout_done_time")]
    numbers = [f"{head}.pose_timestamp", *times, f"{shutter}.shutter"]
    columns = {STAMP: "i", CAMERA: "i", pose: "l", **dict.fromkeys(numbers, "n")}
    rows, found = parts.read("camera_image", columns), dict[str, dict[int, Image]]()
    frame_of = {int(us): number for number, us in enumerate(starts_us)}
    for row in np.argsort(rows[STAMP], kind="stable").tolist():
        camera, frame = int(rows[CAMERA][row]), frame_of.get(int(rows[STAMP][row]))
        where = f"{parts.file('camera_image')}: camera {camera}, frame {frame}"
        if camera not in range(1, len(CAMERAS) + 1):
            raise InputError(f"{where}: got camera {camera}, expected 1 to {len(CAMERAS)}")
        if frame is None:
            continue
        pose_s, trigger_s, done_s, shutter_s = (float(rows[name][row]) for name in numbers)
        readout_s = done_s - trigger_s - shutter_s
        if not -1e-3 < readout_s < 1:
            raise InputError(
                f"{where}: got {readout_s:g} s from trigger to end of readout less the shutter's "
                f"time, expected 0 to 1"
            )
        T = transform_of(rows[pose][row], where)
        exposed_ns = _whole_us((trigger_s + done_s) / 2)
        image = Image(_whole_us(pose_s), exposed_ns, max(readout_s, 0.0), T)
        found.setdefault(CAMERAS[camera - 1], {})[frame] = image
    return {name: found[name] for name in CAMERAS if name in found}


def read_cameras(parts: Components, images: Mapping[str, Mapping[int, Image]]) -> dict[str, Camera]:
    """Return the cameras that have images. Raises InputError if one is malformed."""
    head = "[CameraCalibrationComponent]"
    lens = [f"{head}.intrinsic.{n}" for n in _LENS]
    size = [f"{head}.{n}" for n in ("width", "height", "rolling_shutter_direction")]
    extrinsic = f"{head}.extrinsic.transform"
    columns = {CAMERA: "i", extrinsic: "l", **dict.fromkeys(lens, "n")}
    rows = parts.read("camera_calibration", {**columns, **dict.fromkeys(size, "i")})
    cameras = {}
    for name, taken in images.items():
        where = f"{parts.file('camera_calibration')}: {name}"
        row = np.flatnonzero(rows[CAMERA] == CAMERAS.index(name) + 1)
        if len(row) != 1:
            raise InputError(f"{where}: got {len(row)} rows, expected one")
        f_u, f_v, c_u, c_v, *distortion = (float(rows[n][row[0]]) for n in lens)
        width, height, direction = (int(rows[n][row[0]]) for n in size)
        readout_s = float(np.median([image.readout_s for image in taken.values()]))
        T_cam_vehicle = T_OPTICAL_WAYMO @ inverse(transform_of(rows[extrinsic][row[0]], where))
        cameras[name] = pinhole(
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
    """Return nanoseconds; seconds since 1970 as float64 are good to 0.25 µs."""
    return round(seconds * 1e6) * 1000


def image_of(values: NDArray[Any], shape: NDArray[Any] | None, where: str) -> Float:
    """Return the (H,W,4) of a flattened one."""
    size = () if shape is None else tuple(int(n) for n in shape)
    if len(size) != 3 or size[2] != 4 or np.prod(size) != len(values) or min(size) < 1:
        raise InputError(
            f"{where}: got {len(values)} values for an image of shape {size}, expected (H, W, 4)"
        )
    return values.reshape(size).astype(np.float64)


def transform_of(values: NDArray[Any] | None, where: str) -> Float:
    """Return the (4,4) of 16 numbers, row by row."""
    if values is None or values.shape != (16,):
        num = 0 if values is None else len(values)
        raise InputError(f"{where}: got a transform of {num} numbers, expected 16")
    return rigid(values.reshape(4, 4), where)
