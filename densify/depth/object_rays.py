# SPDX-License-Identifier: MIT
"""Find the rays of a window that may meet the hulls of moving objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from densify.depth.seen_through import Rays
from densify.geometry import poses
from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types import Cloud


class ObjectRays(NamedTuple):
    """K rays in the key sweep's lidar frame, moved along with an object to the key's time."""

    rows: Int  # (K,) indices of the returns in the cloud
    start: Float  # (K,3) origin of each ray
    to_return: Float  # (K,3) vector from the origin to the return

    def select(self, keep: Bool) -> ObjectRays:
        """Return the rays where ``keep`` (K,) is True."""
        return ObjectRays(self.rows[keep], self.start[keep], self.to_return[keep])


def rays_toward(
    cloud: Cloud, rays: Rays, rows_of: Mapping[int, Int], corners: Mapping[int, Float]
) -> dict[int, ObjectRays]:
    """Return the rays of all sweeps that may meet the hull of each object, by instance number.

    ``rows_of`` are the indices of each object's points in the cloud, ``corners`` (V,3) those of its
    hull at the key's time.
    """
    rays_of: dict[int, list[ObjectRays]] = {k: [] for k in rows_of}
    for frame in rays.stretch.frames if rows_of else ():
        returns, motions = _Returns.of(cloud, rays, frame), dict[int, Float]()
        for k, rows in rows_of.items():
            seen = rows[cloud.frame[rows] == frame]
            if len(seen):
                motions[k] = poses.fit_rigid(cloud.rigid_points[seen], cloud.points[seen])
        # motions: of each object from the sweep to the key, in the key sweep's lidar frame
        toward = {
            k: returns.toward(poses.transform(poses.inverse(T_key_sweep), corners[k]))
            for k, T_key_sweep in motions.items()
        }
        starts = rays.starts(cloud.select(np.concatenate([returns.rows[:0], *toward.values()])))
        for k, T_key_sweep in motions.items():
            rows = toward[k]
            start, starts = poses.transform(T_key_sweep, starts[: len(rows)]), starts[len(rows) :]
            end = poses.transform(T_key_sweep, cloud.rigid_points[rows])
            rays_of[k].append(ObjectRays(rows, start, end - start))
    return {
        k: ObjectRays(
            np.concatenate([r.rows for r in sweep_rays]),
            np.concatenate([r.start for r in sweep_rays]),
            np.concatenate([r.to_return for r in sweep_rays]),
        )
        for k, sweep_rays in rays_of.items()
    }


class _Returns(NamedTuple):
    """The N returns of one sweep in a cloud, key sweep's lidar frame."""

    rows: Int  # (N,) indices in the cloud
    origin: Float  # (3,) lidar at the sweep's reference time
    xy: Float32  # (2,N) horizontal positions relative to the origin in metres
    moved_m: float  # greatest distance of a ray's start from the lidar

    @staticmethod
    def of(cloud: Cloud, rays: Rays, frame: int) -> _Returns:
        """Return the returns of sweep ``frame`` among the points of the window (``cloud``)."""
        rows = np.flatnonzero(cloud.frame == frame)
        origin = rays.stretch.T_target_source(rays.key, frame)[:3, 3]
        xy = (cloud.rigid_points.take(rows, axis=0) - origin)[:, :2].T.astype(np.float32)
        return _Returns(rows, origin, xy, rays.moved_m(frame))

    def toward(self, corners: Float) -> Int:
        """Return the rows of the returns whose rays may meet a hull with these corners (V,3)."""
        x, y = (corners - self.origin)[:, :2].T
        middle = np.array([x.mean(), y.mean()])
        range_m = np.hypot(*middle)
        radius_m = np.hypot(x - middle[0], y - middle[1]).max() + self.moved_m
        if range_m <= radius_m:
            return self.rows
        right, ahead = (middle / range_m).astype(np.float32)
        wide = np.float32(radius_m / np.sqrt(range_m**2 - radius_m**2))
        along = right * self.xy[0] + ahead * self.xy[1]
        aside = ahead * self.xy[0] - right * self.xy[1]
        return self.rows[(along > range_m - radius_m) & (abs(aside) <= wide * along)]
