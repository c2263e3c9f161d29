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

import numpy as np
from numpy.typing import NDArray

from densify import depth_metrics, poses, scores
from densify.config import Config, RegisterSettings, resolve
from densify.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.height_map import HeightMap
from densify.range_image import RangeImage
from densify.readers.flow_files import FlowFiles
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from densify.stages.accumulate import accumulate
from densify.stages.age import with_ages
from densify.stages.colour import colour
from densify.stages.deskew import deskew
from densify.stages.flow import estimate_motion
from densify.stages.ground import ground
from densify.stages.optical_flow import optical_flow
from densify.stages.project import project
from densify.stages.register import check_overlap, check_plausible, register
from densify.types import (
    Bool,
    Camera,
    Cloud,
    DepthMap,
    Float,
    Float32,
    FlowField,
    LidarSequence,
    Motion,
    Mover,
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
        trajectory = find_trajectory(sequence, sweeps, settings.register)
    with watch.stage("deskew"):
        stretch = deskew([s for s in sweeps if s.frame in frames], trajectory)
    engines = [METHODS[name].engine for name in methods]
    if any(engine is not None for engine in engines):
        with watch.stage("ground"):
            heights = ground(stretch, settings.ground)
    exposures = {c.name: _exposure(sequence, stretch, key, c, settings) for c in chosen}
    clouds: dict[str, Cloud] = {}
    steps: dict[str, StretchFlow] = {}
    for name, engine in zip(methods, engines, strict=True):
        used = stretch if METHODS[name].all_sweeps else Stretch((stretch[key],))
        fields = [FlowField.zero(len(s.sweep)) for s in used.sweeps]
        if engine is not None:
            with watch.stage("flow"):
                motion = _motion(stretch, heights, engine or settings.flow.engine, settings)
                fields = [motion.flow(frame, key) for frame in stretch.frames]
                if settings.output.flow:
                    steps[name] = _steps(motion, stretch, key)
        with watch.stage("accumulate"):
            drop_lost = settings.accumulate.unfollowed == "drop"
            clouds[name] = accumulate(used, fields, key, drop_lost)

    eye = _Eye(stretch, key, exposures, settings, watch)
    held_out = _HeldOut.of(eye, clouds)
    results: dict[str, Result] = {}
    for name, whole in clouds.items():
        apart = settings.output.movers != "keep"
        cloud = whole.select(~whole.moving) if apart else whole
        depth = eye.depth(cloud)
        depth = {n: with_ages(m, stretch, key, exposures[n].late_s) for n, m in depth.items()}
        with watch.stage("colour"):
            cloud = eye.coloured(cloud, depth, images)
        with watch.stage("score"):
            metrics = _scores(sequence, stretch[key], cloud, depth)
            metrics["held_out"] = held_out.scores(whole)
        results[name] = Result(
            *(name, key, tuple(np.unique(whole.frame).tolist()), cloud, depth, metrics),
            costs=watch.costs(),
            baselines=dict(results),
            flow=steps.get(name),
            movers=_movers(eye, whole, images) if settings.output.movers == "separate" else {},
            optical_flow=eye.optical_flow(cloud, depth) if settings.output.optical_flow else {},
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


def _motion(stretch: Stretch, heights: HeightMap, engine: str, settings: Config) -> Motion:
    """By the engine, or from flow that others left on disk."""
    flow = replace(settings.flow, engine=engine)
    if flow.files is None:
        return estimate_motion(stretch, heights, flow)
    return ChainedMotion(stretch, FlowFiles(flow.files, stretch).step, flow.max_gap_m)


def _steps(motion: Motion, stretch: Stretch, key: int) -> StretchFlow:
    """Flow of every sweep to the next one on the way to the key."""
    before = [f for f in stretch.frames if f <= key]
    after = [f for f in reversed(stretch.frames) if f >= key]
    hops = [*pairwise(before), *pairwise(after)]
    return StretchFlow(stretch, {hop: motion.flow(*hop) for hop in hops})


class _Exposure(NamedTuple):
    """late_s: after the key's reference time. T_cam_key: (4,4), with the ego motion until then.
    others: "previous" and "next" image, where the stretch holds their sweeps: the same of them."""

    camera: Camera
    late_s: float
    T_cam_key: Float
    others: Mapping[str, tuple[float, Float]]


def _exposure(
    sequence: LidarSequence, stretch: Stretch, key: int, camera: Camera, settings: Config
) -> _Exposure:
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
    return _Exposure(camera, *of_image(key), others)


class _Eye:
    """Every camera at its own exposure."""

    def __init__(
        self,
        stretch: Stretch,
        key: int,
        exposures: Mapping[str, _Exposure],
        settings: Config,
        watch: _Watch,
    ) -> None:
        self.key, self.exposures = key, exposures
        self._settings, self._watch = settings.project, watch
        self._origins = {f: stretch.T_target_source(key, f)[:3, 3] for f in stretch.frames}

    def depth(self, cloud: Cloud) -> dict[str, DepthMap]:
        maps = {}
        for name, (camera, late_s, T_cam_key, _) in self.exposures.items():
            with self._watch.stage("project"):
                exposed = cloud.after(late_s)
                maps[name] = project(
                    exposed, camera, T_cam_key, self._settings, self.key, self._origins
                )
        return maps

    def coloured(
        self,
        cloud: Cloud,
        depth: Mapping[str, DepthMap],
        images: Mapping[str, NDArray[np.uint8]],
    ) -> Cloud:
        rgb = cloud.rgb
        for name, (camera, late_s, T_cam_key, _) in self.exposures.items():
            points = cloud.after(late_s).points
            rgb = colour(rgb, points, camera, T_cam_key, depth[name], images[name])
        return replace(cloud, rgb=rgb)

    def optical_flow(
        self, cloud: Cloud, depth: Mapping[str, DepthMap]
    ) -> dict[str, dict[str, Float32]]:
        flows = {}
        for name, (camera, late_s, T_cam_key, others) in self.exposures.items():
            exposed = cloud.after(late_s)
            flows[name] = {
                other: optical_flow(
                    exposed, depth[name], camera, T_cam_key, T_other_key, other_s - late_s
                )
                for other, (other_s, T_other_key) in others.items()
            }
        return flows


def _movers(eye: _Eye, cloud: Cloud, images: Mapping[str, NDArray[np.uint8]]) -> dict[int, Mover]:
    """Every moving object by itself."""
    instances = np.unique(cloud.instance[cloud.moving & (cloud.instance >= 0)])
    movers = {}
    for instance in instances.tolist():
        part = cloud.select(cloud.moving & (cloud.instance == instance))
        depth = eye.depth(part)
        movers[instance] = Mover(eye.coloured(part, depth, images), depth)
    return movers


class _HeldOut:
    """The key sweep's own returns as the truth for the key densified from its neighbours alone."""

    def __init__(
        self, eye: _Eye, key_alone: Mapping[str, DepthMap], moving: Mapping[str, Bool]
    ) -> None:
        self._eye, self._key_alone, self._moving = eye, key_alone, moving

    @staticmethod
    def of(eye: _Eye, clouds: Mapping[str, Cloud]) -> _HeldOut:
        """What moves in the key sweep the last method says."""
        last = list(clouds.values())[-1]
        own = last.select(last.frame == eye.key)
        key_alone = eye.depth(own)
        only_movers = eye.depth(own.select(own.moving))
        moving = {
            name: (maps.depth_m > 0) & (maps.depth_m == key_alone[name].depth_m)
            for name, maps in only_movers.items()
        }
        return _HeldOut(eye, key_alone, moving)

    def scores(self, cloud: Cloud) -> dict[str, Any] | None:
        rest = cloud.select(cloud.frame != self._eye.key)
        if not len(rest):
            return None
        return {
            name: depth_metrics.depth_scores(
                maps,
                self._key_alone[name].depth_m,
                self._moving[name],
                self._eye.exposures[name].camera,
            )
            for name, maps in self._eye.depth(rest).items()
        }


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
