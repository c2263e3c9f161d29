# SPDX-License-Identifier: MIT
"""``densify run``: one key or several."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer, first_of
from densify.cli.options import (
    add_key_options,
    add_method,
    add_output_options,
    add_verb,
    cache_of,
    config_epilog,
    config_of,
    key_slice,
    natural,
    sliced,
)
from densify.cli.progress import Course, course_on_stderr
from densify.cli.screen import tell_doubts
from densify.config import Config, as_mapping
from densify.config.errors import ComputationError, InputError

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence, Result


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(commands, "run", answer, "densify one key or several", config_epilog())
    parser.add_argument(
        "--key",
        type=natural,
        action="append",
        default=[],
        metavar="K",
        help="the frame to densify; may be given several times",
    )
    parser.add_argument(
        "--keys",
        type=key_slice,
        metavar="A:B[:S]",
        help="frames A to B-1, every S-th, of those that exist; keys whose windows overlap share "
        "registration and motion",
    )
    add_key_options(parser)
    add_method(parser)
    parser.add_argument(
        "--prior",
        type=Path,
        metavar="DIR|FILE",
        help="depth images of your own, as of a monocular network: DIR/CAMERA/FRAME.npy, .exr or "
        ".png (16 bit), or one FRAME.npy of one camera; of any scale, depth or inverse depth; "
        "fitted to what is measured they make depth_full/, where nothing is measured or filled; "
        "masks in DIR/sky/CAMERA/FRAME.png",
    )
    parser.add_argument(
        "--film",
        type=Path,
        metavar="FILE",
        help="of one key: a film of 8 s, .webp (half a megabyte) or .gif: registration alone "
        "turns into ours, then sweep by sweep",
    )
    add_output_options(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Densify one key or several."""
    config = config_of(options)
    from densify.cli.results import FIRST_OF_RUN, key_facts, summary
    from densify.outputs import check_writable
    from densify.pipeline import run as pipeline
    from densify.pipeline.memory import check_fits
    from densify.pipeline.methods import engines, with_baselines
    from densify.readers import open_sequence

    sequence = open_sequence(options.data)
    keys = _keys_of(sequence, options)
    for key in keys:
        check_writable(options.out, key, options.overwrite, "run", config.output.also)
    _check_film(options, keys)
    failed: dict[int, Exception] = {}
    doubts: list[tuple[str, str, int]] = []
    course = Course(engines(with_baselines(options.method), config.flow.engine), len(keys))
    with course_on_stderr(course):
        made = pipeline.run_keys(
            sequence,
            keys,
            options.window,
            options.method,
            options.cameras,
            config,
            course.step,
            cache_of(options),
            options.prior,
        )
        check_fits(sequence, keys[0], options.window, options.cameras, config)
        for key, result in made:
            if isinstance(result, Exception):
                failed[key] = result
                course.key_done()
                yield Answer(facts={"keys": [{"key": key, "error": str(result)}]})
                continue
            course.step("write", 0, 1)
            paths = _written(result, options, config)
            first = first_of(paths, FIRST_OF_RUN)
            course.key_done()
            yield Answer(summary(result), {"keys": [key_facts(result)]}, paths, first)
            doubts += [(warning, "", key) for warning in result.warnings]
    tell_doubts(doubts)
    if len(keys) == 1 and failed:
        raise failed[keys[0]]
    if failed:
        told = "; ".join(f"key {key}: {error}" for key, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(keys)} keys not made: {told}")


def _check_film(options: argparse.Namespace, keys: Sequence[int]) -> None:
    if options.film is None:
        return
    from densify.outputs.report.film import check_film

    if len(keys) > 1:
        raise InputError(f"--film {options.film}: got {len(keys)} keys, expected one")
    check_film(options.film, options.overwrite)


def _written(result: Result, options: argparse.Namespace, config: Config) -> list[Path]:
    """The files written of a key."""
    from densify.outputs import write_result

    paths = write_result(
        result,
        result.images,
        options.out,
        config=as_mapping(config),
        data=options.data,
        overwrite=options.overwrite,
        also=config.output.also,
    )
    if options.film is not None:
        from densify.outputs.report.film import write_film

        write_film(options.out / f"{result.key:06d}", options.film, overwrite=True)
        paths.append(options.film)
    return paths


def _keys_of(sequence: LidarSequence, options: argparse.Namespace) -> list[int]:
    """``--key`` and ``--keys`` together, ascending."""
    from densify.readers.timeline import format_frames

    frames = frozenset(sequence.frames)
    wanted = {*options.key}
    if options.keys is not None:
        wanted |= {*sliced(sequence, options.keys)}
    for key in sorted(wanted - frames):
        raise InputError(
            f"--key {key}: no such frame in {sequence.name}; "
            f"it has {format_frames(sequence.frames)}"
        )
    if not wanted:
        raise InputError(
            "--key K or --keys A:B[:S]: expected the frame or frames to densify; "
            "see densify run --help"
        )
    return sorted(wanted)
