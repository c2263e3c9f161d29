# SPDX-License-Identifier: MIT
"""Read KITTI raw drives (Geiger et al., IJRR 2013): a folder, with the calibration in its parent.

Frame numbers are file numbers and lines, from 0, of timestamp files; files may be missing.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.file_sequence import Returns
from densify.readers.kitti.drive import (
    NOMINAL_PERIOD_NS,
    Calibration,
    Drive,
    T_mercator_imu,
    parse_oxts,
    read_points,
    read_stamps,
    turned_ns,
)
from densify.readers.recorded_poses import PoseTrack

KITTI_TRIGGER_LATENCY_NS = 10_500_000
"""Lag of KITTI's recorded image stamps behind the exposure, which the scanner triggers as it faces
forward. Drives 0002 and 0013 of 2011_09_26 record 10.50 ms (image_02) and 9.96 ms (image_03)."""


def open_recording(path: Path, scene: str | None) -> KittiRaw:
    """Open a KITTI raw drive; ``scene`` is unused, since a drive has no scenes."""
    return KittiRaw(path)


class KittiRaw(Drive):
    """A KITTI raw drive as a `LidarSequence`, stamped at the middle of the revolution.

    Without ``velodyne_points/timestamps.txt`` a stamp is the mean of start and end, or k times 100
    ms. The firing time of a point follows from its azimuth, ``timestamps_start.txt`` and
    ``timestamps_end.txt``; if one of them is missing, ``offset_ns`` is None. Poses come from
    ``oxts/``. The world is the frame of the GPS/IMU unit at the first oxts file.
    """

    def __init__(self, path: Path | str) -> None:
        drive = Path(path)
        velodyne = drive / "velodyne_points"
        cameras = _read_cameras(drive)
        images = {name: drive / name / "data" for name in cameras}
        super().__init__(drive.resolve().name, drive, velodyne / "data", drive, images)
        self._stamp_files = {
            name: velodyne / f"timestamps{name}.txt" for name in ("", "_start", "_end")
        }
        self._recorded = {n: read_stamps(p) for n, p in self._stamp_files.items() if p.exists()}
        self._missing = [p.name for n, p in self._stamp_files.items() if n not in self._recorded]
        if self._missing == [self._stamp_files[""].name]:
            ends_ns = self._recorded["_end"]
            self._recorded[""] = {
                frame: (start_ns + ends_ns[frame]) // 2
                for frame, start_ns in self._recorded["_start"].items()
                if frame in ends_ns
            }
        self._oxts = checks.numbered_files(drive / "oxts" / "data", ".txt")
        self.cameras = cameras
        self._exposed_ns = {name: self._exposures_ns(name) for name in self._image_files}

    def gaps(self) -> list[str]:
        """Return missing files and what is assumed instead, a sentence each."""
        velodyne = self.where / "velodyne_points"
        notes = [f"{velodyne} has no {', '.join(self._missing)}"] * bool(self._missing)
        if "" not in self._recorded:
            notes.append(f"{self.where}: sweeps are taken for 100 ms apart")
        left_out = [name for name in _camera_folders(self.where) if name not in self.cameras]
        return notes + [
            f"{name} is left out: calib_cam_to_cam.txt has no P_rect_{name[-2:]}"
            for name in left_out
        ]

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep; raise InputError if the frame has no stamp."""
        return self._recorded_ns("", frame) if "" in self._recorded else frame * NOMINAL_PERIOD_NS

    def _recorded_ns(self, kind: str, frame: int) -> int:
        return checks.of_frame(self._recorded[kind], frame, "stamp", self._stamp_files[kind])

    def _returns(self, frame: int) -> Returns:
        points, intensity = read_points(self._files[frame])
        if len(self._recorded) < len(self._stamp_files):
            return Returns(points, intensity)
        start, end = self._recorded_ns("_start", frame), self._recorded_ns("_end", frame)
        if end <= start:
            raise InputError(
                f"{self._stamp_files['_end']}: sweep of frame {frame} ends {start - end} ns before "
                f"it starts; expected the end after the start"
            )
        centre_ns = (start + end) // 2 - self.stamp_ns(frame)
        offset_ns = turned_ns(points, end - start) + centre_ns
        return Returns(points, intensity, offset_ns)

    def _exposures_ns(self, camera: str) -> dict[int, int]:
        """Return the exposure times of the camera's existing images, by frame number."""
        path, numbers = self.where / camera / "timestamps.txt", self._image_files[camera]
        exposed_ns = self._recorded.get("", {f: f * NOMINAL_PERIOD_NS for f in numbers})
        if path.exists():
            recorded = read_stamps(path).items()
            exposed_ns = exposed_ns | {f: ns - KITTI_TRIGGER_LATENCY_NS for f, ns in recorded}
        return {frame: exposed_ns[frame] for frame in numbers if frame in exposed_ns}

    def _pose(self, frame: int) -> Float:
        """Return the (4,4) T_world_lidar, between oxts records if they have stamps."""
        # The frame's own record is up to 20 ms away from the sweep, 0.3 m at 15 m/s.
        if not self._oxts:
            return super()._pose(frame)
        checks.of_frame(self._oxts, frame, "oxts record", self.where)
        frames = [f for f in (frame - 1, frame, frame + 1) if f in self._oxts_stamps_ns]
        stamps_ns = np.array([self._oxts_stamps_ns[f] for f in frames], np.int64)
        if len(frames) < 2 or (np.diff(stamps_ns) <= 0).any() or "" not in self._recorded:
            return self._T_world_imu(frame) @ poses.inverse(self._T_lidar_imu)
        T_world_imu = np.stack([self._T_world_imu(f) for f in frames])
        track = PoseTrack(str(self.where / "oxts"), stamps_ns, T_world_imu)
        return track.at(self.stamp_ns(frame)) @ poses.inverse(self._T_lidar_imu)

    @cached_property
    def _oxts_stamps_ns(self) -> dict[int, int]:
        path = self.where / "oxts" / "timestamps.txt"
        stamps_ns = read_stamps(path) if path.exists() else {}
        return {frame: ns for frame, ns in stamps_ns.items() if frame in self._oxts}

    def _T_world_imu(self, frame: int) -> Float:
        first = self._first_oxts
        record = parse_oxts(read_text(self._oxts[frame]), str(self._oxts[frame]))
        return poses.inverse(T_mercator_imu(first, first)) @ T_mercator_imu(record, first)

    @cached_property
    def _first_oxts(self) -> Float:
        path = next(iter(self._oxts.values()))
        return parse_oxts(read_text(path), str(path))

    @cached_property
    def _T_lidar_imu(self) -> Float:
        return Calibration.read(_beside(self.where) / "calib_imu_to_velo.txt").pose()


def _beside(drive: Path) -> Path:
    """Return the folder of the calibration: the drive's parent, or that of the target of a link."""
    named, target = drive.absolute().parent, drive.resolve().parent
    return named if any(named.glob("calib_*.txt")) else target


def _camera_folders(drive: Path) -> list[str]:
    return sorted(p.name for p in drive.glob("image_[0-9][0-9]") if p.is_dir())


def _read_cameras(drive: Path) -> dict[str, Camera]:
    """Return the calibrated cameras with images by name; all if there are no folders of images."""
    folder, names = _beside(drive), _camera_folders(drive)
    files = [folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt"]
    if not names and not all(file.is_file() for file in files):
        return {}
    calibration, to_lidar = map(Calibration.read, files)
    names = names or [f"image_{key[-2:]}" for key in calibration.entries if key[:-2] == "P_rect_"]
    T_rect_lidar = calibration.rotation("R_rect_00") @ to_lidar.pose()
    cameras = {}
    for name in names:
        key = f"P_rect_{name[-2:]}"
        if key in calibration.entries:
            size_px = calibration.size_px(f"S_rect_{name[-2:]}")
            cameras[name] = calibration.rectified_camera(key, name, size_px, T_rect_lidar)
    return cameras
