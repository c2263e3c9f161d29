# SPDX-License-Identifier: MIT
"""How far registered poses are off the recording's own, where those are exact."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.config import resolve
from densify.geometry import poses
from densify.geometry.types import LidarSequence
from densify.pipeline.recording import Recording


class PoseErrors(NamedTuple):
    """Root mean squares over the window, of poses relative to the key's."""

    rms_m: float
    rms_deg: float


def bench_registration(sequence: LidarSequence, key: int, window: int) -> PoseErrors:
    """The poses of a key's window. Raises InputError for a missing key, ComputationError where
    registration went wrong."""
    stretch = Recording(sequence, resolve(None), window, [key]).window(key)
    T_true_world = poses.inverse(sequence.T_world_lidar(key))
    off = [
        poses.log(
            poses.inverse(T_true_world @ sequence.T_world_lidar(frame))
            @ stretch.T_target_source(key, frame)
        )
        for frame in stretch.frames
    ]
    rotation, translation = np.hsplit(np.array(off), 2)
    return PoseErrors(_rms(translation), float(np.rad2deg(_rms(rotation))))


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))
