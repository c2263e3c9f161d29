# SPDX-License-Identifier: MIT
"""A training set, as a story: plan, see what is finished, make the rest, record every key."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from densify.config import as_mapping
from densify.config.cache import code, steps_folder
from densify.config.errors import ComputationError, InputError, OutputError
from densify.dataset.capacity import BASE_BYTES, num_processes
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
from densify.dataset.tasks import Outcome, Task, run_tasks
from densify.dataset.work import Job, tasks
from densify.dataset.workers import check_workers, open_workers
from densify.flow.engines import check_engine
from densify.outputs.atomic import clear_leftovers
from densify.outputs.kitti_tree import write_readme
from densify.readers.timeline import format_frames

_log = logging.getLogger("densify")

CACHE_BYTES = 10 * 1024**3
"""Bound of what is kept on disk for later runs."""
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
        """Over the keys that are done, and their cameras."""
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
    memory_bytes: int | None = None,
    cache_bytes: int = CACHE_BYTES,
    verify: bool = False,
    links: bool = False,
    report: Callable[[Summary], None] | None = None,
) -> Summary:
    """Every key of whole recordings, as a training set in ``out``.

    data: recordings, as `densify.open_sequence` takes them. keys: all if None, else those of frames
    ``start`` to ``stop`` - 1 by ``step``. recipe: window, method, cameras and the like, the usual
    ones if None. num_workers: processes; 1 works in this one, None takes as many as cores, free
    memory and keys suffice for (a script that starts several must be importable:
    ``if __name__ == "__main__"``). scheduler: address of a Dask scheduler whose workers are used
    instead; they need the same files at the same paths; ``tcp://`` trusts everybody on that
    network, ``tls://`` takes certificates. shard: (i, n), the i-th of n parts of the work, from 1;
    parts may run at the same time on machines that share ``out``. memory_bytes: of all processes
    together; fewer are started where it does not suffice, and one of several that takes more than
    its share is replaced. cache_bytes: bound of what is kept on disk for later runs. verify:
    compare finished files with their recorded hashes, and make damaged ones anew. links: of the
    tree, for loaders of others, see `densify.dataset.links`. report: called before the first key
    and after every one.

    Run again, it goes on where it was stopped, however that happened: finished keys are kept, keys
    that failed are tried again. The files do not depend on the number of processes, on shards or on
    interruptions. What became of a key is in the manifest (`densify.dataset.manifest`).

    Raises InputError for what cannot be used, and where another run is at work on the same part;
    ComputationError where the disk is full or the workers are lost: what is finished is kept.
    """
    if isinstance(data, str):
        raise InputError(f"data: got {data!r}, expected a list of recordings, such as [{data!r}]")
    out, recipe = Path(out), recipe or Recipe()
    check_engine(recipe.config.flow.engine)
    drives = plan(data, keys, recipe)
    check_place(out)
    if links and recipe.layout != "kitti-depth":
        raise InputError(f"--links: of --layout kitti-depth, got --layout {recipe.layout}")
    steps_folder()
    check_workers(num_workers, scheduler)
    num_started = num_processes(num_workers, memory_bytes, recipe, drives)
    of_workers = memory_bytes and memory_bytes - int(BASE_BYTES)
    with Manifest(out, shard) as manifest:
        write_plan(out, recipe, drives)
        with _log_file(out, shard):
            clear_leftovers(out)
            _explain(out, recipe)
            if links:
                make_links(out, drives)
            drives = _part(drives, shard)
            done = _Done(out, drives, report, verify)
            left = done.left(drives)
            _announce(out, recipe, left, done.summary().num_keys, num_started)
            todo = _tasks(left, recipe, out, cache_bytes)
            if report is not None:
                report(done.summary())
            with _kept_told(done):
                if todo:
                    with open_workers(num_started, scheduler, of_workers) as workers:
                        for record in _records(run_tasks(todo, workers)):
                            manifest.append(record)
                            done.add(record)
                    clear_leftovers(out)  # of workers that were killed
    return done.summary()


def _explain(out: Path, recipe: Recipe) -> None:
    """Write the README of a tree whose layout is not ours."""
    if recipe.layout == "kitti-depth":
        settings = as_mapping(recipe.config)
        write_readme(out, method=recipe.method, window=recipe.window, settings=settings)


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
        self._num_made, self._started = 0, time.monotonic()

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
        seconds = time.monotonic() - self._started
        return Summary(self._records, self._num_keys, self._num_made, seconds)

    def kept(self) -> str:
        num_kept = sum(record.status != "failed" for record in self._records.values())
        return f"{num_kept} of {self._num_keys} keys are finished and kept"


@contextmanager
def _kept_told(done: _Done) -> Iterator[None]:
    """However the block ends early, it is said what is kept; a full disk is a ComputationError."""
    try:
        yield
    except OutputError as error:
        raise ComputationError(f"{error}; {done.kept()}") from error
    except BaseException:
        _log.info(done.kept())
        raise


def _tasks(
    drives: Sequence[PlannedDrive], recipe: Recipe, out: Path, cache_bytes: int
) -> list[Task]:
    run, place = uuid4().hex, out.absolute()
    jobs = [Job(d.source, recipe, place, cache_bytes, code(), run) for d in drives]
    return [task for job, d in zip(jobs, drives, strict=True) for task in tasks(job, d.keys, d.cut)]


def status(out: Path) -> tuple[Summary, list[str]]:
    """How far a set is, finished or not, and the last line of each of its logs.

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
    """Files of finished keys, relative to ``out``, that are missing or hold something else than was
    written, by the hashes in the manifest."""
    records = read_manifests(out).values()
    return [name for r in records if r.status != "failed" for name in damaged_files(r, out)]


def _records(outcomes: Iterator[Outcome]) -> Iterator[KeyRecord]:
    for outcome in outcomes:
        what, *where = outcome.name
        if what == "key":
            if isinstance(outcome.error, OutputError):
                raise outcome.error
            failed = KeyRecord(where[0], where[1], "failed", str(outcome.error))
            yield failed if outcome.error is not None else outcome.value
        elif outcome.error is not None:
            _log.warning("%s of block %d of %s: %s", what, where[1], where[0], outcome.error)
        else:
            _log.debug("%s of block %d of %s: %.1f s", what, where[1], where[0], outcome.value)


def _part(drives: Sequence[PlannedDrive], shard: tuple[int, int] | None) -> list[PlannedDrive]:
    """The blocks of a shard, of all drives: neighbours together, because they share work."""
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
    out: Path, recipe: Recipe, left: Sequence[PlannedDrive], num_keys: int, num_processes: int
) -> None:
    num_left = sum(len(d.keys) for d in left)
    need = sum(len(d.keys) * _bytes_per_key(recipe, d) for d in left)
    free = shutil.disk_usage(out).free
    _log.info(
        "%d keys, %d finished, %d to make with %d worker(s); about %.2f GB needed, %.0f GB free",
        num_keys,
        num_keys - num_left,
        num_left,
        num_processes,
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
    """A line of the log."""
    left_s = summary.seconds_left or 0.0
    told = f" ({record.reason})" if record.reason else ""
    return (
        f"key {record.key} of {record.drive}: {record.status}{told}, "
        f"frames {format_frames(record.frames) or 'none'}, {record.seconds:.1f} s; "
        f"{len(summary.records)} of {summary.num_keys}, "
        f"{summary.seconds / summary.num_made:.2f} s a key, {left_s / 60:.1f} min left"
    )


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """A full disk is told of by those who write what counts."""


@contextmanager
def _log_file(out: Path, shard: tuple[int, int] | None) -> Iterator[None]:
    """What is logged goes to ``OUT/densify.log`` too, behind what earlier runs logged."""
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
