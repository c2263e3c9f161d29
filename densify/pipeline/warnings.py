# SPDX-License-Identifier: MIT
"""Warn about a result: assumptions and suspicions, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from densify.config import Config
from densify.depth.exposure import Shot
from densify.geometry.types import LidarSequence, Result, Stretch
from densify.pipeline.key_result import METHODS, looks_around
from densify.pipeline.recording import Recording
from densify.readers.timeline import format_frames
from densify.scores.depth_metrics import image_density

_LEAST_DENSITY = 0.001  # sixteen rings alone measure 0.5 % of an image
_SLOW_S = 0.15  # from sweep to sweep; at 5 Hz trucks slide along their own sides
_OTHER_CLOCK_S = 1.0  # from a sweep to the nearest image


def add_warnings(
    results: Mapping[str, Result],
    recording: Recording,
    key: int,
    shots: Mapping[str, Shot],
) -> dict[str, Result]:
    """Return the results of a key's methods, by name, with `Result.warnings`.

    Args:
        shots: Of the maps, by name.
    """
    sequence, stretch = recording.sequence, recording.window(key)
    cameras = {shot.camera.name for shot in shots.values()}
    shared = [
        *_of_window(recording, key, looks_around([*results])),
        *(sequence.gaps() if hasattr(sequence, "gaps") else ()),
        *(
            f"{name} is left out: the recording has no images of it; ask with --camera {name}"
            for name in sequence.cameras
            if name not in cameras and not sequence.image_stamps_ns(name)
        ),
        *_of_sweeps(stretch, recording.settings),
        *_of_images(sequence, shots),
    ]
    told = {n: dict.fromkeys([*shared, *_of_result(r, stretch)]) for n, r in results.items()}
    return {name: replace(result, warnings=tuple(told[name])) for name, result in results.items()}


def _of_window(recording: Recording, key: int, follows: bool) -> Iterator[str]:
    window = recording.window_frames(key)
    for cut in window.cuts:
        yield f"the window is cut to frames {format_frames(window.frames)}: {cut}"
    if follows and recording.is_pair(key):
        yield "two sweeps show what moves less well than three or more, which can be followed"


def _of_sweeps(stretch: Stretch, settings: Config) -> Iterator[str]:
    if settings.register.deskew and any(s.sweep.offset_ns is None for s in stretch.sweeps):
        yield "the points have no times of their own: motion within a sweep is not undone"


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
