# SPDX-License-Identifier: MIT
"""Answer ``densify evaluate``: score depth maps against ground truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from densify.cli.options import add_verb, option, positive
from densify.cli.screen import Answer, numbers_table, percent, progress_on_stderr

_MISSING = {
    "without_truth": "predicted without truth",
    "without_prediction": "truth without prediction",
    "without_mask": "truth without mask",
}
_MOST_NAMED = 5


def add(commands: Any) -> None:
    """Add the options of ``evaluate``."""
    parser = add_verb(
        commands,
        "evaluate",
        answer,
        "score depth maps against true depth, as KITTI's benchmark does",
        "PREDICTED and TRUTH are depth PNGs in KITTI's format, or folders of them. Files are "
        "paired by drive, camera and frame. Folders may be KITTI depth trees "
        "(DRIVE/proj_depth/groundtruth/image_02/0000000005.png), densify's output "
        "(000005/depth/image_02.png), training sets, or plain folders of equal names. A pixel that "
        "PREDICTED lacks lowers the coverage and is no error. Numbers are means over images.",
    )
    parser.add_argument("predicted", metavar="PREDICTED", type=Path, help="a PNG or a folder")
    parser.add_argument("truth", metavar="TRUTH", type=Path, help="a PNG or a folder")
    about = (
        "masks of moving objects (pixels that are not 0), for scores of moving and static pixels"
    )
    option(parser, "--mask PNG|DIR", about, type=Path)
    about = "score depth_filled instead of depth (in a training set groundtruth_filled)"
    option(parser, "--filled", about)
    about = "focal length fx of the camera, for outliers (default: KITTI's, 721.5377)"
    option(parser, "--focal-px X", about, type=positive, default=721.5377)
    about = "stereo baseline that defines outliers (default: KITTI's, 0.54)"
    option(parser, "--baseline-m X", about, type=positive, default=0.54)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Score depth maps against ground truth."""
    from densify.bench.evaluation import evaluate
    from densify.readers.depth_trees import pair_depth_files

    pairs = pair_depth_files(options.predicted, options.truth, options.mask, filled=options.filled)
    with progress_on_stderr() as progress:
        scores = evaluate(pairs, options.focal_px, options.baseline_m, progress)
    yield Answer(_describe(scores), {"scores": scores})


def _describe(scores: Mapping[str, Any]) -> str:
    """Return a column for each part of the pixels; files without a counterpart are counted."""
    num, density = scores["num_images"], scores["density"]
    lines = [
        f"{num:,} image{'s' if num != 1 else ''}: predicted {percent(density['predicted'])} of "
        f"the pixels, truth {percent(density['truth'])}; outliers with fx "
        f"{scores['focal_px']:g} px, baseline {scores['baseline_m']:g} m"
    ]
    for name, what in _MISSING.items():
        if paths := scores[name]:
            num_more = len(paths) - _MOST_NAMED
            rest = f", ... and {num_more:,} more" if num_more > 0 else ""
            lines.append(f"{what}: {len(paths):,}: {', '.join(paths[:_MOST_NAMED])}{rest}")
    parts = {name: part for name, part in scores["parts"].items() if part["num_pixels"]}
    return "\n".join([*lines, numbers_table(parts)])
