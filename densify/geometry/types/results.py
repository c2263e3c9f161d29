# SPDX-License-Identifier: MIT
"""One densified key: its maps, tracks and costs, and its maps completed with a prior."""

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
    """One moving object at n moments: the reference times of the sweeps that saw it, and of the
    key.

    instance: as in `Cloud`. size_m: (3,) length, width and height of the box around
    its points, in its own frame: x to where it moves at the key's moment, z along the key's, origin
    in the box's middle. frames: n sweeps, ascending. stamp_ns: (n,). T_key_object: (n,4,4), with
    the vehicle's own motion removed: the key's coordinates do not move. velocity_m_s: (n,3) of the
    box's middle, key frame. num_points: (n,) returns of that sweep.
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
    """A depth image that the user brings, as large as the map it is for.

    value: (H,W) float32, 0 none: depth or inverse depth, relative or metric. sky: (H,W) bool, to be
    left empty. source: where it is from, for messages.
    """

    value: Float32
    sky: Bool
    source: str


@dataclass(frozen=True)
class PriorFit:
    """How a prior's values p become depth z in metres over the whole image, before the local
    correction: kind ``depth``, z = scale p + shift_m; ``inverse``, 1/z = scale p + shift_per_m;
    ``log``, ln z = scale ln p + shift.

    residual: mean of |ln z - ln measured| over the measured pixels, held to ln 1.25, each octave of
    depth counted alike. wrong: share of them, in the same way, that are off by more than 25 %.
    used: whether the prior fits well enough to be used.
    """

    kind: str
    scale: float
    shift: float
    residual: float
    wrong: float
    used: bool


@dataclass(frozen=True)
class FullDepth:
    """A depth map completed with a prior; (H,W) each.

    depth_m: float32 metres, 0 none: ``DepthMap.filled_m`` where that has a depth. confidence:
    float32 0 to 1, of the prior's pixels less than of all others. from_prior: bool, the prior's.
    source: where the prior is from.
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
    """Wall seconds of a stage and the process's peak memory at its end."""

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
        rejected: By name (H,W) `Reason` of the points that were left out (``output.rejected``).
        full: Maps completed with a prior, by name.
        images: By name (H,W,3) RGB, where there is an image.
        far_frames: Sweeps beyond the window from which the cloud has static points.
        far_left_out: Sweeps beyond the window that could not be registered.
        warnings: What was assumed or looks wrong, a sentence each.
        stamp_ns: The key's reference time.
        views: Camera and pose of each map, by name.
        truth_m: By name (H,W) true depth, 0 none, where there is truth.
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
