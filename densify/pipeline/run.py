# SPDX-License-Identifier: MIT
"""Run the pipeline. `densify` tells all of it, step by step, for one key."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, resolve
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError
from densify.depth.exposure import Shot, key_shots, load_images
from densify.depth.views import HeldOut, Views
from densify.flow.engines import check_engine
from densify.free_space.range_image import RangeImage
from densify.geometry.compiled import num_threads
from densify.geometry.types import Cloud, LidarSequence, Progress, Result, StretchFlow
from densify.pipeline.key_result import (
    METHODS,
    USUAL,
    KeyScene,
    complete_with_prior,
    looks_around,
    methods_of_run,
    result_of_method,
)
from densify.pipeline.process import Watch
from densify.pipeline.recording import FarSurfaces, Recording
from densify.pipeline.warnings import add_warnings
from densify.readers.prior_files import PriorFiles
from densify.readers.timeline import choose_cameras

T = TypeVar("T")
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
    """Densify the sweeps around one key sweep, and return its cloud, depth maps and scores.

    Args:
        sequence: The recording, from `densify.open_sequence`.
        key: Frame number of the key sweep.
        window: Number of sweeps on each side of the key. The window is cut, with a warning, at the
            ends of the recording, at a hole in time of more than three usual periods, and at a
            sweep that cannot be used.
        method: ``flow`` (scene flow), ``icp`` (rigid accumulation) or ``none`` (single sweep).
        cameras: Names of cameras; None for all.
        config: Settings: None for the defaults, a `Config`, a mapping ``{section: {key: value}}``,
            the name of a preset, or the path of a YAML file.
        progress: Callback (stage, done, total).
        prior: Folder of depth images that complete the pixels without measured or filled depth.

    Returns:
        The result. With ``output.score`` it also has the simpler methods as ``baselines``, and
            scores of maps made without the key sweep.

    Raises:
        InputError: An argument or a setting is invalid, or the key sweep cannot be read.
        ComputationError: The key sweep or all its neighbours cannot be registered.
    """
    results = run_keys(sequence, [key], window, method, cameras, config, progress, prior=prior)
    ((_, result),) = results  # the pair of the only key
    if isinstance(result, Exception):
        raise result
    return result


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
    """Densify several keys, and yield (key, result or error) by ascending key.

    Keys whose windows overlap share registration, ground and motion. Objects are tracked over all
    these sweeps, which can improve a key slightly over `run`. Arguments that are not listed are
    those of `run`.

    Args:
        keys: Frame numbers of the key sweeps, in any order.
        cache: Keeps registration, motion and far surfaces on disk.
    """
    methods = methods_of_run(method, resolve(config))
    watch = Watch(progress)
    recording = _open(sequence, keys, window, methods, cameras, config, cache, watch)
    priors = _open_prior(prior, sequence, cameras)

    def make(key: int) -> Result:
        return densify(recording, key, methods, cameras, watch, priors=priors)[method]

    return ((key, _or_error(make, key)) for key in sorted(set(keys)))


def compare(
    sequence: LidarSequence,
    key: int,
    window: int = 5,
    cameras: Sequence[str] | None = None,
    config: ConfigLike = None,
    progress: Progress | None = None,
    methods: Sequence[str] = USUAL,
    cache: Cache | None = None,
    prior: str | Path | None = None,
) -> dict[str, Result]:
    """Densify one key with several methods on the same registration, and score them.

    Arguments that are not listed are those of `run`.

    Args:
        methods: Some of ``none``, ``icp``, ``icp-visible``, ``icp-far``, ``flow-plain``, ``paper``
            and ``flow``.
        cache: Keeps registration, motion and far surfaces on disk.
        prior: Folder of depth images that complete the maps of the last method.

    Returns:
        Method -> result. Each result has the results before it as ``baselines``.
    """
    watch = Watch(progress)
    settings = resolve(config).scored()
    recording = _open(sequence, [key], window, methods, cameras, settings, cache, watch)
    priors = _open_prior(prior, sequence, cameras)
    return densify(recording, key, methods, cameras, watch, priors=priors)


def flow_steps(
    sequence: LidarSequence,
    frames: Sequence[int],
    config: ConfigLike = None,
    progress: Progress | None = None,
    cache: Cache | None = None,
) -> Iterator[tuple[int, StretchFlow | ComputationError | InputError]]:
    """Yield (frame, scene flow to the next sweep, or error) for sweeps of a whole recording.

    At the end of the recording and before a hole in time, the flow is to the previous sweep.
    ``frames`` ascend. ``cache`` keeps registration and motion on disk.
    """
    recording = _open(sequence, frames, 1, ["flow"], None, config, cache, None)

    def steps() -> Iterator[tuple[int, StretchFlow | ComputationError | InputError]]:
        for done, frame in enumerate(frames):
            if progress:
                progress("flow", done, len(frames))
            yield frame, _or_error(recording.step, frame)

    return steps()


def densify(
    recording: Recording,
    key: int,
    methods: Sequence[str],
    cameras: Sequence[str] | None = None,
    watch: Watch | None = None,
    with_images: bool = True,
    priors: PriorFiles | None = None,
) -> dict[str, Result]:
    """Return method -> result for one key. Each result has the results before it as baselines.

    Unless results are scored, only the maps of the last method are filled.

    Args:
        recording: The recording, whose blocks include the key.
        methods: Names of `METHODS`.
        watch: Measures the cost of each stage, from zero. A stage shared by several keys counts for
            the first of them.
        with_images: Colour the cloud, and score depth if there is ground truth. The maps are the
            same either way.
        priors: Depth images that complete the maps of the last method.
    """
    methods = tuple(dict.fromkeys(methods))  # each once, in order
    sequence, settings = recording.sequence, recording.settings
    watch = watch or Watch()
    watch.restart()

    # Register and deskew the window. Its errors are raised before an image is read.
    recording.window(key)
    shots = key_shots(sequence, choose_cameras(sequence, cameras), key, settings.project)
    with watch.stage("images"):
        images = load_images(sequence, shots)

    with ThreadPoolExecutor(num_threads()) as pool:
        # Accumulate the window, rigidly or with flow. Meanwhile find static surfaces beyond it.
        wants_far = any(METHODS[name].far for name in methods)
        far_task = pool.submit(recording.find_far_surfaces, key) if wants_far else None
        with_flow = settings.output.flow != "none"
        moments = {
            name: recording.moment(key, METHODS[name].all_sweeps, METHODS[name].engine, with_flow)
            for name in methods
        }
        far_surfaces = None if far_task is None else far_task.result()
        if key == max(recording.cut.number_of):  # no later key needs the raw sweeps
            recording.sweeps.read.cache_clear()

        # See, project, fill and score the points, method by method.
        cloud = moments[methods[-1]].cloud
        scene = scene_of(
            recording, key, shots, images, far_surfaces, cloud, with_images=with_images, watch=watch
        )
        del cloud  # the method replaces this cloud, and memory must not hold both
        are_filled = [settings.is_scored or name == methods[-1] for name in methods]
        make = partial(result_of_method, scene, moments)
        results = list(pool.map(make, methods, are_filled))

    if priors is not None:
        with watch.stage("prior"):
            results[-1] = complete_with_prior(scene, results[-1], priors, shots)
    return add_warnings(_with_baselines(results, watch, sequence.name), recording, key, shots)


def _with_baselines(results: Sequence[Result], watch: Watch, recording: str) -> dict[str, Result]:
    """Return method -> result, each with the results before it as baselines."""
    common = partial(replace, costs=watch.costs(), elapsed_s=watch.elapsed_s(), recording=recording)
    by_method: dict[str, Result] = {}
    for result in results:
        by_method[result.method] = common(result, baselines=dict(by_method))
    return by_method


def scene_of(
    recording: Recording,
    key: int,
    shots: Mapping[str, Shot],
    images: Mapping[str, NDArray[np.uint8]],
    far_surfaces: FarSurfaces | None,
    cloud: Cloud,
    with_images: bool,
    watch: Watch,
) -> KeyScene:
    """Return the inputs that all methods of a key share.

    Args:
        shots: Map name -> camera, image number and exposure time.
        images: Map name -> (H,W,3) RGB image.
        far_surfaces: Static surfaces beyond the window; None leaves them out.
        cloud: Accumulated points. Its moving points mark those of the held-out key sweep.
        with_images: Colour the cloud, and score depth if there is ground truth.
    """
    sequence, settings = recording.sequence, recording.settings
    stretch = recording.window(key)
    key_image = RangeImage.of(stretch[key])
    views = Views.of(sequence, stretch, key, shots, images, settings)
    truth = views.true_maps(sequence.truth) if with_images and sequence.truth else {}
    held_out = None
    if settings.is_scored:
        with watch.stage("held out"):
            held_out = HeldOut.of(views, cloud)
    return KeyScene(
        settings=settings,
        key=key,
        stretch=stretch,
        far_surfaces=far_surfaces,
        key_image=key_image,
        views=views,
        images=images if with_images else {},
        truth=truth,
        held_out=held_out,
        watch=watch,
    )


def _or_error(make: Callable[[int], T], frame: int) -> T | ComputationError | InputError:
    """Return the result for a frame, or the error that ``make`` raises."""
    try:
        return make(frame)
    except (ComputationError, InputError) as error:
        return error


def _open_prior(
    prior: str | Path | None, sequence: LidarSequence, cameras: Sequence[str] | None
) -> PriorFiles | None:
    """Return the depth images in the folder ``prior``, None without one."""
    if prior is None:
        return None
    names = [camera.name for camera in choose_cameras(sequence, cameras)]
    return PriorFiles.open(Path(prior), names)


def _open(
    sequence: LidarSequence,
    keys: Sequence[int],
    window: int,
    methods: Sequence[str],
    cameras: Sequence[str] | None,
    config: ConfigLike,
    cache: Cache | None,
    watch: Watch | None,
) -> Recording:
    """Return the recording with checked arguments; raise InputError before any sweep is read."""
    settings = resolve(config)
    if not hasattr(sequence, "frames"):
        raise InputError(
            f"sequence: got {reprlib.repr(sequence)}, expected what densify.open_sequence returns"
        )
    if isinstance(methods, str):
        raise InputError(f"methods: got {methods!r}, expected a list of names, such as ['flow']")
    if not methods:
        raise InputError(f"methods: got no name, expected some of {', '.join(METHODS)}")
    for name in methods:
        if name not in METHODS:
            raise InputError(f"methods {name}: expected some of {', '.join(METHODS)}")
    check_engine(settings.flow.engine)
    choose_cameras(sequence, cameras)
    return Recording(sequence, settings, window, keys, cache, None, watch, looks_around(methods))
