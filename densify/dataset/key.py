# SPDX-License-Identifier: MIT
"""Densify one key sweep of a training set in any process, write its files and return its record."""

from __future__ import annotations

import logging
import platform
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from densify.config import as_mapping
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError, OutputError, is_out_of_memory
from densify.dataset.manifest import KeyRecord
from densify.dataset.plan import Recipe
from densify.geometry.types import Result
from densify.outputs.key_outputs import write_result
from densify.outputs.kitti_tree import FileRecord, write_key
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import looks_around, methods_of_run
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.version import __version__

_log = logging.getLogger("densify")


@dataclass(frozen=True)
class Job:
    """A recording of a training set, as every process opens it."""

    drive: str  # name of the recording's folder
    data: str  # text of ``--data``, with an absolute path
    folder: str  # folder of the recording's files, relative to ``out``
    # Key frame numbers of the training set, by which the recording is cut into blocks
    keys: tuple[int, ...]
    cameras: tuple[str, ...]  # names of the wanted cameras
    recipe: Recipe
    out: Path  # folder of the training set
    # Unique text of the command's run, because long-lived workers must reopen the recording in each
    # run
    run: str
    version: str = __version__  # version of densify that made the job


def make_key(job_and_key: tuple[Job, int]) -> KeyRecord:
    """Densify and write one key and return its record, ``failed`` on any error but OutputError."""
    job, key = job_and_key
    start_s = time.perf_counter()
    try:
        record = _made(job, key)
    except OutputError:
        raise
    except (InputError, ComputationError) as error:
        record = KeyRecord(job.drive, key, "failed", str(error))
    except Exception as error:  # other key sweeps may succeed
        _log.debug("key %d of %s: %s", key, job.drive, traceback.format_exc())
        told = f"{type(error).__name__}: {error}"
        if is_out_of_memory(error):
            told = f"out of memory ({told}); fewer --workers or a smaller --window take less"
        else:
            told = f"this is a bug in densify; please report it with densify.log: {told}"
        record = KeyRecord(job.drive, key, "failed", told)
    return replace(record, seconds=time.perf_counter() - start_s)


def _made(job: Job, key: int) -> KeyRecord:
    recipe = job.recipe
    recording, cache = _opened(job)
    is_tree = recipe.layout == "kitti-depth"
    # The sparse input in the tree is the depth of the single key sweep.
    methods = ["none", recipe.method] if is_tree else methods_of_run(recipe.method, recipe.config)
    results = pipeline.densify(
        recording, key, tuple(dict.fromkeys(methods)), job.cameras, with_images=not is_tree
    )
    cache.trim()
    result = results[recipe.method]
    scores = _scores(result.metrics)
    reason = recipe.gate.reason(scores, len(result.frames))
    return KeyRecord(
        job.drive,
        key,
        "done" if reason is None else "aside",
        reason,
        frames=result.frames,
        files=_write(job, results) if reason is None else {},
        scores=scores,
        warnings=result.warnings,
    )


def _scores(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores for a manifest line from the metrics of a result."""
    held_out = metrics["held_out"] or {}
    errors = {name: scores["measured"]["all"] for name, scores in held_out.items()}
    return {
        "num_points": metrics["num_points"],
        "num_moving": metrics["num_moving"],
        "ghost": metrics["ghosts"]["all"],
        "density": {n: d["measured"] for n, d in metrics["density"].items()},
        "density_filled": {n: d["filled"] for n, d in metrics["density"].items()},
        "outliers": {n: e["outliers"] for n, e in errors.items()},
        "mae_m": {n: e["mae_m"] for n, e in errors.items()},
    }


def _write(job: Job, results: Mapping[str, Result]) -> dict[str, FileRecord]:
    result = results[job.recipe.method]
    if job.recipe.layout == "kitti-depth":
        sparse = results["none"].depth
        return write_key(job.out, job.folder, result.key, sparse, result.depth)
    paths = write_result(
        result,
        job.out / job.folder,
        config=as_mapping(job.recipe.config),
        data=job.data,
        overwrite=True,
    )
    return {p.relative_to(job.out).as_posix(): FileRecord.of(p.read_bytes()) for p in paths}


@lru_cache(maxsize=1)
def _opened(job: Job) -> tuple[Recording, Cache]:
    if job.version != __version__:
        raise ComputationError(
            f"the worker on {platform.node()} has densify {__version__}, the command has "
            f"{job.version}; install the same on both"
        )
    cache, sequence, recipe = Cache(), open_sequence(job.data), job.recipe
    recording = Recording(
        sequence,
        recipe.config,
        recipe.window,
        job.keys,
        cache,
        job.run,
        looks_around=looks_around([recipe.method]),
    )
    return recording, cache
