# SPDX-License-Identifier: MIT
"""Answer ``densify bench``: measured tables."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    config_of,
    natural,
    option,
    recording_of,
    recordings_of,
    words,
)
from densify.cli.screen import Answer, aligned, numbers_table, progress_on_stderr
from densify.config import as_mapping, resolve
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.bench.paper import PaperPair
    from densify.bench.verdicts import Verdict

_UNSEEN = (
    "street?seed=41@70",
    "street:crossing?seed=42@90",
    "street:highway?seed=43@60",
    "street?seed=44@100",
)


def add(commands: Any) -> None:
    """Add ``bench`` and its tables."""
    about = "measure tables: this package's methods beside published ones"
    parser = add_verb(commands, "bench", None, about)
    benches = parser.add_subparsers(title="benches", metavar="WHAT", required=True)
    _add_flow(benches)
    _add_depth(benches)
    _add_paper(benches)
    _add_doctor(benches)
    _add_gate(benches)
    about = "make the tables of docs/results.md again, as Markdown on stdout; all take half an hour"
    parser = add_verb(benches, "readme", _answer_readme, about)
    names = "flow, registration"
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"{names} (default: all)")


def _add_flow(benches: Any) -> None:
    parser = add_verb(
        benches,
        "flow",
        _answer_flow,
        "compare scene flow engines on the same windows",
        "Methods: ours (the configured engine, all sweeps), ours-pair (two sweeps), paper (the "
        "published objective with our solver), paper-adam (its own solver, minutes a pair), rigid. "
        "Errors need --truth, or a recording with exact truth. The last tables follow the "
        "Argoverse 2 challenges: points within 35 m, without the ground, moving from 0.05 m a "
        "sweep.",
    )
    add_recording(parser, several=True)
    _add_common(parser)
    option(parser, "--methods NAME,…", "the methods (default: all but paper-adam)", type=words)
    about = (
        "folder of true flow from each sweep to the next one: FRAME_NEXT.npz or STAMP.feather. "
        "Pairs before the key are scored"
    )
    option(parser, "--truth DIR", about, type=Path)


def _add_depth(benches: Any) -> None:
    parser = add_verb(
        benches,
        "depth",
        _answer_depth,
        "compare depth maps of several settings",
        "Truths: on the simulated street, exact depth within reach of a scanner of the key sweep. "
        "On other recordings, the returns of the key sweep, for maps made without it. With "
        "--scanner, the returns of one of several scanners, for maps made without it.",
    )
    add_recording(parser)
    _add_common(parser)
    add_common(parser, "camera")
    option(parser, "--method NAME", "a method of densify compare (default: flow)", default="flow")
    names, about = (
        ("NAME", "section.key=value"),
        "other settings to compare; may be given several times",
    )
    parser.add_argument(
        "--variant", nargs="+", action="append", default=[], metavar=names, help=about
    )
    option(parser, "--scanner N", "number of the scanner whose returns are the truth", type=natural)


def _add_paper(benches: Any) -> None:
    parser = add_verb(
        benches,
        "paper",
        _answer_paper,
        "make the tables of Pontes, Hays, Lucey (3DV 2020), beside the published figures",
        "A pair is a frame of a recording and the next sweep, without ego-motion (--data, default: "
        "four streets). Without exact truth, the flow of this package is the truth. Methods: rest "
        "(nothing moves), paper (the published objective), paper-adam (its own solver, minutes a "
        "pair), no-laplacian (Table 2), ours.",
    )
    files = "as FlowNet3D's authors made them"
    option(parser, "--flyingthings DIR", f".npz files of FlyingThings3D {files}", type=Path)
    option(parser, "--kitti DIR", f".npz files of KITTI's scene flow 2015 {files}", type=Path)
    option(
        parser,
        "--data SPEC@K,…",
        "recordings with frames, such as street@60,80; may be given several times",
        action="append",
    )
    option(parser, "--methods NAME,…", "the methods (default: the fast ones)", type=words)
    about = "a network of densify train flow; may be given several times"
    option(parser, "--model FILE", about, type=Path, action="append", default=[], dest="models")
    option(
        parser,
        "--points N",
        "points drawn from a cloud (default: 2048)",
        type=natural,
        default=2048,
    )
    option(parser, "--pairs N", "pairs of a set (default: 0, all)", type=natural, default=0)


def _add_doctor(benches: Any) -> None:
    parser = add_verb(
        benches,
        "doctor",
        _answer_doctor,
        "measure how often densify doctor finds wrong cameras, clocks and poses",
        "Each camera and the poses of each recording get one error after another, in both "
        "directions. The table has the shares that the doctor calls fine, unknown, suspicious and "
        "wrong.",
    )
    add_recording(parser, several=True)
    add_common(parser, "config")


def _add_gate(benches: Any) -> None:
    parser = add_verb(
        benches,
        "gate",
        _answer_gate,
        "judge a change: the figures of 16 keys and 3 pairs beside stored ones, with their luck",
        "Depth maps are compared at equal coverage, key by key. A figure is better or worse if its "
        "mean change exceeds two standard deviations of luck (poses moved by 2 mm and 0.01°) and "
        "two standard errors between the keys. Registration and flow are kept between calls while "
        "their code stays the same.",
    )
    about = "folder of the real recordings (default: $DENSIFY_TEST_DATA; without, streets alone)"
    option(parser, "--data DIR", about, type=Path, default=os.environ.get("DENSIFY_TEST_DATA"))
    option(parser, "--only KIND,…", "some of depth, flow, registration (default: all)", type=words)
    option(parser, "--keys NAME,…", "some of the keys (default: all)", type=words)
    about = "stored figures to compare with (default: tests/gate.json)"
    option(parser, "--stored FILE", about, type=Path, default=Path("tests/gate.json"))
    option(parser, "--write FILE", "store the figures as they are now", type=Path)
    about = "times that poses are moved to measure luck anew (default: 0, keep the stored luck)"
    option(parser, "--draws N", about, type=natural, default=0)


def _add_common(parser: argparse.ArgumentParser) -> None:
    about = "key frame; may be given several times (default: 120)"
    option(parser, "--key K", about, type=natural, action="append", dest="keys")
    add_common(parser, "window", "config")


def _answer_flow(options: argparse.Namespace) -> Iterator[Answer]:
    config = config_of(options)
    from densify.bench.flow import DEFAULT_METHODS, bench_flow
    from densify.readers import open_sequence

    methods = DEFAULT_METHODS if options.methods is None else options.methods
    window = options.window
    for sequence in [open_sequence(spec) for spec in recordings_of(options)]:
        for key in options.keys or [120]:
            with progress_on_stderr() as progress:
                measured = bench_flow(
                    sequence, key, window, config, methods, progress, options.truth
                )
            title = f"{measured['data']}, key {key}, {measured['num_pairs']} pairs"
            text = f"{title}\n{numbers_table(measured['methods'])}\n"
            yield Answer(text, {"runs": [measured]})
    yield Answer(facts={"config": as_mapping(config)})


def _answer_gate(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.bench import gate
    from densify.bench.verdicts import verdicts
    from densify.config.cache import Cache

    kinds = gate.KINDS if options.only is None else options.only
    for kind in kinds:
        if kind not in gate.KINDS:
            raise InputError(f"--only {kind}: expected some of {', '.join(gate.KINDS)}")
    stored = gate.read(options.stored) if options.stored.exists() else gate.Stored({}, {})
    with progress_on_stderr() as progress:
        now = gate.measure(options.data, kinds, options.keys, options.draws, progress, Cache())
    luck = now.luck if options.draws else stored.luck
    for group, names in gate.GROUPS.items():
        before, after = (
            {k: f for k, f in known.items() if k in names}
            for known in (stored.figures, now.figures)
        )
        rows = list(verdicts(before, after, luck))
        if rows:
            titles = [group, "keys", "before", "now", "change", "error", "luck", "worst", ""]
            yield Answer(aligned([titles, *map(_verdict_cells, rows)]) + "\n")
    yield Answer(facts={"figures": now.figures, "luck": luck})
    if options.write is not None:
        merged = gate.Stored(stored.figures | now.figures, stored.luck | luck)
        gate.write(options.write, merged)
        yield Answer(files=[options.write])


def _verdict_cells(v: Verdict) -> list[str]:
    key, change = v.worst
    values = (v.before, v.now, v.change, v.error, v.luck)
    cells = [f"{value:.4g}" for value in values[:2]] + [f"{value:+.4f}" for value in values[2:]]
    return [v.figure, str(len(v.keys)), *cells, f"{key} {change:+.4f}", v.word]


def _answer_doctor(options: argparse.Namespace) -> Iterator[Answer]:
    config = config_of(options)
    from densify.bench.doctor import bench_doctor
    from densify.readers import open_sequence

    sequences = [open_sequence(spec) for spec in recordings_of(options)]
    with progress_on_stderr() as progress:
        found = bench_doctor(sequences, config, progress)
    titles = list(next(iter(found.values())))
    rows = [
        [mistake, *(format(row[title], "d" if title == "of" else ".0%") for title in titles)]
        for mistake, row in found.items()
    ]
    yield Answer(aligned([["", *titles], *rows]), {"mistakes": found})


def _answer_depth(options: argparse.Namespace) -> Iterator[Answer]:
    variants = {"as configured": config_of(options)}
    for name, *changes in options.variant:
        variants[name] = resolve(options.config, [*options.overrides, *changes])
    from densify.bench.depth import bench_depth
    from densify.readers import open_sequence

    sequence, keys = open_sequence(recording_of(options)), options.keys or [120]
    window, cameras, scanner = options.window, options.cameras, options.scanner
    with progress_on_stderr() as progress:
        measured = bench_depth(
            sequence, keys, window, variants, cameras, scanner, options.method, progress
        )
    configs = {name: as_mapping(config) for name, config in variants.items()}
    text = f"{measured['data']}, keys {', '.join(map(str, keys))}"
    facts = {**measured, "config": configs}
    yield Answer(f"{text}\n{numbers_table(measured['variants'])}", facts)


def _answer_paper(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.bench.paper import DEFAULT_METHODS, PUBLISHED, bench_paper

    methods = DEFAULT_METHODS if options.methods is None else options.methods
    models, num_points = options.models, options.points
    for name, pairs in _paper_sets(options).items():
        with progress_on_stderr() as progress:
            measured = bench_paper(pairs, methods, models, num_points, progress)
        published = {"as published": PUBLISHED[name]} if name in PUBLISHED else {}
        title = f"{name}: {measured['num_pairs']} pairs, {num_points} points drawn"
        text = numbers_table({**measured["methods"], **published})
        yield Answer(f"{title}\n{text}\n", {"sets": [{"set": name, **measured}]})
    yield Answer(facts={"published": PUBLISHED})


def _paper_sets(options: argparse.Namespace) -> dict[str, Iterable[PaperPair]]:
    from densify.bench import paper

    sets: dict[str, Iterable[PaperPair]] = {}
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
    for kind, places in chosen.items():
        sets[kind] = map(paper.pair_of_recording, *zip(*places, strict=True))
    return sets


def _answer_readme(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.bench.flow import tables

    with progress_on_stderr() as progress:
        for line in tables(options.tables, progress):
            yield Answer(line, {"lines": [line]})
