# SPDX-License-Identifier: MIT
"""Recorded poses: text files of them (KITTI's 3x4, 4x4, TUM's, tables with a quaternion), and the
pose of a vehicle at any time.

Many data sets store each sweep as if it had been measured at one moment: ego-motion compensation
carried every point there. That smears moving objects, hides their times, and bends rings;
`PoseTrack.as_fired` undoes it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.geometry import poses
from densify.geometry.types import Float, Int
from densify.readers.file_sequence import parse_numbers, quaternion_pose, rigid
from densify.readers.stamp_files import in_ns, unit_of

_MAX_BEYOND_NS = 200_000_000  # a pose is extrapolated at constant velocity for so long
Line = tuple[int, list[str]]  # number and words

_TIMES = ("timestamp", "time", "stamp", "t")
_PLACES = tuple((a, f"t{a}", f"p{a}", f"pos_{a}", f"position_{a}") for a in "xyz")
_TURNS = tuple((f"q{a}", f"q_{a}", f"rot_{a}", f"orientation_{a}") for a in "wxyz")
_NUMBERS = ("frame", "index", "number", "id")


@dataclass(frozen=True)
class PoseTrack:
    """where: the file, for messages. stamp_ns: (n,) int64, ascending. T_world_ego: (n,4,4)."""

    where: str
    stamp_ns: Int
    T_world_ego: Float

    def __post_init__(self) -> None:
        if len(self.stamp_ns) < 2 or np.any(np.diff(self.stamp_ns) <= 0):
            raise InputError(
                f"{self.where}: got {len(self.stamp_ns)} poses, expected two or more with stamps "
                f"that ascend"
            )

    def at(self, time_ns: int) -> Float:
        """Return (4,4) T_world_ego, interpolated between two poses.

        Raises InputError for a time more than 0.2 s before the first pose or after the last.
        """
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
        """Undo ego-motion compensation.

        points: (N,3) metres, vehicle frame at ``stamp_ns``, to which they were compensated.
        offset_ns: (N,) firing times since then. Returns (N,3) in the vehicle frame at each point's
        own firing time; rows of zeros, which formats pad with, stay zeros.
        """
        fired = self._carry(points, stamp_ns, offset_ns, inverse=True)
        return np.where(points.any(axis=1, keepdims=True), fired, points)

    def compensated(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Inverse of `as_fired`."""
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
        fired_ns, row = np.unique(offset_ns, return_inverse=True)  # beams fire together
        turns = Slerp(since_ns, Rotation.from_matrix(T_ref_ego[:, :3, :3]))(fired_ns)[row]
        places_m = T_ref_ego[:, :3, 3].T
        shift_m = np.stack([np.interp(fired_ns, since_ns, p) for p in places_m], 1)[row]
        if inverse:
            return turns.apply(points - shift_m, inverse=True)
        return turns.apply(points) + shift_m


@dataclass(frozen=True)
class PoseFile:
    """Poses as they are written, T_world_body if nothing else is known.

    form: for people. T: (n,4,4). stamps_ns: when each was, None if the file has no times. numbers:
    of the frames that they belong to, None if the file does not say.
    """

    path: Path
    form: str
    T: Float
    stamps_ns: tuple[int, ...] | None = None
    numbers: tuple[int, ...] | None = None

    @staticmethod
    def read(path: Path, unit: str = "") -> PoseFile:
        """unit: of the times, "" finds it out. Raises InputError that names file and line."""
        lines = [
            (number, re.split(r"[\s,;]+", line.strip().strip(",;")))
            for number, line in enumerate(read_text(path).splitlines(), 1)
            if line.strip()
        ]
        names = _header(lines)
        lines = [(number, words) for number, words in lines if not words[0].startswith("#")]
        if names and lines and lines[0][1][0].strip('"').lower() in names:
            lines = lines[1:]
        if not lines:
            raise InputError(f"{path}: holds no poses")
        table = _numbers(path, lines)
        at = [number for number, _ in lines]
        if names:
            return _of_columns(path, names, table, lines, unit)
        num_columns = table.shape[1]
        if num_columns == 4 and len(table) % 4 == 0:
            return PoseFile(path, "4x4 blocks", _rigid(path, table.reshape(-1, 4, 4), at[::4]))
        if num_columns in (12, 13, 16, 17):
            values = table[:, num_columns % 4 :].reshape(len(table), -1, 4)
            form = "KITTI 3x4" if num_columns < 16 else "4x4 rows"
            numbers = tuple(int(n) for n in table[:, 0]) if num_columns % 4 else None
            return PoseFile(path, form, _rigid(path, values, at), None, numbers)
        if num_columns == 8:
            T = _of_quaternions(path, table[:, [7, 4, 5, 6]], table[:, 1:4], at)
            return PoseFile(path, "TUM", T, _stamps(path, [words[0] for _, words in lines], unit))
        raise InputError(
            f"{path}: line {at[0]}: got {num_columns} numbers, expected 12 (KITTI), 16 (4x4), 8 "
            f"(TUM: time x y z qx qy qz qw), 4 in blocks of four lines, or a first line of names"
        )


def _header(lines: Sequence[Line]) -> list[str] | None:
    """Return the names of the columns in lower case, if the first line has them."""
    words = [word.strip('"').lower() for word in lines[0][1]] if lines else []
    words = [word.lstrip("#") for word in words if word != "#"]
    named = [word for word in words if any(word in one for one in _TURNS)]
    return words if len(named) == 4 else None


def _of_columns(
    path: Path, names: Sequence[str], table: Float, lines: Sequence[Line], unit: str
) -> PoseFile:
    def column(choices: Sequence[str]) -> int | None:
        return next((names.index(name) for name in choices if name in names), None)

    found = [column(choices) for choices in (*_TURNS, *_PLACES)]
    columns = [c for c in found if c is not None]
    if len(columns) < len(found) or len(names) != table.shape[1]:
        raise InputError(
            f"{path}: got the columns {', '.join(names)} above {table.shape[1]} numbers, expected "
            f"x y z qw qx qy qz, and a time or frame where the rows are not those of the sweeps"
        )
    at = [number for number, _ in lines]
    T = _of_quaternions(path, table[:, columns[:4]], table[:, columns[4:]], at)
    time, number = column(_TIMES), column(_NUMBERS)
    stamps_ns = numbers = None
    if time is not None:
        stamps_ns = _stamps(path, [words[time] for _, words in lines], unit)
    elif number is not None:
        numbers = tuple(int(n) for n in table[:, number])
    return PoseFile(path, "table with quaternions", T, stamps_ns, numbers)


def _stamps(path: Path, times: Sequence[str], unit: str) -> tuple[int, ...]:
    try:
        unit = unit or unit_of(times)
        if not unit:
            raise ValueError(f"the unit of its times cannot be told ({times[0]}, {times[-1]})")
        return tuple(in_ns(text, unit) for text in times)
    except ValueError as error:
        raise InputError(
            f"{path}: {error}; name the unit in densify.yaml: poses: {{stamps_unit: s}}"
        ) from None


def _numbers(path: Path, lines: Sequence[Line]) -> Float:
    width = len(lines[0][1])
    rows = []
    for number, words in lines:
        if len(words) != width:
            raise InputError(
                f"{path}: line {number}: got {len(words)} numbers, expected {width} as in the "
                f"lines before; it may be cut off"
            )
        rows.append(parse_numbers(" ".join(words), f"{path}: line {number}", width))
    return np.array(rows)


def _of_quaternions(path: Path, w_x_y_z: Float, places: Float, at: Sequence[int]) -> Float:
    """(n,4) and (n,3) -> (n,4,4)."""
    rows = zip(w_x_y_z, places, at, strict=True)
    return np.stack([quaternion_pose(q, place, f"{path}: line {n}") for q, place, n in rows])


def _rigid(path: Path, T: Float, at: Sequence[int]) -> Float:
    return np.stack([rigid(one, f"{path}: line {n}") for one, n in zip(T, at, strict=True)])
