# SPDX-License-Identifier: MIT
"""Complete depth from a depth image of the user (the prior), such as one of a monocular network.

A robust curve converts the values of the prior to metres. The remaining error differs over the
image. It is corrected by a membrane in the logarithm of depth, tied to the known pixels and torn at
the prior's own depth discontinuities (random walks, Grady, "Random walks for image segmentation",
PAMI 2006).
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
_MIN_FITTED = 100
_WRONG = np.log(1.25)
_MOST_CONFIDENCE = 0.2  # of a pixel of the prior
_USUAL = 0.05  # error of a prior in the logarithm of depth; a step of more than twice is an edge
_MAX_CELLS = 40_000
_SMOOTHNESS = 10.0  # relative to 1 for a cell with all pixels known
_TOWARDS_NONE = 0.002  # pull to no correction and the mean error, far from known pixels
_AROUND = np.ones((5, 5), np.uint8)
_EMPTY = 2 * np.log(FAR_M)  # logarithm of a depth beyond all others


def complete(maps: DepthMap, prior: Prior, kind: str = "auto") -> FullDepth:
    """Return the depth map with pixels of the prior where it has no measured or filled depth.

    A pixel stays empty if the prior has no value, shows sky by the mask, or is beyond ``FAR_M`` or
    at its far limit. Pixels on the blurred transition between two surfaces stay empty too. A prior
    that does not fit is not used. Confidences are a ranking. A pixel of the prior has at most 0.2,
    less where the prior is steep or deviates from known pixels nearby. All known pixels have more.
    The prior has the map's shape and measure of depth. The ``kind`` of its values is ``depth``,
    ``inverse`` or ``auto``.
    """
    known = (prior.value > 0) & ~prior.sky
    above = _MOST_CONFIDENCE + (1 - _MOST_CONFIDENCE) * maps.confidence
    confidence = np.where(maps.filled_m > 0, above, 0).astype(np.float32)
    measured = known & (maps.depth_m > 0)
    fit = fit_prior(prior.value[measured], maps.depth_m[measured], kind)
    if not fit.used:
        nothing = np.zeros(known.shape, bool)
        return FullDepth(maps.filled_m, confidence, nothing, fit, prior.source)
    log_depth = _log_depth(prior.value, fit)
    farthest = prior.value[known].min() if fit.kind == "inverse" else prior.value[known].max()
    usable = known & (log_depth < np.log(FAR_M)) & (prior.value != farthest)  # often the sky
    guide = np.where(usable, log_depth, _EMPTY).astype(np.float32)
    guide = cv2.medianBlur(guide, 5).astype(np.float32)
    farther, nearer = cv2.dilate(guide, _AROUND) - guide, guide - cv2.erode(guide, _AROUND)
    correction, spread = _correction(maps.filled_m, log_depth, guide, farther + nearer, usable)
    full_m = np.exp(np.minimum(log_depth + correction, _EMPTY)).astype(np.float32)
    usable &= (np.minimum(farther, nearer) < 2 * _USUAL) & (full_m < FAR_M)
    from_prior = usable & (maps.filled_m == 0)
    error = np.hypot(spread, farther + nearer) / _USUAL
    return FullDepth(
        np.where(from_prior, full_m, maps.filled_m),
        np.where(from_prior, _MOST_CONFIDENCE / (1 + error), confidence).astype(np.float32),
        from_prior,
        fit,
        prior.source,
    )


def fit_prior(value: Float32, depth_m: Float32, kind: str) -> PriorFit:
    """Return the curve from the values of a prior to depth with the least ``residual``.

    A curve that turns near into far is rejected. ``value`` and ``depth_m``, both (N,) and above 0,
    are of the same pixels. ``kind`` is as in `complete`.
    """
    p, z = value.astype(np.float64), depth_m.astype(np.float64)
    fits = [_fitted(form, p, z) for form in _FORMS[kind]]
    return min(fits, key=lambda fit: (not fit.scale > 0, fit.residual))


def _fitted(form: str, p: Float, z: Float) -> PriorFit:
    """Fit one form of curve to values p (N,) and depths z (N,) by medians in steps of depth."""
    if len(z) < _MIN_FITTED:
        return PriorFit(form, 0.0, 0.0, np.inf, 1.0, False)
    step = np.floor(np.log(z / z.min()) / _USUAL).astype(np.int64)
    num = np.bincount(step)
    steps = np.flatnonzero(num)
    # Measured depth counts as exact, the prior's values do not. Medians tolerate a tenth of
    # outliers.
    middle_p = ndimage.median(p, step, steps)
    scale, shift = _line(form, middle_p, ndimage.median(z, step, steps))
    off = np.abs(_log_depth(p, PriorFit(form, scale, shift, np.inf, 1.0, False)) - np.log(z))
    weight = 1 / np.sqrt(num)[step]
    residual = float(np.average(np.minimum(off, _WRONG), weights=weight))
    wrong = float(np.average(off > _WRONG, weights=weight))
    return PriorFit(form, scale, shift, residual, wrong, scale > 0 and wrong <= MAX_WRONG)


def _line(form: str, p: Float, z: Float) -> tuple[float, float]:
    """Return scale and shift of the curve of one form, linear in both, through p and z."""
    unit, one = float(np.median(p)), np.ones(len(z))
    if form == "log":
        columns, target = [np.log(p / unit), one], np.log(z)
    else:
        # The weights make residuals close to residuals of the logarithm of depth.
        weight = z if form == "inverse" else 1 / z
        columns, target = [p / unit * weight, weight], one
    A = np.stack(columns, axis=1)

    def residual(x: Float) -> Float:
        return A @ x - target

    start = np.linalg.lstsq(A, target, rcond=None)[0]
    solution = optimize.least_squares(residual, start, loss="soft_l1", f_scale=_USUAL)
    scale, shift = (float(x) for x in solution.x)
    return (scale, shift - scale * np.log(unit)) if form == "log" else (scale / unit, shift)


def _log_depth(value: Float | Float32, fit: PriorFit) -> Float:
    """Return the logarithm of depth in metres by the curve, whose values are kept above 0."""
    value = value.astype(np.float64)
    if fit.kind == "log":
        return fit.scale * np.log(np.maximum(value, np.finfo(np.float64).tiny)) + fit.shift
    logarithm = np.log(np.maximum(fit.scale * value + fit.shift, np.exp(-_EMPTY)))
    return -logarithm if fit.kind == "inverse" else logarithm


class _Cells(NamedTuple):
    """The image in square cells of ``size`` pixels, R rows and C columns."""

    size: int
    guide: Float  # (R,C) logarithm of depth at the central pixel of each cell
    number: Int  # (H,W) number of each pixel's cell, row by row

    @staticmethod
    def over(guide: Float32) -> _Cells:
        """Return up to 40,000 cells that cover the image ``guide`` (H,W), logarithm of depth."""
        height, width = guide.shape
        size = max(1, int(np.ceil(np.sqrt(guide.size / _MAX_CELLS))))
        rows, columns = (
            np.minimum(np.arange(0, length, size) + size // 2, length - 1)
            for length in (height, width)
        )
        number = np.arange(height)[:, None] // size * len(columns) + np.arange(width) // size
        return _Cells(size, guide[np.ix_(rows, columns)].astype(np.float64), number)

    def membrane(self) -> sparse.csr_array:
        """Return the (RC,RC) matrix of the squared differences between neighbouring cells."""
        cell = np.arange(self.guide.size).reshape(self.guide.shape)
        first = np.concatenate([cell[:, :-1].ravel(), cell[:-1].ravel()])
        second = np.concatenate([cell[:, 1:].ravel(), cell[1:].ravel()])
        step = (self.guide.ravel()[first] - self.guide.ravel()[second]) / _USUAL
        tied = _SMOOTHNESS * np.exp(-(step**2))  # less, the more the guides of both cells differ
        half = sparse.coo_array((tied, (first, second)), shape=(cell.size, cell.size))
        weights = (half + half.T).tocsr()
        return sparse.diags_array(weights.sum(axis=1)) - weights

    def at_pixels(self, values: Float, guide: Float32) -> Float:
        """Return (K,H,W) values (K,RC) of cells, interpolated between four cells."""
        grid = values.reshape(-1, *self.guide.shape)
        down, right = ((np.arange(length) - self.size // 2) / self.size for length in guide.shape)
        weight_sum, value_sum = np.zeros(guide.shape), np.zeros((len(grid), *guide.shape))
        for row, row_weight in _both_ways(down, self.guide.shape[0]):
            for column, column_weight in _both_ways(right, self.guide.shape[1]):
                corner = np.ix_(row, column)
                # Cells on another surface, by their guide, hardly count.
                off = (guide - self.guide[corner]) / _USUAL
                alike = np.exp(-(off**2)) + np.finfo(float).eps
                weight = alike * np.outer(row_weight, column_weight)
                weight_sum += weight
                value_sum += weight * grid[:, row[:, None], column]
        return value_sum / weight_sum


def _both_ways(position: Float, num: int) -> list[tuple[Int, Float]]:
    """Return the cells before and after fractional positions, each with its weights."""
    before = np.clip(np.floor(position), 0, num - 1).astype(np.int64)
    share = np.clip(position - before, 0, 1)
    return [(before, 1 - share), (np.minimum(before + 1, num - 1), share)]


def _correction(
    filled_m: Float32, log_depth: Float, guide: Float32, steepness: Float32, usable: Bool
) -> tuple[Float, Float]:
    """Return (H,W) the correction of the logarithm of depth, and (H,W) its remaining error."""
    # guide: the prior's log_depth smoothed, steepness: its range around a pixel
    cells = _Cells.over(guide)
    area, num = cells.size**2, cells.guide.size
    known = usable & (filled_m > 0) & (np.abs(guide - cells.guide.ravel()[cells.number]) < _USUAL)
    cell = cells.number[known]
    deviation = np.log(filled_m[known].astype(np.float64)) - log_depth[known]
    membrane = cells.membrane()

    def at_rest(trust: Float, values: Float, elsewhere: float) -> Float:
        """Return the (RC,) membrane at rest, pulled by known pixels to their values."""
        tied = np.bincount(cell, trust, num) / area + _TOWARDS_NONE
        pulled = np.bincount(cell, trust * values, num) / area + _TOWARDS_NONE * elsewhere
        system = (membrane + sparse.diags_array(tied)).tocsc()
        settled: Float = linalg.spsolve(system, pulled, permc_spec="MMD_AT_PLUS_A")
        return settled

    def trusted(off: Float | Float32) -> Float:
        """Return the (N,) weight of known pixels at these deviations."""
        weight: Float = 1 / (1 + (off.astype(np.float64) / (2 * _USUAL)) ** 2)
        return weight

    # A steep prior may be blurred. Differences there have little weight.
    flat = trusted(steepness[known])
    mean = float(np.average(np.abs(deviation), weights=flat)) if len(flat) else 0.0
    trust = flat * trusted(deviation - at_rest(flat, deviation, 0.0)[cell])
    correction = at_rest(trust, deviation, 0.0)
    # The mean error of known pixels nearby on the same surface; far from them, of the image.
    spread = at_rest(trust, np.abs(deviation - correction[cell]), mean)
    at_pixels = cells.at_pixels(np.stack([correction, spread]), guide)
    return at_pixels[0], at_pixels[1]
