# SPDX-License-Identifier: MIT
"""Define accumulated clouds, depth maps, and the result of a key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.arrays import Bool, Float, Float32, Int, joined_rows, select_rows, table
from densify.geometry.poses import inverse
from densify.geometry.types.recordings import Camera, StretchFlow


@dataclass(frozen=True)
class Cloud:
    """M accumulated points at the reference time of the key sweep.

    Attributes:
        points: (M,3) metres, key frame, displaced by scene flow.
        rigid_points: (M,3) metres, key frame, by registration only, as in rigid accumulation.
        frame: (M,) frame number of the source sweep.
        since_key_ns: (M,) ns, source sweep's reference time minus key sweep's reference time.
        row: (M,) index of the point's row in the file of the source sweep.
        lidar: (M,) index of the scanner that measured the point.
        moving: (M,) True if the point belongs to a moving object.
        instance: (M,) number of the moving object, -1 for none.
        velocity_m_s: (M,3) at the key's time, key frame, ego-motion removed; 0 if static.
        confidence: (M,) from 0 to 1: the confidence of pixels that confirm the point, 0 if none
            does. Methods without visibility take 1 / (1 + seconds from the key sweep).
        intensity: (M,) from 0 to 1.
        rgb: (M,3) colour from 0 to 255, black for points that no camera observed.
        far: (M,) True if the source sweep is beyond the window (``accumulate.far_m``).
    """

    points: Float
    rigid_points: Float
    frame: NDArray[np.int32]
    since_key_ns: Int
    row: Int
    lidar: NDArray[np.uint8]
    moving: Bool
    instance: NDArray[np.int32]
    velocity_m_s: Float32
    confidence: Float32
    intensity: Float32
    rgb: NDArray[np.uint8]
    far: Bool

    @property
    def displaced(self) -> Float32:
        """(M,) metres between the positions by scene flow and by rigid accumulation."""
        x, y, z = (self.points - self.rigid_points).T
        return np.sqrt(x * x + y * y + z * z).astype(np.float32)

    def joined(self, cloud: Cloud) -> Cloud:
        """Return a new cloud of this cloud's points, followed by the points of ``cloud``."""
        return joined_rows([self, cloud])

    def select(self, keep: Bool | Int) -> Cloud:
        """Return a cloud of the points that ``keep`` selects: an (M,) mask, or point indices."""
        return select_rows(self, keep)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the attributes as (M,) columns by name, with a column for each axis of a vector.

        These columns are x y z, rigid_x ..., velocity_x ... (m/s), and red green blue. All other
        attributes keep their names.
        """
        by_axis = {
            "points": "x y z",
            "rigid_points": "rigid_x rigid_y rigid_z",
            "velocity_m_s": "velocity_x velocity_y velocity_z",
            "rgb": "red green blue",
        }
        columns: dict[str, NDArray[Any]] = {}
        for name, values in vars(self).items():
            names = by_axis.get(name, name).split()
            columns |= zip(names, np.atleast_2d(values.T), strict=True)
        return columns

    def to_numpy(self) -> NDArray[Any]:
        """Return an (M,) structured array with the fields of `columns`."""
        return table(self.columns())

    def __len__(self) -> int:
        return len(self.points)


class Patches(NamedTuple):
    """The surface patches of the M points of a cloud, as large as the spacing of rays there."""

    normal: Float32  # (M,3) normal of the tangent plane, of any length, key frame
    # (M,2) metres to the neighbouring rays of the same sweep: in azimuth, then in elevation
    spacing_m: Float32

    def joined(self, patches: Patches) -> Patches:
        """Return new patches: these, followed by ``patches`` of another cloud."""
        return joined_rows([self, patches])

    def select(self, keep: Bool) -> Patches:
        """Return the patches of the points that ``keep``, an (M,) mask, selects."""
        return select_rows(self, keep)


@dataclass(frozen=True)
class StaticWorld:
    """K points on static surfaces along the road, from n sweeps."""

    points: Float32  # (K,3) metres, in the world of the registered window
    normal: Float32  # (K,3) normal of the tangent plane, of any length, same frame
    spacing_m: Float32  # (K,2) metres to the neighbouring rays: in azimuth, then in elevation
    source: NDArray[np.int32]  # (K,) index of the source sweep in ``frames``
    row: Int  # (K,) row of the point in the file of the source sweep
    lidar: NDArray[np.uint8]  # (K,) index of the scanner
    intensity: Float32  # (K,) of 0 to 1
    frames: tuple[int, ...]  # frame numbers of the n sweeps
    stamp_ns: Int  # (n,) reference times of the n sweeps
    left_out: tuple[int, ...] = ()  # frame numbers of sweeps without a reliable registration

    def select(self, keep: Bool | Int) -> StaticWorld:
        """Return a world of the points that ``keep`` selects: a (K,) mask, or point indices."""
        columns = "points", "normal", "spacing_m", "source", "row", "lidar", "intensity"
        return select_rows(self, keep, columns)

    def __len__(self) -> int:
        return len(self.points)


class Reason(IntEnum):
    """Reason why a point is missing from a depth map; the first reason that applies."""

    KEPT = 0  # not missing: the pixel has the depth of this point
    OUTSIDE = 2  # not in the image
    HIDDEN = 3  # occluded by the patch of another point
    NOT_CHOSEN = 4  # another point of the pixel is nearer, or nearer in time to the key
    UNSUPPORTED = 5  # the sweep nearest to the key does not agree with it
    EDGE = 6  # boundary pixel: the pixel may show the other side of a depth discontinuity


@dataclass(frozen=True)
class CameraView:
    """The viewpoint of a depth map."""

    camera: Camera  # intrinsics and lens
    T_cam_key: Float  # (4,4) pose of the key frame in the camera frame at the time the map shows
    late_s: float  # time the map shows minus the key's reference time, seconds
    number: int | None  # number of the image; None if the map shows no image


class Rejected(NamedTuple):
    """Pixels without a depth in the map, because a rule rejected their depth."""

    depth_m: Float32  # (H,W) rejected depth in metres, 0 elsewhere
    confidence: Float32  # (H,W) confidence of the rejected depth, from 0 to 1
    frame: NDArray[np.int32]  # (H,W) frame number of the sweep that measured it, -1 elsewhere


@dataclass(frozen=True)
class DepthMap:
    """Dense depth of one camera.

    Attributes:
        camera: Name of the camera.
        depth_m: (H,W) metres of measured pixels, 0 elsewhere.
        filled_m: (H,W) metres of measured and interpolated pixels, 0 elsewhere.
        confidence: (H,W) of 0 to 1, for every pixel with a depth in ``filled_m``.
        frame: (H,W) frame number of the sweep that measured the pixel, -1 elsewhere.
        reason: (M,) `Reason` of each point of the cloud; empty if the cloud is not kept.
        age_s: (H,W) seconds between the exposure of the image and the sweep that measured the
            pixel, nan where ``filled_m`` has no depth. None until `densify.depth.views.with_ages`
            computes it.
        measure: ``z`` for depth along the optical axis, ``range`` for distance from the lens.
        warnings: Sentences about requested steps that could not be done.
        evidence: (P,10) `densify.depth.confidence.features` of the P pixels with a depth, in
            the map or in ``rejected``; None if the confidence is not calibrated.
        rejected: Pixels that rules rejected. None if the confidence is not calibrated, and after
            `densify.depth.confidence.with_max_outliers` has used them.
    """

    camera: str
    depth_m: Float32
    filled_m: Float32
    confidence: Float32
    frame: NDArray[np.int32]
    reason: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    age_s: Float32 | None = None
    measure: str = "z"
    warnings: tuple[str, ...] = ()
    evidence: Float32 | None = None
    rejected: Rejected | None = None

    def to_points(self, view: CameraView, filled: bool = True) -> Float:
        """Return the map's pixels with a depth as points (K,3), metres, key frame, row by row.

        Moving objects are at their position at the image's exposure.

        Args:
            view: Viewpoint of this map, from ``Result.views``.
            filled: Take the depths of ``filled_m``. False takes those of ``depth_m``.

        Raises:
            InputError: If the camera is not a rectified pinhole, or the map's measure is not ``z``.
        """
        camera = view.camera
        if not camera.is_rectified or self.measure != "z":
            raise InputError(
                f"{self.camera}: to_points() needs a rectified pinhole and depth along its axis, "
                f"got {camera.model} with {len(camera.distortion)} coefficients and depth as "
                f"{self.measure}; take result.cloud"
            )
        depth_m = (self.filled_m if filled else self.depth_m).astype(np.float64)
        v, u = np.nonzero(depth_m)
        rays = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(camera.K).T
        points_cam = rays * depth_m[v, u][:, None]
        T_key_cam = inverse(view.T_cam_key)
        return np.asarray(points_cam @ T_key_cam[:3, :3].T + T_key_cam[:3, 3])

    def counts(self) -> dict[str, int]:
        """Return the number of points for each `Reason`, by the reason's name in lower case."""
        counts = np.bincount(self.reason, minlength=max(Reason) + 1)
        return {reason.name.lower(): int(counts[reason]) for reason in Reason}


@dataclass(frozen=True)
class Mover:
    """One moving object alone: its points, and a depth map of these points for each map name."""

    cloud: Cloud
    depth: Mapping[str, DepthMap]


METHOD_NAMES = {"none": "single sweep", "icp": "rigid accumulation", "flow": "scene flow"}
"""The methods' names for people. Other methods have only their own."""


@dataclass(frozen=True)
class ObjectTrack:
    """Poses of one moving object at n reference times, of the sweeps it is seen in and of the key.

    Its origin is the middle of the box, x along the motion at the key's time, z that of the key
    frame.

    Attributes:
        instance: Number of the object, as in `Cloud`.
        size_m: (3,) length, width and height of the box. It stands on the ground, and is completed
            to the usual size of a vehicle where no ray passed.
        frames: Frame numbers of the n sweeps, ascending.
        stamp_ns: (n,) reference times.
        T_key_object: (n,4,4) poses in the key frame, ego-motion removed.
        velocity_m_s: (n,3) velocity of the middle of the box, key frame, ego-motion removed.
        num_points: (n,) number of points of the object in each sweep.
        seen_size_m: (3,) length, width and height of the box around its observed points.
        sides_seen: Sides of the box that were observed: of ``front``, ``rear``, ``left``,
            ``right`` and ``top``.
    """

    instance: int
    size_m: Float
    frames: tuple[int, ...]
    stamp_ns: Int
    T_key_object: Float
    velocity_m_s: Float
    num_points: Int
    seen_size_m: Float
    sides_seen: tuple[str, ...] = ()


@dataclass(frozen=True)
class Prior:
    """A depth image (H,W) supplied by the user, as from a network, that completes a depth map."""

    value: Float32  # (H,W) depth or inverse depth, relative or metric; 0 for no value
    sky: Bool  # (H,W) True for pixels that stay without depth
    source: str  # file of the image, for messages


@dataclass(frozen=True)
class PriorFit:
    """The fit of a prior's values p to the measured depth z (metres) of a whole map.

    Kind ``depth``: z = scale p + shift; ``inverse``: 1/z; ``log``: ln z = scale ln p + shift.
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
    confidence: Float32  # (H,W) from 0 to 1. Pixels of the prior are below all others.
    from_prior: Bool  # (H,W) True for pixels whose depth is from the prior
    fit: PriorFit  # fit of the prior to the map
    source: str  # file of the prior


Progress = Callable[[str, int, int], None]
"""Callback ``(stage, done, total)``: name of the stage, finished and total number of steps."""


@dataclass(frozen=True)
class StageCost:
    """The wall time of a pipeline stage, and the peak memory of the process at the stage's end."""

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
        costs: Wall time and memory of each stage. Stages overlap.
        elapsed_s: Wall time of all stages together.
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
    elapsed_s: float = 0.0
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
