# SPDX-License-Identifier: MIT
"""The pipeline, as a story: read, register, deskew, ground, flow, accumulate, project."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from densify import poses, scores
from densify.config import Config, resolve
from densify.errors import InputError
from densify.range_image import RangeImage
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from densify.stages.accumulate import accumulate
from densify.stages.colour import colour
from densify.stages.deskew import deskew
from densify.stages.flow import estimate_motion
from densify.stages.ground import ground
from densify.stages.patches import patches
from densify.stages.project import project
from densify.stages.register import check_overlap, check_plausible, register
from densify.types import (
    Camera,
    Cloud,
    DepthMap,
    Float,
    FlowField,
    LidarSequence,
    Progress,
    RegisteredSweep,
    Result,
    StageCost,
    Stretch,
    Sweep,
    Trajectory,
)

METHODS = ("none", "icp", "flow")
"""The key sweep alone; registration only; registration and scene flow. Each is the baseline of the
next."""

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
    with a warning. method: one of `METHODS`. cameras: names, all if None. config: what
    `densify.config.resolve` takes. progress: called with (stage, done, total).

    The result carries its baselines. Raises InputError for what cannot be used, ComputationError
    where registration went wrong.
    """
    return compare(sequence, key, window, cameras, config, progress, upto=method)[method]


def compare(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    upto: str = "flow",
) -> dict[str, Result]:
    """`METHODS` up to ``upto`` on the same registration, the last with the others as its baselines.

    The rest as `run`.
    """
    if upto not in METHODS:
        raise InputError(f"--method {upto}: expected one of {', '.join(METHODS)}")
    settings = resolve(config)
    wanted = METHODS[: METHODS.index(upto) + 1]
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
    flow = _flow_to_key(stretch, key, settings, watch) if "flow" in wanted else ()

    key_image = RangeImage.of(stretch[key])
    results: dict[str, Result] = {}
    for method in wanted:
        used = Stretch((stretch[key],)) if method == "none" else stretch
        still = tuple(FlowField.zero(len(s.sweep)) for s in used.sweeps)
        fields = flow if method == "flow" else still
        with watch.stage("accumulate"):
            cloud = accumulate(used, fields, key, settings.accumulate.unfollowed == "drop")
        with watch.stage("patches"):
            origins = {f: stretch.T_target_source(key, f)[:3, 3] for f in used.frames}
            surface = patches(cloud, key, settings.project, origins, key_image)
        depth: dict[str, DepthMap] = {}
        for camera in chosen:
            late_s, T_cam_key = _exposure(sequence, stretch[key], camera)
            exposed = cloud.after(late_s)
            with watch.stage("project"):
                seen = project(exposed, camera, T_cam_key, settings.project, key, surface)
            with watch.stage("colour"):
                image = images[camera.name]
                rgb = colour(cloud.rgb, exposed.points, camera, T_cam_key, seen, image)
            cloud, depth[camera.name] = replace(cloud, rgb=rgb), seen
        with watch.stage("score"):
            metrics = _scores(sequence, stretch[key], key_image, cloud, depth)
        results[method] = Result(
            method, key, used.frames, cloud, depth, metrics, watch.costs(), dict(results)
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


def _flow_to_key(
    stretch: Stretch, key: int, settings: Config, watch: _Watch
) -> tuple[FlowField, ...]:
    """Of every sweep."""
    with watch.stage("ground"):
        heights = ground(stretch, settings.ground)
    with watch.stage("flow"):
        motion = estimate_motion(stretch, heights, settings.flow)
        return tuple(motion.flow(frame, key) for frame in stretch.frames)


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
    sequence: LidarSequence,
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
                "measured": scores.image_density(maps.depth_m),
                "filled": scores.image_density(maps.filled_m),
            }
            for name, maps in depth.items()
        },
        "ghosts": scores.ghost_scores(cloud, key_image, key_sweep.frame),
    }
    if sequence.truth is not None:
        metrics["depth"] = {
            name: scores.depth_scores(
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
