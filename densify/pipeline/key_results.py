# SPDX-License-Identifier: MIT
"""The results of one key: what the cameras see of each method's cloud, and how good that is."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.depth.confidence import expected_outliers, reliability
from densify.depth.exposure import Shot
from densify.depth.views import HeldOut, SeenCloud, Views, with_ages
from densify.free_space.range_image import RangeImage
from densify.geometry.types import (
    Bool,
    Cloud,
    DepthMap,
    Float32,
    LidarSequence,
    Prior,
    Result,
    Stretch,
)
from densify.pipeline.completion import completed
from densify.pipeline.costs import Watch
from densify.pipeline.methods import METHODS
from densify.pipeline.recording import Beyond, Moment
from densify.scores import depth_metrics
from densify.scores.cloud_scores import ghost_scores, radial_velocity_scores

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
    moments: Mapping[str, Future[Moment]],
    beyond: Future[Beyond | None],
    priors: Mapping[str, Prior],
    pool: Executor,
) -> dict[str, Result]:
    """Results by method, each with those before it as its baselines.

    moments: by method. beyond: None where nothing is known or wanted. Both, and what is made of
    them here, are tasks of the ``pool``; those that need no flow go first, beside it. priors: by
    map, they complete the maps of the last of the methods.
    """
    shared, last = _Shared.of(key), [*moments][-1]
    far = {
        visible: pool.submit(shared.far, beyond, visible)
        for visible in {METHODS[name].visible for name in moments if METHODS[name].far}
    }
    flow_last = sorted(moments, key=lambda name: METHODS[name].engine is not None)
    seen = {name: pool.submit(shared.seen, name, moments[name], far) for name in flow_last}
    held_out = pool.submit(shared.held_out, moments[last])
    shown, scored = {}, {}
    for name in flow_last:
        shown[name] = pool.submit(shared.shown, name, moments[name], seen[name], beyond)
        scored[name] = pool.submit(shared.held_out_scores, seen[name], held_out)
    made = [
        replace(result, metrics={**result.metrics, "held_out": scored[name].result()})
        for name, result in ((name, shown[name].result()) for name in moments)
    ]
    if priors:
        cameras, kind = key.sequence.cameras, key.settings.prior.kind
        with key.watch.stage("prior"):
            made[-1] = completed(made[-1], priors, shared.truth, cameras, kind)
    results: dict[str, Result] = {}
    for result in made:
        linked = replace(result, costs=key.watch.costs(), baselines=dict(results))
        results[result.method] = linked
    return results


class _Seen(NamedTuple):
    """A method's cloud as the cameras see it. far: the part of it from beyond the window. visible:
    what is hidden, vetoed or doubtful is left out of its maps."""

    everything: SeenCloud
    far: SeenCloud | None
    visible: bool


@dataclass(frozen=True)
class _Shared:
    """What all methods of a key have in common.

    key_image: what the key sweep saw. truth: depth and what moves, by map.
    """

    key: Key
    key_image: RangeImage
    views: Views
    truth: Mapping[str, tuple[Float32, Bool]]

    @staticmethod
    def of(key: Key) -> _Shared:
        sequence, stretch = key.sequence, key.stretch
        key_image = RangeImage.of(stretch[key.frame])
        views = Views.of(
            sequence, stretch, key.frame, key_image, key.shots, key.images, key.settings
        )
        truth = {}
        if key.with_images and sequence.truth is not None:
            truth = views.truth(sequence.truth)
        return _Shared(key, key_image, views, truth)

    def far(self, beyond: Future[Beyond | None], visible: bool) -> SeenCloud | None:
        """What sweeps beyond the window measured."""
        found = beyond.result()
        if found is None:
            return None
        with self.key.watch.stage("far"):
            return self.views.far(*found, self.key.stretch, standing_only=visible)

    def held_out(self, moment: Future[Moment]) -> HeldOut:
        """moment: says what moves in the key sweep."""
        cloud = moment.result().cloud
        with self.key.watch.stage("held out"):
            return HeldOut.of(self.views, cloud)

    def seen(
        self,
        name: str,
        of_method: Future[Moment],
        far: Mapping[bool, Future[SeenCloud | None]],
    ) -> _Seen:
        """One method's cloud."""
        method, cloud = METHODS[name], of_method.result().cloud
        visible = method.visible and self.key.settings.project.visibility
        beside = far[method.visible].result() if method.far else None
        with self.key.watch.stage("project"):
            return _Seen(self.views.see(cloud, visible).joined(beside), beside, visible)

    def held_out_scores(
        self, of_method: Future[_Seen], held_out: Future[HeldOut]
    ) -> dict[str, Any] | None:
        """The score of what is made without the key sweep."""
        seen, alone = of_method.result(), held_out.result()
        with self.key.watch.stage("held out"):
            return alone.scores(seen.everything, seen.visible)

    def shown(
        self,
        name: str,
        of_method: Future[Moment],
        of_cloud: Future[_Seen],
        beyond: Future[Beyond | None],
    ) -> Result:
        """One method's result, without its baselines and its score with the key held out."""
        method, key, views, moment = METHODS[name], self.key, self.views, of_method.result()
        output, watch = key.settings.output, key.watch
        seen, beside, visible = of_cloud.result()
        with watch.stage("project"):
            movers, images = {}, key.images if key.with_images else {}
            if output.movers == "separate":
                movers = views.movers(moment.cloud, visible, images)
            if output.movers != "keep":
                standing = moment.cloud.select(~moment.cloud.moving)
                seen = views.see(standing, visible).joined(beside)
            depth = self._depth(seen, visible, beyond.result() if method.far else None)
        cloud = seen.cloud
        if key.with_images:
            with watch.stage("colour"):
                cloud = views.coloured(seen, depth, images)
        with watch.stage("score"):
            metrics = self._metrics(cloud, depth, visible)
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
        found = beyond.result() if beside is not None else None
        if beside is not None and found is not None:
            result = replace(
                result,
                far_frames=tuple(np.unique(beside.cloud.frame).tolist()),
                far_links=found.standing.links,
                far_left_out=found.standing.left_out,
            )
        return result

    def _depth(self, seen: SeenCloud, visible: bool, beyond: Beyond | None) -> dict[str, DepthMap]:
        frame, views = self.key.frame, self.views
        stamps_ns = {s.frame: s.sweep.stamp_ns for s in self.key.stretch.sweeps}
        if beyond is not None:
            stamps_ns |= beyond.standing.stamps_ns
        return {
            name: with_ages(maps, stamps_ns, frame, views.exposures[name].late_s)
            for name, maps in views.depth(seen, visible).items()
        }

    def _metrics(
        self, cloud: Cloud, depth: Mapping[str, DepthMap], visible: bool
    ) -> dict[str, Any]:
        """What can be said of the result without truth, and against it where there is some."""
        cameras = self.key.sequence.cameras
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
            "ghosts": ghost_scores(cloud, self.key_image, self.key.frame),
        }
        radial = radial_velocity_scores(cloud, self.key.stretch[self.key.frame])
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
        metrics["held_out"] = None  # comes later
        if self.key.settings.output.rejected:
            metrics["rejected"] = {name: maps.counts() for name, maps in depth.items()}
        return metrics
