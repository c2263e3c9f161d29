# SPDX-License-Identifier: MIT
"""Read the Waymo Open Dataset, perception, version 2 (Sun et al., CVPR 2020), without TensorFlow.

    ROOT/{lidar,lidar_calibration,vehicle_pose}/CONTEXT.parquet
    ROOT/{camera_image,camera_calibration,lidar_box}/CONTEXT.parquet    optional

ROOT is ``training``, ``validation`` or ``testing``; ``#CONTEXT`` names a segment. Frames, and their
images, are numbered by time from 0. Lidars 0 to 4 are TOP, FRONT, SIDE_LEFT, SIDE_RIGHT, REAR. A
return is a pixel of a range image: column is azimuth, row is inclination (range_image_utils.py of
the data set). First returns precede second returns. Points are in the vehicle's frame (x forward, y
left, z up) *when fired*, without compensation. TOP's columns are spread evenly over the frame's
period from ``frame_timestamp_micros``; other lidars' returns are assumed to be at the stamp.

``vehicle_pose`` is at the middle of the spin and equals the pose of the FRONT image (issue 464 of
waymo-open-dataset). The stamp is this image's ``pose_timestamp``, or without images half a period
after the frame's. Cameras have distortion (k1 k2 p1 p2 k3) and rolling shutters, usually sideways;
poses are moved to the middle of the exposure. Calibrated coordinate 0 is the left edge of the first
pixel. Built on published formulas; not tried on real files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import described_in
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers import checks
from densify.readers.decoded_files import read_arrow
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.recorded_poses import PoseTrack

_NOMINAL_PERIOD_NS = 100_000_000
LASERS = ("TOP", "FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")
CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
T_OPTICAL_WAYMO = np.array(  # Waymo's camera frame is x forward, y left, z up
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_READOUT = {1: (0.0, 1.0), 2: (1.0, 0.0), 3: (0.0, -1.0), 4: (-1.0, 0.0)}
"""Direction x, y in the image of a rolling shutter's readout: down, right, up, left."""

STAMP, LASER, CAMERA = "key.frame_timestamp_micros", "key.laser_name", "key.camera_name"
OBJECT = "key.laser_object_id"
_LENS = tuple(f"intrinsic.{n}" for n in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"))
_SIZE = ("width", "height", "rolling_shutter_direction")


def full_name(component: str, column: str) -> str:
    """Return the name of a column in its file, such as ``[LiDARBoxComponent].box.heading``."""
    words = ("LiDAR" if word == "lidar" else word.capitalize() for word in component.split("_"))
    return column if column.startswith("key.") else f"[{''.join(words)}Component].{column}"


class Segment(NamedTuple):
    """The Parquet tables of the segment named ``context`` in the split's folder ``root``."""

    root: Path
    context: str

    def file(self, component: str) -> Path:
        """Return the Parquet file of a component, such as ``lidar_box``."""
        return self.root / component / f"{self.context}.parquet"

    def read(
        self, component: str, kinds: Mapping[str, str], where: Mapping[str, int] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return columns (N,) by short name, with the arguments of `read_arrow`."""
        full_kinds = {full_name(component, name): kind for name, kind in kinds.items()}
        path, data_set = self.file(component), ("waymo", "Waymo recordings")
        columns = read_arrow(path, full_kinds, data_set, where)
        return dict(zip(kinds, columns.values(), strict=True))


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
        # Azimuths of pixel centres fall from pi to -pi in the vehicle's axes, in which the lidar's
        # x axis points to mount_rad.
        mount_rad = np.arctan2(T[1, 0], T[0, 0])
        azimuth = ((np.arange(width, 0, -1) - 0.5) / width * 2 - 1) * np.pi - mount_rad
        inclination = beams[::-1, None]  # the first row is the highest beam
        x = np.cos(azimuth) * np.cos(inclination)
        y = np.sin(azimuth) * np.cos(inclination)
        return np.stack([x, y, np.broadcast_to(np.sin(inclination), x.shape)], axis=2)


class Image(NamedTuple):
    """The times and the pose of an image."""

    pose_ns: int  # time of the pose ``T_world_vehicle``
    exposed_ns: int  # exposure time of the middle row or column
    readout_s: float  # time between the exposures of the first and the last row or column
    T_world_vehicle: Float  # (4,4) pose of the vehicle in the world


def _read_lasers(segment: Segment) -> dict[int, Laser]:
    """Return the lidars' calibrations by Waymo's number, from 1 (TOP)."""
    beams, low, high = (f"beam_inclination.{key}" for key in ("values", "min", "max"))
    kinds = {LASER: "i", "extrinsic.transform": "l", beams: "l", low: "m", high: "m"}
    columns = segment.read("lidar_calibration", kinds)
    lasers = {}
    for number, T, values, *bounds in zip(*columns.values(), strict=True):
        where = f"{segment.file('lidar_calibration')}: lidar {number}"
        beams_rad = None if values is None or not len(values) else values.astype(np.float64)
        if not np.isfinite(bounds if beams_rad is None else beams_rad).all():
            raise InputError(f"{where}: got beams that are not finite, expected rad")
        bounds_rad = float(bounds[0]), float(bounds[1])
        lasers[int(number)] = Laser(checks.pose(T, where), beams_rad, bounds_rad)
    return lasers


def _read_images(segment: Segment, starts_us: Int) -> dict[str, dict[int, Image]]:
    """Return times and poses of images by camera and frame. ``starts_us`` (n,) are of frames."""
    keys = ("shutter", "camera_trigger_time", "camera_readout_done_time")
    seconds = ("pose_timestamp", *(f"rolling_shutter_params.{key}" for key in keys))
    kinds = {STAMP: "i", CAMERA: "i", "pose.transform": "l", **dict.fromkeys(seconds, "n")}
    columns = segment.read("camera_image", kinds)
    frame_of_start = {int(us): frame for frame, us in enumerate(starts_us)}
    images_of_camera: dict[str, dict[int, Image]] = {name: {} for name in CAMERAS}
    for us, camera, T, *times_s in sorted(zip(*columns.values(), strict=True), key=itemgetter(0)):
        if (frame := frame_of_start.get(int(us))) is not None:
            pose_s, shutter_s, trigger_s, done_s = map(float, times_s)
            name = dict(enumerate(CAMERAS, 1))[int(camera)]
            where = f"{segment.file('camera_image')}: {name}, frame {frame}"
            images_of_camera[name][frame] = Image(
                pose_ns=_whole_us(pose_s),
                exposed_ns=_whole_us((trigger_s + done_s) / 2),
                readout_s=max(done_s - trigger_s - shutter_s, 0.0),
                T_world_vehicle=checks.pose(T, where),
            )
    return {name: images for name, images in images_of_camera.items() if images}


def _read_cameras(
    segment: Segment, images: Mapping[str, Mapping[int, Image]]
) -> Iterator[tuple[str, Camera]]:
    """Yield the calibrated cameras that have images, with their names and rolling shutters."""
    kinds = {CAMERA: "i", "extrinsic.transform": "l"}
    kinds |= {**dict.fromkeys(_LENS, "n"), **dict.fromkeys(_SIZE, "i")}
    columns = segment.read("camera_calibration", kinds)
    for name, camera_images in images.items():
        where = f"{segment.file('camera_calibration')}: {name}"
        row = columns[CAMERA].tolist().index(CAMERAS.index(name) + 1)
        f_u, f_v, c_u, c_v, *distortion = (float(columns[key][row]) for key in _LENS)
        width, height, direction = (int(columns[key][row]) for key in _SIZE)
        readout_s = float(np.median([image.readout_s for image in camera_images.values()]))
        x, y = _READOUT.get(direction, (0.0, 0.0))
        T_vehicle_cam = checks.pose(columns["extrinsic.transform"][row], where)
        camera = checks.pinhole(
            name,
            (width, height),
            (f_u, f_v, c_u - 0.5, c_v - 0.5),
            T_OPTICAL_WAYMO @ inverse(T_vehicle_cam),
            where,
            distortion=tuple(distortion) if any(distortion) else (),
            row_time_s=y * readout_s / max(height, 1),
            column_time_s=x * readout_s / max(width, 1),
        )
        yield name, camera


def _whole_us(seconds: float) -> int:
    """Convert seconds since 1970 to ns, rounded to µs, because float64 resolves about 0.25 µs."""
    return round(seconds * 1e6) * 1000


def open_recording(path: Path, scene: str | None) -> Waymo:
    """Return the segment ``scene`` (CONTEXT) of a split's folder, the only segment for None."""
    names = sorted(file.stem for file in (path / "lidar").glob("*.parquet"))
    example = "lidar/10017090168044687777_6380_000_6400_000.parquet"
    none = f"no segments; expected files such as {example}"
    return Waymo(path, checks.chosen_scene("waymo", path, scene, names, none))


class Waymo(FileSequence):
    """A Waymo segment in the vehicle's frame, stamped at the recorded pose, about mid-spin."""

    def __init__(self, root: Path, context: str) -> None:
        segment = self._segment = Segment(root, context)
        self._starts_us = np.unique(segment.read("lidar", {STAMP: "i"})[STAMP])
        if not len(self._starts_us):
            raise InputError(f"{segment.file('lidar')}: holds no frames")
        starts_ns = self._starts_us * 1000
        steps_ns = np.diff(starts_ns)
        self._period_ns = int(np.median(steps_ns)) if len(steps_ns) else _NOMINAL_PERIOD_NS
        has_images = segment.file("camera_image").is_file()
        with described_in(root, f"calibration and images of {context} in the data set's own form"):
            self._lasers = _read_lasers(segment)
            self._images = _read_images(segment, self._starts_us) if has_images else {}
            cameras = dict(_read_cameras(segment, self._images)) if has_images else {}
        front = self._images.get(CAMERAS[0], {})
        self._stamps_ns = [
            front[frame].pose_ns if frame in front else int(ns) + self._period_ns // 2
            for frame, ns in enumerate(starts_ns)
        ]
        exposed_ns = {
            name: {frame: image.exposed_ns for frame, image in images.items()}
            for name, images in self._images.items()
        }
        frames, truth = range(len(starts_ns)), checks.truth_beside(root)
        super().__init__(context, root, frames, cameras, exposed_ns, truth)

    def _pose(self, frame: int) -> Float:
        return self._T_world_vehicle[frame]

    def boxes(self, frame: int) -> Boxes | None:
        """Return a sweep's boxes in the vehicle's frame, or None without annotations for it."""
        self.check_frame(frame)
        return self._boxes.get(int(self._starts_us[frame]))

    @cached_property
    def _boxes(self) -> dict[int, Boxes]:
        """Boxes by ``frame_timestamp_micros``, in the vehicle's frame at ``vehicle_pose``."""
        path = self._segment.file("lidar_box")
        if not path.is_file():
            return {}
        numbers = [f"box.{key}.{axis}" for key in ("center", "size") for axis in "xyz"]
        kinds = {STAMP: "i", OBJECT: "s", **dict.fromkeys((*numbers, "box.heading"), "n")}
        columns = self._segment.read("lidar_box", kinds)
        values = np.stack([columns[name] for name in numbers], axis=1).astype(np.float64)
        centre_m, size_m = np.hsplit(values, 2)
        T_vehicle_box = checks.upright_poses(centre_m, columns["box.heading"].astype(np.float64))
        boxes = {}
        for us in np.unique(columns[STAMP]).tolist():
            rows, where = columns[STAMP] == us, f"{path}: frame_timestamp_micros {us}"
            names = columns[OBJECT][rows]
            boxes[us] = checks.boxes(names, T_vehicle_box[rows], size_m[rows], where)
        return boxes

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the (4,4) pose T_world_cam at the middle of the exposure of image ``number``."""
        image = self._images[camera][number]
        T_world_vehicle = image.T_world_vehicle
        if len(self.frames) > 1:
            T_at_pose, T_exposed = (self._track.at(ns) for ns in (image.pose_ns, image.exposed_ns))
            T_world_vehicle = T_world_vehicle @ inverse(T_at_pose) @ T_exposed
        return T_world_vehicle @ inverse(self.cameras[camera].T_cam_lidar)

    def _returns(self, frame: int) -> Returns:
        begin_ns = int(self._starts_us[frame]) * 1000 - self._stamps_ns[frame]
        points, intensity, offset_ns, lidar = [], [], [], []
        for number, image in self._range_images(frame):
            laser, (height, width) = self._lasers[number], image.shape[:2]
            rays = laser.directions(image.shape[:2]) * image[..., :1]
            in_vehicle = transform(laser.T_vehicle_laser, rays.reshape(-1, 3))
            points.append(np.where(image[..., 0].reshape(-1, 1) > 0, in_vehicle, np.nan))
            intensity.append(np.tanh(image[..., 1].ravel()))
            column_ns = begin_ns + (np.arange(width) + 0.5) / width * self._period_ns
            if number != 1:  # other lidars than TOP are assumed to fire at the stamp
                column_ns = np.zeros(width)
            offset_ns.append(np.tile(np.rint(column_ns).astype(np.int64), height))
            lidar.append(np.full(len(in_vehicle), number - 1, np.uint8))
        # Lidars without a calibration keep the identity.
        T = np.tile(np.eye(4), (len(LASERS), 1, 1))
        for number, laser in self._lasers.items():
            T[number - 1] = laser.T_vehicle_laser
        return Returns(
            np.concatenate(points),
            np.concatenate(intensity).astype(np.float32),
            np.concatenate(offset_ns),
            lidar=np.concatenate(lidar),
            scanner_origins=T[:, :3, 3],
            R_scanner_lidar=checks.scanner_axes(T),
        )

    def _range_images(self, frame: int) -> Iterator[tuple[int, Float]]:
        """Yield lidar, from 1, and range image (H,W,4): range (m), intensity and two unused."""
        names = [f"range_image_return{n}.{key}" for n in (1, 2) for key in ("values", "shape")]
        kinds = {LASER: "i", **dict.fromkeys(names, "l")}
        columns = self._segment.read("lidar", kinds, {STAMP: int(self._starts_us[frame])})
        for laser, *returns in sorted(zip(*columns.values(), strict=True), key=itemgetter(0)):
            for values, shape in zip(returns[::2], returns[1::2], strict=True):
                if values is not None and len(values):
                    height, width, num_channels = shape.tolist()
                    image = values.reshape(height, width, num_channels)
                    yield int(laser), image.astype(np.float64)

    @cached_property
    def _T_world_vehicle(self) -> Float:
        """(F,4,4) poses T_world_vehicle of the vehicle at the stamps of the F sweeps."""
        where = self._segment.file("vehicle_pose")
        kinds = {STAMP: "i", "world_from_vehicle.transform": "l"}
        columns = self._segment.read("vehicle_pose", kinds)
        T_of_start = {
            int(us): checks.pose(values, f"{where}: frame_timestamp_micros {us}")
            for us, values in zip(*columns.values(), strict=True)
        }
        T_of_frame = {f: T_of_start[us] for f, us in enumerate(self._starts_us) if us in T_of_start}
        return np.stack(
            [checks.find_entry(T_of_frame, f, "vehicle pose", where) for f in self.frames]
        )

    @cached_property
    def _track(self) -> PoseTrack:
        path = self._segment.file("vehicle_pose")
        return PoseTrack(str(path), np.array(self._stamps_ns, np.int64), self._T_world_vehicle)

    def _image(self, camera: Camera, number: int) -> NDArray[np.uint8]:
        where = {CAMERA: CAMERAS.index(camera.name) + 1, STAMP: int(self._starts_us[number])}
        columns = self._segment.read("camera_image", {"image": "b"}, where)
        return checks.decode_rgb(columns["image"][0], camera, self._segment.file("camera_image"))
