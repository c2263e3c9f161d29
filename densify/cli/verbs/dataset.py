# SPDX-License-Identifier: MIT
"""``densify dataset``: every key of whole recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer, first_of
from densify.cli.options import (
    add_camera,
    add_config_options,
    add_method,
    add_recording,
    add_verb,
    add_window,
    all_or_slice,
    natural,
    recordings_of,
    shard,
)
from densify.cli.progress import progress_on_stderr
from densify.cli.screen import tell_doubts
from densify.config import presets, resolve
from densify.config.errors import ComputationError, InputError, did_you_mean
from densify.config.file_content import parse_yaml
from densify.config.knobs import Section, checked, knob

if TYPE_CHECKING:
    from densify.dataset.make import Summary

_FIRST = {
    "README.txt": "what the set holds and how to read it",
    "manifest.jsonl": "every key with its files and scores",
    "dataset.json": "how it was made",
}
_SCORES = {"density": "density", "ghost": "ghosts", "outliers": "held-out outliers"}
_MOST_SHOWN = 20


@dataclass(frozen=True)
class DatasetSettings(Section):
    """The settings of ``--set dataset.NAME=VALUE``.

    A key that misses a limit is put aside: it is in the
    manifest, not in the set."""

    max_ghost: float | None = knob(None, "limit: ghosts among the accumulated points", 0, 1)
    min_density: float | None = knob(None, "limit: pixels with a measured depth", 0, 1)
    max_outliers: float | None = knob(None, "limit: outliers, the key held out", 0, 1)
    min_sweeps: int | None = knob(None, "limit: sweeps of the window", 1, 101)
    split: str = knob("kitti", "of the tree", choices=("kitti", "train", "val"))


def add(commands: Any) -> None:
    """Add the options of ``dataset``."""
    about = "every key of whole recordings, as a training set"
    knobs = (f"dataset.{f.name}, {f.metadata['help']}" for f in fields(DatasetSettings))
    epilog = (
        "Run again, the same command goes on where it was stopped. --set takes, beside the knobs "
        f"in {presets()['default']}: {'; '.join(knobs)}."
    )
    parser = add_verb(commands, "dataset", answer, about, epilog)
    add_recording(parser, several=True)
    add_window(parser)
    add_method(parser)
    add_camera(parser)
    add_config_options(parser)
    parser.add_argument(
        "--keys",
        type=all_or_slice,
        default="all",
        metavar="all|A:B[:S]",
        help="frames A to B-1, every S-th, those that exist (default: all)",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="the set's folder: a new one, or one to go on with"
    )
    parser.add_argument(
        "--layout",
        choices=("kitti-depth", "densify"),
        default="kitti-depth",
        help="KITTI's depth completion tree (default), or what densify run writes",
    )
    parser.add_argument(
        "--workers", type=natural, metavar="N", help="processes (default: as many as fit)"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a running Dask scheduler, whose workers are used; they need the same files at the "
        "same paths. tcp://host:8786 trusts everybody on that network: whoever reaches the "
        "scheduler can run anything on its workers and here. tls://host:8786 lets in only who has "
        "a certificate, by Dask's configuration (distributed.comm.tls)",
    )
    parser.add_argument(
        "--shard",
        type=shard,
        metavar="i/n",
        help="the i-th of n parts, for several machines",
    )
    parser.add_argument(
        "--status", metavar="DIR", type=Path, help="how far the set in DIR is; makes nothing"
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="compare all finished files with the hashes in the manifest: damaged ones are made "
        "anew, or with --status listed (exit code 1)",
    )


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Make the set, or say how far it is."""
    yield from _made(options) if options.status is None else _so_far(options)


def _so_far(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.dataset.make import damaged, status

    so_far = status(options.status)
    files = damaged(options.status) if options.verify else []
    lines = [_describe(so_far), *(f"damaged: {name}" for name in files)]
    yield Answer("\n".join(lines), {**_facts(so_far), "damaged": files})
    if files:
        raise ComputationError(
            f"--verify: {len(files)} damaged or missing files in {options.status}; run the "
            f"command that made the set again with --verify, which makes them anew"
        )


def _made(options: argparse.Namespace) -> Iterator[Answer]:
    if options.out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    own = [text for text in options.overrides if text.strip().startswith("dataset.")]
    config = resolve(options.config, [text for text in options.overrides if text not in own])
    settings = _settings(own)
    from densify.dataset.make import make_dataset
    from densify.dataset.plan import Gate, Recipe

    limits = {field.name: getattr(settings, field.name) for field in fields(Gate)}
    recipe = Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.cameras is None else tuple(options.cameras),
        split=None if settings.split == "kitti" else settings.split,
        gate=Gate(**limits),
        config=config,
    )
    with progress_on_stderr(lines=True) as show:
        summary = make_dataset(
            recordings_of(options),
            options.out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            verify=options.verify,
            report=lambda so_far: show(
                "keys", len(so_far.records), so_far.num_keys, _scores(so_far)
            ),
        )
    told = [options.out / name for name in _FIRST if (options.out / name).is_file()]
    yield Answer(_describe(summary), _facts(summary), [options.out], first_of(told, _FIRST))
    tell_doubts((w, r.drive, r.key) for r in summary.records.values() for w in r.warnings)
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")


def _settings(overrides: list[str]) -> DatasetSettings:
    """Return the settings of ``dataset.NAME=VALUE``."""
    known = [field.name for field in fields(DatasetSettings)]
    values = {}
    for text in overrides:
        name, _, given = text.strip().removeprefix("dataset.").partition("=")
        if name not in known:
            hint = f"{did_you_mean(name, known)}expected one of {', '.join(known)}"
            raise InputError(f"--set {text}: unknown key dataset.{name}; {hint}")
        value, _ = parse_yaml(given, f"--set {text}")
        values[name] = checked(DatasetSettings, name, value, f"--set {text}: ")
    return DatasetSettings(**values)


def _describe(summary: Summary) -> str:
    """Return what was made, and what is missing and why."""
    counts = [
        f"{summary.count(status)} {said}"
        for status, said in (("done", "done"), ("aside", "put aside"), ("failed", "failed"))
        if summary.count(status) or status == "done"
    ]
    if summary.num_left:
        counts.append(f"{summary.num_left} to make")
    lines = [f"{summary.num_keys} keys: {', '.join(counts)}"]
    if summary.num_made:
        pace = summary.seconds / summary.num_made
        lines[0] += f"; {summary.num_made} now, {pace:.2f} s a key"
    lines.append(_scores(summary))
    missing = [r for r in summary.records.values() if r.status != "done"]
    lines += [f"{r.drive} {r.key} {r.status}: {r.reason}" for r in missing[:_MOST_SHOWN]]
    if len(missing) > _MOST_SHOWN:
        lines.append(f"... and {len(missing) - _MOST_SHOWN} more, see the manifest")
    return "\n".join(line for line in lines if line)


def _facts(summary: Summary) -> dict[str, Any]:
    """Return the numbers of `_describe`."""
    missing = [r for r in summary.records.values() if r.status != "done"]
    return {
        "num_keys": summary.num_keys,
        **{f"num_{status}": summary.count(status) for status in ("done", "aside", "failed")},
        "num_left": summary.num_left,
        "num_made": summary.num_made,
        "seconds": summary.seconds,
        "means": {score: summary.mean(score) for score in _SCORES},
        "missing": [
            {"drive": r.drive, "key": r.key, "status": r.status, "reason": r.reason}
            for r in missing
        ],
    }


def _scores(summary: Summary) -> str:
    """Return the means over the keys so far; empty before the first."""
    means = [(said, summary.mean(score)) for score, said in _SCORES.items()]
    return ", ".join(f"{said} {100 * mean:.2f} %" for said, mean in means if mean is not None)
