# SPDX-License-Identifier: MIT
"""Check by the motion of the vehicle: odometry, poses, deskewing, scanners and their rings.

The rings of a spinning scanner are cones about its spin axis only if each point is relative to the
scanner at its firing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.doctor.sample import (
    FINE,
    GIVE_TIMES,
    SUSPICIOUS,
    UNKNOWN,
    WRONG,
    Finding,
    Sample,
    Spot,
)
from densify.free_space.ground import HeightMap, find_upright
from densify.free_space.raw_sweeps import MAP_FRAME_REMEDY, is_still, way_in_map
from densify.free_space.sensor import SensorModel, Sensors
from densify.geometry import poses
from densify.geometry.twists import move_with_twists
from densify.geometry.types import Float, Sweep
from densify.readers.recorded_poses import PoseTrack
from densify.readers.timeline import format_frames, remove_unusable_returns
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
from densify.scores.metrics import RecordedError, main_error

_NEAR_M = 25.0  # range of the returns that show the ground, and that are compared for deskewing
# Returns of the ego vehicle
_CELL_M, _CLOSE_M = 0.1, 6.0  # side of a cell in which sweeps agree; reach of the vehicle
_LEAST_RETURNS, _LEAST_HEIGHT_M, _DRIVING_M_S = 20, 0.4, 1.0
_NEARLY_ALL = 0.9  # least share of the sweeps that agree in a cell
_WIDEST_M = 2.6  # width of a road vehicle; kerbs and rails stay beside it too, but farther out
_LEAST_WITHOUT = 0.005  # least reported share of rows without a return
# Deskewing: distances between the first and the last sweep of a spot
_LEAST_DESKEWING_M_S = 3.0
_ABOVE_GROUND_M, _APART_M = 0.5, 1.0  # least height of compared points; greatest distance
_LEAST_POINTS = 50
_CLEARLY_NEARER, _NEARER = 1.2, 1.05  # ratios of distances for a verdict: wrong, fine
# Rings
_FAR_M, _LEAST_RING_POINTS = 60.0, 500
# The search for a scanner's position: first on a grid, with far points and wide bins
_REACH_M = np.array([3.0, 0.8, 2.4])  # reach ahead and behind, aside, above and below
_GRID_M = (0.5, 0.4, 0.05)  # steps of the grid; fine in height, which changes every ring
_COARSE_FROM_M, _COARSE_POINTS, _COARSE_BINS, _NUM_STARTS = 18.0, 3000, 3, 8
_FINER = ((0.1, 3), (0.05, 2), (0.02, 1))  # then by steps in metres, with narrower bins
_CUBE = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)  # neighbours
_MOST_STEPS = 8
# The rings of KITTI's HDL-64E, with two separate blocks of lasers, are sharpest from 0.2 m above.
_OFF_M = 0.3
# Poses
_LEAST_WAY_M = 1.5  # an error of 3 % of this distance exceeds the tolerance
_WRONG_COST = 4.0  # error of wrong poses, as a multiple of the tolerance
_MUCH_BETTER = 0.4  # error after a correction that explains it, as a share of the error before
_CLOCK_S, _CLOCK_STEP_S, _CLOCK_OFF_S = 0.3, 0.02, 0.04  # reach and step of the search; suspicious
_WIDEST_CLOCK_S = 0.1  # a period of most scanners; a wider interval gives no verdict
# Standard errors of odometry, and the excess of cost at two standard errors of the clock
_NOISE_M, _NOISE_RAD, _EVEN_COST = 0.05, 1.5e-3, 4.0
CAM_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""(4,4) pose of a body (x forward, y left, z up) in the axes of a camera."""


def check_registration(sample: Sample) -> list[Finding]:
    """Report sweeps that odometry cannot register."""
    failures = [spot.failure for spot in sample.spots if spot.trajectory is None]
    if len(sample.timeline.frames) < 2:
        return [Finding("registration", UNKNOWN, failures[0])]
    if not failures:
        speeds = ", ".join(f"{spot.speed_m_s:.1f}" for spot in sample.spots)
        return [Finding("registration", FINE, f"odometry finds {speeds} m/s")]
    text = f"{len(failures)} of {len(sample.spots)} places cannot be registered: {failures[0]}"
    remedy = "mend what is wrong above first (unit of points, axes, stamps, point times)"
    return [Finding("registration", WRONG, text, remedy)]


def check_frame(sample: Sample) -> list[Finding]:
    """Check that each sweep is in the frame of its own scanner, not in that of a map."""
    name = "frame of sweeps"
    if sample.unregistered:
        return [Finding(name, UNKNOWN, sample.unregistered)]
    if not all(is_still(s.trajectory.T_world_lidar) for s in sample.spots if s.trajectory):
        return [Finding(name, FINE, "the scanner's own: odometry finds motion")]
    way_m = way_in_map(sample.spots[0].sweeps[0], sample.spots[-1].sweeps[-1])
    if not way_m:
        return [Finding(name, FINE, "the scanner's own: all rays begin there")]
    text = f"that of a map: odometry finds no motion, but rays begin up to {way_m:.1f} m apart"
    return [Finding(name, WRONG, text, MAP_FRAME_REMEDY, {"way_m": way_m})]


def check_sensors(sample: Sample) -> list[Finding]:
    """Describe each scanner as the pipeline models it: rings, field of view, number of returns."""
    if sample.unregistered:
        return [Finding("scanners", UNKNOWN, sample.unregistered)]
    sweeps = [
        replace(registered, sweep=remove_unusable_returns(registered.sweep, sample.settings))
        for registered in sample.fastest.stretch.sweeps
    ]
    models = Sensors.of(sweeps).models
    return [_describe_scanner(sample, number, model) for number, model in models.items()]


def _describe_scanner(sample: Sample, number: int, model: SensorModel) -> Finding:
    """Describe the scanner with index ``number``."""
    spot = sample.fastest
    # Rows of a file without a return are not read: the last row tells their number.
    without_return = max(
        1 - len(sweep) / (int(sweep.row.max(initial=0)) + 1) for sweep in spot.sweeps
    )
    kind = "lines" if model.rings_rad is None else f"{len(model.rings_rad)} rings"
    kind = "no rings" if model.unordered else kind
    low, high = np.rad2deg(model.elevation_rad)
    right, left = np.rad2deg(model.azimuth_rad)
    counts = [int((sweep.lidar == number).sum()) for sweep in spot.sweeps]
    least, most = min(counts), max(counts)
    text = (
        f"{kind}, {low:.1f} to {high:.1f} deg up, {right:.0f} to {left:.0f} deg around, "
        f"{np.rad2deg(model.azimuth_step_rad):.2f} deg from ray to ray, {least:,} to {most:,} "
        f"returns a sweep"
    )
    if without_return > _LEAST_WITHOUT:
        text += f", {100 * without_return:.0f} % of the rows without a return"
    all_sweeps = [sweep for each in sample.spots for sweep in each.sweeps]
    silent = [sweep.frame for sweep in all_sweeps if not (sweep.lidar == number).any()]
    if silent:
        text += f", none in sweeps {format_frames(silent)}"
    verdict, note = FINE, ""
    if silent or least < 0.5 * most:
        verdict, note = SUSPICIOUS, "; some sweeps are broken off"
    remedy = "leave the sweeps with few returns out"
    values = {"returns_least": least, "returns_most": most, "without_return": without_return}
    return Finding(f"scanner {number}", verdict, text + note, remedy, values)


def check_own_vehicle(sample: Sample) -> list[Finding]:
    """Check that ``register.min_range_m`` drops all returns of the ego vehicle.

    These returns keep their position in the lidar frame while the vehicle drives. The verdict is
    SUSPICIOUS if many lie beyond that range, UNKNOWN if the vehicle drives in fewer than two spots.
    """
    driving_spots = [
        spot
        for spot in sample.registered
        if spot.speed_m_s > _DRIVING_M_S
        and (np.linalg.norm(spot.sweeps[0].points, axis=1) < _NEAR_M).any()
    ]
    if len(driving_spots) < 2:
        text = f"the vehicle drives in {len(driving_spots)} of the places looked at, two are needed"
        return [Finding("own vehicle", UNKNOWN, text)]
    range_m = np.linalg.norm(_own_returns(driving_spots), axis=1)
    min_range_m = sample.settings.min_range_m
    # A few returns, and the farthest 1 %, may be chance returns: a kerb has some in the same cells.
    num_beyond = int((range_m > min_range_m).sum())
    is_beyond = num_beyond >= _LEAST_RETURNS and num_beyond > 0.01 * len(range_m)
    range_m = range_m if is_beyond else range_m[range_m <= min_range_m]
    num_returns = len(range_m)
    farthest_m = float(np.percentile(range_m, 99)) if num_returns else 0.0
    where, verdict = (f"{num_beyond} beyond", SUSPICIOUS) if is_beyond else ("within", FINE)
    text = f"{num_returns} returns a sweep, at most {farthest_m:.1f} m away, {where} "
    text += f"register.min_range_m = {min_range_m:g}"
    if num_returns < _LEAST_RETURNS:
        verdict, text = FINE, "no returns of it"
    remedy = f"--set register.min_range_m={np.ceil(10 * farthest_m) / 10:.1f}"
    values = {"farthest_m": farthest_m, "num_returns": num_returns}
    return [Finding("own vehicle", verdict, text, remedy, values)]


def _own_returns(spots: list[Spot]) -> Float:
    """Return the returns (N,3) of the ego vehicle in one sweep, metres, rounded to 0.1 m cells."""
    # Nearly all sweeps have returns of it in the same cells. A few sweeps also have returns of a
    # hedge or rail along the road in the same cells, by chance.
    R_level_lidar = find_upright([spot.sweeps[0] for spot in spots])
    cells_of_sweep = []  # for each sweep, the cell of each return
    for spot in spots:
        for sweep in spot.sweeps:
            candidates = _own_candidates(sweep.points, spot.twist, R_level_lidar)
            cells_of_sweep.append([*map(tuple, np.floor(candidates / _CELL_M).astype(np.int64))])
    num_sweeps = Counter(cell for cells in cells_of_sweep for cell in set(cells))
    least = _NEARLY_ALL * len(cells_of_sweep)
    own_cells = [cell for cell in cells_of_sweep[0] if num_sweeps[cell] >= least]
    return (np.array(own_cells).reshape(-1, 3) + 0.5) * _CELL_M  # middles of the cells


def _own_candidates(points: Float, twist: Float, R_level_lidar: Float) -> Float:
    """Return the (K,3) points, without ground, near enough to be of the ego vehicle."""
    range_m = np.linalg.norm(points, axis=1)
    close = points[range_m < _CLOSE_M]
    # Unit vector to the right of the direction of travel, in the lidar's x and y
    right = np.array([twist[4], -twist[3]]) / np.hypot(twist[3], twist[4])
    close = close[np.abs(close[:, :2] @ right) < _WIDEST_M]
    near_levelled = points[range_m < _NEAR_M] @ R_level_lidar.T
    close_levelled = close @ R_level_lidar.T
    # Mirror images pull down the local ground of one sweep. The lower height counts.
    floor_m = np.percentile(near_levelled[:, 2], 10)
    above_ground_m = HeightMap.of([near_levelled]).above(close_levelled)
    above_m = np.minimum(above_ground_m, close_levelled[:, 2] - floor_m)
    return close[above_m > _LEAST_HEIGHT_M]


def check_deskewing(sample: Sample) -> list[Finding]:
    """Compare how well sweeps align with the point times as given, reversed, and left out."""
    spot = sample.fastest
    if sample.unregistered:
        return [Finding("deskewing", UNKNOWN, sample.unregistered)]
    if spot.sweeps[0].offset_ns is None:
        return [Finding("deskewing", UNKNOWN, "the points have no times")]
    if reason := sample.too_slow(_LEAST_DESKEWING_M_S):
        return [Finding("deskewing", UNKNOWN, reason)]

    untimed = [replace(sweep, offset_ns=None) for sweep in spot.sweeps]
    backward = [
        sweep if sweep.offset_ns is None else replace(sweep, offset_ns=-sweep.offset_ns)
        for sweep in spot.sweeps
    ]
    given_m = _apart_m(spot)
    reversed_m, without_m = (
        _apart_m(Spot.of(tuple(sweeps), sample.settings)) for sweeps in (backward, untimed)
    )
    values = {"given_m": given_m, "reversed_m": reversed_m, "without_m": without_m}
    text = (
        f"sweeps {len(spot.sweeps) - 1} apart lie {given_m * 100:.1f} cm from each other with the "
        f"point times as given, {reversed_m * 100:.1f} cm with the times reversed, "
        f"{without_m * 100:.1f} cm without times"
    )
    verdict, note = FINE, ""
    if min(reversed_m, without_m) * _CLEARLY_NEARER < given_m:
        verdict = WRONG
    elif given_m * _NEARER >= min(reversed_m, without_m):
        verdict, note = UNKNOWN, ": too alike to tell"
    remedy = (
        "correct the sign of the point times (of times by azimuth, sweeps: {turn: anticlockwise}), "
        "or --set register.deskew=false"
    )
    return [Finding("deskewing", verdict, text + note, remedy, values)]


def _apart_m(spot: Spot) -> float:
    """Return the median distance (m) of near points of a spot's end sweeps; 1 m if unknown."""
    if spot.trajectory is None:
        return _APART_M
    ends = spot.stretch.sweeps[0], spot.stretch.sweeps[-1]
    first_points, last_points = (_near_above_ground(end.sweep.points) for end in ends)
    if min(len(first_points), len(last_points)) < _LEAST_POINTS:
        return _APART_M
    T_first_last = _motion_between([end.T_world_lidar for end in ends])
    queries = poses.transform(T_first_last, last_points)[::4]  # every fourth is enough
    tree = cKDTree(first_points)
    distance_m, _ = tree.query(queries, distance_upper_bound=_APART_M, workers=-1)
    return float(np.median(np.minimum(distance_m, _APART_M)))


def _near_above_ground(points: Float) -> Float:
    """Return the points (K,3) within 25 m that are clearly higher than the lowest tenth."""
    near = points[np.linalg.norm(points, axis=1) < _NEAR_M]
    if not len(near):
        return near
    return near[near[:, 2] > np.percentile(near[:, 2], 10) + _ABOVE_GROUND_M]


def check_rings(sample: Sample) -> list[Finding]:
    """Check the position of each scanner, and that its sweeps are not motion-compensated yet."""
    findings = []
    sweep = sample.spots[0].sweeps[0]
    for lidar in sample.lidars:
        name = "scanner's place" if lidar == 0 else f"place of scanner {lidar}"
        R = sweep.axes(lidar)  # rings are level in the scanner's own axes
        given_m = R @ sweep.origin_m(lidar)
        points = _returns_of(sample, lidar) @ R.T
        if len(points) < _LEAST_RING_POINTS:
            text = f"{len(points)} near points, {_LEAST_RING_POINTS} are needed to tell"
            findings.append(Finding(name, UNKNOWN, text))
            continue
        origins_m = (given_m, find_origin(points, given_m))
        findings.append(_check_origin(name, points, R, origins_m))
        findings.append(_check_compensation(sample, lidar, R, origins_m))
    return findings


def _returns_of(sample: Sample, lidar: int) -> Float:
    """Return (N,3) returns of one scanner, lidar frame, from the middle sweeps of all spots."""
    points = []
    for middle in sample.middles:
        sweep = middle.select(middle.lidar == lidar)
        points.append(sweep.points[sample_rows(sweep, _FAR_M)])
    return np.concatenate(points)[:: len(points)]  # about as many as of one sweep


def _check_origin(name: str, points: Float, R: Float, origins_m: tuple[Float, Float]) -> Finding:
    """Compare a scanner's given position (3,) with that of the sharpest rings, scanner axes."""
    given_sharpness, best_sharpness = (sharpness(points, origin_m) for origin_m in origins_m)
    off_m = float(np.linalg.norm(origins_m[1] - origins_m[0]))
    given_m, best_m = ((origin_m @ R).tolist() for origin_m in origins_m)
    given, best = ("({:.2f}, {:.2f}, {:.2f})".format(*position) for position in (given_m, best_m))
    values = {"given_m": given_m, "found_m": best_m, "off_m": off_m}
    values |= {"sharpness_given": given_sharpness, "sharpness_found": best_sharpness}
    text = (
        f"rings are sharpest ({best_sharpness:.2f}) seen from {best}; from the given {given}: "
        f"{given_sharpness:.2f}"
    )
    line = f"scanner_origins: {[[round(coordinate, 2) for coordinate in best_m]]}"
    verdict, note = FINE, ""
    if best_sharpness < LEAST_SHARPNESS:
        verdict, note = UNKNOWN, "; no distinct rings"
    elif best_sharpness <= CLEARLY * given_sharpness:
        note = "; not clearly sharper, so the given place fits" if off_m else ""
    elif off_m > _OFF_M:
        verdict = WRONG
    else:
        note = (
            f"; {off_m:.2f} m off, and up to {_OFF_M:g} m is no error: rings of scanners with two "
            f"blocks of lasers, such as the HDL-64E, are sharpest beside the place"
        )
    remedy = f"give the scanner's place in the points' frame ({line})"
    return Finding(name, verdict, text + note, remedy, values)


def find_origin(points: Float, start_m: Float) -> Float:
    """Return the position (3,) of the scanner from which the rings of its points are sharpest.

    ``points`` (N,3) and ``start_m`` (3,), where the search begins, have z along the spin axis.
    """
    # a coarse grid, with a sample of far points
    axes = [
        np.arange(-reach_m, reach_m + 1e-9, step_m)
        for reach_m, step_m in zip(_REACH_M, _GRID_M, strict=True)
    ]
    grid = start_m + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    far_points = points[np.linalg.norm(points, axis=1) > _COARSE_FROM_M]
    sample = far_points[:: len(far_points) // _COARSE_POINTS + 1]
    values = np.array([sharpness(sample, origin_m, _COARSE_BINS) for origin_m in grid])

    # then steps uphill from the start and from the best positions of the grid
    positions = [start_m.astype(np.float64), *grid[np.argsort(-values)[:_NUM_STARTS]]]
    for step_m, bins in _FINER:
        positions = [_climb(points, position_m, step_m, bins) for position_m in positions]
    return max(positions, key=lambda position_m: sharpness(points, position_m))


def _climb(points: Float, origin_m: Float, step_m: float, bins: int) -> Float:
    """Return the position (3,) to which the steepest steps along a grid of ``step_m`` lead."""
    for _ in range(_MOST_STEPS):
        neighbours_m = origin_m + step_m * _CUBE
        values = [sharpness(points, neighbour_m, bins) for neighbour_m in neighbours_m]
        best = int(np.argmax(values))
        if not _CUBE[best].any():  # the position itself is best
            break
        origin_m = neighbours_m[best]
    return origin_m


def _check_compensation(
    sample: Sample, lidar: int, R: Float, origins_m: tuple[Float, Float]
) -> Finding:
    """Check that the motion within a sweep is not compensated already."""
    name = "motion compensation" + f" of scanner {lidar}" * (lidar > 0)
    if reason := sample.too_slow(LEAST_SPEED_M_S):
        return Finding(name, UNKNOWN, reason)
    spot = sample.fastest
    period_s = sample.timeline.period_ns * 1e-9
    sweep = spot.middle.select(spot.middle.lidar == lidar)
    rows = sample_rows(sweep, COMPENSATED_M)
    points = sweep.points[rows]
    is_untimed = sweep.offset_ns is None
    if sweep.offset_ns is None:
        offset_s = turning_s(points, period_s)
    else:
        offset_s = np.asarray(sweep.offset_ns[rows] * 1e-9, np.float64)
    rings = rings_by_motion(points, offset_s, spot.twist, R, origins_m)
    if not rings.are_distinct:
        # The origin was searched in smeared rings. It is searched again in points as fired.
        as_fired = move_with_twists(points, -offset_s, spot.twist, spot.twist) @ R.T
        rings = rings._replace(undone=sharpness(as_fired, find_origin(as_fired, origins_m[0])))
    text = (
        f"at {spot.speed_m_s:.1f} m/s the rings' sharpness is {rings.as_stored:.2f} as stored, "
        f"{rings.undone:.2f} with a compensation undone, {rings.done:.2f} with the motion "
        f"compensated"
    )
    verdict, note, remedy = FINE, ": as they were fired", "--set register.deskew=false"
    if not rings.are_distinct:
        verdict, note = UNKNOWN, "; no distinct rings"
    elif rings.are_compensated and is_untimed:
        note = f": compensated to {rings.moment}, without times"
    elif rings.are_compensated:
        verdict = WRONG
        note = (
            f": the sweeps are compensated already, to {rings.moment}, and would be a second time"
        )
    elif rings.as_stored < CLEARLY * rings.undone:
        verdict, note = UNKNOWN, ": too alike to tell"
    elif is_untimed:
        verdict, remedy = SUSPICIOUS, GIVE_TIMES
        note = (
            f": the sweeps are as they were fired and no point has a time, so they stay stretched "
            f"by {spot.speed_m_s * period_s:.2f} m"
        )
    values = {"as_stored": rings.as_stored, "undone": rings.undone, "done": rings.done}
    return Finding(name, verdict, text + note, remedy, values)


def change_pose(
    rotation: Callable[[Float], Float] = np.copy, scale: float = 1.0
) -> Callable[[Float], Float]:
    """Return a function on poses (4,4) that maps the rotation (3,3) and scales the translation."""

    def change(T: Float) -> Float:
        T_changed = np.eye(4)
        T_changed[:3, :3] = rotation(T[:3, :3])
        T_changed[:3, 3] = scale * T[:3, 3]
        return T_changed

    return change


def _roll_quaternion(places: int, R: Float) -> Float:
    """Return a rotation (3,3) whose quaternion x y z w is rolled, as by `numpy.roll`."""
    quaternion = np.roll(Rotation.from_matrix(R).as_quat(), places)
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


HYPOTHESES: Mapping[str, Callable[[Float], Float]] = {
    "they are inverted (T_lidar_world instead of T_world_lidar)": poses.inverse,
    "they are a camera's, not the lidar's": lambda T: poses.inverse(CAM_AXES) @ T @ CAM_AXES,
    "they are in millimetres": change_pose(scale=1e-3),
    "they are in kilometres": change_pose(scale=1e3),
    "their quaternions are x y z w, read as w x y z": change_pose(partial(_roll_quaternion, 1)),
    "their quaternions are w x y z, read as x y z w": change_pose(partial(_roll_quaternion, -1)),
    "their rotations are transposed": change_pose(np.transpose),
}
"""Common mistake of poses -> the function (4,4) -> (4,4) that corrects it."""


def check_poses(sample: Sample) -> list[Finding]:
    """Compare the poses as given, and corrected for each common mistake, with odometry."""
    spots = sample.registered
    try:
        T_world_lidar = sample.sequence.T_world_lidar
        recorded_ends = [[T_world_lidar(sweep.frame) for sweep in _ends(spot)] for spot in spots]
    except InputError as error:
        if "no poses" in str(error):
            return [Finding("poses", FINE, "none; the sweeps register themselves")]
        return [Finding("poses", WRONG, str(error), "--set register.source=kiss-icp")]
    if not spots:
        return [Finding("poses", UNKNOWN, "no sweeps could be registered to compare with")]
    # motions from the first to the last sweep of each spot
    odometry_ends = [[s.stretch.sweeps[row].T_world_lidar for row in (0, -1)] for s in spots]
    odometry, recorded = ([*map(_motion_between, ends)] for ends in (odometry_ends, recorded_ends))
    error_given = RecordedError.of(recorded, odometry)
    text = (
        f"off by {error_given.m:.2f} m and {error_given.deg:.2f} deg from odometry over "
        f"{error_given.way_m:.1f} m"
    )
    values = {"off_m": error_given.m, "off_deg": error_given.deg, "way_m": error_given.way_m}
    remedy = "leave them out with --set register.source=kiss-icp"

    errors = {}
    for name, change in HYPOTHESES.items():
        corrected = [_motion_between([change(T) for T in ends]) for ends in recorded_ends]
        errors[name] = RecordedError.of(corrected, odometry)
    best = min(errors, key=lambda name: errors[name].cost)
    is_much_better = errors[best].cost < min(_MUCH_BETTER * error_given.cost, _WRONG_COST)
    if error_given.cost > 1 and is_much_better:
        text += f", but only by {errors[best].m:.2f} m and {errors[best].deg:.2f} deg if {best}"
        return [Finding("poses", WRONG, text, f"correct the poses, or {remedy}", values)]

    verdict, note = FINE, ""
    if error_given.cost > 1:
        verdict = WRONG if error_given.cost > _WRONG_COST else SUSPICIOUS
        durations_s = [(last.stamp_ns - first.stamp_ns) * 1e-9 for first, last in map(_ends, spots)]
        note, correction = main_error(recorded, odometry, float(np.mean(durations_s)))
        remedy = correction + remedy
    elif error_given.way_m < _LEAST_WAY_M:
        verdict, note = UNKNOWN, "; the vehicle hardly moves"
    poses_finding = Finding("poses", verdict, text + note, remedy, values)
    return [poses_finding, _check_clock(sample, odometry)]


def _check_clock(sample: Sample, odometry: list[Float]) -> Finding:
    """Measure at which time shift the poses agree best with odometry (4,4) of each spot."""
    # The shift is observable only where the vehicle turns or changes its speed.
    late_s = np.arange(-_CLOCK_S, _CLOCK_S + 1e-9, _CLOCK_STEP_S)
    cost = np.zeros(len(late_s))  # sum of squared errors in standard errors, for each shift
    num_used = 0
    for spot, T_first_last in zip(sample.registered, odometry, strict=True):
        first_ns, last_ns = (end.stamp_ns for end in _ends(spot))
        track = _poses_around(sample, first_ns, last_ns)
        if track is None:
            continue
        num_used += 1
        for row, seconds in enumerate(late_s):
            ends = [track.at(int(ns + 1e9 * seconds)) for ns in (first_ns, last_ns)]
            error = poses.log(poses.inverse(_motion_between(ends)) @ T_first_last)
            cost[row] += np.sum((error[3:] / _NOISE_M) ** 2) + np.sum((error[:3] / _NOISE_RAD) ** 2)
    if not num_used:
        text = "the recording has too few poses before and after the sweeps looked at"
        return Finding("clock of poses", UNKNOWN, text)
    likely_s = late_s[cost < cost.min() + _EVEN_COST].tolist()
    low_s, high_s, best_s = min(likely_s), max(likely_s), float(late_s[np.argmin(cost)])
    text = (
        f"odometry agrees best with the poses stamped {best_s * 1e3:+.0f} ms "
        f"({low_s * 1e3:+.0f} to {high_s * 1e3:+.0f}) later"
    )
    verdict, note = FINE, ""
    if high_s - low_s > _WIDEST_CLOCK_S:
        verdict, note = UNKNOWN, "; the vehicle drives too evenly to tell"
    elif low_s > _CLOCK_OFF_S or high_s < -_CLOCK_OFF_S:
        verdict = SUSPICIOUS
    remedy = f"shift the poses' stamps by {-best_s * 1e3:+.0f} ms"
    values = {"late_s": best_s, "low_s": low_s, "high_s": high_s}
    return Finding("clock of poses", verdict, text + note, remedy, values)


def _poses_around(sample: Sample, first_ns: int, last_ns: int) -> PoseTrack | None:
    """Return the recording's poses around a spot; None at its ends or if a pose is missing."""
    reach_ns = int(1e9 * _CLOCK_S)
    timeline = sample.timeline
    # Twice the reach, to hold a sweep before and after it.
    frames = timeline.within(first_ns - 2 * reach_ns, last_ns + 2 * reach_ns)
    stamp_ns = np.array([timeline.stamp_of(frame) for frame in frames], np.int64)
    if stamp_ns[0] > first_ns - reach_ns or stamp_ns[-1] < last_ns + reach_ns:
        return None
    try:
        T_world_lidar = np.stack([sample.sequence.T_world_lidar(frame) for frame in frames])
        return PoseTrack(sample.sequence.name, stamp_ns, T_world_lidar)
    except InputError:
        return None


def _ends(spot: Spot) -> tuple[Sweep, Sweep]:
    """Return the first and the last sweep of a spot."""
    return spot.sweeps[0], spot.sweeps[-1]


def _motion_between(ends: list[Float]) -> Float:
    """Return the (4,4) motion from the first of two poses to the last."""
    return poses.inverse(ends[0]) @ ends[1]
