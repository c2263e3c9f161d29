# SPDX-License-Identifier: MIT
"""Warnings about a result: what was assumed for it, or looks wrong, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from densify.config import Config
from densify.depth.exposure import Shot
from densify.free_space.ground import find_up_axis
from densify.geometry.types import Camera, KnowsItsGaps, LidarSequence, Result, Stretch
from densify.pipeline.methods import METHODS
from densify.readers.timeline import WindowFrames, format_frames
from densify.scores.depth_metrics import image_density

_LEAST_DENSITY = 0.001  # sixteen rings alone measure 0.5 % of an image
_FARTHEST_M = 20.0  # a camera from the scanner, on the longest trucks
_STEEPEST_DEG = 60.0  # a camera's view, up or down
_LONGEST_SWEEP = 1.5  # of the usual time from sweep to sweep
_SLOW_S = 0.15  # from sweep to sweep; at 5 Hz trucks slide along their own sides
_OTHER_CLOCK_S = 1.0  # from a sweep to the nearest image


def warn_of_window(window: WindowFrames, is_pair: bool) -> list[str]:
    """Say why a key's window has fewer sweeps than asked for, or too few to follow anything."""
    frames = format_frames(window.frames)
    warnings = [f"the window is cut to frames {frames}: {cut}" for cut in window.cuts]
    if is_pair:
        warnings.append(
            "two sweeps show what moves less well than three or more, which can be followed"
        )
    return warnings


def add_warnings(
    results: Mapping[str, Result],
    sequence: LidarSequence,
    stretch: Stretch,
    shots: Mapping[str, Shot],
    settings: Config,
    first: Sequence[str],
) -> dict[str, Result]:
    """Return the results of a key's methods with `Result.warnings`, ``first`` among them."""
    cameras = {shot.camera.name: shot.camera for shot in shots.values()}
    shared = [
        *first,
        *(sequence.gaps() if isinstance(sequence, KnowsItsGaps) else ()),
        *(
            f"{name} is left out: the recording has no images of it; ask with --camera {name}"
            for name in sequence.cameras
            if name not in cameras and not sequence.image_stamps_ns(name)
        ),
        *(warning for camera in cameras.values() for warning in _of_camera(camera)),
        *_of_axes(stretch),
        *_of_times(stretch, settings),
        *_of_images(sequence, shots),
    ]
    return {
        name: replace(
            result, warnings=tuple(dict.fromkeys([*shared, *_of_result(result, stretch)]))
        )
        for name, result in results.items()
    }


def _of_camera(camera: Camera) -> Iterator[str]:
    R, t = camera.T_cam_lidar[:3, :3], camera.T_cam_lidar[:3, 3]
    distance_m = float(np.linalg.norm(t))
    if distance_m > _FARTHEST_M:
        yield (
            f"{camera.name} stands {distance_m:.0f} m from the scanner by its calibration; is the "
            f"translation in metres?"
        )
    steepness_deg = float(np.rad2deg(np.arcsin(np.clip(R[2, 2], -1, 1))))
    if abs(steepness_deg) > _STEEPEST_DEG:
        yield (
            f"{camera.name} looks {'up' if steepness_deg > 0 else 'down'} by "
            f"{abs(steepness_deg):.0f} deg by its calibration; is the rotation from the scanner's "
            f"axes (x forward, z up) to the camera's (z forward, y down)?"
        )


def _of_axes(stretch: Stretch) -> Iterator[str]:
    up = find_up_axis(stretch.sweeps[len(stretch.sweeps) // 2].sweep)
    if up:
        yield (
            f"the ground lies as if {up} pointed up, not z: moving objects are hardly found so; "
            f"densify doctor says which axes the points have"
        )


def _of_times(stretch: Stretch, settings: Config) -> Iterator[str]:
    sweeps = [registered.sweep for registered in stretch.sweeps]
    if not settings.register.deskew:
        return
    if any(sweep.offset_ns is None for sweep in sweeps):
        yield "the points have no times of their own: motion within a sweep is not undone"
    if len(sweeps) < 2:
        return
    period_ns = float(np.median(np.diff([sweep.stamp_ns for sweep in sweeps])))
    times = [s.offset_ns for s in sweeps if s.offset_ns is not None and len(s.offset_ns)]
    longest_ns = max((int(np.ptp(offset_ns)) for offset_ns in times), default=0)
    if longest_ns > _LONGEST_SWEEP * period_ns:
        yield (
            f"a sweep takes {longest_ns * 1e-6:.0f} ms by the times of its points, and the next "
            f"comes after {period_ns * 1e-6:.0f} ms; are their stamps right?"
        )


def _of_images(sequence: LidarSequence, shots: Mapping[str, Shot]) -> Iterator[str]:
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


def _of_result(result: Result, stretch: Stretch) -> Iterator[str]:
    stamps_ns = [s.sweep.stamp_ns for s in stretch.sweeps]
    if METHODS[result.method].engine is not None and len(stamps_ns) > 1:
        period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
        if period_s > _SLOW_S:
            yield (
                f"sweeps are {period_s:.2g} s apart: fast objects are followed less exactly than "
                f"at 10 Hz, and lost where they turn or are occluded between two"
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
