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
from densify.depth.measured_pixels import MapInputs
from densify.depth.moving_bodies import far_inside, fronts
from densify.depth.patches import hidden_m, patches
from densify.depth.project import project
from densify.depth.rays import MovingBody, Rays, moving_bodies, without_sweep
from densify.depth.votes import lab
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.cameras import converted
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
    StandingWorld,
    Stretch,
    Truth,
)
from densify.scores import depth_metrics
from densify.scores.edge_fit import is_off, silhouettes_of

_OFF = (
    "image edges do not lie on depth discontinuities (calibration, clock?): the image is not used, "
    "and boundary pixels are left out as with project.rims=strict; densify doctor says more"
)


class SeenCloud(NamedTuple):
    """A cloud as the cameras see it."""

    cloud: Cloud
    patches: Patches
    in_view: Mapping[str, InView]  # points in each image, by name of the map
    bodies: Mapping[int, MovingBody] = {}  # hulls of moving objects by instance number

    def joined(self, far: SeenCloud | None) -> SeenCloud:
        """Return the cloud with the points of sweeps beyond the window appended."""
        if far is None or not len(far.cloud):
            return self
        num, surface = len(self.cloud), self.patches.joined(far.patches)
        in_view = {name: v.joined(far.in_view[name], num) for name, v in self.in_view.items()}
        return SeenCloud(self.cloud.joined(far.cloud), surface, in_view, self.bodies)


@dataclass(frozen=True)
class Views:
    """The cameras and times of the depth maps of a key sweep; mappings are by name of the map."""

    key: int  # frame number of the key sweep
    exposures: Mapping[str, Exposure]
    sensors: Sensors
    # (S,3) of the scanners, key sweep's lidar frame, by frame number of the sweep
    origins: Mapping[int, Float]
    rays: Rays  # rays of the window's sweeps
    settings: ProjectSettings
    lab: Mapping[str, Float32]  # (H,W,3) L*a*b* images of the maps that use an image
    # Names of the maps whose image does not lie where the depth discontinuities are
    off: frozenset[str] = frozenset()

    @staticmethod
    def of(
        sequence: LidarSequence,
        stretch: Stretch,
        key: int,
        shots: Mapping[str, Shot],
        images: Mapping[str, NDArray[np.uint8]],
        settings: Config,
    ) -> Views:
        """Return the cameras and times of the maps of key sweep ``key``, shown by ``shots``.

        Images are used if ``project.rims`` is not ``strict``, and if they are not off (`is_off`).
        """
        sensors = Sensors.of(stretch.sweeps)
        exposures = {n: Exposure.of(sequence, stretch, key, s, settings) for n, s in shots.items()}
        used, off = {}, frozenset[str]()
        if settings.project.rims != "strict" and images:
            silhouettes = silhouettes_of(stretch[key].sweep)
            cameras = {n: replace(e.camera, T_cam_lidar=e.T_cam_key) for n, e in exposures.items()}
            off = frozenset(n for n, i in images.items() if is_off(cameras[n], silhouettes, i))
            used = {name: lab(image) for name, image in images.items() if name not in off}
        return Views(
            key=key,
            exposures=exposures,
            sensors=sensors,
            origins={
                f: poses.transform(stretch.T_target_source(key, f), sensors.origins_m)
                for f in stretch.frames
            },
            rays=Rays(stretch, key),
            settings=settings.project,
            lab=used,
            off=off,
        )

    def see(self, cloud: Cloud) -> SeenCloud:
        """Return a cloud with its patches, as the cameras see it."""
        in_view, wanted = self.in_view(cloud), np.zeros(len(cloud), bool)
        for view in in_view.values():
            wanted[view.rows] = True
        return SeenCloud(cloud, patches(cloud, self.sensors, self.origins, wanted), in_view)

    def in_view(self, cloud: Cloud) -> dict[str, InView]:
        """Return the points of a cloud in each image, by name of the map."""
        return {name: exposure.sees(cloud) for name, exposure in self.exposures.items()}

    def bodies(self, cloud: Cloud) -> dict[int, MovingBody]:
        """Return the bodies of moving objects by instance number, from all points of the window."""
        return moving_bodies(cloud, self.rays, self.exposures.values())

    def far(
        self, world: StandingWorld, T_key_world: Float, stretch: Stretch, standing_only: bool
    ) -> SeenCloud:
        """Return the points of sweeps beyond the window, see `densify.depth.far.far_cloud`."""
        of_key = stretch, self.key, self.exposures
        cloud, surface = far_cloud(world, T_key_world, *of_key, standing_only)
        return SeenCloud(cloud, surface, self.in_view(cloud))

    def depth(
        self, seen: SeenCloud, visible: bool = True, filled: bool = True
    ) -> dict[str, DepthMap]:
        """Return the depth map of each view by name.

        ``visible`` leaves out occluded and unsupported points. ``filled`` interpolates between
        measured pixels.
        """
        settings = replace(self.settings, visibility=visible)
        maps = {}
        for name, view in seen.in_view.items():
            evidence = self.lab.get(name), self.rays, seen.bodies
            inputs = MapInputs(seen.cloud, seen.patches, view, settings, filled, *evidence)
            depth_map = project(inputs)
            maps[name] = replace(depth_map, warnings=(_OFF,)) if name in self.off else depth_map
        return maps

    def coloured(
        self,
        seen: SeenCloud,
        depth: Mapping[str, DepthMap],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> Cloud:
        """Return the cloud with the colours of the (H,W,3) images that observe its points.

        A point is observed unless it is clearly behind the depth of its pixel, in the maps
        ``depth`` of the cloud. Pixels without depth give no colour.
        """
        rgb = seen.cloud.rgb.copy()
        for name, image in images.items():
            view = seen.in_view[name]
            pixel = pixel_of(view.uv)
            surface_m = depth[name].filled_m[pixel]
            reach_m = surface_m + hidden_m(surface_m)
            shows = (surface_m > 0) & (view.exposure.depth_m(view.points_cam) <= reach_m)
            rgb[view.rows[shows]] = image[pixel][shows]
        return replace(seen.cloud, rgb=rgb)

    def confident(self, seen: SeenCloud, cloud: Cloud, depth: Mapping[str, DepthMap]) -> Cloud:
        """Return the cloud with the greatest confidence of the pixels that agree with each point.

        A pixel agrees if the point is no outlier there. Points that no map confirms have 0.

        Args:
            seen: The points in the images.
            cloud: The same points.
            depth: Maps made of them, by name.
        """
        confidence = np.zeros(len(cloud), np.float32)
        for name, view in seen.in_view.items():
            maps, pixel = depth[name], pixel_of(view.uv)
            surface_m = maps.filled_m[pixel]
            off_m = abs(view.exposure.depth_m(view.points_cam) - surface_m)
            agrees = off_m <= surface_m * tolerance(surface_m, view.exposure.camera)
            of_pixel = np.where(agrees & (surface_m > 0), maps.confidence[pixel], 0)
            confidence[view.rows] = np.maximum(confidence[view.rows], of_pixel)
        return replace(cloud, confidence=confidence)

    def truth(self, truth: Truth) -> dict[str, tuple[Float32, Bool]]:
        """Return the true depth (H,W) and moving pixels (H,W) of each map that shows an image."""
        known = {}
        for name, e in self.exposures.items():
            if e.number is not None:
                depth_m = truth.depth_m(e.camera.name, e.number)
                depth_m = converted(e.camera, depth_m, e.camera.measure, e.measure)
                known[name] = (depth_m, truth.moving_mask(e.camera.name, e.number))
        return known

    def cameras(self) -> dict[str, CameraView]:
        """Return the viewpoint of each map by name."""
        return {
            name: CameraView(e.camera, e.T_cam_key, e.late_s, e.number)
            for name, e in self.exposures.items()
        }

    def optical_flow(
        self, cloud: Cloud, depth: Mapping[str, DepthMap]
    ) -> dict[str, dict[str, Float32]]:
        """Return the (H,W,2) `optical_flow` to the "previous" and "next" image, by map name."""
        return {
            name: {
                image: optical_flow(cloud, depth[name], exposure, neighbour)
                for image, neighbour in exposure.neighbours.items()
            }
            for name, exposure in self.exposures.items()
        }

    def rejected(
        self, seen: SeenCloud, depth: Mapping[str, DepthMap]
    ) -> dict[str, NDArray[np.uint8]]:
        """Return for each map (H,W) the `Reason` of a pixel's nearest rejected point, 0 none.

        Points that lost their pixel to another point do not count.
        """
        maps = {}
        for name, view in seen.in_view.items():
            reason, depth_m = depth[name].reason[view.rows], view.exposure.depth_m(view.points_cam)
            farthest_first = np.argsort(-depth_m, kind="stable")
            lost = np.isin(reason[farthest_first], [Reason.KEPT, Reason.NOT_CHOSEN], invert=True)
            rejected = farthest_first[lost]
            maps[name] = np.zeros(depth[name].depth_m.shape, np.uint8)
            maps[name][pixel_of(view.uv[rejected])] = reason[rejected]
        return maps

    def movers(
        self,
        cloud: Cloud,
        visible: bool,
        bodies: Mapping[int, MovingBody],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> dict[int, Mover]:
        """Return every moving object alone by instance number, points without an object as -1."""
        movers = {}
        for instance in np.unique(cloud.instance[cloud.moving]).tolist():
            seen = self.see(cloud.select(cloud.moving & (cloud.instance == instance)))
            seen = seen._replace(bodies={k: b for k, b in bodies.items() if k == instance})
            depth = self.depth(seen, visible)
            movers[instance] = Mover(self.coloured(seen, depth, images), depth)
        return movers


def optical_flow(cloud: Cloud, depth: DepthMap, exposure: Exposure, target: Exposure) -> Float32:
    """Return the (H,W,2) flow in pixels, right and down, between two exposures; NaN if unknown.

    The flow includes ego-motion, and moving objects continue at their velocity. Pixels that only a
    laser spot covers take the flow of the nearest measured pixel. Other filled pixels have none.
    """
    chosen = np.flatnonzero(depth.reason == Reason.KEPT)
    points, velocity_m_s = cloud.points[chosen], cloud.velocity_m_s[chosen]
    uv = exposure.see(points, velocity_m_s).uv
    flow = np.full((*depth.depth_m.shape, 2), np.nan, np.float32)
    hit = np.zeros(depth.depth_m.shape, bool)
    flow[pixel_of(uv)] = target.see(points, velocity_m_s).uv - uv
    hit[pixel_of(uv)] = True
    covered = (depth.depth_m > 0) & ~hit
    if covered.any():
        flow[covered] = flow[nearest_pixel(hit)][covered]
    return flow


def with_ages(depth: DepthMap, stamps_ns: Mapping[int, int], key: int, late_s: float) -> DepthMap:
    """Return the map with ``age_s``, seconds between its time and the source sweep of each pixel.

    A filled pixel has the age of the nearest measured pixel in the image. The map shows a time
    ``late_s`` seconds after the key sweep. ``stamps_ns`` has the sweeps' times by frame number.
    """
    shown_ns = stamps_ns[key] + round(1e9 * late_s)
    age_s = {frame: abs(stamp_ns - shown_ns) * 1e-9 for frame, stamp_ns in stamps_ns.items()}
    measured, shown = depth.depth_m > 0, depth.filled_m > 0
    ages = np.full(measured.shape, np.nan, np.float32)
    if measured.any():
        frames, index = np.unique(depth.frame[nearest_pixel(measured)][shown], return_inverse=True)
        ages[shown] = np.array([age_s[int(f)] for f in frames])[index]
    return replace(depth, age_s=ages)


@dataclass(frozen=True)
class HeldOut:
    """The key sweep's returns as ground truth for maps made from its neighbouring sweeps alone."""

    views: Views
    # Depth maps of the key sweep by name, without boundary pixels
    key_alone: Mapping[str, DepthMap]
    moving: Mapping[str, Bool]  # (H,W) True at moving returns of the key sweep, by name of the map
    gap_rad: float  # usual angle between neighbouring rings of the key sweep

    @staticmethod
    def of(views: Views, cloud: Cloud) -> HeldOut:
        """Return the ground truth of a key sweep; ``cloud`` has its moving points' velocities."""
        settings = replace(views.settings, rims="strict", visibility=True)
        key_cloud = cloud.select(cloud.frame == views.key)
        seen, key_alone, moving = views.see(key_cloud), {}, {}
        for name, view in seen.in_view.items():
            maps = project(MapInputs(key_cloud, seen.patches, view, settings, filled=False))
            moves = (maps.reason == Reason.KEPT) & key_cloud.moving
            key_alone[name], moving[name] = maps, np.zeros(maps.depth_m.shape, bool)
            moving[name][pixel_of(view.uv[moves[view.rows]])] = True
        gap_rad = seen.patches.spacing_m[:, 1] / np.linalg.norm(key_cloud.points, axis=1)
        known = gap_rad[np.isfinite(gap_rad) & (gap_rad > 0)]
        return HeldOut(views, key_alone, moving, float(np.median(known)) if len(known) else 0.0)

    def without_key(self, seen: SeenCloud) -> SeenCloud:
        """Return the cloud without the key sweep and its evidence on bodies."""
        keep = seen.cloud.frame != self.views.key
        surface, cloud = seen.patches.select(keep), seen.cloud.select(keep)
        bodies = without_sweep(seen.bodies, cloud, self.views.key)
        return SeenCloud(cloud, surface, self.views.in_view(cloud), bodies)

    def maps(self, seen: SeenCloud, visible: bool) -> dict[str, tuple[DepthMap, Float32, Bool]]:
        """Return each map made without the key sweep, its (H,W) truth, and (H,W) moving pixels.

        Returns from far inside a moving body are no ground truth: they passed its windows, but the
        map shows the glass. The result is empty if no points remain.
        """
        without_key = self.without_key(seen)
        if not len(without_key.cloud):
            return {}
        maps = {}
        for name, depth in self.views.depth(without_key, visible).items():
            moving, truth_m = self.moving[name], self.key_alone[name].depth_m
            inside = moving & far_inside(seen.bodies.values(), self.views.exposures[name], truth_m)
            maps[name] = depth, np.where(inside, np.float32(0), truth_m), moving & ~inside
        return maps

    def scores(self, seen: SeenCloud, visible: bool) -> dict[str, Any] | None:
        """Return the scores of each map made without the key sweep, None if no points remain.

        Besides `depth_metrics.depth_scores` each has the ``curve`` of precision over density,
        ``reliability``, and the share ``unjudged`` of filled pixels without a return of the key
        sweep within a ray spacing.
        """
        scores: dict[str, Any] = {}
        for name, (depth, truth_m, moving) in self.maps(seen, visible).items():
            camera = self.views.exposures[name].camera
            depth = with_max_outliers(depth, self.views.settings.max_outliers)
            scores[name] = {
                **depth_metrics.depth_scores(depth, truth_m, moving, camera),
                "curve": depth_metrics.precision_density(depth, truth_m, camera),
                "reliability": reliability(depth, truth_m, camera),
                "unjudged": self._unjudged(name, depth, seen.bodies),
            }
        return scores or None

    def _unjudged(
        self, name: str, maps: DepthMap, bodies: Mapping[int, MovingBody]
    ) -> dict[str, float | None]:
        """Return the share of a map's filled pixels without a return of the key sweep nearby."""
        away_px = ndimage.distance_transform_edt(self.key_alone[name].depth_m == 0)
        unjudged = away_px > self.gap_rad * self.views.exposures[name].camera.focal_px
        filled = maps.filled_m > 0
        moving = fronts(bodies.values(), self.views.exposures[name]) > 0
        masks = {"all": filled, "moving": filled & moving, "static": filled & ~moving}
        return {n: float(unjudged[p].mean()) if p.any() else None for n, p in masks.items()}
