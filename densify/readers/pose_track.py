# SPDX-License-Identifier: MIT
"""The pose of a vehicle at any time, from poses recorded at a rate of their own.

Many data sets store each sweep as if it had been measured at one moment: ego-motion compensation
carried every point there. That smears moving objects, hides their times, and bends rings;
`PoseTrack.as_fired` undoes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float, Int

_MAX_BEYOND_NS = 200_000_000  # a pose is extrapolated at constant velocity for so long


@dataclass(frozen=True)
class PoseTrack:
    """where: the file, for messages. stamp_ns: (n,) int64, ascending. T_world_ego: (n,4,4)."""

    where: str
    stamp_ns: Int
    T_world_ego: Float

    def __post_init__(self) -> None:
        if len(self.stamp_ns) < 2 or np.any(np.diff(self.stamp_ns) <= 0):
            raise InputError(
                f"{self.where}: got {len(self.stamp_ns)} poses, expected two or more with stamps "
                f"that ascend"
            )

    def at(self, time_ns: int) -> Float:
        """Return (4,4) T_world_ego, interpolated between two poses.

        Raises InputError for a time more than 0.2 s before the first pose or after the last.
        """
        begin, end = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        beyond_ns = max(begin - time_ns, time_ns - end)
        if beyond_ns > _MAX_BEYOND_NS:
            raise InputError(
                f"{self.where}: no pose at {time_ns} ns: got poses from {begin} to {end}, "
                f"{beyond_ns * 1e-9:.2f} s away; expected poses around every sweep and image"
            )
        i = int(np.clip(np.searchsorted(self.stamp_ns, time_ns) - 1, 0, len(self.stamp_ns) - 2))
        span_ns = int(self.stamp_ns[i + 1] - self.stamp_ns[i])
        fraction = (time_ns - int(self.stamp_ns[i])) / span_ns
        return poses.interpolate(self.T_world_ego[i], self.T_world_ego[i + 1], fraction)

    def as_fired(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Undo ego-motion compensation.

        points: (N,3) metres, vehicle frame at ``stamp_ns``, to which they were compensated.
        offset_ns: (N,) firing times since then. Returns (N,3) in the vehicle frame at each point's
        own firing time; rows of zeros, which formats pad with, stay zeros.
        """
        fired = self._carry(points, stamp_ns, offset_ns, inverse=True)
        return np.where(points.any(axis=1, keepdims=True), fired, points)

    def compensated(self, points: Float, stamp_ns: int, offset_ns: Int) -> Float:
        """Inverse of `as_fired`."""
        return self._carry(points, stamp_ns, offset_ns, inverse=False)

    def _carry(self, points: Float, stamp_ns: int, offset_ns: Int, inverse: bool) -> Float:
        if not len(points):
            return points
        T_ref_world = poses.inverse(self.at(stamp_ns))
        low, high = stamp_ns + int(offset_ns.min()), stamp_ns + int(offset_ns.max())
        inside = self.stamp_ns[(self.stamp_ns > low) & (self.stamp_ns < high)].tolist()
        times_ns = [low, *inside, max(high, low + 1)]
        T_ref_ego = np.stack([T_ref_world @ self.at(t) for t in times_ns])
        since_ns = np.array([t - stamp_ns for t in times_ns], np.float64)
        fired_ns, row = np.unique(offset_ns, return_inverse=True)  # beams fire together
        turns = Slerp(since_ns, Rotation.from_matrix(T_ref_ego[:, :3, :3]))(fired_ns)[row]
        places_m = T_ref_ego[:, :3, 3].T
        shift_m = np.stack([np.interp(fired_ns, since_ns, p) for p in places_m], 1)[row]
        if inverse:
            return turns.apply(points - shift_m, inverse=True)
        return turns.apply(points) + shift_m
