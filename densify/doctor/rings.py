# SPDX-License-Identifier: MIT
"""Check the rings of a spinning scanner.

They are cones about its own axis only for points relative to its position at their firing.
"""

from __future__ import annotations

import numpy as np

from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.sample import Sample
from densify.geometry import poses
from densify.geometry.types import Float, Sweep

_NEAR_M, _FAR_M = 3.0, 60.0
_COMPENSATED_M = 25.0  # nearer returns show a motion within the sweep
_NUM_POINTS, _LEAST_POINTS = 20_000, 500
_WINDOW_CELLS, _LEAST_SHARE = 100, 0.01
_BIN_RAD = np.deg2rad(0.02)
_LEAST_SPEED_M_S = 1.5
_LEAST_SHARPNESS = 4.0  # of a scanner with distinct rings
_CLEARLY = 1.25  # sharper by that factor
_REACH_M = np.array([3.0, 0.8, 2.4])
_GRID_M = (0.5, 0.4, 0.05)
_COARSE_FROM_M, _COARSE_POINTS, _COARSE_BINS, _NUM_STARTS = 18.0, 3000, 3, 8
_FINER = ((0.1, 3), (0.05, 2), (0.02, 1))  # step in metres, bins
# KITTI's HDL-64E, whose two blocks of lasers stand apart, is sharpest from 0.2 m higher.
_OFF_M = 0.3


def sharpness(points: Float, origin_m: Float, bins: int = 1) -> float:
    """Return how much the elevations at an origin are concentrated in rings, 1 for an even spread.

    In each window of elevation it is the chance that two returns share a cell of ``bins`` times
    0.02 degrees, relative to an even spread. The result is the mean over the windows, each counted
    alike, because from a place on the ground all of a flat ground is in one of them.
    """
    x, y, z = (points - origin_m).T
    elevation = np.arctan2(z, np.hypot(x, y))
    cell = ((elevation + 0.5 * np.pi) / (bins * _BIN_RAD)).astype(np.int64)
    width = max(8, _WINDOW_CELLS // bins)
    length = -(-int(np.pi / (bins * _BIN_RAD) + 1) // width)
    count = np.bincount(cell, minlength=length * width).astype(np.float64).reshape(length, width)
    held = count.sum(axis=1)
    enough = held > _LEAST_SHARE * len(points)
    if not enough.any():
        return 1.0
    return float(np.median((count[enough] ** 2).sum(axis=1) / held[enough] ** 2) * width)


def check_rings(sample: Sample) -> list[Finding]:
    """Check the position of each scanner, and that its sweeps are as they were fired."""
    findings = []
    for lidar in sample.lidars:
        R = sample.spots[0].sweeps[0].axes(lidar)  # rings are level in the scanner's own axes
        given_m = R @ sample.spots[0].sweeps[0].origin_m(lidar)
        points = _still_points(sample, lidar) @ R.T
        if len(points) < _LEAST_POINTS:
            continue
        found_m = found_origin(points, given_m)
        findings.append(_check_origin(lidar, points, R, given_m, found_m))
        findings.append(_check_compensation(sample, lidar, R, (given_m, found_m)))
    return findings


def _check_compensation(
    sample: Sample, lidar: int, R: Float, origins_m: tuple[Float, Float]
) -> Finding:
    """Check that the motion within a sweep is not removed already.

    R: into the scanner's axes. origins_m: possible positions of the scanner.
    """
    name = "motion compensation" + f" of scanner {lidar}" * (lidar > 0)
    spot = sample.fastest
    if spot is None:
        return finding(name, UNKNOWN, "no sweeps could be registered")
    if spot.speed_m_s < _LEAST_SPEED_M_S:
        return finding(name, UNKNOWN, spot.too_slow(_LEAST_SPEED_M_S))
    sweep = spot.sweeps[spot.middle]
    sweep = sweep.select(sweep.lidar == lidar)
    is_untimed = sweep.offset_ns is None
    offset_s = _turning_s(sweep, sample) if sweep.offset_ns is None else sweep.offset_ns * 1e-9
    near = _sample_of(sweep, _COMPENSATED_M)
    found = _sharpness_by_motion(sweep.points[near], offset_s[near], spot.twist, R, origins_m)
    as_stored, undone, done, moment = found
    text = (
        f"at {spot.speed_m_s:.1f} m/s the rings' sharpness is {as_stored:.2f} as stored, "
        f"{undone:.2f} with a compensation undone, {done:.2f} with the motion compensated"
    )
    verdict, remedy = FINE, "--set register.deskew=false"
    if max(as_stored, undone) < _LEAST_SHARPNESS:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif undone > _CLEARLY * as_stored and is_untimed:
        text += f": compensated to {moment}, without times"
    elif undone > _CLEARLY * as_stored:
        verdict = WRONG
        text += f": the sweeps are compensated already, to {moment}, and would be a second time"
    elif as_stored < _CLEARLY * undone:
        verdict, text = UNKNOWN, f"{text}: too alike to tell"
    elif is_untimed:
        stretched_m = spot.speed_m_s * sample.timeline.period_ns * 1e-9
        verdict, remedy = SUSPICIOUS, "give the points times (a column t in the files)"
        text += ": the sweeps are as they were fired and no point has a time, so they stay"
        text += f" stretched by {stretched_m:.2f} m"
    else:
        text += ": as they were fired"
    return finding(name, verdict, text, remedy, as_stored=as_stored, undone=undone, done=done)


def _sharpness_by_motion(
    points: Float, offset_s: Float, twist: Float, R: Float, origins_m: tuple[Float, Float]
) -> tuple[float, float, float, str]:
    """Return the sharpness of rings as stored, with compensation undone, and with compensation.

    The last result is the moment that they would be compensated to. points: (N,3) raw, fired at
    offset_s (N,). twist: (6,) of the lidar, per second.
    """

    def sharpest(moved: Float) -> float:
        return max(sharpness(moved, origin_m) for origin_m in origins_m)

    def carried(since_s: Float) -> Float:
        return poses.transform_each(since_s[:, None] * twist, points) @ R.T

    # The moment they were compensated to may be any of the sweep's.
    moments_s = {
        "its stamp": 0.0,
        "its first point": float(offset_s.min()),
        "its last point": float(offset_s.max()),
    }
    as_stored = sharpest(points @ R.T)
    undone_to = {name: sharpest(carried(at_s - offset_s)) for name, at_s in moments_s.items()}
    moment = max(undone_to, key=lambda name: undone_to[name])
    undone, done = undone_to[moment], sharpest(carried(offset_s))
    if max(as_stored, undone) < _LEAST_SHARPNESS:  # the origin was looked for in smeared rings
        straight = carried(-offset_s)
        undone = sharpness(straight, found_origin(straight, origins_m[0]))
    return as_stored, undone, done, moment


def _turning_s(sweep: Sweep, sample: Sample) -> Float:
    """Return the times of a scanner that turns clockwise and faces forward at the stamp."""
    turn = -np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi)
    return turn * (sample.timeline.period_ns * 1e-9)


def _sample_of(sweep: Sweep, far_m: float) -> np.ndarray:
    range_m = np.linalg.norm(sweep.points, axis=1)
    rows = np.flatnonzero((range_m > _NEAR_M) & (range_m < far_m))
    return rows[:: len(rows) // _NUM_POINTS + 1]


def _still_points(sample: Sample, lidar: int) -> Float:
    """Return (N,3) returns of one scanner from all spots."""
    parts = []
    for spot in sample.spots:
        sweep = spot.sweeps[spot.middle]
        sweep = sweep.select(sweep.lidar == lidar)
        parts.append(sweep.points[_sample_of(sweep, _FAR_M)])
    return np.concatenate(parts)[:: len(parts)]


def _check_origin(lidar: int, points: Float, R: Float, given_m: Float, found_m: Float) -> Finding:
    """Compare the given and the found position of a scanner.

    points, given_m.

    found_m: in the scanner's axes, into which R turns those of the lidar frame.
    """
    name = "scanner's place" if lidar == 0 else f"place of scanner {lidar}"
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
    if found < _LEAST_SHARPNESS:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif off_m > _OFF_M and found > _CLEARLY * given:
        verdict = WRONG
    return finding(name, verdict, text, remedy, **values)


def _text(place_m: Float) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in place_m) + ")"


def found_origin(points: Float, start_m: Float) -> Float:
    """Return (3,) the position with the sharpest rings.

    The search covers 3 m ahead and behind a position, 0.8 m aside, 2.4 m above and below. Heights
    have fine steps, because they move every ring.
    """
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
