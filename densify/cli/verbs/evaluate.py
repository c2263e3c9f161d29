# SPDX-License-Identifier: MIT
"""``densify evaluate``: depth maps against the truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_overwrite, add_verb, positive
from densify.cli.progress import progress_on_stderr


def add(commands: Any) -> None:
    """Its options."""
    parser = add_verb(
        commands,
        "evaluate",
        answer,
        "scores of depth maps against true ones, as KITTI's depth benchmark defines them",
        "PREDICTED and TRUTH: a depth PNG (KITTI's format) each, or folders, of which every PNG "
        "is paired by drive, camera and frame: KITTI depth trees "
        "(DRIVE/proj_depth/groundtruth/image_02/0000000005.png), densify's output "
        "(000005/depth/image_02.png), sets of densify dataset, or plain folders of equal names. A "
        "pixel that PREDICTED lacks costs coverage and is no error. Numbers are means over images.",
    )
    parser.add_argument("predicted", metavar="PREDICTED", type=Path, help="a PNG or a folder")
    parser.add_argument("truth", metavar="TRUTH", type=Path, help="a PNG or a folder")
    parser.add_argument(
        "--mask",
        type=Path,
        metavar="PNG|DIR",
        help="what moves, not 0 in an image or a folder of them: scores of moving and static "
        "pixels too",
    )
    parser.add_argument(
        "--filled",
        action="store_true",
        help="of what densify made, score depth_filled (of a set, groundtruth_filled)",
    )
    parser.add_argument(
        "--focal-px",
        type=positive,
        metavar="F",
        help="the camera's fx, for outliers and edges (default: KITTI's, 721.5377)",
    )
    parser.add_argument(
        "--baseline-m",
        type=positive,
        metavar="B",
        help="stereo baseline that outliers are told by (default: KITTI's, 0.54)",
    )
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="write every number there")
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Depth maps against the truth."""
    from densify.bench import evaluation
    from densify.bench.table_file import write_table
    from densify.cli.bench_tables import evaluation_table
    from densify.cli.point_files import check_new_file
    from densify.readers.depth_trees import pair_depth_files

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    pairs = pair_depth_files(options.predicted, options.truth, options.mask, filled=options.filled)
    given = {name: getattr(options, name) for name in ("focal_px", "baseline_m")}
    stereo = {name: value for name, value in given.items() if value is not None}
    with progress_on_stderr() as progress:
        scores = evaluation.evaluate(pairs, **stereo, progress=progress)
    if options.out is not None:
        write_table(options.out, scores)
    yield Answer(evaluation_table(scores), {"scores": scores}, [options.out] if options.out else [])
