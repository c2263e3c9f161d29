# SPDX-License-Identifier: MIT
"""Define the options that several verbs share, and read their values."""

from __future__ import annotations

import argparse
import logging
import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.screen import Answer
from densify.config import Config, presets, resolve
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence

_DATA = (
    "the recording: a folder or file, READER:PATH, or the built-in simulation "
    "street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG] (default: street)"
)
_MOST_DIGITS = 18


def add_verb(
    commands: Any,
    name: str,
    verb: Callable[[argparse.Namespace], Iterable[Answer]] | None,
    about: str,
    epilog: str = "",
) -> argparse.ArgumentParser:
    """Add a verb to the command line and return its parser; ``verb`` None has verbs of its own."""
    description = f"{about[0].upper()}{about[1:]}."
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=about, description=description, epilog=epilog or None
    )
    if verb is not None:
        parser.set_defaults(verb=verb, name=name)
        option(parser, "--json", "print the results as one JSON object")
    return parser


def option(parser: argparse.ArgumentParser, usage: str, about: str, **more: Any) -> None:
    """Add an option by its usage, ``--name METAVAR``, or ``--name`` for a flag without a value."""
    name, _, metavar = usage.partition(" ")
    kind: dict[str, Any] = {"metavar": metavar} if metavar else {"action": "store_true"}
    parser.add_argument(name, help=about, **kind, **more)


def add_recording(parser: argparse.ArgumentParser, several: bool = False) -> None:
    """Add the argument for the recording, positional and as ``--data``."""
    parser.add_argument("recording", metavar="SPEC", nargs="*" if several else "?", help=_DATA)
    number = "+" if several else 1
    option(
        parser,
        "--data SPEC",
        "the recording, as an option",
        nargs=number,
        action="extend",
        default=[],
    )


def add_common(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add some of the options window, method, camera, config (with ``--set``) and overwrite."""
    if "window" in names:
        about = (
            "number of sweeps on each side of the key (default: 5). More sweeps are denser and "
            "slower. Take twice as many at 20 Hz"
        )
        option(parser, "--window W", about, type=natural, default=5)
    if "method" in names:
        about = "flow: scene flow (default); icp: rigid accumulation; none: single sweep"
        parser.add_argument("--method", choices=("flow", "icp", "none"), default="flow", help=about)
    if "camera" in names:
        about = "take only this camera; may be given several times (default: all cameras)"
        option(parser, "--camera NAME", about, action="append", dest="cameras")
    if "config" in names:
        option(
            parser,
            "--config FILE|NAME",
            f"settings: a YAML file, or a preset: {', '.join(presets())}",
        )
        knob, about = "--set section.key=value", "change one setting; may be given several times"
        option(parser, knob, about, action="append", default=[], dest="overrides")
    if "overwrite" in names:
        option(parser, "--overwrite", "replace existing files (default: stop before them)")


def recordings_of(options: argparse.Namespace, default: str = "street") -> list[str]:
    """Return the specs of the recordings that a command names, else log and return ``default``."""
    given = options.recording or []
    specs = [*([given] if isinstance(given, str) else given), *options.data]
    if not specs:
        logging.getLogger("densify").info("no recording given: taking the simulator, %s", default)
    return specs or [default]


def recording_of(options: argparse.Namespace) -> str:
    """Return the spec of the one recording that a command names."""
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
    return resolve(options.config, [*options.overrides, *short])


def check_new_file(path: Path, overwrite: bool, suffix: str = "") -> None:
    """Raise InputError, before the computation, if a file exists or cannot be created."""
    if path.suffix != (suffix or path.suffix):
        raise InputError(f"--out {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise InputError(
            f"--out {path}: is a folder, expected the name of a {suffix or 'new'} file"
        )
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: already there and kept; give --overwrite or another name")
    place = next(place for place in path.parents if os.path.lexists(place))
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise InputError(f"--out {path}: cannot write in {place}; choose another")


def sliced(sequence: LidarSequence, keys: range | None) -> list[int]:
    """Return the frame numbers selected by ``--keys``; all frames for None."""
    from densify.readers.timeline import format_frames

    there = [frame for frame in sequence.frames if keys is None or frame in keys]
    if keys is not None and not there:
        raise InputError(
            f"--keys {keys.start}:{keys.stop}: {sequence.name} has no sweep among them; it has "
            f"{format_frames(sequence.frames)}"
        )
    return there


def natural(text: str) -> int:
    """Parse a whole number of at least 0."""
    if not _are_digits(text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number from 0 up")
    return int(text)


def positive(text: str) -> float:
    """Parse a number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0")
    return number


def words(text: str) -> list[str]:
    """Parse words separated by commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def key_range(text: str, other: str = "") -> range:
    """Parse ``A:B[:S]`` as a range; ``other`` says what else is accepted, for the message."""
    numbers = text.split(":")
    if len(numbers) in (2, 3) and _are_digits(*numbers):
        first, end, step = (*map(int, numbers), 1)[:3]
        if first < end and step > 0:
            return range(first, end, step)
    raise argparse.ArgumentTypeError(
        f"got {text!r}, expected {other}A:B[:S] with A < B, such as 0:100:5 for frames 0, 5 to 95"
    )


def all_or_range(text: str) -> range | None:
    """Parse ``all`` as None, or ``A:B[:S]`` as a range."""
    return None if text == "all" else key_range(text, "all, or ")


def shard(text: str) -> tuple[int, int]:
    """Parse ``i/n`` with i from 1 to n."""
    i, slash, n = text.partition("/")
    if slash and _are_digits(i, n) and 1 <= int(i) <= int(n):
        return int(i), int(n)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected i/n with i from 1 to n, as in 2/4")


def _are_digits(*texts: str) -> bool:
    return all(t.isascii() and t.isdigit() and len(t) <= _MOST_DIGITS for t in texts)
