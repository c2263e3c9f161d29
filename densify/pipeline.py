# SPDX-License-Identifier: MIT
"""The pipeline, as a story: read, register, deskew, ground, flow, accumulate, project."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from densify import depth_metrics, poses, scores
from densify.config import Config, resolve
from densify.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.height_map import HeightMap
from densify.range_image import RangeImage
from densify.readers.flow_files import FlowFiles
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from densify.stages.accumulate import accumulate
from densify.stages.colour import colour
from densify.stages.deskew import deskew
from densify.stages.flow import estimate_motion
from densify.stages.ground import ground
from densify.stages.project import project
from densify.stages.register import check_overlap, check_plausible, register
from densify.types import (
    Camera,
    Cloud,
    DepthMap,
    Float,
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
)


class Method(NamedTuple):
    """What is accumulated. all_sweeps: else the key sweep alone. engine: which flow, see
    ``flow.engine``; None for none, "" for the configured one."""

    all_sweeps: bool
    engine: str | None
    about: str


METHODS = {
    "none": Method(False, None, "the key sweep alone"),
    "icp": Method(True, None, "registration only"),
    "paper": Method(True, "paper", "registration and the published scene flow"),
    "flow": Method(True, "", "registration and our scene flow"),
}
"""For `compare`. `run` takes all but ``paper``; each but the first is the baseline of the next."""

_RUN = ("none", "icp", "flow")

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
    if method not in _RUN:
        raise InputError(f"--method {method}: expected one of {', '.join(_RUN)}")
    methods = _RUN[: _RUN.index(method) + 1]
    return compare(sequence, key, window, cameras, config, progress, methods)[method]


def compare(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    methods: Sequence[str] = tuple(METHODS),
) -> dict[str, Result]:
    """Methods by name on the same registration, each with those before it as its baselines.

    methods: some of `METHODS`. The rest as `run`.
    """
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    settings = resolve(config)
    chosen = choose_cameras(sequence, cameras)
    frames, lead_in = window_frames(sequence, key, window, settings.register.num_lead_in)
    watch = _Watch(progress)

    sweeps = _read(sequence, [*lead_in, *frames], settings, watch)
    with watch.stage("images"):
        images = {camera.name: sequence.image(camera.name, key) for camera in chosen}
    with watch.stage("register"):
        trajectory = _trajectory(sequence, sweeps, settings)
    with watch.stage("deskew"):
        stretch = deskew([s for s in sweeps if s.frame in frames], trajectory)
    engines = [METHODS[name].engine for name in methods]
    if any(engine is not None for engine in engines):
        with watch.stage("ground"):
            heights = ground(stretch, settings.ground)

    results: dict[str, Result] = {}
    for name, engine in zip(methods, engines, strict=True):
        used = stretch if METHODS[name].all_sweeps else Stretch((stretch[key],))
        fields = [FlowField.zero(len(s.sweep)) for s in used.sweeps]
        steps: dict[tuple[int, int], FlowField] = {}
        if engine is not None:
            with watch.stage("flow"):
                motion = _motion(stretch, heights, engine or settings.flow.engine, settings)
                fields = [motion.flow(frame, key) for frame in stretch.frames]
                if settings.output.flow:
                    hops = _hops_to(key, stretch.frames)
                    steps = {hop: motion.flow(*hop) for hop in hops}
        with watch.stage("accumulate"):
            cloud = accumulate(used, fields, key, settings.accumulate.unfollowed == "drop")
        origins = {f: stretch.T_target_source(key, f)[:3, 3] for f in used.frames}
        depth: dict[str, DepthMap] = {}
        for camera in chosen:
            late_s, T_cam_key = _exposure(sequence, stretch[key], camera)
            exposed = cloud.after(late_s)
            with watch.stage("project"):
                seen = project(exposed, camera, T_cam_key, settings.project, key, origins)
            with watch.stage("colour"):
                image = images[camera.name]
                rgb = colour(cloud.rgb, exposed.points, camera, T_cam_key, seen, image)
            cloud, depth[camera.name] = replace(cloud, rgb=rgb), seen
        with watch.stage("score"):
            metrics = _scores(sequence, stretch[key], cloud, depth)
        results[name] = Result(
            *(name, key, used.frames, cloud, depth, metrics, watch.costs(), dict(results)),
            flow=StretchFlow(stretch, steps) if steps else None,
        )
    return results


def _read(
    sequence: LidarSequence, frames: Sequence[int], settings: Config, watch: _Watch
) -> list[Sweep]:
    with watch.stage("read"):
        sweeps = []
        for sweep in read_sweeps(sequence, frames, settings.register):
            sweeps.append(sweep)
            watch.step("read", len(sweeps), len(frames))
    return sweeps


def _trajectory(sequence: LidarSequence, sweeps: Sequence[Sweep], settings: Config) -> Trajectory:
    """Poses in two passes: raw sweeps are bent by the motion that the first pass finds."""
    if settings.register.source == "dataset":
        trajectory = recorded_trajectory(sequence, sweeps)
        check_plausible(trajectory, settings.register)
        check_overlap(sweeps, trajectory, settings.register)
        return trajectory
    rough = register(sweeps, settings.register)
    straight = [s.sweep for s in deskew(sweeps, rough).sweeps]
    return register(straight, settings.register, rough)


def _motion(stretch: Stretch, heights: HeightMap, engine: str, settings: Config) -> Motion:
    """By the engine, or from flow that others left on disk."""
    flow = replace(settings.flow, engine=engine)
    if flow.files is None:
        return estimate_motion(stretch, heights, flow)
    return ChainedMotion(stretch, FlowFiles(flow.files, stretch).step, flow.max_gap_m)


def _hops_to(key: int, frames: Sequence[int]) -> list[tuple[int, int]]:
    """Of every frame to the next one on the way to the key."""
    before = [f for f in frames if f <= key]
    after = [f for f in reversed(frames) if f >= key]
    return [*pairwise(before), *pairwise(after)]


def _exposure(
    sequence: LidarSequence, key_sweep: RegisteredSweep, camera: Camera
) -> tuple[float, Float]:
    """Seconds from the key's reference time to the exposure, and (4,4) T_cam_key with the ego
    motion until then."""
    stamp_ns = sequence.image_stamp_ns(camera.name, key_sweep.frame)
    late_s = (stamp_ns - key_sweep.sweep.stamp_ns) * 1e-9
    twist = key_sweep.twist_before if late_s < 0 else key_sweep.twist_after
    return late_s, camera.T_cam_lidar @ poses.inverse(poses.exp(late_s * twist))


def _scores(
    sequence: LidarSequence, key_sweep: RegisteredSweep, cloud: Cloud, depth: Mapping[str, DepthMap]
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
        "ghosts": scores.ghost_scores(cloud, RangeImage.of(key_sweep), key_sweep.frame),
    }
    if sequence.truth is not None:
        metrics["depth"] = {
            name: depth_metrics.depth_scores(
                maps,
                sequence.truth.depth_m(name, key_sweep.frame),
                sequence.truth.moving_mask(name, key_sweep.frame),
                sequence.cameras[name],
            )
            for name, maps in depth.items()
        }
    return metrics


class _Watch:
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
