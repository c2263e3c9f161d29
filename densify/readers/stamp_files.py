# SPDX-License-Identifier: MIT
"""Read times in the names of files and in text files.

Times since 1970 (the years 2000 to 2099) tell their unit by their size. Others are in seconds
unless a unit is given.
"""

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
_LONGEST_STEP_NS = 3_900_000_000  # from sweep to sweep, or image to image
_SECONDS_AND_NS = re.compile(r"(?<!\d)(\d{10})[_-](\d{9})(?!\d)")
_FILE_COLUMNS = ("filename", "file", "name", "image", "sweep", "path")
TIME_COLUMNS = ("timestamp", "time", "stamp", "t")
_MAX_NUMBER_DIGITS = 18  # a longer number is no frame's
_MOST_NS = 2**63


class Named(NamedTuple):
    """A file and the number or time in its name.

    Attributes:
        number: None without one.
        stamp_ns: None if it is no time since 1970.
    """

    path: Path
    number: int | None
    stamp_ns: int | None


def named(path: Path, unit: str = "") -> Named:
    """Return the number or the time in the name of a file.

    ``0000000120`` and ``cloud_12`` are numbers. ``1317042651.468569638``, ``1317042651_468569638``
    and ``1317042651468`` are times since 1970.

    Args:
        unit: If given, the last number in the name is a time in this unit.
    """
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
    """Return a decimal number of this unit as nanoseconds, every digit kept. Raises ValueError."""
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
    """Return a date and time in UTC as nanoseconds since 1970, every digit kept.

    Raise ValueError for other texts, and for years beyond 64 bits, which numpy would wrap.
    """
    day = np.datetime64(text, "D")
    if not np.datetime64("1970-01-01") <= day < np.datetime64("2262-01-01"):
        raise ValueError(f"got {text!r}, expected a year from 1970 to 2261")
    return int(np.datetime64(text, "ns").astype(np.int64))  # never through a float


def _epoch_unit(text: str) -> str:
    """Return the unit in which this is a time since 1970, "" without one."""
    for unit in UNIT_NS:
        try:
            if _EPOCH_NS[0] <= in_ns(text, unit) < _EPOCH_NS[1]:
                return unit
        except ValueError:
            continue
    return ""


class TextTable(NamedTuple):
    """Words of a text file, separated by blanks, commas, semicolons or tabs.

    Attributes:
        names: Of the columns, in lower case, if the first line has them.
        lines: Number of each row.
    """

    path: Path
    names: list[str]
    lines: list[int]
    rows: list[list[str]]

    @staticmethod
    def read(path: Path, known: Collection[str]) -> TextTable:
        """Return the table of a file.

        Args:
            known: A first line with one of these words names the columns, or one behind a #.

        Raises:
            InputError: There are no rows, or a row has fewer words than the first.
        """
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
        """Return the number of the first column with one of these names."""
        found = (self.names.index(name) for name in choices if name in self.names)
        return next((i for i in found if i < len(self.rows[0])), None)

    def times_ns(self, column: int, unit: str) -> tuple[tuple[int, ...], str]:
        """Return the times of a column, dates or numbers, and their unit.

        Args:
            unit: "" for the unit of times since 1970, or else seconds.

        Raises:
            InputError: A word is no time, or the usual step in an assumed unit is too long.
        """
        times = [words[column] for words in self.rows]
        dates = "-" in times[0][1:] and ":" in times[0]
        known = unit or _epoch_unit(times[0])
        found = []
        for line, text in zip(self.lines, times, strict=True):
            try:
                found.append(date_ns(text.rstrip("Z")) if dates else in_ns(text, known or "s"))
            except ValueError:
                raise InputError(
                    f"{self.path}: line {line}: got {text!r}, expected a time in {known or 's'}, "
                    f"from 1970 to 2261"
                ) from None
        steps = np.abs(np.diff(np.array(found, np.float64)))
        if not dates and not known and len(steps) and np.median(steps) > _LONGEST_STEP_NS:
            raise InputError(
                f"{self.path}: its times ({times[0]}, {times[1]}, ...) are too far apart for "
                f"seconds; name their unit in densify.yaml: stamps_unit: ms, us or ns"
            )
        return tuple(found), "date" if dates else known or "s"


class StampFile(NamedTuple):
    """The times of a text file, line by line.

    Attributes:
        unit: Of the times.
        names: File that each line belongs to, if the lines have names.
    """

    path: Path
    stamp_ns: tuple[int, ...]
    unit: str
    names: tuple[str, ...] | None

    @staticmethod
    def read(path: Path, unit: str = "") -> StampFile:
        """Return the times of a file: one time a line, or columns with a time and possibly a name.

        Times are numbers, or dates such as 2011-09-26 13:10:51.158069617.

        Args:
            unit: See `TextTable.times_ns`.

        Raises:
            InputError: The file is malformed. The message names file and line.
        """
        table = TextTable.read(path, (*TIME_COLUMNS, *_FILE_COLUMNS))
        at_time, at_name = table.column(TIME_COLUMNS), table.column(_FILE_COLUMNS)
        words = table.rows[0]
        if at_time is None and at_name is None:
            at_name = next((i for i, w in enumerate(words) if Path(w).suffix[1:2].isalpha()), None)
        if at_time is None:
            at_time = next((i for i in range(len(words)) if i != at_name), 0)
        stamps_ns, unit = table.times_ns(at_time, unit)
        files = None if at_name is None else tuple(Path(row[at_name]).name for row in table.rows)
        return StampFile(path, stamps_ns, unit, files)
