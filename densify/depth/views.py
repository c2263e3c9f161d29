# SPDX-License-Identifier: MIT
"""The accumulated cloud as the cameras see it, each at its own exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, ProjectSettings
from densify.depth.colour import colour
from densify.depth.confidence import reliability
from densify.depth.exposure import Exposure, InView, Shot
from densify.depth.far import far_cloud
from densify.depth.free_space import Rays
from densify.depth.optical_flow import optical_flow
from densify.depth.patches import Tangents, patches, vetoed
from densify.depth.picture import lab
from densify.depth.project import project
from densify.free_space.range_image import RangeImage
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


class SeenCloud(NamedTuple):
    """A cloud with what every map of it needs. views: by the maps' names."""

    cloud: Cloud
    patches: Patches
    views: Mapping[str, InView]

    def select(self, keep: Bool) -> SeenCloud:
        """Some of the points, each seen as before."""
        views = {name: view.select(keep) for name, view in self.views.items()}
        return SeenCloud(self.cloud.select(keep), self.patches.select(keep), views)

    def in_view(self) -> Bool:
        """(M,) the points that some map may show."""
        return _in_any(self.views, len(self.cloud))

    def joined(self, far: SeenCloud | None) -> SeenCloud:
        """The same and what sweeps beyond the window measured."""
        if far is None or not len(far.cloud):
            return self
        views = {n: view.joined(far.views[n], len(self.cloud)) for n, view in self.views.items()}
        return SeenCloud(self.cloud.joined(far.cloud), self.patches.joined(far.patches), views)


def _in_any(views: Mapping[str, InView], num_points: int) -> Bool:
    """(num_points,) the points that some map may show."""
    found = np.zeros(num_points, bool)
    for view in views.values():
        found[view.rows] = True
    return found


@dataclass(frozen=True)
class Views:
    """What one key's depth maps show, by their names (`densify.depth.exposure.key_shots`).

    key_image: what the key sweep saw. sensors: the scanners. origins: (S,3) where they stood in
    each sweep, key frame, by frame. rays: of these sweeps. lab: of those that show an
    image, see `densify.depth.picture`. tangents: of what methods share.
    """

    key: int
    key_image: RangeImage | None
    exposures: Mapping[str, Exposure]
    sensors: Sensors
    origins: Mapping[int, Float]
    rays: Rays
    settings: ProjectSettings
    lab: Mapping[str, Float32]
    tangents: Tangents = field(default_factory=Tangents)

    @staticmethod
    def of(
        sequence: LidarSequence,
        stretch: Stretch,
        key: int,
        key_image: RangeImage,
        shots: Mapping[str, Shot],
        images: Mapping[str, NDArray[np.uint8]],
        settings: Config,
    ) -> Views:
        exposures = {
            name: Exposure.of(sequence, stretch, key, shot, settings)
            for name, shot in shots.items()
        }
        sensors = Sensors.of(stretch.sweeps)
        origins = {
            f: poses.transform(stretch.T_target_source(key, f), sensors.origins_m)
            for f in stretch.frames
        }
        pictures = {name: lab(image) for name, image in images.items()}
        return Views(
            key,
            key_image,
            exposures,
            sensors,
            origins,
            Rays(stretch, key),
            settings.project,
            pictures,
        )

    def see(self, cloud: Cloud, visible: bool = True) -> SeenCloud:
        """A cloud as the cameras see it. visible: and which of it the key sweep saw through."""
        key_image = self.key_image if visible else None
        views = {name: exposure.sees(cloud) for name, exposure in self.exposures.items()}
        surface = patches(
            cloud,
            self.key,
            self.settings,
            self.sensors,
            self.origins,
            key_image,
            wanted=_in_any(views, len(cloud)),
            shared=self.tangents,
        )
        return SeenCloud(cloud, surface, views)

    def far(
        self, found: StandingWorld, T_key_found: Float, stretch: Stretch, standing_only: bool
    ) -> SeenCloud:
        """What sweeps beyond the window measured, see `densify.depth.far.far_cloud`;
        standing_only: for maps with visibility."""
        cloud, surface, views = far_cloud(
            found, T_key_found, stretch, self.key, self.exposures, standing_only
        )
        if self.key_image is not None and standing_only:
            free = vetoed(cloud.points, cloud.velocity_m_s, self.key_image, self.settings)
            surface = replace(surface, free=free)
        return SeenCloud(cloud, surface, views)

    def depth(
        self, seen: SeenCloud, visible: bool = True, filled: bool = True
    ) -> dict[str, DepthMap]:
        """Depth maps by name. visible: leave out what is hidden, vetoed or doubtful. filled: and
        fill between what is measured."""
        settings = replace(self.settings, visibility=visible)
        return {
            name: project(
                seen.cloud,
                view,
                settings,
                seen.patches,
                filled,
                self.lab.get(name),
                self.rays,
            )
            for name, view in seen.views.items()
        }

    def coloured(
        self,
        seen: SeenCloud,
        depth: Mapping[str, DepthMap],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> Cloud:
        """The cloud with the colours of the images there are; depth: what `depth` made of it."""
        cloud = seen.cloud
        for name, image in images.items():
            rgb = colour(cloud, seen.views[name], depth[name], image)
            cloud = replace(cloud, rgb=rgb)
        return cloud

    def truth(self, truth: Truth) -> dict[str, tuple[Float32, Bool]]:
        """The true depth, measured as the map's, of the maps that show an image, and (H,W) where
        something moves."""
        known = {}
        for name, e in self.exposures.items():
            if e.number is not None:
                depth_m = truth.depth_m(e.camera.name, e.number)
                depth_m = converted(e.camera, depth_m, e.camera.measure, e.measure)
                known[name] = (depth_m, truth.moving_mask(e.camera.name, e.number))
        return known

    def cameras(self) -> dict[str, CameraView]:
        """Where each map looks from."""
        return {
            name: CameraView(e.camera, e.T_cam_key, e.late_s, e.number)
            for name, e in self.exposures.items()
        }

    def optical_flow(
        self, cloud: Cloud, depth: Mapping[str, DepthMap]
    ) -> dict[str, dict[str, Float32]]:
        """Name -> "previous" and "next" image -> (H,W,2) pixels."""
        return {
            name: {
                which: optical_flow(cloud, depth[name], exposure, other)
                for which, other in exposure.others.items()
            }
            for name, exposure in self.exposures.items()
        }

    def rejected(self, cloud: Cloud, depth: Mapping[str, DepthMap]) -> dict[str, NDArray[np.uint8]]:
        """Name -> (H,W): the `Reason` why the nearest point that was left out of a pixel was,
        0 where none was; points that another one outdid in their pixel do not count."""
        maps = {}
        for name, e in self.exposures.items():
            reason = depth[name].reason
            left_out = ~np.isin(reason, [Reason.KEPT, Reason.OUTSIDE, Reason.NOT_CHOSEN])
            sight = e.see(cloud.points[left_out], cloud.velocity_m_s[left_out])
            inside = sight.inside
            farthest_first = np.argsort(-e.depth_m(sight.points_cam[inside]), kind="stable")
            column, row = np.rint(sight.uv[inside][farthest_first]).astype(np.int64).T
            maps[name] = np.zeros(depth[name].depth_m.shape, np.uint8)
            maps[name][row, column] = reason[left_out][inside][farthest_first]
        return maps

    def movers(
        self, cloud: Cloud, visible: bool, images: Mapping[str, NDArray[np.uint8]]
    ) -> dict[int, Mover]:
        """Every moving object by itself, and as -1 together what moves without one."""
        instances = np.unique(cloud.instance[cloud.moving])
        movers = {}
        for instance in instances.tolist():
            part = self.see(cloud.select(cloud.moving & (cloud.instance == instance)), visible)
            depth = self.depth(part, visible)
            movers[instance] = Mover(self.coloured(part, depth, images), depth)
        return movers


@dataclass(frozen=True)
class HeldOut:
    """The key sweep's own returns as the truth for the key densified from its neighbours alone.

    key_alone: maps of the key sweep, without rims. moving: (H,W) where its returns are something's
    that moves.
    """

    views: Views
    key_alone: Mapping[str, DepthMap]
    moving: Mapping[str, Bool]

    @staticmethod
    def of(views: Views, cloud: Cloud) -> HeldOut:
        """cloud: says what moves in the key sweep, and how fast."""
        views = replace(views, key_image=None)  # what is held out must not help
        alone = replace(views.settings, rims="strict", seen_through=1.0)
        sure = replace(views, settings=alone)
        own = cloud.select(cloud.frame == views.key)
        key_alone = sure.depth(sure.see(own), filled=False)
        movers = sure.depth(sure.see(own.select(own.moving)), filled=False)
        moving = {
            name: (maps.depth_m > 0) & (maps.depth_m == key_alone[name].depth_m)
            for name, maps in movers.items()
        }
        return HeldOut(views, key_alone, moving)

    def depth(self, seen: SeenCloud, visible: bool) -> dict[str, DepthMap]:
        """Depth maps by name without the key sweep; none for a cloud of the key sweep alone."""
        others = seen.cloud.frame != self.views.key
        if not others.any():
            return {}
        rest = seen.select(others & seen.in_view())
        rest = rest._replace(patches=replace(rest.patches, free=np.zeros(len(rest.cloud), bool)))
        return self.views.depth(rest, visible)

    def scores(self, seen: SeenCloud, visible: bool) -> dict[str, Any] | None:
        """Scores by name, as `densify.scores.depth_metrics.depth_scores`, the ``curve`` of
        precision over density, and the confidence's ``reliability``; None for a cloud of the key
        sweep alone."""
        made = self.depth(seen, visible)
        if not made:
            return None
        scores: dict[str, Any] = {}
        for name, maps in made.items():
            truth_m, camera = self.key_alone[name].depth_m, self.views.exposures[name].camera
            scores[name] = {
                **depth_metrics.depth_scores(maps, truth_m, self.moving[name], camera),
                "curve": depth_metrics.precision_density(maps, truth_m, camera),
                "reliability": reliability(maps, truth_m, camera),
            }
        return scores
