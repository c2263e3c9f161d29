# SPDX-License-Identifier: MIT
"""Check by the motion of the vehicle: odometry, poses, deskewing, scanners and their rings.

The rings of a spinning scanner are cones about its spin axis only if each point is relative to the
scanner at its firing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.doctor.sample import (
    FINE,
    SUSPICIOUS,
    UNKNOWN,
    WRONG,
    Finding,
    Sample,
    Spot,
    Value,
    finding,
)
from densify.free_space.ground import HeightMap, find_upright
from densify.free_space.raw_sweeps import MAP_FRAME_REMEDY, is_still, way_in_map
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.types import Float, Sweep
from densify.readers.recorded_poses import PoseTrack
from densify.readers.timeline import format_frames, in_range
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
from densify.scores.pose_metrics import RecordedError, main_error

_NEAR_M = 25.0
# Returns of the own vehicle
_CELL_M, _CLOSE_M = 0.1, 6.0
_LEAST_RETURNS, _LEAST_HEIGHT_M, _DRIVING_M_S = 20, 0.4, 1.0
_WIDEST_M = 2.6  # of a road vehicle; kerbs and rails stay beside it too, but farther out
_LEAST_WITHOUT = 0.005  # share of the rows
# Deskewing: distances between the first and the last sweep of a spot
_LEAST_DESKEWING_M_S = 3.0
_ABOVE_GROUND_M, _APART_M = 0.5, 1.0
_LEAST_POINTS = 50
_CLEARLY_NEARER, _NEARER = 1.2, 1.05
# Rings
_FAR_M, _LEAST_RING_POINTS = 60.0, 500
_REACH_M = np.array([3.0, 0.8, 2.4])  # searched ahead and behind, aside, above and below
_GRID_M = (0.5, 0.4, 0.05)  # fine in height, which changes every ring
_COARSE_FROM_M, _COARSE_POINTS, _COARSE_BINS, _NUM_STARTS = 18.0, 3000, 3, 8
_FINER = ((0.1, 3), (0.05, 2), (0.02, 1))  # step in metres, bins
_CUBE = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
_MOST_STEPS = 8
# The rings of KITTI's HDL-64E, with two separate blocks of lasers, are sharpest from 0.2 m above.
_OFF_M = 0.3
# Poses
_LEAST_WAY_M = 1.5  # an error of 3 % of this distance exceeds the tolerance
_WRONG_COST = 4.0  # as a multiple of the tolerance
_MUCH_BETTER = 0.4
_CLOCK_S, _CLOCK_STEP_S, _CLOCK_OFF_S = 0.3, 0.02, 0.04
_WIDEST_CLOCK_S = 0.1  # a period of most scanners; a wider interval gives no verdict
_NOISE_M, _NOISE_RAD, _EVEN_COST = 0.05, 1.5e-3, 4.0
CAM_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def check_registration(sample: Sample) -> list[Finding]:
    """Report sweeps that odometry cannot register."""
    failures = [spot.failure for spot in sample.spots if spot.trajectory is None]
    if len(sample.timeline.frames) < 2:
        return [finding("registration", UNKNOWN, failures[0])]
    if not failures:
        speeds = ", ".join(f"{spot.speed_m_s:.1f}" for spot in sample.spots)
        return [finding("registration", FINE, f"odometry finds {speeds} m/s")]
    text = f"{len(failures)} of {len(sample.spots)} places cannot be registered: {failures[0]}"
    remedy = "mend what is wrong above first (unit of points, axes, stamps, point times)"
    return [finding("registration", WRONG, text, remedy)]


def check_frame(sample: Sample) -> list[Finding]:
    """Check that each sweep is in the frame of its own scanner, not in that of a map."""
    name, tracks = "frame of sweeps", [s.trajectory for s in sample.spots if s.trajectory]
    if sample.unregistered:
        return [finding(name, UNKNOWN, sample.unregistered)]
    if not all(is_still(track.T_world_lidar) for track in tracks):
        return [finding(name, FINE, "the scanner's own: odometry finds motion")]
    way_m = way_in_map(sample.spots[0].sweeps[0], sample.spots[-1].sweeps[-1])
    if not way_m:
        return [finding(name, FINE, "the scanner's own: all rays begin there")]
    text = f"that of a map: odometry finds no motion, but rays begin up to {way_m:.1f} m apart"
    return [finding(name, WRONG, text, MAP_FRAME_REMEDY, way_m=way_m)]


def check_sensors(sample: Sample) -> list[Finding]:
    """Describe each scanner as the pipeline models it: rings, field of view, number of returns."""
    if sample.unregistered:
        return [finding("scanners", UNKNOWN, sample.unregistered)]
    spot, findings = sample.fastest, []
    sweeps = [replace(s, sweep=in_range(s.sweep, sample.settings)) for s in spot.stretch.sweeps]
    without = max(1 - len(s) / (int(s.row.max(initial=0)) + 1) for s in spot.sweeps)
    for number, model in Sensors.of(sweeps).models.items():
        kind = "lines" if model.rings_rad is None else f"{len(model.rings_rad)} rings"
        kind = "no rings" if model.unordered else kind
        low, high = np.rad2deg(model.elevation_rad)
        right, left = np.rad2deg(model.azimuth_rad)
        counts = [int((s.lidar == number).sum()) for s in spot.sweeps]
        text = (
            f"{kind}, {low:.1f} to {high:.1f} deg up, {right:.0f} to {left:.0f} deg around, "
            f"{np.rad2deg(model.azimuth_step_rad):.2f} deg from ray to ray, {min(counts):,} to "
            f"{max(counts):,} returns a sweep"
        )
        if without > _LEAST_WITHOUT:
            text += f", {100 * without:.0f} % of the rows without a return"
        every = (s for each in sample.spots for s in each.sweeps)
        empty = [s.frame for s in every if not (s.lidar == number).any()]
        if empty:
            text += f", none in sweeps {format_frames(empty)}"
        verdict = FINE
        if empty or min(counts) < 0.5 * max(counts):
            verdict, text = SUSPICIOUS, f"{text}; some sweeps are broken off"
        scanner = finding(
            f"scanner {number}",
            verdict,
            text,
            "leave the sweeps with few returns out",
            returns_least=min(counts),
            returns_most=max(counts),
            without_return=without,
        )
        findings.append(scanner)
    return findings


def check_own_vehicle(sample: Sample) -> list[Finding]:
    """Check for returns of the own vehicle, which keep their lidar-frame position as it drives."""
    moving = [
        spot
        for spot in sample.registered
        if spot.speed_m_s > _DRIVING_M_S
        and (np.linalg.norm(spot.sweeps[0].points, axis=1) < _NEAR_M).any()
    ]
    if len(moving) < 2:
        text = f"the vehicle drives in {len(moving)} of the places looked at, two are needed"
        return [finding("own vehicle", UNKNOWN, text)]
    returns = _own_returns(moving)
    num, least_m = len(returns), sample.settings.min_range_m
    range_m = float(np.percentile(np.linalg.norm(returns, axis=1), 99)) if num else 0.0
    values: dict[str, Value] = {"farthest_m": range_m, "num_returns": num}
    if num < _LEAST_RETURNS:
        return [finding("own vehicle", FINE, "no returns of it", "", **values)]
    where, verdict = ("beyond", SUSPICIOUS) if range_m > least_m else ("all within", FINE)
    text = f"{num} returns a sweep, at most {range_m:.1f} m away, {where} register.min_range_m"
    remedy = f"--set register.min_range_m={np.ceil(10 * range_m) / 10:.1f}"
    return [finding("own vehicle", verdict, f"{text} = {least_m:g}", remedy, **values)]


def _own_returns(spots: list[Spot]) -> Float:
    """Return (N,3) metres, cells of 0.1 m of one sweep's returns that all end sweeps have too."""
    # The ground is excluded, because it is at the same position in all sweeps too.
    R_level_lidar = find_upright([spot.sweeps[0] for spot in spots])
    cells = []
    for sweep, twist in [(s, spot.twist) for spot in spots for s in _ends(spot)]:
        range_m = np.linalg.norm(sweep.points, axis=1)
        close = sweep.points[range_m < _CLOSE_M]
        right = np.array([twist[4], -twist[3]]) / np.hypot(twist[3], twist[4])
        close = close[np.abs(close[:, :2] @ right) < _WIDEST_M]
        around, levelled = (
            points @ R_level_lidar.T for points in (sweep.points[range_m < _NEAR_M], close)
        )
        # Mirror images pull the local ground of one sweep.
        floor_m = np.percentile(around[:, 2], 10)
        above_m = np.minimum(HeightMap.of([around]).above(levelled), levelled[:, 2] - floor_m)
        close = close[above_m > _LEAST_HEIGHT_M]
        cells.append([*map(tuple, np.floor(close / _CELL_M).astype(np.int64))])
    common = set.intersection(*map(set, cells))
    return (np.array([c for c in cells[0] if c in common]).reshape(-1, 3) + 0.5) * _CELL_M


def check_deskewing(sample: Sample) -> list[Finding]:
    """Compare how well sweeps align with the point times as given, reversed, and left out."""
    spot = sample.fastest
    if sample.unregistered:
        return [finding("deskewing", UNKNOWN, sample.unregistered)]
    if spot.sweeps[0].offset_ns is None:
        return [finding("deskewing", UNKNOWN, "the points have no times")]
    if reason := sample.too_slow(_LEAST_DESKEWING_M_S):
        return [finding("deskewing", UNKNOWN, reason)]

    def with_times(sign: int) -> Spot:
        sweeps = (
            replace(s, offset_ns=sign * s.offset_ns if sign and s.offset_ns is not None else None)
            for s in spot.sweeps
        )
        return Spot.of(tuple(sweeps), sample.settings)

    given_m, reversed_m, without_m = map(_apart_m, (spot, with_times(-1), with_times(0)))
    values = {"given_m": given_m, "reversed_m": reversed_m, "without_m": without_m}
    text = (
        f"sweeps {len(spot.sweeps) - 1} apart lie {given_m * 100:.1f} cm from each other with the "
        f"point times as given, {reversed_m * 100:.1f} cm with the times reversed, "
        f"{without_m * 100:.1f} cm without times"
    )
    verdict, remedy = FINE, "correct the sign of the point times, or --set register.deskew=false"
    if min(reversed_m, without_m) * _CLEARLY_NEARER < given_m:
        verdict = WRONG
    elif given_m * _NEARER >= min(reversed_m, without_m):
        verdict, text = UNKNOWN, f"{text}: too slow here to tell"
    return [finding("deskewing", verdict, text, remedy, **values)]


def _apart_m(spot: Spot) -> float:
    """Return the median distance (m) of near points above ground between a spot's end sweeps."""
    if spot.trajectory is None:
        return _APART_M
    first, last = spot.stretch.sweeps[0], spot.stretch.sweeps[-1]
    points, last_points = _above_ground(first.sweep.points), _above_ground(last.sweep.points)
    if min(len(points), len(last_points)) < _LEAST_POINTS:
        return _APART_M
    T_first_last = poses.inverse(first.T_world_lidar) @ last.T_world_lidar
    moved = poses.transform(T_first_last, last_points)
    distance_m, _ = cKDTree(points).query(moved[::4], distance_upper_bound=_APART_M, workers=-1)
    return float(np.median(np.minimum(distance_m, _APART_M)))


def _above_ground(points: Float) -> Float:
    points = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    if not len(points):
        return points
    return points[points[:, 2] > np.percentile(points[:, 2], 10) + _ABOVE_GROUND_M]


def check_rings(sample: Sample) -> list[Finding]:
    """Check the position of each scanner, and that its sweeps are not motion-compensated yet."""
    findings = []
    for lidar in sample.lidars:
        sweep = sample.spots[0].sweeps[0]
        R = sweep.axes(lidar)  # rings are level in the scanner's own axes
        given_m = R @ sweep.origin_m(lidar)
        points = _returns_of(sample, lidar) @ R.T
        if len(points) < _LEAST_RING_POINTS:
            text = f"{len(points)} near points, {_LEAST_RING_POINTS} are needed to tell"
            findings.append(finding(_position_of(lidar), UNKNOWN, text))
            continue
        sharpest_m = find_origin(points, given_m)
        findings.append(_check_origin(lidar, points, R, (given_m, sharpest_m)))
        findings.append(_check_compensation(sample, lidar, R, (given_m, sharpest_m)))
    return findings


def _returns_of(sample: Sample, lidar: int) -> Float:
    """Return (N,3) returns of one scanner, lidar frame, from the middle sweeps of all spots."""
    points = []
    for middle in sample.middles:
        sweep = middle.select(middle.lidar == lidar)
        points.append(sweep.points[sample_rows(sweep, _FAR_M)])
    return np.concatenate(points)[:: len(points)]


def _check_origin(lidar: int, points: Float, R: Float, origins_m: tuple[Float, Float]) -> Finding:
    """Compare a scanner's given position (3,) with that of the sharpest rings, scanner axes."""
    given_sharpness, best = (sharpness(points, origin_m) for origin_m in origins_m)
    off_m = float(np.linalg.norm(origins_m[1] - origins_m[0]))
    given_m, best_m = (origin_m @ R for origin_m in origins_m)
    values = {"given_m": given_m.tolist(), "found_m": best_m.tolist(), "off_m": off_m}
    values |= {"sharpness_given": given_sharpness, "sharpness_found": best}
    text = (
        f"rings are sharpest ({best:.2f}) seen from {_position(best_m)}; from the given "
        f"{_position(given_m)}: {given_sharpness:.2f}"
    )
    line = f"scanner_origins: {[[round(float(v), 2) for v in best_m]]}"
    verdict, remedy = FINE, f"give the scanner's place in the points' frame ({line})"
    if best < LEAST_SHARPNESS:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif off_m > _OFF_M and best > CLEARLY * given_sharpness:
        verdict = WRONG
    return finding(_position_of(lidar), verdict, text, remedy, **values)


def _position_of(lidar: int) -> str:
    return "scanner's place" if lidar == 0 else f"place of scanner {lidar}"


def _position(position_m: Float) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in position_m) + ")"


def find_origin(points: Float, start_m: Float) -> Float:
    """Return (3,) the position near a start where the rings are sharpest, in axes of the points."""
    axes = [np.arange(-r, r + 1e-9, step) for r, step in zip(_REACH_M, _GRID_M, strict=True)]
    grid = start_m + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    far = points[np.linalg.norm(points, axis=1) > _COARSE_FROM_M]
    coarse = far[:: len(far) // _COARSE_POINTS + 1]
    value = np.array([sharpness(coarse, origin_m, _COARSE_BINS) for origin_m in grid])
    starts = [start_m.astype(np.float64), *grid[np.argsort(-value)[:_NUM_STARTS]]]
    for step_m, bins in _FINER:
        starts = [_climb(points, origin_m, step_m, bins) for origin_m in starts]
    return max(starts, key=lambda origin_m: sharpness(points, origin_m))


def _climb(points: Float, origin_m: Float, step_m: float, bins: int) -> Float:
    """Return the position (3,) to which the steepest steps along a grid of ``step_m`` lead."""
    for _ in range(_MOST_STEPS):
        around = origin_m + step_m * _CUBE
        best = int(np.argmax([sharpness(points, neighbour_m, bins) for neighbour_m in around]))
        if not _CUBE[best].any():
            break
        origin_m = around[best]
    return origin_m


def _check_compensation(
    sample: Sample, lidar: int, R: Float, origins_m: tuple[Float, Float]
) -> Finding:
    """Check that the motion within a sweep is not compensated already."""
    name = "motion compensation" + f" of scanner {lidar}" * (lidar > 0)
    if reason := sample.too_slow(LEAST_SPEED_M_S):
        return finding(name, UNKNOWN, reason)
    spot, period_s = sample.fastest, sample.timeline.period_ns * 1e-9
    sweep = spot.middle.select(spot.middle.lidar == lidar)
    rows = sample_rows(sweep, COMPENSATED_M)
    points, is_untimed = sweep.points[rows], sweep.offset_ns is None
    if sweep.offset_ns is None:
        offset_s = turning_s(points, period_s)
    else:
        offset_s = np.asarray(sweep.offset_ns[rows] * 1e-9, np.float64)
    rings = rings_by_motion(points, offset_s, spot.twist, R, origins_m)
    if not rings.are_distinct:  # the origin was looked for in smeared rings
        straight = poses.transform_each(-offset_s[:, None] * spot.twist, points) @ R.T
        rings = rings._replace(undone=sharpness(straight, find_origin(straight, origins_m[0])))
    text = (
        f"at {spot.speed_m_s:.1f} m/s the rings' sharpness is {rings.as_stored:.2f} as stored, "
        f"{rings.undone:.2f} with a compensation undone, {rings.done:.2f} with the motion "
        f"compensated"
    )
    verdict, remedy = FINE, "--set register.deskew=false"
    if not rings.are_distinct:
        verdict, text = UNKNOWN, f"{text}; no distinct rings"
    elif rings.are_compensated and is_untimed:
        text += f": compensated to {rings.moment}, without times"
    elif rings.are_compensated:
        verdict = WRONG
        text += f": the sweeps are compensated already, to {rings.moment}, and would be a second"
        text += " time"
    elif rings.as_stored < CLEARLY * rings.undone:
        verdict, text = UNKNOWN, f"{text}: too alike to tell"
    elif is_untimed:
        verdict, remedy = SUSPICIOUS, "give the points times (a column t in the files)"
        text += ": the sweeps are as they were fired and no point has a time, so they stay"
        text += f" stretched by {spot.speed_m_s * period_s:.2f} m"
    else:
        text += ": as they were fired"
    values = {"as_stored": rings.as_stored, "undone": rings.undone, "done": rings.done}
    return finding(name, verdict, text, remedy, **values)


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
        ends = [[sample.sequence.T_world_lidar(s.frame) for s in _ends(spot)] for spot in spots]
    except InputError as error:
        if "no poses" in str(error):
            return [finding("poses", FINE, "none; the sweeps register themselves")]
        return [finding("poses", WRONG, str(error), "--set register.source=kiss-icp")]
    if not spots:
        return [finding("poses", UNKNOWN, "no sweeps could be registered to compare with")]
    odometry = [_between([s.stretch.sweeps[row].T_world_lidar for row in (0, -1)]) for s in spots]
    recorded = [_between(pair) for pair in ends]
    off = RecordedError.of(recorded, odometry)
    text = f"off by {off.m:.2f} m and {off.deg:.2f} deg from odometry over {off.way_m:.1f} m"
    values = {"off_m": off.m, "off_deg": off.deg, "way_m": off.way_m}
    corrected = {
        name: RecordedError.of([_between([change(T) for T in pair]) for pair in ends], odometry)
        for name, change in HYPOTHESES.items()
    }
    best = min(corrected, key=lambda name: corrected[name].cost)
    remedy = "leave them out with --set register.source=kiss-icp"
    if off.cost > 1 and corrected[best].cost < min(_MUCH_BETTER * off.cost, _WRONG_COST):
        text += f", but only by {corrected[best].m:.2f} m and {corrected[best].deg:.2f} deg if "
        text += best
        return [finding("poses", WRONG, text, f"correct the poses, or {remedy}", **values)]
    verdict = FINE if off.way_m >= _LEAST_WAY_M else UNKNOWN
    if off.cost > 1:
        verdict = WRONG if off.cost > _WRONG_COST else SUSPICIOUS
        duration_s = np.mean([(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in map(_ends, spots)])
        mistake, correction = main_error(recorded, odometry, float(duration_s))
        text, remedy = text + mistake, correction + remedy
    elif verdict == UNKNOWN:
        text += "; the vehicle hardly moves"
    return [finding("poses", verdict, text, remedy, **values), _check_clock(sample, odometry)]


def _check_clock(sample: Sample, odometry: list[Float]) -> Finding:
    """Measure at which time shift the poses agree best with odometry (4,4) of each spot."""
    # It is observable only where the vehicle turns or changes its speed.
    late_s = np.arange(-_CLOCK_S, _CLOCK_S + 1e-9, _CLOCK_STEP_S)
    cost, num_used = np.zeros(len(late_s)), 0
    for spot, T_first_last in zip(sample.registered, odometry, strict=True):
        first_ns, last_ns = (end.stamp_ns for end in _ends(spot))
        track = _track(sample, first_ns, last_ns)
        if track is None:  # at the recording's ends
            continue
        num_used += 1
        for row, seconds in enumerate(late_s):
            ends_ns = [int(ns + 1e9 * seconds) for ns in (first_ns, last_ns)]
            recorded = _between([track.at(ns) for ns in ends_ns])
            off = poses.log(poses.inverse(recorded) @ T_first_last)
            cost[row] += np.sum((off[3:] / _NOISE_M) ** 2) + np.sum((off[:3] / _NOISE_RAD) ** 2)
    if not num_used:
        text = "the recording has too few poses before and after the sweeps looked at"
        return finding("clock of poses", UNKNOWN, text)
    good = late_s[cost < cost.min() + _EVEN_COST]
    low_s, high_s, best_s = float(good.min()), float(good.max()), float(late_s[np.argmin(cost)])
    text = (
        f"odometry agrees best with the poses stamped {best_s * 1e3:+.0f} ms "
        f"({low_s * 1e3:+.0f} to {high_s * 1e3:+.0f}) later"
    )
    verdict, remedy = FINE, f"shift the poses' stamps by {-best_s * 1e3:+.0f} ms"
    if high_s - low_s > _WIDEST_CLOCK_S:
        verdict, text = UNKNOWN, f"{text}; the vehicle drives too evenly to tell"
    elif low_s > _CLOCK_OFF_S or high_s < -_CLOCK_OFF_S:
        verdict = SUSPICIOUS
    values = {"late_s": best_s, "low_s": low_s, "high_s": high_s}
    return finding("clock of poses", verdict, text, remedy, **values)


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
