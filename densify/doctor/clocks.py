# SPDX-License-Identifier: MIT
"""Check the stamps of sweeps and points: order, holes, unit, span, and effect on deskewing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.sample import Sample, Spot, spot_of
from densify.geometry import poses
from densify.geometry.types import Float, Sweep
from densify.readers.timeline import format_frames

_PERIODS_S = (0.015, 1.1)  # range of existing scanners, 50 Hz to 1 Hz
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
_WHOLE_SWEEP = (0.5, 1.5)  # plausible time from first to last point, in periods
_TURN_S = (0.04, 0.25)  # of existing scanners, 25 to 4 Hz


def check_stamps(sample: Sample) -> list[Finding]:
    """Check the sweeps' reference times: order, rate and holes."""
    timeline = sample.timeline
    frames, step_ns = timeline.frames, np.diff(timeline.stamp_ns)
    if timeline.unknown:
        frame, reason = next(iter(timeline.unknown.items()))
        text = (
            f"{len(timeline.unknown)} of {len(frames)} sweeps have no stamp that can be right, the "
            f"first of them frame {frame} ({reason})"
        )
        remedy = "correct the stamps of these sweeps, or remove their files"
        return [finding("stamps", WRONG, text, remedy)]
    if len(frames) < 2:
        return [finding("stamps", UNKNOWN, "one sweep tells no rate")]
    backward = np.flatnonzero(step_ns <= 0)
    if len(backward):
        row = int(backward[0])
        text = (
            f"{len(backward)} of {len(step_ns)} steps do not go on in time; the first: the stamp "
            f"of frame {frames[row + 1]} is {-step_ns[row] * 1e-6:.1f} ms before that of frame "
            f"{frames[row]}"
        )
        remedy = "sort the sweeps by their stamps, or correct the file of stamps"
        return [finding("stamps", WRONG, text, remedy, num_backward=len(backward))]
    findings = [_rate(timeline.period_ns * 1e-9)]
    rows = np.flatnonzero(step_ns > _HOLE_PERIODS * timeline.period_ns)
    if len(rows):
        longest = int(rows[np.argmax(step_ns[rows])])
        text = (
            f"{len(rows)} of more than three periods, the longest of {step_ns[longest] * 1e-9:.1f} "
            f"s after frame {frames[longest]}; windows end there (after frames "
            f"{format_frames(frames[row] for row in rows)})"
        )
        remedy = "nothing, if the sweeps were never recorded; else fetch them again"
        findings.append(finding("holes in time", SUSPICIOUS, text, remedy, num_holes=len(rows)))
    return findings


def _rate(period_s: float) -> Finding:
    least_s, most_s = _PERIODS_S
    if least_s <= period_s <= most_s:
        return finding("stamps", FINE, f"{1 / period_s:.2f} Hz, ascending", period_s=period_s)
    text = f"from sweep to sweep {period_s:.3g} s pass, expected {least_s} to {most_s} s"
    fits = [name for name, f in _UNITS.items() if least_s <= period_s * f <= most_s]
    if fits:
        text += f"; it would be {1 / (period_s * _UNITS[fits[0]]):.1f} Hz with {fits[0]}"
    verdict = WRONG if fits else SUSPICIOUS
    return finding("stamps", verdict, text, "correct the unit of the stamps", period_s=period_s)


def check_point_times(sample: Sample) -> list[Finding]:
    """Check that the firing times within a sweep span about one period."""
    findings, sweeps = [], [spot.sweeps[spot.middle] for spot in sample.spots]
    period_s = sample.timeline.period_ns * 1e-9
    if any(s.offset_ns is None for s in sweeps):
        return [finding("point times", UNKNOWN, "the points have no times")]
    if len(sample.timeline.frames) < 2:
        return [finding("point times", UNKNOWN, "one sweep tells no period to compare with")]
    for lidar in sample.lidars:
        offsets_s = [
            s.offset_ns[s.lidar == lidar] * 1e-9 for s in sweeps if s.offset_ns is not None
        ]
        ends_s = [np.percentile(offset_s, [0.1, 99.9]) for offset_s in offsets_s if len(offset_s)]
        low_s, high_s = np.median(ends_s, axis=0).tolist()
        span, where = (high_s - low_s) / period_s, -low_s / max(high_s - low_s, 1e-12)
        text = (
            f"{low_s * 1e3:+.1f} to {high_s * 1e3:+.1f} ms around the stamp, {span:.3g} periods; "
            f"the stamp is at {round(100 * where)} % of the sweep"
        )
        verdict, remedy = SUSPICIOUS, "compare the point times with the scanner's rate"
        if _WHOLE_SWEEP[0] <= span <= _WHOLE_SWEEP[1]:
            verdict = FINE
        elif span < 1 and _TURN_S[0] <= high_s - low_s <= _TURN_S[1]:
            verdict, text = FINE, f"{text}; one of {round(1 / span)} turns of the scanner was kept"
        elif span < 0.02 or span > 10:
            verdict, remedy = WRONG, "correct the unit of the point times"
        name = "point times" + f" of scanner {lidar}" * (lidar > 0)
        findings.append(finding(name, verdict, text, remedy, first_s=low_s, last_s=high_s))
    return findings


def check_deskewing(sample: Sample) -> list[Finding]:
    """Compare how well sweeps align with the point times as given, reversed, and left out."""
    spot = sample.fastest
    if spot is None:
        return [finding("deskewing", UNKNOWN, "no sweeps could be registered")]
    if spot.sweeps[0].offset_ns is None:
        return [finding("deskewing", UNKNOWN, "the points have no times")]
    if spot.speed_m_s < _LEAST_SPEED_M_S:
        return [finding("deskewing", UNKNOWN, spot.too_slow(_LEAST_SPEED_M_S))]

    def with_times(sign: int) -> Spot:
        def changed(sweep: Sweep) -> Sweep:
            if sweep.offset_ns is None or sign == 0:
                return replace(sweep, offset_ns=None)
            return replace(sweep, offset_ns=sign * sweep.offset_ns)

        return spot_of(tuple(map(changed, spot.sweeps)), sample.settings)

    given_m, reversed_m, without_m = map(_apart_m, (spot, with_times(-1), with_times(0)))
    values = {"given_m": given_m, "reversed_m": reversed_m, "without_m": without_m}
    text = (
        f"sweeps {len(spot.sweeps) - 1} apart lie {given_m * 100:.1f} cm from each other with the "
        f"point times as given, {reversed_m * 100:.1f} cm with the times reversed, "
        f"{without_m * 100:.1f} cm without times"
    )
    verdict, remedy = FINE, "correct the sign of the point times, or --set register.deskew=false"
    if min(reversed_m, without_m) * _CLEARLY < given_m:
        verdict = WRONG
    elif given_m * _TOLD >= min(reversed_m, without_m):
        verdict, text = UNKNOWN, f"{text}: too slow here to tell"
    return [finding("deskewing", verdict, text, remedy, **values)]


def _apart_m(spot: Spot) -> float:
    """Return the median distance (m) of near points above ground between a spot's end sweeps."""
    if spot.trajectory is None:
        return _CLOSE_M
    ends = spot.stretch.sweeps[0], spot.stretch.sweeps[-1]
    first, last = (_above_ground(end.sweep.points) for end in ends)
    if min(len(first), len(last)) < _LEAST_POINTS:
        return _CLOSE_M
    T_first_last = poses.inverse(ends[0].T_world_lidar) @ ends[1].T_world_lidar
    moved = poses.transform(T_first_last, last)
    distance_m, _ = cKDTree(first).query(moved[::4], distance_upper_bound=_CLOSE_M, workers=-1)
    return float(np.median(np.minimum(distance_m, _CLOSE_M)))


def _above_ground(points: Float) -> Float:
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    if not len(points):
        return points
    return points[points[:, 2] > np.percentile(points[:, 2], 10) + _LEAST_HEIGHT_M]
