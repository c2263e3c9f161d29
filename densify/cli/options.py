# SPDX-License-Identifier: MIT
"""Options that several verbs have, and how their values are read."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer
from densify.config import Config, presets, resolve
from densify.config.errors import InputError
from densify.config.plugins.engines import described

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence

DATA_HELP = (
    "a recording's folder, READER:PATH, or the built-in "
    "street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG] (default: street)"
)
_MOST_DIGITS = 18


def add_verb(
    commands: Any,
    name: str,
    verb: Callable[[argparse.Namespace], Iterable[Answer]],
    about: str,
    epilog: str = "",
) -> argparse.ArgumentParser:
    """Add a verb to the command line and return its parser; ``verb`` is called with its options."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=about, description=sentence(about), epilog=epilog or None
    )
    parser.set_defaults(verb=verb, name=name)
    parser.add_argument("--json", action="store_true", help="print one JSON object, nothing else")
    return parser


def sentence(about: str) -> str:
    """Return the text with a capital letter and a full stop."""
    return f"{about[0].upper()}{about[1:]}."


def add_recording(parser: argparse.ArgumentParser, several: bool = False) -> None:
    """Add the recording, as a positional argument and as ``--data``."""
    parser.add_argument("recording", metavar="SPEC", nargs="*" if several else "?", help=DATA_HELP)
    number = "+" if several else 1
    parser.add_argument(
        "--data", metavar="SPEC", nargs=number, action="extend", default=[], help="the same"
    )


def recordings_of(options: argparse.Namespace, default: str = "street") -> list[str]:
    """Return the specs of the recordings that a command names."""
    given = options.recording or []
    return [*([given] if isinstance(given, str) else given), *options.data] or [default]


def recording_of(options: argparse.Namespace) -> str:
    """Return the spec of the one recording that a command names."""
    specs = recordings_of(options)
    if len(specs) > 1:
        raise InputError(f"got {len(specs)} recordings, {', '.join(specs)}; expected one")
    return specs[0]


def add_window(parser: argparse.ArgumentParser) -> None:
    """Add ``--window``."""
    about = "sweeps on each side of the key for moving objects (default: 5, at 10 Hz 0.5 s)"
    parser.add_argument("--window", type=natural, default=5, metavar="W", help=about)


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add ``--method``."""
    about = "flow (default): with scene flow; icp: registration only; none: the key sweep alone"
    parser.add_argument("--method", choices=("flow", "icp", "none"), default="flow", help=about)


def add_camera(parser: argparse.ArgumentParser) -> None:
    """Add ``--camera``."""
    about = "only this camera; may be given several times (default: all)"
    parser.add_argument("--camera", action="append", metavar="NAME", dest="cameras", help=about)


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--config`` and ``--set``."""
    known = ", ".join(presets())
    parser.add_argument("--config", metavar="FILE|NAME", help=f"a YAML file or a preset: {known}")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="section.key=value",
        dest="overrides",
        help="set one knob; may be given several times",
    )


def add_key_options(parser: argparse.ArgumentParser) -> None:
    """Add what ``run`` and ``compare`` share."""
    parser.epilog = f"Every knob with its default and what it does: {presets()['default']}"
    add_recording(parser)
    add_window(parser)
    add_camera(parser)
    parser.add_argument("--flow", metavar="ENGINE", help=f"flow.engine. {described()}")
    parser.add_argument(
        "--report",
        action="store_true",
        help="a page to look at each key in a browser, with the rejected pixels (short for --set "
        "output.report=true --set output.rejected=true; densify report makes it later)",
    )
    add_config_options(parser)
    folder = Path("densify-out")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=folder, help=f"(default: ./{folder})"
    )
    add_overwrite(parser)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add ``--overwrite``."""
    about = "replace what is already there (default: keep it)"
    parser.add_argument("--overwrite", action="store_true", help=about)


def config_of(options: argparse.Namespace) -> Config:
    """Return the configuration that ``--config``, ``--set``, ``--flow`` and ``--report`` make."""
    short = []
    if getattr(options, "flow", None) is not None:
        short.append(f"flow.engine={options.flow}")
    if getattr(options, "report", False):
        short += ["output.report=true", "output.rejected=true"]
    return resolve(options.config, [*options.overrides, *short])


def check_new_file(path: Path, overwrite: bool, suffix: str = ".npz") -> None:
    """Raise InputError, before the computation, if the file exists or cannot be made."""
    if path.suffix != suffix:
        raise InputError(f"--out {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder, expected the name of a {suffix} file")
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: already there and kept; give --overwrite or another name")
    place = path.parent
    while not os.path.lexists(place):
        place = place.parent
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise InputError(f"--out {path}: cannot write in {place}; choose another")


def sliced(sequence: LidarSequence, keys: slice) -> list[int]:
    """Return the frames of ``--keys``. Raises InputError if there is none."""
    from densify.readers.timeline import format_frames

    chosen = frozenset(range(keys.start, keys.stop, keys.step or 1))
    there = [frame for frame in sequence.frames if frame in chosen]
    if not there:
        raise InputError(
            f"--keys {keys.start}:{keys.stop}: {sequence.name} has no sweep among them; it has "
            f"{format_frames(sequence.frames)}"
        )
    return there


def natural(text: str) -> int:
    """Read a whole number from 0 up."""
    if not _are_digits(text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number from 0 up")
    return int(text)


def positive(text: str) -> float:
    """Read a number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (number > 0 and math.isfinite(number)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0")
    return number


def words(text: str) -> list[str]:
    """Read words separated by commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def frame_range(text: str) -> range:
    """Read ``A:B[:S]`` as a range."""
    keys = key_slice(text)
    return range(keys.start, keys.stop, keys.step)


def key_slice(text: str, other: str = "") -> slice:
    """Read ``A:B[:S]``. other: what is accepted too, for the message."""
    numbers = text.split(":")
    if len(numbers) in (2, 3) and _are_digits(*numbers):
        first, end, step = (*map(int, numbers), 1)[:3]
        if first < end and step > 0:
            return slice(first, end, step)
    raise argparse.ArgumentTypeError(
        f"got {text!r}, expected {other}A:B[:S] with A < B, such as 0:100:5 for frames 0, 5 to 95"
    )


def all_or_slice(text: str) -> slice | None:
    """Read ``all``, which is None, or ``A:B[:S]``."""
    return None if text == "all" else key_slice(text, "all, or ")


def shard(text: str) -> tuple[int, int]:
    """Read ``i/n`` with i from 1 to n."""
    i, slash, n = text.partition("/")
    if slash and _are_digits(i, n) and 1 <= int(i) <= int(n):
        return int(i), int(n)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected i/n with i from 1 to n, as in 2/4")


def _are_digits(*texts: str) -> bool:
    return all(t.isascii() and t.isdigit() and len(t) <= _MOST_DIGITS for t in texts)
