# SPDX-License-Identifier: MIT
"""Compute the confidence of pixels: the probability that a pixel is an outlier by KITTI's rule.

The stages of a map rank its pixels. The rank rises with the number of sweeps and points that agree,
the distance to a depth discontinuity and the votes of the image. It falls with roughness and with
the distance over which a pixel is filled.

The probability of an outlier is a sum of two terms: a share for the rank, and a share times the
contradiction by measured pixels around. Both fall with the rank. Both were measured against exact
ground truth for each group of pixels, by the origin of the depth and the roughness around.
``examples/fit_confidence.py`` writes these tables to ``confidence.json`` beside this file.

Within the measured and within the filled pixels of a map, confidence keeps the order of the ranks.
Each rank gets the mean probability of the map's own pixels at that rank, made to fall with the
rank.
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
"""Confidence 1 means one outlier in 10^5 pixels; each 0.2 less means ten times as many."""
_RAGGED = np.array([0.1, 0.5])
GROUPS = tuple(
    f"{how}, rough from {ragged:g}"
    for how in ("window", "beyond", "filled")
    for ragged in (0, *_RAGGED)
)
"""Origin of a pixel's depth, and share of boundary pixels among the measured pixels around."""
CAUSES = ("anyway", "contradicted")
"""Terms of the share of outliers: without contradiction, and per unit of contradiction."""
NUM_RANKS = 200
NUM_MEASURED = sum(not group.startswith("filled") for group in GROUPS)
"""Number of groups of measured pixels; the other groups are of filled pixels."""

_FILE = Path(__file__).with_name("confidence.json")
_AROUND = 4.0  # half size of the surroundings, in spacings of neighbouring rays
_TILT = 0.01  # decades from rank 0 to 1, so that different ranks have different confidences
_NUM_STEPS = 20
_GIVEN = 2.0  # number of agreeing pixels around that is assumed, as a prior


def contradicted(layers: Layers, focal_px: float) -> Float32:
    """Return the (H,W) share of the measured pixels around that contradict a pixel's depth.

    A measured pixel contradicts if its surface, extended to the pixel, would make the pixel an
    outlier by KITTI's rule. Measured pixels within one spacing of rays count, boundary pixels too.
    The share is 0 in closed car windows, because the background may be measured through them.
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
    """Fill ``share`` (H,W) float32 at each flat index in ``pixel`` (P,).

    inverse and known: (H,W) inverse depth of the filled and of the measured map, 1/m, 0 none.
    half_px: half size of the surroundings; up to 11 by 11 pixels are compared. apart: inverse depth
    that is 3 px of disparity, 1/m.
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
    """Return the rank, the group and the contradiction of each pixel of a map.

    Contradiction and roughness are means within four spacings of rays to all sides.

    Args:
        far: (H,W) True at pixels measured by sweeps beyond the window.
        contradicted: (H,W) share of contradicting pixels, see `contradicted`.
    """
    rim, measured = layers.rim_m > 0, (layers.depth_m > 0) | (layers.rim_m > 0)
    shown = layers.filled_m > 0
    size = 2 * max(2, round(_AROUND * float(np.median(layers.gap_px)))) + 1

    def mean(values: Float32 | Bool, of: Bool) -> Float32:
        """Return the (H,W) mean of the values over the surrounding pixels where ``of`` is True."""
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
    """Return the (H,W) confidence ``-log10(P) / 5`` with the probability P of an outlier.

    Args:
        found: Rank, group and contradiction of each pixel, from `rank_pixels`.
        shown: (H,W) True at pixels with a depth; the confidence is 0 elsewhere.
        tables: (G,2,R) share of outliers by group (`GROUPS`), term (`CAUSES`) and step of the rank;
            None for the package's own.
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
    """Return the index of the step of each rank (0 to 1), among R = `NUM_RANKS` equal steps."""
    return np.minimum((rank * NUM_RANKS).astype(np.int64), NUM_RANKS - 1)


def amounts(found: Ranked, of: Bool) -> Float:
    """Return (G,2,R) by group and step of the rank: the number of pixels, and their contradiction.

    The product with a table of `calibrated` is the expected number of outliers.

    Args:
        found: Rank, group and contradiction of each pixel.
        of: (H,W) True at pixels that count.
    """
    place = found.group[of].astype(np.int64) * NUM_RANKS + steps_of(found.rank[of])
    size = len(GROUPS) * NUM_RANKS
    sums = [np.bincount(place, weights, size) for weights in (None, found.contradicted[of])]
    return np.stack([s.reshape(len(GROUPS), NUM_RANKS) for s in sums], axis=1).astype(np.float64)


def curves(pixels: Float, tables: Float) -> Float:
    """Return (2,R) log10 of the probability of an outlier by step of the rank.

    The rows are for measured and for filled pixels.

    Args:
        pixels: (G,2,R) sums of `amounts`.
        tables: (G,2,R) shares of outliers.
    """
    num = pixels[:, 0]
    wrong_num = np.minimum((pixels * tables).sum(axis=1), num)
    shares = [
        falling(num[part].sum(axis=0), wrong_num[part].sum(axis=0))
        for part in (slice(NUM_MEASURED), slice(NUM_MEASURED, None))
    ]
    return np.log10(np.clip(shares, 10.0 ** (_TILT - DECADES), 1))


def falling(num: Float, wrong_num: Float) -> Float:
    """Return the (R,) ratio ``wrong_num / num``, made to fall with the rank by isotonic regression.

    Steps without pixels are interpolated. num and wrong_num: (R,) pixels, outliers among them.
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
    """Return the content of the package's tables, written by examples/fit_confidence.py."""
    return read_json(_FILE)


def tables_of(written: dict[str, Any]) -> Float:
    """Return the (G,2,R) share of outliers from the content of a file as `own_file` returns."""
    middle = (np.arange(NUM_RANKS) + 0.5) / NUM_RANKS
    knots = [[np.array(written["tables"][g][c]).T for c in CAUSES] for g in GROUPS]
    return np.array([[np.interp(middle, *ends) for ends in row] for row in knots])


def wrong(confidence: Float | Float32) -> Float:
    """Return the probability of an outlier at each confidence, in the shape of the argument."""
    probability: Float = 10.0 ** (-DECADES * np.asarray(confidence, np.float64))
    return probability


def without_times(maps: DepthMap, smear_m: float, camera: Camera, share: float = 1.0) -> DepthMap:
    """Return the map with lower confidence at near pixels, for sweeps without times of points.

    The vehicle's motion within such a sweep moves depths by an unknown amount up to ``smear_m`` in
    either direction. Near pixels tolerate less of it than far pixels.

    Args:
        smear_m: Half the travel in metres along the camera's axis from sweep to sweep.
        share: Share of the sweeps without times.
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
    """Return expected and true outliers by confidence, over the filled pixels with ground truth.

    Each interval of 0.05 with pixels has ``confidence`` (its start), ``num_compared`` pixels, and
    the ``expected`` and the true share of ``outliers``.

    Args:
        truth_m: (H,W) true depth in metres, 0 none.
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
