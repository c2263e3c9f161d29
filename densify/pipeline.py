# SPDX-License-Identifier: MIT
"""The pipeline, as a story: what is asked of a recording, for one key or for a thousand.

`densify` is the whole of it: the window of a key is registered and deskewed, everything in it is
brought to the key's moment, and each camera looks at the accumulated cloud. How the steps before
the cloud are made, once for all keys that share them, is told by `densify.recording`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.cache import Cache
from densify.completion import completed, key_priors
from densify.config import Config, resolve
from densify.costs import Watch
from densify.depth.age import with_ages
from densify.depth.confidence import expected_outliers, reliability
from densify.depth.exposure import Shot, key_shots, load_images
from densify.depth.views import HeldOut, SeenCloud, Views
from densify.doubts import with_doubts
from densify.errors import ComputationError, InputError
from densify.flow.engines import check_engine
from densify.geometry.range_image import RangeImage
from densify.kernels.threads import num_threads
from densify.readers.files import format_frames
from densify.readers.prior_files import PriorFiles
from densify.readers.window import choose_cameras
from densify.recording import Moment, Recording
from densify.scores import depth_metrics
from densify.scores import ghosts as scores
from densify.types import (
    Bool,
    Camera,
    Cloud,
    DepthMap,
    Float,
    Float32,
    LidarSequence,
    Prior,
    Progress,
    RegisteredSweep,
    Result,
    Standing,
    Stretch,
)

Image = NDArray[np.uint8]
_log = logging.getLogger("densify")


class Method(NamedTuple):
    """What is accumulated. all_sweeps: else the key sweep alone. engine: which flow, see
    ``flow.engine``; None for none, "" for the configured one. visible: what is hidden, vetoed or
    doubtful is left out, else each pixel shows its nearest point. far: with the standing world
    beyond the window (``accumulate.far_m``)."""

    all_sweeps: bool
    engine: str | None
    visible: bool
    far: bool


METHODS = {
    "none": Method(False, None, False, False),
    "icp": Method(True, None, False, False),
    "icp-far": Method(True, None, False, True),
    "icp-visible": Method(True, None, True, True),
    "flow-plain": Method(True, "", False, False),
    "paper": Method(True, "paper", True, True),
    "flow": Method(True, "", True, True),
}
"""For `compare`: the key sweep alone; registration alone, of the window and of all sweeps within
``accumulate.far_m``; with visibility; our scene flow without visibility; the published scene flow;
ours. `run` takes none, icp and flow."""

RUN = ("none", "icp", "flow")
"""What `run` takes, each with those before it as its baselines."""
COMPARED = ("none", "icp", "icp-far", "paper", "flow")
"""What `compare` shows unless told otherwise."""

ConfigLike = Config | str | Path | Mapping[str, Any] | None


def run(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    method: str = "flow",
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    prior: str | Path | None = None,
) -> Result:
    """Densify one key.

    key: absolute frame number. window: sweeps on each side of it, of those that exist; it is cut,
    with a warning, at the ends of the recording, at a hole in time of more than three usual
    periods, and at a sweep that cannot be read or registered. method: none, icp or flow, see
    `METHODS`. cameras: names, all if None. config: what `densify.config.resolve` takes. progress:
    called with (stage, done, total). prior: a folder of depth images that complete the maps where
    nothing is measured or filled, see `densify.readers.prior_files`; what is measured and filled
    does not depend on it.

    The result carries its baselines. Raises InputError for what cannot be used, ComputationError
    where registration went wrong.
    """
    methods = with_baselines(method)
    made = compare(sequence, key, window, cameras, config, progress, methods, prior=prior)
    return made[method]


def run_keys(
    sequence: LidarSequence,
    keys: Sequence[int],
    window: int = 5,
    method: str = "flow",
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    cache: Cache | None = None,
    prior: str | Path | None = None,
) -> Iterator[tuple[int, Result | ComputationError | InputError]]:
    """Densify several keys, ascending, and yield each with its result, or with what went wrong.

    Keys whose windows overlap share registration, ground and motion, which is then followed over
    all their sweeps: a key may come out a little better than by itself, and a second key near the
    first costs a fraction of it. cache: keeps what is shared on disk. The rest as `run`.

    Raises InputError at once for what no key could be made with.
    """
    settings, methods, watch = resolve(config), with_baselines(method), Watch(progress)
    _check(sequence, settings, methods, cameras)
    priors = _open_priors(prior, sequence, cameras)
    recording = Recording(sequence, settings, window, keys, cache, watch=watch)

    def results() -> Iterator[tuple[int, Result | ComputationError | InputError]]:
        for key in sorted(set(keys)):
            try:
                yield key, densify(recording, key, methods, cameras, watch, priors=priors)[method]
            except (ComputationError, InputError) as error:
                yield key, error

    return results()


def compare(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    methods: Sequence[str] = COMPARED,
    cache: Cache | None = None,
    prior: str | Path | None = None,
) -> dict[str, Result]:
    """Methods by name on the same registration, each with those before it as its baselines.

    methods: some of `METHODS`. cache: keeps what the steps before the cloud make. prior: completes
    the maps of the last of the methods. The rest as `run`.
    """
    settings, watch = resolve(config), Watch(progress)
    _check(sequence, settings, methods, cameras)
    priors = _open_priors(prior, sequence, cameras)
    recording = Recording(sequence, settings, window, [key], cache, watch=watch)
    return densify(recording, key, methods, cameras, watch, priors=priors)


def with_baselines(method: str) -> tuple[str, ...]:
    """A method of `RUN` behind the simpler ones. Raises InputError for another one."""
    if method not in RUN:
        raise InputError(f"--method {method}: expected one of {', '.join(RUN)}")
    return RUN[: RUN.index(method) + 1]


def densify(
    recording: Recording,
    key: int,
    methods: Sequence[str],
    cameras: Sequence[str] | None = None,
    watch: Watch | None = None,
    with_images: bool = True,
    priors: PriorFiles | None = None,
) -> dict[str, Result]:
    """One key of a recording by several methods, each with those before it as its baselines.

    methods: of `METHODS`. with_images: the cloud takes the images' colours, and depth is compared
    with the truth where there is some; the maps are the same either way. priors: complete the maps
    of the last of the methods. Errors as `run`.
    """
    watch, sequence, settings = watch or Watch(), recording.sequence, recording.settings
    cuts = _cuts(recording, key)
    shots = key_shots(sequence, choose_cameras(sequence, cameras), key, settings.project)
    with watch.stage("images"):
        images = load_images(sequence, shots)
    found = {} if priors is None else key_priors(priors, shots, key)
    stretch = recording.window(key)
    moments = {
        name: recording.moment(
            key, METHODS[name].all_sweeps, METHODS[name].engine, settings.output.flow
        )
        for name in methods
    }
    beyond = None
    if any(METHODS[name].far for name in methods):
        beyond = recording.standing(key)
    made = _results(
        *(sequence, stretch, key, moments, beyond, shots, images, with_images, found),
        *(settings, watch),
    )
    return with_doubts(made, sequence, stretch, shots, settings, cuts)


def _open_priors(
    place: str | Path | None, sequence: LidarSequence, cameras: Sequence[str] | None
) -> PriorFiles | None:
    if place is None:
        return None
    return PriorFiles.open(Path(place), [c.name for c in choose_cameras(sequence, cameras)])


def _cuts(recording: Recording, key: int) -> list[str]:
    """Why a key's window has fewer sweeps than asked for, a sentence each."""
    window = recording.window_frames(key)
    frames = format_frames(window.frames)
    return [f"the window is cut to frames {frames}: {cut}" for cut in window.cuts]


def _check(
    sequence: LidarSequence,
    settings: Config,
    methods: Sequence[str],
    cameras: Sequence[str] | None,
) -> None:
    """Raise InputError before anything is read."""
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    check_engine(settings.flow.engine)
    choose_cameras(sequence, cameras)


def _results(
    sequence: LidarSequence,
    stretch: Stretch,
    key: int,
    moments: dict[str, Moment],
    beyond: tuple[Standing, Float] | None,
    shots: Mapping[str, Shot],
    images: Mapping[str, Image],
    with_images: bool,
    priors: Mapping[str, Prior],
    settings: Config,
    watch: Watch,
) -> dict[str, Result]:
    """What the cameras see of each method's cloud, and how good that is; side by side on as many
    cores as there are."""
    key_image = RangeImage.of(stretch[key])
    views = Views.of(sequence, stretch, key, key_image, shots, images, settings)
    truth = {}
    if with_images and sequence.truth is not None:
        truth = views.truth(sequence.truth)
    with watch.stage("held out"):
        held_out = HeldOut.of(views, moments[next(reversed(moments))].cloud)
    pictures = images if with_images else None
    far, stamps_ns = {}, {s.frame: s.sweep.stamp_ns for s in stretch.sweeps}
    if beyond is not None:
        stamps_ns |= beyond[0].stamps_ns
        with watch.stage("far"):
            for visible in {METHODS[name].visible for name in moments if METHODS[name].far}:
                far[visible] = views.far(*beyond, stretch, standing_only=visible)
    seen = _Seen(
        *(sequence, stretch, key_image, views, far, stamps_ns, held_out, truth, pictures),
        *(settings, watch),
    )
    with ThreadPoolExecutor(num_threads()) as pool:
        made = list(pool.map(lambda name: seen.result(name, moments[name]), moments))
    if priors and made:
        with watch.stage("prior"):
            made[-1] = completed(made[-1], priors, truth, sequence.cameras, settings.prior)
    results: dict[str, Result] = {}
    for result in made:
        linked = replace(result, costs=watch.costs(), baselines=dict(results))
        if beyond is not None and METHODS[result.method].far:
            found = beyond[0]
            linked = replace(linked, far_links=found.links, far_left_out=found.left_out)
        results[result.method] = linked
    return results


class _Seen(NamedTuple):
    """What all methods of a key have in common. far: what sweeps beyond the window measured, for
    methods with and without visibility. stamps_ns: of all sweeps, by frame."""

    sequence: LidarSequence
    stretch: Stretch
    key_image: RangeImage
    views: Views
    far: Mapping[bool, SeenCloud]
    stamps_ns: Mapping[int, int]
    held_out: HeldOut
    truth: Mapping[str, tuple[Float32, Bool]]
    images: Mapping[str, Image] | None
    settings: Config
    watch: Watch

    def result(self, method: str, moment: Moment) -> Result:
        """One method's, without its baselines."""
        cloud = moment.cloud
        views, watch, output, key = self.views, self.watch, self.settings.output, self.views.key
        images, visible = self.images or {}, METHODS[method].visible
        visible = visible and self.settings.project.visibility
        far = self.far.get(METHODS[method].visible) if METHODS[method].far else None
        with watch.stage("project"):
            seen = views.see(cloud).joined(far)
        with watch.stage("held out"):
            held_out_scores = self.held_out.scores(seen, visible)
        movers = {}
        if output.movers == "separate":
            with watch.stage("project"):
                movers = views.movers(cloud, visible, images)
        with watch.stage("project"):
            if output.movers != "keep":
                seen = views.see(cloud.select(~cloud.moving)).joined(far)
            depth = {
                name: with_ages(maps, self.stamps_ns, key, views.exposures[name].late_s)
                for name, maps in views.depth(seen, visible).items()
            }
        cloud = seen.cloud
        if self.images is not None:
            with watch.stage("colour"):
                cloud = views.coloured(seen, depth, images)
        with watch.stage("score"):
            cameras, sweep = self.sequence.cameras, self.stretch[key]
            metrics = _scores(self.truth, cameras, sweep, self.key_image, cloud, depth)
            if visible:
                metrics["expected_outliers"] = {
                    n: expected_outliers(maps) for n, maps in depth.items()
                }
            metrics["measure"] = {name: maps.measure for name, maps in depth.items()}
            metrics["held_out"] = held_out_scores
            if output.rejected:
                metrics["rejected"] = {name: maps.counts() for name, maps in depth.items()}
        return Result(
            method=method,
            key=key,
            frames=self.stretch.frames if METHODS[method].all_sweeps else (key,),
            far_frames=() if far is None else tuple(np.unique(far.cloud.frame).tolist()),
            cloud=cloud,
            depth=depth,
            metrics=metrics,
            flow=moment.flow,
            tracks=moment.tracks,
            movers=movers,
            optical_flow=views.optical_flow(cloud, depth) if output.optical_flow else {},
            rejected=views.rejected(cloud, depth) if output.rejected else {},
            images=images,
            stamp_ns=self.stretch[key].sweep.stamp_ns,
            views=views.cameras(),
            truth_m={name: true_m for name, (true_m, _) in self.truth.items()},
            T_key_lidar={f: self.stretch.T_target_source(key, f) for f in self.stretch.frames},
        )


def _scores(
    truth: Mapping[str, tuple[Float32, Bool]],
    cameras: Mapping[str, Camera],
    key_sweep: RegisteredSweep,
    key_image: RangeImage,
    cloud: Cloud,
    depth: Mapping[str, DepthMap],
) -> dict[str, Any]:
    """What can be said of the result without truth, and against the truth where there is some:
    depth and what moves, by map."""
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
        "ghosts": scores.ghost_scores(cloud.select(~cloud.far), key_image, key_sweep.frame),
    }
    if truth:
        metrics["depth"] = {
            name: depth_metrics.depth_scores(depth[name], *true, cameras[depth[name].camera])
            for name, true in truth.items()
        }
        metrics["reliability"] = {
            name: reliability(depth[name], true_m, cameras[depth[name].camera])
            for name, (true_m, _) in truth.items()
        }
    return metrics
