# SPDX-License-Identifier: MIT
"""Close the surfaces of moving objects, so that no background shows through them.

Dark paint and glass give few returns, and other sweeps measured the background there. Every moving
object has a body (`MovingBody`). It is closed where rays end on it, and open where they pass. Its
front is the nearest surface of the hull in each pixel, moved smoothly onto the object's own
returns. Pixels well inside the closed part show it, the image decides the silhouette.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from densify.depth.exposure import Exposure, pixel_of
from densify.depth.fill import LEAST_SHARE
from densify.depth.measured_pixels import MapRecord
from densify.depth.patches import FOOTPRINT, HIDDEN_M, agree_m, hidden_m
from densify.depth.rays import MovingBody, crossing, half_spaces
from densify.depth.votes import ROUNDED, VOTERS_REACH, votes_for
from densify.geometry import cameras
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types import Cloud

_PRIOR = 0.05  # number of rays that end on the body, assumed everywhere
_WHOLE = 0.8  # closed share of the front from which a body is closed as a whole, as a car is
_LEAST_OF_WHOLE, _LEAST_OF_OPEN = 0.2, 0.5  # share of rays that end on the body; a third at glass
_VOTES_OF_WHOLE = 0.75  # share of the votes along the silhouette
_DEEP_M = 3 * HIDDEN_M  # farther behind the front of the hull are seats, axles and the far side
_STIFF, _HELD = 3.0, 0.01  # weights of a smooth and of a small offset, against one return
_ROUNDING = float(np.finfo(np.float32).eps)  # of the stored depth
_AGREES = 2.0  # tolerance, as a multiple of the tolerance between two static points of a surface


def close_bodies(
    record: MapRecord, cloud: Cloud, exposure: Exposure, bodies: Mapping[int, MovingBody]
) -> None:
    """Put the surfaces of moving bodies into the record; ``on_body`` marks their pixels.

    Depths clearly in front of a body stay. Elsewhere inside the outline of its hull only depths of
    moving objects stay. Pixels with a return of the body on its surface count as measured.
    """
    margin_px = round(VOTERS_REACH * float(np.median(record.gap_px)))
    for instance, body in bodies.items():
        front = _Front.of(body, exposure, margin_px)
        if front is not None:
            rows = np.flatnonzero(cloud.moving & (cloud.instance == instance))
            _close(record.box(front.box), cloud, exposure, rows, body, front)


def far_inside(bodies: Iterable[MovingBody], exposure: Exposure, depth_m: Float32) -> Bool:
    """Return (H,W) True where ``depth_m`` (H,W) is far behind a body's front, as behind glass."""
    inverse = fronts(bodies, exposure)
    far: Bool = (inverse > 0) & (depth_m * inverse > 1 + _DEEP_M * inverse)
    return far


def fronts(bodies: Iterable[MovingBody], exposure: Exposure) -> Float:
    """Return (H,W) inverse depths of the nearest front of the bodies' hulls in 1/m, 0 for none."""
    inverse = np.zeros((exposure.camera.height_px, exposure.camera.width_px))
    for body in bodies:
        front = _Front.of(body, exposure, 0)
        if front is not None:
            inverse[front.box] = np.maximum(inverse[front.box], front.inverse)
    return inverse


class _Front(NamedTuple):
    """The nearest surface of a body's hull in each pixel of the image."""

    box: tuple[slice, slice]  # rows and columns of the image around the hull, h by w pixels
    inverse: Float  # (h,w) inverse depth of the surface in 1/m, 0 outside the outline of the hull

    @staticmethod
    def of(body: MovingBody, exposure: Exposure, margin_px: int) -> _Front | None:
        """Return the front of a body, None if out of view; its box is ``margin_px`` wider."""
        camera = exposure.camera
        sight = exposure.see(body.corners, body.velocity_m_s)
        if not sight.inside.any():
            return None
        low, high = np.zeros(2, int), np.array([camera.width_px, camera.height_px])
        if (exposure.depth_m(sight.points_cam) > cameras.NEAREST_M).all():
            low = np.maximum(low, np.floor(np.nanmin(sight.uv, axis=0)).astype(int) - margin_px)
            high = np.minimum(
                high, np.ceil(np.nanmax(sight.uv, axis=0)).astype(int) + 1 + margin_px
            )
        row, column = np.mgrid[low[1] : high[1], low[0] : high[0]]
        uv = np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)
        ray = cameras.rays(camera, uv)
        enter, leave = crossing(half_spaces(sight.points_cam), np.zeros(3), ray)
        inside = (enter > 0) & (enter < leave)
        depth_m = exposure.depth_m(np.where(inside, enter, 1)[:, None] * ray)
        inside &= depth_m > cameras.NEAREST_M
        inverse = np.divide(1, depth_m, out=np.zeros(len(ray)), where=inside)
        box = (slice(low[1], high[1]), slice(low[0], high[0]))
        return _Front(box, inverse.reshape(row.shape)) if inside.any() else None

    def pixels(self, exposure: Exposure, points: Float, velocity_m_s: Float32) -> _Pixels:
        """Project points (N,3), key sweep's lidar frame, to pixels within the box."""
        sight = exposure.see(points, velocity_m_s)
        row, column = pixel_of(np.where(sight.inside[:, None], sight.uv, -1))
        row, column = row - self.box[0].start, column - self.box[1].start
        height, width = self.inverse.shape
        shown = sight.inside & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        point = np.flatnonzero(shown)
        depth_m = exposure.depth_m(sight.points_cam[point])
        return _Pixels(point, (row[point], column[point]), depth_m)

    def closed(self, body: MovingBody, exposure: Exposure, spacing_px: Float32) -> Float:
        """Return the (h,w) share, 0 to 1, of the rays entering at a pixel that end on the body."""
        blur_px = np.maximum(FOOTPRINT * np.median(spacing_px, axis=(0, 1)), 1.0)
        entered = self.pixels(exposure, body.entries, body.velocity_m_s)
        front_m = 1 / np.maximum(self.inverse[entered.pixel], 1e-6)
        faces = entered.depth_m < front_m + hidden_m(front_m)
        counts = np.zeros((2, *self.inverse.shape))
        ends = body.ends[entered.point].astype(np.int64)
        np.add.at(counts, (ends, *entered.pixel), faces)
        passed, ended = (cv2.GaussianBlur(n, (0, 0), blur_px[0], sigmaY=blur_px[1]) for n in counts)
        ended = ended + _PRIOR / (2 * np.pi * blur_px.prod())
        share: Float = np.where(self.inverse > 0, ended / (ended + passed), 0)
        return share


class _Pixels(NamedTuple):
    """Points in a box of the image: index, row and column in the box, and depth of each point."""

    point: Int
    pixel: tuple[Int, Int]
    depth_m: Float


def _close(
    record: MapRecord, cloud: Cloud, exposure: Exposure, rows: Int, body: MovingBody, front: _Front
) -> None:
    """Put a body, with points at ``rows`` of the cloud, into a record cut to the front's box."""
    surface = _surface(record, rows, front)
    surface_m = (1 / surface).astype(np.float32)
    allowed_m = _AGREES * agree_m(surface_m)
    share = front.closed(body, exposure, record.spacing_px)
    shows, measurable = _show(record, cloud, surface, allowed_m, share)

    returns = front.pixels(exposure, cloud.points[rows], cloud.velocity_m_s[rows])
    off_m = abs(returns.depth_m - surface_m[returns.pixel])
    agrees = measurable[returns.pixel] & (off_m <= allowed_m[returns.pixel])
    pixel, rows = tuple(axis[agrees] for axis in returns.pixel), rows[returns.point[agrees]]
    oldest_first = np.argsort(-abs(cloud.since_key_ns[rows]), kind="stable")
    measured = np.full(surface.shape, -1)
    measured[tuple(axis[oldest_first] for axis in pixel)] = rows[oldest_first]
    hit = measured >= 0
    record.depth_m[shows] = np.where(hit, surface_m, 0)[shows]
    record.point[hit] = measured[hit]


def _surface(record: MapRecord, rows: Int, front: _Front) -> Float:
    """Return the (h,w) inverse depth (1/m) of a body's surface; arguments as in `_close`."""
    inside = front.inverse > 0
    known_m = np.maximum(record.depth_m, record.boundary_m)
    on_body = inside & (known_m > 0) & np.isin(record.point, rows)
    on_body &= known_m * front.inverse < 1 + _DEEP_M * front.inverse
    offset = 1 / np.where(on_body, known_m, 1) - front.inverse
    surface: Float = np.maximum(front.inverse + _smooth(offset, on_body, inside), 1e-3)
    return surface


def _show(
    record: MapRecord, cloud: Cloud, surface: Float, allowed_m: Float | Float32, share: Float
) -> tuple[Bool, Bool]:
    """Show a body; return (h,w) its pixels, and (h,w) the pixels where its returns count."""
    inside, now_m, surface_m = share > 0, record.filled_m, (1 / surface).astype(np.float32)
    whole = (share[inside] >= _LEAST_OF_OPEN).mean() >= _WHOLE
    in_front = (now_m > 0) & (now_m < surface_m - hidden_m(surface_m))
    closed = share >= (_LEAST_OF_WHOLE if whole else _LEAST_OF_OPEN)
    core = _well_inside(closed, float(np.median(record.gap_px[inside]))) & ~in_front
    moves = (record.depth_m > 0) & cloud.moving[record.point]
    outline = inside & ~in_front & ~core & ~(moves & (record.depth_m <= surface_m + allowed_m))
    if not whole:
        outline &= share >= _LEAST_OF_WHOLE
    for layer_m in (record.depth_m, record.filled_m, record.rejected_m):
        layer_m[outline] = 0  # what is seen past a moving object is not given back
    record.filled_m[core], record.votes[core] = surface_m[core], 1
    record.tilt[core] = np.stack(list(np.gradient(surface))[::-1], axis=-1)[core]
    shows, least_share = core.copy(), _VOTES_OF_WHOLE if whole else LEAST_SHARE
    pixel = np.flatnonzero(outline)
    votes = votes_for(record, [record.filled_m], pixel, surface_m[outline], surely=not whole)
    record.votes[outline], shows[outline] = votes, votes >= ROUNDED * least_share
    record.filled_m[shows] = surface_m[shows]
    record.on_body |= shows
    return shows, shows if whole else core


def _well_inside(closed: Bool, away_px: float) -> Bool:
    """Return the closed pixels farther than ``away_px`` from any open pixel of the box."""
    padded = np.pad(closed, 1, mode="edge").astype(np.uint8)
    distance_px = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    inside: Bool = distance_px > away_px
    return inside


def _smooth(offset: Float, known: Bool, inside: Bool) -> Float:
    """Return the (h,w) smooth offset (1/m) inside a body's outline, near the known offset."""
    number = np.cumsum(inside).reshape(inside.shape) - 1
    across, down = inside[:, :-1] & inside[:, 1:], inside[:-1] & inside[1:]
    first = np.concatenate([number[:, :-1][across], number[:-1][down]])
    second = np.concatenate([number[:, 1:][across], number[1:][down]])
    num = int(inside.sum())
    joins = sparse.coo_matrix((np.full(len(first), _STIFF), (first, second)), (num, num)).tocsr()
    joins = joins + joins.T
    # The offset o minimises Σ known (o - offset)² + _STIFF Σ |∇o|² + _HELD Σ o².
    weight = known[inside].astype(np.float64)
    diagonal = np.asarray(joins.sum(axis=1)).ravel() + weight + _HELD
    smooth_offset = np.zeros(inside.shape)
    system = (sparse.diags(diagonal) - joins).tocsr()
    smooth_offset[inside] = cg(system, weight * offset[inside], rtol=_ROUNDING)[0]
    return smooth_offset
