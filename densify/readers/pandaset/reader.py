# SPDX-License-Identifier: MIT
"""PandaSet (Xiao et al., "PandaSet: Advanced Sensor Suite Dataset for Autonomous Driving", ITSC
2021): one sequence's folder, as downloaded::

    002/lidar/{00.pkl.gz, ..., poses.json, timestamps.json}
    002/camera/front_camera/{00.jpg, ..., poses.json, timestamps.json, intrinsics.json}
    002/annotations/cuboids/{00.pkl.gz, ...}    optional: tracked boxes

What the files say, and what was found where they are silent (sequence 002):

- A frame's number is its files'. Its stamp is the end of the sweep; every point has a time of its
  own, 0.14 s before the stamp to 0.015 s after it. The first scanner (``d`` 0, Pandar64) turns
  once in a sweep; the second (``d`` 1, PandarGT, forward, solid state) runs free of it.
- Points are in the world, ego-motion compensated: each was placed with the vehicle's pose at its
  own time. (Laid on other sweeps, a sweep's beginning and its end are off by the same, to 3 % of
  the vehicle's way between them, at 0.2 to 0.3 m/s.) Poses are the vehicle's, x right, y forward,
  z up, 10 Hz, quaternions by name. That their clock is the points' own is known to 20 ms only: the
  sequence looked at goes 0.4 m/s at most where there are sweeps.
- Where the scanners stand is not said. The Pandar64's place and axis are those that make its rings
  sharpest: the entropy of the elevations, minimised over place and tilt, gives all 64 rings, and
  the same place to 1 cm in different sweeps. Taking the axis for upright, 0.9 degrees off, puts the
  place a metre away. The PandarGT's place is the one from which the points of each of its mirror
  swings lie on the smoothest curve (from three starts the same to 1 mm). They are constants below,
  and the same vehicle drove all sequences.
- The lidar frame here is the Pandar64's: x forward, y left, z along its axis.
- Boxes are in the world. What moves where both scanners see it has two, each drawn around the
  points of one (``cuboids.sensor_id``) and under a name of its own, as the scanners meet it at
  different times. ``dimensions`` are width, length, height, and ``yaw`` turns the front from the
  world's y (the devkit's documentation; not tried on real boxes).
- Cameras are pinholes without distortion, as the data set's own tools project; their size is that
  of the images. Each image has a pose and a stamp of its own, 19 to 100 ms before the sweep's;
  where a camera sits is taken from that of its images at which the vehicle moved least.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json
from densify.geometry import poses
from densify.geometry.types import Boxes, Camera, Float, Int
from densify.readers.decoded_files import image_size_px
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    numbered_files,
    quaternion_pose,
    truth_beside,
)
from densify.readers.pandaset.cuboids import read_cuboids
from densify.readers.pandaset.pickled_frame import read_columns
from densify.readers.recorded_poses import PoseTrack

_AXIS = np.array([-0.0157, 0.00045, 1.0])  # of the Pandar64, forward left up
_PLACE_M = np.array([0.777, 0.002, 1.8593])
PANDAR_GT_M = np.array([0.580, 0.027, -0.294])
"""(3,) where the rays of the PandarGT start, in the Pandar64's frame."""

_LATEST_S = 4e9  # of stamps: the year 2096
_COLUMNS = ("x", "y", "z", "i", "t", "d")


def _T_pose_lidar() -> Float:
    forward_left_up = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    up = _AXIS / np.linalg.norm(_AXIS)
    forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    forward /= np.linalg.norm(forward)
    T = np.eye(4)
    T[:3, :3] = forward_left_up @ np.column_stack([forward, np.cross(up, forward), up])
    T[:3, 3] = forward_left_up @ _PLACE_M
    return T


T_POSE_LIDAR = _T_pose_lidar()
"""(4,4) from the Pandar64's frame to that of the poses in the files."""


def open_recording(path: Path, scene: str | None) -> PandaSet:
    """See `densify.readers.ReaderModule`; a sequence has no scenes."""
    return PandaSet(path)


class PandaSet(FileSequence):
    """A sequence as a `LidarSequence` with poses of its images."""

    def __init__(self, path: Path) -> None:
        """path: the sequence's folder. Raises InputError if it holds no sweeps, or poses, stamps or
        intrinsics are missing or malformed."""
        lidar = path / "lidar"
        if not lidar.is_dir():
            raise InputError(f"{path}: no PandaSet sequence; expected the folder lidar in it")
        self._sweeps = {
            int(file.name[:-7]): file
            for file in sorted(lidar.glob("*.pkl.gz"))
            if file.name[:-7].isdecimal()
        }
        if not self._sweeps:
            raise InputError(f"{lidar}: no sweeps; expected files such as 00.pkl.gz")
        self._stamps_ns = _stamps_ns(lidar)
        T_world_lidar = _poses(lidar) @ T_POSE_LIDAR
        _check_covers(lidar, list(self._sweeps), self._stamps_ns, T_world_lidar)
        num = min(len(self._stamps_ns), len(T_world_lidar))
        self._track = PoseTrack(
            str(lidar / "poses.json"), self._stamps_ns[:num], T_world_lidar[:num]
        )
        self._images: dict[str, dict[int, Path]] = {}
        self._T_world_cam: dict[str, Float] = {}
        cameras, exposed_ns = {}, {}
        for folder in sorted(path.glob("camera/*")):
            images = numbered_files(folder, ".jpg", ".png")
            if images:
                stamps_ns, T_world_cam = _stamps_ns(folder), _poses(folder)
                _check_covers(folder, list(images), stamps_ns, T_world_cam)
                self._images[folder.name], self._T_world_cam[folder.name] = images, T_world_cam
                calm = min(images, key=lambda n: self._way_m(int(stamps_ns[n])))
                T_cam_world = poses.inverse(T_world_cam[calm])
                T_cam_lidar = T_cam_world @ self._track.at(int(stamps_ns[calm]))
                cameras[folder.name] = _camera(folder, images[min(images)], T_cam_lidar)
                exposed_ns[folder.name] = {n: int(stamps_ns[n]) for n in images}
        super().__init__(
            path.resolve().name,
            path,
            tuple(sorted(self._sweeps)),
            cameras,
            exposed_ns,
            truth_beside(path),
            self._sweeps,
        )

    def stamp_ns(self, frame: int) -> int:
        """The end of the Pandar64's turn."""
        self.check_frame(frame)
        return int(self._stamps_ns[frame])

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) the data set's own pose of an image."""
        self.check_image(camera, number)
        return self._T_world_cam[camera][number]

    def boxes(self, frame: int) -> Boxes | None:
        """See `KnowsBoxes`; None without the frame's file. Raises InputError for one
        that is malformed."""
        self.check_frame(frame)
        path = self.where / "annotations" / "cuboids" / f"{frame:02d}.pkl.gz"
        if not path.is_file():
            return None
        return read_cuboids(path, self._pose(frame))

    def _way_m(self, stamp_ns: int) -> float:
        """How far the vehicle goes between the poses around that time: the nearer to nothing, the
        less does the pose between them differ from where it really was."""
        after = np.searchsorted(self._track.stamp_ns, stamp_ns)
        if not 0 < after < len(self._track.stamp_ns):
            return np.inf
        here, there = self._track.T_world_ego[after - 1 : after + 1, :3, 3]
        return float(np.linalg.norm(there - here))

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path, stamp_ns = self._sweeps[frame], self.stamp_ns(frame)
        columns = read_columns(path)
        missing = [name for name in _COLUMNS if name not in columns]
        if missing:
            raise InputError(
                f"{path}: no column {missing[0]}: got {' '.join(columns) or 'none'}, expected "
                f"{' '.join(_COLUMNS)}; use the data set's own lidar files"
            )
        x, y, z, brightness, time_s, scanner = (columns[name] for name in _COLUMNS)
        world = np.column_stack([x, y, z]).astype(np.float64)
        since_s = time_s - stamp_ns * 1e-9
        if not (np.abs(since_s) < 1.0).all():
            raise InputError(
                f"{path}: got times t up to {np.abs(since_s).max():.3g} s from the sweep's stamp, "
                f"expected seconds since 1970 within a second of it"
            )
        offset_ns = np.rint(since_s * 1e9).astype(np.int64)
        points = poses.transform(poses.inverse(self._track.at(stamp_ns)), world)
        return path, Returns(
            self._track.as_fired(points, stamp_ns, offset_ns),
            (brightness / 255).astype(np.float32),
            offset_ns,
            np.clip(scanner, 0, 1).astype(np.uint8),
            np.stack([np.zeros(3), PANDAR_GT_M]),
        )

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        path = self._images[camera][number]
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        return self._track.at(self.stamp_ns(frame))


def _stamps_ns(folder: Path) -> Int:
    """Seconds with six digits after the point, so that no nanosecond gets lost."""
    path = folder / "timestamps.json"
    try:
        stamps_s = np.array(read_json(path), np.float64)
        if stamps_s.ndim != 1 or not (np.abs(stamps_s) < _LATEST_S).all():
            raise ValueError("it is not a plain list of numbers, or they are no dates")
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}; expected a list of seconds") from None
    return np.rint(stamps_s * 1e6).astype(np.int64) * 1000


def _poses(folder: Path) -> Float:
    """(n,4,4)."""
    path, found = folder / "poses.json", []
    entries = read_json(path)
    for number, entry in enumerate(entries if isinstance(entries, list) else []):
        try:
            turn, place = entry["heading"], entry["position"]
            numbers = [turn[k] for k in "wxyz"], [place[k] for k in "xyz"]
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{path}: entry {number}: no {error}; expected heading w x y z and position x y z"
            ) from None
        found.append(quaternion_pose(*numbers, f"{path}: entry {number}"))
    return np.stack(found) if found else np.zeros((0, 4, 4))


def _check_covers(folder: Path, numbers: list[int], stamps_ns: Int, T_world: Float) -> None:
    for name, entries in (("timestamps", stamps_ns), ("poses", T_world)):
        if max(numbers) >= len(entries):
            raise InputError(
                f"{folder / name}.json: got {len(entries)} entries, expected one for each file up "
                f"to number {max(numbers)}"
            )


def _camera(folder: Path, image: Path, T_cam_lidar: Float) -> Camera:
    path = folder / "intrinsics.json"
    given = read_json(path)
    try:
        fx, fy, cx, cy = (float(given[name]) for name in ("fx", "fy", "cx", "cy"))
        if not (np.isfinite([cx, cy]).all() and 0 < fx < np.inf and 0 < fy < np.inf):
            raise ValueError(f"got fx {fx}, fy {fy}, cx {cx}, cy {cy}")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {error}; expected fx fy cx cy in pixels") from None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return Camera(folder.name, *image_size_px(image), K, T_cam_lidar)
