# SPDX-License-Identifier: MIT
"""Answer ``densify bench``: measured tables."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from densify.bench import gate, paper, training
from densify.bench.depth import bench_depth
from densify.bench.doctor import bench_doctor
from densify.bench.flow import DEFAULT_METHODS, bench_flow, tables
from densify.bench.training import mean_and_error
from densify.bench.verdicts import verdicts
from densify.cli.terminal import (
    Answer,
    aligned,
    config_of,
    numbers_table,
    percent,
    progress_on_stderr,
    recording_of,
    recordings_of,
    written,
)
from densify.config import as_mapping, resolve
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.readers import open_sequence
from densify.scores.metrics import LEAST_PIXELS, DepthErrors

_KEYS = [120]
_FIGURES = {
    "outliers": ("all", "outliers", ".2%"),
    "moving": ("moving", "outliers", ".2%"),
    "static": ("static", "outliers", ".2%"),
    "edges": ("edge", "outliers", ".2%"),
    "MAE m": ("all", "mae_m", ".3f"),
    "RMSE m": ("all", "rmse_m", ".2f"),
    "iRMSE 1/km": ("all", "irmse_per_km", ".2f"),
}
"""Column of ``bench training`` -> part of the pixels, error, format."""
_FIGURES_OF_IMAGE = {
    "log error": ("all", "silog", ".4f"),
    "moving": ("moving", "silog", ".4f"),
    "static": ("static", "silog", ".4f"),
}
_UNSEEN = (
    "street?seed=41@70",
    "street:crossing?seed=42@90",
    "street:highway?seed=43@60",
    "street?seed=44@100",
)


def answer_bench_flow(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench flow``: yield the scores of scene flow engines for each key."""
    config = config_of(options)
    methods = DEFAULT_METHODS if options.methods is None else options.methods
    for sequence in [open_sequence(spec) for spec in recordings_of(options)]:
        for key in options.key or _KEYS:
            with progress_on_stderr() as progress:
                measured = bench_flow(
                    sequence, key, options.window, config, methods, progress, options.truth
                )
            title = f"{measured['data']}, key {key}, {measured['num_pairs']} pairs"
            text = f"{title}\n{numbers_table(measured['methods'])}\n"
            yield Answer(text, {"runs": [measured]})
    yield Answer(facts={"config": as_mapping(config)})


def _recordings_folder(options: argparse.Namespace) -> Path | None:
    """Return the folder of real recordings of ``--data`` or the environment, else None."""
    named = os.environ.get("DENSIFY_TEST_DATA")
    return options.data or (Path(named) if named else None)


def answer_bench_gate(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench gate``: yield the verdicts of each group, store figures on demand."""
    kinds = gate.KINDS if options.only is None else options.only
    for kind in kinds:
        if kind not in gate.KINDS:
            raise InputError(f"--only {kind}: expected some of {', '.join(gate.KINDS)}")
    data = _recordings_folder(options)
    stored = gate.read(options.stored) if options.stored.exists() else gate.Stored({}, {})
    with progress_on_stderr() as progress:
        now = gate.measure(data, kinds, options.keys, options.draws, progress, Cache())
    luck = now.luck if options.draws else stored.luck
    for group, names in gate.GROUPS.items():
        before, after = (
            {key: figures for key, figures in figures_of_key.items() if key in names}
            for figures_of_key in (stored.figures, now.figures)
        )
        rows = []
        for verdict in verdicts(before, after, luck):
            worst_key, worst_change = verdict.worst
            cells = [f"{value:.4g}" for value in (verdict.before, verdict.now)]
            cells += [f"{value:+.4f}" for value in (verdict.change, verdict.error, verdict.luck)]
            cells += [f"{worst_key} {worst_change:+.4f}", verdict.word]
            rows.append([verdict.figure, str(len(verdict.keys)), *cells])
        if rows:
            titles = [group, "keys", "before", "now", "change", "error", "luck", "worst", ""]
            yield Answer(aligned([titles, *rows]) + "\n")
    yield Answer(facts={"figures": now.figures, "luck": luck})
    if options.write is not None:
        merged = gate.Stored(stored.figures | now.figures, stored.luck | luck)
        gate.write(options.write, merged)
        yield Answer(files=[options.write])


def answer_bench_baselines(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench baselines``: yield the errors of simpler maps and ours, by truth."""
    folder = _recordings_folder(options)
    titles = ["", "part", "pixels", "coverage", "outliers", "over 1 px", "MAE"]
    for truth, keys in gate.KEYS_OF_TRUTH.items():
        if folder is None and keys[0].is_real:
            continue
        errors = gate.errors_of_methods(keys, folder)
        rows = [
            [f"{truth}: {method}", part, *_error_cells(of_part)]
            for method, parts in errors.items()
            for part, of_part in parts.items()
        ]
        facts = {m: {p: asdict(e) for p, e in parts.items()} for m, parts in errors.items()}
        yield Answer(aligned([titles, *rows]) + "\n", {truth: facts})


def _error_cells(errors: DepthErrors) -> list[str]:
    """Return the errors as cells of a table, without shares of too few pixels."""
    cells = [f"{errors.num_pixels:,}", percent(errors.coverage)]
    if errors.num_compared < LEAST_PIXELS or errors.mae_m is None:
        return [*cells, "–", "–", "–"]
    shares = [percent(errors.outliers), percent(errors.outliers_1_px)]
    return [*cells, *shares, f"{errors.mae_m:.2f} m"]


def answer_bench_training(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench training``: yield a table for each test."""
    plan = training.Plan(
        options.sets or tuple(training.SETS),
        options.maps or tuple(training.TARGETS),
        options.seeds,
        options.network,
        options.steps,
        not options.image_alone,
        options.device,
    )
    with progress_on_stderr() as progress:
        networks = training.bench_training(_recordings_folder(options), options.out, plan, progress)
    figures = _FIGURES_OF_IMAGE if options.image_alone else _FIGURES
    tests = next(of_seeds[0] for maps in networks.values() for of_seeds in maps.values())
    for test in tests:
        rows = [
            [name, of, *(_mean_cell(of_seeds, test, *figure) for figure in figures.values())]
            for name, maps in networks.items()
            for of, of_seeds in maps.items()
        ]
        yield Answer(aligned([[test, "trained on", *figures], *rows]) + "\n")
    yield Answer(facts={"networks": networks})


def _mean_cell(of_seeds: list[dict[str, Any]], test: str, part: str, error: str, form: str) -> str:
    """Return a cell with the mean of an error over networks, and its standard error."""
    values = [value for of in of_seeds if (value := of[test][part][error]) is not None]
    mean, error_of_mean = mean_and_error(values)
    of_mean = "" if error_of_mean is None else f" ± {written(error_of_mean, form)}"
    return written(mean, form) + of_mean


def answer_bench_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench doctor``: yield a table of the doctor's verdicts for each error."""
    config = config_of(options)
    sequences = [open_sequence(spec) for spec in recordings_of(options)]
    with progress_on_stderr() as progress:
        shares_of_mistake = bench_doctor(sequences, config, progress)
    titles = list(next(iter(shares_of_mistake.values())))
    rows = []
    for mistake, shares in shares_of_mistake.items():
        # "of" is the number of cases, the others are shares of the verdicts.
        cells = (format(shares[title], "d" if title == "of" else ".0%") for title in titles)
        rows.append([mistake, *cells])
    yield Answer(aligned([["", *titles], *rows]), {"mistakes": shares_of_mistake})


def answer_bench_depth(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench depth``: yield the scores of depth maps of several settings."""
    variants = {"as configured": config_of(options)}
    for name, *changes in options.variant or []:
        variants[name] = resolve(options.config, [*(options.set or []), *changes])
    sequence, keys = open_sequence(recording_of(options)), options.key or _KEYS
    wanted = (variants, options.camera, options.scanner, options.method)
    with progress_on_stderr() as progress:
        measured = bench_depth(sequence, keys, options.window, *wanted, progress)
    configs = {name: as_mapping(config) for name, config in variants.items()}
    text = f"{measured['data']}, keys {', '.join(map(str, keys))}"
    facts = {**measured, "config": configs}
    yield Answer(f"{text}\n{numbers_table(measured['variants'])}", facts)


def answer_bench_paper(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench paper``: yield the scores of each data set."""
    methods = paper.DEFAULT_METHODS if options.methods is None else options.methods
    for name, pairs in _paper_sets(options).items():
        with progress_on_stderr() as progress:
            measured = paper.bench_paper(
                pairs, methods, options.model or [], options.points, progress
            )
        published = {"as published": paper.PUBLISHED[name]} if name in paper.PUBLISHED else {}
        title = f"{name}: {measured['num_pairs']} pairs, {options.points} points drawn"
        text = numbers_table({**measured["methods"], **published})
        yield Answer(f"{title}\n{text}\n", {"sets": [{"set": name, **measured}]})
    yield Answer(facts={"published": paper.PUBLISHED})


def _paper_sets(options: argparse.Namespace) -> dict[str, Iterable[paper.PaperPair]]:
    """Return the pairs of each data set that the options name, by its name."""
    sets: dict[str, Iterable[paper.PaperPair]] = {}
    for name in ("flyingthings", "kitti"):
        if (folder := getattr(options, name)) is not None:
            sets[name] = paper.pairs_of_files(folder, options.pairs)
    chosen: dict[str, list[tuple[str, int]]] = {}
    for text in options.data or (() if sets else _UNSEEN):
        spec, _, keys = text.rpartition("@")
        if not spec or not all(key.isdecimal() for key in keys.split(",")):
            raise InputError(f"--data {text}: expected a recording and frames, as street@60,80")
        kind = "streets" if paper.has_truth(spec) else "against this package's engine"
        chosen.setdefault(kind, []).extend((spec, int(key)) for key in keys.split(","))
    for kind, frames in chosen.items():
        sets[kind] = map(paper.pair_of_recording, *zip(*frames, strict=True))
    return sets


def answer_bench_readme(options: argparse.Namespace) -> Iterator[Answer]:
    """Answer ``densify bench readme``: yield the lines of the tables of docs/flow-results.md."""
    with progress_on_stderr() as progress:
        for line in tables(options.table, progress):
            yield Answer(line, {"lines": [line]})
