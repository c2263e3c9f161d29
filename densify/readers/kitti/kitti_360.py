# SPDX-License-Identifier: MIT
"""KITTI-360 (Liao, Xie, Geiger, "KITTI-360: A Novel Dataset and Benchmarks for Urban Scene
Understanding in 2D and 3D", PAMI 2022), as downloaded; its drives are scenes::

    data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/{data/0000000000.bin, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_00/{data_rect/0000000000.png, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_02/{data_rgb/0000000000.png, timestamps.txt}
    data_poses/2013_05_28_drive_0000_sync/poses.txt
    calibration/{calib_cam_to_pose.txt, calib_cam_to_velo.txt, perspective.txt, image_02.yaml, ...}

- Frames are file numbers and files may be missing; line ``frame`` (from 0) of a timestamp file
  belongs to ``frame``. A sweep's stamp is the middle of the turn, when the scanner faces forward.
- Points are the HDL-64E's, in its frame, as measured (the data set's own tools uncurl them). A
  point's time follows from its azimuth; a turn lasts as long as it usually is from stamp to stamp.
- image_00 and image_01 are rectified pinholes; image_02 and image_03 are fisheyes to the sides, as
  they were taken: the model of Mei, of which at most 90 degrees off the axis are used.
- Poses are the vehicle's (the inertial unit's) in a world with metric, level axes. Frames at which
  it stood have none: the path is interpolated between those before and after.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import parse_yaml, read_text
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    numbered_files,
    parse_numbers,
    rigid,
    truth_beside,
)
from densify.readers.kitti.calibration import (
    Calibration,
    Stamps,
    find_sweeps,
    read_points,
    turned_ns,
    usual_period_ns,
)
from densify.readers.recorded_poses import PoseTrack

_FOLDERS = {
    "image_00": "data_rect",
    "image_01": "data_rect",
    "image_02": "data_rgb",
    "image_03": "data_rgb",
}
_HALF_VIEW_DEG = 90.0


def open_recording(path: Path, scene: str | None) -> Kitti360:
    """See `densify.readers.ReaderModule`. path: the folder that holds data_3d_raw/; scene: a drive
    such as ``2013_05_28_drive_0000_sync``."""
    names = sorted(p.parent.name for p in (path / "data_3d_raw").glob("*/velodyne_points"))
    if not names:
        raise InputError(
            f"{path}: no KITTI-360; expected data_3d_raw/ with drives that hold velodyne_points/"
        )
    return Kitti360(path, chosen_scene("kitti-360", path, scene, names))


class Kitti360(FileSequence):
    """A drive as a `LidarSequence`."""

    def __init__(self, path: Path, drive: str) -> None:
        """path: the folder that holds data_3d_raw/. Raises InputError if the drive holds no sweeps,
        or stamps, or the calibration of cameras with images, are missing or malformed."""
        velodyne = path / "data_3d_raw" / drive / "velodyne_points"
        sweeps = find_sweeps(velodyne / "data", "0000000000.bin")
        self._stamps = _stamps(velodyne)
        self._poses_file = path / "data_poses" / drive / "poses.txt"
        cameras, exposed_ns, image_files = {}, {}, {}
        for name, folder in _FOLDERS.items():
            around = path / "data_2d_raw" / drive / name
            images = numbered_files(around / folder, ".png", ".jpg")
            if images:
                stamps = _stamps(around)
                image_files[name] = images
                cameras[name] = _camera(path / "calibration", name)
                exposed_ns[name] = {f: ns for f in images if (ns := stamps.get(f)) is not None}
        super().__init__(
            drive,
            path,
            tuple(sweeps),
            cameras,
            exposed_ns,
            truth_beside(velodyne.parent),
            sweeps,
            image_files,
        )

    def stamp_ns(self, frame: int) -> int:
        """When the scanner faced forward."""
        self.check_frame(frame)
        return self._stamps[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        columns = read_points(self._files[frame])
        points = columns[:, :3].astype(np.float64)
        offset_ns = turned_ns(points, self._revolution_ns)
        return self._files[frame], Returns(points, columns[:, 3], offset_ns)

    def _pose(self, frame: int) -> Float:
        if not self._poses_file.exists():
            return super()._pose(frame)
        T_pose_lidar = _T_pose_lidar(self.where / "calibration")
        return self._track.at(self.stamp_ns(frame)) @ T_pose_lidar

    @cached_property
    def _revolution_ns(self) -> int:
        return usual_period_ns(self._stamps.lines)

    @cached_property
    def _track(self) -> PoseTrack:
        """The vehicle's, at the stamps of the sweeps of the same number."""
        stamps_ns, T_world_pose = [], []
        for number, line in enumerate(read_text(self._poses_file).splitlines(), 1):
            where = f"{self._poses_file}: line {number}"
            frame, *numbers = parse_numbers(line, where, 13)
            if not 0 <= frame < 1 << 31:
                raise InputError(f"{where}: got {frame:g}, expected the number of a frame")
            stamp_ns = self._stamps.get(int(frame))
            if stamp_ns is not None:
                stamps_ns.append(stamp_ns)
                T_world_pose.append(rigid(np.reshape(numbers, (3, 4)), where))
        return PoseTrack(
            str(self._poses_file),
            np.array(stamps_ns, np.int64),
            np.stack(T_world_pose) if T_world_pose else np.zeros((0, 4, 4)),
        )


def _stamps(folder: Path) -> Stamps:
    stamps = Stamps.read(folder / "timestamps.txt")
    if stamps is None:
        raise InputError(f"{folder / 'timestamps.txt'}: missing; expected a stamp for each frame")
    return stamps


def _T_pose_lidar(folder: Path) -> Float:
    """(4,4); the scanner is known from camera 0, which is known from the vehicle."""
    path = folder / "calib_cam_to_velo.txt"
    where = f"{path}: the transform from camera 0 to the scanner"
    T_lidar_cam = rigid(parse_numbers(read_text(path), where, 12).reshape(3, 4), where)
    to_pose = Calibration.read(folder / "calib_cam_to_pose.txt")
    return to_pose.motion("image_00") @ poses.inverse(T_lidar_cam)


def _camera(folder: Path, name: str) -> Camera:
    to_pose = Calibration.read(folder / "calib_cam_to_pose.txt")
    T_cam_lidar = poses.inverse(to_pose.motion(name)) @ _T_pose_lidar(folder)
    if _FOLDERS[name] == "data_rgb":
        return _fisheye(folder / f"{name}.yaml", name, T_cam_lidar)
    perspective = Calibration.read(folder / "perspective.txt")
    size_px = perspective.size_px(f"S_rect_{name[-2:]}")
    camera = perspective.rectified_camera(f"P_rect_{name[-2:]}", name, size_px, np.eye(4))
    R = perspective.rotation(f"R_rect_{name[-2:]}")
    return Camera(name, *size_px, camera.K, R @ T_cam_lidar)


def _fisheye(path: Path, name: str, T_cam_lidar: Float) -> Camera:
    """OpenCV writes ``%YAML:1.0`` where YAML has ``%YAML 1.0``."""
    text = read_text(path).replace("%YAML:1.0", "", 1)
    given, _ = parse_yaml(text, path)
    try:
        lens, onto = given["distortion_parameters"], given["projection_parameters"]
        numbers = [given["mirror_parameters"]["xi"], *(lens[k] for k in ("k1", "k2", "p1", "p2"))]
        fx, fy, cx, cy = (float(onto[k]) for k in ("gamma1", "gamma2", "u0", "v0"))
        distortion = tuple(float(number) for number in numbers)
        width, height = int(given["image_width"]), int(given["image_height"])
        if not np.isfinite([*distortion, fx, fy, cx, cy]).all() or min(fx, fy, width, height) <= 0:
            raise ValueError("a value is not finite or not positive")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        what = " ".join(str(error).split())
        raise InputError(
            f"{path}: {what}; expected image_width, image_height, xi, k1 k2 p1 p2, gamma1 gamma2 "
            f"u0 v0 of a fisheye as KITTI-360 has them"
        ) from None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return Camera(name, width, height, K, T_cam_lidar, distortion, "mei", _HALF_VIEW_DEG)
