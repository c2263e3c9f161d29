# SPDX-License-Identifier: MIT
"""What each bench does: measure, print the table, and write it if asked."""

from __future__ import annotations

import argparse

from densify.cli.screen import print_paths, progress_on_stderr
from densify.config import as_mapping, resolve

_DEFAULT_KEY = 120
_MIDDLE_KEY = 80  # of the street's 160 frames


def bench_confidence(options: argparse.Namespace) -> None:
    """The tables that turn a rank into a probability, and how far they hold."""
    config = resolve(options.config, options.overrides)
    from densify.bench import confidence as bench
    from densify.bench.table_file import write_table
    from densify.cli.point_files import check_new_file
    from densify.cli.tables import reliability_tables
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    fitted, checked = (
        [(open_sequence(spec), keys) for spec, keys in given]
        for given in (options.fit or bench.FITTED, options.check or bench.CHECKED)
    )
    with progress_on_stderr() as progress:
        measured = bench.bench_confidence(
            fitted, checked, options.window, config, options.cameras, progress
        )
    print(reliability_tables(measured["reliability"]), flush=True)
    if options.out is not None:
        write_table(options.out, {**measured, "config": as_mapping(config)})
        print_paths([options.out])


def bench_depth(options: argparse.Namespace) -> None:
    """Depth maps of several configurations against every truth."""
    variants = {"as configured": resolve(options.config, options.overrides)}
    for name, *changes in options.variant:
        variants[name] = resolve(options.config, [*options.overrides, *changes])
    from densify.bench import depth as bench
    from densify.bench.table_file import write_table
    from densify.cli.point_files import check_new_file
    from densify.cli.tables import depth_table
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
    print(depth_table(measured), flush=True)
    if options.out is not None:
        write_table(
            options.out, {**measured, "config": {n: as_mapping(c) for n, c in variants.items()}}
        )
        print_paths([options.out])


def bench_doctor(options: argparse.Namespace) -> None:
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
        print(fault_table(spec, found[spec]) + "\n", flush=True)
    if options.out is not None:
        write_table(options.out, {"recordings": found})
        print_paths([options.out])


def bench_memory(options: argparse.Namespace) -> None:
    """Peak memory of runs, and what is said of it before."""
    config = resolve(options.config, options.overrides)
    from densify.bench import peaks as bench
    from densify.bench.table_file import write_table
    from densify.cli.point_files import check_new_file
    from densify.cli.tables import memory_table

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
    print(memory_table(rows))
    if options.out is not None:
        write_table(options.out, {"key": key, "runs": rows, "config": as_mapping(config)})
        print_paths([options.out])


def bench_flow(options: argparse.Namespace) -> None:
    """Scene flow methods on the same pairs and windows."""
    config = resolve(options.config, options.overrides)
    from densify.bench import flow as bench
    from densify.bench.table_file import write_table
    from densify.cli.point_files import check_new_file
    from densify.cli.tables import flow_table
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
            print(flow_table(measured) + "\n", flush=True)
    if options.out is not None:
        write_table(options.out, {"runs": runs, "config": as_mapping(config)})
        print_paths([options.out])


def bench_readme(options: argparse.Namespace) -> None:
    """The tables of the documentation, made again."""
    from densify.bench.readme import tables

    with progress_on_stderr() as progress:
        for line in tables(options.tables, options.kitti, options.pandaset, progress):
            print(line, flush=True)
