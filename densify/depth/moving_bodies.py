# SPDX-License-Identifier: MIT
"""Close the surfaces of moving objects, so that no background shows through them.

Dark paint and glass give few returns, and other sweeps measured the background there. Every moving
object has a body: the convex hull of its points of the window, at the key sweep's time. The rays of
all sweeps are moved along with it. It is closed where they end on it, and open where they pass. Its
front is the nearest surface of the hull in each pixel, moved smoothly onto the object's own
returns. Pixels well inside the closed part show it, the image decides the silhouette.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg
from scipy.spatial import ConvexHull, KDTree, QhullError

from densify.depth.boundary_pixels import LEAST_SHARE, ROUNDED, VOTERS_REACH, least_votes
from densify.depth.exposure import Exposure
from densify.depth.hulls import crossing, half_spaces, passes_near
from densify.depth.image_points import FOOTPRINT, HIDDEN_FRACTION, HIDDEN_M
from densify.depth.layers import Layers
from densify.depth.measured_pixels import AGREE_FRACTION, AGREE_M
from densify.depth.object_rays import ObjectRays, rays_toward
from densify.depth.seen_through import Rays
from densify.geometry import cameras
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types import Cloud

_AROUND_M, _LEAST_AROUND = 0.25, 6  # a point of the body has six other such points around
_PRIOR = 0.05  # number of rays that end on the body, assumed everywhere
_WHOLE = 0.8  # closed share of the front from which a body is closed as a whole, as a car is
_LEAST_OF_WHOLE, _LEAST_OF_OPEN = 0.2, 0.5  # share of rays that end on the body; a third at glass
_VOTES_OF_WHOLE = 0.75  # share of the votes along the silhouette
_DEEP_M = 0.6  # farther behind the front of the hull are seats, axles and the far side
_STIFF, _HELD = 3.0, 0.01  # weights of a smooth and of a small offset, against one return
_ROUNDING = float(np.finfo(np.float32).eps)  # of the stored depth
_AGREES = 2.0  # tolerance, as a multiple of the tolerance between two static points of a surface


class MovingBody(NamedTuple):
    """The convex hull of a moving object, and the K rays of all sweeps that meet the hull."""

    # (V,3) corners of the hull in metres, key sweep's lidar frame and reference time
    corners: Float
    velocity_m_s: Float32  # (3,) velocity of the object without ego-motion, same frame
    entries: Float  # (K,3) positions where the rays enter the hull, same frame and time
    ends: Bool  # (K,) True if the ray ends on the object, False if it passes through
    frame: NDArray[np.integer]  # (K,) frame number of the ray's sweep


def moving_bodies(
    cloud: Cloud, rays: Rays, exposures: Collection[Exposure]
) -> dict[int, MovingBody]:
    """Return the bodies of moving objects in view of a camera, by instance number.

    Objects whose points span no volume have no body. The ``rays`` measured the ``cloud``.
    """
    moving = np.flatnonzero(cloud.moving & (cloud.instance >= 0))
    instance = cloud.instance[moving]
    rows_of = {k: moving[instance == k] for k in np.unique(instance).tolist()}
    hulls = {k: _corners(cloud.points[rows]) for k, rows in rows_of.items()}
    velocity_m_s = {k: np.median(cloud.velocity_m_s[rows], axis=0) for k, rows in rows_of.items()}

    def is_shown(k: int) -> bool:
        """Return True if a corner of the object's hull is in an image."""
        each_m_s = _each(velocity_m_s[k], hulls[k])
        return any(exposure.see(hulls[k], each_m_s).inside.any() for exposure in exposures)

    rows_of = {k: rows for k, rows in rows_of.items() if is_shown(k)}
    return {
        k: MovingBody(hulls[k], velocity_m_s[k], *_met(cloud, k, hulls[k], toward))
        for k, toward in rays_toward(cloud, rays, rows_of, hulls).items()
    }


def without_sweep(
    bodies: Mapping[int, MovingBody], cloud: Cloud, frame: int
) -> dict[int, MovingBody]:
    """Return the bodies without sweep ``frame``. cloud: points of all other sweeps."""
    reduced_bodies = {}
    for k, body in bodies.items():
        corners = _corners(cloud.points[cloud.moving & (cloud.instance == k)])
        kept = body.frame != frame
        if len(corners):
            rays = (column[kept] for column in (body.entries, body.ends, body.frame))
            reduced_bodies[k] = MovingBody(corners, body.velocity_m_s, *rays)
    return reduced_bodies


def _corners(points: Float) -> Float:
    """Return the (V,3) hull corners of the points (N,3) that have other points around."""
    away_m, _ = KDTree(points).query(points, [_LEAST_AROUND + 1])  # the first is the point
    points = points[np.ravel(away_m) <= _AROUND_M]
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # too few, or flat
        return points[:0]


def _met(
    cloud: Cloud, instance: int, corners: Float, rays: ObjectRays
) -> tuple[Float, Bool, NDArray[np.integer]]:
    """Return entries, ends and frame of the rays that meet a hull (V,3), as in `MovingBody`."""
    rays = rays.select(passes_near(corners, rays.start, rays.to_return))
    enter, leave = crossing(half_spaces(corners), rays.start, rays.to_return)
    meets = (enter > 0) & (enter < np.minimum(leave, 1))
    (rows, start, to_return), enter = rays.select(meets), enter[meets]
    ends = cloud.moving[rows] & (cloud.instance[rows] == instance)
    return start + enter[:, None] * to_return, ends, cloud.frame[rows]


def close_bodies(
    layers: Layers, cloud: Cloud, exposure: Exposure, bodies: Mapping[int, MovingBody]
) -> Layers:
    """Return the layers with the surfaces of moving bodies; ``solid`` marks their pixels.

    Depths clearly in front of a body stay. Elsewhere inside the outline of its hull only depths of
    moving objects stay. Pixels with a return of the body on its surface count as measured.
    """
    changed = ("depth_m", "filled_m", "rejected_m", "votes", "tilt", "point")
    layers = replace(layers, **{name: getattr(layers, name).copy() for name in changed})
    solid = np.zeros(layers.depth_m.shape, bool)
    for instance, body in bodies.items():
        margin_px = round(VOTERS_REACH * float(np.median(layers.gap_px)))
        front = _Front.of(body, exposure, margin_px)
        if front is not None:
            rows = np.flatnonzero(cloud.moving & (cloud.instance == instance))
            box_layers = layers.part(front.box)
            solid[front.box] |= _close(box_layers, cloud, exposure, rows, body, front)
    return replace(layers, solid=solid if layers.solid is None else layers.solid | solid)


def far_inside(bodies: Iterable[MovingBody], exposure: Exposure, depth_m: Float32) -> Bool:
    """Return (H,W) True where ``depth_m`` (H,W) is far behind a body's front, as behind glass."""
    far = np.zeros(depth_m.shape, bool)
    for body in bodies:
        front = _Front.of(body, exposure, 0)
        if front is not None:
            far[front.box] |= (front.inverse > 0) & (
                depth_m[front.box] * front.inverse > 1 + _DEEP_M * front.inverse
            )
    return far


def outlines(bodies: Iterable[MovingBody], exposure: Exposure) -> Bool:
    """Return (H,W) True at pixels within the outlines of the bodies' hulls."""
    shown = np.zeros((exposure.camera.height_px, exposure.camera.width_px), bool)
    for body in bodies:
        front = _Front.of(body, exposure, 0)
        if front is not None:
            shown[front.box] |= front.inverse > 0
    return shown


class _Front(NamedTuple):
    """The nearest surface of a body's hull in each pixel of the image."""

    box: tuple[slice, slice]  # rows and columns of the image around the hull, h by w pixels
    inverse: Float  # (h,w) inverse depth of the surface in 1/m, 0 outside the outline of the hull

    @staticmethod
    def of(body: MovingBody, exposure: Exposure, margin_px: int) -> _Front | None:
        """Return the front of a body, None if out of view; its box is ``margin_px`` wider."""
        camera = exposure.camera
        sight = exposure.see(body.corners, _each(body.velocity_m_s, body.corners))
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
        column, row = np.rint(np.where(sight.inside, sight.uv.T, -1)).astype(np.int64)
        row, column = row - self.box[0].start, column - self.box[1].start
        height, width = self.inverse.shape
        shown = sight.inside & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        point = np.flatnonzero(shown)
        depth_m = exposure.depth_m(sight.points_cam[point])
        return _Pixels(point, (row[point], column[point]), depth_m)

    def closed(self, body: MovingBody, exposure: Exposure, spacing_px: Float32) -> Float:
        """Return the (h,w) share, 0 to 1, of the rays entering at a pixel that end on the body."""
        blur_px = np.maximum(FOOTPRINT * np.median(spacing_px, axis=(0, 1)), 1.0)
        entered = self.pixels(exposure, body.entries, _each(body.velocity_m_s, body.entries))
        front_m = 1 / np.maximum(self.inverse[entered.pixel], 1e-6)
        faces = entered.depth_m < front_m + HIDDEN_M + HIDDEN_FRACTION * front_m
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
    layers: Layers, cloud: Cloud, exposure: Exposure, rows: Int, body: MovingBody, front: _Front
) -> Bool:
    """Put a body into ``layers``, cut to the front's box; return (h,w) True at its pixels."""
    # rows: of the body's points in the cloud
    surface = _surface(layers, rows, front)
    surface_m = (1 / surface).astype(np.float32)
    agree_m = _AGREES * (AGREE_M + AGREE_FRACTION * surface_m)
    share = front.closed(body, exposure, layers.spacing_px)
    shows, measurable = _shown(layers, cloud, surface, agree_m, share)
    layers.filled_m[shows] = surface_m[shows]

    returns = front.pixels(exposure, cloud.points[rows], cloud.velocity_m_s[rows])
    off_m = abs(returns.depth_m - surface_m[returns.pixel])
    agrees = measurable[returns.pixel] & (off_m <= agree_m[returns.pixel])
    pixel, rows = tuple(axis[agrees] for axis in returns.pixel), rows[returns.point[agrees]]
    oldest_first = np.argsort(-abs(cloud.since_key_ns[rows]), kind="stable")
    measured = np.full(surface.shape, -1)
    measured[tuple(axis[oldest_first] for axis in pixel)] = rows[oldest_first]
    hit = measured >= 0
    layers.depth_m[shows] = np.where(hit, surface_m, 0)[shows]
    layers.point[hit] = measured[hit]
    return shows


def _surface(layers: Layers, rows: Int, front: _Front) -> Float:
    """Return the (h,w) inverse depth (1/m) of a body's surface; arguments as in `_close`."""
    inside = front.inverse > 0
    known_m = np.maximum(layers.depth_m, layers.rim_m)
    on_body = inside & (known_m > 0) & np.isin(layers.point, rows)
    on_body &= known_m * front.inverse < 1 + _DEEP_M * front.inverse
    offset = 1 / np.where(on_body, known_m, 1) - front.inverse
    surface: Float = np.maximum(front.inverse + _smooth(offset, on_body, inside), 1e-3)
    return surface


def _shown(
    layers: Layers, cloud: Cloud, surface: Float, agree_m: Float32, share: Float
) -> tuple[Bool, Bool]:
    """Return (h,w) the pixels that show a body, and (h,w) the pixels where its returns count."""
    inside, now_m, surface_m = share > 0, layers.filled_m, (1 / surface).astype(np.float32)
    whole = (share[inside] >= _LEAST_OF_OPEN).mean() >= _WHOLE
    in_front = (now_m > 0) & (now_m < surface_m - HIDDEN_M - HIDDEN_FRACTION * surface_m)
    closed = share >= (_LEAST_OF_WHOLE if whole else _LEAST_OF_OPEN)
    core = _well_inside(closed, float(np.median(layers.gap_px[inside]))) & ~in_front
    moves = (layers.depth_m > 0) & cloud.moving[layers.point]
    outline = inside & ~in_front & ~core & ~(moves & (layers.depth_m <= surface_m + agree_m))
    if not whole:
        outline &= share >= _LEAST_OF_WHOLE
    for layer_m in (layers.depth_m, layers.filled_m, layers.rejected_m):
        layer_m[outline] = 0  # what is seen past a moving object is not given back
    layers.filled_m[core], layers.votes[core] = surface_m[core], 1
    layers.tilt[core] = np.stack(list(np.gradient(surface))[::-1], axis=-1)[core]
    shows, share_needed = core.copy(), _VOTES_OF_WHOLE if whole else LEAST_SHARE
    pixel, depth_m = np.flatnonzero(outline), surface_m[outline]
    votes_for = least_votes(layers, [layers.filled_m], pixel, depth_m, surely=not whole)
    layers.votes[outline], shows[outline] = votes_for, votes_for >= ROUNDED * share_needed
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


def _each(velocity_m_s: Float32, points: Float) -> Float32:
    return np.broadcast_to(velocity_m_s, points.shape)
