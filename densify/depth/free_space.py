# SPDX-License-Identifier: MIT
"""What other rays say against a depth map: a pixel whose surface more rays went through than
stopped at is open there, like the gaps of a fence between its pickets.

The image alone cannot tell: what a scanner saw elsewhere behind a car shows on the car too. So
every ray is followed to where it crosses the map's own surface, and tells of that pixel (free-space
evidence as in occupancy grids: Thrun et al., "Probabilistic Robotics", 2005, ch. 9).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import ProjectSettings
from densify.depth.exposure import Exposure, InView
from densify.depth.layers import Layers
from densify.depth.picture import blurred
from densify.depth.visibility import NOW_NS
from densify.geometry import poses
from densify.geometry.types import Bool, Cloud, Float, Float32, Reason, Stretch

_NUM_STEPS = 6
_SAME_M, _SAME_FRACTION = 0.05, 0.01  # from one step to the next: the crossing is found
_LEAST_BLUR_PX = 1.0
_GAPS, _GAPS_AROUND = 0.25, 0.7  # between rays, over which they tell of a pixel: standard deviation
_LEAST_RAYS, _LEAST_OF_KEY = 0.9, 0.3  # through a pixel itself, or more of them around it
_OF_FILLED = 0.5  # of the share of rays that may go through elsewhere
_OF_KEY = 0.35
# Gaps between rays to all sides of a mover: rays of other sweeps passed there before and after it.
_MOVER_GAPS = 3.6


class _Told(NamedTuple):
    """What rays tell of each pixel (H,W). num_through: how many went through the map, share: of
    those that met it."""

    num_through: Float32
    share: Float32

    @staticmethod
    def by(
        through: Float, stopped: Float, blur_px: tuple[float, float], shape: tuple[int, ...]
    ) -> _Told:
        """through, stopped: (K,2) px, where rays went through and where they ended. blur_px: down
        and across, standard deviation."""
        num_through, num_stopped = (
            _counts(uv, shape, blur_px) * (2 * np.pi * blur_px[0] * blur_px[1])
            for uv in (through, stopped)
        )
        met = num_through + num_stopped
        share = np.divide(num_through, met, out=np.zeros_like(met), where=met > 0)
        return _Told(num_through, share)

    def opens(self, share: float, least: float = _LEAST_RAYS) -> Bool:
        """(H,W) where more than ``share`` of the rays went through, and no fewer than ``least``."""
        opened: Bool = (self.share > share) & (self.num_through >= least)
        return opened


@dataclass(frozen=True)
class Rays:
    """The rays of the sweeps of a stretch, for a key of it."""

    stretch: Stretch
    key: int

    def starts(self, cloud: Cloud) -> Float:
        """(M,3) key frame, where the ray of each point started when it was fired."""
        starts = np.empty((len(cloud), 3))
        for frame in np.unique(cloud.frame).tolist():
            mine, registered = np.flatnonzero(cloud.frame == frame), self.stretch[frame]
            sweep = registered.sweep
            origin = np.stack([sweep.origin_m(n) for n in range(int(sweep.lidar.max()) + 1)])
            start = origin[cloud.lidar[mine]]
            if sweep.offset_ns is not None:
                order = np.argsort(sweep.row, kind="stable")
                found = order[np.searchsorted(sweep.row, cloud.row[mine], sorter=order)]
                offset_s = sweep.offset_ns[found, None] * 1e-9
                twist: Float = np.where(
                    offset_s < 0, registered.twist_before, registered.twist_after
                )
                start = poses.transform_each(offset_s * twist, start)
            starts[mine] = poses.transform(self.stretch.T_target_source(self.key, frame), start)
        return starts


def without_seen_through(
    layers: Layers,
    cloud: Cloud,
    view: InView,
    rays: Rays,
    reason: NDArray[np.uint8],
    settings: ProjectSettings,
) -> Layers:
    """Take out the pixels of which rays say that the place is open; what was measured there becomes
    a rim that is not accepted.

    view: of the cloud. rays: those that tell. reason: (M,) of the points, as far as the map is
    made.

    A ray of a hidden point went through where it crosses the surface that the map shows, if the
    point lies behind by more than ``settings.hidden_m`` plus ``hidden_fraction``; a ray stopped at
    the pixel of a point that is not hidden. Both are blurred by a quarter of the gap between rays,
    and more than the share ``settings.seen_through`` of rays that went through takes a pixel away.
    What is filled goes where half that share did, blurred by .7 gaps, and no less in the pixel
    itself: among leaves a sixth to a half of that was wrong, of a fence's pickets hardly any.
    Near what moves, and what the key sweep alone saw, the rays of other sweeps tell nothing: there
    only the key's own count, blurred by .7 gaps, and a third of them take a pixel away. Closed
    windows stay (`densify.depth.glass`): lasers go through glass.
    """
    told = np.isin(cloud.frame, rays.stretch.frames)
    told &= (reason != Reason.OUTSIDE) & (reason != Reason.VETOED)
    stopped = told & (reason != Reason.HIDDEN)
    passed = told & ~stopped & ~cloud.moving
    gap_px, shape = float(np.median(layers.gap_px)), layers.filled_m.shape
    near_mover = _near_movers(layers, cloud, view, stopped, round(_MOVER_GAPS * gap_px))
    through = _through(layers, cloud, view, rays, passed, settings)
    here, around = (
        _Told.by(through, view.uv[stopped[view.rows]], (blur_px, blur_px), shape)
        for blur_px in (max(_LEAST_BLUR_PX, wide * gap_px) for wide in (_GAPS, _GAPS_AROUND))
    )
    gaps = around.opens(_OF_FILLED * settings.seen_through) & (here.share >= around.share)
    dropped = here.opens(settings.seen_through) | (gaps & (layers.depth_m == 0))
    dropped &= ~near_mover
    if near_mover.any():
        now = told & (np.abs(cloud.since_key_ns) <= NOW_NS)
        column, row = np.rint(view.uv).astype(np.int64).T
        passed = np.zeros(len(cloud), bool)
        passed[view.rows] = near_mover[row, column]
        through = _through(layers, cloud, view, rays, passed & now, settings)
        across_px, down_px = np.median(layers.spacing_px, axis=(0, 1)).tolist()
        blur_px = (_GAPS_AROUND * down_px, _GAPS_AROUND * across_px)
        of_key = _Told.by(through, view.uv[(stopped & now)[view.rows]], blur_px, shape)
        dropped |= of_key.opens(_OF_KEY, _LEAST_OF_KEY) & near_mover
    if layers.window is not None:
        dropped &= ~layers.window
    return layers.without(dropped)


def _near_movers(layers: Layers, cloud: Cloud, view: InView, seen: Bool, reach_px: int) -> Bool:
    """(H,W) within ``reach_px`` of what moves. seen: (M,) points that are not hidden."""
    moving = (seen & cloud.moving)[view.rows]
    movers = _counts(view.uv[moving], layers.depth_m.shape) > 0
    if layers.alone is not None:
        movers |= layers.alone
    near: Bool = ndimage.maximum_filter(movers, 2 * reach_px + 1)
    return near


def _through(
    layers: Layers,
    cloud: Cloud,
    view: InView,
    rays: Rays,
    passed: Bool,
    settings: ProjectSettings,
) -> Float:
    """(K,2) px where rays went through the map. passed: (M,) points whose rays may have."""
    if not passed.any():
        return np.zeros((0, 2))
    hits = cloud.select(passed)
    return crossings(layers.filled_m, rays.starts(hits), hits.points, view.exposure, settings)


def _counts(
    uv: Float, shape: tuple[int, ...], blur_px: tuple[float, float] = (0.0, 0.0)
) -> Float32:
    """(K,2) px -> (H,W) how many in each pixel. blur_px: standard
    deviation down and across."""
    column, row = np.rint(uv).astype(np.int64).T
    counts = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1])
    pixels = counts.reshape(shape).astype(np.float32)
    return blurred(pixels, blur_px) if max(blur_px) > 0 else pixels


def crossings(
    surface_m: Float32,
    from_key: Float,
    to_key: Float,
    exposure: Exposure,
    settings: ProjectSettings,
) -> Float:
    """(P,2) px where the rays from ``from_key`` to ``to_key`` (K,3), key frame, cross the surface
    ``surface_m`` (H,W), of those that do clearly before they end.

    Looked for from the ray's end on: at the depth of the surface in that pixel the ray shows in
    another pixel, and so on until the depth stays the same.
    """
    start = poses.transform(exposure.T_cam_key, from_key)
    end = poses.transform(exposure.T_cam_key, to_key)
    end_m, still = exposure.depth_m(end), np.zeros(to_key.shape, np.float32)
    sight = exposure.see(to_key, still)
    uv, good = sight.uv, sight.inside
    depth_m = np.full(len(to_key), np.inf)
    for _ in range(_NUM_STEPS):
        column, row = np.rint(np.where(good[:, None], uv, 0)).astype(np.int64).T
        there_m = surface_m[row, column].astype(np.float64)
        with np.errstate(invalid="ignore"):
            same = abs(there_m - depth_m) <= _SAME_M + _SAME_FRACTION * depth_m
        depth_m = there_m
        share = _share(start, end, depth_m, exposure.measure)
        good &= (depth_m > 0) & (share > 0) & (share < 1)
        share = np.where(good, share, 1.0)[:, None]
        sight = exposure.see(from_key + share * (to_key - from_key), still)
        uv, good = sight.uv, good & sight.inside
    allowed_m = settings.hidden_m + settings.hidden_fraction * depth_m
    crosses: Float = uv[good & same & (end_m - depth_m > allowed_m)]
    return crosses


def _share(start: Float, end: Float, depth_m: Float, measure: str) -> Float:
    """(P,) at which share of the ways (P,3) from start to end, camera frame, they are as deep; NaN:
    nowhere."""
    way = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        if measure == "z":
            share: Float = (depth_m - start[:, 2]) / way[:, 2]
            return share
        square, along = (way**2).sum(axis=1), (start * way).sum(axis=1)
        within = along**2 - square * ((start**2).sum(axis=1) - depth_m**2)
        share = (np.sqrt(within) - along) / square
        return share
