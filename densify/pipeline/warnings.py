# SPDX-License-Identifier: MIT
"""Warn about assumptions behind a result and suspected errors, in one sentence each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from densify.config.errors import InputError
from densify.depth.exposure import Shot
from densify.free_space.raw_sweeps import LOST_DEG, blind_sector, lost_deg
from densify.geometry import poses
from densify.geometry.types import Camera, LidarSequence, Result, Stretch, Sweep
from densify.pipeline.key_result import METHODS, looks_around
from densify.pipeline.recording import Recording
from densify.readers.timeline import format_frames
from densify.registration.deskew import find_compensated
from densify.registration.trajectory import find_trajectory
from densify.scores.metrics import RecordedError, image_density, main_error

_LEAST_DENSITY = 0.001  # share of the pixels; sixteen rings alone measure 0.005
_SLOW_S = 0.15  # period of sweeps; at 5 Hz the motion of a truck along its own side is ambiguous
_OTHER_CLOCK_S = 1.0  # time from a sweep to the nearest image that suggests two clocks
_LEAST_SIDE = 2  # sweeps on each side of the key, over which recorded poses are compared
# Suspicious shares of the points. A car's own returns were up to 0.14. Clean recordings have up to
# 0.0021 below the ground. Most returns are of ground and buildings.
_MAX_NEAR, _MAX_BELOW, _MAX_MOVING = 0.2, 0.0025, 1 / 3
_MAX_TILT = np.sin(np.deg2rad(45))  # of a camera against upright and level


def add_warnings(
    results: Mapping[str, Result], recording: Recording, key: int, shots: Mapping[str, Shot]
) -> dict[str, Result]:
    """Return the results of one key, by method, with the field ``warnings`` filled in."""
    sequence = recording.sequence
    stretch = recording.window(key)
    cameras = {shot.camera.name for shot in shots.values()}
    shared = [
        *_warn_of_window(recording, key, looks_around([*results])),
        *(sequence.gaps() if hasattr(sequence, "gaps") else ()),
        *(
            f"{name} is left out: the recording has no images of it; ask with --camera {name}"
            for name in sequence.cameras
            if name not in cameras and not sequence.image_stamps_ns(name)
        ),
        *_warn_of_sweeps(recording, key),
        *_warn_of_motion(recording, key),
        *_warn_of_images(sequence, shots),
        *_warn_of_poses(shot.camera for shot in shots.values()),
    ]
    warned = {}
    for method, result in results.items():
        # Each warning once, in the order of their first appearance.
        warnings = dict.fromkeys([*shared, *warn_of_result(result, stretch)])
        warned[method] = replace(result, warnings=tuple(warnings))
    return warned


def _warn_of_poses(cameras: Iterable[Camera]) -> Iterator[str]:
    """Yield a warning for each camera that lies on its side, hangs upside down or looks up.

    This detects an inverted pose or one of other axes, where a single image shows too little.
    """
    for name, camera in {camera.name: camera for camera in cameras}.items():
        right, down, ahead = camera.T_cam_lidar[:3, 2]  # z components of the camera's axes
        postures = {
            "lies on its side": abs(right) > _MAX_TILT,
            "hangs upside down": down > _MAX_TILT,
            "looks up": ahead > _MAX_TILT,
        }
        for posture in [posture for posture, is_so in postures.items() if is_so]:
            yield (
                f"{name} {posture} by its T_cam_lidar: if it does not, the pose is inverted "
                f"(T_lidar_cam) or of other axes; densify doctor looks into it"
            )


def _warn_of_window(recording: Recording, key: int, has_flow: bool) -> Iterator[str]:
    """Yield warnings about a small window, also for scene flow if ``has_flow``."""
    window = recording.window_frames(key)
    for reason in window.cuts:
        yield f"the window is cut to frames {format_frames(window.frames)}: {reason}"
    if has_flow and recording.is_pair(key):
        yield "in two sweeps moving objects are found less well than in three or more"


def _warn_of_sweeps(recording: Recording, key: int) -> Iterator[str]:
    """Yield warnings about missing point times, silent scanners and points that are left out."""
    settings = recording.settings
    sweeps = [registered.sweep for registered in recording.window(key).sweeps]
    if settings.register.deskew and any(sweep.offset_ns is None for sweep in sweeps):
        yield (
            "the points have no times of their own: motion within a sweep is not undone, and unless"
            " that was done before, confidence is low on purpose; densify doctor says what to do"
        )
    untimed = {sweep.frame: sweep.num_untimed for sweep in sweeps if sweep.num_untimed}
    if untimed:
        yield (
            f"{sum(untimed.values()):,} points of sweeps {format_frames(untimed)} are left out: "
            f"their times lie outside their sweep, the driver wrote them wrong"
        )
    yield from _warn_of_silent_scanners(sweeps)
    num_lone = sum(sweep.num_lone for sweep in sweeps)
    if num_lone:
        share = num_lone / (num_lone + sum(len(sweep) for sweep in sweeps))
        yield (
            f"{100 * share:.0f} % of the points are lone returns, as of snow, rain or dust; they "
            f"are left out, and motion is less certain"
        )
    num_near = sum(sweep.num_near for sweep in sweeps)
    share_near = num_near / max(num_near + sum(map(len, sweeps)), 1)
    if share_near > _MAX_NEAR:
        yield (
            f"register.min_range_m = {settings.register.min_range_m:g} takes "
            f"{100 * share_near:.0f} % of the points as the own vehicle's; indoors and on small "
            f"robots set it to the reach of the vehicle"
        )
    share_below = recording.share_below(key)
    if share_below > _MAX_BELOW:
        yield (
            f"{100 * share_below:.1f} % of the points lie below the ground, as mirror images of a "
            f"wet road and echoes over two surfaces do; they are left out"
        )
    if share_near <= _MAX_NEAR:  # else sweeps may lack the returns of the ego vehicle
        yield from _warn_of_sectors(recording, [sweep.frame for sweep in sweeps])


def _warn_of_silent_scanners(sweeps: Sequence[Sweep]) -> Iterator[str]:
    """Yield a warning for each scanner without returns in some of the sweeps."""
    for lidar in np.unique(np.concatenate([np.unique(sweep.lidar) for sweep in sweeps])):
        silent = [sweep.frame for sweep in sweeps if not (sweep.lidar == lidar).any()]
        if silent:
            yield (
                f"sweeps {format_frames(silent)} have no returns of scanner {lidar}, which others "
                f"have: surfaces that only this scanner sees are measured in other sweeps alone"
            )


def _warn_of_sectors(recording: Recording, frames: Sequence[int]) -> Iterator[str]:
    """Yield warnings about directions in which raw sweeps lack returns."""
    returns = np.stack([recording.sweeps.returns_by_azimuth(frame) for frame in frames])
    widths_deg = zip(frames, lost_deg(returns), strict=True)
    lacking_deg = {frame: width for frame, width in widths_deg if width >= LOST_DEG}
    if lacking_deg:
        widest_deg = max(lacking_deg.values())
        yield (
            f"sweeps {format_frames(lacking_deg)} have no returns in up to {widest_deg:.0f} "
            f"deg of azimuth where others have some, as after lost packets: static surfaces there "
            f"are of other sweeps, and motion is less certain"
        )
    sector = blind_sector(returns)
    if sector is not None:
        first_deg, last_deg = sector
        yield (
            f"no sweep has a return from {first_deg} to {last_deg} deg of azimuth "
            f"(counterclockwise from x): a blind sector; depth there is filled in or missing"
        )


def _warn_of_motion(recording: Recording, key: int) -> Iterator[str]:
    """Yield warnings if sweeps seem compensated already, or if given poses do not align them."""
    settings = recording.settings.register
    key_sweep = recording.window(key)[key]
    rings = None
    if key_sweep.sweep.offset_ns is not None:
        period_s = recording.timeline.period_ns * 1e-9
        rings = find_compensated(recording.sweeps.read(key), key_sweep.twist, period_s)
    if rings is not None:
        yield (
            f"the sweeps are compensated already, to {rings.moment}, and now a second time: the "
            f"rings are {rings.undone / rings.as_stored:.1f} times as sharp with a compensation "
            f"undone; --set register.deskew=false"
        )
    if settings.source == "dataset":
        yield from _warn_of_recorded_poses(recording, key)


def _warn_of_recorded_poses(recording: Recording, key: int) -> Iterator[str]:
    """Yield a warning if odometry does not confirm the recording's poses around the key."""
    timeline = recording.timeline
    row = timeline.row[key]
    num_beside = max(len(recording.window(key).frames) // 2, _LEAST_SIDE)
    neighbours = timeline.frames[max(row - num_beside, 0) : row + num_beside + 1]
    (run,) = (run for run in timeline.split_at_holes(neighbours) if key in run)
    by_odometry = replace(recording.settings.register, source="kiss-icp")
    try:
        sweeps = [recording.sweeps.read(frame) for frame in run]
        odometry = find_trajectory(sweeps, by_odometry).T_world_lidar
        recorded = [recording.sequence.T_world_lidar(frame) for frame in (run[0], run[-1])]
    except InputError:
        return  # too short or too poor to compare
    # From the first sweep to the last
    recorded_motion = poses.inverse(recorded[0]) @ recorded[-1]
    odometry_motion = poses.inverse(odometry[0]) @ odometry[-1]
    error = RecordedError.of([recorded_motion], [odometry_motion])
    if error.cost > 1:
        duration_s = (sweeps[-1].stamp_ns - sweeps[0].stamp_ns) * 1e-9
        mistake, remedy = main_error([recorded_motion], [odometry_motion], duration_s)
        yield (
            f"the recording's poses are off by {error.m:.2f} m and {error.deg:.1f} deg from "
            f"odometry over {error.way_m:.1f} m around sweep {key}{mistake}; {remedy}leave them "
            f"out with --set register.source=kiss-icp"
        )


def _warn_of_images(sequence: LidarSequence, shots: Mapping[str, Shot]) -> Iterator[str]:
    """Yield a warning for each depth map to which no image belongs."""
    for name, shot in shots.items():
        if shot.number is not None:
            continue
        stamps_ns = list(sequence.image_stamps_ns(shot.camera.name).values())
        if not stamps_ns:
            yield f"{name}: the recording has no image of it: its map has no colour"
            continue
        nearest_s = min(abs(stamp_ns - shot.stamp_ns) for stamp_ns in stamps_ns) * 1e-9
        clocks = "; are the stamps of both by one clock?" if nearest_s > _OTHER_CLOCK_S else ""
        yield (
            f"{name}: no image belongs to the sweep, the nearest was taken {nearest_s:.3g} s away: "
            f"its map has no colour{clocks}"
        )


def warn_of_result(result: Result, stretch: Stretch) -> Iterator[str]:
    """Yield the warnings about the result of one method on the window's sweeps (``stretch``)."""
    stamps_ns = [registered.sweep.stamp_ns for registered in stretch.sweeps]
    if METHODS[result.method].engine is not None and len(stamps_ns) > 1:
        period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
        if period_s > _SLOW_S:
            yield (
                f"sweeps are {period_s:.2g} s apart: fast objects are followed less exactly than "
                f"at 10 Hz, and lost where they turn or are occluded between two"
            )
    if result.cloud.moving.mean() > _MAX_MOVING:
        yield (
            f"{100 * result.cloud.moving.mean():.0f} % of the points move, more than in any "
            f"traffic: are poses and times of points right? densify doctor looks into both"
        )
    if result.far_left_out:
        yield (
            f"sweeps {format_frames(result.far_left_out)} are left out of the far range: surfaces "
            f"there do not agree with those nearer to the window"
        )
    for name, maps in result.depth.items():
        yield from (f"{name}: {warning}" for warning in maps.warnings)
        density = image_density(maps.depth_m)
        if density < _LEAST_DENSITY:
            yield (
                f"{name}: {100 * density:.2f} % of the pixels have a measured depth; are "
                f"calibration and stamps right? densify doctor looks into both"
            )
