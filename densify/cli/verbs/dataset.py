# SPDX-License-Identifier: MIT
"""``densify dataset``: every key of whole recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer, first_of
from densify.cli.options import (
    DATA_HELP,
    add_camera,
    add_config_options,
    add_method,
    add_short_options,
    add_verb,
    add_window,
    all_or_slice,
    config_epilog,
    config_of,
    natural,
    shard,
)
from densify.cli.progress import keys_on_stderr
from densify.cli.screen import tell_doubts
from densify.config.errors import ComputationError, InputError


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "dataset",
        answer,
        "every key of whole recordings, as a training set",
        "Run again, the same command goes on where it was stopped. Shares are from 0 to 1. "
        + config_epilog(),
    )
    parser.add_argument(
        "--data", metavar="SPEC", nargs="+", action="extend", help=f"{DATA_HELP}; one or more"
    )
    parser.add_argument(
        "--keys",
        type=all_or_slice,
        default="all",
        metavar="all|A:B[:S]",
        help="frames A to B-1, every S-th, those that exist (default: all)",
    )
    add_window(parser)
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="the set's folder: a new one, or one to go on with"
    )
    parser.add_argument(
        "--layout",
        choices=("kitti-depth", "densify"),
        default="kitti-depth",
        help="kitti-depth: the tree of KITTI's depth completion benchmark; densify: what run "
        "writes, for every key (default: kitti-depth)",
    )
    add_method(parser)
    add_camera(parser)
    parser.add_argument(
        "--split",
        choices=("train", "val"),
        help="of the tree (default: KITTI's official one, train for other recordings)",
    )
    _add_gate(parser)
    _add_workers(parser)
    parser.add_argument(
        "--status", metavar="DIR", type=Path, help="how far the set in DIR is; makes nothing"
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="compare all finished files with the hashes in the manifest: damaged ones are made "
        "anew, or with --status listed (exit code 1)",
    )
    add_short_options(parser)
    add_config_options(parser)


def _add_gate(parser: argparse.ArgumentParser) -> None:
    gate = parser.add_argument_group(
        "quality gate", "a key that misses a limit is put aside: into the manifest, not the set"
    )
    gate.add_argument(
        "--max-ghost",
        type=float,
        metavar="SHARE",
        help="of the accumulated points that stand where the key sweep saw through",
    )
    gate.add_argument(
        "--min-density", type=float, metavar="SHARE", help="of the pixels with a measured depth"
    )
    gate.add_argument(
        "--max-outliers",
        type=float,
        metavar="SHARE",
        help="of the key sweep's returns that the map made without it misses",
    )
    gate.add_argument(
        "--min-sweeps", type=natural, metavar="N", help="in the window, cut at ends and gaps"
    )


def _add_workers(parser: argparse.ArgumentParser) -> None:
    work = parser.add_argument_group("where it is made")
    work.add_argument(
        "--workers",
        type=natural,
        metavar="N",
        help="processes on this machine (default: one on each core, or as many as the free memory "
        "suffices for and as have eight keys each)",
    )
    work.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a running Dask scheduler, whose workers are used; they need the same files at the "
        "same paths. tcp://host:8786 trusts everybody on that network: whoever reaches the "
        "scheduler can run anything on its workers and here. tls://host:8786 lets in only who has "
        "a certificate, by Dask's configuration (distributed.comm.tls)",
    )
    work.add_argument(
        "--shard",
        type=shard,
        metavar="i/n",
        help="the i-th of n parts of the work, for machines that share DIR",
    )


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Every key of whole recordings, or how far that is."""
    yield from _made(options) if options.status is None else _so_far(options)


def _so_far(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.cli.sets import set_facts, set_summary
    from densify.dataset.make import damaged, status

    so_far = status(options.status)
    files = damaged(options.status) if options.verify else []
    text = "\n".join([set_summary(so_far), *(f"damaged: {name}" for name in files)])
    yield Answer(text, {**set_facts(so_far), "damaged": files})
    if files:
        raise ComputationError(
            f"--verify: {len(files)} damaged or missing files in {options.status}; run the "
            f"command that made the set again with --verify, which makes them anew"
        )


def _made(options: argparse.Namespace) -> Iterator[Answer]:
    if options.out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    config = config_of(options)
    from densify.cli.sets import FIRST_OF_SET, set_facts, set_summary
    from densify.dataset.make import make_dataset
    from densify.dataset.plan import Gate, Recipe

    limits = ("max_ghost", "min_density", "max_outliers", "min_sweeps")
    recipe = Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.cameras is None else tuple(options.cameras),
        split=options.split,
        gate=Gate(**{limit: getattr(options, limit) for limit in limits}),
        config=config,
    )
    with keys_on_stderr() as report:
        summary = make_dataset(
            options.data or ["street"],
            options.out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            verify=options.verify,
            report=report,
        )
    told = [options.out / name for name in FIRST_OF_SET if (options.out / name).is_file()]
    first = first_of(told, FIRST_OF_SET)
    yield Answer(set_summary(summary), set_facts(summary), [options.out], first)
    tell_doubts((w, r.drive, r.key) for r in summary.records.values() for w in r.warnings)
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")
