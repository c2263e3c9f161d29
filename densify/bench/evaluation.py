# SPDX-License-Identifier: MIT
"""Score depth maps on disk against ground truth, and average the scores over images."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float32, Progress
from densify.outputs.depth_png import read_depth_png, read_mask_png
from densify.readers.depth_trees import DepthPair, DepthPairs
from densify.scores.depth_metrics import (
    KITTI_BASELINE_M,
    DepthErrors,
    errors_by_part,
    image_density,
    mean_errors,
)

SCHEMA_VERSION = 1
"""Version of `evaluate`'s dictionary. It grows when an entry changes its meaning or is removed."""
_AGREEMENT = 0.05  # of a map and its truth in most pixels
_MILLIMETRES = 1000 / 256  # factor between the two usual scales of stored depth
KITTI_FOCAL_PX = 721.5377
"""Focal length of KITTI's rectified cameras on 2011_09_26. On other days it is 707 to 719 px."""


def evaluate(
    pairs: DepthPairs,
    focal_px: float = KITTI_FOCAL_PX,
    baseline_m: float = KITTI_BASELINE_M,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Return the scores of depth maps, averaged over images as in KITTI's development kit.

    The result has plain numbers ready for JSON, None if undefined::

        schema_version, focal_px, baseline_m, num_images
        density      predicted, truth: mean share of all the pixels that have a depth
        parts        name of `errors_by_part` -> num_images and the values of `mean_errors`
        images       for each pair: predicted, truth, mask (paths or None), density, `DepthErrors`
        without_truth, without_prediction, without_mask   paths of files without a partner

    Disparity, which defines outliers and depth discontinuities, is focal length times baseline over
    depth. ``progress`` is called with (stage, done, total).
    """
    stereo = {"focal_px": focal_px, "baseline_m": baseline_m}
    by_part: dict[str, list[DepthErrors]] = defaultdict(list)
    images: list[dict[str, Any]] = []
    for number, pair in enumerate(pairs.pairs):
        predicted_m, truth_m, moving = _read(pair)
        _check_unit(pair, predicted_m, truth_m)
        errors = errors_by_part(predicted_m, truth_m, moving, **stereo)
        for name, of_part in errors.items():
            by_part[name].append(of_part)
        paths = {side: None if path is None else str(path) for side, path in vars(pair).items()}
        densities = {"predicted": image_density(predicted_m), "truth": image_density(truth_m)}
        images.append({**paths, "density": densities, **asdict(errors["all"])})
        if progress is not None:
            progress("evaluate", number + 1, len(pairs.pairs))
    return {
        "schema_version": SCHEMA_VERSION,
        **stereo,
        "num_images": len(images),
        "density": {
            side: float(np.mean([image["density"][side] for image in images]))
            for side in ("predicted", "truth")
        },
        "parts": {
            name: {"num_images": sum(e.num_compared > 0 for e in errors)}
            | asdict(mean_errors(errors))
            for name, errors in by_part.items()
        },
        "images": images,
        "without_truth": [*map(str, pairs.without_truth)],
        "without_prediction": [*map(str, pairs.without_prediction)],
        "without_mask": [*map(str, pairs.without_mask)],
    }


def _check_unit(pair: DepthPair, predicted_m: Float32, truth_m: Float32) -> None:
    """Raise InputError if one of two maps stores 1000 x metres instead of 256 x metres."""
    compared = (predicted_m > 0) & (truth_m > 0)
    if not compared.any():
        return
    ratio = predicted_m[compared] / truth_m[compared]
    for path, too_large in ((pair.predicted, ratio), (pair.truth, 1 / ratio)):
        quartiles = np.percentile(too_large, [25, 50, 75])
        if np.abs(quartiles / _MILLIMETRES - 1).max() < _AGREEMENT:
            raise InputError(
                f"{path}: holds depths {quartiles[1]:.2f} times those of the other map, as if it "
                f"stored 1000 x metres (millimetres); expected 256 x metres: multiply its values "
                f"by 0.256"
            )


def _read(pair: DepthPair) -> tuple[Float32, Float32, Bool | None]:
    """Return (H,W) predicted metres, (H,W) true metres, and an (H,W) mask of moving pixels."""
    predicted_m, truth_m = read_depth_png(pair.predicted), read_depth_png(pair.truth)
    moving = None if pair.mask is None else read_mask_png(pair.mask)
    for path, image in ((pair.predicted, predicted_m), (pair.mask, moving)):
        if image is not None and image.shape != truth_m.shape:
            raise InputError(
                f"{path}: got {image.shape[1]} x {image.shape[0]} px, expected "
                f"{truth_m.shape[1]} x {truth_m.shape[0]}, the size of {pair.truth}; give maps of "
                f"the same camera, neither cropped nor scaled"
            )
    return predicted_m, truth_m, moving
