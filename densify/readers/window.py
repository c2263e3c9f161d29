# SPDX-License-Identifier: MIT
"""Which sweeps and cameras a key needs, and reading them."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from densify.config import RegisterSettings
from densify.errors import InputError
from densify.readers.files import format_frames
from densify.types import Camera, LidarSequence, Sweep, Trajectory

log = logging.getLogger("densify")


def window_frames(
    sequence: LidarSequence, key: int, window: int, num_lead_in: int
) -> tuple[list[int], list[int]]:
    """Frames of the window and of the lead-in before it, both ascending.

    At the ends of the recording the window is cut, with a warning. The lead-in is what exists
    directly before the window, at most ``num_lead_in`` sweeps.

    Raises InputError if the key or a frame inside the window does not exist.
    """
    there = set(sequence.frames)
    if window < 0:
        raise InputError(f"--window {window}: expected 0 or more sweeps on each side of the key")
    if key not in there:
        raise InputError(
            f"--key {key}: no such frame in {sequence.name}; "
            f"it has {format_frames(sequence.frames)}"
        )
    wanted = range(key - window, key + window + 1)
    first, last = min(there), max(there)
    frames = [f for f in wanted if first <= f <= last]
    missing = [f for f in frames if f not in there]
    if missing:
        raise InputError(
            f"--key {key} --window {window}: {sequence.name} has no sweep for frame "
            f"{format_frames(missing)}; it has {format_frames(sequence.frames)}; "
            f"choose another key or a smaller window"
        )
    if len(frames) < len(wanted):
        log.warning(
            "the window of key %d is cut at the end of the recording: frames %s",
            key,
            format_frames(frames),
        )
    lead_in: list[int] = []
    while len(lead_in) < num_lead_in and frames[0] - len(lead_in) - 1 in there:
        lead_in.insert(0, frames[0] - len(lead_in) - 1)
    return frames, lead_in


def read_sweeps(
    sequence: LidarSequence, frames: Sequence[int], settings: RegisterSettings
) -> Iterator[Sweep]:
    """The sweeps without the own vehicle's returns and those too far to trust, and without
    per-point times where they are not to be deskewed."""
    for frame in frames:
        sweep = sequence[frame]
        range_m = np.linalg.norm(sweep.points, axis=1)
        sweep = sweep.select((range_m >= settings.min_range_m) & (range_m <= settings.max_range_m))
        yield sweep if settings.deskew else replace(sweep, offset_ns=None)


def choose_cameras(sequence: LidarSequence, names: Sequence[str] | None) -> list[Camera]:
    """The cameras of these names, all if None. Raises InputError naming those that exist."""
    for name in names or ():
        if name not in sequence.cameras:
            known = ", ".join(sequence.cameras) or "none"
            raise InputError(
                f"--camera {name}: no such camera in {sequence.name}; expected one of {known}"
            )
    return [sequence.cameras[n] for n in (sequence.cameras if names is None else names)]


def recorded_trajectory(sequence: LidarSequence, sweeps: Sequence[Sweep]) -> Trajectory:
    """The data set's own poses of the sweeps."""
    return Trajectory(
        frames=tuple(s.frame for s in sweeps),
        stamp_ns=np.array([s.stamp_ns for s in sweeps], np.int64),
        T_world_lidar=np.stack([sequence.T_world_lidar(s.frame) for s in sweeps]),
    )
