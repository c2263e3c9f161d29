# SPDX-License-Identifier: MIT
"""Find files of sweeps and images, and their times in file names or in a text file beside them."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.readers.point_fields import UNIT_NS

TIME_COLUMNS = ("timestamp", "time", "stamp", "t")
_FILE_COLUMNS = ("filename", "file", "name", "image", "sweep", "path")
_STAMP_FILES = [f"{n}.{s}" for n in ("timestamps", "times", "stamps") for s in ("txt", "csv")]
_NO_SWEEPS = ("truth", "labels", "label", "poses", "calib", "calibration")
_EPOCH_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)  # the years 2000 to 2099
_LONGEST_STEP_NS = 3_900_000_000  # longest median time between sweeps or images
_MOST_NS = 2**63
_MOST_EQUAL = 1 / 3  # greatest share of steps of 0 between stamps
_SECONDS_AND_NS = re.compile(r"(?<!\d)(\d{10})[_-](\d{9})(?!\d)")
_MAX_NUMBER_DIGITS = 18  # a longer number is no frame number


def _to_ns(text: str, unit: str) -> int:
    """Convert a decimal number in ``unit`` to ns, exactly. Raise ValueError if impossible."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("nan")
    if not value.is_finite():
        raise ValueError(f"got {text!r}, expected a time in {unit}")
    # A power of ten with a long exponent takes minutes to become a whole number.
    if value.copy_abs() >= _MOST_NS or abs(value * UNIT_NS[unit]) >= _MOST_NS:
        raise ValueError(f"got {text!r}, which is no time in {unit}: it lies beyond the year 2262")
    return int((value * UNIT_NS[unit]).to_integral_value())


def date_ns(text: str) -> int:
    """Return an ISO date in UTC as ns since 1970, exactly. Raise ValueError for other texts."""
    day = np.datetime64(text, "D")  # numpy wraps years beyond 64 bits
    if not np.datetime64("1970-01-01") <= day < np.datetime64("2262-01-01"):
        raise ValueError(f"got {text!r}, expected a year from 1970 to 2261")
    return int(np.datetime64(text, "ns").astype(np.int64))  # never through a float


def _epoch_unit(text: str) -> str:
    """Return the unit in which a number is a time from 2000 to 2099, "" if no unit fits."""
    for unit in UNIT_NS:
        with suppress(ValueError):
            if _EPOCH_NS[0] <= _to_ns(text, unit) < _EPOCH_NS[1]:
                return unit
    return ""


# --- tables of numbers and names in text files ----------------------------------------------------


class TextTable(NamedTuple):
    """Table of a text file, with columns separated by blanks, commas, semicolons or tabs."""

    path: Path
    names: list[str]  # names of the columns in lower case; empty without a line of names
    lines: list[int]  # line number of each row in the file, from 1
    rows: list[list[str]]  # words of each row

    @staticmethod
    def read(path: Path, known: Collection[str]) -> TextTable:
        """Return a file's table. A first line with a known name or a # has the column names."""
        names, lines, rows = list[str](), list[int](), list[list[str]]()
        for number, line in enumerate(read_text(path).splitlines(), 1):
            text = re.sub(r"(\d-\d\d) (\d\d:)", r"\1T\2", line.strip().strip("#,;").strip())
            words = [word.strip('"') for word in re.split(r"[\s,;]+", text)]
            lower = [word.lower().split("[")[0] for word in words]
            is_comment = line.lstrip().startswith("#")
            if not rows and not names and (is_comment or {*lower} & {*known}):
                names = lower
            elif text and not is_comment:
                lines.append(number)
                rows.append(words)
                if len(words) < len(rows[0]):
                    raise InputError(
                        f"{path}: line {number}: got {len(words)} columns, expected "
                        f"{len(rows[0])} as in the lines before; it may be cut off"
                    )
        if not rows:
            raise InputError(f"{path}: holds no lines with numbers")
        return TextTable(path, names, lines, rows)

    def column(self, choices: Collection[str]) -> int | None:
        """Return the index of the first column among the names ``choices``, None without any."""
        indices = (self.names.index(name) for name in choices if name in self.names)
        return next((index for index in indices if index < len(self.rows[0])), None)

    def times_ns(self, column: int, unit: str) -> tuple[tuple[int, ...], str]:
        """Return the times of a column in ns, and their unit in the file, "date" for dates.

        ``unit`` "" detects the unit of times since 1970 by their size. Other times are in seconds.
        """
        times = [words[column] for words in self.rows]
        dates = "-" in times[0][1:] and ":" in times[0]
        known = unit or _epoch_unit(times[0])
        times_ns = []
        for line, text in zip(self.lines, times, strict=True):
            try:
                times_ns.append(date_ns(text.rstrip("Z")) if dates else _to_ns(text, known or "s"))
            except ValueError:
                raise InputError(
                    f"{self.path}: line {line}: got {text!r}, expected a time in {known or 's'}, "
                    f"from 1970 to 2261"
                ) from None
        steps = np.abs(np.diff(np.array(times_ns, np.float64)))
        if not dates and not known and len(steps) and np.median(steps) > _LONGEST_STEP_NS:
            raise InputError(
                f"{self.path}: its times ({times[0]}, {times[1]}, ...) are too far apart for "
                f"seconds; name their unit in densify.yaml: stamps_unit: ms, us or ns"
            )
        return tuple(times_ns), "date" if dates else known or "s"

    def check_digits(self, stamps_ns: Sequence[int], column: int) -> None:
        """Raise InputError if times of a column, in file order, are equal by rounding."""
        steps_ns = np.diff(np.array(stamps_ns, np.int64))
        num_equal = int((steps_ns == 0).sum())
        min_equal = min(2, len(steps_ns))  # one of several may be a hiccup of the recorder
        if num_equal >= max(min_equal, 1) and num_equal > _MOST_EQUAL * len(steps_ns):
            raise InputError(
                f"{self.path}: {num_equal} of {len(steps_ns)} times are equal to the time before, "
                f"such as {self.rows[0][column]}: they have lost digits; write them anew with all "
                f"digits, in nanoseconds or with %.9f"
            )


class StampFile(NamedTuple):
    """The times of a text file, line by line."""

    path: Path
    stamp_ns: tuple[int, ...]  # time of each line in nanoseconds
    unit: str  # unit of the times in the file: s, ms, us, ns or date
    # Name of the sweep or image file of each line; None if lines have only times
    names: tuple[str, ...] | None

    @staticmethod
    def read(path: Path, unit: str = "") -> StampFile:
        """Return the times of a file's lines: dates, or numbers of ``unit``, "" to detect it."""
        table = TextTable.read(path, (*TIME_COLUMNS, *_FILE_COLUMNS))
        time_column = table.column(TIME_COLUMNS)
        name_column = table.column(_FILE_COLUMNS)
        words = table.rows[0]
        # Without names of columns, a word with a suffix of letters is the name of a file.
        if time_column is None and name_column is None:
            are_files = [Path(word).suffix[1:2].isalpha() for word in words]
            name_column = are_files.index(True) if any(are_files) else None
        if time_column is None:
            time_column = 1 if name_column == 0 and len(words) > 1 else 0
        stamps_ns, unit = table.times_ns(time_column, unit)
        if name_column is None:
            table.check_digits(stamps_ns, time_column)
            return StampFile(path, stamps_ns, unit, None)
        # Equal times are no error here: files of several cameras may have one time.
        names = tuple(Path(row[name_column]).name for row in table.rows)
        return StampFile(path, stamps_ns, unit, names)

    def of(self, paths: Mapping[int, Path]) -> dict[int, int]:
        """Return the stamps (ns) of files by their numbers.

        Lines with names belong to the files of these names. As many lines as files are in the
        files' order. Otherwise line k, from 0, is of the number k. Raise InputError if a file has
        no line.
        """
        if self.names is not None:
            by_name = {Path(n).stem: ns for n, ns in zip(self.names, self.stamp_ns, strict=True)}
            missing = [path for path in paths.values() if path.stem not in by_name]
            if missing:
                raise InputError(
                    f"{self.path}: no line of {missing[0].name}; expected one of each file"
                )
            return {number: by_name[path.stem] for number, path in paths.items()}
        if len(self.stamp_ns) == len(paths):
            return dict(zip(paths, self.stamp_ns, strict=True))
        if len(self.stamp_ns) > max(paths):
            return {number: self.stamp_ns[number] for number in paths}
        raise InputError(
            f"{self.path}: got {len(self.stamp_ns)} times for {len(paths)} files numbered up to "
            f"{max(paths)}, expected one for each file, or one for each number from 0"
        )


# --- files ----------------------------------------------------------------------------------------


class NamedFile(NamedTuple):
    """A file and the number or time in its name."""

    path: Path
    number: int | None  # number in the name; None for a name with a time or without digits
    stamp_ns: int | None  # time in the name in nanoseconds; None for a name without a time

    @staticmethod
    def of(path: Path, unit: str = "") -> NamedFile:
        """Return the number or the time in a name. With a ``unit``, the last number is a time."""
        # 0000000120 and cloud_12 are numbers. 1317042651.468569638, 1317042651_468569638 and
        # 1317042651468 are times since 1970.
        words = re.findall(r"\d+(?:\.\d+)?", _SECONDS_AND_NS.sub(r"\1.\2", path.stem))
        if unit:
            with suppress(ValueError):
                return NamedFile(path, None, _to_ns(words[-1] if words else "", unit))
            return NamedFile(path, None, None)
        for word in reversed(words):
            epoch = _epoch_unit(word)
            # Ten digits without a fraction are a frame number, as in KITTI's file names.
            if epoch and (epoch != "s" or "." in word) and not word.startswith("0"):
                return NamedFile(path, None, _to_ns(word, epoch))
        digits = [word for word in re.findall(r"\d+", path.stem) if len(word) <= _MAX_NUMBER_DIGITS]
        return NamedFile(path, int(digits[-1]) if digits else None, None)


class Series(NamedTuple):
    """Files of sweeps or images in the order of time."""

    paths: Mapping[int, Path]  # path of each file, by its number
    # Stamp of each file, by its number; None if neither names nor a file state it
    stamps_ns: Mapping[int, int] | None
    stamped_by: str  # source of the stamps, for people; "" without stamps


def order_files(
    root: Path, paths: Sequence[Path], stamps: str, unit: str, shared: bool = True
) -> Series:
    """Return files in the order of time, numbered from 0 if their names are times.

    Raise InputError if a stamp is missing or the stamps do not ascend.

    Args:
        root: Folder of the recording.
        paths: Files of sweeps or images, in one folder.
        stamps: "names" if file names are stamps, "sweeps" for files without stamps, the name of a
            stamp file beside the files or below ``root``, or "" to search for one.
        unit: Unit of the stamps, "" to detect it.
        shared: True to search for a stamp file in ``root`` too.
    """
    by_names = stamps == "names"
    names = [NamedFile.of(path, unit if by_names else "") for path in paths]
    untimed = [name.path for name in names if name.stamp_ns is None]
    if by_names and untimed:
        raise InputError(
            f"{untimed[0]}: its name is no time; expected such as 1317042651.468569638, or a "
            f"stamps_unit beside stamps: names in densify.yaml"
        )
    is_beside = stamps not in ("names", "sweeps")
    file = _stamp_file(root, paths[0].parent, stamps, shared) if is_beside else None
    named_of = _numbered(names)
    path_of = {number: name.path for number, name in named_of.items()}
    if file is not None:
        stamp_file = StampFile.read(file, unit)
        stamps_ns, source = stamp_file.of(path_of), f"{file.name} in {stamp_file.unit}"
    elif untimed or stamps == "sweeps":
        return Series(path_of, None, "")
    else:
        stamps_ns = {number: name.stamp_ns or 0 for number, name in named_of.items()}
        source = "the names of the files"
    for before, number in pairwise(stamps_ns):
        if stamps_ns[number] <= stamps_ns[before]:
            raise InputError(
                f"{file or path_of[number]}: the time of number {number} is {stamps_ns[number]} ns"
                f", not after {stamps_ns[before]} ns of the one before; expected times that "
                f"ascend: sort the sweeps by time, and remove one that was stored twice"
            )
    return Series(path_of, stamps_ns, source)


def _numbered(names: Sequence[NamedFile]) -> dict[int, NamedFile]:
    """Return the files by number, counted from 0 in the order of time if names are times."""
    if any(name.number is None for name in names):
        return dict(enumerate(sorted(names, key=lambda name: (name.stamp_ns or 0, name.path))))
    ordered = sorted(names, key=lambda name: (name.number, name.path))
    for before, name in pairwise(ordered):
        if before.number == name.number:
            raise InputError(
                f"{name.path}: has the number {name.number}, as {before.path.name} has; expected "
                f"names that end in different numbers"
            )
    return {name.number or 0: name for name in ordered}


def _stamp_file(root: Path, folder: Path, name: str, shared: bool) -> Path | None:
    if name:
        return require_path(folder if (folder / name).is_file() else root, name, "stamps")
    searched = [folder] + [folder.parent] * (folder != root and (shared or folder.parent != root))
    files = (directory / file for directory in searched for file in _STAMP_FILES)
    return next((file for file in files if file.is_file()), None)


def require_path(folder: Path, name: str, key: str, is_folder: bool = False) -> Path:
    """Return the path that densify.yaml gives as ``key``. Raise InputError if it is missing."""
    path = folder / name
    if not (path.is_dir() if is_folder else path.is_file()):
        kind = "folder" if is_folder else "file"
        raise InputError(f"{path}: no such {kind}, though densify.yaml names it: {key}")
    return path


def files_below(root: Path, suffixes: Sequence[str], depth: int) -> dict[str, list[Path]]:
    """Return the visible files by folder relative to ``root``, ``depth`` levels deep at most."""
    files_of_folder = {}
    for folder, subfolders, names in os.walk(root):
        # os.walk visits the subfolders that remain in the list.
        subfolders[:] = sorted(
            name for name in subfolders if name[0] != "." and name not in _NO_SWEEPS
        )
        relative = Path(folder).relative_to(root)
        if len(relative.parts) == depth:
            subfolders.clear()
        paths = [Path(folder, name) for name in sorted(names) if name[0] != "."]
        paths = [path for path in paths if path.suffix.lower() in suffixes and os.path.isfile(path)]
        if paths:
            files_of_folder[relative.as_posix()] = paths
    return files_of_folder
