# SPDX-License-Identifier: MIT
"""Complete depth from a depth image of the user (the prior), such as one of a monocular network.

A robust curve converts the prior to metres. The remaining error is corrected by a membrane in log
depth, tied to the known pixels and torn at the prior's own depth discontinuities (random walks,
Grady, "Random walks for image segmentation", PAMI 2006).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage, optimize, sparse
from scipy.sparse import linalg

from densify.geometry.types import Bool, DepthMap, Float, Float32, FullDepth, Int, Prior, PriorFit

FAR_M = 120.0
"""Depth beyond which pixels of a prior count as sky."""
MAX_WRONG = 0.2
"""Greatest share of measured pixels, each step of depth counted alike, at which the best fit of a
used prior is off by more than 25 %. Good priors had up to 0.11, priors of other images 0.25 to
0.6."""
_FORMS = {"auto": ("depth", "log", "inverse"), "depth": ("depth", "log"), "inverse": ("inverse",)}
_MIN_FITTED = 100  # least number of measured pixels for a fit
_WRONG = np.log(1.25)  # least error of a wrong pixel, in the logarithm of depth
_MOST_CONFIDENCE = 0.2  # greatest confidence of a pixel of the prior
# Usual error of a prior in the logarithm of depth. A step of more than twice is an edge.
_USUAL = 0.05
_MAX_CELLS = 40_000  # about the greatest number of cells, limits the time of the sparse solver
_SMOOTHNESS = 10.0  # weight of equal corrections, relative to 1 for a cell with all pixels known
_TOWARDS_NONE = 0.002  # pull to no correction and the mean error, far from known pixels
_NEIGHBOURHOOD = np.ones((5, 5), np.uint8)
_EMPTY = 2 * np.log(FAR_M)  # logarithm of a depth beyond all others


def complete(depth_map: DepthMap, prior: Prior, kind: str = "auto") -> FullDepth:
    """Return the depth map with pixels of the prior where the map has no depth.

    A pixel stays empty if the prior has no value, shows sky by the mask, or is beyond 120 m or at
    the prior's far limit. Pixels on the blurred transition between two surfaces stay empty too. A
    prior that does not fit is not used. Confidences are a ranking. A pixel of the prior has at most
    0.2, less where the prior is steep or deviates from known pixels nearby. Known pixels have more.

    Args:
        depth_map: The map to complete.
        prior: Depth image of the user, of the map's shape and measure of depth.
        kind: Meaning of the prior's values: ``depth``, ``inverse`` (depth) or ``auto``.
    """
    has_value = (prior.value > 0) & ~prior.sky
    has_depth = depth_map.filled_m > 0
    known_confidence = _MOST_CONFIDENCE + (1 - _MOST_CONFIDENCE) * depth_map.confidence
    confidence = np.where(has_depth, known_confidence, 0).astype(np.float32)
    measured = has_value & (depth_map.depth_m > 0)
    fit = fit_prior(prior.value[measured], depth_map.depth_m[measured], kind)
    if not fit.used:
        no_pixels = np.zeros(has_value.shape, bool)
        return FullDepth(depth_map.filled_m, confidence, no_pixels, fit, prior.source)

    # The farthest value is often that of the sky.
    log_depth = _log_depth(prior.value, fit)
    values = prior.value[has_value]
    farthest = values.min() if fit.kind == "inverse" else values.max()
    usable = has_value & (log_depth < np.log(FAR_M)) & (prior.value != farthest)

    # Steps of the prior's smoothed logarithm of depth to the farthest and nearest pixel around
    guide = np.where(usable, log_depth, _EMPTY).astype(np.float32)
    guide = cv2.medianBlur(guide, 5).astype(np.float32)
    farther = cv2.dilate(guide, _NEIGHBOURHOOD) - guide
    nearer = guide - cv2.erode(guide, _NEIGHBOURHOOD)
    steepness = farther + nearer

    correction, remaining = _correction(depth_map.filled_m, log_depth, guide, steepness, usable)
    full_m = np.exp(np.minimum(log_depth + correction, _EMPTY)).astype(np.float32)
    # A pixel far from both surfaces is on the blurred transition between them.
    usable &= (np.minimum(farther, nearer) < 2 * _USUAL) & (full_m < FAR_M)
    from_prior = usable & (depth_map.filled_m == 0)
    error = np.hypot(remaining, steepness) / _USUAL
    return FullDepth(
        np.where(from_prior, full_m, depth_map.filled_m),
        np.where(from_prior, _MOST_CONFIDENCE / (1 + error), confidence).astype(np.float32),
        from_prior,
        fit,
        prior.source,
    )


def fit_prior(value: Float32, depth_m: Float32, kind: str) -> PriorFit:
    """Return the curve with the least residual from values of a prior to depths.

    Values (N,) and depths (N,) are above 0. A curve that turns near into far is rejected. ``kind``
    is ``depth``, ``inverse`` (depth) or ``auto``.
    """
    p, z = value.astype(np.float64), depth_m.astype(np.float64)
    fits = [_fit_form(form, p, z) for form in _FORMS[kind]]
    return min(fits, key=lambda fit: (not fit.scale > 0, fit.residual))


def _fit_form(form: str, p: Float, z: Float) -> PriorFit:
    """Return one form of curve fitted to values p (N,) and depths z (N,), m."""
    if len(z) < _MIN_FITTED:
        return PriorFit(form, 0.0, 0.0, np.inf, 1.0, False)
    # Pixels of a step have about equal depth. The curve goes through the medians of the steps,
    # which tolerate outliers.
    step = np.floor(np.log(z / z.min()) / _USUAL).astype(np.int64)
    num_pixels = np.bincount(step)
    steps = np.flatnonzero(num_pixels)
    median_p = ndimage.median(p, step, steps)
    median_z = ndimage.median(z, step, steps)
    scale, shift = _fit_curve(form, median_p, median_z)

    curve = PriorFit(form, scale, shift, np.inf, 1.0, False)
    deviation = np.abs(_log_depth(p, curve) - np.log(z))
    # Most pixels are near. The pixels of a step together therefore weigh the root of their number.
    weight = 1 / np.sqrt(num_pixels)[step]
    residual = float(np.average(np.minimum(deviation, _WRONG), weights=weight))
    wrong_share = float(np.average(deviation > _WRONG, weights=weight))
    used = scale > 0 and wrong_share <= MAX_WRONG
    return PriorFit(form, scale, shift, residual, wrong_share, used)


def _fit_curve(form: str, p: Float, z: Float) -> tuple[float, float]:
    """Return scale and shift of one form of curve through values p (N,) and depths z (N,), m."""
    # z = scale · p + shift, 1 / z = scale · p + shift, or log z = scale · log p + shift.
    # Values are divided by their median, so that both unknowns are of similar size.
    unit = float(np.median(p))
    ones = np.ones(len(z))
    if form == "log":
        columns = [np.log(p / unit), ones]
        target = np.log(z)
    else:
        # The weights make residuals close to residuals of the logarithm of depth.
        weight = z if form == "inverse" else 1 / z
        columns = [p / unit * weight, weight]
        target = ones
    A = np.stack(columns, axis=1)

    def residual(scale_shift: Float) -> Float:
        return A @ scale_shift - target

    start = np.linalg.lstsq(A, target, rcond=None)[0]
    solution = optimize.least_squares(residual, start, loss="soft_l1", f_scale=_USUAL)
    scale, shift = (float(number) for number in solution.x)
    # Scale and shift for values that are not divided by their median
    if form == "log":
        return scale, shift - scale * np.log(unit)
    return scale / unit, shift


def _log_depth(value: Float | Float32, fit: PriorFit) -> Float:
    """Return the logarithm of depth in metres by the curve. Depths are kept above 0."""
    value = value.astype(np.float64)
    if fit.kind == "log":
        return fit.scale * np.log(np.maximum(value, np.finfo(np.float64).tiny)) + fit.shift
    logarithm = np.log(np.maximum(fit.scale * value + fit.shift, np.exp(-_EMPTY)))
    return -logarithm if fit.kind == "inverse" else logarithm


class _Cells(NamedTuple):
    """The image in square cells of ``size`` pixels, R rows and C columns."""

    size: int  # side of a cell in px
    guide: Float  # (R,C) logarithm of depth at the central pixel of each cell
    number: Int  # (H,W) number of each pixel's cell, row by row

    @staticmethod
    def over(guide: Float32) -> _Cells:
        """Return up to 40,000 cells that cover the image ``guide`` (H,W), logarithm of depth."""
        size = max(1, int(np.ceil(np.sqrt(guide.size / _MAX_CELLS))))
        rows, columns = (  # of the central pixels of the cells
            np.minimum(np.arange(0, length, size) + size // 2, length - 1) for length in guide.shape
        )
        row, column = (np.arange(length) // size for length in guide.shape)
        number = row[:, None] * len(columns) + column
        return _Cells(size, guide[np.ix_(rows, columns)].astype(np.float64), number)

    def membrane(self) -> sparse.csr_array:
        """Return the matrix L (RC,RC): x' L x sums squared differences between neighbours in x."""
        cell = np.arange(self.guide.size).reshape(self.guide.shape)
        cell_a = np.concatenate([cell[:, :-1].ravel(), cell[:-1].ravel()])
        cell_b = np.concatenate([cell[:, 1:].ravel(), cell[1:].ravel()])  # right of a, or below
        step = (self.guide.ravel()[cell_a] - self.guide.ravel()[cell_b]) / _USUAL
        tie = _SMOOTHNESS * np.exp(-(step**2))  # less, the more the guides of both cells differ
        half = sparse.coo_array((tie, (cell_a, cell_b)), shape=(cell.size, cell.size))
        weights = (half + half.T).tocsr()
        return sparse.diags_array(weights.sum(axis=1)) - weights

    def at_pixels(self, values: Float, guide: Float32) -> Float:
        """Return the cells' values (K,RC) at pixels (K,H,W), interpolated between four cells."""
        grid = values.reshape(-1, *self.guide.shape)
        # Positions of the image's rows and columns, in cells from the centre of the first
        down, right = ((np.arange(length) - self.size // 2) / self.size for length in guide.shape)
        weight_sum = np.zeros(guide.shape)
        value_sum = np.zeros((len(grid), *guide.shape))
        for row, row_weight in _cells_beside(down, self.guide.shape[0]):
            for column, column_weight in _cells_beside(right, self.guide.shape[1]):
                # Cells on another surface, by their guide, hardly count.
                difference = (guide - self.guide[np.ix_(row, column)]) / _USUAL
                similarity = np.exp(-(difference**2)) + np.finfo(float).eps
                weight = similarity * np.outer(row_weight, column_weight)
                weight_sum += weight
                value_sum += weight * grid[:, row[:, None], column]
        return value_sum / weight_sum


def _cells_beside(position: Float, num_cells: int) -> list[tuple[Int, Float]]:
    """Return the cells before fractional positions and those after, each with their weights."""
    before = np.clip(np.floor(position), 0, num_cells - 1).astype(np.int64)
    after = np.minimum(before + 1, num_cells - 1)
    share = np.clip(position - before, 0, 1)
    return [(before, 1 - share), (after, share)]


def _correction(
    filled_m: Float32, log_depth: Float, guide: Float32, steepness: Float32, usable: Bool
) -> tuple[Float, Float]:
    """Return the correction (H,W) of the prior's log depth, and the remaining error (H,W)."""
    cells = _Cells.over(guide)
    area, num_cells = cells.size**2, cells.guide.size
    # Known pixels pull their cell, unless they are on another surface than the cell's centre.
    centre_guide = cells.guide.ravel()[cells.number]
    pulls = usable & (filled_m > 0) & (np.abs(guide - centre_guide) < _USUAL)
    cell = cells.number[pulls]
    deviation = np.log(filled_m[pulls].astype(np.float64)) - log_depth[pulls]
    membrane = cells.membrane()

    def solve_membrane(weight: Float, values: Float, elsewhere: float) -> Float:
        """Return the (RC,) membrane pulled to N values, and to ``elsewhere`` far from them."""
        diagonal = np.bincount(cell, weight, num_cells) / area + _TOWARDS_NONE
        pull = np.bincount(cell, weight * values, num_cells) / area + _TOWARDS_NONE * elsewhere
        system = (membrane + sparse.diags_array(diagonal)).tocsc()
        return linalg.spsolve(system, pull, permc_spec="MMD_AT_PLUS_A")

    # A steep prior may be blurred. Differences there have little weight.
    flatness_weight = _robust_weight(steepness[pulls])
    mean_error = np.average(np.abs(deviation), weights=flatness_weight) if len(deviation) else 0.0
    # Pixels that deviate from a first solution are outliers.
    draft = solve_membrane(flatness_weight, deviation, 0.0)
    weight = flatness_weight * _robust_weight(deviation - draft[cell])
    correction = solve_membrane(weight, deviation, 0.0)
    # The mean error of known pixels nearby on the same surface, far from them of the whole image
    remaining = solve_membrane(weight, np.abs(deviation - correction[cell]), mean_error)
    correction, remaining = cells.at_pixels(np.stack([correction, remaining]), guide)
    return correction, remaining


def _robust_weight(deviation: Float | Float32) -> Float:
    """Return the weights (N,) of pixels by their deviations (N,) in the logarithm of depth."""
    return 1 / (1 + (deviation.astype(np.float64) / (2 * _USUAL)) ** 2)
