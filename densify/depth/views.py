# SPDX-License-Identifier: MIT
"""The accumulated cloud as the cameras see it, each at its own exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, ProjectSettings
from densify.depth.colour import colour
from densify.depth.optical_flow import optical_flow
from densify.depth.patches import patches
from densify.depth.project import project
from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.range_image import RangeImage
from densify.scores import depth_metrics
from densify.types import (
    Bool,
    Camera,
    Cloud,
    DepthMap,
    Float,
    Float32,
    LidarSequence,
    Mover,
    Reason,
    Stretch,
)


@dataclass(frozen=True)
class Exposure:
    """late_s: after the key's reference time. T_cam_key: (4,4), with the ego motion until then.
    others: "previous" and "next" image, where the stretch holds their sweeps: the same of them."""

    camera: Camera
    late_s: float
    T_cam_key: Float
    others: Mapping[str, tuple[float, Float]]

    @staticmethod
    def of(
        sequence: LidarSequence, stretch: Stretch, key: int, camera: Camera, settings: Config
    ) -> Exposure:
        """At the image's stamp or, with ``project.at=sweep``, at the sweep's."""

        def of_image(frame: int) -> tuple[float, Float]:
            registered = stretch[frame]
            stamp_ns = sequence.image_stamp_ns(camera.name, frame)
            if settings.project.at == "sweep":
                stamp_ns = registered.sweep.stamp_ns
            late_s = (stamp_ns - registered.sweep.stamp_ns) * 1e-9
            twist = registered.twist_before if late_s < 0 else registered.twist_after
            T_cam_lidar = camera.T_cam_lidar @ poses.inverse(poses.exp(late_s * twist))
            since_key_s = (stamp_ns - stretch[key].sweep.stamp_ns) * 1e-9
            return since_key_s, T_cam_lidar @ stretch.T_target_source(frame, key)

        others = {
            name: of_image(frame)
            for name, frame in (("previous", key - 1), ("next", key + 1))
            if settings.output.optical_flow and frame in stretch.frames
        }
        return Exposure(camera, *of_image(key), others)


@dataclass(frozen=True)
class Views:
    """Every camera's exposure of one key.

    key_image: what the key sweep saw. origins: (3,) where each sweep's lidar stood, key frame, by
    frame.
    """

    key: int
    key_image: RangeImage | None
    exposures: Mapping[str, Exposure]
    origins: Mapping[int, Float]
    settings: ProjectSettings

    @staticmethod
    def of(
        sequence: LidarSequence,
        stretch: Stretch,
        key: int,
        key_image: RangeImage,
        cameras: list[Camera],
        settings: Config,
    ) -> Views:
        exposures = {c.name: Exposure.of(sequence, stretch, key, c, settings) for c in cameras}
        origins = {f: stretch.T_target_source(key, f)[:3, 3] for f in stretch.frames}
        return Views(key, key_image, exposures, origins, settings.project)

    def depth(self, cloud: Cloud, visible: bool = True, filled: bool = True) -> dict[str, DepthMap]:
        """By camera. visible: leave out what is hidden, vetoed or doubtful. filled: and fill
        between what is measured."""
        settings = replace(self.settings, visibility=visible)
        surface = patches(cloud, self.key, settings, self.origins, self.key_image)
        return {
            name: project(
                *(cloud.after(e.late_s), e.camera, e.T_cam_key, settings, surface),
                filled,
            )
            for name, e in self.exposures.items()
        }

    def coloured(
        self,
        cloud: Cloud,
        depth: Mapping[str, DepthMap],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> Cloud:
        """With the colours of the images there are; depth: what `depth` made of the cloud."""
        rgb = cloud.rgb
        for name in images:
            e = self.exposures[name]
            points = cloud.after(e.late_s).points
            rgb = colour(rgb, points, e.camera, e.T_cam_key, depth[name], images[name])
        return replace(cloud, rgb=rgb)

    def optical_flow(
        self, cloud: Cloud, depth: Mapping[str, DepthMap]
    ) -> dict[str, dict[str, Float32]]:
        """Camera -> "previous" and "next" image -> (H,W,2) pixels."""
        return {
            name: {
                other: optical_flow(
                    cloud.after(e.late_s),
                    depth[name],
                    e.camera,
                    e.T_cam_key,
                    T_other_key,
                    other_s - e.late_s,
                )
                for other, (other_s, T_other_key) in e.others.items()
            }
            for name, e in self.exposures.items()
        }

    def rejected(self, cloud: Cloud, depth: Mapping[str, DepthMap]) -> dict[str, NDArray[np.uint8]]:
        """Camera -> (H,W): the `Reason` why the nearest point that was left out of a pixel was,
        0 where none was; points that another one outdid in their pixel do not count."""
        maps = {}
        for name, e in self.exposures.items():
            reason = depth[name].reason
            left_out = np.isin(
                reason, [Reason.VETOED, Reason.HIDDEN, Reason.UNSUPPORTED, Reason.EDGE]
            )
            points_cam = poses.transform(e.T_cam_key, cloud.after(e.late_s).points[left_out])
            uv, inside = image_points(e.camera, points_cam)
            farthest_first = np.argsort(-points_cam[inside, 2], kind="stable")
            column, row = np.rint(uv[inside][farthest_first]).astype(np.int64).T
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
            part = cloud.select(cloud.moving & (cloud.instance == instance))
            depth = self.depth(part, visible)
            movers[instance] = Mover(self.coloured(part, depth, images), depth)
        return movers


@dataclass(frozen=True)
class HeldOut:
    """The key sweep's own returns as the truth for the key densified from its neighbours alone.

    key_alone: maps of the key sweep. moving: (H,W) where its returns are something's that moves.
    """

    views: Views
    key_alone: Mapping[str, DepthMap]
    moving: Mapping[str, Bool]

    @staticmethod
    def of(views: Views, cloud: Cloud) -> HeldOut:
        """cloud: says what moves in the key sweep, and how fast."""
        views = replace(views, key_image=None)  # what is held out must not help
        own = cloud.select(cloud.frame == views.key)
        key_alone = views.depth(own, filled=False)
        movers = views.depth(own.select(own.moving), filled=False)
        moving = {
            name: (maps.depth_m > 0) & (maps.depth_m == key_alone[name].depth_m)
            for name, maps in movers.items()
        }
        return HeldOut(views, key_alone, moving)

    def scores(self, cloud: Cloud, visible: bool) -> dict[str, Any] | None:
        """By camera, as `densify.scores.depth_metrics.depth_scores`, and the ``curve`` of
        precision over density; None for a cloud of the key sweep alone."""
        rest = cloud.select(cloud.frame != self.views.key)
        if not len(rest):
            return None
        scores: dict[str, Any] = {}
        for name, maps in self.views.depth(rest, visible).items():
            truth_m, camera = self.key_alone[name].depth_m, self.views.exposures[name].camera
            scores[name] = {
                **depth_metrics.depth_scores(maps, truth_m, self.moving[name], camera),
                "curve": depth_metrics.precision_density(maps, truth_m, camera),
            }
        return scores
