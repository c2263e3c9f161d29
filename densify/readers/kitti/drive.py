# SPDX-License-Identifier: MIT
"""Read what KITTI's data sets share: HDL-64E sweeps, images, stamps, calibration, GPS/IMU poses."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_text
from densify.geometry.types import Camera, Float, Int
from densify.readers import checks
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.stamp_files import date_ns

NOMINAL_PERIOD_NS = 100_000_000
"""Time from sweep to sweep where no stamps are recorded: the scanner turns at 10 Hz."""

_EARTH_RADIUS_M = 6_378_137.0  # of the devkit's Mercator projection
_ENTRY = re.compile(r"\s*([^\s:]+)[:\s]\s*(.*)")
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


class Drive(FileSequence):
    """Numbered sweeps of an HDL-64E, which turns clockwise and is stamped when it faces forward."""

    revolution_ns: int = NOMINAL_PERIOD_NS  # a subclass may set it

    def __init__(
        self, name: str, where: Path, sweeps: Path, truth: Path, images: Mapping[str, Path]
    ) -> None:
        """Find the .bin files in ``sweeps`` and the images; truth/ may be in ``truth``."""
        files = checks.numbered_files(sweeps, ".bin")
        if not files:
            raise InputError(f"{sweeps}: no sweeps; expected files such as 0000000120.bin")
        numbered = {n: checks.numbered_files(p, ".png", ".jpg", ".jpeg") for n, p in images.items()}
        super().__init__(
            name,
            where,
            tuple(files),
            truth=checks.truth_beside(truth),
            files=files,
            images={name: numbers for name, numbers in numbered.items() if numbers},
        )

    def _returns(self, frame: int) -> Returns:
        points, intensity = read_points(self._files[frame])
        return Returns(points, intensity, turned_ns(points, self.revolution_ns))


def read_points(path: Path) -> tuple[Float, np.ndarray]:
    """Read (N,3) points (m, lidar frame, 0 0 0 if not finite) and (N,) reflectances (0 to 1)."""
    data = read_bytes(path)
    if len(data) % 16:
        raise InputError(
            f"{path}: truncated: got {len(data)} bytes, expected a multiple of 16 (x y z "
            f"reflectance as float32); fetch the file again"
        )
    columns = np.frombuffer(data, "<f4").reshape(-1, 4).astype(np.float32)
    columns[~np.isfinite(columns[:, :3]).all(axis=1)] = 0
    return columns[:, :3].astype(np.float64), columns[:, 3]


def turned_ns(points: Float, revolution_ns: int) -> Int:
    """Return (N,) int64 firing times of points, not deskewed, since the scanner faced forward."""
    # -0.5 to 0.5: firing times of the first half are negative
    revolution = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    return np.rint(revolution * revolution_ns).astype(np.int64)


def read_stamps(path: Path) -> dict[int, int]:
    """Return stamps (ns since 1970) by frame, the line's number from 0; other lines are skipped."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    stamps_ns = {}
    for frame, line in enumerate(lines):
        try:
            if _STAMP.fullmatch(line):
                stamps_ns[frame] = date_ns(line)
        except ValueError:  # a thirteenth month
            continue
    wrong = next((line for line in lines if line), None)
    if wrong is not None and not stamps_ns:
        raise InputError(
            f"{path}: got {wrong!r}, expected stamps such as 2011-09-26 13:10:51.158069617, from "
            f"1970 to 2261, a line for each frame"
        )
    return stamps_ns


def usual_period_ns(stamps_ns: Iterable[int]) -> int:
    """Return the median time between consecutive stamps; 100 ms for fewer than two stamps."""
    steps_ns = np.diff(list(stamps_ns))
    return int(np.median(steps_ns)) if len(steps_ns) else NOMINAL_PERIOD_NS


def parse_oxts(text: str, where: str) -> Float:
    """Return the (30,) numbers of a record of the GPS/IMU unit; errors begin with ``where``.

    The first six are latitude and longitude (deg), altitude (m), roll, pitch and yaw (rad).
    """
    values = checks.parse_numbers(text, where, 30)
    if abs(values[0]) >= 90:
        raise InputError(f"{where}: got a latitude of {values[0]:g} deg, expected -90 to 90")
    return values


def T_mercator_imu(oxts: Float, first: Float) -> Float:
    """Return the (4,4) pose of the GPS/IMU unit on the Mercator plane (x east, y north, z up)."""
    # As convertOxtsToPose of KITTI's devkit: the drive's first record determines the scale.
    lat_deg, lon_deg, alt_m, roll, pitch, yaw = oxts[:6]
    scale_m = _EARTH_RADIUS_M * np.cos(np.deg2rad(first[0]))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[0, 3] = scale_m * np.deg2rad(lon_deg)
    T[1, 3] = scale_m * np.log(np.tan(np.deg2rad(90 + lat_deg) / 2))
    T[2, 3] = alt_m
    return T


@dataclass(frozen=True)
class Calibration:
    """A file of lines ``KEY: numbers``, colon optional; bad entries raise InputError on request."""

    path: Path
    entries: Mapping[str, str]

    @staticmethod
    def read(path: Path) -> Calibration:
        """Read a calibration file; raise InputError if the file is missing."""
        if not path.is_file():
            raise InputError(
                f"{path}: missing; expected KITTI's calibration there (it is a download of its own)"
            )
        matches = (_ENTRY.match(line) for line in read_text(path).splitlines())
        return Calibration(path, {match[1]: match[2] for match in matches if match})

    def numbers(self, key: str, *shape: int) -> Float:
        """Return the numbers of an entry as an array of the given shape."""
        if key not in self.entries:
            raise InputError(f"{self.path}: no key {key}; got {', '.join(self.entries)}")
        where = f"{self.path}: {key}"
        return checks.parse_numbers(self.entries[key], where, int(np.prod(shape))).reshape(shape)

    def rotation(self, key: str) -> Float:
        """Return the (4,4) transform of an entry with nine numbers, a (3,3) rotation."""
        T = np.eye(4)
        T[:3, :3] = checks.rotation(self.numbers(key, 3, 3), f"{self.path}: {key}")
        return T

    def motion(self, key: str) -> Float:
        """Return the (4,4) transform of an entry with twelve numbers, its upper three rows."""
        return checks.rigid(self.numbers(key, 3, 4), f"{self.path}: {key}")

    def pose(self) -> Float:
        """Return the (4,4) transform of the entries R (rotation) and T (translation)."""
        T = self.rotation("R")
        T[:3, 3] = self.numbers("T", 3)
        return T

    def size_px(self, key: str) -> tuple[int, int]:
        """Return the width and height of an entry with an image size."""
        width, height = self.numbers(key, 2)
        return int(width), int(height)

    def rectified_camera(
        self, key: str, name: str, size_px: tuple[int, int], T_rect_lidar: Float
    ) -> Camera:
        """Return the rectified camera of an entry with a projection matrix P = K [I | t].

        ``T_rect_lidar`` (4,4) maps the lidar frame to the frame of rectified camera 0.
        """
        P = self.numbers(key, 3, 4)
        fx_fy_cx_cy, T_cam_rect = P[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), np.eye(4)
        camera = checks.pinhole(name, size_px, fx_fy_cx_cy, T_rect_lidar, f"{self.path}: {key}")
        T_cam_rect[:3, 3] = np.linalg.solve(camera.K, P[:, 3])
        return replace(camera, T_cam_lidar=T_cam_rect @ T_rect_lidar)
