# SPDX-License-Identifier: MIT
"""The record of what was made: whole and damaged lines, files, and whatever ends the writer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from key_records import DRIVE, keys, record, write_files, write_lines

from densify.config.errors import InputError, OutputError
from densify.dataset import manifest as manifest_module
from densify.dataset.manifest import (
    KeyRecord,
    Manifest,
    damaged_files,
    finished,
    read_manifests,
)
from densify.outputs.kitti_tree import FileRecord

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


BAD_LINES = [b"", b"{}", b"null", b"[1]", b"\0" * 40, b"\xff\xfe{", b"hello", b"[" * 100_000]
BAD_LINES += [
    record(5).to_line().replace(*change)
    for change in (
        (b'"done"', b'"dome"'),
        (b'"key": 5', b'"key": "5"'),
        (b"[4, 5, 6]", b"[4, 5.5]"),
        (b'"seconds": 2.5', b'"seconds": NaN'),
        (b'"seconds": 2.5', b'"seconds": 1' + b"0" * 400),
        (b'"bytes": 1', b'"bytes": 1.5'),
        (b'"files": {', b'"files": {"a": 1, '),
        (b'"scores": {"ghost": 0.5}', b'"scores": []'),
        (b'"drive"', b'"DRIVE"'),
        (b'"reason": null', b'"reason": 3'),
    )
]


@pytest.mark.parametrize("line", BAD_LINES, ids=range(len(BAD_LINES)))
def test_damaged_lines_are_no_record(line: bytes) -> None:
    with pytest.raises(ValueError):
        KeyRecord.from_line(line)


# Reading


def test_a_last_line_torn_at_any_byte(tmp_path: Path, caplog) -> None:
    """Cut there, and cut there with zeros to its end as after a power loss."""
    path = tmp_path / "manifest.jsonl"
    assert read_manifests(tmp_path) == {}
    kept = {record(key).name: record(key) for key in (1, 2)}
    last = record(3)
    line = last.to_line()
    start = write_lines(path, *kept.values())
    for cut in range(len(line) + 1):
        expected = {**kept, last.name: last} if cut >= len(line) - 1 else kept
        path.write_bytes(start + line[:cut])
        assert read_manifests(tmp_path) == expected, cut
        if cut % 13 == 0:  # it is no trouble for the next run
            with Manifest(tmp_path) as manifest:
                manifest.append(record(4))
            assert keys(tmp_path) == [1, 2, *([3] if cut >= len(line) - 1 else []), 4]
    path.write_bytes(start + bytes(4096))
    assert read_manifests(tmp_path) == kept
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
    good, lost = record(12), record(2)
    aside = record(3, status="aside", reason="drifts", files={})
    failed = record(4, status="failed", reason="no image", files={})
    (name,) = good.files
    assert damaged_files(good, tmp_path) == [name]
    write_files(tmp_path, good)
    assert damaged_files(good, tmp_path) == []
    empty = record(5, files={})
    names = {good.name, aside.name}
    assert finished([good, lost, aside, failed, empty], tmp_path) == names
    (tmp_path / name).write_bytes(b"21")  # as long, but another
    assert damaged_files(good, tmp_path) == [name]
    assert finished([good, aside], tmp_path) == names
    assert finished([good, aside], tmp_path, verify=True) == {aside.name}
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    assert damaged_files(good, tmp_path) == [name]


# Writing


def test_the_file_is_ordered_on_closing_and_opening(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    path = out / "manifest.jsonl"
    with Manifest(out) as manifest:
        assert manifest.path == path
        made = [record(9, "b"), record(2, "b"), record(10, "a"), record(2, "b", seconds=1.0)]
        for number, one in enumerate(made, start=1):
            manifest.append(one)
            assert path.read_bytes() == b"".join(r.to_line() for r in made[:number])
    ordered = b"".join(r.to_line() for r in (made[2], made[3], made[0]))
    assert path.read_bytes() == ordered
    write_lines(path, *made)
    with Manifest(out):
        assert path.read_bytes() == ordered
    assert sorted(p.name for p in out.iterdir()) == [".manifest.lock", "manifest.jsonl"]


FULL = """
import resource, sys
from pathlib import Path
from key_records import record
from densify.dataset.manifest import Manifest
from densify.config.errors import OutputError
with Manifest(Path(sys.argv[1])) as manifest:
    size = len(record(1).to_line())
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    manifest.append(record(1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * size - 10, hard))
    try:
        manifest.append(record(2))
    except OutputError as error:
        print(error)
    print(manifest.path.stat().st_size == size)
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    manifest.append(record(3))
"""
APPENDING = """
import sys
from pathlib import Path
from key_records import record
from densify.dataset.manifest import Manifest
with Manifest(Path(sys.argv[1])) as manifest:
    for key in range(1_000_000):
        manifest.append(record(key))
        print(key, flush=True)
"""


def python(code: str, *arguments: Path) -> subprocess.Popen[str]:
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_disk_that_fills_up_costs_only_the_line(tmp_path: Path, monkeypatch) -> None:
    """A real limit, reached in the middle of a line; then there is room again."""
    out, err = python(FULL, tmp_path).communicate(timeout=60)
    assert err == ""
    message, whole = out.splitlines()
    assert "manifest.jsonl cannot be written: " in message and whole == "True"
    assert keys(tmp_path) == [1, 3]

    def full(*_, **__) -> None:
        raise OSError(28, "No space left on device")

    with (
        monkeypatch.context() as patch,
        pytest.raises(OutputError, match="No space left"),
        Manifest(tmp_path) as manifest,
    ):
        manifest.append(record(0))
        patch.setattr(manifest_module, "write_file", full)
    assert keys(tmp_path) == [0, 1, 3]
    with Manifest(tmp_path):  # the lock was let go
        pass


def test_a_killed_writer_loses_nothing_it_has_recorded(tmp_path: Path) -> None:
    """While it writes, no other run may."""
    process = python(APPENDING, tmp_path)
    assert process.stdout is not None
    with process:
        for _ in range(40):
            recorded = int(process.stdout.readline())
        with pytest.raises(InputError, match="another run is at work there; wait") as error:
            Manifest(tmp_path)
        assert str(tmp_path) in str(error.value)
        with Manifest(tmp_path, (1, 2)), Manifest(tmp_path, (2, 2)) as shard:  # something else
            shard.append(record(10**6))
        process.kill()
        recorded = max([recorded, *map(int, process.stdout.read().split("\n")[:-1])])
    assert process.returncode == -signal.SIGKILL
    found = read_manifests(tmp_path)
    del found[DRIVE, 10**6]
    assert set(range(recorded + 1)) <= {key for _, key in found}
    assert len(found) <= recorded + 2  # one may be on the disk that it could not tell of
    assert all(found[DRIVE, key] == record(key) for _, key in found)
    with Manifest(tmp_path) as manifest:
        manifest.append(record(10**7))
        with pytest.raises(InputError, match="another run"):
            Manifest(tmp_path)  # in the same process too
    assert read_manifests(tmp_path)[DRIVE, 10**7] == record(10**7)


def test_places_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(OutputError, match=f"--out {out}"):
            Manifest(out)
    assert (tmp_path / "file").read_text() == "kept"
    (tmp_path / "manifest.jsonl").mkdir()
    for use in (read_manifests, Manifest):
        with pytest.raises(InputError, match=str(tmp_path / "manifest.jsonl")):
            use(tmp_path)
    (tmp_path / "manifest.jsonl").rmdir()
    with Manifest(tmp_path):  # the lock was let go
        pass
