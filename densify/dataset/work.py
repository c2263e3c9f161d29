# SPDX-License-Identifier: MIT
"""The work on a training set as tasks that any process can do, in any order that `needs` allows:
first what the keys of a block share, then its keys one by one.
"""

from __future__ import annotations

import logging
import platform
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from densify.config import as_mapping
from densify.config.cache import Cache, code
from densify.config.errors import ComputationError, InputError, OutputError, is_out_of_memory
from densify.config.plugins.engines import engine
from densify.dataset.gate import scores_of
from densify.dataset.manifest import KeyRecord
from densify.dataset.plan import Recipe, Source
from densify.dataset.tasks import Task
from densify.geometry.types import Result
from densify.outputs.atomic import FileRecord
from densify.outputs.kitti_tree import write_key
from densify.outputs.store import write_result
from densify.pipeline import run as pipeline
from densify.pipeline.blocks import Cut
from densify.pipeline.methods import METHODS, with_baselines
from densify.pipeline.recording import Recording
from densify.readers import open_sequence

_MARGIN = 2
_NEEDS: dict[str, dict[str, int]] = {
    "registration": {},
    "images": {"registration": 1},
    "ground": {"registration": 1},
    "evidence": {"images": 1, "ground": 0},
    "motion": {"evidence": _MARGIN, "ground": 0},
    "far": {"registration": 1},
}
"""Step of a block -> the steps it is made of, and how many blocks around: none, one on each side,
or all within the margin. Steps are methods of `densify.pipeline.block_steps.BlockSteps`."""
_log = logging.getLogger("densify")


@dataclass(frozen=True)
class Job:
    """What every task of a recording has to know. cache_bytes: bound of the cache. code: of the
    densify that gave it out. run: another one each time, for files change from run to run and
    processes live on."""

    source: Source
    recipe: Recipe
    out: Path
    cache_bytes: int
    code: str
    run: str


def tasks(job: Job, keys: Sequence[int], cut: Cut) -> Iterator[Task]:
    """What is left to do for these keys: their records are the outcomes of the tasks named
    ``("key", drive, frame)``. Ordered so that keys come early. cut: of the recording."""
    name, known = job.source.name, set[tuple[str, int]]()

    def needed(what: str, block: int) -> list[tuple[str, int]]:
        reach = {0: 0, 1: 1, _MARGIN: cut.num_blocks_around}
        return [
            (step, b)
            for step, around in (_NEEDS | {"key": _needs_of_keys(job.recipe)})[what].items()
            for b in range(
                max(0, block - reach[around]), min(len(cut.blocks), block + reach[around] + 1)
            )
        ]

    def steps(what: str, block: int) -> Iterator[Task]:
        """What it needs, then itself, each once."""
        if (what, block) in known:
            return
        known.add((what, block))
        before = needed(what, block)
        for step, b in before:
            yield from steps(step, b)
        if what != "key":
            needs = frozenset((step, name, b) for step, b in before)
            yield Task((what, name, block), share, (job, what, block), needs)

    for block in sorted({cut.number_near(key) for key in keys}):
        yield from steps("key", block)
        needs = frozenset((step, name, b) for step, b in needed("key", block))
        for key in keys:
            if cut.number_near(key) == block:
                yield Task(("key", name, key), make_key, (job, key), needs)


def share(job: Job, stage: str, block: int) -> float:
    """Make what the keys of a block share and leave it in the cache; returns the seconds."""
    start = time.perf_counter()
    recording, cache = _opened(job)
    if stage == "motion":
        recording.steps.motion(block, job.recipe.config.flow.engine)
    else:
        getattr(recording.steps, stage)(block)
    cache.trim()
    return time.perf_counter() - start


def make_key(job: Job, key: int) -> KeyRecord:
    """Make and write one key. Raises OutputError if it cannot be written, which holds for all."""
    start = time.perf_counter()
    record = KeyRecord(job.source.name, key, "failed")
    try:
        record = _made(job, key)
    except OutputError:
        raise
    except (InputError, ComputationError) as error:
        record = replace(record, reason=str(error))
    except Exception as error:  # a bug, or no memory: the other keys may go well all the same
        _log.debug("key %d of %s: %s", key, job.source.name, traceback.format_exc())
        told = f"{type(error).__name__}: {error}"
        if is_out_of_memory(error):
            told = f"out of memory ({told}); fewer --workers or a smaller --window take less"
        else:
            told = f"this is a bug in densify; please report it with densify.log: {told}"
        record = replace(record, reason=told)
    return replace(record, seconds=time.perf_counter() - start)


def _made(job: Job, key: int) -> KeyRecord:
    recipe = job.recipe
    recording, _ = _opened(job)
    pictures = recipe.layout == "densify"
    cameras = job.source.cameras
    results = pipeline.densify(recording, key, _methods(recipe), cameras, with_images=pictures)
    result = results[recipe.method]
    scores = scores_of(result)
    record = KeyRecord(
        job.source.name,
        key,
        "done",
        frames=result.frames,
        scores=scores,
        warnings=result.warnings,
    )
    reason = recipe.gate.reason(scores, len(result.frames))
    if reason is not None:
        return replace(record, status="aside", reason=reason)
    return replace(record, files=_written(job, results))


def _written(job: Job, results: Mapping[str, Result]) -> dict[str, FileRecord]:
    result = results[job.recipe.method]
    if job.recipe.layout == "kitti-depth":
        sparse = results["none"].depth
        return write_key(job.out, job.source.folder, result.key, sparse, result.depth)
    paths = write_result(
        result,
        result.images,
        job.out / job.source.folder,
        config=as_mapping(job.recipe.config),
        data=job.source.data,
        overwrite=True,
        also=job.recipe.config.output.also,
    )
    return {
        path.relative_to(job.out).as_posix(): FileRecord.of(path.read_bytes()) for path in paths
    }


def _methods(recipe: Recipe) -> tuple[str, ...]:
    """The tree's sparse input is the key sweep alone; a run's figure shows all that is simpler."""
    if recipe.layout == "densify":
        return with_baselines(recipe.method)
    return tuple(dict.fromkeys(["none", recipe.method]))


def _needs_of_keys(recipe: Recipe) -> dict[str, int]:
    needs = {"registration": _MARGIN}
    if METHODS[recipe.method].far and recipe.config.accumulate.far_m:
        needs["far"] = 0
    if recipe.method == "flow":
        shared = engine(recipe.config.flow.engine)[0].shared
        needs["motion" if shared else "ground"] = 0
    return needs


@lru_cache(maxsize=1)
def _opened(job: Job) -> tuple[Recording, Cache]:
    if job.code != code():
        raise ComputationError(
            f"the worker on {platform.node()} has another densify than the one that gave it the "
            f"work; install the same on both"
        )
    cache = Cache(job.cache_bytes)
    sequence = open_sequence(job.source.data)
    recording = Recording(sequence, job.recipe.config, job.recipe.window, cache=cache, run=job.run)
    return recording, cache
