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
        confidence: (M,) of 0 to 1, of pixels that confirm the point; 0 where no map does. For
            methods without visibility 1 / (1 + seconds from the key sweep).
        intensity: (M,) from 0 to 1.
        rgb: (M,3), black for points that no camera observed.
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
        """Return a cloud of this cloud's points, then the points of ``cloud``."""
        return Cloud(**{n: np.concatenate([c, vars(cloud)[n]]) for n, c in vars(self).items()})

    def select(self, keep: Bool | Int) -> Cloud:
        """Return a cloud with only the points of an (M,) mask, or of an array of point indices."""
        rows = np.flatnonzero(keep) if keep.dtype == bool else keep  # once for all columns
        return Cloud(**{name: column.take(rows, axis=0) for name, column in vars(self).items()})

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the attributes as (M,) columns by name, vectors split into one column per axis.

        The vector columns are x y z, rigid_x rigid_y rigid_z, velocity_x velocity_y velocity_z
        (m/s), and red green blue.
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
    """The surface patches of the M points of a cloud, in the same order.

    A patch is the piece of surface around a point, as large as the spacing of the rays there. It
    occludes what lies behind it (`densify.depth.patches`).
    """

    normal: Float32  # (M,3) normal of the tangent plane, of any length, key frame
    # (M,2) distance to the neighbouring rays of the same sweep: in azimuth, then in elevation
    spacing_m: Float32

    def joined(self, patches: Patches) -> Patches:
        """Return these patches, then ``patches``, of another cloud."""
        return Patches(*(np.concatenate(columns) for columns in zip(self, patches, strict=True)))

    def select(self, keep: Bool) -> Patches:
        """Return the patches of ``cloud.select(keep)``, for an (M,) mask ``keep``."""
        return Patches(self.normal[keep], self.spacing_m[keep])


@dataclass(frozen=True)
class StandingWorld:
    """K points on static surfaces along the road, from n sweeps."""

    points: Float32  # (K,3) metres, in the world of the registered window
    normal: Float32  # (K,3) normal of the tangent plane, of any length, same frame
    spacing_m: Float32  # (K,2) distance to the neighbouring rays of the same sweep, as in `Patches`
    source: NDArray[np.int32]  # (K,) index of the source sweep in ``frames``
    row: Int  # (K,) row of the point in the file of the source sweep
    lidar: NDArray[np.uint8]  # (K,) index of the scanner
    intensity: Float32  # (K,) of 0 to 1
    frames: tuple[int, ...]  # frame numbers of the n sweeps
    stamp_ns: Int  # (n,) reference times
    left_out: tuple[int, ...] = ()  # frame numbers of sweeps without a reliable registration

    def select(self, keep: Bool | Int) -> StandingWorld:
        """Return a world with only the points of a (K,) mask, or of an array of point indices."""
        rows = np.flatnonzero(keep) if keep.dtype == bool else keep
        kept = {name: getattr(self, name).take(rows, axis=0) for name in _COLUMNS_OF_STANDING}
        return replace(self, **kept)

    def __len__(self) -> int:
        return len(self.points)


_COLUMNS_OF_STANDING = ("points", "normal", "spacing_m", "source", "row", "lidar", "intensity")


class Reason(IntEnum):
    """Reason why a point is missing from a depth map; the first reason that applies."""

    KEPT = 0  # not missing: the pixel has the depth of this point
    OUTSIDE = 2  # not in the image
    HIDDEN = 3  # occluded by the patch of another point
    NOT_CHOSEN = 4  # another point of the pixel is nearer, or nearer in time to the key
    UNSUPPORTED = 5  # the sweep nearest to the key does not agree with it
    EDGE = 6  # boundary pixel: the pixel may show the other side of a depth discontinuity


@dataclass(frozen=True)
class Camera:
    """Intrinsics, lens and mounting pose of a camera.

    Attributes:
        name: Name of the camera in the recording.
        width_px: Width of the image.
        height_px: Height of the image.
        K: (3,3) intrinsics in pixels; an integer coordinate is the centre of a pixel.
        T_cam_lidar: (4,4) pose of the lidar frame in the camera frame.
        distortion: Coefficients of the lens: pinhole k1 k2 p1 p2 k3 ... as OpenCV, empty if
            rectified; fisheye k1 k2 k3 k4; mei xi k1 k2 p1 p2.
        model: ``pinhole``, ``fisheye`` (Kannala-Brandt) or ``mei``.
        max_angle_deg: Greatest angle off the optical axis that the lens sees.
        row_time_s: Rolling shutter: time from the exposure of a row to the exposure of the row
            below. It is negative if the image is read from the bottom, and 0 for a global shutter.
            The stamp of an image is the exposure of its middle.
        column_time_s: Time from the exposure of a column to the exposure of the next one right.
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
        """True for a pinhole without distortion."""
        return self.model == "pinhole" and not self.distortion

    @property
    def measure(self) -> str:
        """The default measure of depth: ``z`` along the optical axis, or ``range`` from the lens.

        Only a pinhole uses ``z``, because other lenses may see points with a negative z.
        """
        return "z" if self.model == "pinhole" else "range"

    @property
    def focal_px(self) -> float:
        """Pixels to the right per radian, at the principal point."""
        xi = self.distortion[0] if self.model == "mei" else 0.0
        return float(self.K[0, 0] / (1 + xi))


@dataclass(frozen=True)
class CameraView:
    """The viewpoint of a depth map."""

    camera: Camera
    T_cam_key: Float  # (4,4) pose of the key frame in the camera frame at the time the map shows
    late_s: float  # time the map shows minus the key's reference time, seconds
    number: int | None  # number of the image; None if the map shows no image


class Rejected(NamedTuple):
    """Pixels without a depth in the map, because a rule rejected their depth."""

    depth_m: Float32  # (H,W) rejected depth in metres, 0 elsewhere
    confidence: Float32  # (H,W) of the rejected depth
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
        """Return the map's pixels as points (K,3) in the key frame, metres, row by row.

        Moving objects are at their position at the exposure of the image. ``view`` is from
        ``Result.views``. ``filled`` includes interpolated pixels. Raises InputError if the camera
        is not rectified or the map holds ranges.
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
        """Return the number of points per `Reason`, by its name in lower case."""
        counts = np.bincount(self.reason, minlength=max(Reason) + 1)
        return {reason.name.lower(): int(counts[reason]) for reason in Reason}


@dataclass(frozen=True)
class Mover:
    """One moving object alone: its points, and map name -> depth map of these points."""

    cloud: Cloud
    depth: Mapping[str, DepthMap]
