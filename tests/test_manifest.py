# SPDX-License-Identifier: MIT
"""The record of what was made: lines and files, whole and damaged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from key_records import DRIVE, keys, record, write_files, write_lines

from densify.config.errors import InputError
from densify.dataset.manifest import (
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    is_whole,
    read_manifests,
)
from densify.outputs.atomic import FileRecord

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


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.dictionaries(st.text(), inner, max_size=3) | st.lists(inner, max_size=3),
    max_leaves=5,
)


@given(
    drive=st.text(),
    key=st.integers(0),
    status=st.sampled_from(["done", "aside", "failed"]),
    reason=st.none() | st.text(),
    frames=st.lists(st.integers(0)).map(tuple),
    files=st.dictionaries(st.text(), st.binary().map(FileRecord.of), max_size=3),
    scores=st.dictionaries(st.text(), json_values, max_size=3),
    seconds=st.integers(0, 10**9).map(lambda ms: ms / 1000),
    warnings=st.lists(st.text()).map(tuple),
)
def test_every_record_comes_back_from_one_line(**fields) -> None:
    made = KeyRecord(**fields)
    line = made.to_line()
    assert line.count(b"\n") == 1 and line.endswith(b"\n")
    assert KeyRecord.from_line(line) == made
    assert KeyRecord.from_line(line).to_line() == line


def test_scores_are_plain_json() -> None:
    scores = {"a": np.float32(0.5), "b": np.nan, "c": [np.int64(3), np.inf], "d": {"e": (1, None)}}
    back = KeyRecord.from_line(record(1, scores=scores).to_line())
    assert back.scores == {"a": 0.5, "b": None, "c": [3, None], "d": {"e": [1, None]}}


@pytest.mark.parametrize(
    "wrong",
    [{"status": "dome"}, {"key": "5"}, {"key": True}, {"seconds": float("nan")}, {"reason": 3}]
    + [{"frames": (1, 2.5)}, {"drive": None}, {"files": {"a": FileRecord(1, "abc")}}],
    ids=str,
)
def test_wrong_kinds_of_values_are_no_record(wrong) -> None:
    with pytest.raises(ValueError, match="wrong kind"):
        KeyRecord(**{**vars(record(5)), **wrong})


BAD_LINES = [b"", b"{}", b"null", b"[1]", b"\0" * 40, b"\xff\xfe{", b"hello", b"[" * 100_000]
BAD_LINES += [
    record(5).to_line().replace(*change)
    for change in (
        (b'"done"', b'"dome"'),
        (b'"key": 5', b'"key": "5"'),
        (b"[4, 5, 6]", b"null"),
        (b'"seconds": 2.5', b'"seconds": NaN'),
        (b'"seconds": 2.5', b'"seconds": 1' + b"0" * 400),
        (b'"bytes": 1', b'"bytes": 1.5'),
        (b'"files": {', b'"files": {"a": 1, '),
        (b'"scores": {"ghost": 0.5}', b'"scores": []'),
        (b'"drive"', b'"DRIVE"'),
    )
]


@pytest.mark.parametrize("line", BAD_LINES, ids=range(len(BAD_LINES)))
def test_damaged_lines_are_no_record(line: bytes) -> None:
    with pytest.raises(ValueError):
        KeyRecord.from_line(line)


def test_fields_of_later_versions_are_passed_over_and_kept(tmp_path: Path) -> None:
    line = record(5).to_line().replace(b'"drive"', b'"later": [1], "drive"')
    (tmp_path / "manifest.jsonl").write_bytes(line)
    assert read_manifests(tmp_path) == {(DRIVE, 5): record(5)}
    with Manifest(tmp_path):
        pass
    assert (tmp_path / "manifest.jsonl").read_bytes() == line


# Reading


def test_no_manifest_is_no_records(tmp_path: Path) -> None:
    assert read_manifests(tmp_path) == {}
    (tmp_path / "manifest.jsonl").write_bytes(b"")
    assert read_manifests(tmp_path) == {}


def test_a_last_line_torn_at_any_byte(tmp_path: Path, caplog) -> None:
    """Cut there, and cut there with zeros to its end as after a power loss."""
    path = tmp_path / "manifest.jsonl"
    kept = {record(key).name: record(key) for key in (1, 2)}
    last = record(3)
    line = last.to_line()
    start = write_lines(path, *kept.values())
    for cut in range(len(line) + 1):
        expected = {**kept, last.name: last} if cut >= len(line) - 1 else kept
        path.write_bytes(start + line[:cut])
        assert read_manifests(tmp_path) == expected, cut
        if cut < len(line):
            path.write_bytes(start + line[:cut] + bytes(len(line) - cut))
            assert read_manifests(tmp_path) == kept, cut
    path.write_bytes(start + bytes(4096))
    assert read_manifests(tmp_path) == kept
    assert not caplog.records


def test_a_torn_line_is_no_trouble_for_the_next_run(tmp_path: Path) -> None:
    path = tmp_path / "manifest.jsonl"
    line = record(3).to_line()
    for cut in (*range(0, len(line), 13), len(line) - 1, len(line)):
        start = write_lines(path, record(1), record(2))
        path.write_bytes(start + line[:cut])
        with Manifest(tmp_path) as manifest:
            whole = cut >= len(line) - 1
            assert path.read_bytes() == start + (line if whole else b""), cut
            if cut % 2 == 0:
                manifest.append(record(4))
        assert keys(tmp_path) == [1, 2, *([3] if whole else []), *([] if cut % 2 else [4])]


def test_damage_in_the_middle_costs_only_its_key_and_is_told(tmp_path: Path, caplog) -> None:
    path = tmp_path / "manifest.jsonl"
    lines = [record(key).to_line() for key in range(6)]
    lines[1] = lines[1][:40] + bytes(30) + lines[1][70:]
    lines[4] = lines[4][:20] + b"\n"
    path.write_bytes(b"".join(lines))
    assert keys(tmp_path) == [0, 2, 3, 5]
    (message,) = (r.getMessage() for r in caplog.records)
    assert all(part in message for part in (str(path), "2 of 6", "line 2", "made again"))
    with Manifest(tmp_path):
        pass
    assert path.read_bytes() == b"".join(lines[i] for i in (0, 2, 3, 5))


def test_a_later_line_of_a_key_counts(tmp_path: Path) -> None:
    again = record(1, status="failed", reason="gone", files={})
    write_lines(tmp_path / "manifest.jsonl", record(1), record(2), again)
    assert read_manifests(tmp_path) == {(DRIVE, 1): again, (DRIVE, 2): record(2)}


@pytest.mark.parametrize("done_in", [1, 2, 3])
def test_done_counts_between_shards(tmp_path: Path, done_in: int) -> None:
    failed = record(1, status="failed", reason="killed", files={})
    for k in (1, 2, 3):
        path = tmp_path / f"manifest-{k}of3.jsonl"
        write_lines(path, record(1) if k == done_in else failed, record(10 + k))
    write_lines(tmp_path / "manifest.jsonl", record(7, drive="0"))
    assert read_manifests(tmp_path)[DRIVE, 1] == record(1)
    assert list(read_manifests(tmp_path)) == [("0", 7), *((DRIVE, k) for k in (1, 11, 12, 13))]


def test_put_aside_counts_more_than_failed_between_shards(tmp_path: Path) -> None:
    failed, aside = (record(1, status=status, files={}) for status in ("failed", "aside"))
    for first, second in ((failed, aside), (aside, failed)):
        write_lines(tmp_path / "manifest-1of2.jsonl", first)
        write_lines(tmp_path / "manifest.jsonl", second)
        assert read_manifests(tmp_path)[DRIVE, 1] == aside


def test_a_manifest_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "manifest.jsonl").mkdir()
    with pytest.raises(InputError) as error:
        read_manifests(tmp_path)
    assert str(tmp_path / "manifest.jsonl") in str(error.value)
    with pytest.raises(InputError):
        Manifest(tmp_path)
    (tmp_path / "manifest.jsonl").rmdir()
    with Manifest(tmp_path):  # the lock was let go
        pass


# Files


def test_whole_and_damaged_files(tmp_path: Path) -> None:
    good = record(12)
    (name,) = good.files
    assert not is_whole(good, tmp_path) and damaged_files(good, tmp_path) == [name]
    write_files(tmp_path, good)
    assert is_whole(good, tmp_path) and damaged_files(good, tmp_path) == []
    (tmp_path / name).write_bytes(b"21")  # as long, but another
    assert is_whole(good, tmp_path) and damaged_files(good, tmp_path) == [name]
    (tmp_path / name).write_bytes(b"")
    assert not is_whole(good, tmp_path)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    assert damaged_files(good, tmp_path) == [name]
    assert not is_whole(replace(good, files={}), tmp_path)


def test_what_need_not_be_made_again(tmp_path: Path) -> None:
    done, lost = record(1), record(2)
    aside = record(3, status="aside", reason="drifts", files={})
    failed = record(4, status="failed", reason="no image", files={})
    write_files(tmp_path, done)
    assert finished([done, lost, aside, failed], tmp_path) == {done.name, aside.name}
