# SPDX-License-Identifier: MIT
"""Define the result of a key: depth maps, tracks, costs, and maps completed with a prior."""

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
    """Poses of one moving object at n reference times, of the sweeps it is seen in and of the key.

    The origin of the object frame is the middle of the box. Its x axis is along the motion at the
    key's time, and its z axis is parallel to the z axis of the key frame.
    """

    instance: int  # number of the object, as in `Cloud`
    # (3,) length, width and height of the box. It stands on the ground, and is completed to the
    # usual size of a vehicle where no ray passed.
    size_m: Float
    frames: tuple[int, ...]  # frame numbers of the n sweeps, ascending
    stamp_ns: Int  # (n,) reference times
    T_key_object: Float  # (n,4,4) poses in the key frame, ego-motion removed
    velocity_m_s: Float  # (n,3) velocity of the middle of the box, key frame, ego-motion removed
    num_points: Int  # (n,) number of points of the object in each sweep
    seen_size_m: Float  # (3,) size of the box around its points
    # Sides of the box that were seen: of front, rear, left, right and top
    sides_seen: tuple[str, ...] = ()


@dataclass(frozen=True)
class Prior:
    """A depth image supplied by the user, for example from a network, that completes a depth map.

    It has the size of the map.
    """

    value: Float32  # (H,W) depth or inverse depth, relative or metric; 0 for no value
    sky: Bool  # (H,W) True for pixels that stay without depth
    source: str  # file of the image, for messages


@dataclass(frozen=True)
class PriorFit:
    """The fit of a prior's values p to the measured depth z (metres) of a map.

    It is one fit for the whole image, before local correction. Kind ``depth``: z = scale p + shift
    (m). ``inverse``: 1/z = scale p + shift (1/m). ``log``: ln z = scale ln p + shift.
    """

    kind: str  # ``depth``, ``inverse`` or ``log``
    scale: float
    shift: float  # offset of the fit, in the unit above
    # Mean of |ln z - ln measured| over the measured pixels, each limited to ln 1.25. Pixels are
    # weighted for each octave of depth to count alike.
    residual: float
    wrong: float  # share of the measured pixels off by more than 25 %, with the same weights
    used: bool  # true if the prior fits well enough to be used


@dataclass(frozen=True)
class FullDepth:
    """A depth map completed with a prior."""

    # (H,W) metres, 0 for none. Pixels with a depth in ``DepthMap.filled_m`` keep it.
    depth_m: Float32
    confidence: Float32  # (H,W) of 0 to 1; pixels of the prior are below all others
    from_prior: Bool  # (H,W) True for pixels whose depth is from the prior
    fit: PriorFit  # fit of the prior to the map
    source: str  # file of the prior


Progress = Callable[[str, int, int], None]
"""Callback ``(stage, done, total)``: name of the stage, finished and total number of steps."""


@dataclass(frozen=True)
class StageCost:
    """The wall time of a pipeline stage and the peak memory of the process at its end."""

    name: str
    seconds: float
    peak_memory_mb: float


@dataclass(frozen=True)
class Result:
    """The result of one method for one key.

    A map's name is its camera's name, or CAMERA/NUMBER with ``project.per=image``.

    Attributes:
        method: ``flow``, ``icp``, ``none`` or another method of `densify.compare`.
        key: Frame number of the key sweep.
        frames: Frame numbers of the sweeps used.
        cloud: Accumulated points at the key's time.
        depth: Map name -> depth map.
        metrics: Scores as plain numbers, ready for JSON.
        costs: Wall time and memory of each stage.
        baselines: Method -> result of a simpler method on the same registration.
        flow: Scene flow of every sweep to the next sweep towards the key (``output.flow``).
        movers: Instance -> points and maps of one moving object (``output.movers``).
        optical_flow: Map name -> "previous" and "next" -> (H,W,2) pixels to that image
            (``output.optical_flow``).
        rejected: Map name -> (H,W) `Reason` of the rejected points (``output.rejected``).
        full: Map name -> map completed with a prior.
        images: Map name -> (H,W,3) RGB, for maps that show an image.
        far_frames: Frame numbers of sweeps beyond the window that contribute static points.
        far_left_out: Frame numbers of sweeps beyond the window that could not be registered.
        warnings: Sentences about assumptions and suspected errors.
        stamp_ns: Reference time of the key.
        views: Map name -> camera and pose.
        truth_m: Map name -> (H,W) ground-truth depth in metres, 0 for none; empty without ground
            truth.
        T_key_lidar: Frame number -> (4,4) lidar pose of that sweep of the window in the key frame.
        tracks: Poses of each moving object.
        recording: Name of the recording.
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
    recording: str = ""

    def __repr__(self) -> str:
        maps = ", ".join(
            f"{name} {np.count_nonzero(depth.depth_m) / depth.depth_m.size:.1%}"
            for name, depth in self.depth.items()
        )
        return (
            f"Result({self.method}, key {self.key} of {len(self.frames)} sweeps; "
            f"{len(self.cloud.points):,} points; measured depth: {maps or 'no camera'}; "
            f"{len(self.tracks)} moving objects)"
        )
