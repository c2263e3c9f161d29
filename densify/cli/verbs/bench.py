# SPDX-License-Identifier: MIT
"""``densify bench``: measured tables."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer, numbers_table
from densify.cli.options import (
    add_camera,
    add_config_options,
    add_overwrite,
    add_recording,
    add_verb,
    add_window,
    check_new_file,
    config_of,
    natural,
    recording_of,
    recordings_of,
    sentence,
    words,
)
from densify.cli.progress import progress_on_stderr
from densify.config import as_mapping, resolve
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.bench.paper_pairs import PaperPair

_UNSEEN = (
    "street?seed=41@70",
    "street:crossing?seed=42@90",
    "street:highway?seed=43@60",
    "street?seed=44@100",
)


def add(commands: Any) -> None:
    """Add ``bench`` and its tables."""
    about = "measured tables: this package's methods beside published ones"
    parser = commands.add_parser("bench", help=about, description=sentence(about))
    benches = parser.add_subparsers(title="benches", metavar="WHAT", required=True)
    _add_flow(benches)
    _add_depth(benches)
    _add_paper(benches)
    parser = add_verb(
        benches,
        "readme",
        _answer_readme,
        "the tables of docs/results.md made again, as Markdown on stdout; all of them take an hour",
    )
    names = "depth, flow, registration"
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {names} (default: all)")
    for name, what in (("kitti", "drive 2011_09_26_drive_0013_sync"), ("pandaset", "sequence 002")):
        parser.add_argument(f"--{name}", metavar="DIR", type=Path, help=f"{what}, for its rows")


def _add_flow(benches: Any) -> None:
    parser = add_verb(
        benches,
        "flow",
        _answer_flow,
        "engines of scene flow on the same windows: errors, seconds",
        "Methods: ours (the configured engine, all sweeps), ours-pair (two sweeps), paper (the "
        "published objective, our solver), paper-adam (its own solver, 1,500 steps: minutes), "
        "rigid. Errors need --truth, or a recording with exact truth. The last tables are scored "
        "as the Argoverse 2 challenges are: within 35 m, without the ground, moving from 0.05 m a "
        "sweep; three-way end-point errors, and errors as parts of the speed in buckets of it.",
    )
    add_recording(parser, several=True)
    _add_common(parser)
    fast = "(default: all but paper-adam)"
    parser.add_argument("--methods", type=words, metavar="NAME,…", help=fast)
    truth = (
        "true flow of the sweeps to the next ones: FRAME_NEXT.npz (flow files), STAMP.feather "
        "(Argoverse 2's labels), or OpenSceneFlow's .h5; pairs before the key are scored"
    )
    parser.add_argument("--truth", metavar="DIR|FILE.h5", type=Path, help=truth)


def _add_depth(benches: Any) -> None:
    parser = add_verb(
        benches,
        "depth",
        _answer_depth,
        "depth maps of several configurations side by side, against every truth there is",
        "Truths: exact depth of the built-in street, where a scanner in the key sweep can reach; "
        "the key sweep's returns, for the key made without them; with --scanner the returns of one "
        "of several scanners, for maps made without it.",
    )
    add_recording(parser)
    _add_common(parser)
    add_camera(parser)
    method = "as of compare (default: flow)"
    parser.add_argument("--method", default="flow", metavar="NAME", help=method)
    parser.add_argument(
        "--variant",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "section.key=value"),
        help="a configuration beside the given one; may be given several times",
    )
    parser.add_argument("--scanner", type=natural, metavar="N", help="whose returns are the truth")


def _add_paper(benches: Any) -> None:
    parser = add_verb(
        benches,
        "paper",
        _answer_paper,
        "the tables of Pontes, Hays, Lucey (3DV 2020), with the published figures beside",
        "Of recordings (--data, default: four streets) the frame and the next sweep, without the "
        "motion of the vehicle; without exact truth the flow is that of this package's engine. "
        "Methods: rest, icp, paper-adam (as published: minutes a pair), paper (this package's "
        "solver), no-laplacian (Table 2), ours.",
    )
    for name, what in (("flyingthings", "FlyingThings3D"), ("kitti", "KITTI's scene flow 2015")):
        about = f".npz files of {what} as FlowNet3D's authors made them"
        parser.add_argument(f"--{name}", metavar="DIR", type=Path, help=about)
    parser.add_argument("--data", action="append", metavar="SPEC@K,…", help="recordings and frames")
    parser.add_argument("--methods", type=words, metavar="NAME,…", help="(default: the fast ones)")
    model = "a network of densify train flow; may be given several times"
    parser.add_argument(
        "--model", type=Path, action="append", default=[], dest="models", help=model
    )
    for name, default, what in (("points", 2048, "drawn"), ("pairs", 0, "of a set, 0: all")):
        about = f"{what} (default: {default})"
        parser.add_argument(f"--{name}", type=natural, default=default, metavar="N", help=about)
    _add_file(parser)


def _add_common(parser: argparse.ArgumentParser) -> None:
    keys = "frame in the middle; may be given several times (default: 120)"
    parser.add_argument("--key", type=natural, action="append", dest="keys", metavar="K", help=keys)
    add_window(parser)
    add_config_options(parser)
    _add_file(parser)


def _add_file(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="write every number there")
    add_overwrite(parser)


def _written(options: argparse.Namespace, numbers: Mapping[str, Any]) -> list[Path]:
    """Write the file of numbers where one is asked for, and return its path."""
    from densify.bench.evaluation import write_numbers

    if options.out is None:
        return []
    write_numbers(options.out, numbers)
    return [options.out]


def _answer_flow(options: argparse.Namespace) -> Iterator[Answer]:
    config = config_of(options)
    from densify.bench import flow as bench
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    methods = bench.DEFAULT_METHODS if options.methods is None else options.methods
    runs = []
    for sequence in [open_sequence(spec) for spec in recordings_of(options)]:
        for key in options.keys or [120]:
            with progress_on_stderr() as progress:
                measured = bench.bench_flow(
                    sequence, key, options.window, config, methods, progress, options.truth
                )
            runs.append(measured)
            title = f"{measured['data']}, key {key}, {measured['num_pairs']} pairs"
            text = f"{title}\n{numbers_table(measured['methods'])}\n"
            yield Answer(text, {"runs": [measured]})
    yield Answer(files=_written(options, {"runs": runs, "config": as_mapping(config)}))


def _answer_depth(options: argparse.Namespace) -> Iterator[Answer]:
    variants = {"as configured": config_of(options)}
    for name, *changes in options.variant:
        variants[name] = resolve(options.config, [*options.overrides, *changes])
    from densify.bench.depth import bench_depth
    from densify.readers import open_sequence

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    sequence, keys = open_sequence(recording_of(options)), options.keys or [120]
    with progress_on_stderr() as progress:
        measured = bench_depth(
            sequence,
            keys,
            options.window,
            variants,
            options.cameras,
            options.scanner,
            options.method,
            progress,
        )
    configs = {name: as_mapping(config) for name, config in variants.items()}
    files = _written(options, {**measured, "config": configs})
    text = f"{measured['data']}, keys {', '.join(map(str, keys))}"
    yield Answer(f"{text}\n{numbers_table(measured['variants'])}", measured, files)


def _answer_paper(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.bench import paper as bench

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    methods = bench.DEFAULT_METHODS if options.methods is None else options.methods
    measured: dict[str, dict[str, Any]] = {}
    for name, pairs in _paper_sets(options).items():
        with progress_on_stderr() as progress:
            measured[name] = bench.bench_paper(
                pairs, methods, options.models, options.points, progress
            )
        published = {"as published": bench.PUBLISHED[name]} if name in bench.PUBLISHED else {}
        lines = [f"{name}: {measured[name]['num_pairs']} pairs, {options.points} points drawn"]
        lines.append(numbers_table({**measured[name]["methods"], **published}))
        yield Answer("\n".join([*lines, ""]), {"sets": [{"set": name, **measured[name]}]})
    numbers = {"sets": measured, "published": bench.PUBLISHED}
    yield Answer(files=_written(options, numbers))


def _paper_sets(options: argparse.Namespace) -> dict[str, Iterable[PaperPair]]:
    from densify.bench import paper_pairs

    sets: dict[str, Iterable[PaperPair]] = {}
    for name in ("flyingthings", "kitti"):
        if (folder := getattr(options, name)) is not None:
            sets[name] = paper_pairs.pairs_of_files(folder, options.pairs)
    chosen: dict[str, list[tuple[str, int]]] = {}
    for text in options.data or (() if sets else _UNSEEN):
        spec, keys = _recording_keys(text)
        kind = "streets" if paper_pairs.has_truth(spec) else "against this package's engine"
        chosen.setdefault(kind, []).extend((spec, key) for key in keys)
    for kind, places in chosen.items():
        sets[kind] = map(paper_pairs.pair_of_recording, *zip(*places, strict=True))
    return sets


def _recording_keys(text: str) -> tuple[str, list[int]]:
    """Read ``SPEC@K,K,…``."""
    spec, _, keys = text.rpartition("@")
    if not spec or not all(key.isdecimal() for key in keys.split(",")):
        raise InputError(f"--data {text}: expected a recording and frames, as street@60,80")
    return spec, [int(key) for key in keys.split(",")]


def _answer_readme(options: argparse.Namespace) -> Iterator[Answer]:
    from densify.bench.readme import tables

    with progress_on_stderr() as progress:
        for line in tables(options.tables, options.kitti, options.pandaset, progress):
            yield Answer(line, {"lines": [line]})
