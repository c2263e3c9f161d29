# SPDX-License-Identifier: MIT
"""What was assumed for a result, or looks wrong about it: a run of a wrong calibration or clock has
no other way to tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from densify.config import Config
from densify.depth.exposure import Shot
from densify.geometry.types import Camera, KnowsItsGaps, LidarSequence, Result, Stretch
from densify.pipeline.methods import METHODS
from densify.readers.timeline import format_frames
from densify.registration.upright import ground_aside
from densify.scores.depth_metrics import image_density

_LEAST_DENSITY = 0.001  # sixteen rings alone measure 0.5 % of an image
_FARTHEST_M = 20.0  # a camera from the scanner, on the longest trucks
_STEEPEST_DEG = 60.0  # a camera's view, up or down
_LONGEST_SWEEP = 1.5  # of the usual time from sweep to sweep
_SLOW_S = 0.15  # from sweep to sweep; at 5 Hz trucks slide along their own sides
_OTHER_CLOCK_S = 1.0  # from a sweep to the nearest image; a camera that missed some is sooner back


def with_doubts(
    results: Mapping[str, Result],
    sequence: LidarSequence,
    stretch: Stretch,
    shots: Mapping[str, Shot],
    settings: Config,
    cuts: Sequence[str] = (),
) -> dict[str, Result]:
    """The results of a key's methods with `Result.warnings`, each a sentence.

    shots: what the maps show. cuts: of the window, sentences that come first. Checked: what the
    reader had to assume, cameras left out for want of images, where cameras stand and look, axes
    that do not stand on the ground, point times that are absent or longer than a sweep, sweeps too
    far apart to follow what is fast, images too far in time, sweeps left out of the far range, what
    maps could not be made as asked, maps with next to nothing in them.
    """
    chosen = {shot.camera.name: shot.camera for shot in shots.values()}
    shared = [
        *cuts,
        *(sequence.gaps() if isinstance(sequence, KnowsItsGaps) else ()),
        *_left_out(sequence, chosen),
        *(doubt for camera in chosen.values() for doubt in _of_camera(camera)),
        *_of_axes(stretch),
        *_of_times(stretch, settings),
        *_of_shots(sequence, shots),
    ]
    own = {
        name: [*_of_rate(name, stretch), *_of_far(result), *_of_maps(result)]
        for name, result in results.items()
    }
    return {
        name: replace(result, warnings=tuple(dict.fromkeys([*shared, *own[name]])))
        for name, result in results.items()
    }


def _left_out(sequence: LidarSequence, chosen: Mapping[str, Camera]) -> Iterator[str]:
    for name in sequence.cameras:
        if name not in chosen and not sequence.image_stamps_ns(name):
            yield f"{name} is left out: the recording has no images of it; ask with --camera {name}"


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
    up = ground_aside(stretch.sweeps[len(stretch.sweeps) // 2].sweep)
    if up:
        yield (
            f"the ground lies as if {up} pointed up, not z: what moves is hardly found so; densify "
            f"doctor says which axes the points have"
        )


def _of_times(stretch: Stretch, settings: Config) -> Iterator[str]:
    """Doubts of the point times, where motion within sweeps is to be undone."""
    if not settings.register.deskew:
        return
    sweeps = [registered.sweep for registered in stretch.sweeps]
    if any(sweep.offset_ns is None for sweep in sweeps):
        yield "the points have no times of their own: motion within a sweep is not undone"
    stamps_ns = [sweep.stamp_ns for sweep in sweeps]
    if len(stamps_ns) < 2:
        return
    period_ns = float(np.median(np.diff(stamps_ns)))
    times = [s.offset_ns for s in sweeps if s.offset_ns is not None and len(s.offset_ns)]
    longest_ns = max((int(offset_ns.max() - offset_ns.min()) for offset_ns in times), default=0)
    if longest_ns > _LONGEST_SWEEP * period_ns:
        yield (
            f"a sweep takes {longest_ns * 1e-6:.0f} ms by the times of its points, and the next "
            f"comes after {period_ns * 1e-6:.0f} ms; are their stamps right?"
        )


def _of_rate(method: str, stretch: Stretch) -> Iterator[str]:
    if METHODS[method].engine is None or len(stretch.sweeps) < 2:
        return
    period_s = float(np.median(np.diff([s.sweep.stamp_ns for s in stretch.sweeps]))) * 1e-9
    if period_s > _SLOW_S:
        yield (
            f"sweeps are {period_s:.2g} s apart: what is fast is followed less exactly than at "
            f"10 Hz, and lost where it turns or hides between two"
        )


def _of_shots(sequence: LidarSequence, shots: Mapping[str, Shot]) -> Iterator[str]:
    for name, shot in shots.items():
        stamps_ns = list(sequence.image_stamps_ns(shot.camera.name).values())
        if shot.number is not None:
            continue
        if not stamps_ns:
            yield f"{name}: the recording has no image of it: its map has no colour"
            continue
        nearest_s = min(abs(stamp_ns - shot.stamp_ns) for stamp_ns in stamps_ns) * 1e-9
        clocks = "; are the stamps of both by one clock?" if nearest_s > _OTHER_CLOCK_S else ""
        yield (
            f"{name}: no image belongs to the sweep, the nearest was taken {nearest_s:.3g} s away: "
            f"its map has no colour{clocks}"
        )


def _of_far(result: Result) -> Iterator[str]:
    if result.far_left_out:
        yield (
            f"sweeps {format_frames(result.far_left_out)} are left out of the far range: surfaces "
            f"there do not lie well on those nearer to the window; run.yaml has the pairs"
        )


def _of_maps(result: Result) -> Iterator[str]:
    for name, maps in result.depth.items():
        yield from (f"{name}: {warning}" for warning in maps.warnings)
        density = image_density(maps.depth_m)
        if density < _LEAST_DENSITY:
            yield (
                f"{name}: {100 * density:.2f} % of the pixels have a measured depth; are "
                f"calibration and stamps right? densify doctor looks into both"
            )
