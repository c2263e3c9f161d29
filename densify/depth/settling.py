# SPDX-License-Identifier: MIT
"""Which depth the points in an image give its pixels: what they hide, whether enough sweeps agree,
and how near a depth edge is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from densify.config import ProjectSettings
from densify.depth import visibility as kernels
from densify.depth.image_points import PointsInImage
from densify.depth.rims import MOST_CONFIDENCE
from densify.geometry.types import Bool, Camera, Float, Float32, Int, Reason

_NEVER_NS = np.iinfo(np.int64).max
_MAX_HALF_PX = 24.0  # a point just before the lens must not hide the whole image
_EDGE_WINDOW_PX = 1.5  # beyond the edge, where points must show that a surface goes on
# Of pixels that sweeps beyond the window give: these vouch that a surface goes on where something
# nearer begins, so both are stricter.
_FAR_SUPPORT, _FAR_EDGE = 6, 1.5
# What takes how much of a pixel's confidence, at most: few sweeps, few points, an edge close by,
# a rough fit, being nearly hidden. Set by hand, in the order of what was most often wrong.
_DOUBTS = np.array([0.45, 0.25, 0.20, 0.10, 0.10])
_MANY_POINTS = 20
_ROUGH_M = 0.10
_LEAST_ALONE = 5  # returns of the key sweep that agree around one, itself among them, of nine


@dataclass(frozen=True)
class MeasuredPixels:
    """P measured pixels. pixel: (P,) row by row. winner: (P,) which of the points in the image.
    depth_m, confidence: (P,). tilt: (P,2) of the inverse depth, 1/m per px. inside: (P,) no depth
    edge near. veiled: (P,) behind another point's patch. refused, alone: (P,) see
    `Layers`."""

    pixel: Int
    winner: Int
    depth_m: Float32
    confidence: Float32
    tilt: Float
    inside: Bool
    veiled: Bool
    refused: Bool
    alone: Bool

    def select(self, keep: Bool | Int) -> MeasuredPixels:
        """Some of the pixels."""
        return MeasuredPixels(**{name: column[keep] for name, column in vars(self).items()})

    def replaced(self, others: MeasuredPixels) -> MeasuredPixels:
        """The pixels and others of the same points, which count where both know one."""
        kept = self.select(~np.isin(self.pixel, others.pixel))
        more = vars(others)
        both = MeasuredPixels(**{n: np.concatenate([c, more[n]]) for n, c in vars(kept).items()})
        return both.select(np.argsort(both.pixel))


def visible_pixels(
    points: PointsInImage,
    own: Float32,
    camera: Camera,
    settings: ProjectSettings,
    reason: np.ndarray,
) -> MeasuredPixels:
    """The pixels that the points not hidden measure; fills in the ``reason`` of the others.

    What sweeps beyond the window measured comes second. It gives pixels where the window has none
    away from depth edges, and vouches there for what the window saw too rarely.
    """
    near = ~points.far
    pixels, why = _settled(points.select(near), own[near], camera, settings)
    pixels = replace(pixels, winner=np.flatnonzero(near)[pixels.winner])
    reason[points.index[near]] = why
    if near.all():
        return pixels
    taken = pixels.pixel[pixels.inside]
    others, why = _settled(points, own, camera, settings, taken)
    reason[points.index[~near]] = why[~near]
    return pixels.replaced(others.select(others.inside))


def _settled(
    points: PointsInImage,
    own: Float32,
    camera: Camera,
    settings: ProjectSettings,
    taken: Int | None = None,
) -> tuple[MeasuredPixels, NDArray[np.uint8]]:
    """The pixels that points measure, and of every point the `Reason`.

    taken: where given, pixels to leave alone; for the others the stricter rules hold of what sweeps
    beyond the window measured. Else what too few sweeps agree with is believed where the key sweep
    has several returns of it: what moves unnoticed was elsewhere at other times.
    """
    many = int(points.sweep.max(initial=0)) + 1
    least = min(settings.support, max(1, many // 2))
    reaches = _reaches(settings, least if taken is None else 0)
    behind = _behind(points, camera, settings)
    hidden = behind > 1
    reason = np.where(hidden, Reason.HIDDEN, Reason.NOT_CHOSEN).astype(np.uint8)
    pixel, winner, found = _found(points, hidden, own, camera, settings, reaches, taken)
    depth_m, num_sweeps, youngest_ns, num_points, residual_m, edge, num_alone = found
    veiled = hidden[winner]
    refused = veiled & (points.age_ns[winner] > kernels.NOW_NS)
    if refused.any():
        refused &= _behind(points, camera, settings, points.moving)[winner] > 1
    refused |= edge < 0
    alone = num_alone >= _LEAST_ALONE
    if taken is None:
        supported = num_sweeps >= least
        supported &= youngest_ns <= np.float32(points.age_ns.min(initial=_NEVER_NS))
        supported |= alone
        inside = edge >= 1
    else:
        many, supported, inside = 2 * _FAR_SUPPORT, num_sweeps >= _FAR_SUPPORT, edge >= _FAR_EDGE
        reason[winner[~inside & ~veiled]] = Reason.EDGE
    reason[winner[~supported & ~veiled]] = Reason.UNSUPPORTED
    doubts = np.stack(
        [
            1 - np.minimum(num_sweeps / many, 1),
            1 - np.minimum(num_points / _MANY_POINTS, 1),
            np.clip(3 - edge, 0, 2) / 2,
            np.minimum(residual_m / _ROUGH_M, 1),
            np.clip(behind[winner], 0, 1),
        ]
    )
    confidence = np.maximum(own[winner] * (1 - _DOUBTS @ doubts), MOST_CONFIDENCE)
    inside &= ~veiled
    every = MeasuredPixels(
        pixel=pixel,
        winner=winner,
        depth_m=depth_m,
        confidence=confidence.astype(np.float32),
        tilt=points.slope[winner],
        inside=inside,
        veiled=veiled,
        refused=refused & ~inside,
        alone=alone,
    )
    return every.select(supported), reason


def _found(
    points: PointsInImage,
    hidden: Bool,
    own: Float32,
    camera: Camera,
    settings: ProjectSettings,
    reaches: kernels.Reaches,
    taken: Int | None,
) -> tuple[Int, Int, Float32]:
    """The pixels (P,) with points, which point comes first in each (P,), and what
    `densify.depth.visibility.settle` finds around it, (7,P). taken: where given, neither these
    nor those with hidden points alone."""
    last = int(points.age_ns.max(initial=0)) + 1
    late = points.age_ns > kernels.NOW_NS
    rank = np.where(hidden, last + late, points.age_ns)
    start, order = _by_pixel(points, rank, own, camera)
    found = np.zeros((7, len(start) - 1), np.float32)
    done = np.zeros(len(start) - 1, bool)
    if taken is not None:
        some = np.flatnonzero(np.diff(start))
        done[some[hidden[order[start[some]]]]] = True
        done[taken] = True
    inverse = points.inverse
    edge_px = settings.edge_slack_m * points.focal_px[:, 0] * inverse
    visible = kernels.Visible(
        start=start,
        uv=points.uv.take(order, axis=0),
        inverse=inverse[order],
        slope=points.slope.take(order, axis=0),
        spacing_px=points.spacing_px.take(order, axis=0),
        edge_px=edge_px[order],
        sweep=points.sweep[order],
        hidden=hidden[order],
        moving=points.moving[order],
        age_ns=points.age_ns[order],
    )
    shape = (camera.height_px, camera.width_px)
    kernels.settle.over_rows(len(done), visible, reaches, shape, done, found)
    pixel = np.flatnonzero(found[0])
    return pixel, order[start[pixel]], found[:, pixel]


def _reaches(settings: ProjectSettings, few: int) -> kernels.Reaches:
    return kernels.Reaches(
        support=float(settings.support_reach),
        plane=float(settings.plane_reach),
        agree_m=float(settings.agree_m),
        agree_fraction=float(settings.agree_fraction),
        behind_m=float(settings.hidden_m),
        behind_fraction=float(settings.hidden_fraction),
        edge=float(settings.edge_reach),
        edge_window_px=_EDGE_WINDOW_PX,
        few=few,
    )


def _behind(
    points: PointsInImage,
    camera: Camera,
    settings: ProjectSettings,
    who: Bool | slice = slice(None),
) -> Float:
    """(K,) how far each point lies behind the nearest patch over its pixel, as a share of what is
    allowed; above 1 it is hidden. who: (K,) whose patches hide."""
    slack_px = settings.slack_m * points.focal_px / points.depth[:, None]
    half_px = np.clip(settings.footprint * points.spacing_px + slack_px, 0.5, _MAX_HALF_PX)
    nearest = np.zeros((camera.height_px, camera.width_px), np.float32)
    kernels.paint(points.uv[who], points.inverse[who], points.slope[who], half_px[who], nearest)
    column, row = np.rint(points.uv).astype(np.int64).T
    occluder = nearest[row, column].astype(np.float64)
    covered = occluder > 0
    np.divide(1, occluder, out=occluder, where=covered)
    off = np.where(covered, points.depth - occluder, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(
            off / (settings.hidden_m + settings.hidden_fraction * occluder), posinf=np.inf
        )


def _by_pixel(points: PointsInImage, rank: Int, own: Float32, camera: Camera) -> tuple[Int, Int]:
    """The points of pixel p are ``order[start[p]:start[p + 1]]``, the least in rank first, then the
    nearest."""
    column, row = np.rint(points.uv).astype(np.int64).T
    start = np.empty(camera.height_px * camera.width_px + 1, np.int64)
    order = np.empty(len(rank), np.int64)
    pixel = row * camera.width_px + column
    kernels.by_pixel(pixel, rank, points.depth, points.frame, points.uv, own, start, order)
    return start, order


def nearest_pixels(
    points: PointsInImage, own: Float32, camera: Camera, reason: NDArray[np.uint8]
) -> MeasuredPixels:
    """Each pixel's nearest point, as it is; fills in the ``reason`` of the others."""
    start, order = _by_pixel(points, np.zeros(len(own), np.int64), own, camera)
    pixel = np.flatnonzero(np.diff(start))
    nearest = order[start[pixel]]
    reason[points.index] = Reason.NOT_CHOSEN
    everywhere = np.ones(len(pixel), bool)
    tilt = points.slope[nearest]
    return MeasuredPixels(
        pixel,
        nearest,
        points.depth[nearest],
        own[nearest],
        tilt,
        everywhere,
        ~everywhere,
        ~everywhere,
        ~everywhere,
    )
