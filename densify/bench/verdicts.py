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

_NUM_STEPS = 200  # number of steps of a curve
_BEYOND = 2.0  # standard deviations of luck, and standard errors between keys

Curve = Mapping[str, Any]
"""Outliers of a map over its coverage.

``num``: number of pixels with a true depth. ``covered``: number of those with a depth.
``outliers``: number of outliers among the most certain 0, 0.5, … 100 % of the covered pixels.
"""


def curve(num_true: int, confidence: Float | Float32, outliers: Bool) -> Curve:
    """Return the curve of a map's outliers over its coverage.

    Pixels of equal confidence share their outliers evenly.

    ``num_true`` counts the pixels with a true depth. ``confidence`` and ``outliers`` (K,) are of
    those among them that also have a depth in the map.
    """
    _, rank, size = np.unique(-confidence, return_inverse=True, return_counts=True)
    outliers_of_rank = np.bincount(rank, outliers, len(size))
    ends = np.append(0, size.cumsum())
    sums = np.append(0, outliers_of_rank.cumsum())
    steps = np.interp(np.linspace(0, len(confidence), _NUM_STEPS + 1), ends, sums)
    return {"num": num_true, "covered": len(confidence), "outliers": np.round(steps, 2).tolist()}


def coverage(outliers: Curve) -> float:
    """Return the coverage in percent: the share of pixels with a true depth that have a depth."""
    return 100 * outliers["covered"] / max(outliers["num"], 1)


def outliers_at(outliers: Curve, covered_percent: float) -> float:
    """Return the percentage of outliers among the most certain pixels, up to this coverage."""
    num_kept = covered_percent / 100 * outliers["num"]
    steps = np.linspace(0, outliers["covered"], len(outliers["outliers"]))
    return float(100 * np.interp(num_kept, steps, outliers["outliers"]) / max(num_kept, 1))


def change(figure: str, before: Any, now: Any) -> dict[str, float]:
    """Return the changes of a figure (`Curve`, number or numbers of repeated draws), by name.

    A curve has two changes, in percent: of its outliers at equal coverage, and of its coverage.
    """
    if isinstance(before, Mapping):
        covered = min(coverage(before), coverage(now))
        more = outliers_at(now, covered) - outliers_at(before, covered)
        return {f"{figure} outliers": more, f"{figure} coverage": coverage(now) - coverage(before)}
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

    Both measurements map key -> figure -> value; ``luck`` maps key -> name of a `change` -> its
    standard deviation.
    """
    # Name of the change -> key -> before, now, change and its standard deviation by luck
    changes: dict[str, dict[str, tuple[float, ...]]] = defaultdict(dict)
    for key in [key for key in before if key in now]:
        for figure in [figure for figure in before[key] if figure in now[key]]:
            old, new = before[key][figure], now[key][figure]
            for name, difference in change(figure, old, new).items():
                sigma = luck.get(key, {}).get(name, 0.0)
                if isinstance(old, Sequence):  # the spread of repeated draws is their luck
                    sigma = float(np.hypot(np.std(old), np.std(new)) / math.sqrt(2 * len(old)))
                changes[name][key] = (_plain(name, old), _plain(name, new), difference, sigma)
    for name, change_of_key in changes.items():
        yield _verdict(name, change_of_key)


def _verdict(name: str, change_of_key: Mapping[str, tuple[float, ...]]) -> Verdict:
    """Return the verdict of a figure over its keys."""
    old, new, difference, sigma = np.array(list(change_of_key.values())).T
    loss = difference if _is_cost(name) else -difference
    num_keys = len(difference)
    error = float(difference.std(ddof=1) / math.sqrt(num_keys)) if num_keys > 1 else math.nan
    # Both measurements have luck.
    by_luck = float(np.sqrt(2 * (sigma**2).sum()) / num_keys)
    limit = _BEYOND * max(by_luck, 0.0 if math.isnan(error) else error)
    word = "no difference"
    if abs(difference.mean()) > limit:
        word = "worse" if loss.mean() > 0 else "better"
    worst = int(loss.argmax())
    return Verdict(
        figure=name,
        keys=list(change_of_key),
        before=float(old.mean()),
        now=float(new.mean()),
        change=float(difference.mean()),
        error=error,
        luck=by_luck,
        worst=(list(change_of_key)[worst], float(difference[worst])),
        word=word,
    )


def beyond_luck(
    before: Mapping[str, Any], now: Mapping[str, Any], luck: Mapping[str, float], sigmas: float
) -> dict[str, float]:
    """Return the changes, by name, of figures that worsened by more than ``sigmas`` deviations.

    Args:
        before: Name of the figure -> its value at one key sweep, in the first measurement.
        now: The same in the second measurement. A change is now minus before.
        luck: Name of a `change` -> its standard deviation by luck.
        sigmas: Limit, in standard deviations of the difference of two measurements.
    """
    worse = {}  # the difference of two measurements has √2 times the deviation of one
    for figure in before:
        for name, difference in change(figure, before[figure], now[figure]).items():
            loss = difference if _is_cost(name) else -difference
            if loss > sigmas * math.sqrt(2) * luck[name]:
                worse[name] = difference
    return worse


def _is_cost(name: str) -> bool:
    """Return True for a figure that is better if it is lower."""
    return not name.endswith(("coverage", "recall %"))


def _plain(name: str, value: Any) -> float:
    """Return a figure as a number: of a curve, its coverage or all its outliers in percent."""
    if isinstance(value, Mapping):
        covered = coverage(value)
        return covered if name.endswith("coverage") else outliers_at(value, covered)
    return float(np.mean(value))
