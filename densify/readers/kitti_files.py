# SPDX-License-Identifier: MIT
"""The small text files of a KITTI raw drive: timestamps, and calibration with its cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.errors import InputError
from densify.readers.files import read_text
from densify.types import Camera, Float

_ORTHONORMAL_TOLERANCE = 1e-3  # calibration files carry seven digits
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def parse_numbers(text: str, where: str, count: int) -> Float:
    """(count,) finite numbers of a line or file. Raises InputError that starts with ``where``."""
    words = text.split()
    if len(words) != count:
        raise InputError(f"{where}: got {len(words)} values, expected {count} numbers")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{where}: {error}; expected {count} numbers") from None
    if not np.isfinite(values).all():
        raise InputError(f"{where}: got a value that is not finite, expected {count} numbers")
    return values


@dataclass(frozen=True)
class Stamps:
    """A timestamps file: int64 nanoseconds by line number, None for a blank line."""

    path: Path
    lines: tuple[int | None, ...]

    @staticmethod
    def read(path: Path) -> Stamps | None:
        """None if there is no such file."""
        if not path.is_file():
            return None
        lines = read_text(path).splitlines()
        return Stamps(path, tuple(Stamps._parse(path, i, line) for i, line in enumerate(lines)))

    @staticmethod
    def _parse(path: Path, index: int, line: str) -> int | None:
        text = line.strip()
        if not text:
            return None
        try:
            if not _STAMP.fullmatch(text):
                raise ValueError
            return int(np.datetime64(text, "ns").astype(np.int64))  # never through a float
        except ValueError:
            raise InputError(
                f"{path}: line {index + 1}: got {text!r}, "
                f"expected a stamp such as 2011-09-26 13:10:51.158069617"
            ) from None

    def get(self, frame: int) -> int | None:
        return self.lines[frame] if 0 <= frame < len(self.lines) else None

    def __getitem__(self, frame: int) -> int:
        stamp = self.get(frame)
        if stamp is None:
            got = "a blank line" if frame < len(self.lines) else f"{len(self.lines)} lines"
            raise InputError(
                f"{self.path}: no stamp of frame {frame}: got {got}, expected the stamp on line "
                f"{frame + 1} (one line per frame number, from 0)"
            )
        return stamp


@dataclass(frozen=True)
class Calibration:
    """A calibration file of lines ``KEY: numbers``. Malformed entries raise InputError when asked
    for, naming file and key."""

    path: Path
    entries: Mapping[str, str]

    @staticmethod
    def read(path: Path) -> Calibration:
        if not path.is_file():
            raise InputError(
                f"{path}: missing; expected KITTI's calibration files in the folder that holds the "
                f"drive (they are a download of their own)"
            )
        pairs = (line.partition(":") for line in read_text(path).splitlines())
        return Calibration(path, {key.strip(): value for key, colon, value in pairs if colon})

    def numbers(self, key: str, *shape: int) -> Float:
        if key not in self.entries:
            raise InputError(
                f"{self.path}: no key {key}; got {', '.join(self.entries) or 'no keys at all'}"
            )
        where = f"{self.path}: {key}"
        return parse_numbers(self.entries[key], where, int(np.prod(shape))).reshape(shape)

    def rotation(self, key: str) -> Float:
        R = self.numbers(key, 3, 3)
        error = np.abs(R @ R.T - np.eye(3)).max()
        if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(R) < 0:
            raise InputError(
                f"{self.path}: {key}: got a matrix that is not a rotation (R Rᵀ is off by "
                f"{error:.2g}, determinant {np.linalg.det(R):.3f}), expected an orthonormal one"
            )
        return R

    def pose(self) -> Float:
        """(4,4) of the keys R and T."""
        T = np.eye(4)
        T[:3, :3] = self.rotation("R")
        T[:3, 3] = self.numbers("T", 3)
        return T


def read_cameras(drive: Path) -> dict[str, Camera]:
    """Cameras by name: those with a folder in the drive and a rectified calibration in its parent.

    K and the size come from ``P_rect`` and ``S_rect``, the images being rectified;
    ``T_cam_lidar`` is camera 0's rectification after ``calib_velo_to_cam``, moved by the camera's
    offset in ``P_rect``. Empty for a drive without image folders.
    """
    names = sorted(p.name for p in drive.glob("image_[0-9][0-9]") if p.is_dir())
    if not names:
        return {}
    folder = drive.resolve().parent
    calibration = Calibration.read(folder / "calib_cam_to_cam.txt")
    T_rect_lidar = Calibration.read(folder / "calib_velo_to_cam.txt").pose()
    R = np.eye(4)
    R[:3, :3] = calibration.rotation("R_rect_00")
    T_rect_lidar = R @ T_rect_lidar
    return {
        name: _read_camera(calibration, name, T_rect_lidar)
        for name in names
        if f"P_rect_{name[-2:]}" in calibration.entries
    }


def _read_camera(calibration: Calibration, name: str, T_rect_lidar: Float) -> Camera:
    number = name[-2:]
    P = calibration.numbers(f"P_rect_{number}", 3, 4)
    K = P[:, :3]
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(
            f"{calibration.path}: P_rect_{number}: got {np.array2string(K.ravel(), precision=4)}, "
            f"expected a projection with positive focal lengths and the last row 0 0 1"
        )
    width, height = calibration.numbers(f"S_rect_{number}", 2)
    if min(width, height) < 1 or width % 1 or height % 1:
        raise InputError(
            f"{calibration.path}: S_rect_{number}: got {width:g} x {height:g}, "
            f"expected the image's width and height in whole pixels"
        )
    # P = K [I | t], t the offset of this camera from the rectified camera 0.
    T_cam_rect = np.eye(4)
    T_cam_rect[:3, 3] = np.linalg.solve(K, P[:, 3])
    return Camera(name, int(width), int(height), K, T_cam_rect @ T_rect_lidar)
