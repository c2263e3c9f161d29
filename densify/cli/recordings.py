# SPDX-License-Identifier: MIT
"""Answer the verbs of whole recordings: ``densify info``, ``doctor``, ``simulate``, ``dataset``."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from densify.cli.options import config_of, recording_of, recordings_of
from densify.cli.screen import Answer, first_of, log_warnings, percent, progress_on_stderr
from densify.config import apply_overrides, resolve
from densify.config.errors import ComputationError, InputError
from densify.dataset.make import Summary, damaged, make_dataset, status
from densify.dataset.plan import Gate, Recipe
from densify.doctor import Diagnosis, Verdict, examine
from densify.outputs.simulated_street import write_street
from densify.readers import open_sequence
from densify.readers.describe import describe, findings, in_lines
from densify.readers.street import Street

_WIDTH = 100
_FIRST_OF_SET = {
    "README.txt": "what the set holds and how to read it",
    "manifest.jsonl": "every key with its files and scores",
    "dataset.json": "how it was made",
}
_SCORES = {"density": "density", "ghost": "ghosts", "outliers": "held-out outliers"}
_STATES = {"done": "done", "aside": "put aside", "failed": "failed", "left": "to make"}
_REASON = ("drive", "key", "status", "reason")
_MOST_REASONS = 20


def answer_info(options: argparse.Namespace) -> Iterator[Answer]:
    """Print what a recording holds."""
    sequence = open_sequence(recording_of(options))
    lines, frames, cameras = findings(sequence), [*sequence.frames], [*sequence.cameras]
    yield Answer(in_lines(lines), {"recording": dict(lines), "frames": frames, "cameras": cameras})


def answer_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Print the findings about a recording."""
    config, spec = config_of(options), recording_of(options)
    sequence = open_sequence(spec)
    diagnosis = examine(sequence, config)
    facts = {
        "recording": sequence.name,
        "worst": str(diagnosis.worst),
        "findings": [{**asdict(f), "verdict": str(f.verdict)} for f in diagnosis.findings],
    }
    yield Answer(f"{describe(sequence)}\n\n{_verdicts(diagnosis)}", facts)
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{spec}: wrong: {', '.join(wrong)}; the remedies are above")


def _verdicts(diagnosis: Diagnosis) -> str:
    """Return verdict, check and evidence of each finding, its remedy below, and the counts."""
    margin = " " * (2 + max(len(str(v)) for v in Verdict))
    lines = []
    for finding in diagnosis.findings:
        evidence = f"{finding.check}: {finding.evidence}"
        begin = f"{finding.verdict!s:<{len(margin)}}"
        lines += textwrap.wrap(evidence, _WIDTH, initial_indent=begin, subsequent_indent=margin)
        if finding.remedy:
            lines.append(f"{margin}-> {finding.remedy}")
    counts = {v: sum(f.verdict == v for f in diagnosis.findings) for v in Verdict}
    return "\n".join([*lines, "", ", ".join(f"{n} {v}" for v, n in counts.items())])


def answer_simulate(options: argparse.Namespace) -> Iterator[Answer]:
    """Write the street and print its path."""
    street = Street.from_spec(recording_of(options))
    frames, chosen = list(street.frames), options.frames
    if chosen is not None and (chosen[0] < frames[0] or chosen[-1] > frames[-1]):
        raise InputError(
            f"--frames {chosen.start}:{chosen.stop}: expected frames within "
            f"{frames[0]}:{frames[-1] + 1}"
        )
    frames = frames if chosen is None else list(chosen)
    with progress_on_stderr() as progress:
        folder = write_street(
            options.format,
            street,
            options.out,
            frames,
            options.camera,
            progress,
            overwrite=options.overwrite,
        )
    text = f"{len(frames)} frames; open them with --data {folder}"
    yield Answer(text, {"data": str(folder), "num_frames": len(frames)})


def answer_dataset(options: argparse.Namespace) -> Iterator[Answer]:
    """Make the data set, or report its progress."""
    yield from _make_set(options) if options.status is None else _check_set(options)


def _check_set(options: argparse.Namespace) -> Iterator[Answer]:
    summary = status(options.status)
    files = damaged(options.status) if options.verify else []
    lines = [_describe_set(summary), *(f"damaged: {name}" for name in files)]
    yield Answer("\n".join(lines), {**_set_facts(summary), "damaged": files})
    if files:
        raise ComputationError(
            f"--verify: {len(files)} damaged or missing files in {options.status}; run the "
            f"command that made the set again with --verify, which makes them again"
        )


def _recipe(options: argparse.Namespace) -> Recipe:
    overrides = options.set or []
    limits = [text for text in overrides if text.strip().startswith("dataset.")]
    gate = {"dataset": asdict(Gate())}
    apply_overrides(gate, limits, {"dataset": Gate})
    return Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.camera is None else tuple(options.camera),
        gate=Gate(**gate["dataset"]),
        config=resolve(options.config, [text for text in overrides if text not in limits]),
    )


def _make_set(options: argparse.Namespace) -> Iterator[Answer]:
    out = options.out
    if out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    recipe = _recipe(options)
    with progress_on_stderr() as progress:
        summary = make_dataset(
            recordings_of(options),
            out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            verify=options.verify,
            report=lambda so_far: progress("keys", len(so_far.records), so_far.num_keys),
        )
    paths = [out / name for name in _FIRST_OF_SET if (out / name).is_file()]
    first = first_of(paths, _FIRST_OF_SET)
    yield Answer(_describe_set(summary), _set_facts(summary), [out], first)
    log_warnings((w, r.drive, r.key) for r in summary.records.values() for w in r.warnings)
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")


def _describe_set(summary: Summary) -> str:
    """Return the numbers of keys by status, mean scores, and the reasons of missing keys."""
    facts = _set_facts(summary)
    numbers = {state: facts[f"num_{state}"] for state in _STATES}
    counts = [f"{n} {_STATES[state]}" for state, n in numbers.items() if n or state == "done"]
    lines = [f"{summary.num_keys} keys: {', '.join(counts)}"]
    if summary.num_made:
        pace = summary.seconds / summary.num_made
        lines[0] += f"; {summary.num_made} now, {pace:.2f} s a key"
    means = [(title, facts["means"][score]) for score, title in _SCORES.items()]
    lines.append(", ".join(f"{title} {percent(mean)}" for title, mean in means if mean is not None))
    missing = ["{drive} {key} {status}: {reason}".format(**key) for key in facts["missing"]]
    lines += missing[:_MOST_REASONS]
    if len(missing) > _MOST_REASONS:
        lines.append(f"... and {len(missing) - _MOST_REASONS} more, see the manifest")
    return "\n".join(line for line in lines if line)


def _set_facts(summary: Summary) -> dict[str, Any]:
    """Return the numbers of `_describe_set`."""
    missing = [r for r in summary.records.values() if r.status != "done"]
    return {
        "num_keys": summary.num_keys,
        **{f"num_{status}": summary.count(status) for status in ("done", "aside", "failed")},
        "num_left": summary.num_left,
        "num_made": summary.num_made,
        "seconds": summary.seconds,
        "means": {score: summary.mean(score) for score in _SCORES},
        "missing": [{name: getattr(record, name) for name in _REASON} for record in missing],
    }
