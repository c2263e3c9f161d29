# SPDX-License-Identifier: MIT
"""Fit the weights of the confidence to the gate's keys, and check them on drives left out.

python examples/fit_confidence.py [--data DIR] [--keys NAME …]

The weights are printed as ``WEIGHTS`` of densify/depth/confidence.py has them, each with its
standard error between drives and streets (jackknife). They are fitted to the pixels of the map. The
weight of rejected pixels alone is fitted to those, with the other weights held.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from densify.bench.gate import judged_maps
from densify.config.cache import Cache
from densify.depth.confidence import WEIGHTS, confidence_of, outlier_probability

NUM_RIGHT = 15_000  # of a map, a random sample; with their weight they stand for all
FREE = ("every pixel", "filled pixel", "rejected pixel")  # of either sign; others raise the risk
REJECTED = [*WEIGHTS].index("rejected pixel")
SMALL = 1e-4  # penalty on the squares of the weights


class Evidence(NamedTuple):
    """The features (P,10) of the pixels of one map with a true depth, and whether each is wrong.

    Rejected pixels have a depth too. group: maps of one group are of one drive or street, and are
    left out together.
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
        some = (depth.filled_m > 0) | (depth.rejected.depth_m > 0)
        known = (truth.depth_m > 0)[some]
        parts = (outlier, depth.depth_m > 0, truth.moving)
        yield Evidence(
            key.name,
            key.data.rpartition("drive_")[2],
            depth.evidence[known].astype(np.float64),
            *(part[some][known] for part in parts),
        )


def fit(maps):
    """Return the (10,) weights of the logistic regression in which every map counts alike."""
    weights = fitted(maps, 0, np.array([*WEIGHTS.values()]), np.arange(len(WEIGHTS)) != REJECTED)
    return fitted(maps, 1, weights, np.arange(len(WEIGHTS)) == REJECTED)


def fitted(maps, rejected, weights, free):
    """Return the weights with the ``free`` ones fitted to the shown, or to the rejected, pixels."""
    rng = np.random.default_rng(0)
    x, y, weight = [], [], []
    for one in maps:
        of_kind = one.features[:, REJECTED] == rejected
        bad, right = (np.flatnonzero(of_kind & (one.outlier == is_bad)) for is_bad in (True, False))
        some = rng.choice(right, min(len(right), NUM_RIGHT), replace=False)
        rows = np.concatenate([bad, some])
        x.append(one.features[rows])
        y.append(one.outlier[rows])
        stands_for = np.where(one.outlier[rows], 1.0, len(right) / max(len(some), 1))
        weight.append(stands_for / max(of_kind.sum(), 1) / len(maps))
    x, y, weight = (np.concatenate(part) for part in (x, y, weight))
    held, x = x[:, ~free] @ weights[~free], x[:, free]
    names = [name for name, is_free in zip(WEIGHTS, free, strict=True) if is_free]
    penalty = SMALL * np.array([name != "every pixel" for name in names])

    def loss(w):
        score = held + x @ w
        value = weight @ np.logaddexp(0, np.where(y, -score, score))
        slope = x.T @ (weight * (1 / (1 + np.exp(-score)) - y))
        return value + penalty @ w**2, slope + 2 * penalty * w

    bounds = [(None if name in FREE else 0, None) for name in names]
    options = {"ftol": 1e-12, "gtol": 1e-8, "maxiter": 500}
    found = minimize(
        loss, weights[free], jac=True, bounds=bounds, method="L-BFGS-B", options=options
    )
    made = weights.copy()
    made[free] = found.x
    return made


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
    title = ("all", "measured", "filled", "moving", "rejected")
    print(f"{'expected / found %':34s}" + "".join(f"{part:>14s}" for part in title) + "   area")
    for one in maps:
        risk = outlier_probability(confidence_of(one.features, weights[one.group]))
        shown = one.features[:, REJECTED] == 0
        filled = shown & ~one.measured
        parts = (shown, shown & one.measured, filled, shown & one.moving, ~shown)
        shares = [(risk[p].mean(), one.outlier[p].mean()) if p.any() else None for p in parts]
        areas.append(area(risk[shown], one.outlier[shown]))
        off.append(np.log2(shares[0][0] / max(shares[0][1], 1e-5)))
        cells = "".join(
            f"{'':14s}" if p is None else f"{100 * p[0]:8.2f} /{100 * p[1]:5.2f}" for p in shares
        )
        print(f"{one.name[-34:]:34s}{cells}   {areas[-1]:.3f}")
    print(f"mean |log2(expected / found)| {np.abs(off).mean():.2f}, mean area {np.mean(areas):.3f}")


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
