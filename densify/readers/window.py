# SPDX-License-Identifier: MIT
"""The sweeps, cameras and poses of a recording that a run uses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.geometry.types import Camera, LidarSequence, Sweep, Trajectory


def read_sweep(sequence: LidarSequence, frame: int, settings: RegisterSettings) -> Sweep:
    """Return a sweep of the returns `in_range`, without times if it is not to be deskewed. Raises
    InputError if it cannot be read."""
    sweep = in_range(sequence[frame], settings)
    return sweep if settings.deskew else replace(sweep, offset_ns=None)


def in_range(sweep: Sweep, settings: RegisterSettings) -> Sweep:
    """Return the sweep without the own vehicle's returns and those too far to trust, both measured
    from the scanner."""
    origins_m = sweep.scanner_origins
    x, y, z = (sweep.points if origins_m is None else sweep.points - origins_m[sweep.lidar]).T
    range_m = np.sqrt(x * x + y * y + z * z)
    return sweep.select((range_m >= settings.min_range_m) & (range_m <= settings.max_range_m))


def choose_cameras(sequence: LidarSequence, names: Sequence[str] | None) -> list[Camera]:
    """Return the cameras of these names; if None all with images, or all where none has any.
    Raises InputError naming those that exist."""
    if isinstance(names, str) or not isinstance(names, Iterable | None):
        one = [*sequence.cameras][:1]
        raise InputError(f"cameras: got {names!r}, expected a list of names, such as {one}")
    for name in names or ():
        if name not in sequence.cameras:
            known = ", ".join(sequence.cameras)
            expected = f"expected one of {known}" if known else "it has none; leave --camera out"
            raise InputError(f"--camera {name}: no such camera in {sequence.name}; {expected}")
    if names is None:
        names = [n for n in sequence.cameras if sequence.image_stamps_ns(n)] or [*sequence.cameras]
    return [sequence.cameras[name] for name in names]


def recorded_trajectory(sequence: LidarSequence, sweeps: Sequence[Sweep]) -> Trajectory:
    """Return the data set's own poses of the sweeps."""
    return Trajectory(
        frames=tuple(s.frame for s in sweeps),
        stamp_ns=np.array([s.stamp_ns for s in sweeps], np.int64),
        T_world_lidar=np.stack([sequence.T_world_lidar(s.frame) for s in sweeps]),
    )
