# SPDX-License-Identifier: MIT
"""KITTI raw drives (Geiger, Lenz, Stiller, Urtasun, "Vision meets Robotics: The KITTI Dataset",
IJRR 2013), in the layout in which they are downloaded: the drive's folder, with the calibration
files in its parent. Frame numbers are file numbers and files may be missing; timestamp files are
whole, so line ``frame`` (from 0) of each belongs to ``frame``.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Camera, Float, Int
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    numbered_files,
    of_frame,
    truth_beside,
)
from densify.readers.kitti.calibration import (
    NOMINAL_PERIOD_NS,
    Calibration,
    Stamps,
    T_mercator_imu,
    find_sweeps,
    parse_oxts,
    read_points,
    turned_ns,
)

KITTI_TRIGGER_LATENCY_NS = 10_500_000
"""Lag of KITTI's recorded image stamps behind the exposure, which the scanner triggers as it faces
forward. Drives 0002 and 0013 of 2011_09_26 record 10.50 ms (image_02) and 9.96 ms (image_03)."""


def open_recording(path: Path, scene: str | None) -> KittiRaw:
    """See `densify.readers.ReaderModule`; a drive has no scenes."""
    return KittiRaw(path)


class KittiRaw(FileSequence):
    """A KITTI raw drive as a `LidarSequence`.

    Reference time of a sweep: ``velodyne_points/timestamps.txt``, the middle of the revolution,
    when the scanner faces forward. There are no stamps per point: the scanner turns clockwise, so a
    return fired ``-azimuth / 2π`` of the revolution (``timestamps_start.txt`` to
    ``timestamps_end.txt``) after the reference time. Without the start and end stamps
    ``offset_ns`` is None; without ``timestamps.txt`` as well, frame k is stamped k times 100 ms.

    Poses come from ``oxts/``; the world is the inertial unit's frame at the first oxts file.
    """

    def __init__(self, path: Path | str) -> None:
        """Read calibration and stamps; everything else is read on demand.

        path: the drive's folder, ``.../2011_09_26/2011_09_26_drive_0013_sync``. Raises InputError
        if it holds no sweeps, or calibration or stamps are malformed.
        """
        drive = Path(path)
        velodyne = drive / "velodyne_points"
        if not (velodyne / "data").is_dir():
            raise InputError(
                f"{drive}: no KITTI raw drive; expected the folder velodyne_points/data"
            )
        sweeps = find_sweeps(velodyne / "data", "0000000120.bin")
        self._stamps = Stamps.read(velodyne / "timestamps.txt")
        self._start_stamps = Stamps.read(velodyne / "timestamps_start.txt")
        self._end_stamps = Stamps.read(velodyne / "timestamps_end.txt")
        self._oxts_stamps = Stamps.read(drive / "oxts" / "timestamps.txt")
        self._oxts = numbered_files(drive / "oxts" / "data", ".txt")
        cameras = _read_cameras(drive)
        self._images = {
            name: numbered_files(drive / name / "data", ".png", ".jpg", ".jpeg") for name in cameras
        }
        super().__init__(
            drive.resolve().name,
            drive,
            tuple(sweeps),
            cameras,
            {name: self._exposures_ns(drive, name) for name in cameras},
            truth_beside(drive),
            sweeps,
            self._images,
        )

    def gaps(self) -> list[str]:
        """See `KnowsItsGaps`."""
        velodyne = self.where / "velodyne_points"
        stamps = (self._stamps, self._start_stamps, self._end_stamps)
        names = [f"timestamps{part}.txt" for part in ("", "_start", "_end")]
        missing = [n for n, found in zip(names, stamps, strict=True) if found is None]
        told = [f"{velodyne} has no {', '.join(missing)}"] if missing else []
        if self._stamps is None:
            told.append(f"{velodyne} has no timestamps.txt: sweeps are taken for 100 ms apart")
        left_out = [name for name in _camera_folders(self.where) if name not in self.cameras]
        return told + [
            f"{name} is left out: calib_cam_to_cam.txt has no P_rect_{name[-2:]}"
            for name in left_out
        ]

    def stamp_ns(self, frame: int) -> int:
        """Return a sweep's reference time. Raises InputError for a frame without a stamp."""
        if self._stamps is None:
            return int(frame) * NOMINAL_PERIOD_NS
        return self._stamps[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path = self._files[frame]
        columns = read_points(path)
        points = columns[:, :3].astype(np.float64)
        return path, Returns(points, columns[:, 3], self._offset_ns(frame, points))

    def _exposures_ns(self, drive: Path, camera: str) -> dict[int, int]:
        """Return when the images that exist were exposed: the recorded stamp less
        `KITTI_TRIGGER_LATENCY_NS`, or the sweep's reference time where none is recorded."""
        stamps = Stamps.read(drive / camera / "timestamps.txt")

        def exposed_ns(frame: int) -> int | None:
            recorded = stamps.get(frame) if stamps else None
            if recorded is not None:
                return recorded - KITTI_TRIGGER_LATENCY_NS
            return self.stamp_ns(frame) if self._stamps is None else self._stamps.get(frame)

        return {f: ns for f in self._images[camera] if (ns := exposed_ns(f)) is not None}

    def _pose(self, frame: int) -> Float:
        """Return the pose by GPS and inertial unit. An oxts record is up to 20 ms away from the
        sweep of its number, 0.3 m at 15 m/s: the pose is interpolated between the records around
        the sweep, and extrapolated from the last two at their end."""
        if not self._oxts:
            return super()._pose(frame)
        of_frame(self._oxts, frame, "oxts record", self.where)
        T_world_imu = self._interpolated_T_world_imu(frame)
        return T_world_imu @ poses.inverse(self._T_lidar_imu)

    def _offset_ns(self, frame: int, points: Float) -> Int | None:
        if self._stamps is None or self._start_stamps is None or self._end_stamps is None:
            return None
        start, end = self._start_stamps[frame], self._end_stamps[frame]
        if end <= start:
            raise InputError(
                f"{self._end_stamps.path}: sweep of frame {frame} ends {start - end} ns before it "
                f"starts; expected the end after the start"
            )
        centre_ns = (start + end) // 2 - self._stamps[frame]
        return turned_ns(points, end - start) + centre_ns

    def _interpolated_T_world_imu(self, frame: int) -> Float:
        if self._oxts_stamps is None or self._stamps is None:
            return self._T_world_imu(frame)
        stamp = self._stamps[frame]
        near = [at for at in (frame - 1, frame, frame + 1) if at in self._oxts]
        records = [(ns, at) for at in near if (ns := self._oxts_stamps.get(at)) is not None]
        # The two records that enclose the sweep, else the two nearest to it.
        pairs = [(a, b) for a in records for b in records if a[0] < b[0]]
        if not pairs:
            return self._T_world_imu(frame)
        (stamp_a, a), (stamp_b, b) = min(
            pairs, key=lambda p: (abs(p[0][0] - stamp) + abs(p[1][0] - stamp), p)
        )
        fraction = (stamp - stamp_a) / (stamp_b - stamp_a)
        return poses.interpolate(self._T_world_imu(a), self._T_world_imu(b), fraction)

    def _T_world_imu(self, frame: int) -> Float:
        return poses.inverse(self._T_mercator_world) @ self._T_mercator_imu(frame)

    def _T_mercator_imu(self, frame: int) -> Float:
        return T_mercator_imu(_read_oxts(self._oxts[frame]), self._first_oxts)

    @cached_property
    def _first_oxts(self) -> Float:
        return _read_oxts(next(iter(self._oxts.values())))

    @cached_property
    def _T_mercator_world(self) -> Float:
        return T_mercator_imu(self._first_oxts, self._first_oxts)

    @cached_property
    def _T_lidar_imu(self) -> Float:
        return Calibration.read(self.where.resolve().parent / "calib_imu_to_velo.txt").pose()


def _read_oxts(path: Path) -> Float:
    return parse_oxts(read_text(path), str(path))


def _camera_folders(drive: Path) -> list[str]:
    return sorted(p.name for p in drive.glob("image_[0-9][0-9]") if p.is_dir())


def _read_cameras(drive: Path) -> dict[str, Camera]:
    """Return the cameras that have a folder in the drive and a rectified calibration in its parent;
    of a drive without image folders all that are calibrated, if any.

    ``T_cam_lidar`` is camera 0's rectification after ``calib_velo_to_cam``, moved by the camera's
    offset in ``P_rect``.
    """
    folder, names = drive.resolve().parent, _camera_folders(drive)
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
