# SPDX-License-Identifier: MIT
"""``densify doctor``: what may be wrong with a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import DATA_HELP, add_config_options, add_overwrite, add_verb
from densify.config import resolve
from densify.config.errors import InputError


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "doctor",
        answer,
        "what may be wrong with a recording, and what mends it",
        "Looks at fifteen sweeps and a few images from all over the recording. Each check has a "
        "verdict (fine, unknown, suspicious, wrong), the number it rests on, and the option or "
        "line that mends it. Exit code 2 if something is wrong.",
    )
    parser.add_argument(
        "data", metavar="SPEC", nargs="?", default="street", help=f"the recording: {DATA_HELP}"
    )
    parser.add_argument(
        "--write-config",
        action="store_true",
        help="instead: draft the densify.yaml of a folder of sweeps from what is found in it",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE.png",
        help="draw neighbouring sweeps upon each other, depth over the image, and depth edges over "
        "image edges",
    )
    add_config_options(parser)
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """What may be wrong with a recording."""
    config = resolve(options.config, options.overrides)
    from densify.cli.findings import diagnosis_facts, diagnosis_table
    from densify.cli.point_files import check_new_file
    from densify.doctor import Verdict, examine
    from densify.readers import open_sequence
    from densify.readers.describe import describe

    if options.write_config:
        yield _write_folder_config(Path(options.data), options.overwrite)
        return
    if options.picture is not None:
        check_new_file(options.picture, options.overwrite, ".png")
    sequence = open_sequence(options.data)
    diagnosis = examine(sequence, config, Path())
    text = f"{describe(sequence)}\n\n{diagnosis_table(diagnosis)}"
    yield Answer(text, diagnosis_facts(diagnosis))
    if options.picture is not None:
        from densify.doctor.picture import draw
        from densify.outputs.png import write_picture

        write_picture(options.picture, draw(diagnosis.sample))
        yield Answer(files=[options.picture])
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{options.data}: wrong: {', '.join(wrong)}; the remedies are above")


def _write_folder_config(folder: Path, overwrite: bool) -> Answer:
    from densify.outputs.atomic import write_file
    from densify.readers.folder.draft import draft_config

    path = folder / "densify.yaml"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: there already, kept; give --overwrite to replace it")
    write_file(path, draft_config(folder).encode())
    return Answer(files=[path])
