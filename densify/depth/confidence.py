# SPDX-License-Identifier: MIT
"""Compute confidence: the probability that a pixel is an outlier by KITTI's rule.

The stages of a map rank its pixels by the number of sweeps and points that agree, the distance to a
depth discontinuity, roughness, the distance of the fill, and the votes of the image. The
probability is a sum of two terms: a share for the rank, and a share in proportion to the
contradiction around the pixel. Both fall with the rank. They were measured against exact truth by
group of pixels: the origin of the depth, and the roughness around. ``examples/fit_confidence.py``
makes these tables, ``confidence.json`` beside this file.

The order of the ranks within a map stays, of measured and of filled pixels. Each rank gets the mean
probability of the map's own pixels at that rank, made to fall with the rank.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import isotonic_regression

from densify.config.file_content import read_json
from densify.depth.layers import Layers
from densify.depth.neighbours import extended
from densify.geometry.compiled import Kernel
from densify.geometry.types import Bool, Camera, DepthMap, Float, Float32, Ranked
from densify.scores.depth_metrics import (
    KITTI_BASELINE_M,
    OUTLIER_FRACTION,
    OUTLIER_PX,
    is_outlier_depth,
)

DECADES = 5.0
"""Confidence 1 is one wrong pixel in 10^5, each fifth less ten times as many."""
_RAGGED = np.array([0.1, 0.5])
GROUPS = tuple(
    f"{how}, rough from {ragged:g}"
    for how in ("window", "beyond", "filled")
    for ragged in (0, *_RAGGED)
)
"""How pixels came to their depth, and the share of what is measured around that is at edges."""
CAUSES = ("anyway", "contradicted")
"""Shares that are wrong: anyway, and for each whole by which a place is contradicted."""
NUM_RANKS = 200
NUM_MEASURED = sum(not group.startswith("filled") for group in GROUPS)
"""Groups of measured pixels; the others are of filled ones."""

_FILE = Path(__file__).with_name("confidence.json")
_AROUND = 4.0  # size of the surroundings, in gaps between rays to all sides
_TILT = 0.01  # decades over all ranks, for different confidences at different ranks
_NUM_STEPS = 20
_GIVEN = 2.0  # number of pixels around that are assumed to agree, as a prior


def contradicted(layers: Layers, focal_px: float) -> Float32:
    """Return (H,W) the share of the measured pixels around that contradict a filled pixel.

    A measured pixel contradicts if its surface would make the filled one an outlier. The
    surroundings are a gap between rays to all sides. Boundary pixels count too. Closed car windows
    have no contradiction, because the background may be measured through them.
    """
    measured_m = np.maximum(layers.depth_m, layers.rim_m)
    inverse, known = (
        np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        for depth_m in (layers.filled_m, measured_m)
    )
    pixel = np.flatnonzero(layers.filled_m)
    share = np.zeros_like(layers.filled_m)
    half_px = max(2, round(float(np.median(layers.gap_px))))
    apart = OUTLIER_PX / (focal_px * KITTI_BASELINE_M)
    _contradicted.over_rows(len(pixel), pixel, inverse, known, layers.tilt, half_px, apart, share)
    if layers.solid is not None:
        share[layers.solid] = 0
    return share


@Kernel
def _contradicted(first, last, pixel, inverse, known, tilt, half_px, apart, share):  # type: ignore[no-untyped-def]
    """Fill ``share`` (H,W) float32 for each ``pixel`` (P,).

    inverse and known: (H,W) float32, 1/m, of the pixels and of those around, 0 none. half_px: size
    of the surroundings, of which up to 11 pixels across are compared. apart: inverse depth, 1/m.
    """
    height, width = known.shape
    step = max(1, -(-half_px // 5))
    half_px = half_px // step * step
    for i in range(first, last):
        v, u = pixel[i] // width, pixel[i] % width
        here = inverse[v, u]
        least = max(apart, OUTLIER_FRACTION * here)
        num = against = 0
        for dv in range(-half_px, half_px + 1, step):
            row = v + dv
            if row < 0 or row >= height:
                continue
            for du in range(-half_px, half_px + 1, step):
                column = u + du
                if column < 0 or column >= width or (du == 0 and dv == 0):
                    continue
                if known[row, column] > 0:
                    num += 1
                    against += abs(extended(known, tilt, row, column, du, dv) - here) > least
        share[v, u] = against / (num + _GIVEN)


def rank_pixels(layers: Layers, far: Bool, contradicted: Float32) -> Ranked:
    """Return the rank and the group of a map's pixels, and the contradiction around them.

    Contradiction and roughness are means over four gaps between rays to all sides.

    Args:
        far: (H,W) measured by sweeps beyond the window.
        contradicted: (H,W), see `contradicted`.
    """
    rim, measured = layers.rim_m > 0, (layers.depth_m > 0) | (layers.rim_m > 0)
    shown = layers.filled_m > 0
    size = 2 * max(2, round(_AROUND * float(np.median(layers.gap_px)))) + 1

    def mean(values: Float32 | Bool, of: Bool) -> Float32:
        """Return (H,W) means over the pixels ``of`` around."""
        sums, num = (
            ndimage.uniform_filter(part.astype(np.float32), size, mode="constant")
            for part in (np.where(of, values, 0), of)
        )
        return np.clip(sums / np.maximum(num, np.float32(1 / size**2)), 0, 1)

    how = np.where(layers.depth_m > 0, far.astype(np.uint8), np.uint8(2))
    ragged = np.searchsorted(_RAGGED, mean(rim, measured), side="right")
    group = np.where(shown, how * (len(_RAGGED) + 1) + ragged, 0).astype(np.uint8)
    rank = np.where(shown, np.clip(layers.confidence, 0, 1), np.float32(0))
    return Ranked(rank, group, np.where(shown, mean(contradicted, shown), np.float32(0)))


def calibrated(found: Ranked, shown: Bool, tables: Float | None = None) -> Float32:
    """Return (H,W) confidence, ``-log10(P) / 5`` with the probability P of an outlier.

    Args:
        shown: (H,W) pixels with a confidence; 0 elsewhere.
        tables: (G,2,R) by group, term and step of the rank; None for the package's own.
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
    """Return the step of each rank."""
    return np.minimum((rank * NUM_RANKS).astype(np.int64), NUM_RANKS - 1)


def amounts(found: Ranked, of: Bool) -> Float:
    """Return (G,2,R) by group and step of the rank: the number of pixels, and their contradiction.

    The product with a table is the expected number of outliers.

    Args:
        of: (H,W) the pixels that count.
    """
    place = found.group[of].astype(np.int64) * NUM_RANKS + steps_of(found.rank[of])
    size = len(GROUPS) * NUM_RANKS
    sums = [np.bincount(place, weights, size) for weights in (None, found.contradicted[of])]
    return np.stack([s.reshape(len(GROUPS), NUM_RANKS) for s in sums], axis=1).astype(np.float64)


def curves(pixels: Float, tables: Float) -> Float:
    """Return (2,R) log10 of the probability of an outlier, by step of the rank.

    The rows are for measured and for filled pixels.

    Args:
        pixels: (G,2,R) of `amounts`.
        tables: (G,2,R).
    """
    num = pixels[:, 0]
    wrong_num = np.minimum((pixels * tables).sum(axis=1), num)
    shares = [
        falling(num[part].sum(axis=0), wrong_num[part].sum(axis=0))
        for part in (slice(NUM_MEASURED), slice(NUM_MEASURED, None))
    ]
    return np.log10(np.clip(shares, 10.0 ** (_TILT - DECADES), 1))


def falling(num: Float, wrong_num: Float) -> Float:
    """Return (R,) ``wrong_num / num``, made to fall with the rank by isotonic regression.

    Steps without pixels are between their neighbours.
    """
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
    """Return the package's own tables, written by examples/fit_confidence.py."""
    return read_json(_FILE)


def tables_of(written: dict[str, Any]) -> Float:
    """Return (G,2,R) the share of outliers, from the content of such a file."""
    middle = (np.arange(NUM_RANKS) + 0.5) / NUM_RANKS
    knots = [[np.array(written["tables"][g][c]).T for c in CAUSES] for g in GROUPS]
    return np.array([[np.interp(middle, *ends) for ends in row] for row in knots])


def wrong(confidence: Float | Float32) -> Float:
    """Return the probability of an outlier at a confidence."""
    probability: Float = 10.0 ** (-DECADES * np.asarray(confidence, np.float64))
    return probability


def without_times(maps: DepthMap, smear_m: float, camera: Camera, share: float = 1.0) -> DepthMap:
    """Return a map of sweeps without times of points, less confident where it is near.

    The motion within these sweeps moves a depth by an unknown amount, any up to ``smear_m`` either
    way. Near pixels tolerate less of it than far ones.

    Args:
        smear_m: Half the way along the camera's axis from sweep to sweep.
        share: Share of the sweeps that have no times.
    """
    depth_m, shown = maps.filled_m.astype(np.float64), maps.filled_m > 0
    px_m = depth_m**2 / (camera.focal_px * KITTI_BASELINE_M)
    tolerated_m = np.maximum(OUTLIER_PX * px_m, OUTLIER_FRACTION * depth_m)
    smeared = share * np.clip(1 - tolerated_m / max(smear_m, 1e-9), 0, 1)
    either = 1 - (1 - wrong(maps.confidence)) * (1 - smeared)
    confidence = np.clip(-np.log10(np.maximum(either, 10.0**-DECADES)) / DECADES, 0, 1)
    return replace(maps, confidence=np.where(shown, confidence, 0).astype(np.float32))


def expected_outliers(maps: DepthMap) -> dict[str, float | None]:
    """Return the expected share of outliers of the ``measured`` and the ``filled`` map."""
    shares: dict[str, float | None] = {}
    for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
        some = depth_m > 0
        shares[name] = float(wrong(maps.confidence[some]).mean()) if some.any() else None
    return shares


def reliability(maps: DepthMap, truth_m: Float32, camera: Camera) -> list[dict[str, Any]]:
    """Return expected and true outliers by confidence, over the filled pixels with a truth.

    Each step of 0.05 with pixels has ``confidence`` (its begin), ``num_compared``, the ``expected``
    share of outliers, and the true ``outliers``.

    Args:
        truth_m: (H,W) metres, 0 none.
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
