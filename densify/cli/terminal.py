# SPDX-License-Identifier: MIT
"""Read the options of commands, and print their answers, progress and tables."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError, shorten_message

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence

_MOST_DIGITS = 18


def natural(text: str) -> int:
    """Parse a whole number from 0 up. Raise ArgumentTypeError for other texts."""
    if not _are_digits(text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number from 0 up")
    return int(text)


def positive(text: str) -> float:
    """Parse a finite number above 0. Raise ArgumentTypeError for other texts."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0")
    return number


def words(text: str) -> list[str]:
    """Parse words separated by commas, without empty ones."""
    return [word.strip() for word in text.split(",") if word.strip()]


def key_range(text: str, alternative: str = "") -> range:
    """Parse ``A:B[:S]`` as frames A to B - 1 by S, else 1. Errors also name the ``alternative``."""
    numbers = text.split(":")
    if len(numbers) in (2, 3) and _are_digits(*numbers):
        begin, end = int(numbers[0]), int(numbers[1])
        step = int(numbers[2]) if len(numbers) == 3 else 1
        if begin < end and step > 0:
            return range(begin, end, step)
    raise argparse.ArgumentTypeError(
        f"got {text!r}, expected {alternative}A:B[:S] with A < B, such as 0:100:5 for frames 0, 5 "
        f"to 95"
    )


def all_or_range(text: str) -> range | None:
    """Parse ``all`` as None, or ``A:B[:S]`` as a range."""
    return None if text == "all" else key_range(text, "all, or ")


def shard(text: str) -> tuple[int, int]:
    """Parse ``i/n``, part i of n with i from 1 to n. Raise ArgumentTypeError for other texts."""
    part, slash, count = text.partition("/")
    if slash and _are_digits(part, count) and 1 <= int(part) <= int(count):
        return int(part), int(count)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected i/n with i from 1 to n, as in 2/4")


def _are_digits(*texts: str) -> bool:
    """Return True if all texts are whole numbers of at most 18 digits."""
    return all(text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS for text in texts)


_PARSERS: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("K", "N", "W"), natural),
    **dict.fromkeys(("C", "MS"), float),
    **dict.fromkeys(("DIR", "FILE", "DIR|FILE", "F.npz|DIR", "PNG|DIR", "MODEL", "RUN"), Path),
    **dict.fromkeys(("PREDICTED", "TRUTH", "TARGET"), Path),
    **dict.fromkeys(("A:B", "A:B[:S]"), key_range),
    **dict.fromkeys(("NAME,…", "KIND,…"), words),
    "X": positive,
    "all|A:B[:S]": all_or_range,
    "i/n": shard,
}
"""METAVAR of an option -> function that parses its value; those of other METAVARs are texts."""


def add_options(parser: argparse.ArgumentParser, table: str) -> None:
    """Add the options of a table to a parser.

    A row begins at the margin: ``--name METAVAR =DEFAULT``, two blanks, and the help, which may
    end in "(required)". A switch has no METAVAR, a positional argument no name. ``METAVAR...`` may
    be given several times, ``METAVAR+`` takes several values, ``[METAVAR]`` and ``[METAVAR+]`` may
    be absent, ``{a,b}`` are the choices. `_PARSERS` has the types of values by METAVAR.
    """
    for row in re.split(r"\n(?=\S)", table.strip()):
        usage, _, about = row.partition("  ")
        about = " ".join(about.split())
        name, *values = usage.split()
        settings: dict[str, Any] = {}
        if values and values[-1].startswith("="):
            settings["default"] = values.pop().removeprefix("=")
            about += f" (default: {settings['default']})"
        if not name.startswith("--"):
            settings |= _settings_of(name.strip("[]"))
            if name.startswith("["):
                settings["nargs"] = "*" if settings.pop("action", None) else "?"
            name = settings["metavar"].partition("|")[0].lower()
        elif values:
            settings |= _settings_of(values[0]) | {"required": about.endswith("(required)")}
        else:
            settings["action"] = "store_true"
        parser.add_argument(name, help=about, **settings)


def _settings_of(usage: str) -> dict[str, Any]:
    """Return the arguments of ``add_argument`` for a METAVAR with its suffix."""
    if usage.startswith("{"):
        return {"choices": usage.strip("{}").split(",")}
    metavar = usage.removesuffix("...").removesuffix("+")
    settings: dict[str, Any] = {"metavar": metavar, "type": _PARSERS.get(metavar, str)}
    if usage.endswith("+"):
        settings |= {"nargs": "+", "action": "extend"}
    elif usage.endswith("..."):
        settings |= {"action": "append", "nargs": "+" if usage.endswith("+...") else None}
    return settings


def recordings_of(options: argparse.Namespace, default: str = "street") -> list[str]:
    """Return the specifications of a command's recordings, or ``default``, which is logged."""
    positional = [options.spec] if isinstance(options.spec, str) else options.spec or []
    specs = [*positional, *(options.data or [])]
    if not specs:
        logging.getLogger("densify").info("no recording given: taking the simulator, %s", default)
    return specs or [default]


def recording_of(options: argparse.Namespace) -> str:
    """Return the specification of a command's only recording. Raise InputError for several."""
    specs = recordings_of(options)
    if len(specs) > 1:
        raise InputError(f"got {len(specs)} recordings, {', '.join(specs)}; expected one")
    return specs[0]


def config_of(options: argparse.Namespace) -> Config:
    """Return the settings of ``--config``, ``--set``, ``--flow``, ``--score`` and ``--report``."""
    short = []
    if getattr(options, "flow", None) is not None:
        short.append(f"flow.engine={options.flow}")
    if getattr(options, "score", False):
        short.append("output.score=true")
    if getattr(options, "report", False):
        short += ["output.report=true", "output.rejected=true"]
    return resolve(options.config, [*(options.set or []), *short])


def check_new_file(path: Path, overwrite: bool, suffix: str = "", option: str = "--out") -> None:
    """Raise InputError if the file of ``option`` exists, lacks ``suffix`` or cannot be made."""
    if path.suffix != (suffix or path.suffix):
        raise InputError(f"{option} {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise InputError(
            f"{option} {path}: is a folder, expected the name of a {suffix or 'new'} file"
        )
    if path.exists() and not overwrite:
        raise InputError(
            f"{option} {path}: already there and kept; give --overwrite or another name"
        )
    parent = next(folder for folder in path.parents if os.path.lexists(folder))
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise InputError(f"{option} {path}: cannot write in {parent}; choose another")


def selected_frames(sequence: LidarSequence, keys: range | None) -> list[int]:
    """Return the frame numbers within ``--keys``, all for None. Raise InputError if none fits."""
    from densify.readers.timeline import format_frames

    frames = [frame for frame in sequence.frames if keys is None or frame in keys]
    if keys is not None and not frames:
        raise InputError(
            f"--keys {keys.start}:{keys.stop}: {sequence.name} has no sweep among them; it has "
            f"{format_frames(sequence.frames)}"
        )
    return frames


def raise_failures(failures: Mapping[int, Exception], num: int, unit: str) -> None:
    """Raise ComputationError if any key or sweep failed.

    Args:
        failures: Frame number -> error of those that failed.
        num: Number of those that were tried.
        unit: "key" or "sweep", for the message.
    """
    if failures:
        reasons = "; ".join(f"{unit} {number}: {error}" for number, error in failures.items())
        raise ComputationError(f"{len(failures)} of {num} {unit}s not made: {reasons}")


if TYPE_CHECKING:
    from densify.geometry.types import Progress

_BAR = "{desc:<27} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"
_SCHEMA = 1
"""Version of what ``--json`` prints; grows when a key changes its meaning or goes."""
_MOST_FIRST = 3
_MOST_WARNINGS = 20
_LINE_S = 10.0  # least time between two lines of progress without a terminal
_MOST_PATHS = 6  # more written files are counted
_TITLES = {
    "read": "reading sweeps",
    "register": "registering sweeps",
    "ground": "finding the ground",
    "flow": "finding moving objects",
    "far": "registering the road around",
    "accumulate": "accumulating points",
    "images": "reading images",
    "project": "making depth maps",
    "colour": "colouring the cloud",
    "held out": "scoring without the key",
    "score": "scoring",
    "prior": "completing with the prior",
}
"""Pipeline stage -> what is shown for it."""


@dataclass(frozen=True)
class Answer:
    """The answer of a command."""

    text: str = ""  # text for people
    # Values for programs (``--json``). Lists of several answers are concatenated.
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Sequence[Path] = ()  # written files
    # File that the user may open first -> its content
    first: Mapping[Path, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Return the text, the files or the folder of many files, and the files to open first."""
        lines = [self.text] if self.text else []
        if len(self.files) > _MOST_PATHS:
            lines.append(f"{len(self.files)} files in {os.path.commonpath(self.files)}")
        else:
            lines += map(str, self.files)
        if self.first:
            rows = [[f"  {path}", content] for path, content in self.first.items()]
            lines += ["open first:", aligned(rows, "<")]
        return lines


def first_of(files: Sequence[Path], kinds: Mapping[str, str]) -> dict[Path, str]:
    """Return up to three files to open first -> content, one for each pattern of ``kinds``."""
    first: dict[Path, str] = {}
    for pattern, content in kinds.items():
        path = next((f for f in files if f.match(pattern) and f not in first), None)
        if path is not None and len(first) < _MOST_FIRST:
            first[path] = content
    return first


def numbers_table(columns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a text table with a column per mapping and a row per number, labelled by its path."""
    flat = {title: dict(_numbers(numbers, "")) for title, numbers in columns.items()}
    names = dict.fromkeys(name for numbers in flat.values() for name in numbers)
    body = [[name, *(_cell(column.get(name)) for column in flat.values())] for name in names]
    return aligned([["", *columns], *body])


def _cell(value: float | None) -> str:
    return written(value, ",d" if isinstance(value, int) else ".4g")


def _numbers(values: Mapping[str, Any], path: str) -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{path}{name} ")
        elif isinstance(value, float | int):
            yield f"{path}{name}", value


def aligned(rows: Sequence[Sequence[str]], side: str = ">") -> str:
    """Return rows of cells as text, the first column left-aligned, the others by ``side``."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<", *(side * (len(widths) - 1))]
    lines = (
        "  ".join(f"{cell:{s}{w}}" for cell, s, w in zip(row, sides, widths, strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def written(value: float | None, form: str) -> str:
    """Return a number as text in a format such as ".2f m", a unit at its end, or "-" for None."""
    if value is None:
        return "-"
    number, _, unit = form.partition(" ")
    return f"{value:{number}}".replace("%", " %") + (f" {unit}" if unit else "")


def percent(value: float | None, digits: int = 2) -> str:
    """Return a share, 0 to 1, as a percentage with this number of digits, or "-" for None."""
    return written(value, f".{digits}%")


def look_up(metrics: Mapping[str, Any], *path: str) -> Any:
    """Return ``metrics[a][b]...``, None if a key of the path is missing."""
    value: Any = metrics
    for step in path:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value


class Screen(logging.Handler):
    """The output of one command: text with log lines above the bar, or one JSON object."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._is_json = False
        self._facts: dict[str, Any] = {}
        self._warnings: list[str] = []

    def begin(self, options: argparse.Namespace) -> None:
        """Start the answer of a command: read its name and ``--json`` from the options."""
        verb = options.verb.rpartition(" ")[2]
        self._is_json = options.json
        self._facts = {"schema": _SCHEMA, "verb": verb, "files": [], "open_first": []}

    def show(self, answer: Answer) -> None:
        """Print the answer, or keep its facts for the JSON object at the end."""
        if self._is_json:
            files = {"files": answer.files, "open_first": [*answer.first]}
            for name, value in {**answer.facts, **files}.items():
                joined = isinstance(value, list | tuple) and name in self._facts
                self._facts[name] = [*self._facts[name], *value] if joined else value
            return
        with _above_bars():
            for line in answer.lines():
                print(line)
            sys.stdout.flush()

    def end(self, exit_code: int, error: str | None = None) -> int:
        """Print the error and the JSON object, if present, and return the exit code."""
        if error is not None:
            logging.getLogger("densify").error("%s", error)
        if self._is_json:
            from densify.outputs.folders import plain

            outcome = {"exit_code": exit_code, "error": error, "warnings": self._warnings}
            facts = plain({**self._facts, **outcome})
            print(json.dumps(facts, indent=1, allow_nan=False, default=str), flush=True)
        return exit_code

    def emit(self, record: logging.LogRecord) -> None:
        """Print the message of a record, and keep a warning for the JSON object."""
        text = shorten_message(" ".join(record.getMessage().split()))
        is_warning = record.levelno == logging.WARNING
        if is_warning:
            self._warnings.append(text)
        with suppress(OSError, ValueError), _above_bars():  # stderr may be closed or full
            print(f"densify: {'warning: ' * is_warning}{text}", file=sys.stderr, flush=True)


@contextmanager
def screen() -> Iterator[Screen]:
    """Send the package's log to a new screen within the ``with`` block."""
    log, progress = logging.getLogger("densify"), logging.getLogger("densify.progress")
    before = log.level, log.propagate, progress.level
    shown = Screen()
    log.addHandler(shown)
    log.setLevel(logging.INFO)
    log.propagate = False
    # Progress is shown on a terminal only, warnings of other packages as debug messages.
    if not progress.level:
        progress.setLevel(logging.INFO if sys.stderr.isatty() else logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: log.debug("%s", message)  # type: ignore
            yield shown
    finally:
        log.removeHandler(shown)
        log_level, log.propagate, progress_level = before
        log.setLevel(log_level)
        progress.setLevel(progress_level)


@contextmanager
def progress_on_stderr() -> Iterator[Progress]:
    """Yield a callback (stage, done, total): a bar on a terminal, elsewhere a line every 10 s."""
    from tqdm import tqdm

    is_hidden = not sys.stderr.isatty()
    begin_s = shown_s = time.monotonic()
    shown_stage = ""
    with tqdm(total=1, file=sys.stderr, leave=False, bar_format=_BAR, disable=is_hidden) as bar:

        def show(stage: str, done: int, total: int) -> None:
            nonlocal shown_s, shown_stage
            stage = _TITLES.get(stage, stage)
            if is_hidden:
                is_end = done == total and stage == shown_stage
                if is_end or time.monotonic() - shown_s >= _LINE_S:
                    shown_s, shown_stage = time.monotonic(), "" if is_end else stage
                    text = f"densify: {shown_s - begin_s:.0f} s: {stage}, {done} of {total}"
                    print(text, file=sys.stderr, flush=True)
                return
            if done < bar.n or total != bar.total:  # another stage
                bar.set_description(stage, refresh=False)
                bar.reset(total)
                bar.initial = done
            bar.n = done
            bar.set_description(stage)

        yield show


def _above_bars() -> AbstractContextManager[None]:
    """Hide progress bars within the block."""
    bars = sys.modules.get("tqdm")
    return nullcontext() if bars is None else bars.tqdm.external_write_mode(sys.stderr)


def log_warnings(warned: Iterable[tuple[str, str, int]]) -> None:
    """Log each distinct warning once with its keys, from (warning, recording, key) triples."""
    from densify.readers.timeline import format_frames

    log = logging.getLogger("densify")
    keys: dict[tuple[str, str], list[int]] = {}
    for warning, recording, key in warned:
        keys.setdefault((warning, recording), []).append(key)
    ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
    for (warning, recording), of_warning in ordered[:_MOST_WARNINGS]:
        log.warning("%s: %s", f"{recording} key {format_frames(of_warning)}".lstrip(), warning)
    num_more = len(ordered) - _MOST_WARNINGS
    if num_more > 0:
        log.warning("... and %d more warnings, see run.yaml or the manifest", num_more)
