# SPDX-License-Identifier: MIT
"""KITTI tracking (Geiger, Lenz, Urtasun, CVPR 2012): the folder ``training`` or ``testing``, whose
sequences are scenes::

    velodyne/0000/000000.bin   image_02/0000/000000.png   calib/0000.txt   oxts/0000.txt
    label_02/0000.txt    optional: tracked boxes, a line for each object and frame

- Frames are file numbers; a sweep's file can be absent. There are no stamps: frame k is at k times
  100 ms, its images too.
- Points are the HDL-64E's, in its frame, as measured. A point's time follows from its azimuth, the
  turn taken to last 100 ms.
- Images are rectified; their size is that of the first. ``calib`` has their projections, R_rect,
  Tr_velo_cam and Tr_imu_velo. Poses come from oxts (a line for each frame); the world is the
  inertial unit's frame at frame 0.
- A label line is ``frame track type truncated occluded alpha left top right bottom height width
  length x y z rotation_y [score]``. x y z is the middle of the box's bottom in the rectified camera
  0 (x right, y down, z forward), rotation_y its turn about y, 0 where the front is along x. A box
  belongs to the time at which the scanner faced it. Only what image_02 shows is labelled;
  ``DontCare`` lines are rectangles in which there may be objects without a box (devkit_tracking).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Boxes, BoxView, Camera, Float, Int
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    checked_boxes,
    chosen_scene,
    numbered_files,
    of_frame,
    parse_numbers,
    truth_beside,
    upright_poses,
)
from densify.readers.kitti.calibration import (
    NOMINAL_PERIOD_NS,
    Calibration,
    T_mercator_imu,
    find_sweeps,
    parse_oxts,
    read_points,
    turned_ns,
)

_SMALLEST_IMAGE_PX = (1224, 370)
_NUM_WORDS = (17, 18)
_LEFT_OUT = "DontCare"
T_CAM_UPRIGHT = np.array(  # from x right, y forward, z up
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def open_recording(path: Path, scene: str | None) -> KittiTracking:
    """See `densify.readers.ReaderModule`. path: the folder that holds velodyne/; scene: a sequence
    such as ``0000``."""
    names = sorted(p.name for p in (path / "velodyne").glob("*") if p.is_dir())
    if not names:
        raise InputError(f"{path}: no KITTI tracking; expected folders such as velodyne/0000 in it")
    return KittiTracking(path, chosen_scene("kitti-tracking", path, scene, names))


class KittiTracking(FileSequence):
    """A sequence as a `LidarSequence`."""

    def __init__(self, path: Path, scene: str) -> None:
        """path: the folder that holds velodyne/. scene: the sequence. Raises InputError if it holds
        no sweeps, or the calibration where there are images is missing or malformed."""
        self._calibration_file = path / "calib" / f"{scene}.txt"
        self._oxts_file = path / "oxts" / f"{scene}.txt"
        self._label_file = path / "label_02" / f"{scene}.txt"
        sweeps = find_sweeps(path / "velodyne" / scene, "000000.bin")
        found = {
            folder.name: numbered_files(folder / scene, ".png", ".jpg")
            for folder in sorted(path.glob("image_0[0-3]"))
        }
        images = {name: files for name, files in found.items() if files}
        super().__init__(
            f"{path.resolve().name}/{scene}",
            path,
            tuple(sweeps),
            {
                name: self._camera(name, image_size_px(next(iter(files.values()))))
                for name, files in images.items()
            },
            {name: {f: f * NOMINAL_PERIOD_NS for f in files} for name, files in images.items()},
            truth_beside(path),
            sweeps,
            images,
        )

    def stamp_ns(self, frame: int) -> int:
        """Return when the scanner faced forward, at the nominal rate."""
        self.check_frame(frame)
        return frame * NOMINAL_PERIOD_NS

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        columns = read_points(self._files[frame])
        points = columns[:, :3].astype(np.float64)
        offset_ns = turned_ns(points, NOMINAL_PERIOD_NS)
        return self._files[frame], Returns(points, columns[:, 3], offset_ns)

    def _pose(self, frame: int) -> Float:
        if not self._oxts_file.exists():
            return super()._pose(frame)
        first = self._oxts(0)
        T_mercator_world = T_mercator_imu(first, first)
        T_lidar_imu = self._calibration.motion("Tr_imu_velo")
        T_world_imu = poses.inverse(T_mercator_world) @ T_mercator_imu(self._oxts(frame), first)
        return T_world_imu @ poses.inverse(T_lidar_imu)

    def _oxts(self, frame: int) -> Float:
        """Return the (30,) record of a frame."""
        line = of_frame(self._oxts_lines, frame, "oxts record", self._oxts_file)
        return parse_oxts(line, f"{self._oxts_file}: line {frame + 1}")

    @cached_property
    def _oxts_lines(self) -> dict[int, str]:
        return dict(enumerate(read_text(self._oxts_file).splitlines()))

    def boxes(self, frame: int) -> Boxes | None:
        """See `KnowsBoxes`; ``testing`` has none. Without images the smallest size of KITTI's is
        assumed. Raises InputError for labels or a calibration that are missing or malformed."""
        self.check_frame(frame)
        if self._labels is None:
            return None
        track, T_cam_box, size_m = self._labels.boxes(frame)
        T_lidar_box = poses.inverse(self._T_rect_lidar) @ T_cam_box
        view = BoxView(self._labelled_camera, self._labels.left_out_px(frame))
        offset_ns = turned_ns(T_lidar_box[:, :3, 3], NOMINAL_PERIOD_NS)
        return Boxes(track, T_lidar_box, size_m, offset_ns, view=view)

    @cached_property
    def _labels(self) -> LabelFile | None:
        return LabelFile.read(self._label_file)

    @cached_property
    def _labelled_camera(self) -> Camera:
        return self.cameras.get("image_02") or self._camera("image_02", _SMALLEST_IMAGE_PX)

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self._calibration_file)

    @cached_property
    def _T_rect_lidar(self) -> Float:
        """(4,4) the rectified camera 0 from the scanner."""
        return self._calibration.rotation("R_rect") @ self._calibration.motion("Tr_velo_cam")

    def _camera(self, name: str, size_px: tuple[int, int]) -> Camera:
        return self._calibration.rectified_camera(f"P{name[-1]}", name, size_px, self._T_rect_lidar)


@dataclass(frozen=True)
class LabelFile:
    """path: for messages. frame: (n,) int64 of the lines, track: (n,) int64, left_out: (n,) bool.
    numbers: (n,14) from ``truncated`` to ``rotation_y``."""

    path: Path
    frame: Int
    track: Int
    left_out: NDArray[np.bool_]
    numbers: Float

    @staticmethod
    def read(path: Path) -> LabelFile | None:
        """Return None if there is no such file. Raises InputError for a malformed line."""
        if not path.is_file():
            return None
        rows, left_out = [], []
        for number, line in enumerate(read_text(path).splitlines(), 1):
            words, where = line.split(), f"{path}: line {number}"
            if not words:
                continue
            if len(words) not in _NUM_WORDS:
                raise InputError(
                    f"{where}: got {len(words)} words, expected 17 (frame track type ... "
                    f"rotation_y), and optionally a score"
                )
            row = parse_numbers(" ".join([*words[:2], *words[3:17]]), where, 16)
            if row[0] % 1 or row[1] % 1 or np.abs(row[:2]).max() >= 1 << 31:
                raise InputError(
                    f"{where}: got frame {words[0]} and track {words[1]}, expected whole numbers"
                )
            rows.append(row)
            left_out.append(words[2] == _LEFT_OUT)
        table = np.reshape(rows, (-1, 16))
        whole = table[:, :2].astype(np.int64)
        return LabelFile(path, whole[:, 0], whole[:, 1], np.array(left_out, bool), table[:, 2:])

    def boxes(self, frame: int) -> tuple[NDArray[np.str_], Float, Float]:
        """Return of a frame: tracks (K,), T_cam_box (K,4,4) in the rectified camera 0, and size_m
        (K,3)."""
        rows = (self.frame == frame) & ~self.left_out
        height_m, width_m, length_m = self.numbers[rows, 7:10].T
        right, down, forward = self.numbers[rows, 10:13].T
        centre_m = np.column_stack([right, forward, height_m / 2 - down])
        found = checked_boxes(
            self.track[rows].astype(np.str_),
            T_CAM_UPRIGHT @ upright_poses(centre_m, -self.numbers[rows, 13]),
            np.column_stack([length_m, width_m, height_m]),
            f"{self.path}: frame {frame}",
        )
        return found.track, found.T_lidar_box, found.size_m

    def left_out_px(self, frame: int) -> Float:
        """Return the (R,4) left, top, right, bottom of rectangles without boxes."""
        return self.numbers[(self.frame == frame) & self.left_out, 3:7]
