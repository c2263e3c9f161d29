# SPDX-License-Identifier: MIT
"""What the forms of KITTI share: sweeps, stamps, calibration with its cameras, oxts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_text
from densify.geometry.types import Camera, Float, Float32, Int
from densify.readers.file_sequence import check_rotation, numbered_files, parse_numbers, rigid
from densify.readers.stamp_files import date_ns

NOMINAL_PERIOD_NS = 100_000_000
"""Time from sweep to sweep where no stamps are recorded: the scanner turns at 10 Hz."""

_NUM_OXTS_VALUES = 30
_EARTH_RADIUS_M = 6_378_137.0  # of the devkit's Mercator projection
_ENTRY = re.compile(r"\s*([^\s:]+)[:\s]\s*(.*)")
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
_EXPECTED = "expected a stamp such as 2011-09-26 13:10:51.158069617, from 1970 to 2261"


def find_sweeps(folder: Path, example: str) -> dict[int, Path]:
    """Return the sweeps of a folder by number. Raises InputError if there are none."""
    sweeps = numbered_files(folder, ".bin")
    if not sweeps:
        raise InputError(f"{folder}: no sweeps; expected files such as {example}")
    return sweeps


def read_points(path: Path) -> Float32:
    """Return (N,4) x, y, z in metres and reflectance; zeros where a row is not finite."""
    data = read_bytes(path)
    if len(data) % 16:
        raise InputError(
            f"{path}: truncated: got {len(data)} bytes, expected a multiple of 16 (x y z "
            f"reflectance as float32), {len(data) % 16} too many; fetch the file again"
        )
    columns = np.frombuffer(data, "<f4").reshape(-1, 4).astype(np.float32)
    columns[~np.isfinite(columns).all(axis=1)] = 0
    return columns


def turned_ns(points: Float, revolution_ns: int) -> Int:
    """(N,3) raw points -> (N,) when each was fired, since the scanner faced forward. It turns
    clockwise: a return was fired ``-azimuth / 2π`` of the revolution after that."""
    revolution = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    return np.rint(revolution * revolution_ns).astype(np.int64)


def parse_oxts(text: str, where: str) -> Float:
    """Return the (30,) numbers of an oxts record: latitude and longitude (deg), altitude (m), roll,
    pitch, yaw (rad), ... Raises InputError, which starts with ``where``."""
    values = parse_numbers(text, where, _NUM_OXTS_VALUES)
    if abs(values[0]) >= 90:
        raise InputError(f"{where}: got a latitude of {values[0]:g} deg, expected -90 to 90")
    return values


def T_mercator_imu(oxts: Float, first: Float) -> Float:
    """Return the (4,4) pose on the Mercator plane (east, north, up), as the devkit's
    convertOxtsToPose.

    oxts, first: (30,) the record, and the first one of the drive, whose latitude gives the scale.
    """
    lat_deg, lon_deg, alt_m, roll, pitch, yaw = oxts[:6]
    scale_m = _EARTH_RADIUS_M * np.cos(np.deg2rad(first[0]))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[0, 3] = scale_m * np.deg2rad(lon_deg)
    T[1, 3] = scale_m * np.log(np.tan(np.deg2rad(90 + lat_deg) / 2))
    T[2, 3] = alt_m
    return T


@dataclass(frozen=True)
class Stamps:
    """A timestamps file: its lines by frame number, from 0. A line that is no stamp costs the frame
    it belongs to, not the drive."""

    path: Path
    texts: tuple[str, ...]

    @staticmethod
    def read(path: Path) -> Stamps | None:
        """Return None if there is no such file. Raises InputError if no line of it is a stamp."""
        if not path.exists():
            return None
        stamps = Stamps(path, tuple(line.strip() for line in read_text(path).splitlines()))
        wrong = next((row for row, text in enumerate(stamps.texts) if text), None)
        if wrong is not None and not any(ns is not None for ns in stamps.lines):
            raise InputError(f"{path}: line {wrong + 1}: got {stamps.texts[wrong]!r}, {_EXPECTED}")
        return stamps

    @cached_property
    def lines(self) -> tuple[int | None, ...]:
        """Return the stamps (ns), None for a line that is none."""
        return tuple(_stamp_ns(text) for text in self.texts)

    def get(self, frame: int) -> int | None:
        return self.lines[frame] if 0 <= frame < len(self.lines) else None

    def __getitem__(self, frame: int) -> int:
        stamp = self.get(frame)
        if stamp is None:
            got = f"{len(self.texts)} lines"
            if 0 <= frame < len(self.texts):
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


def usual_period_ns(stamps_ns: Iterable[int | None]) -> int:
    """Return the median time from one known stamp to the next, the nominal one for fewer than
    two."""
    known = [ns for ns in stamps_ns if ns is not None]
    return int(np.median(np.diff(known))) if len(known) > 1 else NOMINAL_PERIOD_NS


@dataclass(frozen=True)
class Calibration:
    """A calibration file of lines ``KEY: numbers``, with or without the colon. Malformed entries
    raise InputError when asked for, naming file and key."""

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
        """Return (4,4) of the key's (3,3) rotation."""
        T = np.eye(4)
        T[:3, :3] = check_rotation(self.numbers(key, 3, 3), f"{self.path}: {key}")
        return T

    def motion(self, key: str) -> Float:
        """Return (4,4) of the twelve numbers of a key, the upper rows."""
        return rigid(self.numbers(key, 3, 4), f"{self.path}: {key}")

    def pose(self) -> Float:
        """Return (4,4) of the keys R and T."""
        T = self.rotation("R")
        T[:3, 3] = self.numbers("T", 3)
        return T

    def size_px(self, key: str) -> tuple[int, int]:
        """Return width and height."""
        width, height = self.numbers(key, 2)
        if min(width, height) < 1 or width % 1 or height % 1:
            raise InputError(
                f"{self.path}: {key}: got {width:g} x {height:g}, "
                f"expected the image's width and height in whole pixels"
            )
        return int(width), int(height)

    def rectified_camera(
        self, key: str, name: str, size_px: tuple[int, int], T_rect_lidar: Float
    ) -> Camera:
        """Return the camera of a projection matrix.

        T_rect_lidar: (4,4) to the rectified camera 0, from which P = K [I | t] moves by t.
        """
        P = self.numbers(key, 3, 4)
        K = P[:, :3]
        last = K[[1, 2, 2, 2], [0, 0, 1, 2]]
        if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(last, [0, 0, 0, 1]):
            raise InputError(
                f"{self.path}: {key}: got {np.array2string(K.ravel(), precision=4)}, "
                f"expected a projection with positive focal lengths and the last row 0 0 1"
            )
        T_cam_rect = np.eye(4)
        T_cam_rect[:3, 3] = np.linalg.solve(K, P[:, 3])
        return Camera(name, *size_px, K, T_cam_rect @ T_rect_lidar)
