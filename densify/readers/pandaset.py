# SPDX-License-Identifier: MIT
"""Read PandaSet (Xiao et al., ITSC 2021): the folder of one sequence, as downloaded.

    002/lidar/{00.pkl.gz, ..., poses.json, timestamps.json}
    002/camera/front_camera/{00.jpg, ..., poses.json, timestamps.json, intrinsics.json}
    002/annotations/cuboids/{00.pkl.gz, ...}    optional: tracked boxes

- A frame is numbered as its files; its stamp is the end of the sweep. The first scanner (``d`` 0,
  Pandar64) turns once in a sweep. The second (``d`` 1, PandarGT, forward) is not synchronised.
- Points are in the world, each transformed by the vehicle's pose at its firing time. The vehicle's
  poses are at 10 Hz, x right, y forward, z up. The clocks of poses and points agree to 20 ms.
- The lidar frame is the Pandar64's: x forward, y left, z along its axis.
- Boxes are in the world. An object that both scanners observe has a box for each of them
  (``cuboids.sensor_id``). ``dimensions`` are width, length, height. ``yaw`` is measured from the
  world's y axis to the front of the box (as in the devkit; not tried on real boxes).
- Cameras are pinholes without distortion, as large as their images. Each image has a pose and a
  stamp. A camera's mounting is computed from the image at which the vehicle moved least.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import described_in, read_json
from densify.geometry import poses
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers import checks
from densify.readers.decoded_files import image_size_px, read_pickled
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.recorded_poses import PoseTrack

# The positions of the scanners are not published. These make the rings of the Pandar64 sharpest and
# the swings of the PandarGT's mirror smoothest. The same vehicle drove all sequences.
_POSITION_M = np.array([0.777, 0.002, 1.8593])  # position of the Pandar64, forward left up
_AXIS = np.array([-0.0157, 0.00045, 1.0])  # axis about which it spins, forward left up
PANDAR_GT_M = np.array([0.580, 0.027, -0.294])
"""(3,) origin of the PandarGT's rays in the Pandar64's frame."""

_R_POSE_VEHICLE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_UP = _AXIS / np.linalg.norm(_AXIS)
_LEFT = np.cross(_UP, [1.0, 0.0, 0.0]) / np.hypot(_UP[1], _UP[2])
T_POSE_LIDAR = np.eye(4)
T_POSE_LIDAR[:3, :3] = _R_POSE_VEHICLE @ np.column_stack([np.cross(_LEFT, _UP), _LEFT, _UP])
T_POSE_LIDAR[:3, 3] = _R_POSE_VEHICLE @ _POSITION_M
"""(4,4) pose of the lidar frame (Pandar64) in the vehicle frame of the pose files."""

_LATEST_S = 4e9  # latest accepted stamp: the year 2096
_FIRST_CAMERA = "front_camera"
_CENTRE = tuple(f"position.{axis}" for axis in "xyz")
_LENGTH_WIDTH_HEIGHT = tuple(f"dimensions.{axis}" for axis in "yxz")


def open_recording(path: Path, scene: str | None) -> PandaSet:
    """Return the PandaSet sequence in a folder, which has no scenes."""
    return PandaSet(path)


class PandaSet(FileSequence):
    """A PandaSet sequence with a recorded pose for each image, stamped at the end of each turn."""

    def __init__(self, path: Path) -> None:
        lidar = path / "lidar"
        named = {file.name.removesuffix(".pkl.gz"): file for file in sorted(lidar.glob("*.pkl.gz"))}
        sweeps = {int(name): file for name, file in named.items() if name.isdecimal()}
        if not sweeps:
            raise InputError(
                f"{path}: no sweeps; expected a PandaSet sequence with files such as "
                f"lidar/00.pkl.gz"
            )
        self._stamps_ns, T_world_pose = _stamped_poses(lidar, max(sweeps))
        T_world_lidar = T_world_pose @ T_POSE_LIDAR
        self._track = PoseTrack(str(lidar / "poses.json"), self._stamps_ns, T_world_lidar)
        # Where the vehicle moves little from pose to pose, interpolation errs little.
        moved_m = np.linalg.norm(np.diff(T_world_lidar[:, :3, 3], axis=0), axis=1)
        moved_m = np.pad(moved_m, 1, constant_values=np.inf)  # no images outside the poses
        images, cameras, exposed_ns = {}, {}, {}
        self._T_world_cam: dict[str, Float] = {}
        folders = sorted(path.glob("camera/*"), key=lambda p: (p.name != _FIRST_CAMERA, p.name))
        for folder in folders:
            name = folder.name
            if files := checks.numbered_files(folder, ".jpg", ".png"):
                images_ns, self._T_world_cam[name] = _stamped_poses(folder, max(files))
                images[name] = files
                exposed_ns[name] = {number: int(images_ns[number]) for number in files}
                # The mounting of the camera, from the image at which the vehicle moved least
                pose_after = np.searchsorted(self._stamps_ns, images_ns[[*files]])
                number = [*files][int(np.argmin(moved_m[pose_after]))]
                T_cam_world = poses.inverse(self._T_world_cam[name][number])
                T_cam_lidar = T_cam_world @ self._track.at(exposed_ns[name][number])
                cameras[name] = _camera(folder, files[min(files)], T_cam_lidar)
        super().__init__(
            path.resolve().name,
            path,
            tuple(sorted(sweeps)),
            cameras,
            exposed_ns,
            truth=checks.truth_beside(path),
            files=sweeps,
            images=images,
        )

    def T_world_cam(self, camera: str, number: int) -> Float:
        """Return the recorded (4,4) pose T_world_cam of image ``number`` of a camera."""
        self.check_image(camera, number)
        return self._T_world_cam[camera][number]

    def _returns(self, frame: int) -> Returns:
        """Read the points of a sweep, and move them from the world to where they were fired."""
        path, stamp_ns = self._files[frame], self.stamp_ns(frame)
        columns = read_pickled(path)
        x, y, z, brightness, time_s, scanner = (
            np.asarray(columns[name], np.float64) for name in ("x", "y", "z", "i", "t", "d")
        )
        since_s = time_s - stamp_ns * 1e-9
        if not (np.abs(since_s) < 1.0).all():
            raise InputError(
                f"{path}: got times t up to {np.abs(since_s).max():.3g} s from the sweep's stamp, "
                f"expected seconds since 1970 within a second of it"
            )
        offset_ns = np.rint(since_s * 1e9).astype(np.int64)
        T_lidar_world = poses.inverse(self._track.at(stamp_ns))
        points = poses.transform(T_lidar_world, np.column_stack([x, y, z]))
        return Returns(
            self._track.undo_compensation(points, stamp_ns, offset_ns),
            (brightness / 255).astype(np.float32),
            offset_ns,
            lidar=np.clip(scanner, 0, 1).astype(np.uint8),
            scanner_origins=np.stack([np.zeros(3), PANDAR_GT_M]),
        )

    def _pose(self, frame: int) -> Float:
        return self._track.at(self.stamp_ns(frame))

    def boxes(self, frame: int) -> Boxes | None:
        """Return the boxes of a sweep in the lidar frame, or None without a file of boxes."""
        self.check_frame(frame)
        path = self.where / "annotations" / "cuboids" / f"{frame:02d}.pkl.gz"
        if not path.is_file():
            return None
        columns = read_pickled(path)
        with described_in(path, "the cuboids of PandaSet"):
            texts = [str(text) for text in columns["uuid"]]
            centre_m, size_m, yaw_and_scanner = (
                np.column_stack([np.asarray(columns[name], np.float64) for name in names])
                for names in (_CENTRE, _LENGTH_WIDTH_HEIGHT, ("yaw", "cuboids.sensor_id"))
            )
        yaw_rad, scanner = yaw_and_scanner.T
        T_world_box = checks.upright_poses(centre_m, yaw_rad + np.pi / 2)
        T_lidar_box = poses.inverse(self._pose(frame)) @ T_world_box
        return checks.boxes(texts, T_lidar_box, size_m, str(path), lidar=scanner.astype(np.int64))


def _stamped_poses(folder: Path, last: int) -> tuple[Int, Float]:
    """Return (n,) stamps in ns and (n,4,4) world poses by file number, up to ``last`` or more."""
    path = folder / "timestamps.json"
    with described_in(path, "a list of seconds"):
        stamps_s = np.array(read_json(path), np.float64).reshape(-1)
        if not (np.abs(stamps_s) < _LATEST_S).all():
            raise ValueError("they are no dates")
    stamps_ns = np.rint(stamps_s * 1e6).astype(np.int64) * 1000  # six digits after the point
    path, T = folder / "poses.json", []
    with described_in(path, "a list of heading w x y z and position x y z"):
        for number, entry in enumerate(read_json(path)):
            heading, position = entry["heading"], entry["position"]
            values = [heading[k] for k in "wxyz"], [position[k] for k in "xyz"]
            T.append(checks.quaternion_pose(*values, f"{path}: entry {number}"))
    num_entries = min(len(stamps_ns), len(T))
    if last >= num_entries:
        raise InputError(
            f"{folder}: got {num_entries} entries in poses.json and timestamps.json, expected one "
            f"for each file up to number {last}"
        )
    return stamps_ns[:num_entries], np.stack(T[:num_entries])


def _camera(folder: Path, image: Path, T_cam_lidar: Float) -> Camera:
    path = folder / "intrinsics.json"
    intrinsics = read_json(path)
    with described_in(path, "fx fy cx cy in pixels"):
        fx_fy_cx_cy = [float(intrinsics[name]) for name in ("fx", "fy", "cx", "cy")]
    return checks.pinhole(folder.name, image_size_px(image), fx_fy_cx_cy, T_cam_lidar, str(path))
