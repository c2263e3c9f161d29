# SPDX-License-Identifier: MIT
"""Answer ``densify dataset``: every key of whole recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    all_or_range,
    natural,
    option,
    recordings_of,
    shard,
)
from densify.cli.screen import Answer, first_of, percent, progress_on_stderr, tell_doubts
from densify.config import presets, resolve
from densify.config.errors import ComputationError, InputError
from densify.config.resolving import apply_changes, parse_override

if TYPE_CHECKING:
    from densify.dataset.make import Summary

_FIRST = {
    "README.txt": "what the set holds and how to read it",
    "manifest.jsonl": "every key with its files and scores",
    "dataset.json": "how it was made",
}
_SCORES = {"density": "density", "ghost": "ghosts", "outliers": "held-out outliers"}
_MOST_SHOWN = 20


def add(commands: Any) -> None:
    """Add the options of ``dataset``."""
    parser = add_verb(
        commands,
        "dataset",
        answer,
        "make a training set of whole recordings",
        "The same command, run again, continues an interrupted set. --set takes the settings in "
        f"{presets()['default']}. It also takes limits. A key beyond a limit is listed in the "
        "manifest and left out of the set: dataset.max_ghost, share of ghosts; "
        "dataset.min_density, share of pixels with a measured depth; dataset.max_outliers, share "
        "of outliers with the key held out; dataset.min_sweeps, sweeps in the window; "
        "dataset.max_ratio, ghosts or outliers, as a multiple of those of neighbouring keys. "
        "dataset.split is kitti, train or val.",
    )
    add_recording(parser, several=True)
    add_common(parser, "window", "method", "camera", "config")
    about = "frames A to B-1, every S-th (default: all)"
    option(parser, "--keys all|A:B[:S]", about, type=all_or_range, default="all")
    option(parser, "--out DIR", "folder of the set: a new one, or one to continue", type=Path)
    layouts = ("kitti-depth", "densify")
    about = "the tree of KITTI's depth completion benchmark (default), or the files of densify run"
    parser.add_argument("--layout", choices=layouts, default=layouts[0], help=about)
    option(
        parser,
        "--workers N",
        "number of processes (default: one for each core, as far as the memory allows)",
        type=natural,
    )
    about = (
        "use the workers of a Dask scheduler; they need the same paths. tls://host:8786 accepts "
        "holders of a certificate. tcp://host:8786 lets everybody on the network run programs here"
    )
    option(parser, "--scheduler ADDRESS", about)
    option(parser, "--shard i/n", "make the i-th of n parts, for several machines", type=shard)
    option(parser, "--status DIR", "say how far the set in DIR is, and make nothing", type=Path)
    about = (
        "compare finished files with the hashes in the manifest. Damaged files are made again, "
        "or with --status listed (exit code 1)"
    )
    option(parser, "--verify", about)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Make the data set, or report its progress."""
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
            f"command that made the set again with --verify, which makes them again"
        )


def _made(options: argparse.Namespace) -> Iterator[Answer]:
    if options.out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    own = [text for text in options.overrides if text.strip().startswith("dataset.")]
    config = resolve(options.config, [text for text in options.overrides if text not in own])
    from densify.dataset.make import make_dataset
    from densify.dataset.plan import Gate, Recipe

    limits = {"dataset": asdict(Gate())}
    for text in own:
        apply_changes(limits, parse_override(text), f"--set {text}", {"dataset": Gate})
    recipe = Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.cameras is None else tuple(options.cameras),
        gate=Gate(**limits["dataset"]),
        config=config,
    )
    with progress_on_stderr() as show:
        summary = make_dataset(
            recordings_of(options),
            options.out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            verify=options.verify,
            report=lambda so_far: show("keys", len(so_far.records), so_far.num_keys),
        )
    told = [options.out / name for name in _FIRST if (options.out / name).is_file()]
    yield Answer(_describe(summary), _facts(summary), [options.out], first_of(told, _FIRST))
    warned = [(w, r.drive, r.key) for r in summary.records.values() for w in r.warnings]
    tell_doubts(warned)
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")


def _describe(summary: Summary) -> str:
    """Return the numbers of keys by status, mean scores, and the reasons of missing keys."""
    facts = _facts(summary)
    states = {"done": "done", "aside": "put aside", "failed": "failed", "left": "to make"}
    numbers = {state: facts[f"num_{state}"] for state in states}
    counts = [f"{n} {states[state]}" for state, n in numbers.items() if n or state == "done"]
    lines = [f"{summary.num_keys} keys: {', '.join(counts)}"]
    if summary.num_made:
        pace = summary.seconds / summary.num_made
        lines[0] += f"; {summary.num_made} now, {pace:.2f} s a key"
    means = [(said, summary.mean(score)) for score, said in _SCORES.items()]
    lines.append(", ".join(f"{said} {percent(mean)}" for said, mean in means if mean is not None))
    missing = ["{drive} {key} {status}: {reason}".format(**told) for told in facts["missing"]]
    lines += missing[:_MOST_SHOWN]
    if len(missing) > _MOST_SHOWN:
        lines.append(f"... and {len(missing) - _MOST_SHOWN} more, see the manifest")
    return "\n".join(line for line in lines if line)


def _facts(summary: Summary) -> dict[str, Any]:
    """Return the numbers of `_describe`."""
    missing = [r for r in summary.records.values() if r.status != "done"]
    told = ("drive", "key", "status", "reason")
    return {
        "num_keys": summary.num_keys,
        **{f"num_{status}": summary.count(status) for status in ("done", "aside", "failed")},
        "num_left": summary.num_left,
        "num_made": summary.num_made,
        "seconds": summary.seconds,
        "means": {score: summary.mean(score) for score in _SCORES},
        "missing": [{name: getattr(record, name) for name in told} for record in missing],
    }
