# SPDX-License-Identifier: MIT
"""Define sweeps as measured and registered, and their scene flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.poses import inverse


@dataclass(frozen=True)
class Sweep:
    """One lidar revolution of N returns.

    Attributes:
        frame: Absolute number.
        stamp_ns: The reference time, as the data set stamps its sweeps: begin, middle or end.
        points: (N,3) metres, lidar frame. As read, each at its own firing time; after deskewing,
            all at ``stamp_ns``.
        intensity: (N,) float32, 0 to 1.
        offset_ns: (N,) int64, firing time minus ``stamp_ns``; None where the data cannot tell.
        lidar: (N,) uint8 number of the scanner that fired.
        row: (N,) int64 row of the return in the source file. Invalid rows are dropped on reading.
        scanner_origins: (S,3) metres, lidar frame, start of the rays of each scanner; None where
            all start at the frame's origin.
        R_scanner_lidar: (S,3,3) turns the lidar frame's axes into each scanner's, z along the one
            it spins about, upwards; None where they are the frame's.
        num_untimed: Number of returns left out because their times cannot be of this sweep.
        num_near: Number of returns left out because they are nearer than register.min_range_m.
        num_lone: Number of returns left out as snow, rain or dust.
    """

    frame: int
    stamp_ns: int
    points: Float
    intensity: Float32
    offset_ns: Int | None
    lidar: NDArray[np.uint8]
    row: Int
    scanner_origins: Float | None = None
    R_scanner_lidar: Float | None = None
    num_untimed: int = 0
    num_near: int = 0
    num_lone: int = 0

    def __post_init__(self) -> None:
        n = len(self.points)
        for name in ("intensity", "offset_ns", "lidar", "row"):
            column = getattr(self, name)
            if column is not None and column.shape != (n,):
                raise ValueError(f"Sweep.{name}: expected ({n},), got {column.shape}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: Bool | slice) -> Sweep:
        """Return the returns where ``keep`` (N,) is True, or of a slice."""
        rows = np.arange(len(self))[keep]
        return replace(
            self,
            points=self.points.take(rows, axis=0),
            intensity=self.intensity[rows],
            offset_ns=None if self.offset_ns is None else self.offset_ns[rows],
            lidar=self.lidar[rows],
            row=self.row[rows],
        )

    def axes(self, lidar: int) -> Float:
        """Return the rotation (3,3) from the axes of the lidar frame to those of the scanner."""
        return np.eye(3) if self.R_scanner_lidar is None else self.R_scanner_lidar[lidar]

    def origin_m(self, lidar: int) -> Float:
        """Return (3,) the origin of the scanner's rays, lidar frame."""
        return np.zeros(3) if self.scanner_origins is None else self.scanner_origins[lidar]


@dataclass(frozen=True)
class Trajectory:
    """The poses of a lidar.

    Attributes:
        frames: Ascending.
        stamp_ns: (n,) int64.
        T_world_lidar: (n,4,4).
        R_level_lidar: (3,3) turns the axes of the lidar until z is up. It is the identity
            unless the lidar leans.
    """

    frames: tuple[int, ...]
    stamp_ns: Int
    T_world_lidar: Float
    R_level_lidar: Float = field(default_factory=lambda: np.eye(3))

    def part(self, frames: Sequence[int], origin: int) -> Trajectory:
        """Return the poses of these frames, in the upright world of the frame ``origin``."""
        rows = [self.frames.index(f) for f in frames]
        T_new_lidar = np.eye(4)
        T_new_lidar[:3, :3] = self.R_level_lidar
        T_new_old = T_new_lidar @ inverse(self.T_world_lidar[self.frames.index(origin)])
        return replace(
            self,
            frames=tuple(frames),
            stamp_ns=self.stamp_ns[rows],
            T_world_lidar=T_new_old @ self.T_world_lidar[rows],
        )


@dataclass(frozen=True)
class RegisteredSweep:
    """A deskewed sweep with its pose.

    Attributes:
        sweep: Points in the lidar frame at ``sweep.stamp_ns``.
        T_world_lidar: (4,4).
        twist_before: (6,) rotation vector and translation per second (rad/s, m/s) of the lidar
            before its reference time, in the lidar frame. A raw point fired at offset t is at
            ``exp(t · twist) @ p_raw``.
        twist_after: The same after its reference time.
    """

    sweep: Sweep
    T_world_lidar: Float
    twist_before: Float
    twist_after: Float

    @property
    def frame(self) -> int:
        """The frame of the sweep."""
        return self.sweep.frame

    @property
    def twist(self) -> Float:
        """(6,) rotation vector and translation per second at the reference time."""
        return 0.5 * (self.twist_before + self.twist_after)

    @staticmethod
    def without_points(trajectory: Trajectory, frame: int) -> RegisteredSweep:
        """Return the pose and time of a sweep of the trajectory, without points."""
        i, nothing = trajectory.frames.index(frame), np.zeros(0)
        sweep = Sweep(
            frame=frame,
            stamp_ns=int(trajectory.stamp_ns[i]),
            points=np.zeros((0, 3)),
            intensity=nothing.astype(np.float32),
            offset_ns=None,
            lidar=nothing.astype(np.uint8),
            row=nothing.astype(np.int64),
        )
        return RegisteredSweep(sweep, trajectory.T_world_lidar[i], np.zeros(6), np.zeros(6))


@dataclass(frozen=True)
class Stretch:
    """Registered sweeps of a drive in one world, by ascending frame."""

    sweeps: tuple[RegisteredSweep, ...]

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames of the sweeps."""
        return tuple(s.frame for s in self.sweeps)

    def __getitem__(self, frame: int) -> RegisteredSweep:
        return self.sweeps[self.frames.index(frame)]

    def T_target_source(self, target: int, source: int) -> Float:
        """Return (4,4) from the lidar frame of one sweep to that of another, by frame number."""
        if target == source:
            return np.eye(4)
        return inverse(self[target].T_world_lidar) @ self[source].T_world_lidar


@dataclass(frozen=True)
class FlowField:
    """Scene flow of a sweep's (or point file's) N points to another time, ego-motion removed.

    The flow counts from the sweep's reference time. A moving point that was measured earlier or
    later is first brought there by ``to_reference``.

    Attributes:
        displacement: (N,3) metres, in the coordinates of the points; exactly 0 where not moving.
        moving: (N,) bool, confirmed to move.
        instance: (N,) int32 number of the moving object, -1 none.
        lost: (N,) bool, belongs to a moving object that cannot be followed to the target time.
        to_reference: (N,3) metres, own motion between a point's firing and the sweep's reference
            time, in the same coordinates; None where nothing is known of it.
        velocity_m_s: (N,3) at the target time, in the same coordinates; None where nothing is
            known.
    """

    displacement: Float
    moving: Bool
    instance: NDArray[np.int32]
    lost: Bool
    to_reference: Float | None = None
    velocity_m_s: Float | None = None

    @property
    def total(self) -> Float:
        """Return (N,3) metres from the measured position to the one at the target time."""
        if self.to_reference is None:
            return self.displacement
        return self.to_reference + self.displacement

    @staticmethod
    def zero(num_points: int) -> FlowField:
        """Return the flow of static points."""
        return FlowField(
            displacement=np.zeros((num_points, 3)),
            moving=np.zeros(num_points, bool),
            instance=np.full(num_points, -1, np.int32),
            lost=np.zeros(num_points, bool),
        )


class Motion(Protocol):
    """The motion of all points of a stretch, found by any engine."""

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of every point of a sweep to another sweep's reference time."""
        ...


@dataclass(frozen=True)
class StretchFlow:
    """Flow between neighbouring sweeps of a stretch, by (frame, target frame)."""

    stretch: Stretch
    steps: Mapping[tuple[int, int], FlowField]

    @staticmethod
    def towards(key: int, stretch: Stretch, motion: Motion) -> StretchFlow:
        """Return the flow of each sweep to the next one towards the key.

        The key has the flow to a neighbour.
        """
        before = [f for f in stretch.frames if f <= key]
        after = [f for f in reversed(stretch.frames) if f >= key]
        hops = [*pairwise(before), *pairwise(after)]
        if len(stretch.frames) > 1:
            hops.append((key, after[-2] if len(after) > 1 else before[-2]))
        return StretchFlow(stretch, {hop: motion.flow(*hop) for hop in hops})
