# SPDX-License-Identifier: MIT
"""Order sweeps by time, find neighbouring sweeps by their stamps, and read sweeps and cameras."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.free_space.raw_sweeps import remove_lone_returns
from densify.geometry.types import Camera, Int, LidarSequence, Sweep, Trajectory

_HOLE_PERIODS = 3.1  # a longer step is a hole in time: 3 periods and some jitter
_MOST_RANGES = 8


def median_period_ns(stamps_ns: Sequence[int] | Int, default_ns: int = 100_000_000) -> int:
    """Return the median time (ns) between consecutive stamps, the default for a single stamp."""
    return max(1, int(np.median(np.diff(stamps_ns)))) if len(stamps_ns) > 1 else default_ns


class WindowFrames(NamedTuple):
    """The window of sweeps around a key frame."""

    frames: tuple[int, ...]  # frame numbers in the window, ascending, including the key frame
    # Reasons why the window is smaller than requested, a clause for each cut side
    cuts: tuple[str, ...]


def to_runs(frames: Iterable[int]) -> list[range]:
    """Return ascending frame numbers as ranges of consecutive numbers, in the same order."""
    ranges: list[range] = []
    for frame in frames:
        if ranges and frame == ranges[-1].stop:
            ranges[-1] = range(ranges[-1].start, frame + 1)
        else:
            ranges.append(range(frame, frame + 1))
    return ranges


def format_frames(frames: Iterable[int]) -> str:
    """Return frame numbers as ascending text, such as ``96-135, 140``, shortened to 8 ranges."""
    runs = to_runs(sorted(frames))
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    if len(texts) > _MOST_RANGES:
        texts = [*texts[: _MOST_RANGES - 1], "...", texts[-1]]
    return ", ".join(texts) if texts else "none"


def check_window(window: int) -> None:
    """Raise InputError unless the window is a whole number of sweeps, 0 or more."""
    if isinstance(window, bool) or not isinstance(window, int | np.integer) or window < 0:
        expected = "a whole number of sweeps on each side of the key, 0 or more"
        raise InputError(f"window {window!r}: expected {expected}")


def check_key(key: int) -> None:
    """Raise InputError unless the key frame is a whole number."""
    if isinstance(key, bool) or not isinstance(key, int | np.integer):
        raise InputError(f"key {key!r}: expected a frame's number, a whole one")


@dataclass(frozen=True)
class Timeline:
    """The reference times of a recording."""

    name: str  # name of the recording
    frames: tuple[int, ...]  # numbers of all n sweeps, ascending
    stamp_ns: Int  # (n,) int64 reference times of the sweeps; interpolated for ``unknown`` sweeps
    unknown: Mapping[int, str]  # reason why a stamp is unknown or out of order, by frame number

    @staticmethod
    def of(sequence: LidarSequence) -> Timeline:
        """Return the timeline of a recording.

        Stamps that are missing or out of order are interpolated by index, and given in ``unknown``
        with the reason. If no stamp can be read, all are 0.
        """
        frames = tuple(sequence.frames)
        unknown = {}
        stamps_ns = np.zeros(len(frames), np.int64)
        for row, frame in enumerate(frames):
            try:
                stamps_ns[row] = sequence.stamp_ns(frame)
            except InputError as error:
                unknown[frame] = str(error)
        is_known = np.array([frame not in unknown for frame in frames], bool)
        for row in np.flatnonzero(is_known)[_out_of_order(stamps_ns[is_known])].tolist():
            is_known[row] = False
            unknown[frames[row]] = (
                f"the stamp of frame {frames[row]} ({stamps_ns[row]} ns) is not between those of "
                f"the sweeps before and after it; check the recording's timestamps"
            )
        if unknown and is_known.any():
            rows = np.arange(len(frames))
            start_ns = stamps_ns[is_known][0]
            known_since_ns = (stamps_ns[is_known] - start_ns).astype(float)
            since_ns = np.interp(rows, rows[is_known], known_since_ns)
            stamps_ns = np.where(is_known, stamps_ns, start_ns + since_ns.astype(np.int64))
        return Timeline(sequence.name, frames, stamps_ns, unknown)

    @cached_property
    def period_ns(self) -> int:
        """Median time between consecutive sweeps in ns, 100 ms for a single sweep."""
        return median_period_ns(self.stamp_ns)

    def num_in(self, duration_s: float) -> int:
        """Return the number of sweeps in a duration in seconds at the median rate, rounded."""
        return int(duration_s * 1e9 / self.period_ns + 0.5)

    @cached_property
    def row(self) -> Mapping[int, int]:
        """Index in ``frames`` by frame number."""
        return {frame: row for row, frame in enumerate(self.frames)}

    def stamp_of(self, frame: int) -> int:
        """Return the reference time of a sweep (ns)."""
        return int(self.stamp_ns[self.row[frame]])

    def within(self, begin_ns: int, end_ns: int) -> list[int]:
        """Return the frame numbers with begin_ns <= stamp < end_ns, ascending."""
        inside = (self.stamp_ns >= begin_ns) & (self.stamp_ns < end_ns)
        return [self.frames[row] for row in np.flatnonzero(inside)]

    def split_at_holes(self, frames: Collection[int]) -> list[list[int]]:
        """Return series of consecutive sweeps, split also at steps over 3.1 median periods."""
        series: list[list[int]] = []  # indices of the sweeps
        for row in sorted(self.row[frame] for frame in frames):
            if series and series[-1][-1] == row - 1 and not self._hole_before(row):
                series[-1].append(row)
            else:
                series.append([row])
        return [[self.frames[row] for row in rows] for rows in series]

    def before(self, frame: int, num: int) -> list[int]:
        """Return up to ``num`` frames directly before a frame, ascending, up to a hole in time."""
        return self._side(frame, -1, num, {})[0][::-1]

    def after(self, frame: int, num: int) -> list[int]:
        """Return up to ``num`` frames directly after a frame, ascending, up to a hole in time."""
        return self._side(frame, 1, num, {})[0]

    def window(
        self, key: int, window: int, left_out: Mapping[int, str] | None = None
    ) -> WindowFrames:
        """Return the key frame and up to ``window`` sweeps before and after the key frame.

        A side ends early at the recording's end, at a hole in time, or before a left out sweep.
        Raise InputError if the key frame does not exist or ``window`` is no number of sweeps.

        Args:
            key: Frame number of the key sweep.
            window: Number of sweeps on each side, 0 or more.
            left_out: Frame number of a sweep that cannot be used -> reason; None for none.
        """
        check_window(window)
        if key not in self.row:
            raise InputError(
                f"key {key}: no such frame in {self.name}; it has {format_frames(self.frames)}"
            )
        sides = [self._side(key, step, window, left_out or {}) for step in (-1, 1)]
        (before, cut_before), (after, cut_after) = sides
        cuts = tuple(cut for cut in (cut_before, cut_after) if cut)
        return WindowFrames((*reversed(before), key, *after), cuts)

    def _side(
        self, key: int, step: int, num: int, left_out: Mapping[int, str]
    ) -> tuple[list[int], str]:
        """Return up to ``num`` frames beside the key, nearest first, and why there are no more."""
        side: list[int] = []
        key_row = self.row[key]
        for row in range(key_row + step, key_row + step * (num + 1), step):
            previous = self.frames[row - step]
            if not 0 <= row < len(self.frames):
                return side, f"the recording {'begins' if step < 0 else 'ends'} at frame {previous}"
            frame = self.frames[row]
            if self._hole_before(max(row, row - step)):
                gap_s = abs(int(self.stamp_ns[row] - self.stamp_ns[row - step])) * 1e-9
                earlier, later = sorted((previous, frame))
                return side, f"{gap_s:.1f} s lie between frames {earlier} and {later}"
            if frame in left_out:
                return side, left_out[frame]
            side.append(frame)
        return side, ""

    def _hole_before(self, row: int) -> bool:
        """Return True if a hole in time lies between a sweep and the sweep before it."""
        gap_ns = int(self.stamp_ns[row] - self.stamp_ns[row - 1])
        return gap_ns > _HOLE_PERIODS * self.period_ns


def _out_of_order(stamps_ns: Int) -> list[int]:
    """Return indices of stamps outside the longest ascending series, [] for half of all stamps."""
    if np.all(np.diff(stamps_ns) > 0):
        return []
    # Longest increasing subsequence by patience sorting: a stamp continues the longest series
    # that ends below the stamp.
    end_by_length: list[int] = []  # index of the lowest stamp that ends a series of each length
    previous: list[int] = []  # index of the stamp before each in its series, -1 for none
    for row, stamp_ns in enumerate(stamps_ns.tolist()):
        length = bisect_left(end_by_length, stamp_ns, key=lambda end: int(stamps_ns[end]))
        previous.append(end_by_length[length - 1] if length else -1)
        if length == len(end_by_length) or stamp_ns < stamps_ns[end_by_length[length]]:
            end_by_length[length : length + 1] = [row]
    # Follow the longest series back from its end.
    series = set[int]()
    row = end_by_length[-1]
    while row >= 0:
        series.add(row)
        row = previous[row]
    outside = [row for row in range(len(stamps_ns)) if row not in series]
    return outside if 2 * len(outside) < len(stamps_ns) else []


def read_sweep(sequence: LidarSequence, frame: int, settings: RegisterSettings) -> Sweep:
    """Return a sweep without unusable returns, and without firing times if not ``deskew``."""
    sweep = remove_unusable_returns(sequence[frame], settings)
    return sweep if settings.deskew else replace(sweep, offset_ns=None)


def remove_unusable_returns(sweep: Sweep, settings: RegisterSettings) -> Sweep:
    """Return the sweep without returns that are too near, too far or lone.

    Near returns (from the own vehicle) and far ones are outside of ``min_range_m`` to
    ``max_range_m`` from the scanner that fired. Lone returns are snow, rain and dust. The sweep's
    ``num_near`` and ``num_lone`` count the removed ones.
    """
    origins_m = sweep.scanner_origins
    x, y, z = (sweep.points if origins_m is None else sweep.points - origins_m[sweep.lidar]).T
    range_m = np.sqrt(x * x + y * y + z * z)
    is_near = range_m < settings.min_range_m
    inside = sweep.select(~is_near & (range_m <= settings.max_range_m))
    return remove_lone_returns(replace(inside, num_near=int(is_near.sum())))


def choose_cameras(sequence: LidarSequence, names: Sequence[str] | None) -> list[Camera]:
    """Return the cameras of these names in this order. Raise InputError for an unknown name.

    For None, return the cameras with images, or all cameras if none has images.
    """
    if isinstance(names, str) or not isinstance(names, Iterable | None):
        one = [*sequence.cameras][:1]
        raise InputError(f"cameras: got {names!r}, expected a list of names, such as {one}")
    for name in names or ():
        if name not in sequence.cameras:
            known = ", ".join(sequence.cameras)
            expected = f"expected one of {known}" if known else "it has none; leave --camera out"
            raise InputError(f"camera {name}: no such camera in {sequence.name}; {expected}")
    if names is None:
        names = [n for n in sequence.cameras if sequence.image_stamps_ns(n)] or [*sequence.cameras]
    return [sequence.cameras[name] for name in names]


def recorded_trajectory(sequence: LidarSequence, sweeps: Sequence[Sweep]) -> Trajectory:
    """Return the recorded poses of sweeps at their stamps. Raise InputError without poses."""
    return Trajectory(
        frames=tuple(sweep.frame for sweep in sweeps),
        stamp_ns=np.array([sweep.stamp_ns for sweep in sweeps], np.int64),
        T_world_lidar=np.stack([sequence.T_world_lidar(sweep.frame) for sweep in sweeps]),
    )
