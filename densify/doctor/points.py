# SPDX-License-Identifier: MIT
"""Check the points: units, axes, the own vehicle, reflectances, scanners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, finding
from densify.doctor.sample import Sample, Spot
from densify.free_space.ground import HeightMap, find_upright
from densify.free_space.raw_sweeps import (
    LOST_DEG,
    MAP_FRAME_REMEDY,
    blind_sector,
    by_azimuth,
    is_still,
    lost_deg,
    way_in_map,
)
from densify.free_space.sensor import Sensors
from densify.geometry.types import Float
from densify.readers.timeline import format_frames, in_range

_MEDIAN_RANGE_M = (1.5, 60.0)
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "kilometres": 1e3}
_CELL_M, _CLOSE_M = 0.1, 6.0
_LEAST_OWN, _LEAST_HEIGHT_M = 20, 0.4
_WIDEST_M = 2.6  # of a road vehicle; kerbs and rails stay beside it too, but farther out
_LEAST_WITHOUT = 0.005  # share of the rows
_NEAR_M = 25.0
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
_LAYER_M, _LEAST_LEVEL, _FEW_BELOW = 0.3, 0.08, 0.2
_HIGHEST_M = 0.3  # in a vehicle frame the road is at height 0
_CLEARLY = 1.5
_FAR_OFF = 10.0  # distance from the origin, as a multiple of the spread of the points


def check_units(sample: Sample) -> list[Finding]:
    """Check that the points are in metres and that the scanner is at the origin."""
    name, (least_m, most_m) = "unit of points", _MEDIAN_RANGE_M
    middle = [spot.sweeps[spot.middle].points for spot in sample.spots]
    range_m = float(np.median([_median_range_m(points) for points in middle]))
    if least_m <= range_m <= most_m:
        text = f"half of the returns within {range_m:.1f} m"
        return [finding(name, FINE, text, median_range_m=range_m)]
    around_m = float(np.median([_median_range_m(p - np.median(p, axis=0)) for p in middle]))
    fits = [u for u, f in _UNITS.items() if least_m <= range_m * f <= most_m]
    text = f"half of the returns are farther than {range_m:.4g} m"
    verdict, remedy = SUSPICIOUS, "scale the points to metres (sweeps: scale_m in densify.yaml)"
    if least_m <= around_m <= most_m and range_m > _FAR_OFF * around_m:
        text += f", and within {around_m:.1f} m of each other's middle, as if they were in a map's"
        text += " coordinates"
        verdict = WRONG
        remedy = MAP_FRAME_REMEDY
    else:
        text += f", expected {least_m} to {most_m:.0f} m"
        if fits:
            verdict, text = WRONG, f"{text}, as if they were in {fits[0]}"
    return [finding(name, verdict, text, remedy, median_range_m=range_m)]


def _median_range_m(points: Float) -> float:
    return float(np.median(np.linalg.norm(points, axis=1)))


def check_frame(sample: Sample) -> list[Finding]:
    """Check that each sweep is in the frame of its own scanner, not in that of a map."""
    name, tracks = "frame of sweeps", [s.trajectory for s in sample.spots if s.trajectory]
    if not tracks:
        return [finding(name, UNKNOWN, "no sweeps could be registered")]
    if not all(is_still(track.T_world_lidar) for track in tracks):
        return [finding(name, FINE, "the scanner's own: odometry finds motion")]
    way_m = way_in_map(sample.spots[0].sweeps[0], sample.spots[-1].sweeps[-1])
    if not way_m:
        return [finding(name, FINE, "the scanner's own: all rays begin there")]
    text = f"that of a map: odometry finds no motion, but rays begin up to {way_m:.1f} m apart"
    return [finding(name, WRONG, text, MAP_FRAME_REMEDY, way_m=way_m)]


def check_axes(sample: Sample) -> list[Finding]:
    """Check that z points up: one level layer, the ground, holds most returns, with few below."""
    level = {name: _ground_share(sample, up) for name, up in _UP.items()}
    best = max(level, key=lambda name: level[name])
    values = {f"share_{name}": share for name, share in level.items()}
    text = (
        f"{100 * level[best]:.0f} % of the near returns lie in one layer below the scanner if "
        f"{best} is up" + (f", {100 * max(level['z'], 0):.0f} % if z is" if best != "z" else "")
    )
    verdict, remedy = WRONG, "turn the points so that z is up (sweeps: axes in densify.yaml)"
    if max(level["z"], level[best]) < _LEAST_LEVEL:
        verdict, text = UNKNOWN, "no ground was found along any axis"
    elif level["z"] >= _LEAST_LEVEL or level[best] < _CLEARLY * level["z"]:
        verdict = FINE
    elif best in _UP_MEANS:
        text += f" ({_UP_MEANS[best]})"
    return [finding("axes", verdict, text, remedy, **values)]


def _ground_share(sample: Sample, up: Float) -> float:
    """Return the share of near returns in the fullest layer across ``up`` (3,) with few below."""
    # The layer must not be above the origin. The share counts in excess of an even spread over all
    # heights. The result is the median over the spots.
    shares = []
    for spot in sample.spots:
        points = spot.sweeps[spot.middle].points
        height_m = points[np.linalg.norm(points, axis=1) < _NEAR_M] @ up
        if not len(height_m):
            continue
        low_m, high_m = np.percentile(height_m, [0.5, 99.5])
        edges = np.arange(low_m - _LAYER_M, high_m + 2 * _LAYER_M, 0.5 * _LAYER_M)
        share = np.histogram(height_m, edges)[0] / len(height_m)
        layer = share[:-1] + share[1:]
        below = np.cumsum(share)[:-1] - share[:-1]
        even = _LAYER_M / max(float(high_m - low_m), _LAYER_M)
        allowed = (below < _FEW_BELOW) & (edges[:-2] < _HIGHEST_M)
        shares.append(float(layer[allowed].max(initial=0.0)) - even)
    return float(np.median(shares)) if shares else 0.0


def check_own_vehicle(sample: Sample) -> list[Finding]:
    """Check for returns of the own vehicle, which keep their lidar-frame position as it drives."""
    moving = [
        spot
        for spot in sample.registered
        if spot.speed_m_s > 1.0 and (np.linalg.norm(spot.sweeps[0].points, axis=1) < _NEAR_M).any()
    ]
    if len(moving) < 2:
        text = f"the vehicle drives in {len(moving)} of the places looked at, two are needed"
        return [finding("own vehicle", UNKNOWN, text)]
    range_m, num = _own_returns(moving)
    values, least_m = {"farthest_m": range_m, "num_returns": num}, sample.settings.min_range_m
    if num < _LEAST_OWN:
        return [finding("own vehicle", FINE, "no returns of it", "", **values)]
    where, verdict = "all within", FINE
    if range_m > least_m:
        where, verdict = "beyond", SUSPICIOUS
    text = f"{num} returns a sweep, at most {range_m:.1f} m away, {where} register.min_range_m"
    remedy = f"--set register.min_range_m={np.ceil(10 * range_m) / 10:.1f}"
    return [finding("own vehicle", verdict, f"{text} = {least_m:g}", remedy, **values)]


def _own_returns(spots: list[Spot]) -> tuple[float, int]:
    """Return the range (m) of the farthest own-vehicle returns, and their number of 0.1 m cells."""
    # The ground is excluded, because it is at the same position in all sweeps too.
    R_level_lidar = find_upright([spot.sweeps[0] for spot in spots])
    cells = []
    for sweep, twist in [(s, p.twist) for p in spots for s in (p.sweeps[0], p.sweeps[-1])]:
        range_m = np.linalg.norm(sweep.points, axis=1)
        close = sweep.points[range_m < _CLOSE_M]
        right = np.array([twist[4], -twist[3]]) / np.hypot(twist[3], twist[4])
        close = close[np.abs(close[:, :2] @ right) < _WIDEST_M]
        near, level = (
            points @ R_level_lidar.T for points in (sweep.points[range_m < _NEAR_M], close)
        )
        floor_m = np.percentile(near[:, 2], 10)  # mirror images pull the local ground of one sweep
        above_m = np.minimum(HeightMap.of([near]).above(level), level[:, 2] - floor_m)
        close = close[above_m > _LEAST_HEIGHT_M]
        cells.append(np.floor(close / _CELL_M).astype(np.int64))
    everywhere = {tuple(c) for c in cells[0]}
    for other in cells[1:]:
        everywhere &= {tuple(c) for c in other}
    mine = np.array([c for c in map(tuple, cells[0]) if c in everywhere], float).reshape(-1, 3)
    if not len(mine):
        return 0.0, 0
    range_m = np.linalg.norm((mine + 0.5) * _CELL_M, axis=1)
    return float(np.percentile(range_m, 99)), len(mine)


def check_directions(sample: Sample) -> list[Finding]:
    """Check that sweeps have returns in all directions, as far as the scanner sees."""
    returns = [np.stack([by_azimuth(s) for s in spot.sweeps]) for spot in sample.spots]
    width_deg = [float(lost_deg(of_spot).max()) for of_spot in returns]
    sectors = [blind_sector(of_spot) for of_spot in returns]
    name, worst = "directions", max(width_deg)
    if worst >= LOST_DEG:
        frames = format_frames(s.frame for s in sample.spots[int(np.argmax(width_deg))].sweeps)
        text = (
            f"one of the sweeps {frames} lacks {worst:.0f} deg of azimuth that the others measured"
        )
        remedy = "lost packets: record with a larger buffer of the socket, or leave sweeps out"
        return [finding(name, SUSPICIOUS, text, remedy, lost_deg=worst)]
    if sectors[0] is not None and None not in sectors:
        text = f"no returns from {sectors[0][0]} to {sectors[0][1]} deg of azimuth in any sweep"
        remedy = "a blind sector: something covers the scanner, or the sweeps were cropped"
        return [finding(name, SUSPICIOUS, text, remedy)]
    return [finding(name, FINE, "returns all around, as far as the scanner sees")]


def check_intensity(sample: Sample) -> list[Finding]:
    """Check that intensities are between 0 and 1."""
    values = np.concatenate([spot.sweeps[spot.middle].intensity for spot in sample.spots])
    low, high = float(values.min()), float(values.max())
    text, is_fine = f"{low:g} to {high:g}", low >= 0 and high <= 1
    if not is_fine:
        text += ", expected 0 to 1; only pictures and the clouds' column suffer"
    remedy = "scale the intensities (sweeps: intensity_scale in densify.yaml)"
    verdict = FINE if is_fine else SUSPICIOUS
    return [finding("intensity", verdict, text, remedy, lowest=low, highest=high)]


def check_sensors(sample: Sample) -> list[Finding]:
    """Describe each scanner as the pipeline models it: rings, field of view, number of returns."""
    spot = sample.fastest
    if spot is None:
        return [finding("scanners", UNKNOWN, "no sweeps could be registered")]
    findings = []
    used = [replace(s, sweep=in_range(s.sweep, sample.settings)) for s in spot.stretch.sweeps]
    for number, model in Sensors.of(used).models.items():
        kind = "lines" if model.rings_rad is None else f"{len(model.rings_rad)} rings"
        kind = "no rings" if model.unordered else kind
        low, high = np.rad2deg(model.elevation_rad)
        right, left = np.rad2deg(model.azimuth_rad)
        counts = [int((s.lidar == number).sum()) for s in spot.sweeps]
        without = [1 - len(s) / (int(s.row.max(initial=0)) + 1) for s in spot.sweeps]
        text = (
            f"{kind}, {low:.1f} to {high:.1f} deg up, {right:.0f} to {left:.0f} deg around, "
            f"{np.rad2deg(model.azimuth_step_rad):.2f} deg from ray to ray, {min(counts):,} to "
            f"{max(counts):,} returns a sweep"
        )
        if max(without) > _LEAST_WITHOUT:
            text += f", {100 * max(without):.0f} % of the rows without a return"
        every = (s for spot in sample.spots for s in spot.sweeps)
        without_it = [s.frame for s in every if not (s.lidar == number).any()]
        if without_it:
            text += f", none in sweeps {format_frames(without_it)}"
        is_broken = bool(without_it) or min(counts) < 0.5 * max(counts)
        found = finding(
            f"scanner {number}",
            SUSPICIOUS if is_broken else FINE,
            text + "; some sweeps are broken off" * is_broken,
            "leave the sweeps with few returns out",
            returns_least=min(counts),
            returns_most=max(counts),
            without_return=max(without),
        )
        findings.append(found)
    return findings
