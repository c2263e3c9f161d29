# SPDX-License-Identifier: MIT
"""The results of one key: what the cameras see of each method's cloud, and how good that is."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.completion import completed
from densify.config import Config
from densify.costs import Watch
from densify.depth.age import with_ages
from densify.depth.confidence import expected_outliers, reliability
from densify.depth.exposure import Shot
from densify.depth.views import HeldOut, SeenCloud, Views
from densify.geometry.range_image import RangeImage
from densify.kernels.threads import num_threads
from densify.methods import METHODS
from densify.recording import Beyond, Moment
from densify.scores import depth_metrics
from densify.scores import ghosts as scores
from densify.scores.radial_velocity import radial_velocity_scores
from densify.types import (
    Bool,
    Cloud,
    DepthMap,
    Float32,
    LidarSequence,
    Prior,
    Result,
    Stretch,
)

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Key:
    """One key of a recording, without what its methods make of it.

    stretch: its window. shots: what its maps show; images: of those that are images. with_images:
    the cloud takes the images' colours, and depth is compared with the truth where there is some.
    """

    sequence: LidarSequence
    settings: Config
    frame: int
    stretch: Stretch
    shots: Mapping[str, Shot]
    images: Mapping[str, Image]
    with_images: bool
    watch: Watch


def key_results(
    key: Key,
    moments: Mapping[str, Moment],
    beyond: Beyond | None,
    priors: Mapping[str, Prior],
) -> dict[str, Result]:
    """Results by method, each with those before it as its baselines, made side by side on as many
    cores as there are.

    moments: by method. beyond: None where nothing is known or wanted. priors: by map, they complete
    the maps of the last of the methods.
    """
    shared = _Shared.of(key, moments, beyond)
    with ThreadPoolExecutor(num_threads()) as pool:
        made = list(pool.map(lambda name: shared.result(name, moments[name]), moments))
    if priors and made:
        cameras, settings = key.sequence.cameras, key.settings.prior
        with key.watch.stage("prior"):
            made[-1] = completed(made[-1], priors, shared.truth, cameras, settings)
    results: dict[str, Result] = {}
    for result in made:
        linked = replace(result, costs=key.watch.costs(), baselines=dict(results))
        results[result.method] = linked
    return results


@dataclass(frozen=True)
class _Shared:
    """What all methods of a key have in common.

    key_image: what the key sweep saw. far: what sweeps beyond the window measured, with and without
    visibility. truth: depth and what moves, by map.
    """

    key: Key
    key_image: RangeImage
    views: Views
    held_out: HeldOut
    truth: Mapping[str, tuple[Float32, Bool]]
    beyond: Beyond | None
    far: Mapping[bool, SeenCloud]

    @staticmethod
    def of(key: Key, moments: Mapping[str, Moment], beyond: Beyond | None) -> _Shared:
        sequence, stretch, watch = key.sequence, key.stretch, key.watch
        key_image = RangeImage.of(stretch[key.frame])
        views = Views.of(
            sequence, stretch, key.frame, key_image, key.shots, key.images, key.settings
        )
        truth = {}
        if key.with_images and sequence.truth is not None:
            truth = views.truth(sequence.truth)
        with watch.stage("held out"):
            held_out = HeldOut.of(views, moments[[*moments][-1]].cloud)
        far = {}
        if beyond is not None:
            with watch.stage("far"):
                for visible in {METHODS[name].visible for name in moments if METHODS[name].far}:
                    far[visible] = views.far(*beyond, stretch, standing_only=visible)
        return _Shared(key, key_image, views, held_out, truth, beyond, far)

    def result(self, name: str, moment: Moment) -> Result:
        """One method's, without its baselines."""
        method, key, views = METHODS[name], self.key, self.views
        output, watch = key.settings.output, key.watch
        visible = method.visible and key.settings.project.visibility
        far = self.far.get(method.visible) if method.far else None
        with watch.stage("project"):
            seen = views.see(moment.cloud, visible).joined(far)
        with watch.stage("held out"):
            held_out = self.held_out.scores(seen, visible)
        with watch.stage("project"):
            movers, images = {}, key.images if key.with_images else {}
            if output.movers == "separate":
                movers = views.movers(moment.cloud, visible, images)
            if output.movers != "keep":
                standing = moment.cloud.select(~moment.cloud.moving)
                seen = views.see(standing, visible).joined(far)
            depth = self._depth(seen, visible)
        cloud = seen.cloud
        if key.with_images:
            with watch.stage("colour"):
                cloud = views.coloured(seen, depth, images)
        with watch.stage("score"):
            metrics = self._metrics(cloud, depth, visible, held_out)
        result = Result(
            method=name,
            key=key.frame,
            frames=key.stretch.frames if method.all_sweeps else (key.frame,),
            cloud=cloud,
            depth=depth,
            metrics=metrics,
            flow=moment.flow,
            tracks=moment.tracks,
            movers=movers,
            optical_flow=views.optical_flow(cloud, depth) if output.optical_flow else {},
            rejected=views.rejected(cloud, depth) if output.rejected else {},
            images=images,
            stamp_ns=key.stretch[key.frame].sweep.stamp_ns,
            views=views.cameras(),
            truth_m={name: true_m for name, (true_m, _) in self.truth.items()},
            T_key_lidar={f: key.stretch.T_target_source(key.frame, f) for f in key.stretch.frames},
        )
        if far is None or self.beyond is None:
            return result
        return replace(
            result,
            far_frames=tuple(np.unique(far.cloud.frame).tolist()),
            far_links=self.beyond.standing.links,
            far_left_out=self.beyond.standing.left_out,
        )

    def _depth(self, seen: SeenCloud, visible: bool) -> dict[str, DepthMap]:
        frame, views = self.key.frame, self.views
        stamps_ns = {s.frame: s.sweep.stamp_ns for s in self.key.stretch.sweeps}
        if self.beyond is not None:
            stamps_ns |= self.beyond.standing.stamps_ns
        return {
            name: with_ages(maps, stamps_ns, frame, views.exposures[name].late_s)
            for name, maps in views.depth(seen, visible).items()
        }

    def _metrics(
        self,
        cloud: Cloud,
        depth: Mapping[str, DepthMap],
        visible: bool,
        held_out: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        """What can be said of the result without truth, and against it where there is some."""
        cameras, near = self.key.sequence.cameras, cloud.select(~cloud.far)
        metrics: dict[str, Any] = {
            "num_points": len(cloud),
            "num_moving": int(cloud.moving.sum()),
            "density": {
                name: {
                    "measured": depth_metrics.image_density(maps.depth_m),
                    "filled": depth_metrics.image_density(maps.filled_m),
                }
                for name, maps in depth.items()
            },
            "ghosts": scores.ghost_scores(near, self.key_image, self.key.frame),
        }
        radial = radial_velocity_scores(near, self.key.stretch[self.key.frame])
        if radial is not None:
            metrics["radial_velocity"] = radial
        if self.truth:
            metrics["depth"] = {
                name: depth_metrics.depth_scores(depth[name], *true, cameras[depth[name].camera])
                for name, true in self.truth.items()
            }
            metrics["reliability"] = {
                name: reliability(depth[name], true_m, cameras[depth[name].camera])
                for name, (true_m, _) in self.truth.items()
            }
        if visible:
            metrics["expected_outliers"] = {n: expected_outliers(m) for n, m in depth.items()}
        metrics["measure"] = {name: maps.measure for name, maps in depth.items()}
        metrics["held_out"] = held_out
        if self.key.settings.output.rejected:
            metrics["rejected"] = {name: maps.counts() for name, maps in depth.items()}
        return metrics
