# SPDX-License-Identifier: MIT
"""Compare the depth maps of several settings with every ground truth: ``densify bench depth``.

Ground truths by name. ``truth``: exact depth of a simulated recording below the scanner's top ring
and within 80 m. ``key held out``: returns of the key sweep, for a map made from the other sweeps.
``scanner``: returns of one of several scanners, which the maps do not use.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from densify.bench.truth import TruthMap, Without, exact_truth, scanner_truth
from densify.config import Config
from densify.config.errors import InputError
from densify.depth.exposure import key_shots
from densify.geometry.types import Camera, Float32, LidarSequence, Progress, Result
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import METHODS, looks_around
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.readers.timeline import choose_cameras
from densify.scores.depth_metrics import image_density

PRODUCTS = ("measured", "filled")
_PARTS = ("all", "moving")


def bench_depth(
    sequence: LidarSequence,
    keys: Sequence[int],
    window: int,
    variants: Mapping[str, Config],
    cameras: Sequence[str] | None = None,
    scanner: int | None = None,
    method: str = "flow",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Densify the key sweeps with each variant, and pool the scores over key sweeps and cameras.

    Args:
        variants: Name -> settings to compare.
        scanner: Index of the scanner whose returns are the ground truth, None for none. Other
            arguments as in `densify.pipeline.run.run`.

    Returns:
        Under ``variants`` by name: ``density``, mean share of pixels with a depth in the measured
            and the filled map; ``seconds`` of projection per key sweep; ``scores`` (num_pixels,
            coverage, outliers) by ground truth, map (measured, filled) and pixels (all, moving).
    """
    choose_cameras(sequence, cameras)
    if method not in METHODS:
        raise InputError(f"--method {method}: expected one of {', '.join(METHODS)}")
    if scanner is not None and not np.any(sequence[keys[0]].lidar == scanner):
        raise InputError(f"--scanner {scanner}: no returns of it in sweep {keys[0]}")
    used = sequence if scanner is None else Without(sequence, scanner)
    sums = {name: _Sums() for name in variants}
    for number, key in enumerate(keys):
        for name, config in variants.items():
            shots = key_shots(sequence, choose_cameras(sequence, cameras), key, config.project)
            truths = {}
            if scanner is not None:
                truths["scanner"] = scanner_truth(scanner, sequence, key, window, shots, config)
            watch = Watch()
            looks = looks_around([method])
            recording = Recording(used, config.scored(), window, [key], None, None, watch, looks)
            made = pipeline.densify(recording, key, [method], cameras, watch)[method]
            key_sweep = recording.window(key)[key].sweep
            truths["truth"] = exact_truth(used, key_sweep, shots, config)
            sums[name].add(made, truths, used.cameras)
        if progress is not None:
            progress("bench", number + 1, len(keys))
    found = {name: variant.numbers(len(keys)) for name, variant in sums.items()}
    return {"data": sequence.name, "keys": list(keys), "scanner": scanner, "variants": found}


class _Sums:
    """Sums of pixel counts over key sweeps and cameras, by ground truth, map and kind of pixels."""

    def __init__(self) -> None:
        # Pixels with a true depth, those that have a depth in the map too, outliers among these
        self._counts: defaultdict[tuple[str, str, str], Any] = defaultdict(lambda: np.zeros(3, int))
        self._densities: dict[str, list[float]] = {product: [] for product in PRODUCTS}
        self._seconds = 0.0

    def add(
        self,
        made: Result,
        truths: Mapping[str, Mapping[str, TruthMap]],
        cameras: Mapping[str, Camera],
    ) -> None:
        """Add the maps of a result. ``truths``: name of the ground truth -> map -> true depth."""
        self._seconds += sum(cost.seconds for cost in made.costs if cost.name == "project")
        for name, maps in made.depth.items():
            focal_px = cameras[maps.camera].focal_px
            for product, depth_m in zip(PRODUCTS, (maps.depth_m, maps.filled_m), strict=True):
                self._densities[product].append(image_density(depth_m))
                for source, truth in [(s, t[name]) for s, t in truths.items() if name in t]:
                    for part, counts in _counted(depth_m, truth, focal_px):
                        self._counts[source, product, part] += counts
        for scores in (made.metrics.get("held_out") or {}).values():
            for product in PRODUCTS:
                for part in _PARTS:
                    score = scores[product][part]
                    outliers = round((score["outliers"] or 0.0) * score["num_compared"])
                    counts = (score["num_pixels"], score["num_compared"], outliers)
                    self._counts["key held out", product, part] += counts

    def numbers(self, num_keys: int) -> dict[str, Any]:
        """Return density, seconds and scores of a variant, see `bench_depth`."""
        scores: dict[str, Any] = {}
        for (source, product, part), (num, compared, outliers) in self._counts.items():
            scores.setdefault(source, {}).setdefault(product, {})[part] = {
                "num_pixels": int(num),
                "coverage": compared / num if num else None,
                "outliers": outliers / compared if compared else None,
            }
        density = {p: float(np.mean(d)) for p, d in self._densities.items() if d}
        return {"density": density, "seconds": self._seconds / num_keys, "scores": scores}


def _counted(
    depth_m: Float32, truth: TruthMap, focal_px: float
) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """Yield "all" and "moving" pixels, each with its three counts of `_Sums`."""
    for part in _PARTS:
        known = (truth.depth_m > 0) & (truth.moving if part == "moving" else True)
        both = known & (depth_m > 0)
        wrong = truth.outliers(depth_m, both, focal_px)
        yield part, (int(known.sum()), int(both.sum()), int(wrong.sum()))
