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
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from densify.config import as_mapping
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError, OutputError, is_out_of_memory
from densify.dataset.executor import call_all, logged_to
from densify.dataset.judged_set import suspects_of
from densify.dataset.manifest import (
    USUAL_SHARES,
    Key,
    KeyRecord,
    Manifest,
    damaged_files,
    describe_files,
    finished,
    read_manifests,
)
from densify.dataset.plan import (
    Drive,
    Gate,
    Recipe,
    choose_spread,
    plan,
    planned_keys,
    read_plan,
    write_plan,
)
from densify.dataset.report import FILLED, find_map, front_camera, keep_picture, kept_picture
from densify.flow.engines import check_engine
from densify.geometry.compiled import num_threads
from densify.geometry.types import Result
from densify.outputs.depth_png import read_depth_png
from densify.outputs.folders import LEFT_AFTER_S, clear_leftovers
from densify.outputs.key_outputs import write_result
from densify.outputs.kitti_tree import write_key, write_readme
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import looks_around, methods_of_run
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.scores.metrics import shown_score
from densify.version import __version__

_log = logging.getLogger("densify")
_KEYS_PER_PROCESS = 8  # fewer are done before another process has started
_BASE_BYTES, _SWEEP_BYTES = 1.5e9, 0.15e9  # memory per process, and per sweep of 64 rings
_JUDGED = {"ghost": "ghosts", "outliers": "held-out outliers"}
_Keys = list[tuple["Job", int]]  # key sweeps, each by its job and frame number
Shard = tuple[int, int]
"""(i, n), part i of n, from 1."""


@dataclass(frozen=True)
class Summary:
    """The progress of a training set, or of one shard."""

    records: Mapping[Key, KeyRecord]  # of the key sweeps tried so far, by drive and frame number
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

    A repeated call keeps finished key sweeps, also after an error. With other limits in
    ``recipe.gate`` it puts key sweeps aside, or makes them again. Files do not depend on processes
    or interruptions. A full disk or the loss of all workers raises ComputationError.

    Args:
        data: Recordings, each a text for `densify.open_sequence`.
        out: Folder of the training set.
        keys: Existing frame numbers from ``start`` to ``stop`` - 1 by ``step``. None for all.
        recipe: Window, method, cameras, limits of the scores, and settings. None uses the defaults.
        num_workers: Number of processes, None for many. In a script they need a ``__main__`` guard.
        scheduler: Address of a Dask scheduler whose workers replace local processes. They need the
            same files at the same paths. ``tcp://`` trusts everybody on that network.
        shard: (i, n), part i of n, from 1. Machines that share ``out`` may make parts at once.
        verify: Compare finished files with their recorded hashes, and make damaged files again.
        preview: Make only this number of keys, spread over all, and measure held-out outliers.
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
            blocks = _blocks(drives, shard, recipe, out, is_scored=preview is not None)
            records = _finished(blocks, out, verify, recipe.gate if preview is None else None)
            num_keys = sum(map(len, blocks))
            _log.info("%d of %d keys finished, %d worker(s)", len(records), num_keys, num_workers)
            groups = _left(blocks, records.keys(), num_workers)
            outcomes = call_all(make_key, groups, num_workers, log, scheduler)
            summary = _record(outcomes, manifest, records, num_keys, report)
            if preview is None:
                records |= _set_aside(manifest, records, recipe, out, drives)
            clear_leftovers(out, age_s)  # hidden folders of killed workers
    return summary


def status(out: Path) -> Summary:
    """Return the progress of a training set from its files. Raise InputError if it is none."""
    table = read_plan(out)
    if table is None:
        raise InputError(f"--status {out}: no dataset.json in it; expected a set's folder")
    keys = planned_keys(table)
    records = {name: record for name, record in read_manifests(out).items() if name in keys}
    return Summary(records, len(keys))


def damaged(out: Path) -> list[str]:
    """Return the files, relative to ``out``, that are missing or differ from recorded hashes."""
    tried = read_manifests(out).values()
    kept = (record for record in tried if record.status != "failed")
    return [name for record in kept for name in damaged_files(record, out)]


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
    # The scarcest of memory, cores and work decides.
    need_bytes = _BASE_BYTES + _SWEEP_BYTES * (2 * recipe.window + 1)
    num_keys = sum(len(drive.keys) for drive in drives)
    most = (_free_bytes() / need_bytes, num_threads(), num_keys / _KEYS_PER_PROCESS)
    return max(1, int(min(most)))


def _free_bytes() -> float:
    """Return the free memory of the system, or a container's lower limit."""
    sizes = [math.inf]
    with suppress(OSError, ValueError, IndexError):
        table = Path("/proc/meminfo").read_text()
        sizes.append(1024.0 * int(re.findall(r"MemAvailable:\s+(\d+)", table)[0]))
        sizes.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))  # may be "max"
    return min(sizes)


def _blocks(
    drives: Sequence[Drive], shard: Shard | None, recipe: Recipe, out: Path, is_scored: bool
) -> list[_Keys]:
    """Return the key sweeps of each block, or of the consecutive blocks of one shard."""
    run, blocks = uuid4().hex, list[_Keys]()
    for drive in drives:
        job = Job(drive, recipe, out.absolute(), run, is_scored)
        blocks += [[(job, key) for key in keys] for keys in drive.blocks]
    number, num_shards = shard or (1, 1)
    begin, end = (len(blocks) * part // num_shards for part in (number - 1, number))
    return blocks[begin:end]


def _finished(
    blocks: Sequence[_Keys], out: Path, verify: bool, gate: Gate | None
) -> dict[Key, KeyRecord]:
    """Return the records of the finished key sweeps in these blocks, sorted by key.

    Key sweeps that were put aside are finished if they are beyond a limit of ``gate``, if given.
    """
    wanted = {(job.drive.name, key) for block in blocks for job, key in block}
    before = read_manifests(out)
    names = sorted(wanted & finished(before.values(), out, verify))
    records = {name: before[name] for name in names}
    if gate is None:
        return records
    if gate.max_outliers is not None:  # keys that were not scored cannot be judged
        records = {name: r for name, r in records.items() if r.scores.get("is_scored")}
    beyond = beyond_limits(records, gate)
    return {name: r for name, r in records.items() if r.status == "done" or name in beyond}


def _left(blocks: Sequence[_Keys], done: Collection[Key], num_workers: int) -> list[_Keys]:
    """Return the key sweeps to make, in a group for each block."""
    # The first key sweep of a group computes the results that the group shares.
    groups = [[(j, key) for j, key in block if (j.drive.name, key) not in done] for block in blocks]
    groups = [group for group in groups if group]
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
    """Record and report the outcomes of `call_all` as they come, and return the final progress."""
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
    """Put the keys beyond a limit aside, and return their new records by key."""
    drive_of = {drive.name: drive for drive in drives}

    def keep(record: KeyRecord) -> list[Path]:
        """Write the picture of a finished key, and return its path."""
        drive = drive_of[record.drive]
        name = find_map(record, FILLED, front_camera(drive))
        if name is None:
            return []
        try:
            filled_m = read_depth_png(out / name)
        except InputError:  # a damaged map, which is deleted anyway
            return []
        return [keep_picture(out, drive, record.key, filled_m)]

    beyond = beyond_limits(records, recipe.gate)
    return {record.name: record for record in manifest.set_aside(beyond, keep)}


def beyond_limits(records: Mapping[Key, KeyRecord], gate: Gate) -> dict[Key, str]:
    """Return key -> reason, for the made keys, kept or put aside, that are beyond a limit."""
    ratio = gate.max_ratio
    worse = {} if ratio is None else worse_than_neighbours(records, ratio)
    made = ((name, record) for name, record in records.items() if record.status != "failed")
    own = {name: gate.reason(record.scores, len(record.frames)) for name, record in made}
    beyond = worse | {name: reason for name, reason in own.items() if reason is not None}
    if gate.suspects == "aside":
        suspects = suspects_of([*records.values()])
        beyond = {
            name: found[0].reason(with_camera=True) for name, found in suspects.items()
        } | beyond
    return beyond


def worse_than_neighbours(records: Mapping[Key, KeyRecord], max_ratio: float) -> dict[Key, str]:
    """Return made key -> reason, for keys with far more ghosts or outliers than neighbours.

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
            shares = np.array([max(r.values_of(score), default=np.nan) for r in drive])
            for row, record in enumerate(drive):
                # At the ends, all neighbours are on one side.
                begin = max(0, min(row - num_beside // 2, len(drive) - num_beside - 1))
                beside = np.delete(shares[begin : begin + num_beside + 1], row - begin)
                beside = beside[np.isfinite(beside)]
                # With a single neighbour it is unknown which of the two keys is unusual.
                median = float(np.median(beside)) if len(beside) > 1 else np.inf
                bound = max(USUAL_SHARES[score][1], max_ratio * median)
                if shares[row] > bound:
                    worse[record.name].append(
                        f"{title} {100 * shares[row]:.2g} %, more than {max_ratio:g} times the "
                        f"{100 * median:.2g} % of the neighbouring keys (median)"
                    )
    return {name: "; ".join(reasons) for name, reasons in sorted(worse.items())}


# Any process


@dataclass(frozen=True)
class Job:
    """A recording of a training set, as every process opens the recording."""

    drive: Drive
    recipe: Recipe
    out: Path  # absolute folder of the training set
    run: str  # unique text of the command's run; long-lived workers reopen the recording in each
    is_scored: bool  # measure outliers with the key sweep held out, whatever the recipe
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
        reason = f"{type(error).__name__}: {error}"
        if is_out_of_memory(error):
            advice = "fewer --workers or a smaller --window take less"
            reason = f"out of memory ({reason}); {advice}"
        else:
            reason = f"this is a bug in densify; please report it with densify.log: {reason}"
        record = KeyRecord(job.drive.name, key, "failed", reason)
    return replace(record, seconds=time.perf_counter() - start_s - record.seconds)


def _densified(job: Job, key: int) -> KeyRecord:
    """Densify one key, write the files if its scores are within the limits, return its record.

    ``seconds`` are those to subtract from the computing time: of scores that the recipe leaves out.
    """
    recipe = job.recipe
    recording, cache = _opened(job)
    is_tree = recipe.layout == "kitti-depth"
    # The sparse input in the tree is the depth of the single key sweep.
    methods = ["none", recipe.method] if is_tree else methods_of_run(recipe.method, recipe.config)
    cameras = tuple(job.drive.cameras)
    results = pipeline.densify(recording, key, methods, cameras, with_images=not is_tree)
    cache.trim()
    result = results[recipe.method]
    scores = _scores(result.metrics) | {"is_scored": recording.settings.is_scored}
    reason = recipe.gate.reason(scores, len(result.frames))
    if reason is None:
        kept_picture(job.out, job.drive, key).unlink(missing_ok=True)  # put aside before
    paths = _write(job, results) if reason is None else _keep_result(job, result)
    costs = () if recipe.config.is_scored else result.costs
    return KeyRecord(
        job.drive.name,
        key,
        "done" if reason is None else "aside",
        reason,
        frames=result.frames,
        files=describe_files(job.out, paths),
        scores=scores,
        seconds=sum(cost.seconds for cost in costs if cost.name == "held out"),
        warnings=result.warnings,
    )


def _keep_result(job: Job, result: Result) -> list[Path]:
    """Write the picture of a key beyond a limit, if the key has a map, and return the path."""
    camera = front_camera(job.drive)
    maps = [maps for name, maps in result.depth.items() if name.partition("/")[0] == camera]
    return [keep_picture(job.out, job.drive, result.key, m.filled_m) for m in maps[:1]]


def _scores(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores for a manifest line from the metrics of a result."""
    held_out = metrics["held_out"] or {}
    errors = {name: scores["measured"]["all"] for name, scores in held_out.items()}
    num_points, num_moving = metrics["num_points"], metrics["num_moving"]
    expected = metrics.get("expected_outliers", {})
    return {
        "num_points": num_points,
        "num_moving": num_moving,
        "moving": num_moving / num_points if num_points else None,
        "ghost": metrics["ghosts"]["all"],
        "density": {name: shares["measured"] for name, shares in metrics["density"].items()},
        "density_filled": {name: shares["filled"] for name, shares in metrics["density"].items()},
        "outliers": {name: scores["outliers"] for name, scores in errors.items()},
        "outliers_moving": {
            name: shown_score(scores["measured"]["moving"], "outliers")
            for name, scores in held_out.items()
        },
        "outliers_filled": {n: s["filled"]["all"]["outliers"] for n, s in held_out.items()},
        "expected_outliers": {name: shares["measured"] for name, shares in expected.items()},
        "mae_m": {name: scores["mae_m"] for name, scores in errors.items()},
    }


def _write(job: Job, results: Mapping[str, Result]) -> list[Path]:
    """Write the files of a key sweep, and return their paths."""
    result, folder = results[job.recipe.method], job.out / job.drive.folder
    if job.recipe.layout == "kitti-depth":
        return write_key(folder, result.key, results["none"].depth, result.depth)
    config = as_mapping(job.recipe.config)
    return write_result(result, folder, config=config, data=job.drive.data, overwrite=True)


@lru_cache(maxsize=1)
def _opened(job: Job) -> tuple[Recording, Cache]:
    """Return a job's recording with its cache. Raise ComputationError for another version."""
    if job.version != __version__:
        raise ComputationError(
            f"the worker on {platform.node()} has densify {__version__}, the command has "
            f"{job.version}; install the same on both"
        )
    cache, recipe, keys = Cache(), job.recipe, job.drive.keys
    config = recipe.config.scored() if job.is_scored else recipe.config
    sequence, around = open_sequence(job.drive.data), looks_around([recipe.method])
    recording = Recording(
        sequence, config, recipe.window, keys, cache, job.run, looks_around=around
    )
    return recording, cache
