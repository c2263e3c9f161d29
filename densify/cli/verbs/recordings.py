# SPDX-License-Identifier: MIT
"""Answer the verbs of recordings: ``densify info``, ``doctor`` and ``simulate``."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    config_of,
    key_range,
    option,
    recording_of,
)
from densify.cli.screen import Answer, progress_on_stderr
from densify.config.errors import InputError
from densify.config.plugins import READERS

if TYPE_CHECKING:
    from densify.doctor import Diagnosis

_WIDTH = 100


def add_info(commands: Any) -> None:
    """Add the options of ``info``."""
    about = "print what a recording holds: frames, rate, cameras, stamps, poses"
    readers = "; ".join(f"{row.name}: {row.holds}" for row in READERS.built_in)
    add_recording(add_verb(commands, "info", answer_info, about, f"Readers: {readers}."))


def answer_info(options: argparse.Namespace) -> Iterator[Answer]:
    """Print what a recording holds."""
    from densify.readers import findings, in_lines, open_sequence

    sequence = open_sequence(recording_of(options))
    lines, frames, cameras = findings(sequence), [*sequence.frames], [*sequence.cameras]
    yield Answer(in_lines(lines), {"recording": dict(lines), "frames": frames, "cameras": cameras})


def add_doctor(commands: Any) -> None:
    """Add the options of ``doctor``."""
    parser = add_verb(
        commands,
        "doctor",
        answer_doctor,
        "check whether a recording is read correctly, and print remedies",
        "Reads fifteen sweeps and some images from all over the recording. Each check prints a "
        "verdict (fine, unknown, suspicious, wrong), its evidence, and the option or the line that "
        "mends it. The exit code is 2 if something is wrong.",
    )
    add_recording(parser)
    add_common(parser, "config")


def answer_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Print the findings about a recording."""
    config, spec = config_of(options), recording_of(options)
    from densify.doctor import Verdict, examine
    from densify.readers import describe, open_sequence

    sequence = open_sequence(spec)
    diagnosis = examine(sequence, config)
    yield Answer(f"{describe(sequence)}\n\n{_describe(diagnosis)}", _facts(diagnosis))
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{spec}: wrong: {', '.join(wrong)}; the remedies are above")


def _describe(diagnosis: Diagnosis) -> str:
    """Return verdict, check and evidence of each finding, its remedy below, and the counts."""
    from densify.doctor import Verdict

    margin = " " * (2 + max(len(str(v)) for v in Verdict))
    lines = []
    for finding in diagnosis.findings:
        said = f"{finding.check}: {finding.evidence}"
        begin = f"{finding.verdict!s:<{len(margin)}}"
        lines += textwrap.wrap(said, _WIDTH, initial_indent=begin, subsequent_indent=margin)
        if finding.remedy:
            lines.append(f"{margin}-> {finding.remedy}")
    counts = {v: sum(f.verdict == v for f in diagnosis.findings) for v in Verdict}
    return "\n".join([*lines, "", ", ".join(f"{n} {v}" for v, n in counts.items())])


def _facts(diagnosis: Diagnosis) -> dict[str, Any]:
    findings = [{**asdict(f), "verdict": str(f.verdict)} for f in diagnosis.findings]
    worst = str(diagnosis.worst)
    return {"recording": diagnosis.sample.sequence.name, "worst": worst, "findings": findings}


def add_simulate(commands: Any) -> None:
    """Add the options of ``simulate``."""
    about = "write the simulated street as a recording with exact ground truth"
    parser = add_verb(commands, "simulate", answer_simulate, about)
    add_recording(parser)
    option(parser, "--out DIR", "folder to write into", type=Path, required=True)
    about = "kitti: a KITTI raw drive (default); folder: numbered sweeps with densify.yaml"
    option(parser, "--format NAME", about, default="kitti")
    option(parser, "--frames A:B", "only frames A to B-1 (default: all)", type=key_range)
    add_common(parser, "camera", "overwrite")


def answer_simulate(options: argparse.Namespace) -> Iterator[Answer]:
    """Write the street and print its path."""
    from densify.outputs.simulated_street import write_street
    from densify.readers.street import Street

    street = Street.from_spec(recording_of(options))
    frames, wanted = list(street.frames), options.frames
    if wanted is not None and (wanted[0] < frames[0] or wanted[-1] > frames[-1]):
        raise InputError(
            f"--frames {wanted.start}:{wanted.stop}: expected frames within "
            f"{frames[0]}:{frames[-1] + 1}"
        )
    frames = frames if wanted is None else list(wanted)
    form, out, cameras = options.format, options.out, options.cameras
    with progress_on_stderr() as progress:
        place = write_street(
            form, street, out, frames, cameras, progress, overwrite=options.overwrite
        )
    text = f"{len(frames)} frames; open them with --data {place}"
    yield Answer(text, {"data": str(place), "num_frames": len(frames)})
