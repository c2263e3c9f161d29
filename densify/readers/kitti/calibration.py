# SPDX-License-Identifier: MIT
"""What KITTI and its relatives share: sweeps, timestamps, calibration with its cameras, oxts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_text
from densify.geometry.types import Camera, Float, Float32, Int
from densify.readers.stamp_files import date_ns

_ORTHONORMAL_TOLERANCE = 1e-3  # calibration files carry seven digits
NOMINAL_PERIOD_NS = 100_000_000
"""The scanner turns at 10 Hz: the time from sweep to sweep where no stamps are recorded."""

NUM_OXTS_VALUES = 30
_EARTH_RADIUS_M = 6_378_137.0  # of the devkit's Mercator projection
_ENTRY = re.compile(r"\s*([^\s:]+)[:\s]\s*(.*)")
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
_EXPECTED = "expected a stamp such as 2011-09-26 13:10:51.158069617, from 1970 to 2261"


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


def read_points(path: Path) -> Float32:
    """(N,4) x, y, z in metres and reflectance; zeros where a row is not finite."""
    data = read_bytes(path)
    if len(data) % 16:
        raise InputError(
            f"{path}: truncated: got {len(data)} bytes, expected a multiple of 16 (x y z "
            f"reflectance as float32), {len(data) % 16} too many; fetch the file again"
        )
    columns = np.frombuffer(data, "<f4").reshape(-1, 4).astype(np.float32)
    finite = np.isfinite(columns)
    if not finite.all():
        columns[~finite.all(axis=1)] = 0
    return columns


def turned_ns(points: Float, revolution_ns: int) -> Int:
    """(N,3) raw points -> (N,) when each was fired, since the scanner faced forward: it turns
    clockwise, so a return fired ``-azimuth / 2π`` of the revolution after that."""
    revolution = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    return np.rint(revolution * revolution_ns).astype(np.int64)


def check_oxts(values: Float, where: str) -> Float:
    """An oxts record, if its latitude is one. Raises InputError, which starts with ``where``."""
    if abs(values[0]) >= 90:
        raise InputError(f"{where}: got a latitude of {values[0]:g} deg, expected -90 to 90")
    return values


def mercator_scale(oxts: Float) -> float:
    """The scale of the projection, from the first record of a drive."""
    return float(np.cos(np.deg2rad(oxts[0])))


def T_mercator_imu(oxts: Float, scale: float) -> Float:
    """(4,4) pose on the Mercator plane (east, north, up), as the devkit's convertOxtsToPose.

    oxts: (30,) latitude and longitude (deg), altitude (m), roll, pitch, yaw (rad), ...
    """
    lat_deg, lon_deg, alt_m, roll, pitch, yaw = oxts[:6]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[0, 3] = scale * _EARTH_RADIUS_M * np.deg2rad(lon_deg)
    T[1, 3] = scale * _EARTH_RADIUS_M * np.log(np.tan(np.deg2rad(90 + lat_deg) / 2))
    T[2, 3] = alt_m
    return T


@dataclass(frozen=True)
class Stamps:
    """A timestamps file: int64 nanoseconds by line number, None for a line that is blank or no
    stamp. One such line costs the frame it is of, not the drive."""

    path: Path
    lines: tuple[int | None, ...]
    texts: tuple[str, ...]

    @staticmethod
    def read(path: Path) -> Stamps | None:
        """None if there is no such file. Raises InputError if none of its lines is a stamp."""
        if not path.exists():
            return None
        texts = tuple(line.strip() for line in read_text(path).splitlines())
        stamps = Stamps(path, tuple(_stamp_ns(text) for text in texts), texts)
        wrong = next((row for row, text in enumerate(texts) if text), None)
        if wrong is not None and not any(ns is not None for ns in stamps.lines):
            raise InputError(f"{path}: line {wrong + 1}: got {texts[wrong]!r}, {_EXPECTED}")
        return stamps

    def get(self, frame: int) -> int | None:
        return self.lines[frame] if 0 <= frame < len(self.lines) else None

    def __getitem__(self, frame: int) -> int:
        stamp = self.get(frame)
        if stamp is None:
            got = f"{len(self.lines)} lines"
            if 0 <= frame < len(self.lines):
                got = repr(self.texts[frame]) if self.texts[frame] else "a blank line"
            raise InputError(
                f"{self.path}: no stamp of frame {frame}: got {got}, {_EXPECTED}, on line "
                f"{frame + 1} (one line per frame number, from 0)"
            )
        return stamp


def _stamp_ns(text: str) -> int | None:
    try:
        return date_ns(text) if _STAMP.fullmatch(text) else None
    except ValueError:
        return None


@dataclass(frozen=True)
class Calibration:
    """A calibration file of lines ``KEY: numbers``, the colon at will. Malformed entries raise
    InputError when asked for, naming file and key."""

    path: Path
    entries: Mapping[str, str]

    @staticmethod
    def read(path: Path) -> Calibration:
        if not path.is_file():
            raise InputError(
                f"{path}: missing; expected KITTI's calibration there (it is a download of its own)"
            )
        matches = (_ENTRY.match(line) for line in read_text(path).splitlines())
        return Calibration(path, {found[1]: found[2] for found in matches if found})

    def numbers(self, key: str, *shape: int) -> Float:
        if key not in self.entries:
            raise InputError(
                f"{self.path}: no key {key}; got {', '.join(self.entries) or 'no keys at all'}"
            )
        where = f"{self.path}: {key}"
        return parse_numbers(self.entries[key], where, int(np.prod(shape))).reshape(shape)

    def rotation(self, key: str) -> Float:
        return self._orthonormal(key, self.numbers(key, 3, 3))

    def motion(self, key: str) -> Float:
        """(4,4) of the twelve numbers of a key, the upper rows."""
        T = np.vstack([self.numbers(key, 3, 4), [0.0, 0.0, 0.0, 1.0]])
        self._orthonormal(key, T[:3, :3])
        return T

    def _orthonormal(self, key: str, R: Float) -> Float:
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


def camera_folders(drive: Path) -> list[str]:
    """Names of the cameras that have a folder in the drive."""
    return sorted(p.name for p in drive.glob("image_[0-9][0-9]") if p.is_dir())


def read_cameras(drive: Path) -> dict[str, Camera]:
    """Cameras by name: those with a folder in the drive and a rectified calibration in its parent;
    of a drive without any image folder all that are calibrated.

    K and the size come from ``P_rect`` and ``S_rect``, the images being rectified;
    ``T_cam_lidar`` is camera 0's rectification after ``calib_velo_to_cam``, moved by the camera's
    offset in ``P_rect``. Empty where there are neither image folders nor a calibration.
    """
    folder, names = drive.resolve().parent, camera_folders(drive)
    files = [folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt"]
    if not names and not all(file.is_file() for file in files):
        return {}
    calibration, to_lidar = map(Calibration.read, files)
    names = names or [f"image_{key[-2:]}" for key in calibration.entries if key[:-2] == "P_rect_"]
    T_rect_lidar = to_lidar.pose()
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
    size_px = read_size_px(calibration, f"S_rect_{number}")
    return rectified_camera(calibration, f"P_rect_{number}", name, size_px, T_rect_lidar)


def read_size_px(calibration: Calibration, key: str) -> tuple[int, int]:
    """Width and height."""
    width, height = calibration.numbers(key, 2)
    if min(width, height) < 1 or width % 1 or height % 1:
        raise InputError(
            f"{calibration.path}: {key}: got {width:g} x {height:g}, "
            f"expected the image's width and height in whole pixels"
        )
    return int(width), int(height)


def rectified_camera(
    calibration: Calibration, key: str, name: str, size_px: tuple[int, int], T_rect_lidar: Float
) -> Camera:
    """The camera of a projection matrix.

    T_rect_lidar: (4,4) to the rectified camera 0, from which P = K [I | t] moves by t.
    """
    P = calibration.numbers(key, 3, 4)
    K = P[:, :3]
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(
            f"{calibration.path}: {key}: got {np.array2string(K.ravel(), precision=4)}, "
            f"expected a projection with positive focal lengths and the last row 0 0 1"
        )
    T_cam_rect = np.eye(4)
    T_cam_rect[:3, 3] = np.linalg.solve(K, P[:, 3])
    return Camera(name, *size_px, K, T_cam_rect @ T_rect_lidar)
