# SPDX-License-Identifier: MIT
"""Define the record of a depth map in the making, and measure its pixels by the points in an image.

Of the visible points in a pixel, the one nearest in time to the key sweep wins. The pixel gets the
depth of a plane through the points around it that agree with the winner. The pixel is measured if
the sweep nearest to the key, of all sweeps with points around it, is among those that agree. Close
to a depth discontinuity it becomes a boundary pixel instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.exposure import InView, PointsInImage, pixel_of, points_in_image
from densify.depth.patches import (
    AGREE_FRACTION,
    AGREE_M,
    FOOTPRINT,
    HIDDEN_FRACTION,
    HIDDEN_M,
    add_moments,
    is_occluded,
    limit_inverse,
    plane,
    sorted_by_pixel,
)
from densify.depth.rays import MovingBody, Rays
from densify.geometry.arrays import select_rows
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Cloud, Float32, Int, Patches, Reason

# Half size of the window around a pixel whose points are compared with the winner, in spacings of
# rays, and its limits: more than half a spacing, so that neighbouring rays are in it
_REACH = 0.65
_LEAST_PX, _MOST_PX = 3, 24
_SLACK_M = 0.15 * AGREE_M  # added to the radius of a laser's spot, for errors of registration
_EDGE_WINDOW_PX = 1.5  # width beyond the spot in which points show if the surface goes on
# Beyond the window, least number of sweeps that agree, and least distance from a discontinuity in
# radii of a spot. Both are stricter than in the window: these sweeps share errors of registration,
# and may measure a background through the gaps of a nearer surface.
_FAR_SWEEPS, _FAR_EDGE = 6, 1.5
_RIDGE_PX2 = 0.02  # see `densify.depth.patches.plane`
ALL_ROUND = 3.0
"""Extent of a surface without a depth discontinuity nearby, in radii of a laser's spot."""
_BLOCK_PX = 16  # blocks within which the density of rays is about constant
_JUMP = 1.6  # least factor between spacings beyond the last of a scanner's denser rings


class MapInputs(NamedTuple):
    """All that one depth map is made of."""

    cloud: Cloud
    patches: Patches  # surface patches of the cloud's points
    view: InView  # points of the cloud in the image
    settings: ProjectSettings  # without ``visibility`` each pixel takes its nearest point
    filled: bool = True  # fill holes by interpolation
    lab: Float32 | None = None  # (H,W,3) image in L*a*b*; None accepts no boundary pixel by it
    rays: Rays | None = None  # of the window; None rejects no pixel as seen through
    bodies: Mapping[int, MovingBody] = {}  # of moving objects, by instance number


@dataclass
class MapRecord:
    """One depth map in the making, changed in place by its stages; (H,W) metres, 0 for no depth."""

    depth_m: Float32  # depth of pixels that are accepted as measured
    # Depth of boundary pixels, measured so close to a depth discontinuity that they may show the
    # background. Accepted boundary pixels keep this value too.
    boundary_m: Float32
    filled_m: Float32  # depth of accepted and of interpolated pixels
    rejected_m: Float32  # depth of pixels that a stage has rejected
    confidence: Float32  # confidence, 0 to 1, of pixels with a filled or rejected depth
    point: NDArray[np.int32]  # index, in the cloud, of the point that measured the pixel; -1 none
    tilt: Float32  # (H,W,2) slope of the surface's inverse depth to the right and down, 1/m per px
    # (H,W,2) spacing of neighbouring rays of one sweep, across and down, at all pixels
    spacing_px: Float32
    # (H,W) share of the image's votes for the depth of a boundary pixel, a filled or a rejected
    # pixel; 1 without a vote
    votes: Float32
    # (H,W) distance of measured pixels from a depth discontinuity, in radii of a laser's spot;
    # `ALL_ROUND` if none is near
    edge: Float32
    on_body: Bool  # (H,W) True on bodies of moving objects (`MovingBody`)
    lab: Float32  # (H,W,3) camera image in L*a*b*, (0,0,3) if there is no image
    points: PointsInImage  # points of the cloud in the image
    reason: NDArray[np.uint8]  # (M,) `Reason` of each point of the cloud
    # (P,10) `densify.depth.confidence.features` of P pixels; None without calibrated confidence
    evidence: Float32 | None = None

    @property
    def gap_px(self) -> Float32:
        """The spacing (H,W) of neighbouring rays in px, geometric mean of both directions."""
        return np.sqrt(self.spacing_px[..., 0] * self.spacing_px[..., 1])

    def box(self, box: tuple[slice, slice]) -> MapRecord:
        """Return the part of this record in a box of rows and columns, which shares its memory."""
        image_names = {field.name for field in fields(self)} - {"points", "reason", "evidence"}
        return replace(self, **{name: getattr(self, name)[box] for name in image_names})

    def reject(self, mask: Bool) -> None:
        """Reject the pixels of a mask (H,W), in place. Measured pixels become boundary pixels."""
        rejected = mask & (self.filled_m > 0)
        np.copyto(self.boundary_m, self.depth_m, where=rejected & (self.depth_m > 0))
        np.copyto(self.rejected_m, self.filled_m, where=rejected)
        self.depth_m[rejected] = 0
        self.filled_m[rejected] = 0


def measure(inputs: MapInputs) -> MapRecord:
    """Return the record of a map with its measured and boundary pixels, nothing interpolated.

    Points beyond the window measure only pixels that the window leaves empty, away from depth
    discontinuities. Without ``visibility`` in the settings each pixel takes its nearest point.
    """
    camera = inputs.view.exposure.camera
    shape = (camera.height_px, camera.width_px)
    points = points_in_image(inputs.cloud, inputs.view, inputs.patches)
    in_window = select_rows(points, ~points.far) if points.far.any() else points
    no_image = np.zeros((0, 0, 3), np.float32)
    zero_images = ("depth_m", "boundary_m", "filled_m", "rejected_m", "confidence", "edge")
    record = MapRecord(
        **{name: np.zeros(shape, np.float32) for name in zero_images},
        point=np.full(shape, -1, np.int32),
        tilt=np.zeros((*shape, 2), np.float32),
        # Of the window's sweeps, unless none of their points is in view
        spacing_px=_spacing_px(in_window if len(in_window.rows) else points, shape),
        votes=np.ones(shape, np.float32),
        on_body=np.zeros(shape, bool),
        lab=np.ascontiguousarray(no_image if inputs.lab is None else inputs.lab),
        points=points,
        reason=np.full(len(inputs.cloud), Reason.OUTSIDE, np.uint8),
    )
    if not inputs.settings.visibility:
        _measure_nearest(record)
        return record
    _measure_visible(record, in_window)
    if points.far.any():
        _measure_visible(record, points, beyond_window=True)
    return record


def _spacing_px(points: PointsInImage, shape: tuple[int, int]) -> Float32:
    """Return the (H,W,2) spacing of rays across and down in px, a mean over each block."""
    height, width = (-(-size // _BLOCK_PX) for size in shape)  # in blocks, rounded up
    row, column = pixel_of(points.uv)
    block = row // _BLOCK_PX * width + column // _BLOCK_PX
    num_points = np.bincount(block, minlength=height * width)
    if not num_points.any():
        return np.ones((*shape, 2), np.float32)
    sums = [np.bincount(block, spacing, height * width) for spacing in points.spacing_px.T]
    mean = (np.stack(sums, axis=1) / np.maximum(num_points, 1)[:, None]).astype(np.float32)

    # A block without points takes the spacing of the nearest block with points.
    empty = (num_points == 0).reshape(height, width)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    blocks = mean.reshape(height, width, 2)[tuple(nearest)]

    # A block takes the downward spacing of the block above or below if the other spacing is far
    # larger: the hole below the last of a scanner's denser rings is as wide.
    down_px = blocks[..., 1]
    widest_px = ndimage.maximum_filter1d(down_px, 3, axis=0)
    blocks[..., 1] = np.where(widest_px > _JUMP * down_px, widest_px, down_px)

    # The last blocks reach beyond the image.
    pixels = blocks.repeat(_BLOCK_PX, axis=0).repeat(_BLOCK_PX, axis=1)
    return np.ascontiguousarray(pixels[: shape[0], : shape[1]])


def _measure_nearest(record: MapRecord) -> None:
    """Measure each pixel by its nearest point, without occlusion or support tests."""
    points = record.points
    equal_rank = np.zeros(len(points.rows), np.int64)  # the depth decides
    start, order = sorted_by_pixel(points, equal_rank, record.depth_m.shape)
    pixel = np.flatnonzero(np.diff(start))  # pixels with a point
    nearest = order[start[pixel]]
    record.reason[points.rows] = Reason.NOT_CHOSEN
    record.depth_m.flat[pixel] = points.depth[nearest]
    record.edge.flat[pixel] = ALL_ROUND
    record.point.flat[pixel] = points.rows[nearest]
    record.tilt.reshape(-1, 2)[pixel] = points.slope[nearest]


def _measure_visible(record: MapRecord, points: PointsInImage, beyond_window: bool = False) -> None:
    """Measure pixels without a depth by visible points, and set the reason of each point.

    The points are those of the window, or with ``beyond_window`` all points. Pixels that the window
    measured, and reasons of its points, stay.
    """
    shape = record.depth_m.shape
    is_hidden = is_occluded(points, shape)
    # Occluded points rank behind the oldest visible one, so a pixel's first point is its winner.
    hidden_rank = int(points.age_ns.max(initial=0)) + 1
    rank = np.where(is_hidden, hidden_rank, points.age_ns)
    start, order = sorted_by_pixel(points, rank, shape)
    by_pixel = _ByPixel(select_rows(points, order), is_hidden[order], start, shape)
    all_pixels = _Measurements(*np.zeros((4, record.depth_m.size), np.float32))
    _measure_pixels.over_rows(record.depth_m.size, by_pixel, record.depth_m.ravel() > 0, all_pixels)
    pixel = np.flatnonzero(all_pixels.depth_m)
    winner = order[start[pixel]]
    depth_m, num_sweeps, agrees_nearest, edge = (column[pixel] for column in all_pixels)

    reasons = np.where(is_hidden, Reason.HIDDEN, Reason.NOT_CHOSEN).astype(np.uint8)
    if beyond_window:
        # The sweep nearest to the key need not agree, but six sweeps must. Pixels close to a depth
        # discontinuity stay empty.
        is_supported, is_inside = num_sweeps >= _FAR_SWEEPS, edge >= _FAR_EDGE
        is_used = is_supported & is_inside
        reasons[winner[~is_inside]] = Reason.EDGE
    else:
        is_used = is_supported = agrees_nearest > 0
        is_inside = edge >= 1  # else it is a boundary pixel
    reasons[winner[~is_supported]] = Reason.UNSUPPORTED
    is_judged = points.far == beyond_window
    record.reason[points.rows[is_judged]] = reasons[is_judged]

    used = pixel[is_used]
    record.depth_m.flat[used] = np.where(is_inside, depth_m, 0)[is_used]
    record.boundary_m.flat[used] = np.where(is_inside, 0, depth_m)[is_used]
    record.edge.flat[used] = edge[is_used]
    record.point.flat[used] = points.rows[winner[is_used]]
    record.tilt.reshape(-1, 2)[used] = points.slope[winner[is_used]]


class _Measurements(NamedTuple):
    """Measured values of the P pixels of an image, (P,) float32 each."""

    depth_m: Float32  # depth at the pixel's centre, 0 without a visible point
    num_sweeps: Float32  # number of sweeps that agree with the winner
    agrees_nearest: Float32  # 1 if the sweep nearest to the key, of those around, is one of them
    edge: Float32  # distance from a depth discontinuity in radii of a laser's spot


class _ByPixel(NamedTuple):
    """Points in an image sorted by pixel, occluded points last in each pixel."""

    points: PointsInImage
    is_hidden: Bool  # (K,) True for occluded points
    start: Int  # (H·W+1,) index of each pixel's first point
    shape: tuple[int, ...]  # height and width of the image


@inlined
def _window(reach_px):  # type: ignore[no-untyped-def]
    """Return the half size of a window in whole pixels, within its limits."""
    return int(min(max(np.rint(reach_px), _LEAST_PX), _MOST_PX))


@inlined
def _extend(extent, u, v):  # type: ignore[no-untyped-def]
    """Raise ``extent`` (8,), px of the surface in eight directions, by a point at (u, v)."""
    extent[0], extent[1] = max(extent[0], u), max(extent[1], -u)
    extent[2], extent[3] = max(extent[2], v), max(extent[3], -v)
    falling, rising = np.sqrt(0.5) * (u + v), np.sqrt(0.5) * (u - v)  # along the diagonals
    extent[4], extent[5] = max(extent[4], falling), max(extent[5], -falling)
    extent[6], extent[7] = max(extent[6], rising), max(extent[7], -rising)


@inlined
def _count(bits):  # type: ignore[no-untyped-def]
    """Return the number of sweeps in a bit set."""
    num_sweeps = 0
    while bits:
        num_sweeps += bits & 1
        bits >>= 1
    return num_sweeps


@inlined
def _compare(by_pixel, winner, u0, v0, centre, tolerance, edge_px, moments, extent):  # type: ignore[no-untyped-def]
    """Compare the points around pixel (v0, u0) with the tangent plane of its ``winner``, a point.

    The plane has the inverse depth ``centre`` (1/m) at the pixel. A point agrees if it deviates by
    at most ``tolerance`` (1/m). Its deviation is added to ``moments`` (9,). In a square of half
    size ``edge_px`` an agreeing point raises ``extent`` (8,).

    Returns:
        sweeps: Bit set of the agreeing sweeps in the window.
        agrees_nearest: True if no other sweep in the window is nearer in time to the key.
        has_background: True if a point in the square is clearly behind the plane.
    """
    points, is_hidden, start, shape = by_pixel
    uv, inverse, age_ns = points.uv, points.inverse, points.age_ns
    slope_u, slope_v = points.slope[winner, 0], points.slope[winner, 1]
    # A step of depth (m), times the squared inverse depth, is a step of inverse depth (1/m).
    background_step = HIDDEN_M + HIDDEN_FRACTION / inverse[winner]
    background_step = background_step * inverse[winner] * inverse[winner]
    # The window of the pixel. The search covers the window and the square.
    reach_u = _window(_REACH * points.spacing_px[winner, 0])
    reach_v = _window(_REACH * points.spacing_px[winner, 1])
    wide_u, wide_v = max(reach_u, _window(edge_px)), max(reach_v, _window(edge_px))
    sweeps, has_background = np.int64(0), False
    # Least age of an agreeing sweep, and of another sweep. At least the winner itself agrees.
    agreeing_ns = other_ns = age_ns[winner]
    left, right = max(u0 - wide_u, 0), min(u0 + wide_u, shape[1] - 1)
    for v in range(max(v0 - wide_v, 0), min(v0 + wide_v, shape[0] - 1) + 1):
        for j in range(start[v * shape[1] + left], start[v * shape[1] + right + 1]):
            k = np.uint64(j)  # unsigned, so that no access checks for a negative index
            du, dv = uv[k, 0] - u0, uv[k, 1] - v0
            deviation = inverse[k] - (centre + slope_u * du + slope_v * dv)
            is_close = abs(du) <= edge_px and abs(dv) <= edge_px
            # Points anywhere in the window's last pixel column count, hence half a pixel more.
            in_window = abs(du) <= reach_u + 0.5 and abs(v - v0) <= reach_v
            if is_hidden[k] or abs(deviation) > tolerance:
                has_background |= is_close and deviation < -background_step
                other_ns = min(other_ns, age_ns[k]) if in_window else other_ns
                continue
            # No branches: half of them would be predicted wrongly. The 63 bits of a positive number
            # are for frame numbers modulo 63.
            sweeps |= np.int64(in_window) << np.int64(points.frame[k] % 63)
            agreeing_ns = min(agreeing_ns, age_ns[k]) if in_window else agreeing_ns
            _extend(extent, du if is_close else 0.0, dv if is_close else 0.0)
            # The weight falls to 0 just outside the window.
            weight = max(1 - abs(du) / (reach_u + 1), 0.0) * max(1 - abs(dv) / (reach_v + 1), 0.0)
            add_moments(moments, weight, du, dv, deviation)
    return sweeps, agreeing_ns <= other_ns, has_background


@Kernel
def _measure_pixels(begin, end, by_pixel, has_depth, measurements):  # type: ignore[no-untyped-def]
    """Fill the `_Measurements` of pixels without a depth that have a visible point."""
    moments, extent = np.empty(9), np.empty(8)
    points, start, width = by_pixel.points, by_pixel.start, by_pixel.shape[1]
    for p in range(begin, end):
        # The first point of a pixel wins, unless there is none or only occluded ones.
        winner = start[p]
        if has_depth[p] or winner == start[p + 1] or by_pixel.is_hidden[winner]:
            continue

        # The tangent plane of the winner, at the pixel's centre
        v0, u0 = p // width, p % width
        inverse, uv, slope = points.inverse[winner], points.uv[winner], points.slope[winner]
        centre = inverse + slope[0] * (u0 - uv[0]) + slope[1] * (v0 - uv[1])
        # From a tolerance of depth (m) to a tolerance of inverse depth (1/m)
        tolerance = (AGREE_M + AGREE_FRACTION / inverse) * inverse * inverse
        slack_px = _SLACK_M * points.focal_px[winner, 0] * inverse
        spot_px = FOOTPRINT * points.spacing_px[winner, 0] + slack_px

        # The depth is that of the tangent plane, corrected by a second plane. The second plane is
        # fitted to the deviations of the agreeing points from the first, and counts at the centre.
        moments[:], extent[:] = 0.0, 0.0
        sweeps, agrees_nearest, has_background = _compare(
            by_pixel, winner, u0, v0, centre, tolerance, spot_px + _EDGE_WINDOW_PX, moments, extent
        )
        deviation, _, _ = plane(moments, _RIDGE_PX2)
        deviation = min(max(deviation, -tolerance), tolerance)
        measurements.depth_m[p] = 1 / limit_inverse(centre + deviation, inverse)
        measurements.num_sweeps[p] = _count(sweeps)
        measurements.agrees_nearest[p] = agrees_nearest
        # The discontinuity is where the surface ends first.
        is_near_edge = has_background and spot_px > 0
        measurements.edge[p] = extent.min() / spot_px if is_near_edge else ALL_ROUND
