# SPDX-License-Identifier: MIT
"""Read recorded poses from text files, and interpolate the pose of a vehicle at any time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from densify.readers.stamped_files import TIME_COLUMNS, TextTable, require_path
from densify.readers.timeline import format_frames

_PCD_HEADER = 4096  # bytes that hold the header of a .pcd file
_NO_VIEWPOINT = "0 0 0 1 0 0 0"
_MAX_BEYOND_NS = 200_000_000  # longest extrapolation of a pose, at constant velocity
_NUM_ROUNDS = 3  # rounds of the fixed-point iteration, in which the azimuth changes by few degrees
_POSITIONS = tuple((a, f"t{a}", f"p{a}", f"pos_{a}", f"position_{a}") for a in "xyz")
_TURNS = tuple((f"q{a}", f"q_{a}", f"rot_{a}", f"orientation_{a}") for a in "wxyz")
_POSE_FILES = [
    f"{name}.{suffix}"
    for name in ("poses", "pose", "trajectory", "odometry", "groundtruth")
    for suffix in ("txt", "csv", "tum")
]


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
        """Return the (4,4) T_world_ego at a time. Raise InputError over 0.2 s beyond the poses."""
        begin, end = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        beyond_ns = max(begin - time_ns, time_ns - end)
        if beyond_ns > _MAX_BEYOND_NS:
            raise InputError(
                f"{self.where}: no pose at {time_ns} ns: got poses from {begin} to {end}, "
                f"{beyond_ns * 1e-9:.2f} s away; expected poses around every sweep and image"
            )
        # The pose before the time; at the ends, that of the first or the last pair
        last_pair = len(self.stamp_ns) - 2
        before = int(np.clip(np.searchsorted(self.stamp_ns, time_ns) - 1, 0, last_pair))
        after = before + 1
        span_ns = int(self.stamp_ns[after] - self.stamp_ns[before])
        fraction = (time_ns - int(self.stamp_ns[before])) / span_ns
        return poses.interpolate(self.T_world_ego[before], self.T_world_ego[after], fraction)

    def undo_compensation(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Return points (N,3) as measured, in the vehicle frame at each point's own firing time.

        Many data sets store a sweep as if measured at one time, which smears moving objects and
        bends rings.

        Args:
            points: (N,3) metres, compensated to the vehicle frame at ``stamp_ns``. 0 0 0 stays.
            stamp_ns: Time to which the points are compensated.
            offset_ns: (N,) firing times since ``stamp_ns``.
        """
        if not len(points):
            return points
        turns, shift_m = self._motion_since(stamp_ns, offset_ns)
        fired = turns.apply(points - shift_m, inverse=True)
        return np.where(points.any(axis=1, keepdims=True), fired, points)

    def compensate(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Return (N,3) points moved from firing times to ``stamp_ns``, as data sets store them."""
        turns, shift_m = self._motion_since(stamp_ns, offset_ns)
        return turns.apply(points) + shift_m

    def undo_compensation_by(
        self, times_of: Callable[[Float], Int], points: Float, stamp_ns: int
    ) -> tuple[Float, Int]:
        """Return points (N,3) as measured, and their firing times (N,) since ``stamp_ns``.

        ``times_of`` returns the firing times of points as measured, such as by their azimuths.
        """
        fired = points
        for _ in range(_NUM_ROUNDS):  # times of points, then points as fired at these times
            offset_ns = times_of(fired)
            fired = self.undo_compensation(points, stamp_ns, offset_ns)
        return fired, offset_ns

    def undo_placement(self, placed: Returns, stamp_ns: int) -> Returns:
        """Return world points as fired, or without times in the vehicle frame at ``stamp_ns``."""
        points = transform_from_world(placed.points, self.at(stamp_ns))
        if placed.offset_ns is not None:
            points = self.undo_compensation(points, stamp_ns, placed.offset_ns)
        return replace(placed, points=points)

    def _motion_since(self, stamp_ns: int, offset_ns: Int) -> tuple[Rotation, Float]:
        """Return N rotations and shifts (N,3): poses at firing times in the pose at the stamp."""
        # Poses relative to the pose at the stamp, at the ends of the sweep and at stored poses
        T_ref_world = poses.inverse(self.at(stamp_ns))
        begin_ns, end_ns = stamp_ns + int(offset_ns.min()), stamp_ns + int(offset_ns.max())
        is_inside = (self.stamp_ns > begin_ns) & (self.stamp_ns < end_ns)
        times_ns = [begin_ns, *self.stamp_ns[is_inside].tolist(), max(end_ns, begin_ns + 1)]
        T_ref_ego = np.stack([T_ref_world @ self.at(time_ns) for time_ns in times_ns])
        since_ns = np.array([time_ns - stamp_ns for time_ns in times_ns], np.float64)
        # The pose at each firing time is interpolated between these poses.
        fired_ns, row = np.unique(offset_ns, return_inverse=True)  # many points share a firing time
        turns = Slerp(since_ns, Rotation.from_matrix(T_ref_ego[:, :3, :3]))(fired_ns)[row]
        shifts_m = [np.interp(fired_ns, since_ns, axis) for axis in T_ref_ego[:, :3, 3].T]
        return turns, np.stack(shifts_m, axis=1)[row]


def transform_from_world(placed: Float, T_world_ego: Float) -> Float:
    """Return world points (N,3) in the frame of a pose (4,4), except padding at 0 0 0."""
    points = poses.transform(poses.inverse(T_world_ego), placed)
    return np.where(placed.any(axis=1, keepdims=True), points, placed)


@dataclass(frozen=True)
class PoseFile:
    """The n poses of text files, in the frames that the files use (usually T_world_body)."""

    path: Path  # file of the poses; the first file if each sweep has its own
    form: str  # name of the file's format, for messages
    T: Float  # (n,4,4) poses in file order
    stamps_ns: tuple[int, ...] | None = None  # n times of the poses, None for a file without times
    frames: tuple[int, ...] | None = None  # n frames of files for each sweep, None for one file

    @staticmethod
    def of_folder(
        folder: Path, name: str, unit: str, sweeps: Mapping[int, Path]
    ) -> PoseFile | None:
        """Return the poses of a recording, or None without any.

        ``name`` is the pose file. "" searches for a usual name, a .pose file beside each of the
        ``sweeps`` (file by frame), or the viewpoints of .pcd files. ``unit`` is the unit of the
        times, "" to find it.
        """
        if name:
            return PoseFile.read(require_path(folder, name, "poses: {file: ...}"), unit)
        for path in (folder / usual for usual in _POSE_FILES):
            if path.is_file():
                return PoseFile.read(path, unit)
        beside = {frame: path.with_suffix(".pose") for frame, path in sweeps.items()}
        beside = {frame: path for frame, path in beside.items() if path.is_file()}
        if beside:
            return PoseFile._of_each(beside, "one file for each sweep", _one_pose)
        paths = list(sweeps.values())
        if any(path.suffix.lower() != ".pcd" for path in paths):
            return None
        try:
            # The default in the first and the last file is no pose.
            if np.allclose([_viewpoint(path) for path in (paths[0], paths[-1])], np.eye(4)):
                return None
            return PoseFile._of_each(sweeps, "VIEWPOINT of each sweep", _viewpoint)
        except InputError:  # some programs write zeros
            return None

    @staticmethod
    def read(path: Path, unit: str = "") -> PoseFile:
        """Return the poses of a file with a pose on each line."""
        table = TextTable.read(path, [name for names in _TURNS for name in names])
        columns = [i for names in (*_TURNS, *_POSITIONS) if (i := table.column(names)) is not None]
        width, form, time = len(table.rows[0]), "table with quaternions", None
        if len(columns) == 7:
            time = table.column(TIME_COLUMNS)
        elif width == 8:
            form, columns, time = "TUM", [7, 4, 5, 6, 1, 2, 3], 0
        elif width in (12, 16):
            form, columns = "KITTI 3x4" if width == 12 else "4x4 rows", []
        else:
            raise InputError(
                f"{path}: line {table.lines[0]}: got {width} numbers, expected 12 (KITTI), 16 "
                f"(4x4), 8 (TUM: time x y z qx qy qz qw), or a first line that names x y z qw qx "
                f"qy qz"
            )
        T = []
        for line, words in zip(table.lines, table.rows, strict=True):
            where = f"{path}: line {line}"
            text = " ".join([words[i] for i in columns] or words)
            values = checks.parse_numbers(text, where, len(columns) or width)
            if columns:
                T.append(checks.quaternion_pose(values[:4], values[4:], where))
            else:
                T.append(checks.pose(values, where))
        stamps_ns = None
        if time is not None:
            stamps_ns, _ = table.times_ns(time, unit)
            table.check_digits(stamps_ns, time)
        return PoseFile(path, form, np.stack(T), stamps_ns)

    @staticmethod
    def _of_each(paths: Mapping[int, Path], form: str, read: Callable[[Path], Float]) -> PoseFile:
        T = np.stack([read(path) for path in paths.values()])
        return PoseFile(next(iter(paths.values())), form, T, frames=tuple(paths))

    def by_frame(self, frames: Sequence[int]) -> dict[int, Float]:
        """Return frame number -> (4,4) pose for the recording's ``frames``, ascending.

        Poses of files for each sweep keep their frames. As many poses as ``frames`` are in their
        order. More poses than the last frame number belong to the numbers from 0. Otherwise raise
        InputError.
        """
        if self.frames is not None:
            return dict(zip(self.frames, self.T, strict=True))
        if len(self.T) == len(frames):
            return dict(zip(frames, self.T, strict=True))
        if len(self.T) > frames[-1]:
            return dict(enumerate(self.T))
        raise InputError(
            f"{self.path}: got {len(self.T)} poses for {len(frames)} sweeps numbered "
            f"{format_frames(frames)}, expected one for each, or for each number from 0"
        )


def _one_pose(path: Path) -> Float:
    """Return the (4,4) pose of a file: a 3x4 or 4x4 matrix, or x y z qx qy qz qw."""
    text = read_text(path)
    values = checks.parse_numbers(text, str(path), len(text.split()))
    if len(values) in (12, 16):
        return checks.pose(values, str(path))
    if len(values) == 7:
        return checks.quaternion_pose(values[[6, 3, 4, 5]], values[:3], str(path))
    raise InputError(
        f"{path}: got {len(values)} numbers, expected 12 or 16 (rows of T_world_lidar) or 7 (x y z "
        f"qx qy qz qw); write them as lines of a file poses.txt instead"
    )


def _viewpoint(path: Path) -> Float:
    """Return the pose (4,4) in VIEWPOINT of a .pcd file, the identity without one."""
    with open_file(path) as file:
        header = file.read(_PCD_HEADER).split(b"\nDATA")[0].decode("ascii", "replace")
    lines = (line.split(maxsplit=1) for line in header.splitlines())
    viewpoints = [line[1] for line in lines if len(line) == 2 and line[0] == "VIEWPOINT"]
    where = f"{path}: VIEWPOINT"
    values = checks.parse_numbers(viewpoints[0] if viewpoints else _NO_VIEWPOINT, where, 7)
    return checks.quaternion_pose(values[3:], values[:3], where)
