# SPDX-License-Identifier: MIT
"""Compare the recording's poses with odometry from the sweeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.sample import Sample, Spot
from densify.geometry import poses
from densify.geometry.types import Float, Sweep
from densify.readers.recorded_poses import PoseTrack
from densify.scores.pose_metrics import RecordedError, main_error

_LEAST_WAY_M = 1.5  # an error of 3 % of this distance exceeds the tolerance
_WRONG = 4.0  # as a multiple of the tolerance
_CLOCK_S, _CLOCK_STEP_S, _CLOCK_OFF_S = 0.3, 0.02, 0.04
_CLOCK_TOLD_S = 0.1  # a period of most scanners; a wider interval gives no verdict
_NOISE_M, _NOISE_RAD, _EVEN_COST = 0.05, 1.5e-3, 4.0
_MUCH_BETTER = 0.4
CAM_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def changed(
    rotation: Callable[[Float], Float] = np.copy, scale: float = 1.0
) -> Callable[[Float], Float]:
    """Return a function on poses (4,4) that maps the rotation (3,3) and scales the translation."""

    def change(T: Float) -> Float:
        new = np.eye(4)
        new[:3, :3], new[:3, 3] = rotation(T[:3, :3]), scale * T[:3, 3]
        return new

    return change


def _rolled(by: int) -> Callable[[Float], Float]:
    """Return a function that rolls a rotation's quaternion x y z w, as `numpy.roll`."""
    return lambda R: Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), by)).as_matrix()


HYPOTHESES: Mapping[str, Callable[[Float], Float]] = {
    "they are inverted (T_lidar_world instead of T_world_lidar)": poses.inverse,
    "they are a camera's, not the lidar's": lambda T: poses.inverse(CAM_AXES) @ T @ CAM_AXES,
    "they are in millimetres": changed(scale=1e-3),
    "they are in kilometres": changed(scale=1e3),
    "their quaternions are x y z w, read as w x y z": changed(_rolled(1)),
    "their quaternions are w x y z, read as x y z w": changed(_rolled(-1)),
    "their rotations are transposed": changed(np.transpose),
}
"""Common mistake of poses -> the function (4,4) -> (4,4) that corrects it."""


def check_poses(sample: Sample) -> list[Finding]:
    """Compare the poses as given, and corrected for each of `HYPOTHESES`, with odometry."""
    spots = sample.registered
    try:
        given = [[sample.sequence.T_world_lidar(end.frame) for end in _ends(s)] for s in spots]
    except InputError as error:
        if "no poses" in str(error):
            return [finding("poses", FINE, "none; the sweeps register themselves")]
        return [finding("poses", WRONG, str(error), "--set register.source=kiss-icp")]
    if not spots:
        return [finding("poses", UNKNOWN, "no sweeps could be registered to compare with")]
    found = [_between([s.stretch.sweeps[row].T_world_lidar for row in (0, -1)]) for s in spots]
    between = [_between(pair) for pair in given]
    off = RecordedError.of(between, found)
    text = f"off by {off.m:.2f} m and {off.deg:.2f} deg from odometry over {off.way_m:.1f} m"
    values = {"off_m": off.m, "off_deg": off.deg, "way_m": off.way_m}
    others = {
        name: RecordedError.of([_between([change(T) for T in pair]) for pair in given], found)
        for name, change in HYPOTHESES.items()
    }
    best = min(others, key=lambda name: others[name].cost)
    remedy = "leave them out with --set register.source=kiss-icp"
    if off.cost > 1 and others[best].cost < min(_MUCH_BETTER * off.cost, _WRONG):
        text += f", but only by {others[best].m:.2f} m and {others[best].deg:.2f} deg if {best}"
        return [finding("poses", WRONG, text, f"correct the poses, or {remedy}", **values)]
    verdict = FINE if off.way_m >= _LEAST_WAY_M else UNKNOWN
    if off.cost > 1:
        verdict = WRONG if off.cost > _WRONG else SUSPICIOUS
        duration_s = np.mean([(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in map(_ends, spots)])
        told, mended = main_error(between, found, float(duration_s))
        text, remedy = text + told, mended + remedy
    elif verdict == UNKNOWN:
        text += "; the vehicle hardly moves"
    return [finding("poses", verdict, text, remedy, **values), *_check_clock(sample, found)]


def _check_clock(sample: Sample, found: list[Float]) -> list[Finding]:
    """Measure at which time shift the poses agree best with odometry (4,4) of each spot."""
    # It is observable only where the vehicle turns or changes its speed.
    late_s = np.arange(-_CLOCK_S, _CLOCK_S + 1e-9, _CLOCK_STEP_S)
    cost, num_used = np.zeros(len(late_s)), 0
    for spot, step in zip(sample.registered, found, strict=True):
        first_ns, last_ns = (end.stamp_ns for end in _ends(spot))
        track = _track(sample, first_ns, last_ns)
        if track is None:  # at the recording's ends
            continue
        num_used += 1
        for row, seconds in enumerate(late_s):
            ends_ns = [int(ns + 1e9 * seconds) for ns in (first_ns, last_ns)]
            off = poses.log(poses.inverse(_between([track.at(ns) for ns in ends_ns])) @ step)
            cost[row] += np.sum((off[3:] / _NOISE_M) ** 2) + np.sum((off[:3] / _NOISE_RAD) ** 2)
    if not num_used:
        text = "the recording has too few poses before and after the sweeps looked at"
        return [finding("clock of poses", UNKNOWN, text)]
    good = late_s[cost < cost.min() + _EVEN_COST]
    low_s, high_s, best_s = float(good.min()), float(good.max()), float(late_s[np.argmin(cost)])
    text = (
        f"odometry agrees best with the poses stamped {best_s * 1e3:+.0f} ms "
        f"({low_s * 1e3:+.0f} to {high_s * 1e3:+.0f}) later"
    )
    verdict, remedy = FINE, f"shift the poses' stamps by {-best_s * 1e3:+.0f} ms"
    if high_s - low_s > _CLOCK_TOLD_S:
        verdict, text = UNKNOWN, f"{text}; the vehicle drives too evenly to tell"
    elif low_s > _CLOCK_OFF_S or high_s < -_CLOCK_OFF_S:
        verdict = SUSPICIOUS
    values = {"late_s": best_s, "low_s": low_s, "high_s": high_s}
    return [finding("clock of poses", verdict, text, remedy, **values)]


def _track(sample: Sample, first_ns: int, last_ns: int) -> PoseTrack | None:
    """Return the recording's poses around a spot; None at its ends or if a pose is missing."""
    reach_ns = int(1e9 * _CLOCK_S)
    timeline = sample.timeline
    frames = timeline.within(first_ns - 2 * reach_ns, last_ns + 2 * reach_ns)
    stamp_ns = np.array([timeline.stamp_of(f) for f in frames], np.int64)
    if stamp_ns[0] > first_ns - reach_ns or stamp_ns[-1] < last_ns + reach_ns:
        return None
    try:
        T_world_lidar = np.stack([sample.sequence.T_world_lidar(f) for f in frames])
        return PoseTrack(sample.sequence.name, stamp_ns, T_world_lidar)
    except InputError:
        return None


def _ends(spot: Spot) -> tuple[Sweep, Sweep]:
    return spot.sweeps[0], spot.sweeps[-1]


def _between(pair: list[Float]) -> Float:
    return poses.inverse(pair[0]) @ pair[1]
