# SPDX-License-Identifier: MIT
"""Options of ``densify bench``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from densify.cli import bench_verbs
from densify.cli.options import (
    DATA_HELP,
    add_camera,
    add_config_options,
    add_overwrite,
    add_verb,
    add_window,
    natural,
    recording_keys,
    sentence,
    words,
)


def add_bench(commands: Any) -> None:
    about = "measured tables: this package's methods beside published ones"
    parser = commands.add_parser("bench", help=about, description=sentence(about))
    benches = parser.add_subparsers(title="benches", metavar="WHAT", required=True)
    _add_bench_flow(benches)
    _add_bench_depth(benches)
    _add_bench_confidence(benches)
    _add_bench_doctor(benches)
    _add_bench_memory(benches)
    _add_bench_paper(benches)
    _add_bench_readme(benches)


def _add_bench_flow(benches: Any) -> None:
    parser = add_verb(
        benches,
        "flow",
        bench_verbs.bench_flow,
        "scene flow methods on the same pairs and windows: error, energy, seconds, memory",
        "Methods: ours (all sweeps), ours-pair (two sweeps), paper (the published objective, our "
        "solver), paper-adam (its own solver, 1,500 steps: minutes), rigid, cluster-icp, nicp "
        "(non-rigid ICP). Errors need --truth, or a recording with truth, such as the built-in "
        "street. The last tables are scored as the Argoverse 2 challenges are: within 35 m, "
        "without the ground, moving from 0.05 m a sweep; three-way end-point errors, and errors as "
        "parts of the speed in buckets of it.",
    )
    parser.add_argument(
        "--data", metavar="SPEC", action="append", help=f"{DATA_HELP}; may be given several times"
    )
    _add_keys(parser)
    add_window(parser)
    parser.add_argument(
        "--methods",
        type=words,
        metavar="NAME,…",
        help="of those below, or all (default: all but paper-adam)",
    )
    parser.add_argument(
        "--pairs-only",
        action="store_true",
        help="one pair of sweeps for each key; nothing is accumulated",
    )
    parser.add_argument(
        "--max-points",
        type=natural,
        default=8000,
        metavar="N",
        help="points that paper, paper-adam and nicp may move; more is slower and finer, 0: all "
        "(default: 8000)",
    )
    parser.add_argument(
        "--truth",
        metavar="DIR|FILE.h5",
        type=Path,
        help="true flow of DATA's sweeps to the next ones: FRAME_NEXT.npz (flow files), "
        "STAMP.feather (Argoverse 2's labels), or OpenSceneFlow's .h5; pairs are then those before "
        "the key (default: the exact truth of a simulated recording)",
    )
    _add_configuration_and_file(parser)


def _add_bench_depth(benches: Any) -> None:
    parser = add_verb(
        benches,
        "depth",
        bench_verbs.bench_depth,
        "depth maps of several configurations side by side, against every truth there is",
        "Truths: the built-in street's exact one, where a scanner in the key sweep can reach; the "
        "key sweep's returns, for the key made without them; with --scanner the returns of one of "
        "several scanners, for maps made without it.",
    )
    parser.add_argument("--data", metavar="SPEC", help=DATA_HELP)
    _add_keys(parser)
    add_window(parser)
    add_camera(parser)
    parser.add_argument(
        "--method", default="flow", metavar="NAME", help="as of compare (default: flow)"
    )
    parser.add_argument(
        "--variant",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "section.key=value"),
        help="a configuration beside the given one, with these values changed; may be given "
        "several times",
    )
    parser.add_argument(
        "--scanner",
        type=natural,
        metavar="N",
        help="leave this scanner's returns out of the maps and take them for the truth",
    )
    _add_configuration_and_file(parser)


def _add_bench_confidence(benches: Any) -> None:
    parser = add_verb(
        benches,
        "confidence",
        bench_verbs.bench_confidence,
        "the tables behind confidence: fitted to exact truth, checked where they were not fitted",
        "What --out writes is used in the place of densify/depth/confidence.json. Checked are maps "
        "against exact truth, where there is some, and maps made without the key sweep "
        "against its returns. Hold means: expected and found differ by at most a fifth or 0.05 %.",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--shipped",
        action="store_true",
        help="fit nothing: check the tables that come with the package",
    )
    source.add_argument(
        "--fit",
        type=recording_keys,
        action="append",
        metavar="SPEC@KEYS",
        help="simulated recording to fit to, and its keys (K,K,… or A:B[:S]); may be given several "
        "times (default: streets of several kinds, seeds and scanners)",
    )
    parser.add_argument(
        "--check",
        type=recording_keys,
        action="append",
        metavar="SPEC@KEYS",
        help="recording to check on; may be given several times (default: other streets)",
    )
    add_window(parser)
    add_camera(parser)
    _add_configuration_and_file(parser)


def _add_bench_doctor(benches: Any) -> None:
    parser = add_verb(
        benches,
        "doctor",
        bench_verbs.bench_doctor,
        "mistakes made on purpose in a good recording, and which of them densify doctor names",
    )
    parser.add_argument(
        "--data", metavar="SPEC", action="append", help=f"{DATA_HELP}; may be given several times"
    )
    _add_configuration_and_file(parser)


def _add_bench_paper(benches: Any) -> None:
    parser = add_verb(
        benches,
        "paper",
        bench_verbs.bench_paper,
        "the tables of Pontes, Hays, Lucey (3DV 2020), with the published figures beside",
        "Methods: rest, icp, nicp, pointpwc (its loss without learning), paper-adam (as "
        "published), paper (this package's solver), no-laplacian (Table 2), ours. pointpwc and "
        "paper-adam take minutes a pair. On streets the motion of the vehicle is removed, in the "
        "published sets it is not; ours and networks know it where the recording has poses.",
    )
    _add_paper_sets(parser)
    parser.add_argument(
        "--methods", type=words, metavar="NAME,…", help="(default: all but pointpwc, paper-adam)"
    )
    parser.add_argument(
        "--model",
        type=Path,
        action="append",
        default=[],
        metavar="MODEL",
        dest="models",
        help="a network of densify train flow; may be given several times",
    )
    parser.add_argument(
        "--points", type=natural, default=2048, metavar="N", help="drawn (default: 2048)"
    )
    parser.add_argument(
        "--pairs",
        type=natural,
        default=0,
        metavar="N",
        help="of a set or recording, 0: all (default: 0)",
    )
    parser.add_argument(
        "--curves", action="store_true", help="also over neighbours and over the number of points"
    )
    parser.add_argument(
        "--figure",
        metavar="FILE.png",
        type=Path,
        help="draw the first pair from above: the true flow and each method's, 3 times as long",
    )
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="write every number there")
    add_overwrite(parser)


def _add_paper_sets(parser: argparse.ArgumentParser) -> None:
    sets = parser.add_argument_group("pairs of clouds, a table for each set")
    made = "as FlowNet3D's authors made them"
    for name, what in (
        ("flyingthings", f".npz files of FlyingThings3D {made}"),
        ("kitti", f"KITTI's scene flow 2015 with its calibration, or .npz files {made}"),
    ):
        sets.add_argument(f"--{name}", metavar="DIR", type=Path, help=what)
    for name, what in (("argoverse", "DIR[#LOG]"), ("nuscenes", "DIR[#SCENE]")):
        sets.add_argument(
            f"--{name}",
            metavar=what,
            action="append",
            help="a recording with tracked boxes, whose flow densify labels makes; may be given "
            "several times",
        )
    sets.add_argument(
        "--data",
        type=recording_keys,
        action="append",
        metavar="SPEC@KEYS",
        help="recordings and their frames (K,K,… or A:B[:S]), streets or, without truth, held "
        "against what this package's engine finds (default: four streets that nothing was tuned "
        "on, where no set is given)",
    )


def _add_bench_readme(benches: Any) -> None:
    parser = add_verb(
        benches,
        "readme",
        bench_verbs.bench_readme,
        "the tables of docs/results.md made again, as Markdown on stdout; all of them take an hour",
    )
    parser.add_argument(
        "tables",
        nargs="*",
        metavar="TABLE",
        help="of methods, depth, parts, flow, rings, registration, rates, segmentation, pairs, "
        "prior, images (default: "
        "all)",
    )
    parser.add_argument(
        "--kitti", metavar="DIR", type=Path, help="drive 2011_09_26_drive_0013_sync, for its rows"
    )
    parser.add_argument(
        "--pandaset", metavar="DIR", type=Path, help="sequence 002 of PandaSet, for its rows"
    )


def _add_bench_memory(benches: Any) -> None:
    parser = add_verb(
        benches,
        "memory",
        bench_verbs.bench_memory,
        "peak memory of runs on the built-in street over window, cameras and rings, and what is "
        "said before",
        "Window 50 takes some 12 GB. Each run is a process of its own; the first camera is there "
        "several times.",
    )
    _add_keys(parser)
    for name, kind in (("window", "sweeps on each side"), ("cameras", "a number of cameras")):
        parser.add_argument(
            f"--{name}",
            type=natural,
            action="append",
            metavar="N",
            help=f"{kind}; may be given several times",
        )
    parser.add_argument(
        "--rings",
        type=natural,
        choices=(16, 32, 64, 128),
        action="append",
        help="of the scanner; may be given several times",
    )
    _add_configuration_and_file(parser)


def _add_keys(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--key",
        type=natural,
        action="append",
        dest="keys",
        metavar="K",
        help="frame in the middle; may be given several times (default: 120)",
    )


def _add_configuration_and_file(parser: argparse.ArgumentParser) -> None:
    add_config_options(parser)
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="write every number there")
    add_overwrite(parser)
