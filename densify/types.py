# SPDX-License-Identifier: MIT
"""What the stages hand to each other. All are frozen; columns stay aligned row by row.

Poses are named ``T_target_source``: ``p_target = T_target_source @ p_source``. Frames of reference:
``world`` (the first sweep's lidar), ``lidar`` (at the sweep's reference time), ``key`` (the key
sweep's lidar), ``cam``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from densify import poses

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Sweep:
    """One lidar revolution of N returns.

    points: (N,3) metres, lidar frame; as read, each at its own firing time, and after deskewing all
        at ``stamp_ns``.
    stamp_ns: the reference time, the middle of the revolution.
    intensity: (N,) float32, 0 to 1.
    offset_ns: (N,) int64, firing time minus ``stamp_ns``; None where the data cannot tell.
    lidar: (N,) uint8, which of several scanners in one sweep fired.
    row: (N,) int64, row of the return in the source file (invalid rows are dropped on reading).
    scanner_origins: (S,3) metres, lidar frame, where the rays of each scanner start; None where all
        start at the frame's origin.
    """

    frame: int
    stamp_ns: int
    points: Float
    intensity: Float32
    offset_ns: Int | None
    lidar: NDArray[np.uint8]
    row: Int
    scanner_origins: Float | None = None

    def __post_init__(self) -> None:
        n = len(self.points)
        for name in ("intensity", "offset_ns", "lidar", "row"):
            column = getattr(self, name)
            if column is not None and column.shape != (n,):
                raise ValueError(f"Sweep.{name}: expected ({n},), got {column.shape}")
        if self.scanner_origins is not None:
            num_scanners = int(self.lidar.max(initial=0)) + 1
            shape = self.scanner_origins.shape
            if len(shape) != 2 or shape[1] != 3 or shape[0] < num_scanners:
                raise ValueError(
                    f"Sweep.scanner_origins: expected a row (3,) for each of {num_scanners} "
                    f"scanners, got {shape}"
                )

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: Bool) -> Sweep:
        """The returns where ``keep`` (N,) is True."""
        return replace(
            self,
            points=self.points[keep],
            intensity=self.intensity[keep],
            offset_ns=None if self.offset_ns is None else self.offset_ns[keep],
            lidar=self.lidar[keep],
            row=self.row[keep],
        )

    def origin_m(self, lidar: int) -> Float:
        """(3,) where the rays of that scanner start, lidar frame."""
        return np.zeros(3) if self.scanner_origins is None else self.scanner_origins[lidar]


@dataclass(frozen=True)
class Trajectory:
    """Where the lidar was: frames ascending, stamp_ns (n,) int64, T_world_lidar (n,4,4)."""

    frames: tuple[int, ...]
    stamp_ns: Int
    T_world_lidar: Float


@dataclass(frozen=True)
class RegisteredSweep:
    """A deskewed sweep with its place in the world.

    sweep: points in the lidar frame at ``sweep.stamp_ns``.
    T_world_lidar: (4,4).
    twist_before, twist_after: (6,) rotation vector and translation per second (rad/s, m/s) of the
        lidar before and after its reference time, in the lidar frame: a raw point fired at offset t
        lies at ``exp(t · twist) @ p_raw``.
    """

    sweep: Sweep
    T_world_lidar: Float
    twist_before: Float
    twist_after: Float

    @property
    def frame(self) -> int:
        return self.sweep.frame


@dataclass(frozen=True)
class Stretch:
    """Registered sweeps of a drive in one world, by ascending frame."""

    sweeps: tuple[RegisteredSweep, ...]

    @property
    def frames(self) -> tuple[int, ...]:
        return tuple(s.frame for s in self.sweeps)

    def __getitem__(self, frame: int) -> RegisteredSweep:
        return self.sweeps[self.frames.index(frame)]

    def T_target_source(self, target: int, source: int) -> Float:
        """(4,4) from the lidar frame of one sweep to that of another, by frame number."""
        if target == source:
            return np.eye(4)
        return poses.inverse(self[target].T_world_lidar) @ self[source].T_world_lidar


@dataclass(frozen=True)
class FlowField:
    """Scene flow of one sweep's (or point file's) N points to another time, ego-motion removed.

    From the sweep's reference time: a moving point that was measured earlier or later is first
    brought there by ``to_reference``.

    displacement: (N,3) metres, in the coordinates the points are in; exactly 0 where not moving.
    moving: (N,) bool, proven to move.
    instance: (N,) int32, the moving object the point belongs to, -1 none.
    lost: (N,) bool, belongs to something that moves but cannot be followed to the target time.
    to_reference: (N,3) metres, own motion between a point's firing and the sweep's reference time,
        in the same coordinates; None where nothing is known of it.
    velocity_m_s: (N,3) at the target time, in the same coordinates; None where nothing is known.
    """

    displacement: Float
    moving: Bool
    instance: NDArray[np.int32]
    lost: Bool
    to_reference: Float | None = None
    velocity_m_s: Float | None = None

    @property
    def total(self) -> Float:
        """(N,3) from where a point was measured to where it is at the target time."""
        if self.to_reference is None:
            return self.displacement
        return self.to_reference + self.displacement

    @staticmethod
    def zero(num_points: int) -> FlowField:
        """Nothing moves."""
        return FlowField(
            displacement=np.zeros((num_points, 3)),
            moving=np.zeros(num_points, bool),
            instance=np.full(num_points, -1, np.int32),
            lost=np.zeros(num_points, bool),
        )


class Motion(Protocol):
    """How everything in a stretch moves, whatever found it out."""

    def flow(self, frame: int, target: int) -> FlowField:
        """Of every point of a sweep to another sweep's reference time; both by frame number."""
        ...


@dataclass(frozen=True)
class StretchFlow:
    """Flow between neighbouring sweeps of a stretch, by (frame, target frame)."""

    stretch: Stretch
    steps: Mapping[tuple[int, int], FlowField]


@dataclass(frozen=True)
class Cloud:
    """M accumulated points at the key's moment.

    points: (M,3) metres, key frame.
    rigid_points: (M,3) where registration alone puts them.
    frame: (M,) int32 source sweep. row: (M,) int64 in the source sweep's file.
    moving: (M,) bool. instance: (M,) int32, -1 none. velocity_m_s: (M,3) float32 at the key's
    moment, ego-motion removed, 0 where nothing moves. confidence: (M,) float32, 0 to 1.
    intensity: (M,) float32. rgb: (M,3) uint8, black where no camera saw the point.
    """

    points: Float
    rigid_points: Float
    frame: NDArray[np.int32]
    row: Int
    moving: Bool
    instance: NDArray[np.int32]
    velocity_m_s: Float32
    confidence: Float32
    intensity: Float32
    rgb: NDArray[np.uint8]

    @property
    def displaced(self) -> Float32:
        """(M,) metres moved beyond the rigid alignment."""
        return np.linalg.norm(self.points - self.rigid_points, axis=1).astype(np.float32)

    def after(self, seconds: float) -> Cloud:
        """Shortly after (or before) the key's moment: what moves goes on at its velocity."""
        return replace(self, points=self.points + seconds * self.velocity_m_s)

    def select(self, keep: Bool) -> Cloud:
        """The points where ``keep`` (M,) is True."""
        return Cloud(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Patches:
    """What each of a cloud's M points stands for; see `densify.stages.patches`.

    normal: (M,3) float32 key frame, of any length, of the tangent plane. spacing_m: (M,2) float32
    to the neighbouring rays of the same sweep, across and along elevation. free: (M,) bool, the key
    sweep saw through the place. sweep: (M,) int32, which of the cloud's sweeps, counted by frame.
    """

    normal: Float32
    spacing_m: Float32
    free: Bool
    sweep: NDArray[np.int32]


class Reason(IntEnum):
    """Why a point is not in a depth map; the first that applies."""

    KEPT = 0  # its pixel's depth is from it
    VETOED = 1  # the key sweep saw through its place
    OUTSIDE = 2  # not in the image
    HIDDEN = 3  # behind another point's patch
    NOT_CHOSEN = 4  # its pixel's depth is from a point nearer in time to the key, or nearer
    UNSUPPORTED = 5  # too few sweeps agree with it, or not the one nearest to the key
    EDGE = 6  # so close to a depth edge that its pixel may lie beyond it


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, rectified or with lens distortion.

    width_px, height_px: image size. K: (3,3) pixels; pixel (u,v) is an integer at its centre.
    T_cam_lidar: (4,4). distortion: OpenCV's coefficients (k1 k2 p1 p2 k3 …), empty if rectified.
    """

    name: str
    width_px: int
    height_px: int
    K: Float
    T_cam_lidar: Float
    distortion: tuple[float, ...] = ()


@dataclass(frozen=True)
class DepthMap:
    """Dense depth of one camera; (H,W) everywhere.

    depth_m: float32 camera z of measured pixels, 0 none. filled_m: the same plus pixels
    interpolated between measured ones. confidence: float32 0 to 1, of every pixel in ``filled_m``.
    frame: int32 source sweep of measured pixels, -1 elsewhere. age_s: float32 seconds between the
    moment the map shows and the reference time of the sweep that measured the pixel, of every pixel
    in ``filled_m``, nan elsewhere; None until `densify.stages.age` has worked it out. reason: (M,)
    uint8, a `Reason` for each point of the cloud; empty if the cloud is not at hand.
    """

    camera: str
    depth_m: Float32
    filled_m: Float32
    confidence: Float32
    frame: NDArray[np.int32]
    reason: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    age_s: Float32 | None = None

    def counts(self) -> dict[str, int]:
        """Points of the cloud by what became of them."""
        counts = np.bincount(self.reason, minlength=len(Reason))
        return {which.name.lower(): int(counts[which]) for which in Reason}


@dataclass(frozen=True)
class Mover:
    """One moving object by itself: its points, and the depth it has in each camera."""

    cloud: Cloud
    depth: Mapping[str, DepthMap]


@dataclass(frozen=True)
class SweepTruth:
    """What really was where, for the N points of a raw sweep, row by row.

    T_world_lidar: (4,4) at the reference time. points: (N,3) lidar frame at the reference time.
    instance: (N,) int32, -1 the static world. moving: (N,) bool, moves at that time.
    """

    T_world_lidar: Float
    points: Float
    instance: NDArray[np.int32]
    moving: Bool


Progress = Callable[[str, int, int], None]
"""Called as ``(stage, done, total)`` while something takes its time."""


class Truth(Protocol):
    """Exact truth of a simulated sequence."""

    def sweep(self, frame: int) -> SweepTruth: ...

    def displacement(self, frame: int, target: int) -> Float:
        """(N,3) scene flow from the reference time of ``frame`` to that of ``target``, in the
        lidar frame of ``frame``, ego-motion removed."""
        ...

    def depth_m(self, camera: str, frame: int) -> Float32:
        """(H,W) camera z of the nearest solid surface at the camera's own time, 0 none."""
        ...

    def moving_mask(self, camera: str, frame: int) -> Bool:
        """(H,W), True where the pixel shows something that moves."""
        ...


class LidarSequence(Protocol):
    """A recording, opened lazily. A reader for a data set is one class with these members.

    Frames are absolute numbers. Methods raise InputError with a full sentence for anything missing
    or malformed.
    """

    @property
    def name(self) -> str: ...

    @property
    def frames(self) -> Sequence[int]:
        """Of the sweeps that exist, ascending."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]: ...

    @property
    def truth(self) -> Truth | None: ...

    def __getitem__(self, frame: int) -> Sweep: ...

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """(H,W,3) RGB."""
        ...

    def image_stamp_ns(self, camera: str, frame: int) -> int: ...

    def T_world_lidar(self, frame: int) -> Float:
        """(4,4) the data set's own pose at the sweep's reference time."""
        ...


@dataclass(frozen=True)
class StageCost:
    """Wall seconds of a stage and the process's peak memory at its end."""

    name: str
    seconds: float
    peak_memory_mb: float


@dataclass(frozen=True)
class Result:
    """One densified key.

    metrics: plain numbers, ready for JSON. baselines: the results of the simpler methods on the
    same registration, by method. flow: of every sweep to the next one on the way to the key, where
    asked for (``output.flow``). movers: by instance (``output.movers``). optical_flow: camera ->
    (H,W,2) pixels to the "previous" and the "next" image (``output.optical_flow``). rejected:
    camera -> (H,W) `Reason` of what was left out (``output.rejected``).
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
