# SPDX-License-Identifier: MIT
"""Train a small network on a training set, and complete the single sweeps of another one.

python examples/train_completion.py SET TEST [STEPS]

SET and TEST are folders of `densify dataset`. `densify bench training` compares kinds of maps.
"""

import sys
from collections.abc import Iterator

import numpy as np

import densify
from densify.learning.completion import Completion, Sample, predict, train
from densify.scores.metrics import depth_errors


def samples(folder: str) -> Iterator[tuple[Sample, np.ndarray, float]]:
    """Yield each sample of a set with its dense depth (H,W) in metres and its focal length."""
    for maps in densify.DepthDataset(folder):
        focal_px = float(maps["intrinsics"][0, 0])
        sparse_m, dense_m = (maps[name][0].numpy() for name in ("sparse_depth_m", "dense_depth_m"))
        image = maps["image"].numpy()
        yield Sample.of(image, sparse_m, dense_m, focal_px=focal_px), dense_m, focal_px


def outliers(network: Completion, folder: str) -> float:
    """Return the mean share of outliers against the dense depth of a set."""
    errors = (
        depth_errors(predict(network, sample), dense_m, focal_px=focal_px)
        for sample, dense_m, focal_px in samples(folder)
    )
    return float(np.mean([of_image.outliers for of_image in errors]))


def main() -> None:
    folder, test, *steps = sys.argv[1:]
    print(f"untrained {outliers(Completion().eval(), test):.2%} outliers against {test}")
    network = train([sample for sample, *_ in samples(folder)], int(*steps or [300]))
    print(f"trained   {outliers(network, test):.2%}")


if __name__ == "__main__":
    main()
