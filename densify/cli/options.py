# SPDX-License-Identifier: MIT
"""Read the options of verbs: the table that lists them, their values, and what they name."""

from __future__ import annotations

import argparse
import logging
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError

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
    """Raise ComputationError, with reasons by frame, if any of ``num`` keys or sweeps failed."""
    if failures:
        reasons = "; ".join(f"{unit} {number}: {error}" for number, error in failures.items())
        raise ComputationError(f"{len(failures)} of {num} {unit}s not made: {reasons}")
