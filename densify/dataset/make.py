# SPDX-License-Identifier: MIT
"""Make a training set: plan it, skip finished key sweeps, densify and record the others."""

from __future__ import annotations

import logging
import math
import platform
import re
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from densify.config import as_mapping
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError, OutputError, is_out_of_memory
from densify.dataset.executor import call_all, logged_to
from densify.dataset.manifest import (
    USUAL_SHARES,
    Key,
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    read_manifests,
)
from densify.dataset.pictures import FILLED, find_map, front_camera, keep_picture
from densify.dataset.plan import (
    Drive,
    Recipe,
    choose_spread,
    plan,
    planned_keys,
    read_plan,
    write_plan,
)
from densify.flow.engines import check_engine
from densify.geometry.compiled import num_threads
from densify.geometry.types import Result
from densify.outputs.atomic import LEFT_AFTER_S, clear_leftovers
from densify.outputs.depth_png import read_depth_png
from densify.outputs.key_outputs import write_result
from densify.outputs.kitti_tree import FileRecord, write_key, write_readme
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import looks_around, methods_of_run
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.version import __version__

_log = logging.getLogger("densify")
_KEYS_PER_PROCESS = 8  # fewer are done before another process has started
_BASE_BYTES, _SWEEP_BYTES = 1.5e9, 0.15e9  # memory per process, and per sweep of 64 rings
_JUDGED = {"ghost": "ghosts", "outliers": "held-out outliers"}
Shard = tuple[int, int]
"""(i, n), part i of n, from 1."""


@dataclass(frozen=True)
class Summary:
    """The progress of a training set, or of one shard."""

    # Records of the key sweeps tried so far, by drive and frame number
    records: Mapping[Key, KeyRecord]
    num_keys: int  # number of wanted key sweeps
    num_made: int = 0  # number of key sweeps made in this run
    seconds: float = 0.0  # duration of this run

    def count(self, status: str) -> int:
        """Return the number of key sweeps with this status: done, aside or failed."""
        return sum(record.status == status for record in self.records.values())

    @property
    def num_left(self) -> int:
        """The number of wanted key sweeps without a record."""
        return self.num_keys - len(self.records)

    def mean(self, score: str) -> float | None:
        """Return a manifest score's mean over finished key sweeps and cameras, None if unknown."""
        done = [record for record in self.records.values() if record.status == "done"]
        known = [value for record in done for value in record.values_of(score)]
        return sum(known) / len(known) if known else None


def make_dataset(
    data: Sequence[str],
    out: str | Path,
    keys: slice | None = None,
    recipe: Recipe | None = None,
    *,
    num_workers: int | None = 1,
    scheduler: str | None = None,
    shard: Shard | None = None,
    verify: bool = False,
    preview: int | None = None,
    report: Callable[[Summary], None] | None = None,
) -> Summary:
    """Make a training set from the key sweeps of whole recordings, and return the final progress.

    A repeated call keeps finished key sweeps. Files do not depend on processes or interruptions. A
    full disk or the loss of all workers raises ComputationError; finished key sweeps are kept.

    Args:
        data: Recordings, as `densify.open_sequence` takes them.
        out: Folder of the training set.
        keys: Existing frame numbers from ``start`` to ``stop`` - 1 by ``step``. None for all.
        recipe: Window, method, cameras, limits of the scores, and settings. None uses the defaults.
        num_workers: Number of processes, as many as possible if None. More than one needs ``if
            __name__ == "__main__"`` in a script.
        scheduler: Address of a Dask scheduler whose workers replace local processes. They need the
            same files at the same paths. ``tcp://`` trusts everybody on that network.
        shard: (i, n), part i of n, from 1. Machines that share ``out`` may make parts at once.
        verify: Compare finished files with their recorded hashes, and make damaged files again.
        preview: Make only this number of keys, spread over all. They are not compared with their
            neighbours before a later call makes the others.
        report: Function called with the progress, before the first and after every key sweep.
    """
    if isinstance(data, str) or not data:
        raise InputError(f"data: got {data!r}, expected a list of recordings, such as ['street']")
    out, recipe = Path(out), recipe or Recipe()
    check_engine(recipe.config.flow.engine)
    planned = plan(data, keys, recipe)
    drives = planned if preview is None else choose_spread(planned, preview)
    _check_folder(out)
    Cache()  # raises InputError if other users can write to the cache folder
    num_workers = _num_processes(num_workers, recipe, drives)
    age_s, suffix = (0.0, "") if shard is None else (LEFT_AFTER_S, f"-{shard[0]}of{shard[1]}")
    log = out.absolute() / f"densify{suffix}.log"
    with Manifest(out, shard) as manifest:
        write_plan(out, recipe, planned)  # no log where the plan is refused
        with logged_to(log):
            clear_leftovers(out, age_s)
            if recipe.layout == "kitti-depth":
                write_readme(out, recipe.method, recipe.window, as_mapping(recipe.config))
            blocks = _blocks(drives, shard)
            num_keys, records = sum(len(keys) for _, keys in blocks), _finished(blocks, out, verify)
            groups = _jobs(blocks, records.keys(), recipe, out, num_workers)
            _log.info("%d of %d keys finished, %d worker(s)", len(records), num_keys, num_workers)
            outcomes = call_all(make_key, groups, num_workers, log, scheduler)
            summary = _record(outcomes, manifest, records, num_keys, report)
            if preview is None:
                records |= _set_aside(manifest, records, recipe, out, drives)
            clear_leftovers(out, age_s)  # hidden folders of killed workers
    return summary


def status(out: Path) -> Summary:
    """Return the progress of a training set from its files; raise InputError if it is none."""
    table = read_plan(out)
    if table is None:
        raise InputError(f"--status {out}: no dataset.json in it; expected a set's folder")
    keys = planned_keys(table)
    records = {name: record for name, record in read_manifests(out).items() if name in keys}
    return Summary(records, len(keys))


def damaged(out: Path) -> list[str]:
    """Return the files, relative to ``out``, that are missing or differ from recorded hashes."""
    finished_records = (
        record for record in read_manifests(out).values() if record.status != "failed"
    )
    return [name for record in finished_records for name in damaged_files(record, out)]


# The command's process


def _check_folder(out: Path) -> None:
    """Raise InputError if the folder holds files other than a finished or begun training set."""
    begun = (".", "manifest")  # a run makes these files before dataset.json
    names = [path.name for path in out.iterdir()] if out.is_dir() else []
    if read_plan(out) is None and not all(name.startswith(begun) for name in names):
        raise InputError(f"--out {out}: not empty, and no dataset.json in it; choose another")


def _num_processes(wanted: int | None, recipe: Recipe, drives: Sequence[Drive]) -> int:
    """Return the wanted number, or as many as cores, free memory and key sweeps allow."""
    if wanted is not None:
        if wanted < 1:
            raise InputError(f"--workers {wanted}: expected 1 or more processes")
        return wanted
    need_bytes = _BASE_BYTES + _SWEEP_BYTES * (2 * recipe.window + 1)
    num_keys = sum(len(drive.keys) for drive in drives)
    limits = (_free_bytes() / need_bytes, num_threads(), num_keys / _KEYS_PER_PROCESS)
    return max(1, int(min(limits)))


def _free_bytes() -> float:
    """Return the free memory of the system, or a container's lower limit."""
    sizes = [math.inf]
    with suppress(OSError, ValueError, IndexError):
        table = Path("/proc/meminfo").read_text()
        sizes.append(1024.0 * int(re.findall(r"MemAvailable:\s+(\d+)", table)[0]))
        sizes.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))  # may be "max"
    return min(sizes)


def _blocks(drives: Sequence[Drive], shard: Shard | None) -> list[tuple[Drive, tuple[int, ...]]]:
    """Return the key frame numbers of all blocks, or of the consecutive blocks of one shard."""
    number, num_shards = shard or (1, 1)
    blocks = [(drive, keys) for drive in drives for keys in drive.blocks]
    begin = len(blocks) * (number - 1) // num_shards
    end = len(blocks) * number // num_shards
    return blocks[begin:end]


def _finished(
    blocks: Sequence[tuple[Drive, tuple[int, ...]]], out: Path, verify: bool
) -> dict[Key, KeyRecord]:
    """Return the records of the key sweeps in these blocks that are finished, sorted by key."""
    wanted = {(drive.name, key) for drive, keys in blocks for key in keys}
    before = read_manifests(out)
    return {name: before[name] for name in sorted(wanted & finished(before.values(), out, verify))}


def _jobs(
    blocks: Sequence[tuple[Drive, tuple[int, ...]]],
    done: Collection[Key],
    recipe: Recipe,
    out: Path,
    num_workers: int,
) -> list[list[tuple[Job, int]]]:
    """Return the key sweeps to make, in a group for each block."""
    # The first key sweep of a group computes the results that the group shares.
    run, groups = uuid4().hex, []
    for drive, keys in blocks:
        job = Job(drive, recipe, out.absolute(), run)
        if group := [(job, key) for key in keys if (drive.name, key) not in done]:
            groups.append(group)
    # Workers begin at distant blocks, because neighbouring blocks share results too.
    step = math.ceil(len(groups) / num_workers)
    return [group for start in range(step) for group in groups[start::step]]


def _record(
    outcomes: Iterator[tuple[tuple[Job, int], Any]],
    manifest: Manifest,
    records: dict[Key, KeyRecord],
    num_keys: int,
    report: Callable[[Summary], None] | None,
) -> Summary:
    """Record and report the outcomes of `call_all` as they come; return the final progress."""
    start_s = time.monotonic()
    summary = Summary(records, num_keys)
    try:
        if report is not None:
            report(summary)
        for num_made, ((job, key), record) in enumerate(outcomes, start=1):
            if isinstance(record, Exception):
                record = KeyRecord(job.drive.name, key, "failed", str(record))
            manifest.append(record)
            records[record.name] = record
            summary = Summary(records, num_keys, num_made, time.monotonic() - start_s)
            reason = f" ({record.reason})" if record.reason else ""
            _log.debug("key %d of %s: %s%s", record.key, record.drive, record.status, reason)
            if report is not None:
                report(summary)
    except BaseException as error:
        num_kept = summary.count("done") + summary.count("aside")
        message = f"{num_kept} of {num_keys} keys are finished and kept"
        if isinstance(error, OutputError):
            raise ComputationError(f"{error}; {message}") from error
        _log.info(message)
        raise
    return summary


def _set_aside(
    manifest: Manifest,
    records: Mapping[Key, KeyRecord],
    recipe: Recipe,
    out: Path,
    drives: Sequence[Drive],
) -> dict[Key, KeyRecord]:
    """Put keys far worse than their neighbours aside, and return their new records."""
    if recipe.gate.max_ratio is None:
        return {}
    worse = worse_than_neighbours(records, recipe.gate.max_ratio)
    keep = partial(_keep_picture, out, {drive.name: drive for drive in drives})
    return {record.name: record for record in manifest.set_aside(worse, keep)}


def _keep_picture(
    out: Path, drives: Mapping[str, Drive], record: KeyRecord
) -> dict[str, FileRecord]:
    """Write the picture of a finished key that is put aside; return its path and record."""
    drive = drives[record.drive]
    name = find_map(record, FILLED, front_camera(drive))
    try:
        filled_m = None if name is None else read_depth_png(out / name)
    except InputError:  # a damaged map, which is deleted anyway
        filled_m = None
    return {} if filled_m is None else keep_picture(out, drive, record.key, filled_m)


def worse_than_neighbours(records: Mapping[Key, KeyRecord], max_ratio: float) -> dict[Key, str]:
    """Return finished key -> reason, for keys with far more ghosts or outliers than neighbours.

    Such a share exceeds what is usual on KITTI (0.75 % ghosts, 0.9 % held-out outliers), and
    ``max_ratio`` times the median of the neighbours in the recording. Unlike a limit for all
    recordings, this detects keys that are bad for their own recording, such as keys with cut
    windows at its ends.
    """
    drives: dict[str, list[KeyRecord]] = defaultdict(list)
    for record in records.values():
        if record.status != "failed":
            drives[record.drive].append(record)
    worse: dict[Key, list[str]] = defaultdict(list)
    for drive in drives.values():
        drive.sort(key=lambda record: record.key)
        # Twice a window: the keys whose windows an end cuts are the minority of neighbours.
        num_beside = 2 * max(len(record.frames) for record in drive)
        for score, title in _JUDGED.items():
            shares = [max(record.values_of(score), default=np.nan) for record in drive]
            for row, median in _outlying(shares, num_beside, USUAL_SHARES[score][1], max_ratio):
                if drive[row].status == "done":
                    worse[drive[row].name].append(
                        f"{title} {100 * shares[row]:.2g} %, more than {max_ratio:g} times the "
                        f"{100 * median:.2g} % of the neighbouring keys (median)"
                    )
    return {name: "; ".join(reasons) for name, reasons in sorted(worse.items())}


def _outlying(
    shares: Sequence[float], num_beside: int, usual_share: float, max_ratio: float
) -> Iterator[tuple[int, float]]:
    """Yield (row, median of ``num_beside`` neighbours) of shares that are worse than usual."""
    for row, share in enumerate(shares):
        # At the ends, all neighbours are on one side.
        begin = max(0, min(row - num_beside // 2, len(shares) - num_beside - 1))
        beside = np.array([*shares[begin:row], *shares[row + 1 : begin + num_beside + 1]])
        beside = beside[np.isfinite(beside)]
        # With a single neighbour it is unknown which of the two keys is unusual.
        if len(beside) > 1:
            median = float(np.median(beside))
            if share > max(usual_share, max_ratio * median):
                yield row, median


# Any process


@dataclass(frozen=True)
class Job:
    """A recording of a training set, as every process opens it."""

    drive: Drive
    recipe: Recipe
    out: Path  # absolute folder of the training set
    run: str  # unique text of the command's run; long-lived workers reopen the recording in each
    version: str = __version__  # version of densify that made the job


def make_key(job_and_key: tuple[Job, int]) -> KeyRecord:
    """Densify and write one key, given as (job, frame number), and return its record.

    An error gives a record with the status ``failed``. Only OutputError is raised.
    """
    job, key = job_and_key
    start_s = time.perf_counter()
    try:
        record = _densified(job, key)
    except OutputError:
        raise
    except (InputError, ComputationError) as error:
        record = KeyRecord(job.drive.name, key, "failed", str(error))
    except Exception as error:  # other key sweeps may succeed
        _log.debug("key %d of %s: %s", key, job.drive.name, traceback.format_exc())
        record = KeyRecord(job.drive.name, key, "failed", _unexpected(error))
    return replace(record, seconds=time.perf_counter() - start_s)


def _unexpected(error: Exception) -> str:
    """Return the reason in the manifest for an error that densify does not raise itself."""
    message = f"{type(error).__name__}: {error}"
    if is_out_of_memory(error):
        return f"out of memory ({message}); fewer --workers or a smaller --window take less"
    return f"this is a bug in densify; please report it with densify.log: {message}"


def _densified(job: Job, key: int) -> KeyRecord:
    """Densify and write one key, unless its scores are beyond a limit; return its record."""
    recipe = job.recipe
    recording, cache = _opened(job)
    is_tree = recipe.layout == "kitti-depth"
    # The sparse input in the tree is the depth of the single key sweep.
    methods = ["none", recipe.method] if is_tree else methods_of_run(recipe.method, recipe.config)
    cameras = tuple(job.drive.cameras)
    results = pipeline.densify(recording, key, methods, cameras, with_images=not is_tree)
    cache.trim()
    result = results[recipe.method]
    scores = _scores(result.metrics)
    reason = recipe.gate.reason(scores, len(result.frames))
    files = _write(job, results) if reason is None else _keep_result(job, result)
    return KeyRecord(
        job.drive.name,
        key,
        "done" if reason is None else "aside",
        reason,
        frames=result.frames,
        files=files,
        scores=scores,
        warnings=result.warnings,
    )


def _keep_result(job: Job, result: Result) -> dict[str, FileRecord]:
    """Write the picture of a key that is beyond a limit; return its path and record."""
    camera = front_camera(job.drive)
    names = [name for name in result.depth if name.partition("/")[0] == camera]
    if not names:
        return {}
    return keep_picture(job.out, job.drive, result.key, result.depth[names[0]].filled_m)


def _scores(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores for a manifest line from the metrics of a result."""
    held_out = metrics["held_out"] or {}
    errors = {name: scores["measured"]["all"] for name, scores in held_out.items()}
    return {
        "num_points": metrics["num_points"],
        "num_moving": metrics["num_moving"],
        "ghost": metrics["ghosts"]["all"],
        "density": {name: shares["measured"] for name, shares in metrics["density"].items()},
        "density_filled": {name: shares["filled"] for name, shares in metrics["density"].items()},
        "outliers": {name: scores["outliers"] for name, scores in errors.items()},
        "mae_m": {name: scores["mae_m"] for name, scores in errors.items()},
    }


def _write(job: Job, results: Mapping[str, Result]) -> dict[str, FileRecord]:
    """Write the files of a key sweep, and return path relative to the set -> size and hash."""
    result, out, drive = results[job.recipe.method], job.out, job.drive
    if job.recipe.layout == "kitti-depth":
        return write_key(out, drive.folder, result.key, results["none"].depth, result.depth)
    config = as_mapping(job.recipe.config)
    paths = write_result(result, out / drive.folder, config=config, data=drive.data, overwrite=True)
    return {p.relative_to(out).as_posix(): FileRecord.of(p.read_bytes()) for p in paths}


@lru_cache(maxsize=1)
def _opened(job: Job) -> tuple[Recording, Cache]:
    """Return a job's recording with its cache; raise ComputationError for another version."""
    if job.version != __version__:
        raise ComputationError(
            f"the worker on {platform.node()} has densify {__version__}, the command has "
            f"{job.version}; install the same on both"
        )
    cache, recipe = Cache(), job.recipe
    recording = Recording(
        open_sequence(job.drive.data),
        recipe.config,
        recipe.window,
        job.drive.keys,
        cache,
        job.run,
        looks_around=looks_around([recipe.method]),
    )
    return recording, cache
