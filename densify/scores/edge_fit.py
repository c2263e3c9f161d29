# SPDX-License-Identifier: MIT
"""Fit the rotation and the clock of a camera: depth discontinuities of sweeps to image edges.

Levinson and Thrun, "Automatic Online Calibration of Cameras and Lasers", RSS 2013, with two
additions. Vertical silhouettes are compared with horizontal image gradients, and level silhouettes
with vertical gradients, so pitch is observable as well as yaw. The error of the best fit is an
M-estimator's (Huber, "The behavior of maximum likelihood estimates under nonstandard conditions",
1967), from the score's curvature and the spread of its slope over the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import Bool, Camera, Float, Float32, Sweep

_NEAREST_M, _MOST_RANGE_M = 3.0, 100.0  # least and greatest range of both surfaces at an edge
_FARTHEST_M = 50.0  # greatest range of the near surface
_EDGE_M, _EDGE_SHARE = 0.6, 0.08  # least step of range at an edge, in metres and as a share
_ROW_RAD = np.deg2rad(0.1)  # finer than any scanner's rings
_APART_RAD = np.deg2rad(1.5)  # greatest angle between neighbouring returns at an edge
_FOCAL_PX = 700.0  # focal length to which images are resized
_NOISE_PX, _BLUR_PX, _AROUND_PX = 0.8, 2.0, 25.0  # blurs: of noise, of edges, of their surroundings
_MOST_STRENGTH = 4.0
# Half extent and step of the grid of offsets: degrees (pitch, yaw, roll) and seconds
_REACH, _STEP = (2.7, 2.7, 2.0, 0.2), (0.3, 0.3, 1.0, 0.05)
_BLURRED = np.array([0.15, 0.15, 0.3, 0.015])  # an offset that moves edges by the blur
_NUM_ON_GRID, _NUM_STARTS, _NUM_HALVINGS = 4000, 4, 4
_CLEARLY = 2.0  # standard errors by which a clearly better score exceeds another
_AS_HIGH = 0.8  # share of the best score's height above the median, for scores of similar height


class Silhouettes(NamedTuple):
    """E depth discontinuities of a sweep."""

    # (E,3) metres, lidar frame: at the range of the near surface, in the direction halfway between
    # the near and the far return
    points: Float
    is_level: Bool  # (E,) True if the far surface is above or below, False if beside


class View(NamedTuple):
    """An image and the depth discontinuities of a sweep near it in time."""

    silhouettes: Silhouettes
    strength: Float32  # (2,H,W) image gradient (horizontal, then vertical) minus its mean
    scale: float  # size of the resized image divided by the size of the original
    twist: Float  # (6,) velocity of the lidar (rad/s, m/s), lidar frame
    exposed_s: float  # stamp of the image minus the reference time of the sweep


class Fit(NamedTuple):
    """The best-fitting offset of a camera's rotation and clock."""

    # (4,) degrees about the camera's x (pitch), y (yaw) and z (roll), and seconds from the stamps
    # of the images to their exposure
    offset: Float
    error: Float  # (4,) standard error of the offset, infinite if the views do not determine it
    score: float  # sum of image gradients at the depth discontinuities with this offset
    rival: float  # best score with an offset more than 1 degree or 0.1 s away
    usual: float  # median score of all offsets on the grid
    # (R,4) offsets that far away with 0.8 times the height of the score above ``usual``
    others: Float
    # (R,) True if the best fit is not better by two standard errors of the sum over the images
    are_equal: Bool

    @property
    def clearness(self) -> float:
        """Height of the best score above the median, divided by the height of the rival."""
        return (self.score - self.usual) / max(self.rival - self.usual, 1e-9)


def silhouettes_of(sweep: Sweep) -> Silhouettes:
    """Return the depth discontinuities of a sweep, found per scanner, in the lidar frame."""
    by_scanner = []
    for lidar in map(int, np.unique(sweep.lidar)):
        origin_m, axes = sweep.origin_m(lidar), sweep.axes(lidar)
        points = (sweep.points[sweep.lidar == lidar] - origin_m) @ axes.T
        range_m = np.linalg.norm(points, axis=1)
        edges = depth_edges(points[(range_m > _NEAREST_M) & (range_m < _MOST_RANGE_M)])
        by_scanner.append(edges._replace(points=edges.points @ axes + origin_m))
    return Silhouettes(*map(np.concatenate, zip(*by_scanner, strict=True)))


def depth_edges(points: Float) -> Silhouettes:
    """Return the depth discontinuities of one scanner's points (N,3), metres, in its own frame."""
    x, y, z = points.T
    range_m = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(y, x)
    elevation = np.arcsin(z / range_m)
    edge_points, is_level = [], []
    step_rad = _ROW_RAD  # width of a line
    # Lines of equal elevation, then lines of equal azimuth
    for far_is_level, position, line_rad in (
        (False, azimuth, elevation),
        (True, elevation, azimuth),
    ):
        # Triples of neighbouring returns on a line
        line = np.floor(line_rad / step_rad)
        order = np.lexsort((position, line))
        gap = np.diff(position[order])
        is_joined = (np.diff(line[order]) == 0) & (gap < _APART_RAD)
        row = 1 + np.flatnonzero(is_joined[:-1] & is_joined[1:])
        before, middle, after = order[row - 1], order[row], order[row + 1]

        # The middle return is at an edge if it is nearer than the line through both neighbours.
        # Inverse range is linear on a plane at any slant.
        fraction = gap[row - 1] / np.maximum(gap[row - 1] + gap[row], 1e-12)
        straight_inverse = (1 - fraction) / range_m[before] + fraction / range_m[after]
        far = np.where(range_m[before] > range_m[after], before, after)
        deeper_m = np.maximum(_EDGE_M, _EDGE_SHARE * range_m[middle])
        is_edge = (range_m[far] - range_m[middle] > deeper_m) & (range_m[middle] < _FARTHEST_M)
        is_edge &= 1 - straight_inverse * range_m[middle] > _EDGE_SHARE
        near, far = middle[is_edge], far[is_edge]
        ray = points[near] / range_m[near, None] + points[far] / range_m[far, None]
        edge_points.append(ray * (range_m[near] / np.linalg.norm(ray, axis=1))[:, None])
        is_level.append(np.full(len(near), far_is_level))
        # The columns of a sparse scanner are as wide as the gaps within its rings.
        if is_joined.any():
            step_rad = max(step_rad, float(np.median(gap[is_joined])))
    return Silhouettes(np.concatenate(edge_points), np.concatenate(is_level))


def image_edges(image: NDArray[np.uint8], focal_px: float) -> tuple[Float32, float]:
    """Return the gradients (2,h,w) of an (H,W,3) RGB image resized to 700 px of focal length.

    They are horizontal, then vertical, minus their means. The second value is the scale h / H.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = _FOCAL_PX / focal_px
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=interpolation)
    smooth = cv2.GaussianBlur(resized, (0, 0), _NOISE_PX)
    edges = []
    for order in ((1, 0), (0, 1)):
        gradient = np.abs(cv2.Sobel(smooth, cv2.CV_32F, *order))
        # Strength relative to the surroundings, limited and blurred
        surroundings = cv2.GaussianBlur(gradient, (0, 0), _AROUND_PX) + _MOST_STRENGTH
        strength = np.minimum(gradient / surroundings, _MOST_STRENGTH)
        strength = cv2.GaussianBlur(strength, (0, 0), _BLUR_PX)
        edges.append(strength - strength.mean())
    return np.stack(edges), smooth.shape[1] / image.shape[1]


def turned(camera: Camera, offset: Float) -> Camera:
    """Return the camera turned by an offset: degrees about its x, y and z, then an unused delay."""
    turn = poses.exp(np.append(np.deg2rad(offset[:3]), np.zeros(3)))
    return replace(camera, T_cam_lidar=turn @ camera.T_cam_lidar)


def score(camera: Camera, views: Sequence[View]) -> tuple[float, int]:
    """Return the sum of image gradients at all depth discontinuities in view, and their number."""
    lines = [_Lines.of(camera, view, np.zeros(4)) for view in views]
    return _sum(lines, np.zeros(4)), sum(len(line.uv) for line in lines)


def is_off(camera: Camera, silhouettes: Silhouettes, image: NDArray[np.uint8]) -> bool:
    """Return True if an RGB image is clearly turned against the depth discontinuities of a sweep.

    A turn of up to 2.7 degrees must score better than the best turn within 0.3 degrees, by two
    standard errors of the sum of their differences at the discontinuities. The turn must also stand
    out from all others: where discontinuities are few, the best of many turns is better by chance.
    ``camera`` has its pose at the exposure of the (H,W,3) image.
    """
    view = View(silhouettes, *image_edges(image, camera.focal_px), np.zeros(6), 0.0)
    lines = _Lines.of(camera, view, np.zeros(4))
    turns = _grid()
    scores = lines.scores(turns)
    # Half a step beyond the first step of the grid: turns within 0.3 degrees
    is_small = (np.abs(turns[:, :2]) < 1.5 * _STEP[0]).all(axis=1)
    small, large = (turns[mask][np.argmax(scores[mask])] for mask in (is_small, ~is_small))
    gain = np.diff(lines.strengths(np.stack([small, large])), axis=0)
    rival_score = scores[_is_far(turns, large)].max()
    median_score = np.median(scores)
    height = scores[~is_small].max() - median_score
    stands_out = rival_score - median_score < _AS_HIGH * height
    return bool(stands_out and gain.sum() > _CLEARLY * np.sqrt((gain**2).sum()))


def best_fit(camera: Camera, views: Sequence[View], with_clock: bool) -> Fit:
    """Return the offset of a camera's rotation and clock that fits two or more views best.

    Of equal maxima, the one of fewest changes is chosen. ``with_clock`` False keeps the clock.
    """
    free = np.array([True, True, True, with_clock])
    lines = [_Lines.of(camera, view, np.zeros(4)) for view in views]
    grid = _grid(2)
    if with_clock:
        grid = np.concatenate([grid, _grid(3)])
    # Scores on a grid of offsets, at every n-th discontinuity to save time
    thin = sum(len(line.uv) for line in lines) // _NUM_ON_GRID + 1
    on_grid = np.sum([line.scores(grid, thin) for line in lines], axis=0)
    usual = float(np.median(on_grid)) * thin

    # The best of the local maxima near some starts, and the best score far from it
    starts = _find_starts(grid, on_grid, free)
    maxima = [_climb(lines, start, free) for start in starts]
    best, others, are_equal = _choose_simplest(lines, maxima, usual)
    is_far = _is_far(grid, best)
    rival = grid[is_far][np.argmax(on_grid[is_far])]
    rival_score = _sum(lines, rival)

    # Projections are linear in the offset; they are linearised again at the best offset.
    lines = [_Lines.of(camera, view, best) for view in views]
    correction = _climb(lines, np.zeros(4), free)
    error = _find_error(lines, correction, free)
    best_score = _sum(lines, correction)
    return Fit(best + correction, error, best_score, rival_score, usual, others, are_equal)


def _find_starts(grid: Float, on_grid: Float, free: Bool) -> list[Float]:
    """Return offsets (4,) to climb from: none, the best of each parameter, the best of all."""
    # on_grid (M,): score of each offset of the grid (M,4)
    starts = [np.zeros(4)]
    for axis in np.flatnonzero(free):
        rows = np.flatnonzero((np.delete(np.abs(grid), axis, axis=1) < 1e-9).all(axis=1))
        starts.append(grid[rows[np.argmax(on_grid[rows])]])
    num_starts = len(starts) + _NUM_STARTS - 1
    for row in np.argsort(-on_grid):
        if len(starts) == num_starts:
            break
        if all(_is_far(grid[row], start) for start in starts):
            starts.append(grid[row])
    return starts


def _choose_simplest(
    lines: Sequence[_Lines], maxima: Sequence[Float], usual: float
) -> tuple[Float, Float, Bool]:
    """Return the equally good maximum (4,) of fewest changes, then `Fit.others` and `are_equal`."""
    offsets = np.array(maxima)
    scores = np.stack([line.scores(offsets) for line in lines], axis=1)  # of each view
    total = scores.sum(axis=1)
    top = int(np.argmax(total))
    deficit = scores[top] - scores
    deficit_error = np.sqrt(len(lines)) * deficit.std(axis=1, ddof=1)  # of the sum over the views
    is_high = total - usual > _AS_HIGH * (total[top] - usual)
    is_equal = is_high & (deficit.sum(axis=1) <= _CLEARLY * deficit_error)
    is_equal[top] = True
    # Equal offsets first, then by number of changes, then by score
    order = np.lexsort((-total, num_changed(offsets), ~is_equal))
    kept = [int(order[0])]
    for row in order[is_high[order]]:
        if all(_is_far(offsets[row], offsets[kept_row]) for kept_row in kept):
            kept.append(int(row))
    return offsets[kept[0]], offsets[kept[1:]], is_equal[kept[1:]]


def num_changed(offsets: Float) -> Any:
    """Return the number of parameters, (M,), that each offset (M,4) changes by over 3 blurs."""
    return (np.abs(offsets) > 3 * _BLURRED).sum(axis=-1)


def _grid(*others: int) -> Float:
    """Return (M,4) offsets: all pitches and yaws, with each step of other parameters, or 0."""
    axes = [np.zeros(1)] * 4
    for axis in (0, 1, *others):
        # Half a step keeps the last value.
        axes[axis] = np.arange(-_REACH[axis], _REACH[axis] + _STEP[axis] / 2, _STEP[axis])
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 4)


class _Lines(NamedTuple):
    """The E depth discontinuities of a view, projected into the resized image."""

    uv: Float  # (E,2) pixels
    slope: Float  # (E,2,4) change of ``uv`` per degree and per second of the offset
    is_level: Bool
    strength: Float32  # (2,H+2,W+2) image gradient, padded with 0

    @staticmethod
    def of(camera: Camera, view: View, offset: Float) -> _Lines:
        """Project the depth discontinuities of a view, after an offset (4,) as in `Fit`."""

        def project(added: Float) -> tuple[Float, Bool]:
            exposed_s = view.exposed_s + offset[3] + added[3]
            T_exposed_lidar = poses.inverse(poses.exp(exposed_s * view.twist))
            T_cam_exposed = turned(turned(camera, offset), added).T_cam_lidar
            return image_points(camera, poses.transform(T_cam_exposed @ T_exposed_lidar, points))

        points, is_level = view.silhouettes
        _, inside = project(np.zeros(4))
        points, is_level = points[inside], is_level[inside]
        (uv, _), slope = project(np.zeros(4)), np.zeros((len(points), 2, 4))
        for axis, step in enumerate(0.2 * _BLURRED):  # small against the blur of the edges
            ends = [project(sign * step * np.eye(4)[axis])[0] for sign in (1, -1)]
            slope[:, :, axis] = (ends[0] - ends[1]) / (2 * step)
        known = np.isfinite(slope).all(axis=(1, 2))
        # The centre of the first pixel is at 0, so resizing shifts by half a pixel.
        return _Lines(
            (uv[known] + 0.5) * view.scale - 0.5,
            slope[known] * view.scale,
            is_level[known],
            np.pad(view.strength, ((0, 0), (1, 1), (1, 1))),
        )

    def scores(self, offsets: Float, thin: int = 1) -> Float:
        """Return (M,) sums of `strengths` over the discontinuities."""
        return self.strengths(offsets, thin).sum(axis=1, dtype=np.float64)

    def strengths(self, offsets: Float, thin: int = 1) -> Float32:
        """Return (M,E) image gradients at every ``thin``-th discontinuity, for offsets (M,4)."""
        height, width = self.strength.shape[1:]
        uv, slope = self.uv[::thin], self.slope[::thin]
        moved = np.rint(uv + np.einsum("ma,eda->med", offsets, slope)).astype(np.int32) + 1
        column, row = np.clip(moved[..., 0], 0, width - 1), np.clip(moved[..., 1], 0, height - 1)
        pixel = (self.is_level[::thin] * height + row) * width + column
        return self.strength.reshape(-1).take(pixel)


def _sum(lines: Sequence[_Lines], offset: Float) -> float:
    """Return the score of an offset (4,), summed over all views."""
    return float(sum(line.scores(offset[None])[0] for line in lines))


def _is_far(offsets: Float, reference: Float) -> Any:
    """Return (M,) True for offsets (M,4) over 1 degree (pitch, yaw) or 0.1 s from the reference."""
    return (np.abs(offsets - reference)[..., [0, 1, 3]] > (1.0, 1.0, 0.1)).any(axis=-1)


def _climb(lines: Sequence[_Lines], offset: Float, free: Bool) -> Float:
    """Return the offset (4,) of the local maximum of the score near a start."""
    steps = np.concatenate([np.eye(4)[free], -np.eye(4)[free]])
    best = _sum(lines, offset)
    for halving in range(_NUM_HALVINGS):
        while True:
            around = offset + steps * _BLURRED / 2**halving
            scores = np.sum([line.scores(around) for line in lines], axis=0)
            if scores.max() <= best or np.abs(offset[0]) > 2 * _REACH[0]:  # summit, or lost
                break
            offset, best = around[int(np.argmax(scores))], float(scores.max())
    return offset


def _find_error(lines: Sequence[_Lines], offset: Float, free: Bool) -> Float:
    """Return (4,) the standard error of the best offset, 0 for parameters that are not fitted."""
    axes = np.flatnonzero(free)
    steps = np.eye(4)[axes] * _BLURRED
    # Scores at the offset, one step ahead and behind along each axis, and at the corners of pairs
    num, pairs = len(axes), [(i, j) for i in range(len(axes)) for j in range(i)]
    corners = [s * steps[i] + t * steps[j] for i, j in pairs for s in (1, -1) for t in (1, -1)]
    offsets = offset + np.concatenate([np.zeros((1, 4)), steps, -steps, np.array(corners)])
    scores = np.stack([line.scores(offsets) for line in lines])
    _, ahead, behind, _ = np.split(scores, [1, num + 1, 2 * num + 1], axis=1)
    slope = 0.5 * (ahead - behind)
    total = scores.sum(axis=0)
    centre, ahead, behind, at_corners = np.split(total, [1, num + 1, 2 * num + 1])
    curvature = np.diag(ahead + behind - 2 * centre)
    for (i, j), (pp, pm, mp, mm) in zip(pairs, at_corners.reshape(-1, 4), strict=True):
        # Mixed derivative from the corners ++, +-, -+ and -- of the axes i and j
        curvature[i, j] = curvature[j, i] = 0.25 * (pp - pm - mp + mm)
    error = np.zeros(4)
    error[axes] = np.inf
    if np.linalg.eigvalsh(curvature).max() < 0:  # a maximum, which the views determine
        # Sandwich estimate: curvature⁻¹ (Σ slope slopeᵀ over the views) curvature⁻¹
        slope = slope - slope.mean(axis=0)
        spread = np.linalg.solve(curvature, slope.T)
        error[axes] = np.sqrt(np.einsum("av,av->a", spread, spread)) * _BLURRED[axes]
    return error
