# SPDX-License-Identifier: MIT
"""Compare poses of sweeps with other poses: true ones, or recorded ones with odometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float, Stretch

# Tolerance over half a second; an error of 1 % shifts surfaces by 0.1 m over 10 m.
_OFF_M, _OFF_PER_M, _OFF_DEG = 0.03, 0.01, 0.3


def window_pose_errors(
    stretch: Stretch, key: int, T_world_lidar: Callable[[int], Float]
) -> tuple[float, float]:
    """Return the root mean square errors (m, degrees) of a window's poses relative to the key's.

    ``T_world_lidar`` returns the true (4,4) pose of a frame.
    """
    T_key_world = poses.inverse(T_world_lidar(key))
    true = T_key_world @ np.stack([T_world_lidar(frame) for frame in stretch.frames])
    estimated = np.stack([stretch.T_target_source(key, frame) for frame in stretch.frames])
    T_error = poses.inverse(true) @ estimated
    squared_m2 = T_error[:, :3, 3] ** 2
    squared_rad2 = poses.log(T_error)[:, :3] ** 2
    error_m, error_rad = (
        np.sqrt(squared.sum(axis=1).mean()) for squared in (squared_m2, squared_rad2)
    )
    return float(error_m), float(np.rad2deg(error_rad))


class RecordedError(NamedTuple):
    """Error of recorded motions against odometry."""

    m: float  # median translation error in metres
    deg: float  # median rotation error in degrees
    cost: float  # the larger error, as a multiple of its tolerance
    way_m: float  # length of the longest motion by odometry

    @staticmethod
    def of(recorded: Sequence[Float], odometry: Sequence[Float]) -> RecordedError:
        """Compare recorded motions (4,4), each over one stretch of sweeps, with odometry's."""
        T_recorded, T_odometry = np.stack(recorded), np.stack(odometry)
        difference = poses.log(poses.inverse(T_recorded) @ T_odometry)
        way_m = np.linalg.norm(T_odometry[:, :3, 3], axis=1)
        error_rad, error_m = (np.linalg.norm(half, axis=1) for half in np.hsplit(difference, 2))
        error_deg = float(np.rad2deg(np.median(error_rad)))
        cost_m = float(np.median(error_m / (_OFF_M + _OFF_PER_M * way_m)))
        cost = max(cost_m, error_deg / _OFF_DEG)
        return RecordedError(float(np.median(error_m)), error_deg, cost, float(way_m.max()))


def main_error(
    recorded: Sequence[Float], odometry: Sequence[Float], duration_s: float
) -> tuple[str, str]:
    """Return a clause about the main error of recorded motions (4,4), and one about its correction.

    The error is a scale, or a drift over ``duration_s``. Without correction, that clause is "".
    """
    recorded_m, odometry_m = (
        np.array([T[:3, 3] for T in motions]) for motions in (recorded, odometry)
    )
    off_m, way_m = (recorded_m - odometry_m).mean(axis=0), odometry_m.mean(axis=0)
    # Errors in different directions have no common cause.
    if np.linalg.norm(off_m) < 0.5 * np.linalg.norm(recorded_m - odometry_m, axis=1).mean():
        mistake = "; no usual mistake explains it (another frame than the points', another clock,"
        return f"{mistake} or noise)", ""
    longer = float(off_m @ way_m / (way_m @ way_m))
    if abs(longer) * np.linalg.norm(way_m) > 0.7 * np.linalg.norm(off_m):
        sense = "long" if longer > 0 else "short"
        mistake = f": their ways are {abs(longer) * 100:.1f} % too {sense}"
        return mistake, f"divide their translations by {1 + longer:.3f}, or "
    axis = int(np.argmax(np.abs(off_m)))
    direction = (("forward", "back"), ("left", "right"), ("up", "down"))[axis][int(off_m[axis] < 0)]
    return f": they go {abs(off_m[axis]) / duration_s:.2f} m/s {direction} beside the sweeps", ""
