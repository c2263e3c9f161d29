# SPDX-License-Identifier: MIT
"""Read KITTI and its relatives; the folders tell which of four data sets a path holds.

KITTI raw (Geiger et al., IJRR 2013): a drive's folder, with the calibration in its parent::

    velodyne_points/{data/0000000120.bin, timestamps.txt, timestamps_start.txt, timestamps_end.txt}
    image_02/{data/0000000120.png, timestamps.txt}   oxts/{data/0000000120.txt, timestamps.txt}

KITTI odometry (Geiger et al., CVPR 2012) and SemanticKITTI (Behley et al., ICCV 2019)::

    sequences/00/{velodyne/000000.bin, image_2/000000.png, calib.txt, times.txt}
    poses/00.txt   or SemanticKITTI's  sequences/00/poses.txt

KITTI tracking (Geiger et al., CVPR 2012), in ``training`` or ``testing``, by scene::

    velodyne/0000/000000.bin   image_02/0000/000000.png   calib/0000.txt   oxts/0000.txt
    label_02/0000.txt    optional: tracked boxes, a line for each object and frame

KITTI-360 (Liao, Xie, Geiger, PAMI 2022); its drives are scenes::

    data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/{data/0000000000.bin, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_00/{data_rect/0000000000.png, timestamps.txt}
    data_2d_raw/2013_05_28_drive_0000_sync/image_02/{data_rgb/0000000000.png, timestamps.txt}
    data_poses/2013_05_28_drive_0000_sync/poses.txt
    calibration/{calib_cam_to_pose.txt, calib_cam_to_velo.txt, perspective.txt, image_02.yaml, ...}

Frame numbers are file numbers; files may be missing. Line ``frame`` (from 0) of a file of stamps or
poses belongs to ``frame``. Without stamps frame k is at k times 100 ms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Boxes, BoxView, Camera, Float
from densify.readers import checks
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.kitti_files import (
    NOMINAL_PERIOD_NS,
    Calibration,
    Stamps,
    T_first_imu,
    parse_oxts,
    read_fisheye,
    read_labels,
    read_points,
    read_stamps,
    turned_ns,
)
from densify.readers.recorded_poses import PoseFile, PoseTrack
from densify.readers.stamped_files import StampFile

KITTI_TRIGGER_LATENCY_NS = 10_500_000
"""Lag of KITTI's recorded image stamps behind the exposure, which the scanner triggers as it faces
forward. Drives 0002 and 0013 of 2011_09_26 record 10.50 ms (image_02) and 9.96 ms (image_03)."""

_SMALLEST_IMAGE_PX = (1224, 370)  # of the tracking data set
_T_CAM_UPRIGHT = np.array(  # from x right, y forward, z up
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_RECTIFIED_360 = ("image_00", "image_01")
_FISHEYES_360 = ("image_02", "image_03")


def open_recording(path: Path, scene: str | None) -> Drive:
    """Return the drive or sequence at a path, or ``scene``, one of several in a folder."""
    if (path / "velodyne_points").is_dir():
        return KittiRaw(path)
    if (path / "data_3d_raw").is_dir():
        drives = path.glob("data_3d_raw/*/velodyne_points")
        return Kitti360(path, _scene("kitti-360", path, scene, [p.parent.name for p in drives]))
    tracks = [p.name for p in path.glob("velodyne/*") if p.is_dir()]
    if tracks:
        return KittiTracking(path, _scene("kitti-tracking", path, scene, tracks))
    if (path / "velodyne").is_dir() and scene is None:
        return KittiOdometry(path)
    folder = path / "sequences" if (path / "sequences").is_dir() else path
    names = [p.parent.name for p in folder.glob("*/velodyne") if any(p.glob("*.bin"))]
    return KittiOdometry(folder / _scene("kitti-odometry", path, scene, names))


def _scene(reader: str, path: Path, scene: str | None, names: list[str]) -> str:
    """Return the name of the requested or the only scene. Raise InputError if not clear."""
    none = (
        "no KITTI recording; expected velodyne_points/ (a raw drive), data_3d_raw/ (KITTI-360), "
        "velodyne/0000/ (tracking), or sequences/ or velodyne/ (odometry)"
    )
    return checks.chosen_scene(reader, path, scene, sorted(names), none)


class Drive(FileSequence):
    """Numbered sweeps of an HDL-64E that turns clockwise and faces forward at the stamp."""

    def __init__(
        self, name: str, where: Path, sweeps: Path, stamps: Stamps, images: Mapping[str, Path]
    ) -> None:
        """Find the .bin files in the folder ``sweeps``, and images in the folder of each camera."""
        files = checks.numbered_files(sweeps, ".bin")
        if not files:
            raise InputError(f"{sweeps}: no sweeps; expected files such as 0000000120.bin")
        numbered = {
            camera: numbers
            for camera, folder in images.items()
            if (numbers := checks.numbered_files(folder, ".png", ".jpg", ".jpeg"))
        }
        super().__init__(name, where, tuple(files), files=files, images=numbered)
        self._stamps = stamps
        self._exposed_ns = {camera: stamps.of(numbers) for camera, numbers in numbered.items()}

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep in ns. Raise InputError if it has no stamp."""
        self.check_frame(frame)
        return self._stamps.at(frame)

    def gaps(self) -> list[str]:
        """Return a sentence for each missing file, which says what is assumed instead."""
        note = f"{self.where} has no {self._stamps.path.name}: sweeps are taken for 100 ms apart"
        return [] if self._stamps.by_frame else [note]

    def _returns(self, frame: int) -> Returns:
        points, intensity = read_points(self._files[frame])
        return Returns(points, intensity, turned_ns(points, self._stamps.period_ns))

    def _rectified_cameras(
        self, calibration: Calibration, T_rect_lidar: Float
    ) -> dict[str, Camera]:
        """Return the cameras with images, which are rectified and as large as the first image."""
        return {
            name: calibration.rectified_camera(
                f"P{name[-1]}", name, image_size_px(min(files.values())), T_rect_lidar
            )
            for name, files in self._image_files.items()
        }


class KittiRaw(Drive):
    """A KITTI raw drive as a `LidarSequence`, stamped at the middle of the revolution.

    Without ``timestamps.txt``, a stamp is the mean of ``timestamps_start.txt`` and
    ``timestamps_end.txt``. Without these two files, the points have no times (``offset_ns`` None).
    The world is the frame of the GPS/IMU unit at the first oxts file.
    """

    def __init__(self, path: Path | str) -> None:
        drive = Path(path)
        cameras = _raw_cameras(drive)
        # Stamps of the sweeps, or the middle of each revolution
        files = (drive / f"velodyne_points/timestamps{end}.txt" for end in ("", "_start", "_end"))
        stamps, self._start, self._end = (read_stamps(file, required=False) for file in files)
        recorded = (stamps, self._start, self._end)
        self._missing = [file.path.name for file in recorded if not file.by_frame]
        if self._missing == [stamps.path.name]:
            start_ns, end_ns = self._start.by_frame, self._end.by_frame
            both = [frame for frame in start_ns if frame in end_ns]
            middle_ns = {frame: (start_ns[frame] + end_ns[frame]) // 2 for frame in both}
            stamps = Stamps(stamps.path, middle_ns)
        images = {name: drive / name / "data" for name in cameras}
        sweeps = drive / "velodyne_points" / "data"
        super().__init__(drive.resolve().name, drive, sweeps, stamps, images)
        self.cameras = cameras
        self.truth = checks.truth_beside(drive)
        # Exposures of the images; those without a stamp keep the stamp of the sweep.
        for name, numbers in self._image_files.items():
            image_stamps = read_stamps(drive / name / "timestamps.txt", required=False)
            exposed_ns = dict(self._exposed_ns[name])
            for frame, stamp_ns in image_stamps.by_frame.items():
                exposed_ns[frame] = stamp_ns - KITTI_TRIGGER_LATENCY_NS
            self._exposed_ns[name] = Stamps(image_stamps.path, exposed_ns).of(numbers)
        self._oxts = checks.numbered_files(drive / "oxts" / "data", ".txt")

    def gaps(self) -> list[str]:
        """Return a sentence for each missing file, which says what is assumed instead."""
        velodyne = self.where / "velodyne_points"
        notes = [f"{velodyne} has no {', '.join(self._missing)}"] * bool(self._missing)
        notes += super().gaps()
        return notes + [
            f"{name} is left out: calib_cam_to_cam.txt has no P_rect_{name[-2:]}"
            for name in _image_folders(self.where)
            if name not in self.cameras
        ]

    def _returns(self, frame: int) -> Returns:
        points, intensity = read_points(self._files[frame])
        if not (self._start.by_frame and self._end.by_frame):
            return Returns(points, intensity)
        start_ns, end_ns = self._start.at(frame), self._end.at(frame)
        if end_ns <= start_ns:
            raise InputError(
                f"{self._end.path}: sweep of frame {frame} ends {start_ns - end_ns} ns before it "
                f"starts; expected the end after the start"
            )
        centre_ns = (start_ns + end_ns) // 2 - self.stamp_ns(frame)
        return Returns(points, intensity, turned_ns(points, end_ns - start_ns) + centre_ns)

    def _pose(self, frame: int) -> Float:
        """Return the (4,4) T_world_lidar, between oxts records if they have stamps."""
        # The frame's own record is up to 20 ms away from the sweep, which is 0.3 m at 15 m/s.
        if not self._oxts:
            return super()._pose(frame)
        checks.find_entry(self._oxts, frame, "oxts record", self.where)
        T_imu_lidar = poses.inverse(self._T_lidar_imu)
        recorded_ns = self._oxts_stamps.by_frame
        frames = [f for f in (frame - 1, frame, frame + 1) if f in recorded_ns and f in self._oxts]
        stamps_ns = np.array([recorded_ns[f] for f in frames], np.int64)
        if len(frames) < 2 or (np.diff(stamps_ns) <= 0).any() or not self._stamps.by_frame:
            return self._T_world_imu(frame) @ T_imu_lidar
        T_world_imu = np.stack([self._T_world_imu(f) for f in frames])
        track = PoseTrack(str(self.where / "oxts"), stamps_ns, T_world_imu)
        return track.at(self.stamp_ns(frame)) @ T_imu_lidar

    def _T_world_imu(self, frame: int) -> Float:
        paths = self._oxts[min(self._oxts)], self._oxts[frame]
        first_record, record = (parse_oxts(read_text(path), str(path)) for path in paths)
        return T_first_imu(first_record, record)

    @cached_property
    def _oxts_stamps(self) -> Stamps:
        return read_stamps(self.where / "oxts" / "timestamps.txt", required=False)

    @cached_property
    def _T_lidar_imu(self) -> Float:
        path = _calibration_folder(self.where) / "calib_imu_to_velo.txt"
        return Calibration.read(path).rotation("R", "T")


def _calibration_folder(drive: Path) -> Path:
    """Return the drive's parent, or that of the target of a link."""
    named, target = drive.absolute().parent, drive.resolve().parent
    return named if any(named.glob("calib_*.txt")) else target


def _image_folders(drive: Path) -> list[str]:
    return sorted(p.name for p in drive.glob("image_[0-9][0-9]") if p.is_dir())


def _raw_cameras(drive: Path) -> dict[str, Camera]:
    """Return the calibrated cameras by name: those with images, or all if no images exist."""
    folder, names = _calibration_folder(drive), _image_folders(drive)
    files = [folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt"]
    if not names and not all(file.is_file() for file in files):
        return {}
    calibration, to_lidar = map(Calibration.read, files)
    calibrated = [f"image_{key[-2:]}" for key in calibration.entries if key[:-2] == "P_rect_"]
    T_rect_lidar = calibration.rotation("R_rect_00") @ to_lidar.rotation("R", "T")
    return {
        name: calibration.rectified_camera(
            f"P_rect_{name[-2:]}", name, f"S_rect_{name[-2:]}", T_rect_lidar
        )
        for name in names or calibrated
        if name in calibrated
    }


class KittiOdometry(Drive):
    """A KITTI odometry sequence as a `LidarSequence`.

    ``times.txt`` has seconds since the first frame. Points are ego-motion compensated to the stamp,
    without firing times; poses undo this by fixed-point iteration, as firing time and azimuth at
    firing depend on each other. Without poses ``offset_ns`` is None. Images are rectified. ``Tr``
    is T_cam_lidar of camera 0. A pose P is T_first_now of camera 0; the scanner's is Tr⁻¹ P Tr.
    """

    def __init__(self, path: Path) -> None:
        images = {p.name: p for p in sorted(path.glob("image_[0-3]"))}
        times = path / "times.txt"
        times_ns = StampFile.read(times, "s").stamp_ns if times.exists() else ()
        stamps = Stamps(times, dict(enumerate(times_ns)))
        super().__init__(path.resolve().name, path, path / "velodyne", stamps, images)
        self.truth = checks.truth_beside(path)
        if self._image_files:
            T_cam_lidar = self._calibration.motion("Tr")
            self.cameras = self._rectified_cameras(self._calibration, T_cam_lidar)

    def _returns(self, frame: int) -> Returns:
        stored, intensity = read_points(self._files[frame])
        if self._track is None:
            return Returns(stored, intensity)
        points, offset_ns = self._track.undo_compensation_by(
            lambda points: turned_ns(points, self._stamps.period_ns), stored, self.stamp_ns(frame)
        )
        return Returns(points, intensity, offset_ns)

    def _pose(self, frame: int) -> Float:
        return super()._pose(frame) if self._track is None else self._track.at(self.stamp_ns(frame))

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self.where / "calib.txt")

    @cached_property
    def _track(self) -> PoseTrack | None:
        """The path of the scanner, None without poses."""
        folders = [self.where.absolute(), self.where.resolve()]  # a link, and its target
        paths = [folder / "poses.txt" for folder in folders]
        paths += [folder.parent.parent / "poses" / f"{folder.name}.txt" for folder in folders]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            return None
        T_first_cam, T_cam_lidar = PoseFile.read(path).T, self._calibration.motion("Tr")
        num_poses = len(T_first_cam)
        if self._stamps.by_frame:
            num_poses = min(num_poses, len(self._stamps.by_frame))
        stamps_ns = np.array([self._stamps.at(frame) for frame in range(num_poses)], np.int64)
        T = poses.inverse(T_cam_lidar) @ T_first_cam[:num_poses] @ T_cam_lidar
        return PoseTrack(str(path), stamps_ns, T)


class KittiTracking(Drive):
    """A KITTI tracking sequence as a `LidarSequence`, without stamps.

    Points are not deskewed. Images are rectified. The world is the frame of the GPS/IMU unit (oxts)
    at frame 0. A label line is ``frame track type truncated occluded alpha left top right bottom
    height width length x y z rotation_y [score]``. x y z is the middle of the box's bottom in
    rectified camera 0 when the scanner faced the object; rotation_y is the heading about y, 0 along
    x. Only objects in view of image_02 have boxes; ``DontCare`` rectangles may hold more objects.
    """

    def __init__(self, path: Path, scene: str) -> None:
        images = {folder.name: folder / scene for folder in sorted(path.glob("image_0[0-3]"))}
        name, stamps = f"{path.resolve().name}/{scene}", Stamps(path / "stamps", {})
        super().__init__(name, path, path / "velodyne" / scene, stamps, images)
        self._scene_file = f"{scene}.txt"
        self.truth = checks.truth_beside(path)
        if self._image_files:
            self.cameras = self._rectified_cameras(self._calibration, self._T_rect_lidar)

    def _pose(self, frame: int) -> Float:
        path = self.where / "oxts" / self._scene_file
        if not path.exists():
            return super()._pose(frame)
        lines = dict(enumerate(read_text(path).splitlines()))
        first_record, record = (
            parse_oxts(checks.find_entry(lines, f, "oxts record", path), f"{path}: line {f + 1}")
            for f in (0, frame)
        )
        T_lidar_imu = self._calibration.motion("Tr_imu_velo")
        return T_first_imu(first_record, record) @ poses.inverse(T_lidar_imu)

    def boxes(self, frame: int) -> Boxes | None:
        """Return a sweep's boxes at their firing times, lidar frame, or None without labels."""
        self.check_frame(frame)
        path = self.where / "label_02" / self._scene_file
        if not path.is_file():
            return None
        numbers, is_area = read_labels(path)
        # Columns: 0 frame, 1 track, 5 to 8 rectangle in the image, 9 to 15 box
        is_of_frame = numbers[:, 0] == frame
        labels = numbers[is_of_frame & ~is_area]
        areas_px = numbers[is_of_frame & is_area, 5:9]
        height_m, width_m, length_m, right_m, down_m, forward_m, turn_rad = labels[:, 9:16].T
        # Labels have the middle of the bottom, boxes their own middle.
        centre_m = np.column_stack([right_m, forward_m, height_m / 2 - down_m])
        T_cam_box = _T_CAM_UPRIGHT @ checks.upright_poses(centre_m, -turn_rad)
        T_lidar_box = poses.inverse(self._T_rect_lidar) @ T_cam_box
        size_m = np.column_stack([length_m, width_m, height_m])
        tracks = [f"{track:.0f}" for track in labels[:, 1]]
        frame_boxes = checks.boxes(tracks, T_lidar_box, size_m, f"{path}: frame {frame}")
        camera = self.cameras.get("image_02") or self._calibration.rectified_camera(
            "P2", "image_02", _SMALLEST_IMAGE_PX, self._T_rect_lidar
        )
        offset_ns = turned_ns(T_lidar_box[:, :3, 3], NOMINAL_PERIOD_NS)
        return replace(frame_boxes, offset_ns=offset_ns, view=BoxView(camera, areas_px))

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self.where / "calib" / self._scene_file)

    @cached_property
    def _T_rect_lidar(self) -> Float:
        """The (4,4) transform from the lidar frame to the frame of rectified camera 0."""
        return self._calibration.rotation("R_rect") @ self._calibration.motion("Tr_velo_cam")


class Kitti360(Drive):
    """A KITTI-360 drive as a `LidarSequence`, stamped at the middle of the revolution.

    Points are not deskewed. image_00 and image_01 are rectified; image_02 and image_03 are fisheyes
    (Mei's model), used up to 90 degrees off the axis. Poses are the GPS/IMU unit's, interpolated.
    """

    def __init__(self, path: Path, drive: str) -> None:
        velodyne = path / "data_3d_raw" / drive / "velodyne_points"
        folder = path / "data_2d_raw" / drive
        images = {name: folder / name / "data_rect" for name in _RECTIFIED_360}
        images |= {name: folder / name / "data_rgb" for name in _FISHEYES_360}
        stamps = read_stamps(velodyne / "timestamps.txt")
        super().__init__(drive, path, velodyne / "data", stamps, images)
        self.truth = checks.truth_beside(velodyne.parent)
        self._pose_file = path / "data_poses" / drive / "poses.txt"
        self.cameras = {name: self._camera(name) for name in self._image_files}
        self._exposed_ns = {
            name: read_stamps(folder / name / "timestamps.txt").of(numbers)
            for name, numbers in self._image_files.items()
        }

    def _pose(self, frame: int) -> Float:
        if not self._pose_file.exists():
            return super()._pose(frame)
        return self._track.at(self.stamp_ns(frame)) @ self._T_pose_lidar

    @cached_property
    def _track(self) -> PoseTrack:
        """The poses of the vehicle, each at the stamp of the sweep with the same number."""
        T_world_pose = {}
        for number, line in enumerate(read_text(self._pose_file).splitlines(), 1):
            where = f"{self._pose_file}: line {number}"
            frame, *numbers = checks.parse_numbers(line, where, 13).tolist()
            if frame in self._stamps.by_frame:
                T_world_pose[self._stamps.by_frame[int(frame)]] = checks.pose(numbers, where)
        stamps_ns = np.array(list(T_world_pose), np.int64)
        T = np.reshape(list(T_world_pose.values()), (-1, 4, 4))
        return PoseTrack(str(self._pose_file), stamps_ns, T)

    @cached_property
    def _to_pose(self) -> Calibration:
        return Calibration.read(self.where / "calibration" / "calib_cam_to_pose.txt")

    @cached_property
    def _T_pose_lidar(self) -> Float:
        """The (4,4) pose of the scanner in the vehicle's frame, computed through camera 0."""
        path = self.where / "calibration" / "calib_cam_to_velo.txt"
        where = f"{path}: the transform from camera 0 to the scanner"
        T_lidar_cam = checks.pose(checks.parse_numbers(read_text(path), where, 12), where)
        return self._to_pose.motion("image_00") @ poses.inverse(T_lidar_cam)

    def _camera(self, name: str) -> Camera:
        folder, number = self.where / "calibration", name[-2:]
        T_cam_lidar = poses.inverse(self._to_pose.motion(name)) @ self._T_pose_lidar
        if name in _FISHEYES_360:
            return read_fisheye(folder / f"{name}.yaml", name, T_cam_lidar)
        perspective = Calibration.read(folder / "perspective.txt")
        size = f"S_rect_{number}"
        camera = perspective.rectified_camera(f"P_rect_{number}", name, size, np.eye(4))
        R = perspective.rotation(f"R_rect_{number}")
        return replace(camera, T_cam_lidar=R @ T_cam_lidar)
