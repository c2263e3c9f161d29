# SPDX-License-Identifier: MIT
"""Stamps of sweeps and points: order, gaps, unit, and where in a sweep its reference time lies."""

from __future__ import annotations

import numpy as np

from densify.doctor.findings import Finding, Verdict, fine, suspicious, unknown, wrong
from densify.doctor.sample import Sample
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
_YEAR_NS = 31_556_952 * 10**9
_YEARS = (1980 - 1970, 2040 - 1970)  # the clock of GPS counts from 1980
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
    return [_rate(sample), *_holes(sample), *_year(sample)]


def _rate(sample: Sample) -> Finding:
    period_s = sample.timeline.period_ns * 1e-9
    values = {"period_s": period_s}
    if _PERIODS_S[0] <= period_s <= _PERIODS_S[1]:
        return fine("stamps", f"{1 / period_s:.2f} Hz, ascending", **values)
    fits = [name for name, f in _UNITS.items() if _PERIODS_S[0] <= period_s * f <= _PERIODS_S[1]]
    guess = f"; it would be {1 / (period_s * _UNITS[fits[0]]):.1f} Hz with {fits[0]}" * bool(fits)
    verdict = Verdict.WRONG if fits else Verdict.SUSPICIOUS
    return Finding(
        "stamps",
        verdict,
        f"from sweep to sweep {period_s:.3g} s pass, expected {_PERIODS_S[0]} to "
        f"{_PERIODS_S[1]} s{guess}",
        "correct the unit of the stamps",
        values,
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


def _year(sample: Sample) -> list[Finding]:
    years = int(sample.timeline.stamp_ns[0]) / _YEAR_NS
    if years < 1 or _YEARS[0] <= years <= _YEARS[1]:  # counted from power-on, or a date
        return []
    return [
        suspicious(
            "date",
            f"the first sweep is stamped in the year {1970 + years:.0f}, expected a date from 1980 "
            f"to 2040 or a clock that starts at 0",
            "nothing, as long as sweeps, images and poses share the clock",
            year=1970 + years,
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
        return []  # whether that matters, `check_compensation` says
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
            verdict, remedy = Verdict.FINE, ""
        elif span < 0.02 or span > 10:
            verdict, remedy = Verdict.WRONG, "correct the unit of the point times"
        else:
            verdict, remedy = Verdict.SUSPICIOUS, "compare the point times with the scanner's rate"
        findings.append(Finding(name, verdict, text, remedy, values))
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
