# SPDX-License-Identifier: MIT
"""KITTI odometry (Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012) and
SemanticKITTI (Behley et al., ICCV 2019), which has the same sequences::

    dataset/sequences/00/velodyne/000000.bin   image_2/000000.png   calib.txt   times.txt
    dataset/poses/00.txt   or SemanticKITTI's  dataset/sequences/00/poses.txt

- Frames are file numbers. ``times.txt`` has seconds since the first frame, a line for each: when
  the camera exposed and the scanner faced forward. Without it frame k is at k times 100 ms.
- Points are the HDL-64E's, in its frame, ego-motion compensated to that time, without times. Where
  there are poses the compensation is undone in a few rounds: a point's time follows from the
  azimuth at which it was fired, and that azimuth from its time. (On three real sweeps at 0.7 m a
  sweep the entropy of elevations falls from 6.68 to 6.50; undone twice over it is 6.66.) Without
  poses ``offset_ns`` is None. Labels are not read.
- Images are rectified; their size is that of the first. ``calib.txt`` has their projections and
  ``Tr``, the rectified camera 0 from the scanner. Poses are camera 0's, T_first_now: the scanner's
  are Tr⁻¹ P Tr, and the world is its frame at frame 0.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    numbered_files,
    of_frame,
    parse_numbers,
    rigid,
    truth_beside,
)
from densify.readers.kitti.calibration import (
    NOMINAL_PERIOD_NS,
    Calibration,
    find_sweeps,
    read_points,
    turned_ns,
    usual_period_ns,
)
from densify.readers.recorded_poses import PoseTrack
from densify.readers.stamp_files import in_ns

_NUM_ROUNDS = 3  # the azimuth changes by degrees at most


def open_recording(path: Path, scene: str | None) -> KittiOdometry:
    """See `densify.readers.ReaderModule`. path: a sequence's folder, or one that holds some, or
    ``sequences/`` with some; scene: a sequence's number such as ``00``."""
    if (path / "velodyne").is_dir() and scene is None:
        return KittiOdometry(path)
    folder = path / "sequences" if (path / "sequences").is_dir() else path
    names = sorted(found.parent.name for found in folder.glob("*/velodyne"))
    if not names:
        raise InputError(
            f"{path}: no KITTI odometry; expected a folder with velodyne/, or sequences/ with such "
            f"folders"
        )
    return KittiOdometry(folder / chosen_scene("kitti-odometry", path, scene, names))


class KittiOdometry(FileSequence):
    """A sequence as a `LidarSequence`."""

    def __init__(self, path: Path) -> None:
        """path: the sequence's folder. Raises InputError if it holds no sweeps, or times, or the
        calibration where there are images, are missing or malformed."""
        sweeps = find_sweeps(path / "velodyne", "000000.bin")
        times = path / "times.txt"
        self._times_ns = _read_times_ns(times) if times.exists() else None
        found = {
            folder.name: numbered_files(folder, ".png", ".jpg")
            for folder in sorted(path.glob("image_[0-3]"))
        }
        self._images = {name: images for name, images in found.items() if images}
        super().__init__(
            path.resolve().name,
            path,
            tuple(sweeps),
            {name: self._camera(path, name) for name in self._images},
            {n: {f: self._time_ns(f, times) for f in files} for n, files in self._images.items()},
            truth_beside(path),
            sweeps,
            self._images,
        )

    def stamp_ns(self, frame: int) -> int:
        """When the scanner faced forward, since the first frame."""
        self.check_frame(frame)
        return self._time_ns(frame, self.where / "times.txt")

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path, columns = self._files[frame], read_points(self._files[frame])
        stored = columns[:, :3].astype(np.float64)
        track = self._track_around(frame)
        if track is None:
            return path, Returns(stored, columns[:, 3])
        points, stamp_ns = stored, self.stamp_ns(frame)
        for _ in range(_NUM_ROUNDS):
            offset_ns = turned_ns(points, self._revolution_ns)
            points = track.as_fired(stored, stamp_ns, offset_ns)
        return path, Returns(points, columns[:, 3], offset_ns)

    def _track_around(self, frame: int) -> PoseTrack | None:
        """The scanner's, from the poses of the frame and of those beside it; None without two."""
        path, lines = self._pose_lines
        near = [f for f in (frame - 1, frame, frame + 1) if 0 <= f < len(lines)]
        if len(near) < 2:
            return None
        stamps_ns = np.array([self._time_ns(f, self.where / "times.txt") for f in near], np.int64)
        where = f"{path}: line {frame + 1} and those beside it"
        T_world_lidar = [rigid(self._pose(f), where) for f in near]
        return PoseTrack(where, stamps_ns, np.stack(T_world_lidar))

    @cached_property
    def _revolution_ns(self) -> int:
        return usual_period_ns((self._times_ns or {}).values())

    def _pose(self, frame: int) -> Float:
        path, lines = self._pose_lines
        if path is None:
            return super()._pose(frame)
        line = of_frame(dict(enumerate(lines)), frame, "pose", path)
        P = parse_numbers(line, f"{path}: line {frame + 1}", 12).reshape(3, 4)
        T_cam_lidar = self._calibration.motion("Tr")
        T_first_cam = np.vstack([P, [0.0, 0.0, 0.0, 1.0]])
        return poses.inverse(T_cam_lidar) @ T_first_cam @ T_cam_lidar

    def _time_ns(self, frame: int, path: Path) -> int:
        if self._times_ns is None:
            return frame * NOMINAL_PERIOD_NS
        return of_frame(self._times_ns, frame, "time", path)

    def _camera(self, path: Path, name: str) -> Camera:
        calibration = Calibration.read(path / "calib.txt")
        size_px = image_size_px(next(iter(self._images[name].values())))
        T_rect_lidar = calibration.motion("Tr")
        return calibration.rectified_camera(f"P{name[-1]}", name, size_px, T_rect_lidar)

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self.where / "calib.txt")

    @cached_property
    def _pose_lines(self) -> tuple[Path | None, list[str]]:
        sequence = self.where.resolve()
        for path in (
            sequence / "poses.txt",
            sequence.parent.parent / "poses" / f"{sequence.name}.txt",
        ):
            if path.is_file():
                return path, read_text(path).splitlines()
        return None, []


def _read_times_ns(path: Path) -> dict[int, int]:
    """Stamps by line, from 0. Raises InputError if one is no number or not after the last."""
    lines = read_text(path).splitlines()
    times_ns: dict[int, int] = {}
    for number, line in enumerate(lines):
        try:
            times_ns[number] = in_ns(line.strip(), "s")
        except ValueError as error:
            raise InputError(f"{path}: line {number + 1}: {error}") from None
        if number and times_ns[number] <= times_ns[number - 1]:
            raise InputError(
                f"{path}: line {number + 1}: got {line.strip()} s, expected more than on the line "
                f"before"
            )
    return times_ns
