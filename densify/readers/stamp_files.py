# SPDX-License-Identifier: MIT
"""Times in the names of files and in text files, in any unit."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_text
from densify.readers.point_fields import UNIT_NS

_EPOCH_S = (946_684_800, 4_102_444_800)  # what counts as a time since 1970: the years 2000 to 2099
_STEP_S = (0.002, 3.9)  # from sweep to sweep, or image to image
_SECONDS_AND_NS = re.compile(r"(?<!\d)(\d{10})[_-](\d{9})(?!\d)")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_FILE_COLUMNS = ("filename", "file", "name", "image", "sweep", "path")
TIME_COLUMNS = ("timestamp", "time", "stamp", "t")
_MAX_NUMBER_DIGITS = 18  # a longer number is no frame's
_MOST_NS = 2**63


class Named(NamedTuple):
    """A file and what its name says. number: None where there is none; stamp_ns: None where it is
    no time since 1970."""

    path: Path
    number: int | None
    stamp_ns: int | None


def named(path: Path, unit: str = "") -> Named:
    """Return what a file's name says: ``0000000120`` and ``cloud_12`` are numbers;
    ``1317042651.468569638``, ``1317042651_468569638`` and ``1317042651468`` are times since 1970 in
    a unit that their size tells.

    unit: the last number in the name is a time in this unit.
    """
    stem = _SECONDS_AND_NS.sub(r"\1.\2", path.stem)
    words = _NUMBER.findall(stem)
    if unit:
        try:
            return Named(path, None, in_ns(words[-1] if words else "", unit))
        except ValueError:
            return Named(path, None, None)
    for word in reversed(words):
        epoch = _epoch_unit(Decimal(word))
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
    """Return a date and time in UTC as nanoseconds since 1970, every digit kept. Raises ValueError,
    also for years that 64 bits do not reach, of which numpy makes others."""
    day = np.datetime64(text, "D")
    if not np.datetime64("1970-01-01") <= day < np.datetime64("2262-01-01"):
        raise ValueError(f"got {text!r}, expected a year from 1970 to 2261")
    return int(np.datetime64(text, "ns").astype(np.int64))  # never through a float


def unit_of(times: Sequence[str]) -> str:
    """Return the unit in which these are times since 1970, or else in which the usual step between
    them is one of sweeps or images; "" if there is none. Raises ValueError for no numbers."""
    try:
        values = sorted(Decimal(text) for text in times)
    except InvalidOperation:
        raise ValueError(f"got {times[0]!r}, expected times") from None
    if not values or not all(value.is_finite() and value.copy_abs() < _MOST_NS for value in values):
        raise ValueError("got no finite numbers, expected times")
    epochs = {_epoch_unit(value) for value in values}
    if len(epochs) == 1 and epochs != {""}:
        return epochs.pop()
    step = float(np.median(np.diff([float(value) for value in values]))) if len(values) > 1 else 0
    low_s, high_s = _STEP_S
    fit = [unit for unit, ns in UNIT_NS.items() if low_s <= step * ns * 1e-9 <= high_s]
    return fit[0] if fit else ""


def _epoch_unit(value: Decimal) -> str:
    for unit, ns in UNIT_NS.items():
        if _EPOCH_S[0] <= value * ns / 1_000_000_000 < _EPOCH_S[1]:
            return unit
    return ""


class TextTable(NamedTuple):
    """Words of a text file, parted by blanks, commas, semicolons or tabs. names: of the columns, in
    lower case, where the first line has them. lines: the number of each row."""

    path: Path
    names: list[str]
    lines: list[int]
    rows: list[list[str]]

    @staticmethod
    def read(path: Path, known: Collection[str]) -> TextTable:
        """known: a first line with one of these words names the columns, or one behind a #. Raises
        InputError if there are no rows, or one has fewer words than the first."""
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
        """Return the times of a column, dates or numbers of this unit, "" to find it out; and the
        unit."""
        times = [words[column] for words in self.rows]
        dates = "-" in times[0][1:] and ":" in times[0]
        try:
            unit = "date" if dates else unit or unit_of(times)
        except ValueError as error:
            raise InputError(f"{self.path}: {error} in each line") from None
        if not unit:
            raise InputError(
                f"{self.path}: the unit of its times cannot be told ({times[0]}, {times[-1]}); "
                f"name it in densify.yaml: stamps_unit: s, ms, us or ns"
            )
        found = []
        for line, text in zip(self.lines, times, strict=True):
            try:
                found.append(date_ns(text.rstrip("Z")) if dates else in_ns(text, unit))
            except ValueError:
                raise InputError(
                    f"{self.path}: line {line}: got {text!r}, expected a time in {unit}, from 1970 "
                    f"to 2261"
                ) from None
        return tuple(found), unit


class StampFile(NamedTuple):
    """Times of a text file, line by line. unit: what was found or given. names: the file that each
    line belongs to, where it says so."""

    path: Path
    stamp_ns: tuple[int, ...]
    unit: str
    names: tuple[str, ...] | None

    @staticmethod
    def read(path: Path, unit: str = "") -> StampFile:
        """Read one time a line, or columns of which one is the time and another may be a file's
        name; numbers, or dates such as 2011-09-26 13:10:51.158069617.

        unit: "" finds it out. Raises InputError that names file and line.
        """
        table = TextTable.read(path, (*TIME_COLUMNS, *_FILE_COLUMNS))
        at_time, at_name = table.column(TIME_COLUMNS), table.column(_FILE_COLUMNS)
        words = table.rows[0]
        if at_time is None and at_name is None:
            named = [i for i, word in enumerate(words) if Path(word).suffix[1:2].isalpha()]
            at_name = named[0] if named else None
        if at_time is None:
            at_time = next((i for i in range(len(words)) if i != at_name), 0)
        stamps_ns, unit = table.times_ns(at_time, unit)
        files = None if at_name is None else tuple(Path(row[at_name]).name for row in table.rows)
        return StampFile(path, stamps_ns, unit, files)
