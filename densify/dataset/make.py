# SPDX-License-Identifier: MIT
"""Make a training set: plan it, see what is finished, make the rest, record every key."""

from __future__ import annotations

import logging
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from densify.config import as_mapping
from densify.config.cache import Cache
from densify.config.errors import ComputationError, InputError, OutputError
from densify.dataset.executor import call_all, check_scheduler
from densify.dataset.key import Job, make_key
from densify.dataset.links import make_links
from densify.dataset.manifest import (
    Key,
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    read_manifests,
)
from densify.dataset.plan import (
    PlannedDrive,
    Recipe,
    check_place,
    plan,
    planned_keys,
    read_plan,
    write_plan,
)
from densify.flow.engines import check_engine
from densify.geometry.threads import num_threads
from densify.outputs.atomic import LEFT_AFTER_S, clear_leftovers
from densify.outputs.kitti_tree import write_readme
from densify.pipeline.memory import available_bytes, check_free, need_of_run
from densify.readers import open_sequence
from densify.readers.timeline import format_frames

_log = logging.getLogger("densify")
_LEAST_KEYS = 8  # of a process; fewer are made before another one has begun
_SHARE_OF_FREE = 0.7  # of the memory; files that are read want some too
_TREE_BYTES_PER_PIXEL = 1.8  # the four maps of a camera
_RUN_BYTES_PER_PIXEL, _CLOUD_BYTES_PER_SWEEP = 8.0, 2.5e6


@dataclass(frozen=True)
class Summary:
    """How far a set is, or a shard's part of it. records: of keys that were ever tried. num_keys:
    that are wanted. num_made: in this run, within ``seconds``."""

    records: Mapping[Key, KeyRecord]
    num_keys: int
    num_made: int = 0
    seconds: float = 0.0

    def count(self, status: str) -> int:
        return sum(record.status == status for record in self.records.values())

    @property
    def num_left(self) -> int:
        return self.num_keys - len(self.records)

    @property
    def seconds_left(self) -> float | None:
        """The time that is left at the rate so far; None before the first key."""
        return self.seconds / self.num_made * self.num_left if self.num_made else None

    def mean(self, score: str) -> float | None:
        """Return the mean over the keys that are done, and their cameras."""
        values: list[Any] = []  # a manifest of others may hold anything
        for record in self.records.values():
            value = record.scores.get(score) if record.status == "done" else None
            values += value.values() if isinstance(value, Mapping) else [value]
        known = [value for value in values if isinstance(value, float | int)]
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
    links: bool = False,
    report: Callable[[Summary], None] | None = None,
) -> Summary:
    """Make every key of whole recordings, as a training set in the folder ``out``.

    data: recordings, as `densify.open_sequence` takes them.
    keys: the frames ``start`` to ``stop`` - 1 by ``step`` that exist; all if None.
    recipe: window, method, cameras and the like; the usual ones if None.
    num_workers: processes; 1 works in this one, None takes as many as cores, free memory and keys
        suffice for. A script that starts several needs ``if __name__ == "__main__"``.
    scheduler: address of a Dask scheduler whose workers are used instead; they need the same files
        at the same paths. ``tcp://`` trusts everybody on that network, ``tls://`` takes
        certificates.
    shard: (i, n), the i-th of n parts of the work, from 1. Parts may run at the same time on
        machines that share ``out``.
    verify: compare finished files with their recorded hashes, and make damaged ones again.
    links: for loaders of others, see `densify.dataset.links`.
    report: called before the first key and after every one.

    Run again, it goes on where it was stopped: finished keys are kept, keys that failed are tried
    again. The files do not depend on the number of processes, on shards or on interruptions. The
    manifest says what became of every key (`densify.dataset.manifest`).

    Raises InputError for what cannot be used, and where another run is at work on the same part;
    ComputationError where the disk is full or the workers are lost: what is finished is kept.
    """
    if isinstance(data, str) or not data:
        raise InputError(f"data: got {data!r}, expected a list of recordings, such as ['street']")
    out, recipe = Path(out), recipe or Recipe()
    check_engine(recipe.config.flow.engine)
    drives = plan(data, keys, recipe)
    check_place(out)
    if links and recipe.layout != "kitti-depth":
        raise InputError(f"--links: of --layout kitti-depth, got --layout {recipe.layout}")
    Cache()  # refuses a folder that others can write to
    if scheduler is not None:
        check_scheduler(scheduler)
    num_workers = _num_processes(num_workers, recipe, drives)
    leftover_age_s = 0.0 if shard is None else LEFT_AFTER_S
    with Manifest(out, shard) as manifest:
        write_plan(out, recipe, drives)
        with _log_file(out, shard):
            clear_leftovers(out, leftover_age_s)
            if recipe.layout == "kitti-depth":
                settings = as_mapping(recipe.config)
                write_readme(out, method=recipe.method, window=recipe.window, settings=settings)
            if links:
                make_links(out, drives)
            drives = _part(drives, shard)
            done = _Done(out, drives, report, verify)
            left = done.left(drives)
            _announce(out, recipe, left, done.summary().num_keys, num_workers)
            if report is not None:
                report(done.summary())
            with _tell_kept(done):
                for record in _made(left, recipe, out, num_workers, scheduler):
                    manifest.append(record)
                    done.add(record)
            clear_leftovers(out, leftover_age_s)  # of workers that were killed
    return done.summary()


def status(out: Path) -> tuple[Summary, list[str]]:
    """Return how far a set is, finished or not, and the last line of each of its logs.

    Raises InputError if ``out`` holds none.
    """
    table = read_plan(out)
    if table is None:
        raise InputError(f"--status {out}: no dataset.json in it; expected a set's folder")
    keys = planned_keys(table)
    records = {name: r for name, r in read_manifests(out).items() if name in keys}
    lines = []
    for path in sorted(out.glob("densify*.log")):
        text = path.read_text("utf-8", errors="replace").splitlines()
        lines += [line.replace(" DEBUG ", " ", 1) for line in text[-1:]]
    return Summary(records, len(keys)), lines


def damaged(out: Path) -> list[str]:
    """Return the files of finished keys, relative to ``out``, that are missing or hold something
    else than was written, by the hashes in the manifest."""
    records = read_manifests(out).values()
    return [name for r in records if r.status != "failed" for name in damaged_files(r, out)]


def _num_processes(wanted: int | None, recipe: Recipe, drives: Sequence[PlannedDrive]) -> int:
    """Return the number wanted; if None, as many as cores, free memory and keys suffice for.
    Raises InputError if the memory does not suffice for one."""
    if wanted is not None and wanted < 1:
        raise InputError(f"--workers {wanted}: expected 1 or more processes")
    need_bytes = _need_bytes(recipe, drives[0])
    check_free(need_bytes, f"--window {recipe.window}: a process")
    if wanted is not None:
        return wanted
    num_keys = sum(len(drive.keys) for drive in drives)
    free_bytes = available_bytes() or float("inf")
    fitting = [_SHARE_OF_FREE * free_bytes / need_bytes, num_threads(), num_keys // _LEAST_KEYS]
    return max(1, int(min(fitting)))


def _need_bytes(recipe: Recipe, drive: PlannedDrive) -> float:
    """Return about what a process takes at its peak, by the first sweep that can be read."""
    sequence = open_sequence(drive.source.data)
    for key in drive.keys:
        with suppress(InputError):
            cameras = drive.source.cameras
            return need_of_run(sequence, key, recipe.window, cameras, recipe.config)
    return 1.0


def _made(
    drives: Sequence[PlannedDrive],
    recipe: Recipe,
    out: Path,
    num_workers: int,
    scheduler: str | None,
) -> Iterator[KeyRecord]:
    """Make the keys; a block's first key makes what all its keys share."""
    run, groups = uuid4().hex, []
    for drive in drives:
        job = Job(drive.source, recipe, out.absolute(), run)
        for block in sorted({drive.cut.number_near(key) for key in drive.keys}):
            keys = [key for key in drive.keys if drive.cut.number_near(key) == block]
            groups.append([(job, key) for key in keys])
    # Workers begin far from each other, because neighbouring blocks share steps too.
    step = math.ceil(len(groups) / num_workers)
    spread = [group for start in range(step) for group in groups[start::step]]
    for (job, key), outcome in call_all(make_key, spread, num_workers, scheduler):
        if isinstance(outcome, Exception):
            outcome = KeyRecord(job.source.name, key, "failed", str(outcome))
        yield outcome


class _Done:
    """What is finished of the keys wanted, and how fast it goes."""

    def __init__(
        self,
        out: Path,
        drives: Sequence[PlannedDrive],
        report: Callable[[Summary], None] | None,
        verify: bool,
    ) -> None:
        wanted = {(d.source.name, key) for d in drives for key in d.keys}
        before = read_manifests(out)
        whole = finished(before.values(), out, verify)
        self._records = {name: before[name] for name in sorted(wanted & whole)}
        self._num_keys, self._report = len(wanted), report
        self._num_made, self._start_s = 0, time.monotonic()

    def left(self, drives: Sequence[PlannedDrive]) -> list[PlannedDrive]:
        rest = [
            replace(d, keys=tuple(k for k in d.keys if (d.source.name, k) not in self._records))
            for d in drives
        ]
        return [d for d in rest if d.keys]

    def add(self, record: KeyRecord) -> None:
        self._records[record.name] = record
        self._num_made += 1
        summary = self.summary()
        _log.debug("%s", _line(record, summary))
        if self._report is not None:
            self._report(summary)

    def summary(self) -> Summary:
        seconds = time.monotonic() - self._start_s
        return Summary(self._records, self._num_keys, self._num_made, seconds)


@contextmanager
def _tell_kept(done: _Done) -> Iterator[None]:
    """Say what is kept if the block ends early; a full disk is a ComputationError."""
    try:
        yield
    except BaseException as error:
        summary = done.summary()
        num_kept = summary.count("done") + summary.count("aside")
        told = f"{num_kept} of {summary.num_keys} keys are finished and kept"
        if isinstance(error, OutputError):
            raise ComputationError(f"{error}; {told}") from error
        _log.info(told)
        raise


def _part(drives: Sequence[PlannedDrive], shard: tuple[int, int] | None) -> list[PlannedDrive]:
    """Return the blocks of a shard, of all drives: neighbours together, because they share work."""
    i, n = shard or (1, 1)
    blocks = [
        (d.source.name, b) for d in drives for b in sorted({d.cut.number_near(k) for k in d.keys})
    ]
    mine = set(blocks[len(blocks) * (i - 1) // n : len(blocks) * i // n])
    parts = [
        replace(d, keys=tuple(k for k in d.keys if (d.source.name, d.cut.number_near(k)) in mine))
        for d in drives
    ]
    return [part for part in parts if part.keys]


def _announce(
    out: Path, recipe: Recipe, left: Sequence[PlannedDrive], num_keys: int, num_workers: int
) -> None:
    num_left = sum(len(d.keys) for d in left)
    need = sum(len(d.keys) * _bytes_per_key(recipe, d) for d in left)
    free = shutil.disk_usage(out).free
    _log.info(
        "%d keys, %d finished, %d to make with %d worker(s); about %.2f GB needed, %.0f GB free",
        num_keys,
        num_keys - num_left,
        num_left,
        num_workers,
        need / 1e9,
        free / 1e9,
    )
    if need > free:
        _log.warning("%s: the disk will be full before all keys are made", out)


def _bytes_per_key(recipe: Recipe, drive: PlannedDrive) -> float:
    num_pixels = sum(c.width_px * c.height_px for c in drive.cameras)
    if recipe.layout == "densify":
        return _CLOUD_BYTES_PER_SWEEP * (2 * recipe.window + 1) + _RUN_BYTES_PER_PIXEL * num_pixels
    return _TREE_BYTES_PER_PIXEL * num_pixels


def _line(record: KeyRecord, summary: Summary) -> str:
    """Return a line of the log."""
    told = f" ({record.reason})" if record.reason else ""
    return (
        f"key {record.key} of {record.drive}: {record.status}{told}, "
        f"frames {format_frames(record.frames) or 'none'}, {record.seconds:.1f} s; "
        f"{len(summary.records)} of {summary.num_keys}, "
        f"{summary.seconds / summary.num_made:.2f} s a key, "
        f"{(summary.seconds_left or 0.0) / 60:.1f} min left"
    )


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore a full disk: whoever writes maps reports it."""


@contextmanager
def _log_file(out: Path, shard: tuple[int, int] | None) -> Iterator[None]:
    """Append what is logged to ``OUT/densify.log``, or a shard's own."""
    name = "densify.log" if shard is None else f"densify-{shard[0]}of{shard[1]}.log"
    try:
        handler = _LogFile(out / name, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"--out {out}: {name} cannot be written: {error.strerror}") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    before = _log.level
    _log.addHandler(handler)
    _log.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        _log.removeHandler(handler)
        _log.setLevel(before)
        with suppress(OSError):
            handler.close()
