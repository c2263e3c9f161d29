# SPDX-License-Identifier: MIT
"""The manifest while it is written: nothing that was recorded is lost, whatever ends the writer."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from key_records import DRIVE, keys, record, write_lines

from densify.config.errors import InputError, OutputError
from densify.dataset.manifest import (
    Manifest,
    read_manifests,
)

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
    ordered = [made[2], made[3], made[0]]
    assert path.read_bytes() == b"".join(r.to_line() for r in ordered)
    write_lines(path, *made)
    with Manifest(out):
        assert path.read_bytes() == b"".join(r.to_line() for r in ordered)
    assert sorted(p.name for p in out.iterdir()) == [".manifest.lock", "manifest.jsonl"]


def test_shards_have_their_own_files_and_work_at_once(tmp_path: Path) -> None:
    with Manifest(tmp_path, (1, 2)) as first, Manifest(tmp_path, (2, 2)) as second:
        first.append(record(1))
        second.append(record(2))
        assert keys(tmp_path) == [1, 2]
    names = {p.name for p in tmp_path.iterdir() if not p.name.startswith(".")}
    assert names == {"manifest-1of2.jsonl", "manifest-2of2.jsonl"}
    with pytest.raises(ValueError, match="shard"):
        Manifest(tmp_path, (3, 2))


def test_every_line_is_on_the_disk_before_append_returns(tmp_path: Path, monkeypatch) -> None:
    synced: list[int] = []
    fsync = os.fsync
    sizes = np.cumsum([len(record(key).to_line()) for key in range(3)]).tolist()
    with Manifest(tmp_path) as manifest:
        monkeypatch.setattr(
            os, "fsync", lambda fd: (synced.append(os.fstat(fd).st_size), fsync(fd))
        )
        for key in range(3):
            manifest.append(record(key))
            assert synced == sizes[: key + 1]
        monkeypatch.undo()


def test_a_disk_that_fills_up_costs_only_the_line(tmp_path: Path) -> None:
    """A real limit, reached in the middle of a line; then there is room again."""
    code = """
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
    done = python(code, tmp_path)
    out, err = done.communicate(timeout=60)
    assert err == ""
    message, whole = out.splitlines()
    assert "manifest.jsonl" in message and "File too large" in message and whole == "True"
    assert keys(tmp_path) == [1, 3]


def test_a_manifest_that_cannot_be_put_in_order_is_kept(tmp_path: Path, monkeypatch) -> None:
    manifest = Manifest(tmp_path)
    manifest.append(record(2))
    manifest.append(record(1))

    def full(*_, **__) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OutputError, match="No space left"):
        patch.setattr("densify.dataset.manifest.write_file", full)
        manifest.close()
    assert keys(tmp_path) == [1, 2]
    with Manifest(tmp_path):  # the lock was let go
        pass


# Several runs, and killed ones


def python(code: str, *arguments: Path) -> subprocess.Popen[str]:
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


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


def test_a_second_run_at_once_is_refused(tmp_path: Path) -> None:
    with python(APPENDING, tmp_path) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "0\n"
            with pytest.raises(InputError) as error:
                Manifest(tmp_path)
            with Manifest(tmp_path, (1, 2)):  # a shard is something else
                pass
        finally:
            process.kill()
    message = str(error.value)
    assert "\n" not in message
    assert all(p in message for p in (str(tmp_path), "another run", "wait", "another --out"))
    with Manifest(tmp_path), pytest.raises(InputError, match="another run"):
        Manifest(tmp_path)  # in the same process too


def test_of_many_that_open_at_once_one_at_a_time_is_in(tmp_path: Path) -> None:
    inside, most, refused, errors = [], [], [], []

    def work(key: int) -> None:
        for _ in range(200):
            try:
                with Manifest(tmp_path) as manifest:
                    inside.append(key)
                    most.append(len(inside))
                    manifest.append(record(key))
                    inside.remove(key)
                return
            except InputError:
                refused.append(key)
                threading.Event().wait(0.005)
            except Exception as error:
                errors.append(error)
                return

    threads = [threading.Thread(target=work, args=(key,)) for key in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors and set(most) == {1} and refused
    assert keys(tmp_path) == list(range(6))


@pytest.mark.parametrize("num_read", [1, 40, 200])
def test_a_killed_writer_loses_nothing_it_has_recorded(tmp_path: Path, num_read: int) -> None:
    process = python(APPENDING, tmp_path)
    assert process.stdout is not None
    with process:
        for _ in range(num_read):
            recorded = int(process.stdout.readline())
        process.kill()
        recorded = max([recorded, *map(int, process.stdout.read().split("\n")[:-1])])
    assert process.returncode == -signal.SIGKILL
    found = read_manifests(tmp_path)
    assert set(range(recorded + 1)) <= {key for _, key in found}
    assert len(found) <= recorded + 2  # one may be on the disk that it could not tell of
    assert all(found[DRIVE, key] == record(key) for _, key in found)
    with Manifest(tmp_path) as manifest:
        manifest.append(record(10**7))
    assert read_manifests(tmp_path) == {**found, (DRIVE, 10**7): record(10**7)}


def test_a_file_system_without_locks_is_told(tmp_path: Path, monkeypatch, caplog) -> None:
    def refuse(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with Manifest(tmp_path) as manifest:
        manifest.append(record(1))
    assert keys(tmp_path) == [1]
    (message,) = (r.getMessage() for r in caplog.records)
    assert "No locks available" in message and str(tmp_path) in message


def test_places_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(InputError) as error:
            Manifest(out)
        assert f"--out {out}" in str(error.value) and "\n" not in str(error.value)
    (tmp_path / ".manifest.lock").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        Manifest(tmp_path)
    assert (tmp_path / "file").read_text() == "kept"
