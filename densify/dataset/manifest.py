# SPDX-License-Identifier: MIT
"""The record of what was made: ``OUT/manifest.jsonl``, or ``OUT/manifest-2of4.jsonl`` of the second
of four shards, one JSON line per key::

    drive, key   the recording's name and the frame number
    status       done, aside (made, but not good enough to be in the set) or failed
    reason       why it is not done, or null
    frames       of the sweeps it was made of
    files        path relative to OUT, with slashes -> bytes, sha256
    scores       numbers; null where nothing can be said
    seconds      of computing
    warnings     what was assumed or looks wrong, sentences

A line is on the disk before the next one is begun, so whatever kills the writer damages at most the
last one. A damaged line counts as none, and its key is made again. A later line of a key replaces
an earlier one.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import math
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

from densify.config.errors import InputError, OutputError
from densify.config.file_content import open_file, parse_json, read_bytes
from densify.outputs.atomic import FileRecord, make_folder, sync_folder, write_file
from densify.outputs.plain import plain

Status = Literal["done", "aside", "failed"]
Key = tuple[str, int]
"""A recording's name and a frame number."""

log = logging.getLogger("densify")

_PATTERN = "manifest*.jsonl"


@dataclass(frozen=True)
class KeyRecord:
    """What became of one key; the fields are those of a line, see the module. Raises ValueError for
    values of a wrong kind."""

    drive: str
    key: int
    status: Status
    reason: str | None = None
    frames: tuple[int, ...] = ()
    files: Mapping[str, FileRecord] = field(default_factory=dict)
    scores: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        sane = (
            isinstance(self.drive, str)
            and self.status in get_args(Status)
            and isinstance(self.reason, (str, type(None)))
            and all(type(number) is int for number in (self.key, *self.frames))
            and all(type(f.num_bytes) is int and len(f.sha256) == 64 for f in self.files.values())
            and math.isfinite(self.seconds)
            and all(isinstance(warning, str) for warning in self.warnings)
        )
        if not sane:
            raise ValueError(f"KeyRecord: a value of a wrong kind: {self}")

    @property
    def name(self) -> Key:
        return self.drive, self.key

    def to_line(self) -> bytes:
        """One line of JSON with its end; the same record gives the same bytes."""
        record = {
            "drive": self.drive,
            "key": self.key,
            "status": self.status,
            "reason": self.reason,
            "frames": self.frames,
            "files": {
                name: {"bytes": file.num_bytes, "sha256": file.sha256}
                for name, file in sorted(self.files.items())
            },
            "scores": self.scores,
            "seconds": round(self.seconds, 3),
            "warnings": self.warnings,
        }
        return (json.dumps(plain(record), allow_nan=False) + "\n").encode()

    @staticmethod
    def from_line(line: bytes) -> KeyRecord:
        """Fields of later versions are passed over. Raises ValueError for a damaged line."""
        try:
            return _record(parse_json(line, "a line"))
        except (
            InputError,
            KeyError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ) as error:
            raise ValueError(f"no record of a key: {error!r}") from error


def read_manifests(root: Path) -> dict[Key, KeyRecord]:
    """The records of all manifests in a folder, ordered by drive and key.

    Of several lines of a key in one file the last one counts; between the files of shards one that
    is done, else one put aside. A torn last line is passed over, any other damaged line too, with a
    warning. Raises InputError if a manifest cannot be read.
    """
    records: dict[Key, KeyRecord] = {}
    for path in sorted(root.glob(_PATTERN)):
        for name, (record, _) in _read(path).items():
            if name not in records or _rank(record) >= _rank(records[name]):
                records[name] = record
    return dict(sorted(records.items()))


def _rank(record: KeyRecord) -> int:
    return ("failed", "aside", "done").index(record.status)


def is_whole(record: KeyRecord, root: Path) -> bool:
    """Whether all files of a record are there with their size; of a done one, at least one file.

    Looks at no content, see `damaged_files`.
    """
    if record.status == "done" and not record.files:
        return False
    return all(_size(root / name) == file.num_bytes for name, file in record.files.items())


def damaged_files(record: KeyRecord, root: Path) -> list[str]:
    """Paths relative to ``root`` of a record's files that are missing or hold something else."""
    return [name for name, file in record.files.items() if _content(root / name) != file]


def finished(records: Iterable[KeyRecord], root: Path, verify: bool = False) -> set[Key]:
    """Keys that need not be made again: done or put aside, and their files are whole.

    verify: whether their contents are compared with the recorded hashes too, which reads them all.
    """
    return {
        r.name
        for r in records
        if r.status != "failed" and is_whole(r, root) and not (verify and damaged_files(r, root))
    }


class Manifest:
    """The manifest of one run, or of one shard, while it is written; a context manager.

    root: the folder of the set, made if it is not there. shard: (k, n) for the k-th of n, from 1.

    Only one process at a time can have it open. The lock goes with its process, however that ends;
    its hidden file stays: who removes a lock's file takes it from under one who has just opened it,
    and a third then locks a new one. On opening and on closing the file is put in order: one line
    per key, by drive and key, and nothing torn.

    Raises InputError if another process has it open or it cannot be read, OutputError if it cannot
    be written.
    """

    def __init__(self, root: Path, shard: tuple[int, int] | None = None) -> None:
        if shard is not None and not 1 <= shard[0] <= shard[1]:
            raise ValueError(f"shard: got {shard}, expected (k, n) with 1 <= k <= n")
        stem = "manifest" if shard is None else f"manifest-{shard[0]}of{shard[1]}"
        self.path = root / f"{stem}.jsonl"
        self._root = root
        try:
            make_folder(root)
            self._lock = _locked(root / f".{stem}.lock", root)
        except OSError as error:
            raise self._not_written(error) from error
        try:
            self._lines = {name: line for name, (_, line) in _read(self.path).items()}
            self._put_in_order()
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            sync_folder(root)
        except OSError as error:
            os.close(self._lock)
            raise self._not_written(error) from error
        except BaseException:
            os.close(self._lock)
            raise

    def __enter__(self) -> Manifest:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:  # what came before says more; the file goes on without the order
            with suppress(OutputError):
                self.close()

    def append(self, record: KeyRecord) -> None:
        """Add a key's record, or replace it. It is on the disk when this returns; where that fails
        the manifest is as before, and OutputError is raised."""
        line = record.to_line()
        try:
            size = os.fstat(self._file).st_size
            try:
                written = 0
                while written < len(line):
                    written += os.write(self._file, line[written:])
                os.fsync(self._file)
            except BaseException:
                os.ftruncate(self._file, size)  # else the next line would go on behind half of this
                raise
        except OSError as error:
            raise self._not_written(error) from error
        self._lines[record.name] = line

    def close(self) -> None:
        """Put the file in order and let the next one have it. Raises OutputError if the file
        cannot be rewritten; it then is as it was, with all records."""
        os.close(self._file)
        try:
            self._put_in_order()
        except OSError as error:
            raise self._not_written(error) from error
        finally:
            os.close(self._lock)

    def _put_in_order(self) -> None:
        data = b"".join(line for _, line in sorted(self._lines.items()))
        if _bytes_of(self.path) != data:
            write_file(self.path, data, durable=True)

    def _not_written(self, error: OSError) -> OutputError:
        return OutputError(
            f"--out {self._root}: {self.path.name} cannot be written: {error.strerror or error}; "
            f"see to it and run the same command again"
        )


def _record(fields: Mapping[str, Any]) -> KeyRecord:
    return KeyRecord(
        drive=fields["drive"],
        key=fields["key"],
        status=fields["status"],
        reason=fields["reason"],
        frames=tuple(fields["frames"]),
        files={n: FileRecord(f["bytes"], f["sha256"]) for n, f in fields["files"].items()},
        scores=dict(fields["scores"].items()),
        seconds=float(fields["seconds"]),
        warnings=tuple(fields.get("warnings", ())),
    )


def _read(path: Path) -> dict[Key, tuple[KeyRecord, bytes]]:
    """The last record of each key with its line; empty if there is no such file."""
    *lines, tail = (_bytes_of(path) or b"").split(b"\n")
    records, damaged = {}, []
    for number, line in enumerate(lines, start=1):
        try:
            record = KeyRecord.from_line(line)
            records[record.name] = (record, line + b"\n")
        except ValueError:
            damaged.append(number)
    if damaged:
        log.warning(
            "%s: damaged lines passed over: %d of %d, the first is line %d; their keys are made "
            "again",
            path,
            len(damaged),
            len(lines),
            damaged[0],
        )
    with suppress(ValueError):  # torn, unless only its end is missing
        record = KeyRecord.from_line(tail)
        records[record.name] = (record, tail + b"\n")
    return records


def _bytes_of(path: Path) -> bytes | None:
    """None if there is no such file."""
    return read_bytes(path) if path.exists() else None


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def _content(path: Path) -> FileRecord | None:
    try:
        with open_file(path) as file:
            digest = hashlib.sha256()
            while block := file.read(1 << 20):
                digest.update(block)
            return FileRecord(file.tell(), digest.hexdigest())
    except (InputError, OSError):
        return None


def _locked(path: Path, root: Path) -> int:
    """The descriptor of the lock's file, to be closed."""
    lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise InputError(
            f"--out {root}: another run is at work there; wait for it, or use another --out"
        ) from error
    except OSError as error:
        log.warning(
            "%s: this file system has no locks (%s); see that no second run writes there",
            root,
            error.strerror or error,
        )
    return lock
