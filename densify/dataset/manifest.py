# SPDX-License-Identifier: MIT
"""Record the key sweeps of a training set in a manifest, one JSON line for each.

The file is ``OUT/manifest.jsonl``, or ``OUT/manifest-2of4.jsonl`` for the second of four shards::

    drive, key       the recording's name and the frame number
    status, reason   done, aside (made, but beyond a limit of the scores and not kept) or
                     failed; the reason is null for done
    frames           frame numbers of the sweeps in the window
    files            path relative to OUT, with slashes -> bytes, sha256; a picture for aside
    scores           numbers; null if unknown
    seconds          computing time
    warnings         sentences about assumptions and suspicions

A killed process can damage only the last line. A later line of a key sweep replaces an earlier one.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from densify.config.errors import InputError, OutputError
from densify.config.file_content import import_extra, parse_json, read_bytes
from densify.outputs.folders import plain, write_file

Status = Literal["done", "aside", "failed"]
Key = tuple[str, int]
"""The name of a recording and the frame number of a key sweep."""
_STATUSES: tuple[Status, ...] = ("failed", "aside", "done")  # from worst to best
_log = logging.getLogger("densify")


USUAL_SHARES: Mapping[str, tuple[float, float]] = {
    "ghost": (0.0005, 0.0075),
    "outliers": (0.0006, 0.009),
    "expected_outliers": (0.0035, 0.0079),
    "density": (0.36, 0.50),
    "density_filled": (0.49, 0.62),
}
"""Score of a manifest line -> range of 5 to 95 % of 20 keys of KITTI's drive 2011_09_26 0013
(frames 96 to 134, every second, window 5)."""


@dataclass(frozen=True)
class FileRecord:
    """The expected size of a file in bytes and its hexadecimal SHA-256."""

    num_bytes: int
    sha256: str

    @staticmethod
    def of(data: bytes) -> FileRecord:
        """Return the record of a file with this content."""
        return FileRecord(len(data), hashlib.sha256(data).hexdigest())


def describe_files(root: Path, paths: Iterable[Path]) -> dict[str, FileRecord]:
    """Return path relative to ``root`` -> record of the file, for existing files."""
    return {p.relative_to(root).as_posix(): FileRecord.of(p.read_bytes()) for p in paths}


@dataclass(frozen=True)
class KeyRecord:
    """The outcome of one key sweep, with the fields of a manifest line."""

    drive: str
    key: int
    status: Status
    reason: str | None = None
    frames: tuple[int, ...] = ()
    files: Mapping[str, FileRecord] = field(default_factory=dict)
    scores: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> Key:
        """The drive and the frame number."""
        return self.drive, self.key

    def values_of(self, score: str) -> list[float]:
        """Return the known values of a score, one for each camera or a single one, [] for none."""
        score_value = self.scores.get(score)
        values = score_value.values() if isinstance(score_value, Mapping) else [score_value]
        return [value for value in values if value is not None]

    def to_line(self) -> bytes:
        """Return the record as a line of JSON with its newline. Equal records give equal bytes."""
        files = {
            name: {"bytes": file.num_bytes, "sha256": file.sha256}
            for name, file in sorted(self.files.items())
        }
        record = {**vars(self), "files": files, "seconds": round(self.seconds, 3)}
        return (json.dumps(plain(record), allow_nan=False) + "\n").encode()

    @staticmethod
    def from_line(line: bytes) -> KeyRecord:
        """Return the record in a manifest line. Raise ValueError if the line is damaged."""
        try:
            fields = parse_json(line, "a line")
            files = fields["files"].items()
            return KeyRecord(
                drive=str(fields["drive"]),
                key=int(fields["key"]),
                status=_STATUSES[_STATUSES.index(fields["status"])],
                reason=fields["reason"],
                frames=tuple(map(int, fields["frames"])),
                files={name: FileRecord(file["bytes"], file["sha256"]) for name, file in files},
                scores=dict(fields["scores"].items()),
                seconds=float(fields["seconds"]),
                warnings=tuple(map(str, fields.get("warnings", ()))),
            )
        except Exception as error:  # damaged text raises errors of any type
            raise ValueError(f"no record of a key: {error!r}") from error


def manifest(folder: str | Path) -> Any:
    """Return a training set's manifest as a pandas.DataFrame, with a row for each key sweep.

    Columns are ``drive``, ``key``, ``status``, ``reason``, ``seconds``, ``num_sweeps``,
    ``warnings``, and the scores. A score of cameras has a column for each camera, such as
    ``density.image_02``. Raise InputError without pandas, or if the folder has no records.
    """
    pandas = import_extra("pandas", "pandas", "tables of a manifest")
    fields = ("drive", "key", "status", "reason", "seconds")
    rows = [
        {
            **{name: getattr(record, name) for name in fields},
            "num_sweeps": len(record.frames),
            "warnings": "; ".join(record.warnings),
            **record.scores,
        }
        for record in read_manifests(Path(folder)).values()
    ]
    if not rows:
        raise InputError(
            f"{folder}: no key in manifest*.jsonl; expected a folder that make_dataset wrote"
        )
    return pandas.json_normalize(rows)


def describe_pace(records: Iterable[KeyRecord]) -> str:
    """Return the median and the range of the computing times of all tried keys as text."""
    seconds = [record.seconds for record in records]
    if not seconds:
        return ""
    span = f" ({min(seconds):.1f} to {max(seconds):.1f})" if len(seconds) > 1 else ""
    return f"{np.median(seconds):.1f} s a key{span}"


def describe_cost(records: Iterable[KeyRecord]) -> str:
    """Return the computing time and the disk space of all tried keys together as text."""
    records = list(records)
    seconds = sum(record.seconds for record in records)
    num_bytes = sum(file.num_bytes for record in records for file in record.files.values())
    disk = f", {_size(num_bytes)}" if num_bytes else ""
    return f"{_duration(seconds, seconds)} of computing{disk}" if records else ""


def describe_rest(records: Iterable[KeyRecord], num_left: int) -> str:
    """Return the expected time and disk space of the ``num_left`` keys as text, "" for no keys."""
    records = list(records)
    if len(records) < 2 or not num_left:
        return f"{num_left:,} keys are left" if num_left else ""
    usual_s = sorted(record.seconds for record in records)[
        :-1
    ]  # the slowest waited for compilation
    # Quartiles. A few slow keys may raise the mean, which the sum follows, above the upper one.
    low_s, high_s = np.quantile(usual_s, 0.25), max(np.quantile(usual_s, 0.75), np.mean(usual_s))
    sizes = [sum(f.num_bytes for f in r.files.values()) for r in records if r.status == "done"]
    disk = f" and {_size(num_left * float(np.mean(sizes)))}" if any(sizes) else ""
    span = _duration(num_left * low_s, num_left * high_s)
    return f"the other {num_left:,} keys take about {span} in one process{disk}"


def _duration(low_s: float, high_s: float) -> str:
    """Return a range of times in the unit that people use for the longer one."""
    units = ((1, "s", 120), (60, "min", 7200), (3600, "h", math.inf))
    factor, unit, _ = next(row for row in units if high_s < row[2])
    low, high = (f"{max(1.0, value / factor):.0f}" for value in (low_s, high_s))
    return f"{high} {unit}" if low == high else f"{low} to {high} {unit}"


def _size(num_bytes: float) -> str:
    return f"{num_bytes / 1e9:.1f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.0f} MB"


def read_manifests(root: Path) -> dict[Key, KeyRecord]:
    """Return the records of all manifests in a folder, ordered by drive and frame number.

    In a file, the last line of a key sweep counts. If several shards have a key sweep, done counts
    before aside, and aside before failed.
    """
    rank = _STATUSES.index
    records: dict[Key, KeyRecord] = {}
    for path in sorted(root.glob("manifest*.jsonl")):
        for name, (record, _) in _read(path).items():
            if name not in records or rank(record.status) >= rank(records[name].status):
                records[name] = record
    return dict(sorted(records.items()))


def damaged_files(record: KeyRecord, root: Path, by_content: bool = True) -> list[str]:
    """Return the paths, relative to ``root``, of a record's files that are missing or changed.

    A file is changed if its size differs or, with ``by_content``, its hash.
    """

    def is_whole(path: Path, file: FileRecord) -> bool:
        try:
            if path.stat().st_size != file.num_bytes:
                return False
            return not by_content or FileRecord.of(read_bytes(path, file.num_bytes)) == file
        except (InputError, OSError):
            return False

    return [name for name, file in record.files.items() if not is_whole(root / name, file)]


def finished(records: Iterable[KeyRecord], root: Path, verify: bool = False) -> set[Key]:
    """Return the drive and key of each record that needs no second attempt.

    These are records put aside, and done ones with at least one file, whose files are all whole.
    ``verify`` compares files with their hashes. Otherwise only their sizes are compared.
    """
    return {
        record.name
        for record in records
        if record.status == "aside" or (record.status == "done" and record.files)
        if not damaged_files(record, root, verify)
    }


class Manifest:
    """The manifest file of a run or shard for one process, sorted when opened and closed."""

    def __init__(self, root: Path, shard: tuple[int, int] | None = None) -> None:
        """Open the manifest of a training set, or of shard (k, n), and make its folder if needed.

        Raise InputError if another run has the manifest open.
        """
        stem = "manifest" if shard is None else f"manifest-{shard[0]}of{shard[1]}"
        self.path = root / f"{stem}.jsonl"
        with self._errors_explained():
            root.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(root / f".{stem}.lock", os.O_RDWR | os.O_CREAT, 0o666)
            try:
                self._take_lock()
                self._put_in_order()
            except BaseException:
                os.close(self._lock)
                raise

    def __enter__(self) -> Manifest:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        with suppress(OSError, OutputError):  # an unsorted file still has all records
            self._put_in_order()
        os.close(self._lock)

    def append(self, record: KeyRecord) -> None:
        """Add or replace the record of a key sweep. At return, the record is on the disk."""
        with self._errors_explained(), self.path.open("ab") as file:
            file.write(record.to_line())
            file.flush()
            os.fsync(file.fileno())

    def set_aside(
        self,
        reasons: Mapping[Key, str],
        keep_picture: Callable[[KeyRecord], Iterable[Path]],
    ) -> list[KeyRecord]:
        """Delete the files of finished keys, record the reasons, and return the new records.

        ``keep_picture`` returns the paths of files that take their place. Keys that are not done in
        this manifest are left out.
        """
        aside = []
        for name, (record, _) in _read(self.path).items():
            if name not in reasons or record.status != "done":
                continue
            files = describe_files(self.path.parent, keep_picture(record))
            with self._errors_explained():
                # Files first: if the process is killed here, the key sweep is made again.
                for file in record.files:
                    (self.path.parent / file).unlink(missing_ok=True)
            aside.append(replace(record, status="aside", reason=reasons[name], files=files))
            self.append(aside[-1])
            _log.debug("key %d of %s: put aside (%s)", record.key, record.drive, reasons[name])
        return aside

    def _take_lock(self) -> None:
        """Take the lock, which is released when the process ends, even by a crash."""
        root = self.path.parent
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"--out {root}: another run is at work there; wait for it, or use another --out"
            ) from error
        except OSError as error:
            _log.warning("%s: no locks here (%s); start no second run there", root, error.strerror)

    def _put_in_order(self) -> None:
        """Sort the lines of the file, the last line of each key sweep alone."""
        data = b"".join(line for _, (_, line) in sorted(_read(self.path).items()))
        if not self.path.exists() or read_bytes(self.path) != data:
            write_file(self.path, data)

    @contextmanager
    def _errors_explained(self) -> Iterator[None]:
        """Raise OutputError for the errors of the disk in the block."""
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"--out {self.path.parent}: {self.path.name} cannot be written: "
                f"{error.strerror or error}; see to it and run the same command again"
            ) from error


def _read(path: Path) -> dict[Key, tuple[KeyRecord, bytes]]:
    """Return the last record of each key sweep with its line, {} if the file does not exist."""
    lines = read_bytes(path).split(b"\n") if path.exists() else [b""]
    records, damaged = {}, []
    for number, line in enumerate(lines, start=1):
        try:
            record = KeyRecord.from_line(line)
            records[record.name] = (record, line + b"\n")
        except ValueError:
            damaged.append(number)
    if damaged[-1:] == [len(lines)]:  # the last line is empty, or cut by a killed process
        del damaged[-1]
    if damaged:
        told = f"{len(damaged)} of {len(lines) - 1} lines are damaged, the first is line"
        _log.warning("%s: %s %d; their keys are made again", path, told, damaged[0])
    return records
