# SPDX-License-Identifier: MIT
"""Check the rings of a spinning scanner.

They are cones about its spin axis only if each point is relative to the scanner at its firing.
"""

from __future__ import annotations

import numpy as np

from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.sample import Sample
from densify.geometry import poses
from densify.geometry.types import Float
from densify.registration.deskew import (
    CLEARLY,
    COMPENSATED_M,
    LEAST_SHARPNESS,
    LEAST_SPEED_M_S,
    rings_by_motion,
    sample_rows,
    sharpness,
    turning_s,
)

_FAR_M = 60.0
_LEAST_POINTS = 500
_REACH_M = np.array([3.0, 0.8, 2.4])  # searched ahead and behind, aside, above and below
_GRID_M = (0.5, 0.4, 0.05)  # fine in height, which changes every ring
_COARSE_FROM_M, _COARSE_POINTS, _COARSE_BINS, _NUM_STARTS = 18.0, 3000, 3, 8
_FINER = ((0.1, 3), (0.05, 2), (0.02, 1))  # step in metres, bins
# The rings of KITTI's HDL-64E, with two separate blocks of lasers, are sharpest from 0.2 m above.
_OFF_M = 0.3


def check_rings(sample: Sample) -> list[Finding]:
    """Check the position of each scanner, and that its sweeps are not motion-compensated yet."""
    findings = []
    for lidar in sample.lidars:
        R = sample.spots[0].sweeps[0].axes(lidar)  # rings are level in the scanner's own axes
        given_m = R @ sample.spots[0].sweeps[0].origin_m(lidar)
        points = _still_points(sample, lidar) @ R.T
        if len(points) < _LEAST_POINTS:
            text = f"{len(points)} near points, {_LEAST_POINTS} are needed to tell"
            findings.append(finding(_place_of(lidar), UNKNOWN, text))
            continue
        found_m = found_origin(points, given_m)
        findings.append(_check_origin(lidar, points, R, given_m, found_m))
        findings.append(_check_compensation(sample, lidar, R, (given_m, found_m)))
    return findings


def _check_compensation(
    sample: Sample, lidar: int, R: Float, origins_m: tuple[Float, Float]
) -> Finding:
    """Check that the motion within a sweep is not compensated already."""
    name = "motion compensation" + f" of scanner {lidar}" * (lidar > 0)
    spot = sample.fastest
    if spot is None:
        return finding(name, UNKNOWN, "no sweeps could be registered")
    if spot.speed_m_s < LEAST_SPEED_M_S:
        return finding(name, UNKNOWN, spot.too_slow(LEAST_SPEED_M_S))
    sweep = spot.sweeps[spot.middle]
    sweep = sweep.select(sweep.lidar == lidar)
    is_untimed = sweep.offset_ns is None
    near = sample_rows(sweep, COMPENSATED_M)
    points = sweep.points[near]
    if sweep.offset_ns is None:
        offset_s = turning_s(points, sample.timeline.period_ns * 1e-9)
    else:
        offset_s = np.asarray(sweep.offset_ns[near] * 1e-9, np.float64)
    rings = rings_by_motion(points, offset_s, spot.twist, R, origins_m)
    if not rings.are_distinct:  # the origin was looked for in smeared rings
        straight = poses.transform_each(-offset_s[:, None] * spot.twist, points) @ R.T
        rings = rings._replace(undone=sharpness(straight, found_origin(straight, origins_m[0])))
    as_stored, undone, done, moment = rings
    text = (
        f"at {spot.speed_m_s:.1f} m/s the rings' sharpness is {as_stored:.2f} as stored, "
        f"{undone:.2f} with a compensation undone, {done:.2f} with the motion compensated"
    )
    verdict, remedy = FINE, "--set register.deskew=false"
    if not rings.are_distinct:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif rings.are_compensated and is_untimed:
        text += f": compensated to {moment}, without times"
    elif rings.are_compensated:
        verdict = WRONG
        text += f": the sweeps are compensated already, to {moment}, and would be a second time"
    elif as_stored < CLEARLY * undone:
        verdict, text = UNKNOWN, f"{text}: too alike to tell"
    elif is_untimed:
        stretched_m = spot.speed_m_s * sample.timeline.period_ns * 1e-9
        verdict, remedy = SUSPICIOUS, "give the points times (a column t in the files)"
        text += ": the sweeps are as they were fired and no point has a time, so they stay"
        text += f" stretched by {stretched_m:.2f} m"
    else:
        text += ": as they were fired"
    return finding(name, verdict, text, remedy, as_stored=as_stored, undone=undone, done=done)


def _still_points(sample: Sample, lidar: int) -> Float:
    """Return (N,3) returns of one scanner, lidar frame, from the middle sweeps of all spots."""
    parts = []
    for spot in sample.spots:
        sweep = spot.sweeps[spot.middle]
        sweep = sweep.select(sweep.lidar == lidar)
        parts.append(sweep.points[sample_rows(sweep, _FAR_M)])
    return np.concatenate(parts)[:: len(parts)]


def _check_origin(lidar: int, points: Float, R: Float, given_m: Float, found_m: Float) -> Finding:
    """Compare a scanner's given position (3,) with that of the sharpest rings, scanner axes."""
    name = _place_of(lidar)
    given, found = sharpness(points, given_m), sharpness(points, found_m)
    off_m = float(np.linalg.norm(found_m - given_m))
    given_m, found_m = given_m @ R, found_m @ R
    values = {"given_m": given_m.tolist(), "found_m": found_m.tolist(), "off_m": off_m}
    values |= {"sharpness_given": given, "sharpness_found": found}
    text = (
        f"rings are sharpest ({found:.2f}) seen from {_text(found_m)}; from the given "
        f"{_text(given_m)}: {given:.2f}"
    )
    line = f"scanner_origins: {[[round(float(v), 2) for v in found_m]]}"
    verdict, remedy = FINE, f"give the scanner's place in the points' frame ({line})"
    if found < LEAST_SHARPNESS:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif off_m > _OFF_M and found > CLEARLY * given:
        verdict = WRONG
    return finding(name, verdict, text, remedy, **values)


def _place_of(lidar: int) -> str:
    return "scanner's place" if lidar == 0 else f"place of scanner {lidar}"


def _text(place_m: Float) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in place_m) + ")"


def found_origin(points: Float, start_m: Float) -> Float:
    """Return (3,) the position near a start where the rings are sharpest, in axes of the points."""
    axes = [np.arange(-r, r + 1e-9, step) for r, step in zip(_REACH_M, _GRID_M, strict=True)]
    grid = start_m + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    far = points[np.linalg.norm(points, axis=1) > _COARSE_FROM_M]
    some = far[:: len(far) // _COARSE_POINTS + 1]
    value = np.array([sharpness(some, place_m, _COARSE_BINS) for place_m in grid])
    starts = [start_m.astype(np.float64), *grid[np.argsort(-value)[:_NUM_STARTS]]]
    for step_m, bins in _FINER:
        starts = [_climbed(points, place_m, step_m, bins) for place_m in starts]
    return max(starts, key=lambda place_m: sharpness(points, place_m))


def _climbed(points: Float, place_m: Float, step_m: float, bins: int) -> Float:
    around = step_m * np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    for _ in range(8):
        places = place_m + around
        values = [sharpness(points, place, bins) for place in places]
        best = int(np.argmax(values))
        if best == 13:
            break
        place_m = places[best]
    return place_m
