# SPDX-License-Identifier: MIT
"""Fit the weights of the confidence to the gate's keys, and check them on recordings left out.

python examples/fit_confidence.py [--data DIR] [--keys NAME …]

The weights are printed as ``WEIGHTS`` of densify/depth/confidence.py has them, each with its
standard error between recordings (jackknife).
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from densify.bench.gate import judged_maps
from densify.config.cache import Cache
from densify.depth.confidence import WEIGHTS, confidence_of, wrong

NUM_RIGHT = 15_000  # of a map, a random sample; with their weight they stand for all
FREE = ("every pixel", "filled pixel")  # weights of either sign; the others raise the risk
SMALL = 1e-3  # penalty on the squares of the weights
STEPS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8)


class Evidence(NamedTuple):
    """The features (P,8) of the pixels of one map with a true depth, and whether each is wrong.

    group: maps of one group are of one recording, and are left out together.
    """

    name: str
    group: str
    features: np.ndarray
    outlier: np.ndarray
    measured: np.ndarray
    moving: np.ndarray


def collected(folder, names):
    """Yield the evidence of each of the gate's keys."""
    for key, depth, truth, outlier in judged_maps(folder, names, Cache()):
        shown = depth.filled_m > 0
        known = (truth.depth_m > 0)[shown]
        parts = (outlier, depth.depth_m > 0, truth.moving)
        yield Evidence(
            key.name,
            key.data,
            depth.evidence[known].astype(np.float64),
            *(part[shown][known] for part in parts),
        )


def fit(maps):
    """Return the (8,) weights of the logistic regression in which every map counts alike."""
    rng = np.random.default_rng(0)
    x, y, weight = [], [], []
    for one in maps:
        bad, right = (np.flatnonzero(one.outlier == is_bad) for is_bad in (True, False))
        some = rng.choice(right, min(len(right), NUM_RIGHT), replace=False)
        rows = np.concatenate([bad, some])
        x.append(one.features[rows])
        y.append(one.outlier[rows])
        stands_for = np.where(one.outlier[rows], 1.0, len(right) / max(len(some), 1))
        weight.append(stands_for / len(one.outlier) / len(maps))
    x, y, weight = (np.concatenate(part) for part in (x, y, weight))
    penalty = SMALL * np.array([name != "every pixel" for name in WEIGHTS])

    def loss(w):
        score = x @ w
        value = weight @ np.logaddexp(0, np.where(y, -score, score))
        slope = x.T @ (weight * (1 / (1 + np.exp(-score)) - y))
        return 100 * value + penalty @ w**2, 100 * slope + 2 * penalty * w

    bounds = [(None if name in FREE else 0, None) for name in WEIGHTS]
    start = np.array([*WEIGHTS.values()])
    return minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x


def left_out(maps):
    """Return group -> weights fitted without the maps of this group."""
    groups = dict.fromkeys(one.group for one in maps)
    return {g: fit([one for one in maps if one.group != g]) for g in groups}


def area(risk, outlier):
    """Return the probability that an outlier has a higher risk than another pixel."""
    order = np.argsort(risk, kind="stable")
    place = np.empty(len(risk))
    place[order] = np.arange(len(risk))
    num = int(outlier.sum())
    return (place[outlier].sum() - num * (num - 1) / 2) / max(num * (len(risk) - num), 1)


def check(maps, weights):
    """Print expected and found outliers of each map with the weights fitted without it."""
    off, areas = [], []
    title = ("all", "measured", "moving")
    print(f"{'expected / found %':34s}" + "".join(f"{part:>16s}" for part in title) + "   area")
    for one in maps:
        risk = wrong(confidence_of(one.features, weights[one.group]))
        every = np.ones(len(risk), bool)
        parts = [
            (100 * risk[p].mean(), 100 * one.outlier[p].mean()) if p.any() else None
            for p in (every, one.measured, one.moving)
        ]
        areas.append(area(risk, one.outlier))
        off.append(abs(np.log2(parts[0][0] / max(parts[0][1], 1e-3))))
        cells = "".join(f"{'':>16s}" if p is None else f"{p[0]:9.2f} / {p[1]:4.2f}" for p in parts)
        print(f"{one.name[-34:]:34s}{cells}   {areas[-1]:.3f}")
    print(f"mean |log2(expected / found)| {np.mean(off):.2f}, mean area {np.mean(areas):.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the real recordings")
    parser.add_argument("--keys", nargs="+", help="names of the gate's keys (default: all)")
    given = parser.parse_args()
    maps = list(collected(given.data, given.keys))
    weights, without = fit(maps), left_out(maps)
    each = np.stack([*without.values()])
    error = np.sqrt((len(each) - 1) * each.var(axis=0))
    for name, value, off in zip(WEIGHTS, weights, error, strict=True):
        print(f'    "{name}": {value:.2f},  # ± {off:.2f}')
    check(maps, without)


if __name__ == "__main__":
    main()
