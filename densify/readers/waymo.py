# SPDX-License-Identifier: MIT
"""Waymo Open Dataset, perception, version 2 (Sun et al., CVPR 2020), read without TensorFlow::

    ROOT/{lidar,lidar_calibration,vehicle_pose}/CONTEXT.parquet
    ROOT/{camera_image,camera_calibration}/CONTEXT.parquet    optional
    ROOT/lidar_box/CONTEXT.parquet    optional: tracked boxes, in the vehicle's frame

ROOT is ``training``, ``validation`` or ``testing``. A segment is named by ``#CONTEXT``. Frames are
numbered from 0 in the order of time, images by the number of their frame.

Five lidars, lidar 0 to 4: TOP, FRONT, SIDE_LEFT, SIDE_RIGHT, REAR. A return is a pixel of a range
image, with the azimuth by its column and the inclination by its row
(waymo_open_dataset/utils/range_image_utils.py); first and second returns follow each other. The
point is in the vehicle's frame (x forward, y left, z up) *when it was fired*: not compensated. The
columns of TOP are spread over the frame's period, from ``frame_timestamp_micros``, when the spin
begins. The other four lidars are taken as measured at the frame's pose, as in the data set's
conversion.

``vehicle_pose`` belongs to the middle of the spin: it is the pose of the FRONT camera's image
(https://github.com/waymo-research/waymo-open-dataset/issues/464). The sweep's stamp is therefore
that image's ``pose_timestamp``, or half a period after the frame's stamp where there are no images.
Intensity has no bound, so its tanh is used.

Cameras have lenses (k1 k2 p1 p2 k3, as OpenCV) and shutters that usually run sideways. The middle
of an image is exposed half-way between trigger and end of readout; its own pose, of a time close
to that, is carried there. Pixel 0 of the calibration is the left edge of the first pixel.

Built on the published formulas and documentation; not tried on real files.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Boxes, Float, Int
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    of_frame,
    scanner_axes,
    truth_beside,
)
from densify.readers.recorded_poses import PoseTrack
from densify.readers.waymo_components import (
    CAMERA,
    CAMERAS,
    LASER,
    LASERS,
    STAMP,
    Components,
    image_of,
    read_boxes,
    read_cameras,
    read_images,
    read_lasers,
    transform_of,
)

_NOMINAL_PERIOD_NS = 100_000_000


def open_recording(path: Path, scene: str | None) -> Waymo:
    """See `densify.readers.ReaderModule`. path: the folder of a split."""
    files = sorted((path / "lidar").glob("*.parquet"))
    if not files:
        raise InputError(
            f"{path / 'lidar'}: no segments; expected files such as "
            f"10017090168044687777_6380_000_6400_000.parquet"
        )
    return Waymo(path, chosen_scene("waymo", path, scene, [file.stem for file in files]))


class Waymo(FileSequence):
    """A segment as a `LidarSequence`; the lidar frame is the vehicle's."""

    def __init__(self, root: Path, context: str) -> None:
        """Read stamps, poses and calibration. Raises InputError if a component is missing or
        malformed."""
        parts = self._parts = Components(root, context)
        self._starts_us = np.unique(parts.read("lidar", {STAMP: "i"})[STAMP])
        if not len(self._starts_us):
            raise InputError(f"{parts.file('lidar')}: holds no frames")
        starts_ns = self._starts_us * 1000
        steps = np.diff(starts_ns)
        self._period_ns = int(np.median(steps)) if len(steps) else _NOMINAL_PERIOD_NS
        self._lasers = read_lasers(parts)
        has_images = parts.file("camera_image").is_file()
        self._images = read_images(parts, self._starts_us) if has_images else {}
        front = self._images.get(CAMERAS[0], {})
        self._stamps_ns = [
            front[number].pose_ns if number in front else int(ns) + self._period_ns // 2
            for number, ns in enumerate(starts_ns)
        ]
        super().__init__(
            context,
            root,
            range(len(starts_ns)),
            read_cameras(parts, self._images) if has_images else {},
            {name: {n: i.exposed_ns for n, i in of.items()} for name, of in self._images.items()},
            truth_beside(root),
        )

    def stamp_ns(self, frame: int) -> int:
        """Return about the middle of the spin, the time of the recorded pose."""
        self.check_frame(frame)
        return self._stamps_ns[frame]

    def _pose(self, frame: int) -> Float:
        return self._T_world_vehicle[frame]

    def boxes(self, frame: int) -> Boxes | None:
        """See `LidarSequence`; the test split has none. Raises InputError if they are malformed."""
        self.check_frame(frame)
        return self._boxes.get(int(self._starts_us[frame]))

    @cached_property
    def _boxes(self) -> dict[int, Boxes]:
        return read_boxes(self._parts) if self._parts.file("lidar_box").is_file() else {}

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the (4,4) pose at the exposure of the image's middle."""
        image = self._images[camera][number]
        T_world_vehicle = image.T_world_vehicle
        if len(self.frames) > 1:
            before, after = (self._track.at(ns) for ns in (image.pose_ns, image.exposed_ns))
            T_world_vehicle = T_world_vehicle @ inverse(before) @ after
        return T_world_vehicle @ inverse(self.cameras[camera].T_cam_lidar)

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path, images = self._parts.file("lidar"), self._range_images(frame)
        if not images:
            raise InputError(f"{path}: no range image of frame {frame}; fetch it again")
        points, intensity, offset_ns, lidar = [], [], [], []
        for (number, _), image in images.items():
            if number not in self._lasers:
                raise InputError(
                    f"{self._parts.file('lidar_calibration')}: no lidar {number}; got "
                    f"{', '.join(map(str, self._lasers))}"
                )
            laser, where = self._lasers[number], f"{path}: frame {frame}, lidar {number}"
            away = laser.directions(image.shape[:2], where) * image[..., :1]
            met = transform(laser.T_vehicle_laser, away.reshape(-1, 3))
            points.append(np.where(image[..., 0].ravel()[:, None] > 0, met, np.nan))
            intensity.append(np.tanh(image[..., 1].ravel()))
            offset_ns.append(self._offset_ns(frame, number, image.shape).ravel())
            lidar.append(np.full(len(met), number - 1, np.uint8))
        T = np.tile(np.eye(4), (len(LASERS), 1, 1))
        for number, laser in self._lasers.items():
            T[number - 1] = laser.T_vehicle_laser
        return path, Returns(
            np.concatenate(points),
            np.concatenate(intensity).astype(np.float32),
            np.concatenate(offset_ns),
            np.concatenate(lidar),
            T[:, :3, 3],
            scanner_axes(T),
        )

    def _range_images(self, frame: int) -> dict[tuple[int, int], Float]:
        """Return (H,W,4) by lidar and return."""
        names = {number: f"[LiDARComponent].range_image_return{number}" for number in (1, 2)}
        columns = {f"{name}.{part}": "l" for name in names.values() for part in ("values", "shape")}
        start_us = int(self._starts_us[frame])
        rows = self._parts.read("lidar", {LASER: "i", **columns}, {STAMP: start_us})
        found = {}
        for row in np.argsort(rows[LASER], kind="stable"):
            laser = int(rows[LASER][row])
            where = f"{self._parts.file('lidar')}: frame {frame}, lidar {laser}"
            if laser not in range(1, len(LASERS) + 1) or (laser, 1) in found:
                raise InputError(f"{where}: expected lidars 1 to {len(LASERS)}, each once")
            for number, name in names.items():
                values, shape = rows[f"{name}.values"][row], rows[f"{name}.shape"][row]
                if values is not None and len(values):
                    found[laser, number] = image_of(values, shape, where)
            if (laser, 1) not in found:
                raise InputError(f"{where}: no first returns; fetch the file again")
        return found

    def _offset_ns(self, frame: int, laser: int, size: tuple[int, ...]) -> Int:
        """Return (H,W) firing times since the sweep's stamp."""
        height, width = size[:2]
        if laser != 1:
            return np.zeros((height, width), np.int64)
        begin_ns = int(self._starts_us[frame]) * 1000 - self._stamps_ns[frame]
        column_ns = begin_ns + (np.arange(width) + 0.5) / width * self._period_ns
        return np.broadcast_to(np.rint(column_ns).astype(np.int64), (height, width))

    @cached_property
    def _T_world_vehicle(self) -> dict[int, Float]:
        """Poses of the vehicle by frame."""
        name = "[VehiclePoseComponent].world_from_vehicle.transform"
        rows, where = (
            self._parts.read("vehicle_pose", {STAMP: "i", name: "l"}),
            self._parts.file("vehicle_pose"),
        )
        poses = {
            int(us): transform_of(values, f"{where}: frame_timestamp_micros {us}")
            for us, values in zip(rows[STAMP], rows[name], strict=True)
        }
        of = {number: poses[int(us)] for number, us in enumerate(self._starts_us) if us in poses}
        return {frame: of_frame(of, frame, "vehicle pose", where) for frame in self.frames}

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
