# SPDX-License-Identifier: MIT
"""The pipeline, as a story: read, register, deskew, ground, flow, accumulate, project."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, RegisterSettings, resolve
from densify.depth.accumulate import accumulate
from densify.depth.age import with_ages
from densify.depth.views import HeldOut, Views
from densify.errors import InputError
from densify.flow.engines import check_engine, estimate_motion
from densify.flow.scene import Scene
from densify.geometry.ground import ground
from densify.geometry.height_map import HeightMap
from densify.geometry.range_image import RangeImage
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from densify.registration.deskew import deskew
from densify.registration.odometry import check_overlap, check_plausible, register
from densify.scores import depth_metrics
from densify.scores import ghosts as scores
from densify.types import (
    Camera,
    Cloud,
    DepthMap,
    FlowField,
    LidarSequence,
    Motion,
    Progress,
    RegisteredSweep,
    Result,
    StageCost,
    Stretch,
    StretchFlow,
    Sweep,
    Trajectory,
    Truth,
)

Image = NDArray[np.uint8]


class Method(NamedTuple):
    """What is accumulated. all_sweeps: else the key sweep alone. engine: which flow, see
    ``flow.engine``; None for none, "" for the configured one. visible: what is hidden, vetoed or
    doubtful is left out, else each pixel shows its nearest point."""

    all_sweeps: bool
    engine: str | None
    visible: bool


METHODS = {
    "none": Method(False, None, False),
    "icp": Method(True, None, False),
    "icp-visible": Method(True, None, True),
    "flow-plain": Method(True, "", False),
    "paper": Method(True, "paper", True),
    "flow": Method(True, "", True),
}
"""For `compare`: the key sweep alone; registration alone, as it is and with visibility; our scene
flow without visibility; the published scene flow; ours. `run` takes none, icp and flow."""

RUN = ("none", "icp", "flow")
"""What `run` takes, each with those before it as its baselines."""
COMPARED = ("none", "icp", "paper", "flow")
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
) -> Result:
    """Densify one key.

    key: absolute frame number. window: sweeps on each side of it; cut at the ends of the recording,
    with a warning. method: none, icp or flow, see `METHODS`. cameras: names, all if None. config:
    what `densify.config.resolve` takes. progress: called with (stage, done, total).

    The result carries its baselines. Raises InputError for what cannot be used, ComputationError
    where registration went wrong.
    """
    if method not in RUN:
        raise InputError(f"--method {method}: expected one of {', '.join(RUN)}")
    methods = RUN[: RUN.index(method) + 1]
    return compare(sequence, key, window, cameras, config, progress, methods)[method]


def compare(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    methods: Sequence[str] = COMPARED,
) -> dict[str, Result]:
    """Methods by name on the same registration, each with those before it as its baselines.

    methods: some of `METHODS`. The rest as `run`.
    """
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    settings = resolve(config)
    check_engine(settings.flow.engine)
    chosen = choose_cameras(sequence, cameras)
    frames, lead_in = window_frames(sequence, key, window, settings.register.num_lead_in)
    watch = Watch(progress)

    with watch.stage("images"):
        images = {camera.name: sequence.image(camera.name, key) for camera in chosen}
    stretch = _registered(sequence, lead_in, frames, settings, watch)
    with watch.stage("ground"):
        heights = ground(stretch, settings.ground)

    def motion(engine: str) -> Motion:
        return motion_by(engine, stretch, heights, settings)

    moments = {name: _key_moment(stretch, key, name, motion, settings, watch) for name in methods}
    return _results(sequence, stretch, key, moments, chosen, images, settings, watch)


def densify(
    sequence: LidarSequence,
    stretch: Stretch,
    key: int,
    motion: Callable[[], Motion],
    cameras: Sequence[str] | None,
    settings: Config,
    methods: Sequence[str],
    images: Mapping[str, Image] | None = None,
) -> dict[str, Result]:
    """Methods by name for one key whose stretch is registered and whose motion is known.

    motion: gives that of at least the stretch. methods: of `METHODS`, none with an engine of its
    own. images: by camera; without them nothing is coloured, nor compared with the truth. The rest
    as `compare`.
    """
    watch = Watch(None)
    chosen = choose_cameras(sequence, cameras)
    moments = {
        name: _key_moment(stretch, key, name, lambda _: motion(), settings, watch)
        for name in methods
    }
    return _results(sequence, stretch, key, moments, chosen, images, settings, watch)


def _results(
    sequence: LidarSequence,
    stretch: Stretch,
    key: int,
    moments: dict[str, tuple[Cloud, StretchFlow | None]],
    cameras: list[Camera],
    images: Mapping[str, Image] | None,
    settings: Config,
    watch: Watch,
) -> dict[str, Result]:
    """What the cameras see of each method's cloud, and how good that is."""
    key_image = RangeImage.of(stretch[key])
    views = Views.of(sequence, stretch, key, key_image, cameras, settings)
    truth = sequence.truth if images is not None else None
    with watch.stage("held out"):
        held_out = HeldOut.of(views, moments[next(reversed(moments))][0])
    results: dict[str, Result] = {}
    for name, (cloud, flow) in moments.items():
        visible = METHODS[name].visible and settings.project.visibility
        used = stretch.frames if METHODS[name].all_sweeps else (key,)
        with watch.stage("held out"):
            held_out_scores = held_out.scores(cloud, visible)
        movers = {}
        if settings.output.movers == "separate":
            with watch.stage("project"):
                movers = views.movers(cloud, visible, images or {})
        if settings.output.movers != "keep":
            cloud = cloud.select(~cloud.moving)
        with watch.stage("project"):
            depth = views.depth(cloud, visible)
            depth = {
                n: with_ages(m, stretch, key, views.exposures[n].late_s) for n, m in depth.items()
            }
        if images is not None:
            with watch.stage("colour"):
                cloud = views.coloured(cloud, depth, images)
        with watch.stage("score"):
            metrics = _scores(truth, sequence.cameras, stretch[key], key_image, cloud, depth)
            metrics["held_out"] = held_out_scores
            if settings.output.rejected:
                metrics["rejected"] = {n: maps.counts() for n, maps in depth.items()}
        results[name] = Result(
            *(name, key, used, cloud, depth, metrics),
            costs=watch.costs(),
            baselines=dict(results),
            flow=flow,
            movers=movers,
            optical_flow=views.optical_flow(cloud, depth) if settings.output.optical_flow else {},
            rejected=views.rejected(cloud, depth) if settings.output.rejected else {},
        )
    return results


def _registered(
    sequence: LidarSequence,
    lead_in: Sequence[int],
    frames: Sequence[int],
    settings: Config,
    watch: Watch,
) -> Stretch:
    sweeps = _read(sequence, [*lead_in, *frames], settings, watch)
    with watch.stage("register"):
        trajectory = find_trajectory(sequence, sweeps, settings.register)
    with watch.stage("deskew"):
        return deskew([s for s in sweeps if s.frame in frames], trajectory)


def _read(
    sequence: LidarSequence, frames: Sequence[int], settings: Config, watch: Watch
) -> list[Sweep]:
    with watch.stage("read"):
        sweeps = []
        for sweep in read_sweeps(sequence, frames, settings.register):
            sweeps.append(sweep)
            watch.step("read", len(sweeps), len(frames))
    return sweeps


def find_trajectory(
    sequence: LidarSequence, sweeps: Sequence[Sweep], settings: RegisterSettings
) -> Trajectory:
    """Where the lidar was: the recording's own poses, or registration in two passes, whose first
    finds the motion that bends raw sweeps.

    sweeps: raw, consecutive frames ascending. settings: its ``source`` decides.
    Raises ComputationError naming the frames where the poses cannot be right.
    """
    if settings.source == "dataset":
        trajectory = recorded_trajectory(sequence, sweeps)
        check_plausible(trajectory, settings)
        check_overlap(sweeps, trajectory, settings)
        return trajectory
    rough = register(sweeps, settings)
    straight = [s.sweep for s in deskew(sweeps, rough).sweeps]
    return register(straight, settings, rough)


def _key_moment(
    stretch: Stretch,
    key: int,
    name: str,
    motion_of: Callable[[str], Motion],
    settings: Config,
    watch: Watch,
) -> tuple[Cloud, StretchFlow | None]:
    """All sweeps at the key's moment as a method places them, and its flow where asked for.

    motion_of: by engine.
    """
    method, flow = METHODS[name], None
    used = stretch if method.all_sweeps else Stretch((stretch[key],))
    fields = [FlowField.zero(len(s.sweep)) for s in used.sweeps]
    if method.engine is not None:
        with watch.stage("flow"):
            motion = motion_of(method.engine or settings.flow.engine)
            fields = [motion.flow(frame, key) for frame in stretch.frames]
            if settings.output.flow:
                flow = _steps(motion, stretch, key)
    with watch.stage("accumulate"):
        drop_lost = settings.accumulate.unfollowed == "drop"
        return accumulate(used, fields, key, drop_lost), flow


def motion_by(engine: str, stretch: Stretch, heights: HeightMap, settings: Config) -> Motion:
    """How everything in a stretch moves, by that engine."""
    return estimate_motion(Scene(stretch, heights, settings.flow.min_height_m), settings, engine)


def _steps(motion: Motion, stretch: Stretch, key: int) -> StretchFlow:
    """Flow of every sweep to the next one on the way to the key, and of the key to a neighbour."""
    before = [f for f in stretch.frames if f <= key]
    after = [f for f in reversed(stretch.frames) if f >= key]
    own = [(key, key + 1 if key + 1 in stretch.frames else key - 1)] if stretch.frames[1:] else []
    hops = [*pairwise(before), *pairwise(after), *own]
    return StretchFlow(stretch, {hop: motion.flow(*hop) for hop in hops})


def _scores(
    truth: Truth | None,
    cameras: Mapping[str, Camera],
    key_sweep: RegisteredSweep,
    key_image: RangeImage,
    cloud: Cloud,
    depth: Mapping[str, DepthMap],
) -> dict[str, Any]:
    """What can be said of the result without truth, and against the truth where there is some."""
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
        "ghosts": scores.ghost_scores(cloud, key_image, key_sweep.frame),
    }
    if truth is not None:
        metrics["depth"] = {
            name: depth_metrics.depth_scores(
                maps,
                truth.depth_m(name, key_sweep.frame),
                truth.moving_mask(name, key_sweep.frame),
                cameras[name],
            )
            for name, maps in depth.items()
        }
    return metrics


class Watch:
    """Says which stage is at work, and what each has cost."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._peak_mb: dict[str, float] = {}

    def step(self, name: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(name, done, total)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.step(name, 0, 1)
        start = time.perf_counter()
        yield
        self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start
        self._peak_mb[name] = _peak_memory_mb()
        self.step(name, 1, 1)

    def costs(self) -> tuple[StageCost, ...]:
        """So far; a stage that worked for several methods is counted once, in sum."""
        return tuple(StageCost(n, s, self._peak_mb[n]) for n, s in self._seconds.items())


def _peak_memory_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
