# SPDX-License-Identifier: MIT
"""Judge a change by figures of many keys, each known with its luck.

Luck is the standard deviation σ of a figure when the poses of a window move by 2 mm and 0.01°. Two
maps are compared at equal coverage: the least confident pixels of either are left out.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from densify.geometry.types import Bool, Float, Float32

_NUM_STEPS = 200  # of a curve
_BEYOND = 2.0  # standard deviations of luck, and standard errors between keys

Curve = Mapping[str, Any]
"""Outliers of a map over its coverage.

``num``: number of pixels with a true depth. ``covered``: number of those with a depth.
``outliers``: number of outliers among the most certain 0, 0.5, … 100 % of the covered pixels.
"""


def curve(num_true: int, confidence: Float | Float32, outliers: Bool) -> Curve:
    """Return the outliers over the coverage, of ``num_true`` pixels with a true depth.

    Both arrays (K,) are of the covered ones. Equal confidences share their outliers evenly.
    """
    _, rank, size = np.unique(-confidence, return_inverse=True, return_counts=True)
    of_rank = np.bincount(rank, outliers, len(size))
    ends, sums = np.append(0, size.cumsum()), np.append(0, of_rank.cumsum())
    steps = np.interp(np.linspace(0, len(confidence), _NUM_STEPS + 1), ends, sums)
    return {"num": num_true, "covered": len(confidence), "outliers": np.round(steps, 2).tolist()}


def coverage(outliers: Curve) -> float:
    """Return the share of the true pixels with a depth in percent."""
    return 100 * outliers["covered"] / max(outliers["num"], 1)


def outliers_at(outliers: Curve, covered_percent: float) -> float:
    """Return the share of outliers in percent among the most certain pixels of this coverage."""
    num = covered_percent / 100 * outliers["num"]
    steps = np.linspace(0, outliers["covered"], len(outliers["outliers"]))
    return float(100 * np.interp(num, steps, outliers["outliers"]) / max(num, 1))


def change(figure: str, before: Any, now: Any) -> dict[str, float]:
    """Return name -> change of a figure: of a curve, its outliers at equal coverage and coverage.

    ``before`` and ``now`` are both a `Curve`, a number, or numbers of repeated draws.
    """
    if isinstance(before, Mapping):
        covered = min(coverage(before), coverage(now))
        off = outliers_at(now, covered) - outliers_at(before, covered)
        return {f"{figure} outliers": off, f"{figure} coverage": coverage(now) - coverage(before)}
    return {figure: float(np.mean(now) - np.mean(before))}


class Verdict(NamedTuple):
    """The change of one figure over the keys of a group."""

    figure: str  # name of the figure, with its unit
    keys: Sequence[str]  # names of the keys
    before: float  # mean over the keys before the change
    now: float  # mean over the keys now
    change: float  # mean change; of outliers, at equal coverage
    error: float  # standard error of the mean change between keys; NaN with one key
    luck: float  # standard deviation of the mean change by luck
    worst: tuple[str, float]  # name of the key with the worst change, and that change
    word: str  # "better", "worse" or "no difference"


def verdicts(
    before: Mapping[str, Any], now: Mapping[str, Any], luck: Mapping[str, Any]
) -> Iterator[Verdict]:
    """Yield the verdict of each figure over all keys that both measurements have.

    Both map key -> figure -> `Curve`, number or draws; ``luck`` maps key -> name of `change` -> σ.
    """
    rows: dict[str, dict[str, tuple[float, float, float, float]]] = defaultdict(dict)
    for key in [k for k in before if k in now]:
        for figure in [f for f in before[key] if f in now[key]]:
            was, value = before[key][figure], now[key][figure]
            for name, off in change(figure, was, value).items():
                sigma = luck.get(key, {}).get(name, 0.0)
                if isinstance(was, Sequence):
                    sigma = float(np.hypot(np.std(was), np.std(value)) / math.sqrt(2 * len(was)))
                rows[name][key] = _plain(name, was), _plain(name, value), off, sigma
    for name, row in rows.items():
        was, value, off, sigma = np.array(list(row.values())).T
        bad = off if _is_cost(name) else -off
        error = float(off.std(ddof=1) / math.sqrt(len(off))) if len(off) > 1 else math.nan
        # Both measurements have luck.
        by_luck = float(np.sqrt(2 * (sigma**2).sum()) / len(off))
        beyond = _BEYOND * max(by_luck, 0.0 if math.isnan(error) else error)
        worst, word = int(bad.argmax()), "no difference"
        if abs(off.mean()) > beyond:
            word = "worse" if bad.mean() > 0 else "better"
        yield Verdict(
            figure=name,
            keys=list(row),
            before=float(was.mean()),
            now=float(value.mean()),
            change=float(off.mean()),
            error=error,
            luck=by_luck,
            worst=(list(row)[worst], float(off[worst])),
            word=word,
        )


def beyond_luck(
    before: Mapping[str, Any], now: Mapping[str, Any], luck: Mapping[str, float], sigmas: float
) -> dict[str, float]:
    """Return the changes of one key's figures for the worse beyond ``sigmas`` of both lucks."""
    worse = {}
    for figure in before:
        for name, off in change(figure, before[figure], now[figure]).items():
            bad = off if _is_cost(name) else -off
            if bad > sigmas * math.sqrt(2) * luck[name]:
                worse[name] = off
    return worse


def _is_cost(name: str) -> bool:
    return not name.endswith(("coverage", "recall %"))


def _plain(name: str, value: Any) -> float:
    """Return a figure as a number: of a curve, its coverage or all its outliers in percent."""
    if isinstance(value, Mapping):
        covered = coverage(value)
        return covered if name.endswith("coverage") else outliers_at(value, covered)
    return float(np.mean(value))
