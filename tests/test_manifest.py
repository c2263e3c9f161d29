# SPDX-License-Identifier: MIT
"""The record of what was made: whole and damaged lines, files, and whatever ends the writer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from densify.config.errors import InputError, OutputError
from densify.dataset.manifest import (
    FileRecord,
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    read_manifests,
)

DRIVE = "2011_09_26_drive_0013_sync"


def record(key: int, drive: str = DRIVE, **others) -> KeyRecord:
    files = {f"val/{drive}/{key:010d}.png": FileRecord.of(b"%d" % key)}
    fields = {"status": "done", "frames": tuple(range(key - 1, key + 2)), "files": files}
    return KeyRecord(drive, key, **{**fields, "scores": {"ghost": 0.5}, "seconds": 2.5, **others})


def write_lines(path: Path, *records: KeyRecord) -> bytes:
    data = b"".join(r.to_line() for r in records)
    path.write_bytes(data)
    return data


def keys(root: Path) -> list[int]:
    return [key for _, key in read_manifests(root)]


# One record


def test_a_line_is_what_the_contract_says() -> None:
    digest = "ef2d127de37b942baad06145e54b0c619a1f22327b2ebbcfbec78f5564afe39d"
    assert json.loads(record(5).to_line()) == {
        "drive": DRIVE,
        "key": 5,
        "status": "done",
        "reason": None,
        "frames": [4, 5, 6],
        "files": {f"val/{DRIVE}/0000000005.png": {"bytes": 1, "sha256": digest}},
        "scores": {"ghost": 0.5},
        "seconds": 2.5,
        "warnings": [],
    }
    scores = {"a": np.float32(0.5), "b": np.nan, "c": [np.int64(3), np.inf], "d": {"e": (1, None)}}
    back = KeyRecord.from_line(record(1, scores=scores).to_line())
    assert back.scores == {"a": 0.5, "b": None, "c": [3, None], "d": {"e": [1, None]}}


BAD_LINES = [b"", b"{}", b"null", b"[1]", b"\0" * 40, b"\xff\xfe{", b"hello", b"[" * 100_000]
BAD_LINES += [
    record(5).to_line().replace(*change)
    for change in (
        (b'"done"', b'"dome"'),
        (b'"files": {', b'"files": {"a": 1, '),
        (b'"scores": {"ghost": 0.5}', b'"scores": []'),
        (b'"drive"', b'"DRIVE"'),
    )
]


@pytest.mark.parametrize("line", BAD_LINES, ids=range(len(BAD_LINES)))
def test_damaged_lines_are_no_record(line: bytes) -> None:
    with pytest.raises(ValueError):
        KeyRecord.from_line(line)


# Reading


def test_a_torn_last_line_is_left_out(tmp_path: Path, caplog) -> None:
    """Cut at any place, as by a killed writer, and zeros after a power failure."""
    path = tmp_path / "manifest.jsonl"
    assert read_manifests(tmp_path) == {}
    start, line = write_lines(path, record(1), record(2)), record(3).to_line()
    for end in (*(line[:cut] for cut in range(0, len(line) - 1, 7)), bytes(4096)):
        path.write_bytes(start + end)
        assert keys(tmp_path) == [1, 2]
    with Manifest(tmp_path) as manifest:
        manifest.append(record(4))
    assert keys(tmp_path) == [1, 2, 4]
    assert not caplog.records


def test_damage_in_the_middle_costs_only_its_key_and_is_told(tmp_path: Path, caplog) -> None:
    path = tmp_path / "manifest.jsonl"
    lines = [record(key).to_line() for key in range(6)]
    lines[1] = lines[1][:40] + bytes(30) + lines[1][70:]
    lines[4] = lines[4][:20] + b"\n"
    lines[5] = lines[5].replace(b'"drive"', b'"later": [1], "drive"')  # of another version
    path.write_bytes(b"".join(lines))
    assert keys(tmp_path) == [0, 2, 3, 5]
    (message,) = (r.getMessage() for r in caplog.records)
    assert all(part in message for part in (str(path), "2 of 6", "line 2", "made again"))
    with Manifest(tmp_path):
        pass
    assert path.read_bytes() == b"".join(lines[i] for i in (0, 2, 3, 5))


def test_which_line_of_a_key_counts(tmp_path: Path) -> None:
    """The last of a file; between shards one that is done, else one put aside."""
    failed, aside = (record(1, status=status, files={}) for status in ("failed", "aside"))
    write_lines(tmp_path / "manifest.jsonl", record(1), record(7, drive="0"), failed)
    assert read_manifests(tmp_path) == {("0", 7): record(7, drive="0"), (DRIVE, 1): failed}
    for first, second in ((aside, record(1)), (record(1), failed)):
        write_lines(tmp_path / "manifest-1of2.jsonl", first, record(11))
        write_lines(tmp_path / "manifest-2of2.jsonl", second)
        assert read_manifests(tmp_path)[DRIVE, 1] == record(1)
    write_lines(tmp_path / "manifest-1of2.jsonl", aside)
    write_lines(tmp_path / "manifest-2of2.jsonl", failed)
    assert read_manifests(tmp_path)[DRIVE, 1] == aside


def test_whole_and_damaged_files(tmp_path: Path) -> None:
    good, lost, empty = record(12), record(2), record(5, files={})
    aside, failed = (record(3 + n, status=s, files={}) for n, s in enumerate(("aside", "failed")))
    (name,), path = good.files, tmp_path / next(iter(good.files))
    assert damaged_files(good, tmp_path) == [name]
    path.parent.mkdir(parents=True)
    path.write_bytes(b"12")
    assert damaged_files(good, tmp_path) == []
    names = {good.name, aside.name}
    assert finished([good, lost, aside, failed, empty], tmp_path) == names
    path.write_bytes(b"21")  # as long, but another
    assert damaged_files(good, tmp_path) == [name]
    assert finished([good, aside], tmp_path) == names
    assert finished([good, aside], tmp_path, verify=True) == {aside.name}
    path.unlink()
    path.mkdir()
    assert damaged_files(good, tmp_path) == [name]


# Writing


def test_the_file_is_ordered_on_closing_and_opening(tmp_path: Path) -> None:
    path = tmp_path / "new" / "out" / "manifest.jsonl"
    written = [record(9, "b"), record(2, "b"), record(10, "a"), record(2, "b", seconds=1.0)]
    with Manifest(path.parent) as manifest:
        for number, one in enumerate(written, start=1):
            manifest.append(one)
            assert path.read_bytes() == b"".join(r.to_line() for r in written[:number])
    ordered = b"".join(written[i].to_line() for i in (2, 3, 0))
    assert path.read_bytes() == ordered
    write_lines(path, *written)
    with Manifest(path.parent):
        assert path.read_bytes() == ordered
    assert sorted(p.name for p in path.parent.iterdir()) == [".manifest.lock", path.name]


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    with Manifest(tmp_path):
        with pytest.raises(InputError, match="another run is at work there; wait"):
            Manifest(tmp_path)
        with Manifest(tmp_path, (1, 2)), Manifest(tmp_path, (2, 2)) as shard:  # something else
            shard.append(record(6))
    with Manifest(tmp_path):  # the lock was let go
        assert keys(tmp_path) == [6]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=f"--out {tmp_path / 'file'}"):
        Manifest(tmp_path / "file")
