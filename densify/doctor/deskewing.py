# SPDX-License-Identifier: MIT
"""Whether the point times straighten the sweeps: with right ones, sweeps some metres apart lie best
on each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.doctor.findings import Finding, Verdict, unknown, wrong
from densify.doctor.sample import Sample, Spot, spot_of
from densify.geometry import poses
from densify.geometry.types import Float, Sweep

_LEAST_SPEED_M_S = 3.0
_NEAR_M = 25.0
_LEAST_HEIGHT_M = 0.5
_CLOSE_M = 1.0
_LEAST_POINTS = 50
_CLEARLY, _TOLD = 1.2, 1.05


def check_deskewing(sample: Sample, settings: RegisterSettings) -> list[Finding]:
    """The times as given, reversed, and none at all."""
    spot = sample.fastest
    if spot is None or spot.sweeps[0].offset_ns is None:
        return []
    if spot.speed_m_s < _LEAST_SPEED_M_S:
        text = (
            f"the vehicle drives at {spot.speed_m_s:.1f} m/s where it was looked at, "
            f"{_LEAST_SPEED_M_S:g} are needed"
        )
        return [unknown("deskewing", text)]
    given_m = apart_m(spot)
    others = {
        "with the times reversed": apart_m(_changed(spot, -1, settings)),
        "without times": apart_m(_changed(spot, 0, settings)),
    }
    best = min(others, key=lambda name: others[name])
    values = {"given_m": given_m, "reversed_m": others["with the times reversed"]}
    values |= {"without_m": others["without times"]}
    text = (
        f"sweeps {len(spot.sweeps) - 1} apart lie {given_m * 100:.1f} cm from each other with the "
        f"point times as given, " + ", ".join(f"{m * 100:.1f} cm {n}" for n, m in others.items())
    )
    if others[best] * _CLEARLY < given_m:
        return [
            wrong(
                "deskewing",
                f"{text}: best {best}",
                "correct the sign of the point times, or --set register.deskew=false",
                **values,
            )
        ]
    told = given_m * _TOLD < min(others.values())
    verdict = Verdict.FINE if told else Verdict.UNKNOWN
    text += "" if told else ": too slow here to tell"
    return [Finding("deskewing", verdict, text, values=values)]


def _changed(spot: Spot, sign: int, settings: RegisterSettings) -> Spot:
    def with_times(sweep: Sweep) -> Sweep:
        offset_ns = None if sign == 0 or sweep.offset_ns is None else sign * sweep.offset_ns
        return replace(sweep, offset_ns=offset_ns)

    return spot_of(tuple(with_times(sweep) for sweep in spot.sweeps), settings)


def apart_m(spot: Spot) -> float:
    """The median distance of what stands near in the last sweep from the first one; 1 m where
    they cannot be registered."""
    if spot.trajectory is None:
        return _CLOSE_M
    first, last = (_standing(spot.stretch.sweeps[row].sweep.points) for row in (0, -1))
    if min(len(first), len(last)) < _LEAST_POINTS:
        return _CLOSE_M
    T_first_last = poses.inverse(spot.stretch.sweeps[0].T_world_lidar) @ (
        spot.stretch.sweeps[-1].T_world_lidar
    )
    moved = poses.transform(T_first_last, last)
    distance_m, _ = cKDTree(first).query(moved[::4], distance_upper_bound=_CLOSE_M, workers=-1)
    return float(np.median(np.minimum(distance_m, _CLOSE_M)))


def _standing(points: Float) -> Float:
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    if not len(points):
        return points
    return points[points[:, 2] > np.percentile(points[:, 2], 10) + _LEAST_HEIGHT_M]
