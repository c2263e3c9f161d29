# SPDX-License-Identifier: MIT
"""Read KITTI odometry (Geiger et al., CVPR 2012) and SemanticKITTI (Behley et al., ICCV 2019).

    dataset/sequences/00/velodyne/000000.bin   image_2/000000.png   calib.txt   times.txt
    dataset/poses/00.txt   or SemanticKITTI's  dataset/sequences/00/poses.txt

- Frame numbers are file numbers. ``times.txt`` has seconds since the first frame, at which camera
  and scanner faced forward. Without this file frame k is at k times 100 ms.
- Points of the HDL-64E are ego-motion compensated to that time, without firing times. The poses
  undo this by fixed-point iteration: firing time and azimuth at firing depend on each other.
  Without poses ``offset_ns`` is None.
- Images are rectified and have the size of the first image. ``calib.txt`` has their projections and
  ``Tr``, T_cam_lidar of camera 0. A pose P is T_first_now of camera 0; the scanner's is Tr⁻¹ P Tr.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Float
from densify.readers import checks
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import Returns
from densify.readers.kitti.drive import (
    NOMINAL_PERIOD_NS,
    Calibration,
    Drive,
    read_points,
    turned_ns,
    usual_period_ns,
)
from densify.readers.recorded_poses import PoseTrack
from densify.readers.stamp_files import StampFile

_NUM_ROUNDS = 3  # the azimuth changes by degrees at most


def open_recording(path: Path, scene: str | None) -> KittiOdometry:
    """Open a sequence by its folder, or by a folder of sequences and its number, such as 00."""
    if (path / "velodyne").is_dir() and scene is None:
        return KittiOdometry(path)
    folder = path / "sequences" if (path / "sequences").is_dir() else path
    names = sorted(velodyne.parent.name for velodyne in folder.glob("*/velodyne"))
    none = "no KITTI odometry; expected a folder with velodyne/, or sequences/ with such folders"
    return KittiOdometry(folder / checks.chosen_scene("kitti-odometry", path, scene, names, none))


class KittiOdometry(Drive):
    """A KITTI odometry sequence as a `LidarSequence`."""

    def __init__(self, path: Path) -> None:
        images = {p.name: p for p in sorted(path.glob("image_[0-3]"))}
        super().__init__(path.resolve().name, path, path / "velodyne", path, images)
        self._times = path / "times.txt"
        self._times_ns = _read_times_ns(self._times) if self._times.exists() else {}
        self.revolution_ns = usual_period_ns(self._times_ns.values())
        self.cameras = {
            name: self._calibration.rectified_camera(
                f"P{name[-1]}",
                name,
                image_size_px(next(iter(files.values()))),
                self._calibration.motion("Tr"),
            )
            for name, files in self._image_files.items()
        }
        self._exposed_ns = {
            name: {frame: self._time_ns(frame) for frame in files}
            for name, files in self._image_files.items()
        }

    def gaps(self) -> list[str]:
        """Return a sentence about the assumed rate if times.txt is missing."""
        note = f"{self.where} has no times.txt: sweeps are taken for 100 ms apart"
        return [] if self._times_ns else [note]

    def stamp_ns(self, frame: int) -> int:
        """Return the time, since the first frame, at which the scanner faced forward in a sweep."""
        self.check_frame(frame)
        return self._time_ns(frame)

    def _time_ns(self, frame: int) -> int:
        if not self._times_ns:
            return frame * NOMINAL_PERIOD_NS
        return checks.of_frame(self._times_ns, frame, "time", self._times)

    def _returns(self, frame: int) -> Returns:
        stored, intensity = read_points(self._files[frame])
        track = self._track_around(frame)
        if track is None:
            return Returns(stored, intensity)
        points = stored
        for _ in range(_NUM_ROUNDS):
            offset_ns = turned_ns(points, self.revolution_ns)
            points = track.as_fired(stored, self.stamp_ns(frame), offset_ns)
        return Returns(points, intensity, offset_ns)

    def _track_around(self, frame: int) -> PoseTrack | None:
        """Return the scanner's poses at a frame and its neighbours, None for fewer than two."""
        path, lines = self._pose_lines
        frames = [f for f in (frame - 1, frame, frame + 1) if f in lines]
        if len(frames) < 2:
            return None
        where = f"{path}: line {frame + 1} and those beside it"
        stamps_ns = np.array([self._time_ns(f) for f in frames], np.int64)
        return PoseTrack(
            where, stamps_ns, np.stack([checks.rigid(self._pose(f), where) for f in frames])
        )

    def _pose(self, frame: int) -> Float:
        path, lines = self._pose_lines
        if path is None:
            return super()._pose(frame)
        line = checks.of_frame(lines, frame, "pose", path)
        P = checks.parse_numbers(line, f"{path}: line {frame + 1}", 12).reshape(3, 4)
        T_cam_lidar = self._calibration.motion("Tr")
        T_first_cam = np.vstack([P, [0.0, 0.0, 0.0, 1.0]])
        return poses.inverse(T_cam_lidar) @ T_first_cam @ T_cam_lidar

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self.where / "calib.txt")

    @cached_property
    def _pose_lines(self) -> tuple[Path | None, dict[int, str]]:
        folders = [self.where.absolute(), self.where.resolve()]  # a link, and its target
        paths = [folder / "poses.txt" for folder in folders]
        paths += [folder.parent.parent / "poses" / f"{folder.name}.txt" for folder in folders]
        for path in paths:
            if path.is_file():
                return path, dict(enumerate(read_text(path).splitlines()))
        return None, {}


def _read_times_ns(path: Path) -> dict[int, int]:
    """Return stamps by line number from 0; InputError if a line is no number or does not ascend."""
    times_ns = StampFile.read(path, "s").stamp_ns
    for number, (before, now) in enumerate(pairwise(times_ns), 2):
        if now <= before:
            raise InputError(
                f"{path}: line {number}: got {now} ns, expected more than on the line before"
            )
    return dict(enumerate(times_ns))
