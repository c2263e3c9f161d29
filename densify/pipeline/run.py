# SPDX-License-Identifier: MIT
"""The pipeline, as a story: what is asked of a recording, for one key or for a thousand.

`densify` is the whole of it: the window of a key is registered and deskewed, everything in it is
brought to the key's moment, and each camera looks at the accumulated cloud. How the steps before
the cloud are made, once for all keys that share them, is told by `pipeline.recording`; what comes
after it, by `densify.pipeline.key_results`.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from densify.config import Config, resolve
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError
from densify.depth.exposure import key_shots, load_images
from densify.flow.engines import check_engine
from densify.geometry.threads import tasks
from densify.geometry.types import LidarSequence, Progress, Result, StretchFlow
from densify.pipeline.completion import key_priors
from densify.pipeline.costs import Watch
from densify.pipeline.doubts import with_doubts
from densify.pipeline.key_results import Key, key_results
from densify.pipeline.methods import COMPARED, METHODS, looks_around, with_baselines
from densify.pipeline.recording import Beyond, Moment, Recording
from densify.readers.prior_files import PriorFiles
from densify.readers.timeline import format_frames
from densify.readers.window import choose_cameras

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
    looks = looks_around(methods)
    recording = Recording(sequence, settings, window, keys, cache, None, watch, looks)

    def results() -> Iterator[tuple[int, Result | ComputationError | InputError]]:
        for key in sorted(set(keys)):
            try:
                yield key, densify(recording, key, methods, cameras, watch, priors=priors)[method]
            except (ComputationError, InputError) as error:
                yield key, error

    return results()


def flow_steps(
    sequence: LidarSequence,
    frames: Sequence[int],
    config: ConfigLike = None,
    progress: Progress | None = None,
    cache: Cache | None = None,
) -> Iterator[tuple[int, StretchFlow | ComputationError | InputError]]:
    """The flow of sweeps of a whole recording to the next ones; motion is followed over all sweeps
    around, as for a training set.

    frames: ascending. cache: keeps what is shared on disk. Yields each sweep with the one step that
    leads from it, none where no sweep follows (the last one, before a hole in time), or with what
    went wrong. Raises InputError at once for what nothing can be made with.
    """
    settings, watch = resolve(config), Watch()
    _check(sequence, settings, ["flow"], None)
    recording = Recording(sequence, settings, 1, cache=cache, watch=watch)

    def steps() -> Iterator[tuple[int, StretchFlow | ComputationError | InputError]]:
        for done, frame in enumerate(frames):
            if progress:
                progress("flow", done, len(frames))
            try:
                yield frame, recording.step(frame)
            except (ComputationError, InputError) as error:
                yield frame, error

    return steps()


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
    looks = looks_around(methods)
    recording = Recording(sequence, settings, window, [key], cache, None, watch, looks)
    return densify(recording, key, methods, cameras, watch, priors=priors)


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
    cuts = _cuts(recording, key, any(METHODS[name].engine is not None for name in methods))
    shots = key_shots(sequence, choose_cameras(sequence, cameras), key, settings.project)
    with watch.stage("images"):
        images = load_images(sequence, shots)
    priors_of_key = {} if priors is None else key_priors(priors, shots, key)
    stretch = recording.window(key)
    this = Key(sequence, settings, key, stretch, shots, images, with_images, watch)

    def moment(name: str) -> Moment:
        method = METHODS[name]
        return recording.moment(
            key, method.all_sweeps, method.engine, settings.output.flow != "none"
        )

    def beyond() -> Beyond | None:
        return recording.standing(key) if any(METHODS[name].far for name in methods) else None

    with tasks() as pool:  # what takes longest, the flow of the last method, begins
        begun = {name: pool.submit(moment, name) for name in reversed(methods)}
        moments = {name: begun[name] for name in methods}
        made = key_results(this, moments, pool.submit(beyond), priors_of_key, pool)
    return with_doubts(made, sequence, stretch, shots, settings, cuts)


def _open_priors(
    place: str | Path | None, sequence: LidarSequence, cameras: Sequence[str] | None
) -> PriorFiles | None:
    if place is None:
        return None
    return PriorFiles.open(Path(place), [c.name for c in choose_cameras(sequence, cameras)])


def _cuts(recording: Recording, key: int, with_flow: bool) -> list[str]:
    """Why a key's window has fewer sweeps than asked for, and that it has too few to follow
    anything, a sentence each."""
    window = recording.window_frames(key)
    frames = format_frames(window.frames)
    told = [f"the window is cut to frames {frames}: {cut}" for cut in window.cuts]
    if with_flow and recording.is_pair(key):
        told.append(
            "two sweeps show what moves less well than three or more, which can be followed"
        )
    return told


def _check(
    sequence: LidarSequence,
    settings: Config,
    methods: Sequence[str],
    cameras: Sequence[str] | None,
) -> None:
    """Raise InputError before anything is read."""
    if not hasattr(sequence, "frames"):
        raise InputError(
            f"sequence: got {reprlib.repr(sequence)}, expected what densify.open_sequence returns"
        )
    if isinstance(methods, str):
        raise InputError(f"methods: got {methods!r}, expected a list of names, such as ['flow']")
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    check_engine(settings.flow.engine)
    choose_cameras(sequence, cameras)
