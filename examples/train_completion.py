# SPDX-License-Identifier: MIT
"""Train a small network on a training set, and complete the single sweeps of another one.

python examples/train_completion.py SET TEST [STEPS]

SET and TEST are folders of `densify dataset`. `densify bench training` compares kinds of maps.
"""

import sys
from collections.abc import Iterator

import numpy as np

import densify
from densify.scores.depth_metrics import depth_errors
from densify.learning.completion import Sample, predict, train


def samples(folder: str) -> Iterator[tuple[Sample, np.ndarray, float]]:
    """Yield each sample of a set with its dense depth (H,W) in metres and its focal length."""
    for maps in densify.DepthDataset(folder):
        focal_px = float(maps["intrinsics"][0, 0])
        names = ("sparse_depth_m", "dense_depth_m", "confidence")
        sparse_m, dense_m, confidence = (maps[name][0].numpy() for name in names)
        image = maps["image"].numpy()
        yield Sample.of(image, sparse_m, dense_m, confidence, focal_px=focal_px), dense_m, focal_px


def main() -> None:
    folder, test, *steps = sys.argv[1:]
    network = train([sample for sample, *_ in samples(folder)], int(*steps or [250]))
    outliers = [
        depth_errors(predict(network, sample), dense_m, focal_px=focal_px).outliers
        for sample, dense_m, focal_px in samples(test)
    ]
    print(f"{np.mean(outliers):.2%} outliers against the maps of {test}")


if __name__ == "__main__":
    main()
