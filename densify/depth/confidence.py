# SPDX-License-Identifier: MIT
"""What a confidence means: the probability that a pixel's depth is right.

A map's stages rank its pixels: by sweeps and points that agree, nearness of an edge, roughness, how
far was filled, votes of the image. What a rank is worth depends on where it is had. KITTI's rule
forgives 0.4 m at 7 m and 3 m at 20 m: what is right among the leaves of a hedge far away is wrong
among the same leaves close by, and on a road neither. So the probability of a wrong depth is
taken as a sum of two: a share that pixels of this rank have anyway, and one in proportion to how
far the surroundings contradict each other by that same rule (`densify.depth.agreement`): as if some
of the pixels had the depth of a neighbour. Both fall with the rank, and were measured, where the
truth is exact, by group: how a pixel came to its depth (measured within the window, beyond it, or
filled), and how ragged its surroundings are, the share of what is measured around it that lies at
depth edges. ``densify bench confidence`` makes these tables, ``confidence.json`` beside this file,
and says how far they hold elsewhere.

Within a map the order of the ranks stays, of pixels measured and of pixels filled: each rank gets
the mean probability of the map's own pixels at that rank, made to fall with the rank.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import isotonic_regression

from densify.config.file_content import read_json
from densify.depth.layers import Layers
from densify.geometry.types import Bool, Camera, DepthMap, Float, Float32, Ranked
from densify.scores.depth_metrics import is_outlier_depth

DECADES = 5.0
"""Confidence 1 is one wrong pixel in 10^5, each fifth less ten times as many."""
GROUPS = tuple(
    f"{how}, rough from {ragged:g}"
    for how in ("window", "beyond", "filled")
    for ragged in (0, 0.1, 0.5)
)
"""How pixels came to their depth, and the share of what is measured around that is at edges."""
CAUSES = ("anyway", "contradicted")
"""Shares that are wrong: anyway, and for each whole by which a place is contradicted."""
NUM_RANKS = 200

_FILE = Path(__file__).with_name("confidence.json")
_RAGGED = np.array([0.1, 0.5])
_NUM_RAGGED = len(_RAGGED) + 1
NUM_MEASURED = 2 * _NUM_RAGGED
"""Groups of measured pixels; those behind are of filled ones."""
_AROUND = 4.0  # gaps between rays to all sides
_TILT = 0.01  # decades over all ranks: pixels of different rank keep a different confidence
_NUM_STEPS = 20


def ranked(layers: Layers, far: Bool, contradicted: Float32) -> Ranked:
    """What the confidence of a map's pixels is made from. far: (H,W) measured by sweeps beyond the
    window. contradicted: (H,W) of the filled map's pixels, see `densify.depth.agreement`. It and
    raggedness are means over four gaps between rays to all sides."""
    rim, measured = layers.rim_m > 0, (layers.depth_m > 0) | (layers.rim_m > 0)
    shown = layers.filled_m > 0
    size = 2 * max(2, round(_AROUND * float(np.median(layers.gap_px)))) + 1

    def mean(values: Float32 | Bool, of: Bool) -> Float32:
        """(H,W) over the pixels ``of`` around."""
        sums, num = (
            ndimage.uniform_filter(part.astype(np.float32), size, mode="constant")
            for part in (np.where(of, values, 0), of)
        )
        return np.clip(sums / np.maximum(num, np.float32(1 / size**2)), 0, 1)

    how = np.where(layers.depth_m > 0, far.astype(np.uint8), np.uint8(2))
    ragged = np.searchsorted(_RAGGED, mean(rim, measured), side="right")
    group = np.where(shown, how * _NUM_RAGGED + ragged, 0).astype(np.uint8)
    rank = np.where(shown, np.clip(layers.confidence, 0, 1), np.float32(0))
    return Ranked(rank, group, np.where(shown, mean(contradicted, shown), np.float32(0)))


def calibrated(found: Ranked, shown: Bool, tables: Float | None = None) -> Float32:
    """(H,W) confidence, 0 to 1, 0 where nothing is ``shown`` (H,W): ``-log10(P) / 5`` with the
    probability P that a depth is wrong by KITTI's rule, see
    `densify.scores.depth_metrics.DepthErrors`.

    tables: (G,2,R) by group, cause and step of the rank, else the package's own.
    """
    rank, group = found.rank[shown], found.group[shown]
    log_wrong = curves(amounts(found, shown), _own_tables() if tables is None else tables)
    place = rank.astype(np.float64) * NUM_RANKS - 0.5
    steps = np.arange(NUM_RANKS)
    measured, filled = (np.interp(place, steps, curve) for curve in log_wrong)
    confidence = np.zeros(shown.shape, np.float32)
    log = np.where(group < NUM_MEASURED, measured, filled) + _TILT * (0.5 - rank)
    confidence[shown] = np.clip(-log / DECADES, 0, 1)
    return confidence


def steps_of(rank: Float32) -> NDArray[np.int64]:
    """The step that each rank falls into."""
    return np.minimum((rank * NUM_RANKS).astype(np.int64), NUM_RANKS - 1)


def amounts(found: Ranked, of: Bool) -> Float:
    """(G,2,R) by group and step of the rank: how many of the pixels ``of`` (H,W) there are, and by
    how much they are contradicted together. Times a table it is how many are wrong."""
    place = found.group[of].astype(np.int64) * NUM_RANKS + steps_of(found.rank[of])
    size = len(GROUPS) * NUM_RANKS
    sums = [np.bincount(place, weights, size) for weights in (None, found.contradicted[of])]
    return np.stack([s.reshape(len(GROUPS), NUM_RANKS) for s in sums], axis=1).astype(np.float64)


def curves(pixels: Float, tables: Float) -> Float:
    """(2,R) log10 of the probability that a pixel is wrong by step of the rank, of those measured
    and of those filled, in a map with ``pixels`` (G,2,R), `amounts`. tables: (G,2,R)."""
    num = pixels[:, 0]
    wrong_num = np.minimum((pixels * tables).sum(axis=1), num)
    shares = [
        falling(num[part].sum(axis=0), wrong_num[part].sum(axis=0))
        for part in (slice(NUM_MEASURED), slice(NUM_MEASURED, None))
    ]
    return np.log10(np.clip(shares, 10.0 ** (_TILT - DECADES), 1))


def falling(num: Float, wrong_num: Float) -> Float:
    """(R,) ``wrong_num`` over ``num``, (R,) pixels, made to fall with the rank (isotonic
    regression); steps without any lie between their neighbours, 0 where no step has any."""
    some = num > 0
    if not some.any():
        return np.zeros(len(num))
    share = isotonic_regression(wrong_num[some] / num[some], weights=num[some], increasing=False).x
    steps = np.arange(len(num))
    between: Float = np.interp(steps, steps[some], share)
    return between


@cache
def _own_tables() -> Float:
    return tables_of(own_file())


def own_file() -> dict[str, Any]:
    """The package's own tables, as `densify.bench.confidence` wrote them."""
    return read_json(_FILE)


def tables_of(written: dict[str, Any]) -> Float:
    """(G,2,R) share that is wrong, from what `densify.bench.confidence` wrote."""
    middle = (np.arange(NUM_RANKS) + 0.5) / NUM_RANKS
    knots = [[np.array(written["tables"][g][c]).T for c in CAUSES] for g in GROUPS]
    return np.array([[np.interp(middle, *ends) for ends in row] for row in knots])


def wrong(confidence: Float | Float32) -> Float:
    """Confidence -> the probability that a depth is wrong, as `calibrated` has it."""
    probability: Float = 10.0 ** (-DECADES * np.asarray(confidence, np.float64))
    return probability


def expected_outliers(maps: DepthMap) -> dict[str, float | None]:
    """The expected share of wrong pixels of the ``measured`` and the ``filled`` map; None of a map
    without any."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
        some = depth_m > 0
        shares[name] = float(wrong(maps.confidence[some]).mean()) if some.any() else None
    return shares


def reliability(maps: DepthMap, truth_m: Float32, camera: Camera) -> list[dict[str, Any]]:
    """How far confidence keeps what it promises, over the pixels of ``filled_m`` with a truth.

    truth_m: (H,W) metres, 0 none. By confidence, in steps of 0.05: ``confidence`` where the step
    begins, ``num_compared`` pixels, the share of them ``expected`` to be wrong, and the share that
    is (``outliers``). Steps without a pixel are left out.
    """
    compared = (truth_m > 0) & (maps.filled_m > 0)
    confidence = maps.confidence[compared]
    bad = is_outlier_depth(maps.filled_m[compared], truth_m[compared], camera.focal_px)
    step = np.minimum((confidence * _NUM_STEPS).astype(np.int64), _NUM_STEPS - 1)
    num = np.bincount(step, minlength=_NUM_STEPS)
    expected = np.bincount(step, wrong(confidence), _NUM_STEPS)
    found = np.bincount(step, bad, _NUM_STEPS)
    return [
        {
            "confidence": i / _NUM_STEPS,
            "num_compared": int(num[i]),
            "expected": float(expected[i] / num[i]),
            "outliers": float(found[i] / num[i]),
        }
        for i in np.flatnonzero(num).tolist()
    ]
