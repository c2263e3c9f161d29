# SPDX-License-Identifier: MIT
"""Make a training set: plan it, skip finished key sweeps, densify and record the others."""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from densify.config import as_mapping
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError, OutputError
from densify.dataset.executor import call_all, logged_to
from densify.dataset.key import Job, make_key
from densify.dataset.manifest import (
    Key,
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    read_manifests,
)
from densify.dataset.neighbours import worse_than_neighbours
from densify.dataset.plan import (
    Drive,
    Recipe,
    check_place,
    plan,
    planned_keys,
    read_plan,
    write_plan,
)
from densify.flow.engines import check_engine
from densify.geometry.compiled import num_threads
from densify.outputs.atomic import LEFT_AFTER_S, clear_leftovers
from densify.outputs.kitti_tree import write_readme

_log = logging.getLogger("densify")
_LEAST_KEYS = 8  # key sweeps per process; fewer are done before another process has started
_BASE_BYTES, _SWEEP_BYTES = 1.5e9, 0.15e9  # memory per process, and per sweep of 64 rings
Block = tuple[Drive, tuple[int, ...]]
"""A recording, and the key frame numbers of one of its blocks."""


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
        """Return a score's mean over finished key sweeps and their cameras, None if unknown."""
        values: list[Any] = []
        for record in self.records.values():
            value = record.scores.get(score) if record.status == "done" else None
            values += value.values() if isinstance(value, Mapping) else [value]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None


def make_dataset(
    data: Sequence[str],
    out: str | Path,
    keys: slice | None = None,
    recipe: Recipe | None = None,
    *,
    num_workers: int | None = 1,
    scheduler: str | None = None,
    shard: tuple[int, int] | None = None,
    verify: bool = False,
    report: Callable[[Summary], None] | None = None,
) -> Summary:
    """Make a training set from the key sweeps of whole recordings, and return the final progress.

    A repeated call keeps finished key sweeps. Files do not depend on processes or interruptions. A
    full disk or the loss of all workers raises ComputationError; finished key sweeps are kept.

    Args:
        data: Recordings, as `densify.open_sequence` takes them.
        out: Folder of the training set.
        keys: Existing frame numbers from ``start`` to ``stop`` - 1 by ``step``; no start or stop
            means the first frame or the last. None for all.
        recipe: Window, method, cameras, limits of the scores, and settings. None uses the defaults.
        num_workers: Number of processes, as many as possible if None. More than one needs ``if
            __name__ == "__main__"`` in a script.
        scheduler: Address of a Dask scheduler whose workers replace local processes. They need the
            same files at the same paths. ``tcp://`` trusts everybody on that network.
        shard: (i, n), part i of n, from 1. Machines that share ``out`` may make parts at once.
        verify: Compare finished files with their recorded hashes, and make damaged files again.
        report: Function called with the progress, before the first and after every key sweep.
    """
    if isinstance(data, str) or not data:
        raise InputError(f"data: got {data!r}, expected a list of recordings, such as ['street']")
    out, recipe = Path(out), recipe or Recipe()
    check_engine(recipe.config.flow.engine)
    drives = plan(data, keys, recipe)
    check_place(out)
    Cache()  # raises InputError if other users can write to the cache folder
    num_workers = _num_processes(num_workers, recipe, drives)
    age_s, part = (0.0, "") if shard is None else (LEFT_AFTER_S, f"-{shard[0]}of{shard[1]}")
    log = out.absolute() / f"densify{part}.log"
    with Manifest(out, shard) as manifest:
        write_plan(out, recipe, drives)  # no log where the plan is refused
        with logged_to(log):
            clear_leftovers(out, age_s)
            if recipe.layout == "kitti-depth":
                write_readme(out, recipe.method, recipe.window, as_mapping(recipe.config))
            blocks = _blocks(drives, shard)
            num_keys, records = sum(len(keys) for _, keys in blocks), _finished(blocks, out, verify)
            left = _jobs(blocks, records.keys(), recipe, out, num_workers)
            _log.info("%d of %d keys finished, %d worker(s)", len(records), num_keys, num_workers)
            made = call_all(make_key, left, num_workers, log, scheduler)
            summary = _record(made, manifest, records, num_keys, report)
            if recipe.gate.max_ratio is not None:
                worse = worse_than_neighbours(records, recipe.gate.max_ratio)
                records |= {record.name: record for record in manifest.set_aside(worse)}
            clear_leftovers(out, age_s)  # hidden folders of killed workers
    return summary


def status(out: Path) -> Summary:
    """Return the progress of a training set from its files."""
    table = read_plan(out)
    if table is None:
        raise InputError(f"--status {out}: no dataset.json in it; expected a set's folder")
    keys = planned_keys(table)
    records = {name: r for name, r in read_manifests(out).items() if name in keys}
    return Summary(records, len(keys))


def damaged(out: Path) -> list[str]:
    """Return the finished key sweeps' missing or changed (by hash) files, relative to ``out``."""
    records = read_manifests(out).values()
    return [name for r in records if r.status != "failed" for name in damaged_files(r, out)]


def _num_processes(wanted: int | None, recipe: Recipe, drives: Sequence[Drive]) -> int:
    """Return the wanted number, or as many as cores, free memory and key sweeps allow."""
    if wanted is not None:
        if wanted < 1:
            raise InputError(f"--workers {wanted}: expected 1 or more processes")
        return wanted
    need_bytes = _BASE_BYTES + _SWEEP_BYTES * (2 * recipe.window + 1)
    num_keys = sum(len(drive.keys) for drive in drives)
    fitting = (_free_bytes() / need_bytes, num_threads(), num_keys / _LEAST_KEYS)
    return max(1, int(min(fitting)))


def _free_bytes() -> float:
    """Return the free memory of the system, or a container's lower limit."""
    found = []
    with suppress(OSError, ValueError, TypeError):
        table = Path("/proc/meminfo").read_text()
        found.append(1024.0 * int(re.findall(r"MemAvailable:\s+(\d+)", table)[0]))
        found.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))  # may be "max"
    return min(found, default=float("inf"))


def _blocks(drives: Sequence[Drive], shard: tuple[int, int] | None) -> list[Block]:
    """Return the blocks of all drives, or the consecutive blocks of one shard."""
    i, n = shard or (1, 1)
    blocks = [(drive, keys) for drive in drives for keys in drive.blocks]
    return blocks[len(blocks) * (i - 1) // n : len(blocks) * i // n]


def _finished(blocks: Sequence[Block], out: Path, verify: bool) -> dict[Key, KeyRecord]:
    wanted = {(drive.name, key) for drive, keys in blocks for key in keys}
    before = read_manifests(out)
    done = finished(before.values(), out, verify)
    return {name: before[name] for name in sorted(wanted & done)}


def _jobs(
    blocks: Sequence[Block], done: Collection[Key], recipe: Recipe, out: Path, num_workers: int
) -> list[list[tuple[Job, int]]]:
    """Return the key sweeps to make, in a group for each block."""
    # The first key sweep of a group computes the results that the group shares.
    run, groups = uuid4().hex, []
    for drive, keys in blocks:
        cameras, place = tuple(drive.cameras), out.absolute()
        job = Job(drive.name, drive.data, drive.folder, drive.keys, cameras, recipe, place, run)
        if group := [(job, key) for key in keys if (drive.name, key) not in done]:
            groups.append(group)
    # Workers begin at distant blocks, because neighbouring blocks share results too.
    step = math.ceil(len(groups) / num_workers)
    return [group for start in range(step) for group in groups[start::step]]


def _record(
    made: Iterator[tuple[tuple[Job, int], Any]],
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
        for num_made, ((job, key), record) in enumerate(made, start=1):
            if isinstance(record, Exception):
                record = KeyRecord(job.drive, key, "failed", str(record))
            manifest.append(record)
            records[record.name] = record
            summary = Summary(records, num_keys, num_made, time.monotonic() - start_s)
            told = f" ({record.reason})" if record.reason else ""
            _log.debug("key %d of %s: %s%s", record.key, record.drive, record.status, told)
            if report is not None:
                report(summary)
    except BaseException as error:
        num_kept = summary.count("done") + summary.count("aside")
        told = f"{num_kept} of {num_keys} keys are finished and kept"
        if isinstance(error, OutputError):
            raise ComputationError(f"{error}; {told}") from error
        _log.info(told)
        raise
    return summary
