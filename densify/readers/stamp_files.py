# SPDX-License-Identifier: MIT
"""Read times in file names and text files; the unit of times since 1970 is found by their size."""

from __future__ import annotations

import re
from collections.abc import Collection
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.readers.point_fields import UNIT_NS

_EPOCH_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)
_LONGEST_STEP_NS = 3_900_000_000  # between sweeps or images
_SECONDS_AND_NS = re.compile(r"(?<!\d)(\d{10})[_-](\d{9})(?!\d)")
_FILE_COLUMNS = ("filename", "file", "name", "image", "sweep", "path")
TIME_COLUMNS = ("timestamp", "time", "stamp", "t")
_MAX_NUMBER_DIGITS = 18  # a longer number is no frame number
_MOST_NS = 2**63
_MOST_EQUAL = 1 / 3  # share of the steps


class Named(NamedTuple):
    """A file and the number or time in its name."""

    path: Path
    number: int | None  # number in the name; None for a name with a time or without digits
    stamp_ns: int | None  # time in the name in nanoseconds; None for a name without a time


def named(path: Path, unit: str = "") -> Named:
    """Find the number or the time in a file's name; with a ``unit`` the last number is a time."""
    # 0000000120 and cloud_12 are numbers. 1317042651.468569638, 1317042651_468569638 and
    # 1317042651468 are times since 1970.
    words = re.findall(r"\d+(?:\.\d+)?", _SECONDS_AND_NS.sub(r"\1.\2", path.stem))
    if unit:
        try:
            return Named(path, None, in_ns(words[-1] if words else "", unit))
        except ValueError:
            return Named(path, None, None)
    for word in reversed(words):
        epoch = _epoch_unit(word)
        # ten digits without a fraction are a number with zeros before it, as KITTI's
        if epoch and (epoch != "s" or "." in word) and not word.startswith("0"):
            return Named(path, None, in_ns(word, epoch))
    digits = [word for word in re.findall(r"\d+", path.stem) if len(word) <= _MAX_NUMBER_DIGITS]
    return Named(path, int(digits[-1]) if digits else None, None)


def in_ns(text: str, unit: str) -> int:
    """Convert a decimal number in ``unit`` to ns, exactly; raise ValueError if impossible."""
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
    """Convert an ISO date in UTC to ns since 1970 without loss; raise ValueError for others."""
    day = np.datetime64(text, "D")  # numpy wraps years beyond 64 bits
    if not np.datetime64("1970-01-01") <= day < np.datetime64("2262-01-01"):
        raise ValueError(f"got {text!r}, expected a year from 1970 to 2261")
    return int(np.datetime64(text, "ns").astype(np.int64))  # never through a float


def _epoch_unit(text: str) -> str:
    """Return the unit in which a number is a time from 2000 to 2099, "" if no unit fits."""
    for unit in UNIT_NS:
        try:
            if _EPOCH_NS[0] <= in_ns(text, unit) < _EPOCH_NS[1]:
                return unit
        except ValueError:
            continue
    return ""


def check_digits(stamps_ns: Collection[int], text: str, where: Path) -> None:
    """Raise InputError if times in file order are equal by rounding; ``text`` is the first one."""
    steps_ns = np.diff(np.array([*stamps_ns], np.int64))
    num_equal = int((steps_ns == 0).sum())
    min_equal = min(2, len(steps_ns))  # one of several may be a hiccup of the recorder
    if num_equal >= max(min_equal, 1) and num_equal > _MOST_EQUAL * len(steps_ns):
        raise InputError(
            f"{where}: {num_equal} of {len(steps_ns)} times are equal to the time before, such as "
            f"{text}: they have lost digits; write them anew with all digits, in nanoseconds or "
            f"with %.9f"
        )


class TextTable(NamedTuple):
    """Table of a text file, with columns separated by blanks, commas, semicolons or tabs."""

    path: Path
    names: list[str]  # names of the columns in lower case; empty without a line of names
    lines: list[int]  # line number of each row in the file, from 1
    rows: list[list[str]]  # words of each row

    @staticmethod
    def read(path: Path, known: Collection[str]) -> TextTable:
        """Read a file; its first line names columns if it has a known name or begins with #."""
        names: list[str] = []
        lines: list[int] = []
        rows: list[list[str]] = []
        for number, line in enumerate(read_text(path).splitlines(), 1):
            text = re.sub(r"(\d-\d\d) (\d\d:)", r"\1T\2", line.strip().strip("#,;").strip())
            words = [word.strip('"') for word in re.split(r"[\s,;]+", text)]
            lower = [word.lower().split("[")[0] for word in words]
            is_comment = line.lstrip().startswith("#")
            if not rows and not names and (is_comment or any(word in known for word in lower)):
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
        """Return the index of the first of the names in ``choices`` that is a column, else None."""
        indices = (self.names.index(name) for name in choices if name in self.names)
        return next((i for i in indices if i < len(self.rows[0])), None)

    def times_ns(self, column: int, unit: str) -> tuple[tuple[int, ...], str]:
        """Return the times of a column in nanoseconds, and the unit in the file ("date" for dates).

        Without a ``unit`` ("") the unit of times since 1970 is found; else it is seconds.
        """
        times = [words[column] for words in self.rows]
        dates = "-" in times[0][1:] and ":" in times[0]
        known = unit or _epoch_unit(times[0])
        times_ns = []
        for line, text in zip(self.lines, times, strict=True):
            try:
                times_ns.append(date_ns(text.rstrip("Z")) if dates else in_ns(text, known or "s"))
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


class StampFile(NamedTuple):
    """The times of a text file, line by line."""

    path: Path
    stamp_ns: tuple[int, ...]  # time of each line in nanoseconds
    unit: str  # unit of the times in the file: s, ms, us, ns or date
    # Name of the sweep or image file of each line; None if lines have only times
    names: tuple[str, ...] | None

    @staticmethod
    def read(path: Path, unit: str = "") -> StampFile:
        """Read a time from each line, alone or among columns: a number of ``unit``, or a date."""
        table = TextTable.read(path, (*TIME_COLUMNS, *_FILE_COLUMNS))
        at_time, at_name = table.column(TIME_COLUMNS), table.column(_FILE_COLUMNS)
        words = table.rows[0]
        if at_time is None and at_name is None:
            at_name = next((i for i, w in enumerate(words) if Path(w).suffix[1:2].isalpha()), None)
        if at_time is None:
            at_time = next((i for i in range(len(words)) if i != at_name), 0)
        stamps_ns, unit = table.times_ns(at_time, unit)
        files = None if at_name is None else tuple(Path(row[at_name]).name for row in table.rows)
        if files is None:  # files of several cameras may have one time
            check_digits(stamps_ns, words[at_time], path)
        return StampFile(path, stamps_ns, unit, files)
