# SPDX-License-Identifier: MIT
"""What each bench does: measure, print the table, and write it if asked."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer
from densify.cli.progress import progress_on_stderr
from densify.config import as_mapping, resolve
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.bench.paper_pairs import PaperPair

_DEFAULT_KEY = 120
_MIDDLE_KEY = 80  # of the street's 160 frames
_UNSEEN = (
    ("street?seed=41", [70]),
    ("street:crossing?seed=42", [90]),
    ("street:highway?seed=43", [60]),
    ("street?seed=44", [100]),
)


def bench_confidence(options: argparse.Namespace) -> Iterator[Answer]:
    """The tables that turn a rank into a probability, and how far they hold."""
    config = resolve(options.config, options.overrides)
    from densify.bench import confidence as bench
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import reliability_tables
    from densify.cli.point_files import check_new_file
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    asked = [] if options.shipped else options.fit or bench.FITTED
    fitted, checked = (
        [(open_sequence(spec), keys) for spec, keys in given]
        for given in (asked, options.check or bench.CHECKED)
    )
    with progress_on_stderr() as progress:
        measured = bench.bench_confidence(
            fitted, checked, options.window, config, options.cameras, progress
        )
    if options.out is not None:
        write_table(options.out, {**measured, "config": as_mapping(config)})
    yield Answer(reliability_tables(measured["reliability"]), measured, _files(options))


def bench_depth(options: argparse.Namespace) -> Iterator[Answer]:
    """Depth maps of several configurations against every truth."""
    variants = {"as configured": resolve(options.config, options.overrides)}
    for name, *changes in options.variant:
        variants[name] = resolve(options.config, [*options.overrides, *changes])
    from densify.bench import depth as bench
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import depth_table
    from densify.cli.point_files import check_new_file
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    with progress_on_stderr() as progress:
        measured = bench.bench_depth(
            open_sequence(options.data or "street"),
            options.keys or [_DEFAULT_KEY],
            options.window,
            variants,
            options.cameras,
            options.scanner,
            options.method,
            progress,
        )
    if options.out is not None:
        write_table(
            options.out, {**measured, "config": {n: as_mapping(c) for n, c in variants.items()}}
        )
    yield Answer(depth_table(measured), measured, _files(options))


def bench_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Which mistakes, made on purpose in good recordings, doctor names."""
    config = resolve(options.config, options.overrides)
    from densify.bench import faults as bench
    from densify.bench.table_file import write_table
    from densify.cli.findings import fault_table
    from densify.cli.point_files import check_new_file
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    found = {}
    for spec in options.data or ["street"]:
        with progress_on_stderr() as progress:
            found[spec] = bench.bench_doctor(open_sequence(spec), config, progress)
        yield Answer(fault_table(spec, found[spec]) + "\n")
    if options.out is not None:
        write_table(options.out, {"recordings": found})
    yield Answer(facts={"recordings": found}, files=_files(options))


def bench_memory(options: argparse.Namespace) -> Iterator[Answer]:
    """Peak memory of runs, and what is said of it before."""
    config = resolve(options.config, options.overrides)
    from densify.bench import peaks as bench
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import memory_table
    from densify.cli.point_files import check_new_file

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    cases = bench.grid(
        options.window or bench.WINDOWS,
        options.cameras or bench.NUM_CAMERAS,
        options.rings or bench.RINGS,
    )
    with progress_on_stderr() as progress:
        key = (options.keys or [_MIDDLE_KEY])[0]
        rows = bench.bench_memory(key, config, cases, progress)
    if options.out is not None:
        write_table(options.out, {"key": key, "runs": rows, "config": as_mapping(config)})
    yield Answer(memory_table(rows), {"key": key, "runs": rows}, _files(options))


def bench_flow(options: argparse.Namespace) -> Iterator[Answer]:
    """Scene flow methods on the same pairs and windows."""
    config = resolve(options.config, options.overrides)
    from densify.bench import flow as bench
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import flow_table
    from densify.cli.point_files import check_new_file
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    methods = options.methods if options.methods is not None else bench.DEFAULT_METHODS
    if list(methods) == ["all"]:
        methods = tuple(bench.METHODS)
    sequences = [open_sequence(spec) for spec in options.data or ["street"]]
    runs = []
    for sequence in sequences:
        for key in options.keys or [_DEFAULT_KEY]:
            with progress_on_stderr() as progress:
                measured = bench.bench_flow(
                    sequence,
                    key,
                    options.window,
                    config,
                    methods,
                    options.pairs_only,
                    options.max_points,
                    progress,
                    options.truth,
                )
            runs.append(measured)
            yield Answer(flow_table(measured) + "\n", {"runs": [measured]})
    if options.out is not None:
        write_table(options.out, {"runs": runs, "config": as_mapping(config)})
    yield Answer(files=_files(options))


def bench_paper(options: argparse.Namespace) -> Iterator[Answer]:
    """The tables of the paper."""
    from densify.bench import paper as bench
    from densify.bench import paper_pairs
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import paper_table
    from densify.cli.point_files import check_new_file

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    if options.figure is not None:
        check_new_file(options.figure, options.overwrite, ".png", "--figure")
    sets: dict[str, Iterable[PaperPair]] = {}
    if options.flyingthings is not None:
        sets["flyingthings"] = paper_pairs.pairs_of_files(options.flyingthings, options.pairs)
    if options.kitti is not None:
        sets["kitti"] = paper_pairs.pairs_of_kitti(options.kitti, options.pairs)
    for name, reader in (("argoverse", "argoverse2"), ("nuscenes", "nuscenes")):
        if places := getattr(options, name):
            specs = [f"{reader}:{place}" for place in places]
            sets[name] = paper_pairs.pairs_of_boxes(specs, options.pairs)
    if options.data or not sets:
        chosen: dict[str, list[tuple[str, int]]] = {}
        for spec, keys in options.data or _UNSEEN:
            kind = "streets" if paper_pairs.has_truth(spec) else "against this package's engine"
            chosen.setdefault(kind, []).extend((spec, key) for key in keys)
        for kind, places in chosen.items():
            sets[kind] = map(paper_pairs.pair_of_recording, *zip(*places, strict=True))
    methods = bench.DEFAULT_METHODS if options.methods is None else options.methods
    measured: dict[str, dict[str, Any]] = {}
    for name, pairs in sets.items():
        if options.figure is not None and not measured:
            pairs = _with_figure(iter(pairs), options, methods)
        with progress_on_stderr() as progress:
            measured[name] = bench.bench_paper(
                pairs, methods, options.models, options.points, options.curves, progress
            )
        published = bench.PUBLISHED.get(name)
        text = paper_table(name, measured[name], published, bench.ONLY_PUBLISHED)
        yield Answer(text + "\n", {"sets": [{"set": name, **measured[name]}]})
    if options.out is not None:
        write_table(options.out, {"sets": measured, "published": bench.PUBLISHED})
    figure = [] if options.figure is None else [options.figure]
    yield Answer(files=[*figure, *_files(options)])


def _with_figure(
    pairs: Iterator[PaperPair], options: argparse.Namespace, methods: Sequence[str]
) -> Iterator[PaperPair]:
    """The same pairs; the first is drawn as it passes."""
    from densify.bench.paper import flows_of_pair
    from densify.outputs.plots import draw_arrows, write_plot

    for number, pair in enumerate(pairs):
        if number == 0:
            points, flows = flows_of_pair(pair, methods, options.models, options.points)
            try:
                options.figure.parent.mkdir(parents=True, exist_ok=True)
                write_plot(options.figure, draw_arrows(points, flows))
            except OSError as error:
                reason = error.strerror or error
                raise InputError(
                    f"--figure {options.figure}: cannot be written: {reason}"
                ) from error
        yield pair


def bench_readme(options: argparse.Namespace) -> Iterator[Answer]:
    """The tables of the documentation, made again."""
    from densify.bench.readme import tables

    with progress_on_stderr() as progress:
        for line in tables(options.tables, options.kitti, options.pandaset, progress):
            yield Answer(line, {"lines": [line]})


def _files(options: argparse.Namespace) -> list[Path]:
    return [] if options.out is None else [options.out]
