# SPDX-License-Identifier: MIT
"""Define the result of a key: its maps, tracks and costs, and its maps completed with a prior."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types.depth import CameraView, Cloud, DepthMap, Mover
from densify.geometry.types.sweeps import StretchFlow

METHOD_NAMES = {"none": "single sweep", "icp": "rigid accumulation", "flow": "scene flow"}
"""The methods' names for people. Other methods have only their own."""


@dataclass(frozen=True)
class ObjectTrack:
    """One moving object at n times: the reference times of its sweeps, and that of the key.

    The frame of the object has its origin in the middle of the box, x along the motion at the key's
    time, z along the key's.

    Attributes:
        instance: Number as in `Cloud`.
        size_m: (3,) length, width and height of the box around its points.
        frames: n sweeps, ascending.
        stamp_ns: (n,) int64.
        T_key_object: (n,4,4), ego-motion removed.
        velocity_m_s: (n,3) of the middle of the box, key frame.
        num_points: (n,) returns in the sweep.
    """

    instance: int
    size_m: Float
    frames: tuple[int, ...]
    stamp_ns: Int
    T_key_object: Float
    velocity_m_s: Float
    num_points: Int


@dataclass(frozen=True)
class Prior:
    """A depth image that the user brings, as large as its map.

    Attributes:
        value: (H,W) float32, 0 none: depth or inverse depth, relative or metric.
        sky: (H,W) bool, to be left empty.
        source: Origin, for messages.
    """

    value: Float32
    sky: Bool
    source: str


@dataclass(frozen=True)
class PriorFit:
    """The fit of a prior's values p to depth z in metres over the image, before local correction.

    Kind ``depth``: z = scale p + shift_m. ``inverse``: 1/z = scale p + shift_per_m. ``log``: ln z =
    scale ln p + shift.

    Attributes:
        residual: Mean of |ln z - ln measured| over the measured pixels, at most ln 1.25 each.
            Each octave of depth counts alike.
        wrong: Share of the measured pixels, weighted in the same way, that are off by more than
            25 %.
        used: The prior fits well enough to be used.
    """

    kind: str
    scale: float
    shift: float
    residual: float
    wrong: float
    used: bool


@dataclass(frozen=True)
class FullDepth:
    """A depth map completed with a prior.

    Attributes:
        depth_m: (H,W) float32 metres, 0 none: ``DepthMap.filled_m`` where that has a depth.
        confidence: (H,W) float32 0 to 1, lower for pixels of the prior than for all others.
        from_prior: (H,W) bool.
        source: Origin of the prior.
    """

    depth_m: Float32
    confidence: Float32
    from_prior: Bool
    fit: PriorFit
    source: str


Progress = Callable[[str, int, int], None]
"""Called as ``(stage, done, total)`` while something takes its time."""


@dataclass(frozen=True)
class StageCost:
    """The wall seconds of a stage and the peak memory of the process at its end."""

    name: str
    seconds: float
    peak_memory_mb: float


@dataclass(frozen=True)
class Result:
    """One densified key. A map's name is its camera's, or CAMERA/NUMBER with ``project.per=image``.

    Attributes:
        method: ``flow``, ``icp``, ``none`` or another one of `densify.compare`.
        key: Absolute frame number.
        frames: Sweeps of the window.
        cloud: All points at the key's time.
        depth: Depth map by name.
        metrics: Scores, plain numbers, ready for JSON.
        costs: Seconds and memory of each stage.
        baselines: Results of the simpler methods on the same registration, by method.
        flow: Flow of every sweep to the next one towards the key (``output.flow``).
        movers: Each moving object alone, by instance (``output.movers``).
        optical_flow: By name (H,W,2) pixels to the "previous" and the "next" image
            (``output.optical_flow``).
        rejected: By name (H,W) `Reason` of the rejected points (``output.rejected``).
        full: Maps completed with a prior, by name.
        images: By name (H,W,3) RGB, if there is an image.
        far_frames: Sweeps beyond the window from which the cloud has static points.
        far_left_out: Sweeps beyond the window that could not be registered.
        warnings: Assumptions and suspicions, a sentence each.
        stamp_ns: Reference time of the key.
        views: Camera and pose of each map, by name.
        truth_m: By name (H,W) true depth, 0 none, if there is truth.
        T_key_lidar: (4,4) of every sweep of the window, by frame.
        tracks: Path of each moving object.
    """

    method: str
    key: int
    frames: tuple[int, ...]
    cloud: Cloud
    depth: Mapping[str, DepthMap]
    metrics: Mapping[str, Any] = field(default_factory=dict)
    costs: tuple[StageCost, ...] = ()
    baselines: Mapping[str, Result] = field(default_factory=dict)
    flow: StretchFlow | None = None
    movers: Mapping[int, Mover] = field(default_factory=dict)
    optical_flow: Mapping[str, Mapping[str, Float32]] = field(default_factory=dict)
    rejected: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    full: Mapping[str, FullDepth] = field(default_factory=dict)
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    far_frames: tuple[int, ...] = ()
    far_left_out: tuple[int, ...] = ()
    warnings: tuple[str, ...] = ()
    stamp_ns: int = 0
    views: Mapping[str, CameraView] = field(default_factory=dict)
    truth_m: Mapping[str, Float32] = field(default_factory=dict)
    T_key_lidar: Mapping[int, Float] = field(default_factory=dict)
    tracks: tuple[ObjectTrack, ...] = ()
