# SPDX-License-Identifier: MIT
"""Define accumulated clouds, cameras and depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.arrays import Bool, Float, Float32, Int, table
from densify.geometry.poses import inverse


@dataclass(frozen=True)
class Cloud:
    """M accumulated points at the key's time.

    Attributes:
        points: (M,3) metres, key frame.
        rigid_points: (M,3) positions of rigid accumulation.
        frame: (M,) int32 frame of the source sweep.
        since_key_ns: (M,) int64 from the key's reference time to that of the source sweep.
        row: (M,) int64 row in the file of the source sweep.
        lidar: (M,) uint8 number of the scanner that measured the point.
        moving: (M,) bool.
        instance: (M,) int32 number of the moving object, -1 none.
        velocity_m_s: (M,3) float32 at the key's time, ego-motion removed, 0 for static points.
        confidence: (M,) float32, 0 to 1.
        intensity: (M,) float32.
        rgb: (M,3) uint8, black where no camera observed the point.
        far: (M,) bool, from a sweep beyond the window (``accumulate.far_m``).
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
        """Return (M,) metres moved beyond the rigid alignment."""
        x, y, z = (self.points - self.rigid_points).T
        return np.sqrt(x * x + y * y + z * z).astype(np.float32)

    def joined(self, other: Cloud) -> Cloud:
        """Return the cloud with the points of another one appended."""
        return Cloud(**{n: np.concatenate([c, vars(other)[n]]) for n, c in vars(self).items()})

    def select(self, keep: Bool) -> Cloud:
        """Return the points where ``keep`` (M,) is True."""
        rows = np.flatnonzero(keep)  # once for all columns
        return Cloud(**{name: column.take(rows, axis=0) for name, column in vars(self).items()})

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all columns (M,) by name, vectors by axis.

        These are x y z, rigid_x rigid_y rigid_z, velocity_x velocity_y velocity_z (m/s), red green
        blue, and the other attributes.
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
        """Return an (M,) structured array with a field for each of `columns`."""
        return table(self.columns())

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Patches:
    """The surface patches of M points of a cloud; see `densify.depth.patches`.

    Attributes:
        normal: (M,3) float32 normal of the tangent plane, of any length, key frame.
        spacing_m: (M,2) float32 distance to the neighbouring rays of the same sweep, across and
            along elevation.
        free: (M,) bool, the key sweep saw through the point.
        sweep: (M,) int32 number of the source sweep by frame, those beyond the window last.
        place: (M,) int32 number of the piece of road from which a sweep beyond the window
            measured the point; -1 within the window.
    """

    normal: Float32
    spacing_m: Float32
    free: Bool
    sweep: NDArray[np.int32]
    place: NDArray[np.int32]

    def joined(self, other: Patches) -> Patches:
        """Return the patches with those of another cloud appended. No sweep may be in both."""
        num_sweeps = np.int32(self.sweep.max(initial=-1) + 1)
        behind = vars(other) | {"sweep": num_sweeps + other.sweep}
        return Patches(**{n: np.concatenate([c, behind[n]]) for n, c in vars(self).items()})

    def select(self, keep: Bool) -> Patches:
        """Return the patches of ``cloud.select(keep)``."""
        rows = np.flatnonzero(keep)
        kept = {name: column.take(rows, axis=0) for name, column in vars(self).items()}
        number = np.cumsum(np.bincount(kept["sweep"]) > 0) - 1
        return Patches(**kept | {"sweep": number[kept["sweep"]].astype(np.int32)})


@dataclass(frozen=True)
class StandingWorld:
    """K points of static surfaces, measured along the road.

    Attributes:
        points: (K,3) float32 metres.
        normal: (K,3) float32 normal of the tangent plane, of any length.
        spacing_m: (K,2) float32 distance to the neighbouring rays of the same sweep.
        source: (K,) int32 index of the source sweep in ``frames``.
        row: As in `Cloud`; lidar and intensity too.
        frames: Frames of n sweeps.
        stamp_ns: (n,) int64.
        travel_m: (n,) float64 along the road: 0 at the key's window, negative before it.
        left_out: Sweeps that could not be registered well.
    """

    points: Float32
    normal: Float32
    spacing_m: Float32
    source: NDArray[np.int32]
    row: Int
    lidar: NDArray[np.uint8]
    intensity: Float32
    frames: tuple[int, ...]
    stamp_ns: Int
    travel_m: Float
    left_out: tuple[int, ...] = ()

    def select(self, keep: Bool | Int) -> StandingWorld:
        """Return some of the points."""
        rows = np.flatnonzero(keep) if keep.dtype == bool else keep
        kept = {name: getattr(self, name).take(rows, axis=0) for name in _COLUMNS_OF_STANDING}
        return replace(self, **kept)

    def __len__(self) -> int:
        return len(self.points)


_COLUMNS_OF_STANDING = ("points", "normal", "spacing_m", "source", "row", "lidar", "intensity")


class Reason(IntEnum):
    """Why a point is not in a depth map; the first reason that applies."""

    KEPT = 0  # it gives its pixel the depth
    VETOED = 1  # the key sweep saw through its position
    OUTSIDE = 2  # not in the image
    HIDDEN = 3  # behind another point's patch
    NOT_CHOSEN = 4  # a point nearer in time to the key, or nearer, gives its pixel the depth
    UNSUPPORTED = 5  # too few sweeps agree with it, or not the one nearest to the key
    EDGE = 6  # so close to a depth discontinuity that its pixel may be beyond it
    GLASS = 7  # inside a vehicle, measured through a car window


@dataclass(frozen=True)
class Camera:
    """A camera, rectified or with its lens.

    Attributes:
        name: As in the recording.
        width_px: Width of the image.
        height_px: Height of the image.
        K: (3,3) intrinsics in pixels; an integer coordinate is the centre of a pixel.
        T_cam_lidar: (4,4) pose.
        distortion: Coefficients of the lens. Of a pinhole OpenCV's (k1 k2 p1 p2 k3 ...), empty
            if rectified; of a fisheye k1 k2 k3 k4; of mei xi k1 k2 p1 p2.
        model: ``pinhole``, ``fisheye`` (Kannala-Brandt) or ``mei``.
        max_angle_deg: Greatest angle off the axis in the view of the lens.
        row_time_s: Time from the exposure of a row to that of the row below, negative if the
            image is read from the bottom, 0 for all at once. Stamps are those of the image's
            middle.
        column_time_s: The same from a column to the one on its right.
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
        """Approximate seconds from the exposure of the first row or column to the last."""
        along = abs(self.row_time_s) * self.height_px
        return along + abs(self.column_time_s) * self.width_px

    @property
    def is_rectified(self) -> bool:
        """True for a pinhole without distortion."""
        return self.model == "pinhole" and not self.distortion

    @property
    def measure(self) -> str:
        """The default measure of depth, camera ``z`` or ``range``.

        A lens that may see behind its image plane, where z is negative, has ranges.
        """
        return "z" if self.model == "pinhole" else "range"

    @property
    def focal_px(self) -> float:
        """Pixels to the right per radian, in the middle of the image."""
        xi = self.distortion[0] if self.model == "mei" else 0.0
        return float(self.K[0, 0] / (1 + xi))


class Ranked(NamedTuple):
    """The inputs of the confidence of a map's pixels (`densify.depth.confidence`).

    Attributes:
        rank: (H,W) float32 0 to 1, larger is more certain, 0 where ``filled_m`` has none.
        group: (H,W) uint8 kind of the pixel.
        contradicted: (H,W) float32 0 to 1, share of the measurements around that contradict
            each other.
    """

    rank: Float32
    group: NDArray[np.uint8]
    contradicted: Float32


@dataclass(frozen=True)
class CameraView:
    """The viewpoint of a depth map.

    Attributes:
        T_cam_key: (4,4) at the moment the map shows.
        late_s: Seconds from the key's reference time to that moment.
        number: Number of the image, None without one.
    """

    camera: Camera
    T_cam_key: Float
    late_s: float
    number: int | None


@dataclass(frozen=True)
class DepthMap:
    """Dense depth of one camera; (H,W) each.

    Attributes:
        camera: Name of the camera.
        depth_m: float32 metres of measured pixels, 0 none.
        filled_m: The same, and pixels interpolated between measured ones.
        confidence: float32 0 to 1, of every pixel in ``filled_m``.
        frame: int32 frame of the sweep that measured the pixel, -1 elsewhere.
        reason: (M,) uint8 `Reason` of each point of the cloud; empty without the cloud.
        age_s: float32 time between the moment of the map and the sweep that measured the pixel,
            of every pixel in ``filled_m``, nan elsewhere; None before
            `densify.depth.views.with_ages`.
        measure: ``z`` along the camera's axis, or ``range`` from the lens.
        warnings: What could not be done as asked.
        ranked: Inputs of the calibrated confidence; None for another one.
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
    ranked: Ranked | None = None

    def to_points(self, view: CameraView, filled: bool = True) -> Float:
        """Return the map's pixels as points (K,3) in the key frame, metres, row by row.

        Moving objects are where they were at the exposure.

        Args:
            view: ``Result.views`` of the same name.
            filled: Take the interpolated pixels too.

        Raises:
            InputError: The camera is not rectified, or the map holds ranges.
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
        """Return the number of points for each `Reason`."""
        counts = np.bincount(self.reason, minlength=len(Reason))
        return {which.name.lower(): int(counts[which]) for which in Reason}


@dataclass(frozen=True)
class Mover:
    """One moving object alone: its points, and its depth map in each camera."""

    cloud: Cloud
    depth: Mapping[str, DepthMap]
