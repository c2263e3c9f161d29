# SPDX-License-Identifier: MIT
"""Read recorded poses from text files, and interpolate the pose of a vehicle at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from densify.config.errors import InputError
from densify.config.file_content import open_file, read_text
from densify.geometry import poses
from densify.geometry.types import Float, Int
from densify.readers import checks
from densify.readers.file_sequence import Returns
from densify.readers.stamp_files import TIME_COLUMNS, TextTable, check_digits

_PCD_HEADER = 4096  # bytes that hold the header of a .pcd file
_NO_VIEWPOINT = "0 0 0 1 0 0 0"
_MAX_BEYOND_NS = 200_000_000  # longest extrapolation of a pose, at constant velocity

_PLACES = tuple((a, f"t{a}", f"p{a}", f"pos_{a}", f"position_{a}") for a in "xyz")
_TURNS = tuple((f"q{a}", f"q_{a}", f"rot_{a}", f"orientation_{a}") for a in "wxyz")


@dataclass(frozen=True)
class PoseTrack:
    """The path of a vehicle as n poses over time."""

    where: str  # file of the poses, for messages
    stamp_ns: Int  # (n,) int64 times of the poses, ascending
    T_world_ego: Float  # (n,4,4) poses of the vehicle (in some readers of the lidar) in the world

    def __post_init__(self) -> None:
        if len(self.stamp_ns) < 2 or np.any(np.diff(self.stamp_ns) <= 0):
            raise InputError(
                f"{self.where}: got {len(self.stamp_ns)} poses, expected two or more with stamps "
                f"that ascend"
            )

    def at(self, time_ns: int) -> Float:
        """Return T_world_ego (4,4) at a time, up to 0.2 s beyond the ends of the path."""
        begin, end = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        beyond_ns = max(begin - time_ns, time_ns - end)
        if beyond_ns > _MAX_BEYOND_NS:
            raise InputError(
                f"{self.where}: no pose at {time_ns} ns: got poses from {begin} to {end}, "
                f"{beyond_ns * 1e-9:.2f} s away; expected poses around every sweep and image"
            )
        i = int(np.clip(np.searchsorted(self.stamp_ns, time_ns) - 1, 0, len(self.stamp_ns) - 2))
        span_ns = int(self.stamp_ns[i + 1] - self.stamp_ns[i])
        fraction = (time_ns - int(self.stamp_ns[i])) / span_ns
        return poses.interpolate(self.T_world_ego[i], self.T_world_ego[i + 1], fraction)

    def as_fired(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Undo ego-motion compensation: return points in the vehicle frame at their firing times.

        Many data sets store a sweep as if measured at one time, which smears moving objects and
        bends rings. ``points`` is (N,3) metres, compensated to the vehicle frame at ``stamp_ns``;
        padding at 0 0 0 stays. ``offset_ns`` is (N,) firing times since ``stamp_ns``.
        """
        fired = self._carry(points, stamp_ns, offset_ns, inverse=True)
        return np.where(points.any(axis=1, keepdims=True), fired, points)

    def taken_back(self, placed: Returns, stamp_ns: int) -> Returns:
        """Undo that points were moved to the world with the poses of this path.

        Points of a sweep without times are compensated to its ``stamp_ns``, and the result is too.
        """
        at_stamp = taken_back(placed.points, self.at(stamp_ns))
        if placed.offset_ns is not None:
            at_stamp = self.as_fired(at_stamp, stamp_ns, placed.offset_ns)
        return replace(placed, points=at_stamp)

    def compensated(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Move (N,3) points as fired to the vehicle frame at ``stamp_ns``; undoes `as_fired`."""
        return self._carry(points, stamp_ns, offset_ns, inverse=False)

    def _carry(self, points: Float, stamp_ns: int, offset_ns: Int, inverse: bool) -> Float:
        if not len(points):
            return points
        T_ref_world = poses.inverse(self.at(stamp_ns))
        low, high = stamp_ns + int(offset_ns.min()), stamp_ns + int(offset_ns.max())
        inside = self.stamp_ns[(self.stamp_ns > low) & (self.stamp_ns < high)].tolist()
        times_ns = [low, *inside, max(high, low + 1)]
        T_ref_ego = np.stack([T_ref_world @ self.at(t) for t in times_ns])
        since_ns = np.array([t - stamp_ns for t in times_ns], np.float64)
        fired_ns, row = np.unique(offset_ns, return_inverse=True)  # many points share a firing time
        turns = Slerp(since_ns, Rotation.from_matrix(T_ref_ego[:, :3, :3]))(fired_ns)[row]
        places_m = T_ref_ego[:, :3, 3].T
        shift_m = np.stack([np.interp(fired_ns, since_ns, p) for p in places_m], 1)[row]
        if inverse:
            return turns.apply(points - shift_m, inverse=True)
        return turns.apply(points) + shift_m


def taken_back(placed: Float, T_world_ego: Float) -> Float:
    """Return points (N,3) of the world in the frame of a pose (4,4). Padding at 0 0 0 stays."""
    points = poses.transform(poses.inverse(T_world_ego), placed)
    return np.where(placed.any(axis=1, keepdims=True), points, placed)


@dataclass(frozen=True)
class PoseFile:
    """The n poses of a text file, in the frames that the file uses (usually T_world_body)."""

    path: Path  # file of the poses; the first file if each sweep has its own
    form: str  # name of the file's format, for messages
    T: Float  # (n,4,4) poses in file order
    stamps_ns: tuple[int, ...] | None = None  # n times of the poses, None for a file without times

    @staticmethod
    def read(path: Path, unit: str = "") -> PoseFile:
        """Read a file with one pose on each line; ``unit`` of the times, "" to find it."""
        table = TextTable.read(path, [name for names in _TURNS for name in names])
        width, time = len(table.rows[0]), None
        columns = [i for names in (*_TURNS, *_PLACES) if (i := table.column(names)) is not None]
        form = "table with quaternions"
        if len(columns) == 7:
            time = table.column(TIME_COLUMNS)
        elif width == 8:
            form, columns, time = "TUM", [7, 4, 5, 6, 1, 2, 3], 0
        elif width in (12, 16):
            lines = zip(_numbers(table), table.lines, strict=True)
            T = np.stack([checks.rigid(one, f"{path}: line {n}") for one, n in lines])
            return PoseFile(path, "KITTI 3x4" if width == 12 else "4x4 rows", T)
        else:
            raise InputError(
                f"{path}: line {table.lines[0]}: got {width} numbers, expected 12 (KITTI), 16 "
                f"(4x4), 8 (TUM: time x y z qx qy qz qw), or a first line that names x y z qw qx "
                f"qy qz"
            )
        values = _numbers(table, columns)
        lines = zip(values, table.lines, strict=True)
        T = np.stack([checks.quaternion_pose(v[:4], v[4:], f"{path}: line {n}") for v, n in lines])
        stamps_ns = None
        if time is not None:
            stamps_ns, _ = table.times_ns(time, unit)
            check_digits(stamps_ns, table.rows[0][time], path)
        return PoseFile(path, form, T, stamps_ns)

    @staticmethod
    def read_each(paths: Sequence[Path]) -> PoseFile:
        """Read files with one pose each: 3x4 or 4x4 matrices, or x y z qx qy qz qw."""
        T = []
        for path in paths:
            count = len(read_text(path).split())
            values = checks.parse_numbers(read_text(path), str(path), count)
            if count in (12, 16):
                T.append(checks.rigid(values, str(path)))
            elif count == 7:
                T.append(checks.quaternion_pose(values[[6, 3, 4, 5]], values[:3], str(path)))
            else:
                raise InputError(
                    f"{path}: got {count} numbers, expected 12 or 16 (rows of T_world_lidar) or "
                    f"7 (x y z qx qy qz qw); write them as lines of a file poses.txt instead"
                )
        return PoseFile(paths[0], "one file for each sweep", np.stack(T))

    @staticmethod
    def of_viewpoints(paths: Sequence[Path]) -> PoseFile | None:
        """Read the poses in VIEWPOINT of .pcd files; None for other files and without poses."""
        if not all(path.suffix.lower() == ".pcd" for path in paths):
            return None
        try:
            # The default in the first and the last file is no pose.
            if np.allclose([_viewpoint(path) for path in (paths[0], paths[-1])], np.eye(4)):
                return None
            T = np.stack([_viewpoint(path) for path in paths])
        except InputError:  # some programs write zeros
            return None
        return PoseFile(paths[0], "VIEWPOINT of each sweep", T)


def _viewpoint(path: Path) -> Float:
    """Return the pose (4,4) in VIEWPOINT of a .pcd file, the identity without one."""
    with open_file(path) as file:
        header = file.read(_PCD_HEADER).split(b"\nDATA")[0].decode("ascii", "replace")
    lines = (line.split(maxsplit=1) for line in header.splitlines())
    viewpoints = [line[1] for line in lines if len(line) == 2 and line[0] == "VIEWPOINT"]
    where = f"{path}: VIEWPOINT"
    values = checks.parse_numbers(viewpoints[0] if viewpoints else _NO_VIEWPOINT, where, 7)
    return checks.quaternion_pose(values[3:], values[:3], where)


def _numbers(table: TextTable, columns: Sequence[int] | None = None) -> Float:
    rows = []
    for line, words in zip(table.lines, table.rows, strict=True):
        chosen = words if columns is None else [words[i] for i in columns]
        width = len(table.rows[0] if columns is None else columns)
        rows.append(checks.parse_numbers(" ".join(chosen), f"{table.path}: line {line}", width))
    return np.array(rows)
