# SPDX-License-Identifier: MIT
"""Check the sweeps as they are stored: files, stamps, point times, unit, axes and intensities."""

from __future__ import annotations

import numpy as np

from densify.doctor.sample import FINE, GIVE_TIMES, SUSPICIOUS, UNKNOWN, WRONG, Finding, Sample
from densify.free_space.raw_sweeps import (
    LOST_DEG,
    MAP_FRAME_REMEDY,
    blind_sector,
    count_by_azimuth,
    lost_deg,
)
from densify.geometry.types import Float, Sweep
from densify.readers.timeline import format_frames

_SHORT = 0.3  # a file below this share of the usual size is short
_FETCH = "fetch these files again; windows end before sweeps that cannot be read"
_PERIODS_S = (0.015, 1.1)  # range of existing scanners, 50 Hz to 1 Hz
_HOLE_PERIODS = 3.1  # a longer step between sweeps is a hole in time
# Common mistake -> factor that corrects a period
_STAMP_UNITS = {
    "seconds taken for nanoseconds": 1e9,
    "milliseconds taken for nanoseconds": 1e6,
    "microseconds taken for nanoseconds": 1e3,
    "nanoseconds taken for microseconds": 1e-3,
    "nanoseconds taken for milliseconds": 1e-6,
    "nanoseconds taken for seconds": 1e-9,
}
_WHOLE_SWEEP = (0.5, 1.5)  # plausible time from first to last point, in periods
_TURN_S = (0.04, 0.25)  # duration of a turn of existing scanners, 25 to 4 Hz
_WRONG_SPAN = (0.02, 10)  # in periods; outside, the unit of the point times is wrong
_MEDIAN_RANGE_M = (1.5, 60.0)  # plausible median range of a sweep
_LENGTH_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}  # in metres
_FAR_OFF = 10.0  # distance from the origin, as a multiple of the spread of the points
# Name of an axis -> unit vector along it; z first, because equal shares go to the first
_UP = {
    sign + axis: (-1.0 if sign else 1.0) * np.eye(3)["xyz".index(axis)]
    for axis in "zyx"
    for sign in ("", "-")
}
_UP_MEANS = {
    "-z": "x forward, y right, z down",
    "-y": "a camera's axes: x right, y down, z forward",
    "y": "y up",
}
_NEAR_M = 25.0  # range of the returns in which the ground is searched
_LAYER_M = 0.3  # thickness of the layer that holds the ground
_LEAST_GROUND, _MOST_BELOW = 0.08, 0.2  # shares of the near returns in and below the ground
_HIGHEST_M = 0.3  # highest ground; in a vehicle frame the road is at height 0
# Ratios of two shares from which the larger one is clearly better, and from which z, although it
# has a ground, may not be up. A hedge beside the road had 1.7 times the share of the ground.
_CLEARLY, _FAR_BETTER = 1.5, 2.5


def check_sweep_files(sample: Sample) -> list[Finding]:
    """Report empty or short sweep files, and sweeps that cannot be read."""
    findings = []
    if sample.unreadable:
        frame, reason = next(iter(sample.unreadable.items()))
        text = (
            f"{len(sample.unreadable)} of the sweeps looked at cannot be read: frames "
            f"{format_frames(sample.unreadable)}; frame {frame}: {reason}"
        )
        findings.append(Finding("reading", WRONG, text, _FETCH))
    sequence = sample.sequence
    sizes = sequence.sweep_bytes() if hasattr(sequence, "sweep_bytes") else {}
    if sizes:
        usual_bytes = float(np.median(list(sizes.values())))
        empty = [frame for frame, size in sizes.items() if size == 0]
        short = [frame for frame, size in sizes.items() if 0 < size < _SHORT * usual_bytes]
        text = f"{len(sizes)} sweeps of {usual_bytes / 1e6:.2f} MB, none empty or much shorter"
        if empty or short:
            text = (
                f"empty: {format_frames(empty)}; much shorter than the usual "
                f"{usual_bytes / 1e6:.2f} MB: {format_frames(short)}"
            )
        verdict = WRONG if empty else SUSPICIOUS if short else FINE
        values = {"num_empty": len(empty), "num_short": len(short), "usual_bytes": int(usual_bytes)}
        findings.append(Finding("files", verdict, text, _FETCH, values))
    return findings


def check_stamps(sample: Sample) -> list[Finding]:
    """Check the sweeps' reference times: order, rate and holes."""
    timeline = sample.timeline
    frames = timeline.frames
    step_ns = np.diff(timeline.stamp_ns)
    if timeline.unknown:
        frame, reason = next(iter(timeline.unknown.items()))
        text = (
            f"{len(timeline.unknown)} of {len(frames)} sweeps have no stamp that can be right, the "
            f"first of them frame {frame} ({reason})"
        )
        remedy = "correct the stamps of these sweeps, or remove their files"
        return [Finding("stamps", WRONG, text, remedy)]
    if len(frames) < 2:
        return [Finding("stamps", UNKNOWN, "one sweep tells no rate")]
    backward = np.flatnonzero(step_ns <= 0)
    if len(backward):
        row = int(backward[0])
        text = (
            f"{len(backward)} of {len(step_ns)} steps do not go on in time; the first: the stamp "
            f"of frame {frames[row + 1]} is {-step_ns[row] * 1e-6:.1f} ms before that of frame "
            f"{frames[row]}"
        )
        remedy = "sort the sweeps by their stamps, or correct the file of stamps"
        return [Finding("stamps", WRONG, text, remedy, {"num_backward": len(backward)})]
    findings = [_check_rate(timeline.period_ns * 1e-9)]
    holes = np.flatnonzero(step_ns > _HOLE_PERIODS * timeline.period_ns)
    if len(holes):
        longest = int(holes[np.argmax(step_ns[holes])])
        text = (
            f"{len(holes)} of more than three periods, the longest of "
            f"{step_ns[longest] * 1e-9:.1f} s after frame {frames[longest]}; windows end there "
            f"(after frames {format_frames(frames[row] for row in holes)})"
        )
        remedy = "nothing, if the sweeps were never recorded; else fetch them again"
        findings.append(
            Finding("holes in time", SUSPICIOUS, text, remedy, {"num_holes": len(holes)})
        )
    return findings


def _check_rate(period_s: float) -> Finding:
    """Check that the period of the sweeps is that of an existing scanner."""
    least_s, most_s = _PERIODS_S
    values = {"period_s": period_s}
    if least_s <= period_s <= most_s:
        return Finding("stamps", FINE, f"{1 / period_s:.2f} Hz, ascending", values=values)
    text = f"from sweep to sweep {period_s:.3g} s pass, expected {least_s} to {most_s} s"
    verdict = SUSPICIOUS
    for mistake, factor in _STAMP_UNITS.items():
        if least_s <= period_s * factor <= most_s:
            verdict = WRONG
            text += f"; it would be {1 / (period_s * factor):.1f} Hz with {mistake}"
            break
    return Finding("stamps", verdict, text, "correct the unit of the stamps", values)


def check_point_times(sample: Sample) -> list[Finding]:
    """Check that the firing times within a sweep span about one period."""
    if any(sweep.offset_ns is None for sweep in sample.middles):
        return [Finding("point times", UNKNOWN, f"the points have no times; {GIVE_TIMES}")]
    if len(sample.timeline.frames) < 2:
        return [Finding("point times", UNKNOWN, "one sweep tells no period to compare with")]
    return [_check_point_times_of(sample, lidar) for lidar in sample.lidars]


def _check_point_times_of(sample: Sample, lidar: int) -> Finding:
    """Check the firing times of one scanner."""
    ends_s = []  # of each middle sweep, the first and the last firing time
    for sweep in sample.middles:
        is_of_lidar = sweep.lidar == lidar
        if sweep.offset_ns is not None and is_of_lidar.any():
            # The first and the last 0.1 % may be stray.
            ends_s.append(np.percentile(sweep.offset_ns[is_of_lidar] * 1e-9, [0.1, 99.9]))
    low_s, high_s = np.median(ends_s, axis=0).tolist()
    span_s = high_s - low_s
    span = span_s / (sample.timeline.period_ns * 1e-9)
    text = (
        f"{low_s * 1e3:+.1f} to {high_s * 1e3:+.1f} ms around the stamp, {span:.3g} periods; "
        f"the stamp is at {round(100 * -low_s / max(span_s, 1e-12))} % of the sweep"
    )
    verdict, remedy = SUSPICIOUS, "compare the point times with the scanner's rate"
    if _WHOLE_SWEEP[0] <= span <= _WHOLE_SWEEP[1]:
        verdict = FINE
    elif span < 1 and _TURN_S[0] <= span_s <= _TURN_S[1]:
        verdict = FINE
        text += f"; one of {round(1 / span)} turns of the scanner was kept"
    elif not _WRONG_SPAN[0] <= span <= _WRONG_SPAN[1]:
        verdict, remedy = WRONG, "correct the unit of the point times"
    name = "point times" + f" of scanner {lidar}" * (lidar > 0)
    return Finding(name, verdict, text, remedy, {"first_s": low_s, "last_s": high_s})


def check_units(sample: Sample) -> list[Finding]:
    """Check that the points are in metres and that the scanner is at the origin."""
    name = "unit of points"
    least_m, most_m = _MEDIAN_RANGE_M
    clouds = [sweep.points for sweep in sample.middles]
    range_m = float(np.median([_median_range_m(points) for points in clouds]))
    if least_m <= range_m <= most_m:
        text = f"half of the returns within {range_m:.1f} m"
        return [Finding(name, FINE, text, values={"median_range_m": range_m})]

    # Points in a map's coordinates are far from the origin, but close to each other.
    spreads_m = [_median_range_m(points - np.median(points, axis=0)) for points in clouds]
    spread_m = float(np.median(spreads_m))
    units = [
        unit for unit, factor in _LENGTH_UNITS.items() if least_m <= range_m * factor <= most_m
    ]
    text = f"half of the returns are farther than {range_m:.4g} m"
    verdict = WRONG
    remedy = "scale the points to metres (sweeps: scale_m in densify.yaml)"
    if least_m <= spread_m <= most_m and range_m > _FAR_OFF * spread_m:
        text += f", and within {spread_m:.1f} m of each other's middle, as if they were in a map's"
        text += " coordinates"
        remedy = MAP_FRAME_REMEDY
    elif units:
        text += f", expected {least_m} to {most_m:.0f} m, as if they were in {units[0]}"
    else:
        text += f", expected {least_m} to {most_m:.0f} m"
        verdict = SUSPICIOUS
    return [Finding(name, verdict, text, remedy, {"median_range_m": range_m})]


def _median_range_m(points: Float) -> float:
    """Return the median distance of points (N,3) from the origin."""
    return float(np.median(np.linalg.norm(points, axis=1)))


def check_axes(sample: Sample) -> list[Finding]:
    """Check that z points up, by the ground: a level layer that few returns lie below.

    Along the up axis the layer's share of the near returns exceeds an even spread over all heights
    by at least 8 %.
    """
    shares = {
        axis: float(np.median([_ground_share(sweep, up) for sweep in sample.middles]))
        for axis, up in _UP.items()
    }
    best = max(shares, key=lambda axis: shares[axis])
    if_up = {
        axis: f"{100 * max(shares[axis], 0):.0f} % of the near returns lie in one layer below the "
        f"scanner if {axis} is up"
        for axis in ("z", best)
    }
    text, other = if_up[best], f"{100 * max(shares['z'], 0):.0f} % if z is"
    verdict = WRONG
    remedy = "turn the points so that z is up (sweeps: axes in densify.yaml)"
    if shares[best] < _LEAST_GROUND:
        verdict, text = UNKNOWN, "no ground was found along any axis"
    elif best == "z":
        verdict = FINE
    elif shares["z"] >= _LEAST_GROUND and shares[best] < _FAR_BETTER * shares["z"]:
        verdict = FINE
        text = (
            f"{if_up['z']}, and {100 * _LEAST_GROUND:.0f} % are enough for a road; a wall or hedge "
            f"explains the {100 * shares[best]:.0f} % in one layer across {best.lstrip('-')}"
        )
    elif shares["z"] >= _LEAST_GROUND or shares[best] < _CLEARLY * shares["z"]:
        verdict = UNKNOWN
        text += f", {other}: both may be the ground"
    else:
        text += f", {other}"
        text += f" ({_UP_MEANS[best]})" if best in _UP_MEANS else ""
    values = {f"share_{axis}": share for axis, share in shares.items()}
    return [Finding("axes", verdict, text, remedy, values)]


def _ground_share(sweep: Sweep, up: Float) -> float:
    """Return the excess share of near returns in the fullest layer across ``up`` (3,)."""
    # Few returns may lie below the layer, which begins below 0.3 m. An even spread is subtracted.
    height_m = sweep.points[np.linalg.norm(sweep.points, axis=1) < _NEAR_M] @ up
    if not len(height_m):
        return 0.0
    low_m, high_m = np.percentile(height_m, [0.5, 99.5])  # without stray returns
    # Bins are half a layer high. A layer is two neighbouring bins, and layers overlap.
    edges_m = np.arange(low_m - _LAYER_M, high_m + 2 * _LAYER_M, 0.5 * _LAYER_M)
    bin_share = np.histogram(height_m, edges_m)[0] / len(height_m)
    layer_share = bin_share[:-1] + bin_share[1:]
    share_below = np.cumsum(bin_share)[:-1] - bin_share[:-1]
    even_share = _LAYER_M / max(float(high_m - low_m), _LAYER_M)
    is_allowed = (share_below < _MOST_BELOW) & (edges_m[:-2] < _HIGHEST_M)
    return float(layer_share[is_allowed].max(initial=0.0)) - even_share


def check_directions(sample: Sample) -> list[Finding]:
    """Check that sweeps have returns in all directions, as far as the scanner sees."""
    name = "directions"
    spot_returns = [
        np.stack([count_by_azimuth(sweep) for sweep in spot.sweeps]) for spot in sample.spots
    ]
    widths_deg = [float(lost_deg(returns).max()) for returns in spot_returns]
    sectors = [blind_sector(returns) for returns in spot_returns]
    widest_deg = max(widths_deg)
    if widest_deg >= LOST_DEG:
        spot = sample.spots[int(np.argmax(widths_deg))]
        frames = format_frames(sweep.frame for sweep in spot.sweeps)
        text = (
            f"one of the sweeps {frames} lacks {widest_deg:.0f} deg of azimuth that the others "
            f"measured"
        )
        remedy = "lost packets: record with a larger buffer of the socket, or leave sweeps out"
        return [Finding(name, SUSPICIOUS, text, remedy, {"lost_deg": widest_deg})]
    if sectors[0] is not None and None not in sectors:
        first_deg, last_deg = sectors[0]
        text = f"no returns from {first_deg} to {last_deg} deg of azimuth in any sweep"
        remedy = "a blind sector: something covers the scanner, or the sweeps were cropped"
        return [Finding(name, SUSPICIOUS, text, remedy)]
    return [Finding(name, FINE, "returns all around, as far as the scanner sees")]


def check_intensity(sample: Sample) -> list[Finding]:
    """Check that intensities are between 0 and 1."""
    values = np.concatenate([sweep.intensity for sweep in sample.middles])
    low, high = float(values.min()), float(values.max())
    verdict, note = FINE, ""
    if low < 0 or high > 1:
        verdict, note = SUSPICIOUS, ", expected 0 to 1; only pictures and the clouds' column suffer"
    text = f"{low:g} to {high:g}{note}"
    remedy = "scale the intensities (sweeps: intensity_scale in densify.yaml)"
    return [Finding("intensity", verdict, text, remedy, {"lowest": low, "highest": high})]
