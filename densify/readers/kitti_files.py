# SPDX-License-Identifier: MIT
"""Read the files of KITTI's data sets: sweeps, stamps, GPS/IMU records, calibration, boxes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import described_in, parse_yaml, read_bytes, read_text
from densify.geometry import poses
from densify.geometry.clock import share_of_turn
from densify.geometry.types import Bool, Camera, Float, Int
from densify.readers import checks
from densify.readers.stamped_files import date_ns

NOMINAL_PERIOD_NS = 100_000_000
"""Time from sweep to sweep where no stamps are recorded: the scanner turns at 10 Hz."""

_EARTH_RADIUS_M = 6_378_137.0  # of the devkit's Mercator projection
_ENTRY = re.compile(r"\s*([^\s:]+)[:\s]\s*(.*)")
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
_HALF_VIEW_DEG = 90.0  # of a fisheye


def read_points(path: Path) -> tuple[Float, np.ndarray]:
    """Return the (N,3) points of a sweep in metres, lidar frame, and (N,) reflectances, 0 to 1.

    A point that is not finite becomes 0 0 0. Raise InputError if the file is cut off.
    """
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
    """Return the (N,) int64 times in ns from facing forward to the firing at each point.

    The scanner turns clockwise. The times are from minus half to plus half of ``revolution_ns``,
    the duration of a revolution. ``points`` (N,3) are in the lidar frame and not deskewed.
    """
    return np.rint(share_of_turn(points) * revolution_ns).astype(np.int64)


@dataclass(frozen=True)
class Stamps:
    """Times (ns) by frame, from a file with a line for each frame from 0."""

    path: Path
    by_frame: Mapping[int, int]  # empty without the file: frame k is at k times 100 ms

    def at(self, frame: int) -> int:
        """Return the time of a frame in ns. Raise InputError if the file lacks the frame."""
        if not self.by_frame:
            return frame * NOMINAL_PERIOD_NS
        return checks.find_entry(self.by_frame, frame, "stamp", self.path)

    def of(self, frames: Mapping[int, Path]) -> dict[int, int]:
        """Return frame -> time in ns for the given frames that have a time."""
        known = self.by_frame or frames
        return {frame: self.at(frame) for frame in frames if frame in known}

    @property
    def period_ns(self) -> int:
        """Median time between consecutive stamps in ns, 100 ms for fewer than two stamps."""
        steps_ns = np.diff(list(self.by_frame.values()))
        return int(np.median(steps_ns)) if len(steps_ns) else NOMINAL_PERIOD_NS


def read_stamps(path: Path, required: bool = True) -> Stamps:
    """Return the stamps of a file with a date (UTC) on line k for frame k.

    A line without a date gives no stamp. Raise InputError if the file has lines but no date, or is
    missing and ``required``.
    """
    if not required and not path.exists():
        return Stamps(path, {})
    lines = [line.strip() for line in read_text(path).splitlines()]
    by_frame = {}
    for frame, line in enumerate(lines):
        try:
            if _STAMP.fullmatch(line):
                by_frame[frame] = date_ns(line)
        except ValueError:  # a thirteenth month
            continue
    if not by_frame and any(lines):
        raise InputError(
            f"{path}: got {next(filter(None, lines))!r}, expected stamps such as 2011-09-26 "
            f"13:10:51.158069617, from 1970 to 2261, a line for each frame"
        )
    return Stamps(path, by_frame)


def parse_oxts(text: str, where: str) -> Float:
    """Return the 30 numbers of a GPS/IMU record as (30,).

    They begin with latitude and longitude (deg), altitude (m), roll, pitch and yaw (rad).
    """
    values = checks.parse_numbers(text, where, 30)
    lat_deg = values[0]
    if abs(lat_deg) >= 90:  # the Mercator projection has no poles
        raise InputError(f"{where}: got a latitude of {lat_deg:g} deg, expected -90 to 90")
    return values


def T_first_imu(first: Float, record: Float) -> Float:
    """Return the (4,4) GPS/IMU pose at ``record`` in the unit's frame at ``first``, both (30,)."""
    return poses.inverse(_T_mercator_imu(first, first)) @ _T_mercator_imu(record, first)


def _T_mercator_imu(oxts: Float, first: Float) -> Float:
    """Return the (4,4) pose on the Mercator plane (x east, y north, z up)."""
    # As convertOxtsToPose of KITTI's devkit: the drive's first record determines the scale.
    # x = scale lon, y = scale ln tan((90 deg + lat) / 2), scale = radius cos(first lat)
    lat_deg, lon_deg, alt_m, roll, pitch, yaw = oxts[:6]
    first_lat_deg = first[0]
    scale_m = _EARTH_RADIUS_M * np.cos(np.deg2rad(first_lat_deg))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[0, 3] = scale_m * np.deg2rad(lon_deg)
    T[1, 3] = scale_m * np.log(np.tan(np.deg2rad(90 + lat_deg) / 2))
    T[2, 3] = alt_m
    return T


@dataclass(frozen=True)
class Calibration:
    """A file of lines ``KEY: numbers``, colon optional. A malformed entry raises InputError."""

    path: Path
    entries: Mapping[str, str]  # key -> text of the numbers

    @staticmethod
    def read(path: Path) -> Calibration:
        """Return the entries of a calibration file. Raise InputError if the file is missing."""
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

    def motion(self, key: str) -> Float:
        """Return the (4,4) transform of an entry that has its upper three rows."""
        return checks.pose(self.numbers(key, 3, 4), f"{self.path}: {key}")

    def rotation(self, key: str, translation: str = "") -> Float:
        """Return the (4,4) transform of the entries of a rotation and a translation, "" for 0."""
        t = self.numbers(translation, 3, 1) if translation else np.zeros((3, 1))
        return checks.pose(np.hstack([self.numbers(key, 3, 3), t]), f"{self.path}: {key}")

    def rectified_camera(
        self, key: str, name: str, size_px: tuple[int, int] | str, T_rect_lidar: Float
    ) -> Camera:
        """Return the rectified camera of an entry with a projection matrix P = K [I | t].

        Args:
            key: Name of the entry.
            name: Name of the camera.
            size_px: Width and height of its images, or the name of the entry that has them.
            T_rect_lidar: (4,4) pose of the lidar in the frame of rectified camera 0.
        """
        P = self.numbers(key, 3, 4)
        if isinstance(size_px, str):
            width, height = self.numbers(size_px, 2)
            size_px = int(width), int(height)
        fx_fy_cx_cy = P[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        camera = checks.pinhole(name, size_px, fx_fy_cx_cy, T_rect_lidar, f"{self.path}: {key}")
        T_cam_rect = np.eye(4)
        T_cam_rect[:3, 3] = np.linalg.solve(camera.K, P[:, 3])
        return replace(camera, T_cam_lidar=T_cam_rect @ T_rect_lidar)


def read_fisheye(path: Path, name: str, T_cam_lidar: Float) -> Camera:
    """Return the fisheye camera (Mei's model) of a KITTI-360 calibration file."""
    # YAML libraries reject the first line that OpenCV writes.
    content, _ = parse_yaml(read_text(path).replace("%YAML:1.0", "", 1), path)
    with described_in(path, "image_width, image_height, xi, k1 k2 p1 p2, gamma1 gamma2 u0 v0"):
        sections = [content[f"{kind}_parameters"] for kind in ("mirror", "distortion")]
        lens = [sections[0]["xi"], *(sections[1][key] for key in ("k1", "k2", "p1", "p2"))]
        projection = content["projection_parameters"]
        pinhole = [projection[key] for key in ("gamma1", "gamma2", "u0", "v0")]
        words = [content["image_width"], content["image_height"], *pinhole, *lens]
    width, height, *numbers = checks.parse_numbers(" ".join(map(str, words)), str(path), 11)
    fx_fy_cx_cy, distortion = numbers[:4], tuple(map(float, numbers[4:]))
    size_px = int(width), int(height)
    camera = checks.pinhole(name, size_px, fx_fy_cx_cy, T_cam_lidar, str(path))
    return replace(camera, distortion=distortion, model="mei", max_angle_deg=_HALF_VIEW_DEG)


def read_labels(path: Path) -> tuple[Float, Bool]:
    """Return the numbers (n,16) of label lines without type and score, and a DontCare mask (n,)."""
    rows, is_area = [], []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if words:
            row = " ".join([*words[:2], *words[3:17]])  # a score may follow
            rows.append(checks.parse_numbers(row, f"{path}: line {number}", 16))
            is_area.append(words[2] == "DontCare")
    return np.reshape(rows, (-1, 16)), np.array(is_area, bool)
