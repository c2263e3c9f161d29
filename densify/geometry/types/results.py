# SPDX-License-Identifier: MIT
"""One densified key, and what it cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Float, Float32
from densify.geometry.types.depth import CameraView, Cloud, DepthMap, Mover
from densify.geometry.types.flow import StretchFlow
from densify.geometry.types.prior import FullDepth
from densify.geometry.types.tracks import ObjectTrack

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
    """One densified key.

    frames: of the window. far_frames: sweeps beyond it of which the cloud holds what stands still.
    far_left_out: sweeps beyond that could not be placed.
    depth: by name: the camera's, or CAMERA/NUMBER of each image (``project.per=image``). metrics:
    plain numbers, ready for JSON. baselines: the results of the simpler methods on the same
    registration, by method. flow: of every sweep to the next one on the way to the key, where
    asked for (``output.flow``). movers: by instance (``output.movers``). optical_flow: name ->
    (H,W,2) pixels to the "previous" and the "next" image (``output.optical_flow``). rejected: name
    -> (H,W) `Reason` of what was left out (``output.rejected``). full: of the maps that a prior was
    given for. images: name -> (H,W,3) RGB, of the maps whose image there is. warnings: what was
    assumed or looks wrong, a sentence each. stamp_ns: the key's reference time. views: from where
    each map looks. truth_m: name -> (H,W) true depth, 0 none, where there is truth. T_key_lidar:
    (4,4) of every sweep of the window, by frame. tracks: of what moves.
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
