# SPDX-License-Identifier: MIT
"""Close the surfaces of moving objects, so that no background shows through them.

Dark paint and glass give few returns, and other sweeps measured the background there. A body
(`MovingBody`) is closed where rays end on it, open where they pass.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from densify.depth.exposure import Exposure, pixel_of
from densify.depth.fill import LEAST_SHARE, ROUNDED, VOTERS_REACH, votes_for
from densify.depth.measured_pixels import MapRecord
from densify.depth.patches import FOOTPRINT, HIDDEN_M, agree_m, hidden_m
from densify.depth.rays import MovingBody, find_crossing, half_spaces
from densify.geometry import cameras
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types import Cloud

_PRIOR = 0.05  # number of rays that end on the body, assumed everywhere
_COMPACT = 0.8  # closed share of the front from which all of a body is closed, as a car is
# Least share of rays that end on a compact body, and on the closed part of another one. At glass it
# is a third.
_LEAST_OF_COMPACT, _LEAST_OF_OTHER = 0.2, 0.5
_VOTES_OF_COMPACT = 0.75  # least share of the votes along the silhouette of a compact body
_DEEP_M = 3 * HIDDEN_M  # farther behind the front of the hull are seats, axles and the far side
# Weights of the difference of neighbouring offsets and of an offset itself, against one return
_SMOOTHNESS, _TOWARDS_HULL = 3.0, 0.01
_ROUNDING = float(np.finfo(np.float32).eps)  # relative rounding error of the stored depth
_AGREES = 2.0  # tolerance, as a multiple of that between two static points of a surface


def close_bodies(
    record: MapRecord, cloud: Cloud, exposure: Exposure, bodies: Mapping[int, MovingBody]
) -> None:
    """Put the surfaces of moving bodies into the record, in place, and mark them in ``on_body``.

    Depths clearly in front of a body stay. Elsewhere inside the outline of a hull only depths of
    moving objects stay. Pixels with a return of the body on its surface count as measured.
    ``bodies`` are by instance number.
    """
    margin_px = round(VOTERS_REACH * float(np.median(record.gap_px)))
    for instance, body in bodies.items():
        front = _Front.of(body, exposure, margin_px)
        if front is not None:
            rows = np.flatnonzero(cloud.moving & (cloud.instance == instance))
            _close(record.box(front.box), cloud, exposure, rows, body, front)


def find_far_inside(bodies: Iterable[MovingBody], exposure: Exposure, depth_m: Float32) -> Bool:
    """Return the mask (H,W) of depths ``depth_m`` (H,W) over 0.6 m behind the front of a body."""
    inverse = fronts(bodies, exposure)
    # The test is depth > front + _DEEP_M, times the inverse depth of the front.
    return (inverse > 0) & (depth_m * inverse > 1 + _DEEP_M * inverse)


def fronts(bodies: Iterable[MovingBody], exposure: Exposure) -> Float:
    """Return the inverse depths (H,W) in 1/m of the nearest surface of all hulls, 0 for none."""
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
        low = np.zeros(2, int)  # column and row
        high = np.array([camera.width_px, camera.height_px])
        # A hull that reaches behind the camera may cover the whole image.
        if (exposure.depth_m(sight.points_cam) > cameras.NEAREST_M).all():
            least_uv = np.floor(np.nanmin(sight.uv, axis=0)).astype(int)
            end_uv = np.ceil(np.nanmax(sight.uv, axis=0)).astype(int) + 1  # exclusive
            low, high = np.maximum(low, least_uv - margin_px), np.minimum(high, end_uv + margin_px)
        box = slice(low[1], high[1]), slice(low[0], high[0])
        row, column = np.mgrid[box]

        # The viewing ray of each pixel enters the hull at its front.
        uv = np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)
        ray = cameras.rays(camera, uv)
        enter_m, leave_m = find_crossing(half_spaces(sight.points_cam), np.zeros(3), ray)
        meets = (enter_m > 0) & (enter_m < leave_m)
        depth_m = exposure.depth_m(np.where(meets, enter_m, 1)[:, None] * ray)
        meets &= depth_m > cameras.NEAREST_M
        if not meets.any():
            return None
        inverse = np.divide(1, depth_m, out=np.zeros(len(ray)), where=meets)
        return _Front(box, inverse.reshape(row.shape))

    def pixels(
        self, exposure: Exposure, points: Float, velocity_m_s: Float32
    ) -> tuple[Int, tuple[Int, Int], Float]:
        """Return those of the points (N,3), key sweep's lidar frame, that lie within the box.

        Returns:
            point: (K,) indices of the points.
            pixel: (K,) rows and (K,) columns in the box.
            depth_m: (K,) depths of the points.
        """
        sight = exposure.see(points, velocity_m_s)
        point = np.flatnonzero(sight.inside)  # others may have no coordinates
        row, column = pixel_of(sight.uv[point])
        row, column = row - self.box[0].start, column - self.box[1].start
        height, width = self.inverse.shape
        in_box = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        point = point[in_box]
        return point, (row[in_box], column[in_box]), exposure.depth_m(sight.points_cam[point])

    def closed_share(self, body: MovingBody, exposure: Exposure, spacing_px: Float32) -> Float:
        """Return the (h,w) share, 0 to 1, of the rays entering at a pixel that end on the body."""
        # Each ray counts in the pixel where it enters the hull, blurred by the spot of the laser.
        blur_px = np.maximum(FOOTPRINT * np.median(spacing_px, axis=(0, 1)), 1.0)
        entry, pixel, depth_m = self.pixels(exposure, body.entries, body.velocity_m_s)
        # Rays that enter behind the front, on the far side of the hull, do not count.
        front_m = 1 / np.maximum(self.inverse[pixel], 1e-6)
        is_at_front = depth_m < front_m + hidden_m(front_m)
        counts = np.zeros((2, *self.inverse.shape))  # of rays that pass, and that end
        np.add.at(counts, (body.ends[entry].astype(np.int64), *pixel), is_at_front)
        num_passed, num_ended = (
            cv2.GaussianBlur(count, (0, 0), blur_px[0], sigmaY=blur_px[1]) for count in counts
        )
        # The blur, a Gaussian, leaves this part of _PRIOR rays in the pixel where they end.
        num_ended = num_ended + _PRIOR / (2 * np.pi * blur_px.prod())
        return np.where(self.inverse > 0, num_ended / (num_ended + num_passed), 0)


def _close(
    record: MapRecord, cloud: Cloud, exposure: Exposure, rows: Int, body: MovingBody, front: _Front
) -> None:
    """Put a body into a record cut to the front's box, in place: ``rows`` are its cloud points."""
    surface = _fit_surface(record, rows, front)
    surface_m = (1 / surface).astype(np.float32)
    allowed_m = _AGREES * agree_m(surface_m)
    closed_share = front.closed_share(body, exposure, record.spacing_px)
    is_shown, may_be_measured = _show(record, cloud, surface, allowed_m, closed_share)

    # Returns of the body on its surface
    point, pixel, depth_m = front.pixels(exposure, cloud.points[rows], cloud.velocity_m_s[rows])
    error_m = abs(depth_m - surface_m[pixel])
    agrees = may_be_measured[pixel] & (error_m <= allowed_m[pixel])
    row, column = (index[agrees] for index in pixel)
    agreeing_rows = rows[point[agrees]]

    # The oldest return is written first, so the return nearest to the key in time stays.
    oldest_first = np.argsort(-abs(cloud.since_key_ns[agreeing_rows]), kind="stable")
    source = np.full(surface.shape, -1)
    source[row[oldest_first], column[oldest_first]] = agreeing_rows[oldest_first]
    is_measured = source >= 0
    record.depth_m[is_shown] = np.where(is_measured, surface_m, 0)[is_shown]
    record.point[is_measured] = source[is_measured]


def _fit_surface(record: MapRecord, rows: Int, front: _Front) -> Float:
    """Return the (h,w) inverse depth (1/m) of a body's surface, from its cloud points ``rows``."""
    inside = front.inverse > 0
    measured_m = np.maximum(record.depth_m, record.boundary_m)
    on_body = inside & (measured_m > 0) & np.isin(record.point, rows)
    # Returns from deep inside, such as returns from seats, are not on the surface: the test is
    # measured_m < front + _DEEP_M, times the inverse depth of the front.
    on_body &= measured_m * front.inverse < 1 + _DEEP_M * front.inverse
    # The surface is the front of the hull, with a smooth offset through the returns.
    offset = 1 / np.where(on_body, measured_m, 1) - front.inverse
    return np.maximum(front.inverse + _smooth(offset, on_body, inside), 1e-3)  # at most 1 km away


def _show(
    record: MapRecord, cloud: Cloud, surface: Float, allowed_m: Float | Float32, closed_share: Float
) -> tuple[Bool, Bool]:
    """Show a body's surface (h,w), inverse depth in 1/m, in a record, in place.

    Returns of moving objects up to ``allowed_m`` (h,w) behind the surface stay. ``closed_share``
    (h,w) is the share of the rays that end on the body, 0 outside the hull.

    Returns:
        is_shown: (h,w) True where the record shows the body.
        may_be_measured: (h,w) True where returns of the body count as measured.
    """
    inside = closed_share > 0
    surface_m = (1 / surface).astype(np.float32)
    is_compact = (closed_share[inside] >= _LEAST_OF_OTHER).mean() >= _COMPACT

    # The core, well inside the closed part, shows the body, unless something is in front.
    is_hidden = (record.filled_m > 0) & (record.filled_m < surface_m - hidden_m(surface_m))
    is_closed = closed_share >= (_LEAST_OF_COMPACT if is_compact else _LEAST_OF_OTHER)
    core = _erode(is_closed, float(np.median(record.gap_px[inside]))) & ~is_hidden
    record.filled_m[core] = surface_m[core]
    record.votes[core] = 1
    slope_down, slope_right = np.gradient(surface)
    record.tilt[core] = np.stack([slope_right, slope_down], axis=-1)[core]

    # The outline is the other part of the front, which may show the body or the background. All
    # depths are removed, except those of moving objects in front of the surface or on the surface.
    is_moving = (record.depth_m > 0) & cloud.moving[record.point]
    stays = is_moving & (record.depth_m <= surface_m + allowed_m)
    outline = inside & ~is_hidden & ~core & ~stays
    if not is_compact:
        outline &= closed_share >= _LEAST_OF_COMPACT
    for layer_m in (record.depth_m, record.filled_m, record.rejected_m):
        layer_m[outline] = 0  # a background seen past a moving object is not given back

    # The votes of the pixels around decide where in the outline the silhouette is.
    pixel = np.flatnonzero(outline)
    votes = votes_for(
        record, [record.filled_m], pixel, surface_m[outline], with_shifts=not is_compact
    )
    least_share = _VOTES_OF_COMPACT if is_compact else LEAST_SHARE
    is_shown = core.copy()
    is_shown[outline] = votes >= ROUNDED * least_share
    record.votes[outline] = votes
    record.filled_m[is_shown] = surface_m[is_shown]
    record.on_body |= is_shown
    return is_shown, is_shown if is_compact else core


def _erode(mask: Bool, margin_px: float) -> Bool:
    """Return the pixels of a mask farther than ``margin_px`` from any other pixel of the box."""
    # With a border, a mask of the whole box has distances too.
    padded = np.pad(mask, 1, mode="edge").astype(np.uint8)
    distance_px = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return distance_px > margin_px


def _smooth(offset: Float, known: Bool, inside: Bool) -> Float:
    """Return the (h,w) smooth offset (1/m) inside a body's outline, near the ``known`` offsets."""
    # Pairs of neighbouring pixels inside, by the pixels' numbers
    number = np.cumsum(inside).reshape(inside.shape) - 1
    pair_right = inside[:, :-1] & inside[:, 1:]
    pair_down = inside[:-1] & inside[1:]
    left_or_upper = np.concatenate([number[:, :-1][pair_right], number[:-1][pair_down]])
    right_or_lower = np.concatenate([number[:, 1:][pair_right], number[1:][pair_down]])
    shape = (int(inside.sum()),) * 2
    weights = np.full(len(left_or_upper), _SMOOTHNESS)
    half = sparse.coo_matrix((weights, (left_or_upper, right_or_lower)), shape).tocsr()
    ties = half + half.T  # symmetric

    # The offset o minimises Σ known (o - offset)² + _SMOOTHNESS Σ |∇o|² + _TOWARDS_HULL Σ o². The
    # derivatives by o are 0 where system @ o = known · offset.
    weight = known[inside].astype(np.float64)
    diagonal = np.asarray(ties.sum(axis=1)).ravel() + weight + _TOWARDS_HULL
    system = (sparse.diags(diagonal) - ties).tocsr()
    smooth_offset = np.zeros(inside.shape)
    smooth_offset[inside] = cg(system, weight * offset[inside], rtol=_ROUNDING)[0]
    return smooth_offset
