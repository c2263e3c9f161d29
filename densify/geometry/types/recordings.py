# SPDX-License-Identifier: MIT
"""Define sweeps, as measured and registered, their scene flow, cameras, and readers' interface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Float32, Int, select_rows
from densify.geometry.poses import inverse


@dataclass(frozen=True)
class Sweep:
    """One lidar revolution of N returns.

    Attributes:
        frame: Frame number in the recording.
        stamp_ns: Reference time: begin, middle or end of the revolution, as the data set defines.
        points: (N,3) metres, lidar frame. A raw sweep has each point in the lidar frame at its own
            firing time, a deskewed sweep all points in the frame at ``stamp_ns``.
        intensity: (N,) from 0 to 1.
        offset_ns: (N,) firing time minus ``stamp_ns``; None if the data has no point times.
        lidar: (N,) index of the scanner that fired.
        row: (N,) row of the return in the source file, whose invalid rows are not read.
        scanner_origins: (S,3) metres, lidar frame, position of each of the S scanners; None if all
            are at the origin.
        R_scanner_lidar: (S,3,3) rotation from the lidar axes to the axes of each scanner, whose z
            is its spin axis, upwards; None for the identity.
        num_untimed: Number of returns dropped because their times lie outside this sweep.
        num_near: Number of returns dropped because they are nearer than register.min_range_m.
        num_lone: Number of returns dropped as snow, rain or dust.
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
        """Return a new sweep of the returns that ``keep`` selects: an (N,) mask or a slice."""
        return select_rows(self, keep, ("points", "intensity", "offset_ns", "lidar", "row"))

    def axes(self, lidar: int) -> Float:
        """Return the (3,3) rotation from lidar axes to the axes of the scanner with this index."""
        return np.eye(3) if self.R_scanner_lidar is None else self.R_scanner_lidar[lidar]

    def origin_m(self, lidar: int) -> Float:
        """Return the (3,) position in metres, lidar frame, of the scanner with index ``lidar``."""
        return np.zeros(3) if self.scanner_origins is None else self.scanner_origins[lidar]


@dataclass(frozen=True)
class Trajectory:
    """The lidar poses of n sweeps."""

    frames: tuple[int, ...]  # frame numbers, ascending
    stamp_ns: Int  # (n,) reference times
    T_world_lidar: Float  # (n,4,4) poses at the reference times
    # (3,3) rotation that makes the z axis of the lidar point up; the identity unless the lidar is
    # mounted tilted
    R_level_lidar: Float = field(default_factory=lambda: np.eye(3))

    def part(self, frames: Sequence[int], origin: int) -> Trajectory:
        """Return the poses of some frames in the levelled lidar frame of the sweep ``origin``.

        The order of ``frames`` is kept. A frame that the trajectory lacks raises ValueError.
        """
        rows = [self.frames.index(frame) for frame in frames]
        T_new_lidar = np.eye(4)
        T_new_lidar[:3, :3] = self.R_level_lidar
        T_new_old = T_new_lidar @ inverse(self.T_world_lidar[self.frames.index(origin)])
        T_new = T_new_old @ self.T_world_lidar[rows]
        return Trajectory(tuple(frames), self.stamp_ns[rows], T_new, self.R_level_lidar)


@dataclass(frozen=True)
class RegisteredSweep:
    """A sweep with its pose, usually deskewed."""

    sweep: Sweep  # sweep with points in the lidar frame at ``sweep.stamp_ns``
    T_world_lidar: Float  # (4,4) lidar pose at the reference time
    # (6,) velocity (rotation rad/s, translation m/s) of the lidar before the reference time, in the
    # lidar frame. Deskewing moves a raw point fired at offset t to ``exp(t · twist) @ p_raw``.
    twist_before: Float
    twist_after: Float  # (6,) velocity of the lidar after the reference time

    @property
    def frame(self) -> int:
        """Frame number of the sweep."""
        return self.sweep.frame

    @property
    def twist(self) -> Float:
        """(6,) velocity (rad/s, m/s) of the lidar at the reference time, in the lidar frame."""
        return 0.5 * (self.twist_before + self.twist_after)

    @staticmethod
    def without_points(trajectory: Trajectory, frame: int) -> RegisteredSweep:
        """Return the pose and time of a frame of the trajectory as a sweep without points.

        Its twists are 0. A frame that the trajectory lacks raises ValueError.
        """
        index = trajectory.frames.index(frame)
        points, intensity = np.zeros((0, 3)), np.zeros(0, np.float32)
        lidar, row = np.zeros(0, np.uint8), np.zeros(0, np.int64)
        stamp_ns = int(trajectory.stamp_ns[index])
        sweep = Sweep(frame, stamp_ns, points, intensity, None, lidar, row)
        return RegisteredSweep(sweep, trajectory.T_world_lidar[index], np.zeros(6), np.zeros(6))


@dataclass(frozen=True)
class Stretch:
    """Consecutive registered sweeps in one common world, ascending by frame number."""

    sweeps: tuple[RegisteredSweep, ...]

    @property
    def frames(self) -> tuple[int, ...]:
        """Frame numbers of the sweeps."""
        return tuple(registered.frame for registered in self.sweeps)

    def __getitem__(self, frame: int) -> RegisteredSweep:
        return self.sweeps[self.frames.index(frame)]

    def T_target_source(self, target: int, source: int) -> Float:
        """Return the (4,4) pose of the lidar of sweep ``source`` in the lidar frame of ``target``.

        Both are frame numbers of the stretch. A sweep's pose in its own frame is exactly identity.
        """
        if target == source:
            return np.eye(4)
        return inverse(self[target].T_world_lidar) @ self[source].T_world_lidar


@dataclass(frozen=True)
class FlowField:
    """Scene flow, ego-motion removed, of the N points of a sweep (or file) to a target time.

    Vectors are in the frame of the points: for a sweep its lidar frame at the reference time. The
    flow counts from that reference time. A moving point measured earlier or later first moves by
    ``to_reference``.

    Attributes:
        displacement: (N,3) metres from the reference time to the target time; exactly 0 if static.
        moving: (N,) True if the point is confirmed to move.
        instance: (N,) number of the moving object, -1 for none.
        lost: (N,) True if the point's object cannot be followed to the target time.
        to_reference: (N,3) metres that the object itself moves between the point's firing and the
            reference time; None if unknown.
        velocity_m_s: (N,3) velocity at the target time; None if unknown.
    """

    displacement: Float
    moving: Bool
    instance: NDArray[np.int32]
    lost: Bool
    to_reference: Float | None = None
    velocity_m_s: Float | None = None

    @property
    def total(self) -> Float:
        """(N,3) metres from the measured position to the position at the target time.

        It is the ``displacement`` alone if ``to_reference`` is None.
        """
        if self.to_reference is None:
            return self.displacement
        return self.to_reference + self.displacement

    @staticmethod
    def zero(num_points: int) -> FlowField:
        """Return the flow of N points that are all static: no displacement, no object, not lost."""
        displacement = np.zeros((num_points, 3))
        instance = np.full(num_points, -1, np.int32)
        moving, lost = np.zeros((2, num_points), bool)
        return FlowField(displacement, moving, instance, lost)


class Motion(Protocol):
    """The motion of all points of a stretch, found by any engine (scene-flow method)."""

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of the points of sweep ``frame`` to the reference time of ``target``."""


@dataclass(frozen=True)
class StretchFlow:
    """Scene flow between neighbouring sweeps of a stretch."""

    stretch: Stretch
    # (frame, target frame) -> flow of the points of the first sweep
    steps: Mapping[tuple[int, int], FlowField]

    @staticmethod
    def towards(key: int, stretch: Stretch, motion: Motion) -> StretchFlow:
        """Return the flow of each sweep of a stretch to the next sweep towards the key sweep.

        The key sweep has its flow to the next sweep, or to the previous one if it is the last. A
        stretch of a single sweep has no steps. ``key`` is the frame number of the key sweep.
        """
        up_to_key = [frame for frame in stretch.frames if frame <= key]
        down_to_key = [frame for frame in reversed(stretch.frames) if frame >= key]
        hops = [*pairwise(up_to_key), *pairwise(down_to_key)]
        if len(stretch.frames) > 1:
            neighbour = down_to_key[-2] if len(down_to_key) > 1 else up_to_key[-2]
            hops.append((key, neighbour))
        return StretchFlow(stretch, {hop: motion.flow(*hop) for hop in hops})


@dataclass(frozen=True)
class Camera:
    """Intrinsics, lens and mounting pose of a camera.

    Attributes:
        name: Name of the camera in the recording.
        width_px: Width of the image.
        height_px: Height of the image.
        K: (3,3) intrinsics in pixels; an integer coordinate is the centre of a pixel.
        T_cam_lidar: (4,4) pose of the lidar frame in the camera frame.
        distortion: Coefficients of the lens. A pinhole has k1 k2 p1 p2 k3 ... as in OpenCV, none
            if its images are rectified. A fisheye has k1 k2 k3 k4, a mei lens xi k1 k2 p1 p2.
        model: ``pinhole``, ``fisheye`` (Kannala-Brandt) or ``mei``.
        max_angle_deg: Greatest angle off the optical axis that the lens sees, in degrees.
        row_time_s: Rolling shutter: seconds from the exposure of a row to the exposure of the row
            below. It is negative if the image is read from the bottom, and 0 for a global shutter.
            The stamp of an image is the exposure of its middle.
        column_time_s: Seconds from the exposure of a column to that of the next one on the right.
    """

    name: str
    width_px: int
    height_px: int
    K: Float
    T_cam_lidar: Float
    distortion: tuple[float, ...] = ()
    model: str = "pinhole"
    max_angle_deg: float = 180.0
    row_time_s: float = 0.0
    column_time_s: float = 0.0

    @property
    def is_rolling(self) -> bool:
        """True if rows or columns are exposed one after another."""
        return bool(self.row_time_s or self.column_time_s)

    @property
    def readout_s(self) -> float:
        """Approximate seconds from the first exposure of a row or column to the last."""
        along = abs(self.row_time_s) * self.height_px
        return along + abs(self.column_time_s) * self.width_px

    @property
    def is_rectified(self) -> bool:
        """True for a pinhole without distortion coefficients."""
        return self.model == "pinhole" and not self.distortion

    @property
    def measure(self) -> str:
        """The default measure of depth: ``z``, or ``range`` for lenses that may see z < 0."""
        return "z" if self.model == "pinhole" else "range"

    @property
    def focal_px(self) -> float:
        """Focal length: pixels along u for each radian off the axis, at the principal point."""
        xi = self.distortion[0] if self.model == "mei" else 0.0
        return float(self.K[0, 0] / (1 + xi))


class LidarSequence(Protocol):
    """A recording, opened lazily. A reader is one class with these members.

    Frames are the data set's own sweep numbers. Methods raise InputError for anything missing or
    malformed. A reader may also have these methods, which are looked up by name:

    - findings() -> Sequence[tuple[str, str]]: short labels and texts of findings and assumptions.
    - gaps() -> Sequence[str]: a sentence for each missing part and its replacement.
    - prepare(frames, images=()): render these sweeps and images (camera, number) in parallel.
    - T_world_cam(camera, number) -> (4,4): camera pose at an image's exposure in the lidar's world.
    - boxes(frame) -> Boxes | None: annotated boxes of a sweep; None if it is not annotated.
    - sweep_bytes() -> Mapping[int, int]: file size of each sweep by frame; empty for shared files.
    - num_rows(frame) -> int: number of rows of the sweep's file, valid and invalid.
    """

    @property
    def name(self) -> str:
        """Name of the recording in messages and outputs."""

    @property
    def frames(self) -> Sequence[int]:
        """Frame numbers of the existing sweeps, ascending."""

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""

    @property
    def truth(self) -> Truth | None:
        """Ground truth of a simulation, None for a real recording."""

    def __getitem__(self, frame: int) -> Sweep: ...

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep in nanoseconds, without reading its points."""

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return image number -> exposure time (ns) of a camera's middle row, both ascending."""

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return the (H,W,3) RGB image with this number of the named camera."""

    def T_world_lidar(self, frame: int) -> Float:
        """Return the data set's own (4,4) lidar pose at the sweep's reference time.

        The world is the data set's. InputError is raised if the data set has no poses.
        """


def in_one_line(sequence: LidarSequence) -> str:
    """Return a line with the name, sweeps and cameras of a recording, for its ``repr``."""
    frames = sequence.frames
    cameras = ", ".join(sequence.cameras) or "none"
    span = f" from {frames[0]} to {frames[-1]}" if len(frames) else ""
    sweeps = "sweep" if len(frames) == 1 else "sweeps"
    return f"<{sequence.name}: {len(frames)} {sweeps}{span}; cameras: {cameras}>"


@dataclass(frozen=True)
class BoxView:
    """The camera image in which an annotator drew the boxes."""

    camera: Camera
    # (R,4) left, top, right, bottom, pixels, of R image rectangles that are not annotated
    left_out_px: Float


@dataclass(frozen=True)
class Boxes:
    """The K annotated boxes of one sweep."""

    # (K,) text identifying the object in all sweeps; empty for an untracked object
    track: NDArray[Any]
    # (K,4,4) pose of each box in the lidar frame at the reference time, for points compensated for
    # ego-motion. The box frame is in the middle of the box, x to the front, z up.
    T_lidar_box: Float
    size_m: Float  # (K,3) length, width, height in metres
    # (K,) ns since the reference time at which the lidar frame of ``T_lidar_box`` is taken. None
    # means 0 for all boxes.
    offset_ns: Int | None = None
    # (K,) index of the scanner whose points a box encloses, -1 for all scanners; None if every box
    # encloses the points of all scanners
    lidar: Int | None = None
    # Image in which the boxes were drawn; None for boxes all around the vehicle
    view: BoxView | None = None


@dataclass(frozen=True)
class SweepTruth:
    """The ground truth of the N points of a raw sweep, in the same order."""

    T_world_lidar: Float  # (4,4) lidar pose at the reference time
    points: Float  # (N,3) metres, positions at the reference time, lidar frame at that time
    instance: NDArray[np.int32]  # (N,) number of the object, -1 for the static scene
    moving: Bool  # (N,) True if the object moves at the reference time


class Truth(Protocol):
    """Exact ground truth of a simulated sequence.

    Arrays by point have a row for each row of the stored sweep: `Sweep.row` selects from them.
    """

    def sweep(self, frame: int) -> SweepTruth:
        """Return the ground truth of the sweep with this frame number."""

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) true scene flow in metres of a sweep's points to another sweep's time.

        Sweep ``target`` gives the target time. The flow is in the lidar frame of sweep ``frame``,
        ego-motion removed, and 0 for static points.
        """

    def depth_m(self, camera: str, number: int) -> Float32:
        """Return the (H,W) true depth in metres of the image with this number of the named camera.

        It is at the exposure of each row, in the camera's own measure (`Camera.measure`). It is 0
        where the ray meets no surface.
        """

    def moving_mask(self, camera: str, number: int) -> Bool:
        """Return an (H,W) mask of the image ``number`` of a camera, True at moving objects."""
