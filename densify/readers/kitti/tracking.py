# SPDX-License-Identifier: MIT
"""KITTI tracking (Geiger, Lenz, Urtasun, CVPR 2012): the folder ``training`` or ``testing``, whose
sequences are scenes::

    velodyne/0000/000000.bin   image_02/0000/000000.png   calib/0000.txt   oxts/0000.txt
    label_02/0000.txt    optional: tracked boxes, see `densify.readers.kitti.tracking_labels`

- Frames are file numbers; a sweep's file can be absent. There are no stamps: frame k is at k times
  100 ms, its images too.
- Points are the HDL-64E's, in its frame, the same as in the raw drives that the sequences are cut
  from: as measured. A point's time follows from its azimuth, as there, the turn taken to last
  100 ms.
- Images are rectified; their size is that of the first. ``calib`` has their projections, R_rect and
  Tr_velo_cam, and Tr_imu_velo. Poses come from oxts (a line for each frame); the world is the
  inertial unit's frame at frame 0.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_text
from densify.geometry import poses
from densify.geometry.types import Boxes, BoxView, Camera, Float
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    numbered_files,
    of_frame,
    truth_beside,
)
from densify.readers.kitti.calibration import (
    NOMINAL_PERIOD_NS,
    NUM_OXTS_VALUES,
    Calibration,
    T_mercator_imu,
    check_oxts,
    mercator_scale,
    parse_numbers,
    read_points,
    rectified_camera,
    turned_ns,
)
from densify.readers.kitti.tracking_labels import LabelFile

_SMALLEST_IMAGE_PX = (1224, 370)


def open_recording(path: Path, scene: str | None) -> KittiTracking:
    """See `densify.readers.ReaderModule`. path: the folder that holds velodyne/; scene: a sequence
    such as ``0000``."""
    velodyne = path / "velodyne"
    names = sorted(p.name for p in velodyne.glob("*") if p.is_dir())
    if not names:
        raise InputError(f"{path}: no KITTI tracking; expected folders such as velodyne/0000 in it")
    return KittiTracking(path, chosen_scene("kitti-tracking", path, scene, names))


class KittiTracking(FileSequence):
    """A sequence as a `LidarSequence`."""

    def __init__(self, path: Path, scene: str) -> None:
        """path: the folder that holds velodyne/. scene: the sequence. Raises InputError if it holds
        no sweeps, or the calibration where there are images is missing or malformed."""
        self._scene = scene
        self._sweeps = numbered_files(path / "velodyne" / scene, ".bin")
        if not self._sweeps:
            raise InputError(
                f"{path / 'velodyne' / scene}: no sweeps; expected files such as 000000.bin"
            )
        found = {
            folder.name: numbered_files(folder / scene, ".png", ".jpg")
            for folder in sorted(path.glob("image_0[0-3]"))
        }
        self._images = {name: images for name, images in found.items() if images}
        super().__init__(
            f"{path.resolve().name}/{scene}",
            path,
            tuple(self._sweeps),
            {
                name: self._camera(path, name, image_size_px(next(iter(images.values()))))
                for name, images in self._images.items()
            },
            {n: {f: f * NOMINAL_PERIOD_NS for f in files} for n, files in self._images.items()},
            truth_beside(path),
            self._sweeps,
        )

    def stamp_ns(self, frame: int) -> int:
        """When the scanner faced forward, at the nominal rate."""
        self.check_frame(frame)
        return frame * NOMINAL_PERIOD_NS

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        columns = read_points(self._sweeps[frame])
        points = columns[:, :3].astype(np.float64)
        offset_ns = turned_ns(points, NOMINAL_PERIOD_NS)
        return self._sweeps[frame], Returns(points, columns[:, 3], offset_ns)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._images[camera][number]
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        if not (self.where / "oxts" / f"{self._scene}.txt").exists():
            return super()._pose(frame)
        scale = mercator_scale(self._oxts(0))
        first, here = (T_mercator_imu(self._oxts(f), scale) for f in (0, frame))
        T_lidar_imu = Calibration.read(self._calibration_file(self.where)).motion("Tr_imu_velo")
        return poses.inverse(first) @ here @ poses.inverse(T_lidar_imu)

    def _oxts(self, frame: int) -> Float:
        """(30,) a frame's record."""
        path, lines = self._oxts_lines
        line = of_frame(dict(enumerate(lines)), frame, "oxts record", path)
        where = f"{path}: line {frame + 1}"
        return check_oxts(parse_numbers(line, where, NUM_OXTS_VALUES), where)

    @cached_property
    def _oxts_lines(self) -> tuple[Path, list[str]]:
        path = self.where / "oxts" / f"{self._scene}.txt"
        return path, read_text(path).splitlines()

    def boxes(self, frame: int) -> Boxes | None:
        """See `KnowsBoxes`; ``testing`` has none. Without images their size is taken
        for the smallest of KITTI's. Raises InputError for labels or a calibration that are missing
        or malformed."""
        self.check_frame(frame)
        if self._labels is None:
            return None
        track, T_cam_box, size_m = self._labels.boxes(frame)
        T_lidar_box = poses.inverse(self._T_rect_lidar(self.where)) @ T_cam_box
        view = BoxView(self._labelled_camera, self._labels.left_out_px(frame))
        offset_ns = turned_ns(T_lidar_box[:, :3, 3], NOMINAL_PERIOD_NS)
        return Boxes(track, T_lidar_box, size_m, offset_ns, view=view)

    @cached_property
    def _labels(self) -> LabelFile | None:
        return LabelFile.read(self.where / "label_02" / f"{self._scene}.txt")

    @cached_property
    def _labelled_camera(self) -> Camera:
        known = self.cameras.get("image_02")
        return known or self._camera(self.where, "image_02", _SMALLEST_IMAGE_PX)

    def _calibration_file(self, path: Path) -> Path:
        return path / "calib" / f"{self._scene}.txt"

    def _T_rect_lidar(self, path: Path) -> Float:
        """(4,4) the rectified camera 0 from the scanner."""
        calibration = Calibration.read(self._calibration_file(path))
        R = np.eye(4)
        R[:3, :3] = calibration.rotation("R_rect")
        return R @ calibration.motion("Tr_velo_cam")

    def _camera(self, path: Path, name: str, size_px: tuple[int, int]) -> Camera:
        calibration = Calibration.read(self._calibration_file(path))
        key = f"P{name[-1]}"
        return rectified_camera(calibration, key, name, size_px, self._T_rect_lidar(path))
