# SPDX-License-Identifier: MIT
"""``densify doctor``: what may be wrong with a recording; ``densify info``: what it holds."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer
from densify.cli.options import (
    add_config_options,
    add_overwrite,
    add_recording,
    add_verb,
    config_of,
    recording_of,
)
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.doctor import Diagnosis

_WIDTH = 100


def add_info(commands: Any) -> None:
    """Add the options of ``info``."""
    about = "what a recording holds: frames, rate, cameras, stamps, poses"
    add_recording(add_verb(commands, "info", answer_info, about))


def answer_info(options: argparse.Namespace) -> Iterator[Answer]:
    """Say what a recording holds."""
    from densify.readers import open_sequence
    from densify.readers.describe import findings, in_lines

    sequence = open_sequence(recording_of(options))
    lines, frames, cameras = findings(sequence), [*sequence.frames], [*sequence.cameras]
    yield Answer(in_lines(lines), {"recording": dict(lines), "frames": frames, "cameras": cameras})


def add_doctor(commands: Any) -> None:
    """Add the options of ``doctor``."""
    parser = add_verb(
        commands,
        "doctor",
        answer_doctor,
        "what may be wrong with a recording, and what mends it",
        "Looks at fifteen sweeps and a few images from all over the recording. Each check has a "
        "verdict (fine, unknown, suspicious, wrong), the number it rests on, and the option or "
        "line that mends it. Exit code 2 if something is wrong.",
    )
    add_recording(parser)
    parser.add_argument(
        "--write-config",
        action="store_true",
        help="instead: draft the densify.yaml of a folder of sweeps from what is found in it",
    )
    add_config_options(parser)
    add_overwrite(parser)


def answer_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Say what may be wrong with a recording."""
    config, spec = config_of(options), recording_of(options)
    from densify.doctor import Verdict, examine
    from densify.readers import open_sequence
    from densify.readers.describe import describe

    if options.write_config:
        yield _write_folder_config(Path(spec), options.overwrite)
        return
    sequence = open_sequence(spec)
    diagnosis = examine(sequence, config)
    yield Answer(f"{describe(sequence)}\n\n{_describe(diagnosis)}", _facts(diagnosis))
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{spec}: wrong: {', '.join(wrong)}; the remedies are above")


def _write_folder_config(folder: Path, overwrite: bool) -> Answer:
    from densify.outputs.atomic import write_file
    from densify.readers.folder.draft import draft_config

    path = folder / "densify.yaml"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: there already, kept; give --overwrite to replace it")
    write_file(path, draft_config(folder).encode())
    return Answer(files=[path])


def _describe(diagnosis: Diagnosis) -> str:
    """Return verdict, check and evidence of each finding, its remedy below, and the counts."""
    from densify.doctor import Verdict

    columns = 2 + max(len(str(v)) for v in Verdict)
    lines = []
    for finding in diagnosis.findings:
        lines += textwrap.wrap(
            f"{finding.check}: {finding.evidence}",
            _WIDTH,
            initial_indent=f"{finding.verdict!s:<{columns}}",
            subsequent_indent=" " * columns,
        )
        if finding.remedy:
            lines.append(" " * columns + f"-> {finding.remedy}")
    counts = {v: sum(f.verdict == v for f in diagnosis.findings) for v in Verdict}
    return "\n".join([*lines, "", ", ".join(f"{n} {v}" for v, n in counts.items())])


def _facts(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the findings with their values."""
    from densify.outputs.plain import plain

    findings = [
        {
            "check": f.check,
            "verdict": str(f.verdict),
            "evidence": f.evidence,
            "remedy": f.remedy,
            "values": plain(f.values),
        }
        for f in diagnosis.findings
    ]
    worst = str(diagnosis.worst)
    return {"recording": diagnosis.sample.sequence.name, "worst": worst, "findings": findings}
