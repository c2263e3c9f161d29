# SPDX-License-Identifier: MIT
"""Make all depth maps of a key sweep: the accumulated cloud in the view of each camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.config import Config, ProjectSettings
from densify.depth.confidence import nearest_pixel, reliability, tolerance, with_max_outliers
from densify.depth.exposure import Exposure, InView, Shot, pixel_of
from densify.depth.far import far_cloud
from densify.depth.fill import to_lab
from densify.depth.measured_pixels import MapInputs
from densify.depth.moving_bodies import find_far_inside, fronts
from densify.depth.patches import find_patches, hidden_m
from densify.depth.project import project
from densify.depth.rays import MovingBody, Rays, find_moving_bodies, without_sweep
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.cameras import convert_depth
from densify.geometry.types import (
    Bool,
    CameraView,
    Cloud,
    DepthMap,
    Float,
    Float32,
    LidarSequence,
    Mover,
    Patches,
    Reason,
    StaticWorld,
    Stretch,
    Sweep,
    Truth,
)
from densify.scores.edge_fit import is_off, silhouettes_of
from densify.scores.metrics import depth_scores, precision_density, shares_by_motion

_MISALIGNED = (
    "image edges do not lie on depth discontinuities (calibration, clock?): the image is not used, "
    "and boundary pixels are left out as with project.rims=strict; densify doctor says more"
)


class SeenCloud(NamedTuple):
    """A cloud as the cameras see it."""

    cloud: Cloud
    patches: Patches
    in_view: Mapping[str, InView]  # points in each image, by name of the map
    bodies: Mapping[int, MovingBody] = {}  # hulls of moving objects by instance number

    def with_far_points(self, far: SeenCloud | None) -> SeenCloud:
        """Return the cloud with the points of sweeps beyond the window appended."""
        if far is None or not len(far.cloud):
            return self
        num_points = len(self.cloud)
        in_view = {
            name: view.joined(far.in_view[name], num_points) for name, view in self.in_view.items()
        }
        cloud = self.cloud.joined(far.cloud)
        return SeenCloud(cloud, self.patches.joined(far.patches), in_view, self.bodies)


@dataclass(frozen=True)
class Views:
    """The cameras and times of the depth maps of a key sweep."""

    key: int  # frame number of the key sweep
    exposures: Mapping[str, Exposure]  # name of a map -> its camera and time
    sensors: Sensors  # scanners of the recording
    # Frame number of a sweep in the window -> (S,3) origins of its scanners, key's lidar frame
    origins: Mapping[int, Float]
    rays: Rays  # rays of the window's sweeps
    settings: ProjectSettings  # section ``project`` of the configuration
    lab: Mapping[str, Float32]  # name of a map that uses an image -> (H,W,3) image in L*a*b*
    # Names of the maps whose image edges do not lie on the depth discontinuities
    misaligned_maps: frozenset[str] = frozenset()

    @staticmethod
    def of(
        sequence: LidarSequence,
        stretch: Stretch,
        key: int,
        shots: Mapping[str, Shot],
        images: Mapping[str, NDArray[np.uint8]],
        settings: Config,
    ) -> Views:
        """Return the cameras and times of the depth maps of a key sweep.

        Shots and RGB images (H,W,3) are by name of the map. Images are used unless ``project.rims``
        is ``strict`` or their edges miss the depth discontinuities. ``key`` is a frame number.
        """
        sensors = Sensors.of(stretch.sweeps)
        exposures = {
            name: Exposure.of(sequence, stretch, key, shot, settings)
            for name, shot in shots.items()
        }
        used_images = {} if settings.project.rims == "strict" else images
        misaligned_maps = _misaligned_maps(stretch[key].sweep, exposures, used_images)
        return Views(
            key=key,
            exposures=exposures,
            sensors=sensors,
            origins={
                frame: poses.transform(stretch.T_target_source(key, frame), sensors.origins_m)
                for frame in stretch.frames
            },
            rays=Rays(stretch, key),
            settings=settings.project,
            lab={
                name: to_lab(image)
                for name, image in used_images.items()
                if name not in misaligned_maps
            },
            misaligned_maps=misaligned_maps,
        )

    def see(self, cloud: Cloud) -> SeenCloud:
        """Return a cloud with its patches and with its points in each image."""
        in_view = self.points_in_view(cloud)
        wanted = np.zeros(len(cloud), bool)
        for view in in_view.values():
            wanted[view.rows] = True
        return SeenCloud(cloud, find_patches(cloud, self.sensors, self.origins, wanted), in_view)

    def points_in_view(self, cloud: Cloud) -> dict[str, InView]:
        """Return the points of a cloud that lie in each image, by name of the map."""
        return {name: exposure.view_of(cloud) for name, exposure in self.exposures.items()}

    def find_bodies(self, cloud: Cloud) -> dict[int, MovingBody]:
        """Return the bodies of moving objects by instance number, from all points of the window."""
        return find_moving_bodies(cloud, self.rays, self.exposures.values())

    def see_far(
        self, world: StaticWorld, T_key_world: Float, stretch: Stretch, static_only: bool
    ) -> SeenCloud:
        """Return the static points beyond the window that cameras observe, in the key frame."""
        cloud, patches = far_cloud(
            world, T_key_world, stretch, self.key, self.exposures, static_only=static_only
        )
        return SeenCloud(cloud, patches, self.points_in_view(cloud))

    def depth_maps(
        self, seen: SeenCloud, visible: bool = True, filled: bool = True
    ) -> dict[str, DepthMap]:
        """Return the depth map of each view, by name of the map.

        Unless ``visible``, pixels take their nearest point, without occlusion or rejection. Unless
        ``filled``, pixels without a return stay empty.
        """
        settings = replace(self.settings, visibility=visible)
        depth_maps = {}
        for name, view in seen.in_view.items():
            inputs = MapInputs(
                cloud=seen.cloud,
                patches=seen.patches,
                view=view,
                settings=settings,
                filled=filled,
                lab=self.lab.get(name),
                rays=self.rays,
                bodies=seen.bodies,
            )
            depth_map = project(inputs)
            is_misaligned = name in self.misaligned_maps
            depth_maps[name] = replace(depth_map, warnings=(_MISALIGNED,) * is_misaligned)
        return depth_maps

    def with_colours(
        self,
        seen: SeenCloud,
        depth_maps: Mapping[str, DepthMap],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> Cloud:
        """Return the cloud with the colours of the RGB images (H,W,3) that observe its points.

        A point is observed unless it is clearly behind the depth of its pixel. Pixels without
        depth give no colour. Maps and images are by name of the map.
        """
        rgb = seen.cloud.rgb.copy()
        for name, image in images.items():
            view = seen.in_view[name]
            pixel = pixel_of(view.uv)
            surface_m = depth_maps[name].filled_m[pixel]
            limit_m = surface_m + hidden_m(surface_m)
            is_observed = (surface_m > 0) & (view.exposure.depth_m(view.points_cam) <= limit_m)
            rgb[view.rows[is_observed]] = image[pixel][is_observed]
        return replace(seen.cloud, rgb=rgb)

    def with_confidence(
        self, seen: SeenCloud, cloud: Cloud, depth_maps: Mapping[str, DepthMap]
    ) -> Cloud:
        """Return the cloud with the greatest confidence of the pixels that agree with each point.

        A pixel agrees if the point is no outlier there. Points that no map confirms have 0. The
        points of ``cloud`` are those of ``seen``.
        """
        confidence = np.zeros(len(cloud), np.float32)
        for name, view in seen.in_view.items():
            depth_map = depth_maps[name]
            pixel = pixel_of(view.uv)
            surface_m = depth_map.filled_m[pixel]
            error_m = abs(view.exposure.depth_m(view.points_cam) - surface_m)
            agrees = error_m <= surface_m * tolerance(surface_m, view.exposure.camera)
            pixel_confidence = np.where(agrees & (surface_m > 0), depth_map.confidence[pixel], 0)
            confidence[view.rows] = np.maximum(confidence[view.rows], pixel_confidence)
        return replace(cloud, confidence=confidence)

    def true_maps(self, truth: Truth) -> dict[str, tuple[Float32, Bool]]:
        """Return the true depth (H,W), m, and moving pixels (H,W) of maps that show an image."""
        true_maps = {}
        for name, exposure in self.exposures.items():
            if exposure.number is not None:
                camera = exposure.camera
                depth_m = truth.depth_m(camera.name, exposure.number)
                depth_m = convert_depth(camera, depth_m, camera.measure, exposure.measure)
                true_maps[name] = (depth_m, truth.moving_mask(camera.name, exposure.number))
        return true_maps

    def cameras(self) -> dict[str, CameraView]:
        """Return the camera, pose and time of each map, by name of the map."""
        return {
            name: CameraView(exposure.camera, exposure.T_cam_key, exposure.late_s, exposure.number)
            for name, exposure in self.exposures.items()
        }

    def optical_flow(
        self, cloud: Cloud, depth_maps: Mapping[str, DepthMap]
    ) -> dict[str, dict[str, Float32]]:
        """Return the optical flow (H,W,2) in px, by name of the map and "previous" or "next"."""
        return {
            name: {
                image: optical_flow(cloud, depth_maps[name], exposure, neighbour)
                for image, neighbour in exposure.neighbours.items()
            }
            for name, exposure in self.exposures.items()
        }

    def rejection_reasons(
        self, seen: SeenCloud, depth_maps: Mapping[str, DepthMap]
    ) -> dict[str, NDArray[np.uint8]]:
        """Return the `Reason` (H,W) of each pixel's nearest rejected point, 0 for none, by map."""
        reason_maps = {}
        for name, view in seen.in_view.items():
            reason = depth_maps[name].reason[view.rows]
            depth_m = view.exposure.depth_m(view.points_cam)
            is_rejected = np.isin(reason, [Reason.KEPT, Reason.NOT_CHOSEN], invert=True)
            # The farthest point is written first, so the nearest one in a pixel stays.
            farthest_first = np.argsort(-depth_m, kind="stable")
            rejected_points = farthest_first[is_rejected[farthest_first]]
            reason_map = np.zeros(depth_maps[name].depth_m.shape, np.uint8)
            reason_map[pixel_of(view.uv[rejected_points])] = reason[rejected_points]
            reason_maps[name] = reason_map
        return reason_maps

    def movers(
        self,
        cloud: Cloud,
        visible: bool,
        bodies: Mapping[int, MovingBody],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> dict[int, Mover]:
        """Return the points and depth maps of each moving object alone, by instance number.

        Moving points without an object are together, with the number -1. Without ``visible``,
        occluded and unsupported points count too. Images are RGB (H,W,3), by name of the map.
        """
        movers = {}
        for instance in np.unique(cloud.instance[cloud.moving]).tolist():
            seen = self.see(cloud.select(cloud.moving & (cloud.instance == instance)))
            if instance in bodies:
                seen = seen._replace(bodies={instance: bodies[instance]})
            depth_maps = self.depth_maps(seen, visible)
            movers[instance] = Mover(self.with_colours(seen, depth_maps, images), depth_maps)
        return movers


def _misaligned_maps(
    key_sweep: Sweep, exposures: Mapping[str, Exposure], images: Mapping[str, NDArray[np.uint8]]
) -> frozenset[str]:
    """Return the names of the maps whose image edges miss the key sweep's depth discontinuities."""
    if not images:
        return frozenset()
    silhouettes = silhouettes_of(key_sweep)
    # The silhouettes are in the lidar frame of the key sweep's time. The exposures' poses include
    # the ego-motion between that time and theirs.
    cameras = {
        name: replace(exposure.camera, T_cam_lidar=exposure.T_cam_key)
        for name, exposure in exposures.items()
    }
    return frozenset(
        name for name, image in images.items() if is_off(cameras[name], silhouettes, image)
    )


def optical_flow(
    cloud: Cloud, depth_map: DepthMap, exposure: Exposure, target: Exposure
) -> Float32:
    """Return the optical flow (H,W,2) between two exposures in pixels, right and down.

    The flow includes ego-motion, and moving objects keep their velocity. Pixels under a laser spot
    take the flow of the nearest pixel with a point. Other pixels have NaN. ``depth_map`` is the map
    of the cloud at ``exposure``, where the flow starts. The flow ends at ``target``.
    """
    chosen = np.flatnonzero(depth_map.reason == Reason.KEPT)
    points, velocity_m_s = cloud.points[chosen], cloud.velocity_m_s[chosen]
    uv = exposure.see(points, velocity_m_s).uv
    pixel = pixel_of(uv)
    flow = np.full((*depth_map.depth_m.shape, 2), np.nan, np.float32)
    flow[pixel] = target.see(points, velocity_m_s).uv - uv
    has_return = np.zeros(depth_map.depth_m.shape, bool)
    has_return[pixel] = True
    covered = (depth_map.depth_m > 0) & ~has_return
    if covered.any():
        flow[covered] = flow[nearest_pixel(has_return)][covered]
    return flow


def with_ages(
    depth_map: DepthMap, stamps_ns: Mapping[int, int], key: int, late_s: float
) -> DepthMap:
    """Return the map with ``age_s``, seconds between its time and the source sweep of each pixel.

    A filled pixel has the age of the nearest measured pixel in the image. The map shows the time
    ``late_s`` seconds after the key sweep. ``stamps_ns`` has the times of sweeps by frame number.
    """
    shown_ns = stamps_ns[key] + round(1e9 * late_s)
    measured = depth_map.depth_m > 0
    has_depth = depth_map.filled_m > 0
    ages_s = np.full(measured.shape, np.nan, np.float32)
    if measured.any():
        source_frame = depth_map.frame[nearest_pixel(measured)][has_depth]
        frames, index = np.unique(source_frame, return_inverse=True)
        sweep_ages_s = [abs(stamps_ns[frame] - shown_ns) * 1e-9 for frame in frames.tolist()]
        ages_s[has_depth] = np.array(sweep_ages_s)[index]
    return replace(depth_map, age_s=ages_s)


class JudgedMap(NamedTuple):
    """A map made without the key sweep, and the key sweep's returns as its ground truth."""

    depth_map: DepthMap
    truth_m: Float32  # (H,W) depth of the key sweep's returns, 0 none
    moving: Bool  # (H,W) True at moving returns of the key sweep


@dataclass(frozen=True)
class HeldOut:
    """The key sweep's returns as ground truth for maps made from its neighbouring sweeps alone."""

    views: Views
    # Name of a map -> (H,W) depth of the key sweep's returns in m without boundary pixels, 0 none
    truth_m: Mapping[str, Float32]
    moving: Mapping[str, Bool]  # name of a map -> (H,W) True at moving returns of the key sweep
    gap_rad: float  # usual angle between neighbouring rings of the key sweep

    @staticmethod
    def of(views: Views, cloud: Cloud) -> HeldOut:
        """Return the key sweep's returns in a window's cloud as ground truth, with velocities."""
        settings = replace(views.settings, rims="strict", visibility=True)
        key_cloud = cloud.select(cloud.frame == views.key)
        seen = views.see(key_cloud)
        truth_m, moving = {}, {}
        for name, view in seen.in_view.items():
            depth_map = project(MapInputs(key_cloud, seen.patches, view, settings, filled=False))
            in_map = (depth_map.reason == Reason.KEPT) & key_cloud.moving
            is_moving = np.zeros(depth_map.depth_m.shape, bool)
            is_moving[pixel_of(view.uv[in_map[view.rows]])] = True
            truth_m[name], moving[name] = depth_map.depth_m, is_moving

        elevation_spacing_m = seen.patches.spacing_m[:, 1]
        gap_rad = elevation_spacing_m / np.linalg.norm(key_cloud.points, axis=1)
        gap_rad = gap_rad[gap_rad > 0]  # points out of view have no patch
        return HeldOut(views, truth_m, moving, float(np.median(gap_rad)) if len(gap_rad) else 0.0)

    def judged_maps(self, seen: SeenCloud, visible: bool) -> dict[str, JudgedMap]:
        """Return each map of a cloud without the key sweep, by name, or {} if no points remain."""
        keep = seen.cloud.frame != self.views.key
        if not keep.any():
            return {}
        # Bodies are made without the rays of the key sweep, too.
        cloud = seen.cloud.select(keep)
        bodies = without_sweep(seen.bodies, cloud, self.views.key)
        in_view = self.views.points_in_view(cloud)
        neighbours_only = SeenCloud(cloud, seen.patches.select(keep), in_view, bodies)
        judged_maps = {}
        for name, depth_map in self.views.depth_maps(neighbours_only, visible).items():
            moving, truth_m = self.moving[name], self.truth_m[name]
            exposure = self.views.exposures[name]
            # Returns through glass, from seats or the far side, are no truth of the surface.
            inside = moving & find_far_inside(seen.bodies.values(), exposure, truth_m)
            truth_m = np.where(inside, np.float32(0), truth_m)
            judged_maps[name] = JudgedMap(depth_map, truth_m, moving & ~inside)
        return judged_maps

    def scores(self, seen: SeenCloud, visible: bool) -> dict[str, Any] | None:
        """Return the scores of each map made without the key sweep, None if no points remain.

        The keys are names of maps, then those of `depth_scores`, ``curve`` (precision by density),
        ``reliability``, and ``unjudged``: the shares of ``all``, ``moving`` and ``static`` filled
        pixels without a key return within a ray spacing.
        """
        scores: dict[str, Any] = {}
        for name, (judged_map, truth_m, moving) in self.judged_maps(seen, visible).items():
            camera = self.views.exposures[name].camera
            depth_map = with_max_outliers(judged_map, self.views.settings.max_outliers)
            scores[name] = {
                **depth_scores(depth_map, truth_m, moving, camera),
                "curve": precision_density(depth_map, truth_m, camera),
                "reliability": reliability(depth_map, truth_m, camera),
                "unjudged": self._unjudged_shares(name, depth_map, seen.bodies),
            }
        return scores or None

    def _unjudged_shares(
        self, name: str, depth_map: DepthMap, bodies: Mapping[int, MovingBody]
    ) -> dict[str, float | None]:
        """Return the filled share (all, moving, static) without a key return nearby, or None."""
        exposure = self.views.exposures[name]
        to_return_px = ndimage.distance_transform_edt(self.truth_m[name] == 0)
        unjudged = to_return_px > self.gap_rad * exposure.camera.focal_px
        filled = depth_map.filled_m > 0
        moving = fronts(bodies.values(), exposure) > 0
        return shares_by_motion(unjudged[filled], moving[filled])
