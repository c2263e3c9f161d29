# SPDX-License-Identifier: MIT
"""Read KITTI tracking (Geiger et al., CVPR 2012), in ``training`` or ``testing``, by scene.

    velodyne/0000/000000.bin   image_02/0000/000000.png   calib/0000.txt   oxts/0000.txt
    label_02/0000.txt    optional: tracked boxes, a line for each object and frame

- Frame numbers are file numbers; sweeps can be missing. Sweep and images k are at k times 100 ms.
- Points of the HDL-64E are not deskewed; azimuth and a 100 ms revolution give the firing times.
- Images are rectified, with the size of the first image. ``calib`` has projections, R_rect,
  Tr_velo_cam and Tr_imu_velo. The world is the frame of the GPS/IMU unit (oxts) at frame 0.
- A label line is ``frame track type truncated occluded alpha left top right bottom height width
  length x y z rotation_y [score]``. x y z is the middle of the box's bottom in rectified camera 0,
  at the time at which the scanner faced the object. rotation_y is the heading about y, 0 along x.
  Only objects in view of image_02 have boxes; ``DontCare`` rectangles may hold more objects.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Bool, Boxes, BoxView, Camera, Float
from densify.readers import checks
from densify.readers.decoded_files import image_size_px
from densify.readers.kitti.drive import (
    NOMINAL_PERIOD_NS,
    Calibration,
    Drive,
    T_mercator_imu,
    parse_oxts,
    turned_ns,
)

_SMALLEST_IMAGE_PX = (1224, 370)
_T_CAM_UPRIGHT = np.array(  # from x right, y forward, z up
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def open_recording(path: Path, scene: str | None) -> KittiTracking:
    """Open a sequence, by its name such as ``0000``, of the folder that contains velodyne/."""
    names = sorted(p.name for p in (path / "velodyne").glob("*") if p.is_dir())
    none = "no KITTI tracking; expected folders such as velodyne/0000 in it"
    return KittiTracking(path, checks.chosen_scene("kitti-tracking", path, scene, names, none))


class KittiTracking(Drive):
    """A KITTI tracking sequence; a sweep is stamped as the scanner faces forward, every 100 ms."""

    def __init__(self, path: Path, scene: str) -> None:
        images = {folder.name: folder / scene for folder in sorted(path.glob("image_0[0-3]"))}
        name = f"{path.resolve().name}/{scene}"
        super().__init__(name, path, path / "velodyne" / scene, path, images)
        self._scene_file = f"{scene}.txt"
        self._stamps_ns = {frame: frame * NOMINAL_PERIOD_NS for frame in self.frames}
        for name, files in self._image_files.items():
            size_px = image_size_px(next(iter(files.values())))
            self.cameras = {**self.cameras, name: self._camera(name, size_px)}
        self._exposed_ns = {
            name: {frame: frame * NOMINAL_PERIOD_NS for frame in files}
            for name, files in self._image_files.items()
        }

    def gaps(self) -> list[str]:
        """Return the assumption about the rate, since the data set has no stamps."""
        return ["KITTI tracking has no stamps: sweeps are taken for 100 ms apart"]

    def _pose(self, frame: int) -> Float:
        path = self.where / "oxts" / self._scene_file
        if not path.exists():
            return super()._pose(frame)
        lines = dict(enumerate(read_text(path).splitlines()))
        first, record = (
            parse_oxts(checks.of_frame(lines, f, "oxts record", path), f"{path}: line {f + 1}")
            for f in (0, frame)
        )
        T_lidar_imu = self._calibration.motion("Tr_imu_velo")
        T_world_imu = poses.inverse(T_mercator_imu(first, first)) @ T_mercator_imu(record, first)
        return T_world_imu @ poses.inverse(T_lidar_imu)

    def boxes(self, frame: int) -> Boxes | None:
        """Return the labelled boxes of a sweep in the lidar frame, None without labels.

        Objects are labelled only in view of image_02; without images its smallest size is assumed.
        A box is where the object was when the scanner faced it, at the box's ``offset_ns``.
        """
        self.check_frame(frame)
        path = self.where / "label_02" / self._scene_file
        if not path.is_file():
            return None
        numbers, is_area = read_labels(path)
        # Columns: 0 frame, 1 track, 5 to 8 rectangle in the image, 9 to 15 box
        is_of_frame = numbers[:, 0] == frame
        labels, areas_px = numbers[is_of_frame & ~is_area], numbers[is_of_frame & is_area, 5:9]
        height_m, width_m, length_m, right, down, forward, turn = labels[:, 9:16].T
        centre_m = np.column_stack([right, forward, height_m / 2 - down])
        T_cam_box = _T_CAM_UPRIGHT @ checks.upright_poses(centre_m, -turn)
        T_lidar_box = poses.inverse(self._T_rect_lidar) @ T_cam_box
        size_m = np.column_stack([length_m, width_m, height_m])
        tracks = [f"{track:.0f}" for track in labels[:, 1]]
        checked = checks.boxes(tracks, T_lidar_box, size_m, f"{path}: frame {frame}")
        camera = self.cameras.get("image_02") or self._camera("image_02", _SMALLEST_IMAGE_PX)
        offset_ns = turned_ns(T_lidar_box[:, :3, 3], NOMINAL_PERIOD_NS)
        view = BoxView(camera, areas_px)
        return Boxes(checked.track, checked.T_lidar_box, size_m, offset_ns, view=view)

    @cached_property
    def _calibration(self) -> Calibration:
        return Calibration.read(self.where / "calib" / self._scene_file)

    @cached_property
    def _T_rect_lidar(self) -> Float:
        """The (4,4) transform from the lidar frame to the frame of rectified camera 0."""
        return self._calibration.rotation("R_rect") @ self._calibration.motion("Tr_velo_cam")

    def _camera(self, name: str, size_px: tuple[int, int]) -> Camera:
        return self._calibration.rectified_camera(f"P{name[-1]}", name, size_px, self._T_rect_lidar)


def read_labels(path: Path) -> tuple[Float, Bool]:
    """Return the (n,16) numbers of label lines, no type and score, and an (n,) DontCare mask."""
    rows, is_area = [], []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words:
            row = " ".join([*words[:2], *words[3:17]])  # a score may follow
            rows.append(checks.parse_numbers(row, f"{path}: line {number}", 16))
            is_area.append(words[2] == "DontCare")
    return np.reshape(rows, (-1, 16)), np.array(is_area, bool)
