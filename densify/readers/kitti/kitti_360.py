# SPDX-License-Identifier: MIT
"""Read KITTI-360 (Liao, Xie, Geiger, PAMI 2022) as downloaded; its drives are scenes.

    data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/{data/0000000000.bin, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_00/{data_rect/0000000000.png, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_02/{data_rgb/0000000000.png, timestamps.txt}
    data_poses/2013_05_28_drive_0000_sync/poses.txt
    calibration/{calib_cam_to_pose.txt, calib_cam_to_velo.txt, perspective.txt, image_02.yaml, ...}

- Frame numbers are file numbers; some are missing. Line ``frame`` (from 0) of a timestamp file is
  the stamp of ``frame``, the middle of the revolution.
- Points of the HDL-64E are not deskewed; azimuth and median period give the firing times.
- image_00 and image_01 are rectified; image_02 and image_03 are fisheyes to the sides (Mei's
  model), used up to 90 degrees off the axis.
- Poses are the GPS/IMU unit's and are interpolated, since frames at standstill have no pose.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.file_content import described_in, parse_yaml, read_text
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.kitti.drive import Calibration, Drive, read_stamps, usual_period_ns
from densify.readers.recorded_poses import PoseTrack

_FOLDERS = {
    "image_00": "data_rect",
    "image_01": "data_rect",
    "image_02": "data_rgb",
    "image_03": "data_rgb",
}
_HALF_VIEW_DEG = 90.0


def open_recording(path: Path, scene: str | None) -> Kitti360:
    """Open a drive, by its name, of the folder that contains data_3d_raw/."""
    names = sorted(p.parent.name for p in (path / "data_3d_raw").glob("*/velodyne_points"))
    none = "no KITTI-360; expected data_3d_raw/ with drives that hold velodyne_points/"
    return Kitti360(path, checks.chosen_scene("kitti-360", path, scene, names, none))


class Kitti360(Drive):
    """A KITTI-360 drive as a `LidarSequence`."""

    def __init__(self, path: Path, drive: str) -> None:
        velodyne = path / "data_3d_raw" / drive / "velodyne_points"
        around = path / "data_2d_raw" / drive
        images = {name: around / name / folder for name, folder in _FOLDERS.items()}
        super().__init__(drive, path, velodyne / "data", velodyne.parent, images)
        self._stamp_file = velodyne / "timestamps.txt"
        self._recorded_ns = read_stamps(self._stamp_file)
        self.revolution_ns = usual_period_ns(self._recorded_ns.values())
        self._pose_file = path / "data_poses" / drive / "poses.txt"
        self.cameras = {name: _camera(path / "calibration", name) for name in self._image_files}
        stamps_ns = {n: read_stamps(around / n / "timestamps.txt") for n in self._image_files}
        self._exposed_ns = {
            name: {f: stamps_ns[name][f] for f in files if f in stamps_ns[name]}
            for name, files in self._image_files.items()
        }

    def stamp_ns(self, frame: int) -> int:
        """Return the time (ns since 1970) at which the scanner faced forward in a sweep."""
        self.check_frame(frame)
        return checks.of_frame(self._recorded_ns, frame, "stamp", self._stamp_file)

    def _pose(self, frame: int) -> Float:
        if not self._pose_file.exists():
            return super()._pose(frame)
        return self._track.at(self.stamp_ns(frame)) @ _T_pose_lidar(self.where / "calibration")

    @cached_property
    def _track(self) -> PoseTrack:
        """The poses of the vehicle, each at the stamp of the sweep with the same number."""
        T_world_pose = {}
        for number, line in enumerate(read_text(self._pose_file).splitlines(), 1):
            where = f"{self._pose_file}: line {number}"
            frame, *numbers = checks.parse_numbers(line, where, 13).tolist()
            if frame in self._recorded_ns:
                stamp_ns = self._recorded_ns[int(frame)]
                T_world_pose[stamp_ns] = checks.rigid(np.reshape(numbers, (3, 4)), where)
        return PoseTrack(
            str(self._pose_file),
            np.array(list(T_world_pose), np.int64),
            np.reshape(list(T_world_pose.values()), (-1, 4, 4)),
        )


def _T_pose_lidar(folder: Path) -> Float:
    """Return the (4,4) pose of the scanner in the vehicle's frame, computed through camera 0."""
    path = folder / "calib_cam_to_velo.txt"
    where = f"{path}: the transform from camera 0 to the scanner"
    T_lidar_cam = checks.rigid(checks.parse_numbers(read_text(path), where, 12), where)
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
    """Read a fisheye camera from OpenCV's YAML, whose first line YAML libraries reject."""
    content, _ = parse_yaml(read_text(path).replace("%YAML:1.0", "", 1), path)
    with described_in(path, "image_width, image_height, xi, k1 k2 p1 p2, gamma1 gamma2 u0 v0"):
        lens, projection = content["distortion_parameters"], content["projection_parameters"]
        words = [content["image_width"], content["image_height"]]
        words += [projection[key] for key in ("gamma1", "gamma2", "u0", "v0")]
        words += [content["mirror_parameters"]["xi"], *(lens[k] for k in ("k1", "k2", "p1", "p2"))]
    text = " ".join(map(str, words))
    width, height, *numbers = checks.parse_numbers(text, str(path), 11).tolist()
    return checks.pinhole(
        name,
        (int(width), int(height)),
        numbers[:4],
        T_cam_lidar,
        str(path),
        distortion=tuple(numbers[4:]),
        model="mei",
        max_angle_deg=_HALF_VIEW_DEG,
    )
