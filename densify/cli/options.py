# SPDX-License-Identifier: MIT
"""Options that several verbs have, and what their values are read with."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer
from densify.config import Config, presets, resolve
from densify.config.errors import InputError
from densify.config.plugins.engines import described

if TYPE_CHECKING:
    from densify.config.cache import Cache
    from densify.geometry.types import LidarSequence

_MOST_DIGITS = 18
_UNITS = ("K", "M", "G", "T")
_SHORT = {
    "flow": "flow.engine",
    "at": "project.at",
    "movers": "output.movers",
    "per": "project.per",
}
DATA_HELP = (
    "a recording's folder, READER:PATH, or the built-in "
    "street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG] (default: street)"
)


def add_verb(
    commands: Any,
    name: str,
    verb: Callable[[argparse.Namespace], Iterable[Answer]],
    about: str,
    epilog: str = "",
) -> argparse.ArgumentParser:
    """A verb of the command line, which calls ``verb`` with its options."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=about, description=sentence(about), epilog=epilog or None
    )
    parser.set_defaults(verb=verb, name=name)
    parser.add_argument("--json", action="store_true", help="print one JSON object, nothing else")
    parser.add_argument("--quiet", action="store_true", help="say nothing but errors")
    return parser


def sentence(about: str) -> str:
    """What a verb is about, as it stands above its options."""
    return f"{about[0].upper()}{about[1:]}."


def config_epilog() -> str:
    """Where every knob is explained."""
    return f"Every knob with its default and what it does: {presets()['default']}"


def add_window(parser: argparse.ArgumentParser) -> None:
    """``--window``"""
    parser.add_argument(
        "--window",
        type=natural,
        default=5,
        metavar="W",
        help="sweeps on each side of the key from which what moves is taken (default: 5; at 10 Hz "
        "0.5 s, at 12 m/s 6 m); what stands still comes from accumulate.far_m",
    )


def add_method(parser: argparse.ArgumentParser) -> None:
    """``--method``"""
    parser.add_argument(
        "--method",
        choices=("flow", "icp", "none"),
        default="flow",
        help="flow: registration and scene flow; icp: registration only; none: the key sweep alone "
        "(default: flow)",
    )


def add_camera(parser: argparse.ArgumentParser) -> None:
    """``--camera``"""
    parser.add_argument(
        "--camera",
        action="append",
        metavar="NAME",
        dest="cameras",
        help="only this camera; may be given several times (default: all)",
    )


def add_short_options(parser: argparse.ArgumentParser) -> None:
    """Options that are short for a knob."""
    parser.add_argument(
        "--flow",
        metavar="ENGINE",
        help=f"{described()} (short for --set flow.engine=ENGINE)",
    )
    parser.add_argument(
        "--at",
        choices=("camera", "sweep"),
        help="the moment the maps show: each image's own exposure, or the key sweep's reference "
        "time (short for --set project.at=…; default: camera)",
    )
    parser.add_argument(
        "--per",
        choices=("sweep", "image"),
        help="one depth map for each camera, or one for every image exposed nearer to this sweep "
        "than to another (short for --set project.per=…; default: sweep)",
    )
    parser.add_argument(
        "--movers",
        choices=("keep", "drop", "separate"),
        help="moving objects in the maps, left out, or left out and written one by one (short for "
        "--set output.movers=…; default: keep)",
    )
    parser.add_argument(
        "--report",
        action="store_true",
        help="a page to look at each key in a browser, with what was left out and why (short for "
        "--set output.report=true --set output.rejected=true; densify report makes it later)",
    )


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """``--config`` and ``--set``"""
    parser.add_argument(
        "--config", metavar="FILE|NAME", help=f"a YAML file or a preset: {', '.join(presets())}"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="section.key=value",
        dest="overrides",
        help="set one knob; may be given several times",
    )


def add_key_options(parser: argparse.ArgumentParser) -> None:
    """What ``run`` and ``compare`` share."""
    add_window(parser)
    parser.add_argument(
        "--cache",
        action="store_true",
        help="keep poses, ground, evidence and motion on disk, and take what an earlier run with "
        "the same sweeps and settings left there (default: nothing is kept, since hashing and "
        "writing cost more than a single run gains)",
    )
    parser.add_argument(
        "--cache-size",
        type=size_bytes,
        default="10G",
        metavar="SIZE",
        help="bound of what --cache keeps (default: 10G)",
    )
    parser.add_argument("--data", metavar="SPEC", default="street", help=DATA_HELP)
    add_camera(parser)
    add_short_options(parser)
    add_config_options(parser)


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """``--out`` of a run, and ``--overwrite``"""
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("densify-out"),
        help="(default: ./densify-out)",
    )
    add_overwrite(parser)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """``--overwrite``"""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace what is already there (default: keep it)"
    )


def config_of(options: argparse.Namespace) -> Config:
    """The configuration with the options that are short for a knob."""
    given = {knob: getattr(options, name) for name, knob in _SHORT.items()}
    named = [f"{knob}={value}" for knob, value in given.items() if value is not None]
    if options.report:
        named += ["output.report=true", "output.rejected=true"]
    return resolve(options.config, [*options.overrides, *named])


def cache_of(options: argparse.Namespace) -> Cache | None:
    """What ``--cache`` keeps."""
    if not options.cache:
        return None
    from densify.config.cache import Cache

    return Cache(options.cache_size)


def sliced(sequence: LidarSequence, keys: slice) -> list[int]:
    """The frames of ``--keys``. Raises InputError if there is none."""
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
    """A whole number from 0 up."""
    if not _are_digits(text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number from 0 up")
    return int(text)


def positive(text: str) -> float:
    """A number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (number > 0 and math.isfinite(number)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0")
    return number


def words(text: str) -> list[str]:
    """Words parted by commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def frame_range(text: str) -> range:
    """``A:B``, frames A to B-1."""
    first, colon, end = text.partition(":")
    if not (colon and _are_digits(first, end) and int(first) < int(end)):
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected A:B with A < B, for example 115:126 for frames 115 to 125"
        )
    return range(int(first), int(end))


def key_slice(text: str, other: str = "") -> slice:
    """``A:B[:S]``; ``other``: what the option takes too, for the message."""
    numbers = text.split(":")
    if len(numbers) in (2, 3) and _are_digits(*numbers):
        first, end = int(numbers[0]), int(numbers[1])
        step = int(numbers[2]) if len(numbers) == 3 else 1
        if first < end and step > 0:
            return slice(first, end, step)
    raise argparse.ArgumentTypeError(
        f"got {text!r}, expected {other}A:B[:S] with A < B, for example 0:100:5 for frames 0, 5 "
        f"to 95"
    )


def all_or_slice(text: str) -> slice | None:
    """``all``, which is None, or ``A:B[:S]``."""
    return None if text == "all" else key_slice(text, "all, or ")


def recording_keys(text: str) -> tuple[str, list[int]]:
    """``SPEC@KEYS``: a recording and its frames, ``K,K,…`` or ``A:B[:S]``."""
    spec, _, keys = text.rpartition("@")
    numbers = keys.split(",")
    if spec and _are_digits(*numbers):
        return spec, [int(number) for number in numbers]
    frames = key_slice(keys) if spec and ":" in keys else None
    if frames is None:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a recording and frames such as street?seed=51@60,80 or "
            f"drive@101:126:4"
        )
    return spec, list(range(frames.start, frames.stop, frames.step))


def shard(text: str) -> tuple[int, int]:
    """``i/n`` with i from 1 to n."""
    i, slash, n = text.partition("/")
    if slash and _are_digits(i, n) and 1 <= int(i) <= int(n):
        return int(i), int(n)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected i/n with i from 1 to n, as in 2/4")


def size_bytes(text: str) -> int:
    """A size such as 8G, in powers of 1024."""
    number, unit = text[:-1], text[-1:].upper()
    size = positive(number) * 1024.0 ** (1 + "KMGT".index(unit)) if unit in _UNITS else 0
    if not 1 <= size <= 1024**5:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a size such as 8G or 500M, up to 1024T"
        )
    return int(size)


def _are_digits(*texts: str) -> bool:
    return all(t.isascii() and t.isdigit() and len(t) <= _MOST_DIGITS for t in texts)
