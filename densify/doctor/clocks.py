# SPDX-License-Identifier: MIT
"""Check the stamps of sweeps and points: order, gaps, unit, span, and whether they deskew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify.config import RegisterSettings
from densify.doctor.findings import Finding, fine, suspicious, unknown, wrong
from densify.doctor.sample import Sample, Spot, spot_of
from densify.geometry import poses
from densify.geometry.types import Float, Sweep
from densify.readers.timeline import format_frames

_PERIODS_S = (0.015, 1.1)  # of scanners that are built: 50 Hz to 1 Hz
_HOLE_PERIODS = 3.1
_UNITS = {
    "seconds taken for nanoseconds": 1e9,
    "milliseconds taken for nanoseconds": 1e6,
    "microseconds taken for nanoseconds": 1e3,
    "nanoseconds taken for microseconds": 1e-3,
    "nanoseconds taken for milliseconds": 1e-6,
    "nanoseconds taken for seconds": 1e-9,
}
_LEAST_SPEED_M_S = 3.0
_NEAR_M = 25.0
_LEAST_HEIGHT_M = 0.5
_CLOSE_M = 1.0
_LEAST_POINTS = 50
_CLEARLY, _TOLD = 1.2, 1.05
_WHOLE_SWEEP = (0.5, 1.5)  # of a period: from the first to the last point


def check_stamps(sample: Sample) -> list[Finding]:
    """The sweeps' reference times."""
    timeline = sample.timeline
    if timeline.unknown:
        frame, reason = next(iter(timeline.unknown.items()))
        return [
            wrong(
                "stamps",
                f"{len(timeline.unknown)} of {len(timeline.frames)} sweeps have no stamp that can "
                f"be right, the first of them frame {frame} ({reason})",
                "correct the stamps of these sweeps, or remove their files",
            )
        ]
    if len(timeline.frames) < 2:
        return [unknown("stamps", "one sweep tells no rate")]
    step_ns = np.diff(timeline.stamp_ns)
    backward = np.flatnonzero(step_ns <= 0)
    if len(backward):
        row = int(backward[0])
        pair = timeline.frames[row], timeline.frames[row + 1]
        what = "the same as" if step_ns[row] == 0 else f"{-step_ns[row] * 1e-6:.1f} ms before"
        return [
            wrong(
                "stamps",
                f"{len(backward)} of {len(step_ns)} steps do not go on in time; the first: the "
                f"stamp of frame {pair[1]} is {what} that of frame {pair[0]}",
                "sort the sweeps by their stamps, or correct the file of stamps",
                num_backward=len(backward),
            )
        ]
    return [_rate(sample), *_holes(sample)]


def _rate(sample: Sample) -> Finding:
    period_s = sample.timeline.period_ns * 1e-9
    values = {"period_s": period_s}
    if _PERIODS_S[0] <= period_s <= _PERIODS_S[1]:
        return fine("stamps", f"{1 / period_s:.2f} Hz, ascending", **values)
    fits = [name for name, f in _UNITS.items() if _PERIODS_S[0] <= period_s * f <= _PERIODS_S[1]]
    guess = f"; it would be {1 / (period_s * _UNITS[fits[0]]):.1f} Hz with {fits[0]}" * bool(fits)
    verdict = wrong if fits else suspicious
    return verdict(
        "stamps",
        f"from sweep to sweep {period_s:.3g} s pass, expected {_PERIODS_S[0]} to "
        f"{_PERIODS_S[1]} s{guess}",
        "correct the unit of the stamps",
        **values,
    )


def _holes(sample: Sample) -> list[Finding]:
    timeline = sample.timeline
    step_ns = np.diff(timeline.stamp_ns)
    rows = np.flatnonzero(step_ns > _HOLE_PERIODS * timeline.period_ns)
    if not len(rows):
        return []
    longest = int(rows[np.argmax(step_ns[rows])])
    return [
        suspicious(
            "holes in time",
            f"{len(rows)} of more than three periods, the longest of {step_ns[longest] * 1e-9:.1f} "
            f"s after frame {timeline.frames[longest]}; windows end there (after frames "
            f"{format_frames(timeline.frames[row] for row in rows)})",
            "nothing, if the sweeps were never recorded; else fetch them again",
            num_holes=len(rows),
        )
    ]


def check_point_times(sample: Sample) -> list[Finding]:
    """The firing times within a sweep."""
    speed_m_s = max((spot.speed_m_s for spot in sample.spots), default=0.0)
    period_s = sample.timeline.period_ns * 1e-9
    findings = []
    sweeps = [spot.sweeps[spot.middle] for spot in sample.spots]
    if len(sample.timeline.frames) < 2:
        return []
    if any(s.offset_ns is None for s in sweeps):
        return []  # `check_rings` says if they are needed
    for lidar in sorted({int(n) for s in sweeps for n in np.unique(s.lidar)}):
        low_s, high_s = _span_s(sample, lidar)
        span = (high_s - low_s) / period_s
        where = -low_s / max(high_s - low_s, 1e-12)
        name = "point times" if lidar == 0 else f"point times of scanner {lidar}"
        values = {"first_s": low_s, "last_s": high_s, "speed_m_s": speed_m_s}
        text = (
            f"{low_s * 1e3:+.1f} to {high_s * 1e3:+.1f} ms around the stamp, {span:.3g} periods; "
            f"the stamp is at {round(100 * where)} % of the sweep"
        )
        if _WHOLE_SWEEP[0] <= span <= _WHOLE_SWEEP[1]:
            finding = fine(name, text, **values)
        elif span < 0.02 or span > 10:
            finding = wrong(name, text, "correct the unit of the point times", **values)
        else:
            remedy = "compare the point times with the scanner's rate"
            finding = suspicious(name, text, remedy, **values)
        findings.append(finding)
    return findings


def _span_s(sample: Sample, lidar: int) -> tuple[float, float]:
    """The earliest and the latest time of one scanner, medians over the spots."""
    ends = []
    for spot in sample.spots:
        sweep = spot.sweeps[spot.middle]
        if sweep.offset_ns is not None and (mine := sweep.lidar == lidar).any():
            ends.append(np.percentile(sweep.offset_ns[mine], [0.1, 99.9]) * 1e-9)
    low_s, high_s = np.median(ends, axis=0)
    return float(low_s), float(high_s)


def check_deskewing(sample: Sample, settings: RegisterSettings) -> list[Finding]:
    """Compare the alignment of sweeps with the point times given, reversed and left out."""
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
    if given_m * _TOLD < min(others.values()):
        return [fine("deskewing", text, **values)]
    return [unknown("deskewing", f"{text}: too slow here to tell", **values)]


def _changed(spot: Spot, sign: int, settings: RegisterSettings) -> Spot:
    def with_times(sweep: Sweep) -> Sweep:
        offset_ns = None if sign == 0 or sweep.offset_ns is None else sign * sweep.offset_ns
        return replace(sweep, offset_ns=offset_ns)

    return spot_of(tuple(with_times(sweep) for sweep in spot.sweeps), settings)


def apart_m(spot: Spot) -> float:
    """Return the median distance (m) of near points above the ground in the last sweep from the
    first sweep; 1 m where they cannot be registered."""
    if spot.trajectory is None:
        return _CLOSE_M
    first, last = (_above_ground(spot.stretch.sweeps[row].sweep.points) for row in (0, -1))
    if min(len(first), len(last)) < _LEAST_POINTS:
        return _CLOSE_M
    T_first_last = poses.inverse(spot.stretch.sweeps[0].T_world_lidar) @ (
        spot.stretch.sweeps[-1].T_world_lidar
    )
    moved = poses.transform(T_first_last, last)
    distance_m, _ = cKDTree(first).query(moved[::4], distance_upper_bound=_CLOSE_M, workers=-1)
    return float(np.median(np.minimum(distance_m, _CLOSE_M)))


def _above_ground(points: Float) -> Float:
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    if not len(points):
        return points
    return points[points[:, 2] > np.percentile(points[:, 2], 10) + _LEAST_HEIGHT_M]
