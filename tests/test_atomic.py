# SPDX-License-Identifier: MIT
"""Files whole or not there: a full disk, lost power, killed processes, several machines."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from densify.outputs import atomic
from densify.outputs.atomic import (
    FileRecord,
    clear_leftovers,
    make_folder,
    staged_folder,
    write_file,
)


def everything_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def in_subprocess(code: str, *arguments: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def killed_after_ready(code: str, *arguments: Path) -> None:
    """Run Python code in a process of its own, and kill it once it has printed a line."""
    process = in_subprocess(code, *arguments)
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
    assert process.returncode == -signal.SIGKILL


WAIT = "print('ready', flush=True); time.sleep(60)"

IN_A_FILE = """
import os, sys, time
from pathlib import Path
from densify.outputs.atomic import write_file
os.replace = lambda *_: [print("ready", flush=True), time.sleep(60)]
write_file(Path(sys.argv[1]), b"half")
"""

IN_A_FOLDER = f"""
import sys, time
from pathlib import Path
from densify.outputs.atomic import staged_folder
with staged_folder(Path(sys.argv[1]), ("new",)) as staging:
    (staging / "new").write_text("new")
    {WAIT}
"""

BETWEEN_RENAMES = f"""
import os, sys, time
from pathlib import Path
from densify.outputs.atomic import staged_folder
rename = os.rename
def wait_before_the_second(source, target):
    if target == Path(sys.argv[1]):
        {WAIT}
    rename(source, target)
os.rename = wait_before_the_second
with staged_folder(Path(sys.argv[1]), ("new",)) as staging:
    (staging / "new").write_text("new")
"""


# Power loss


def events(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """What is synced and renamed from now on, in order, by the name of the file or folder."""
    seen: list[tuple[str, str]] = []
    fsync, replace, rename = os.fsync, os.replace, os.rename

    def note_sync(descriptor: int) -> None:
        seen.append(("sync", Path(os.readlink(f"/proc/self/fd/{descriptor}")).name))
        fsync(descriptor)

    def note_replace(source: Path, target: Path) -> None:
        seen.append(("rename", target.name))
        replace(source, target)

    def note_rename(source: Path, target: Path) -> None:
        seen.append(("rename", target.name))
        rename(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_replace)
    monkeypatch.setattr(os, "rename", note_rename)
    return seen


def test_a_durable_file_is_on_the_disk_before_and_after_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = events(monkeypatch)
    write_file(tmp_path / "a.png", b"depth", durable=True)
    aside = seen[0][1]
    assert seen == [("sync", aside), ("rename", "a.png"), ("sync", tmp_path.name)]
    assert aside.startswith(".a.png.") and aside.endswith(".tmp")
    assert (tmp_path / "a.png").read_bytes() == b"depth"


def test_a_new_folder_is_known_to_those_above_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = events(monkeypatch)
    make_folder(tmp_path / "a" / "b" / "c")
    assert sorted(seen) == sorted([("sync", tmp_path.name), ("sync", "a"), ("sync", "b")])
    make_folder(tmp_path / "a" / "b" / "c")
    assert len(seen) == 3


def test_all_of_a_staged_folder_is_on_the_disk_before_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "other").write_text("kept")
    seen = events(monkeypatch)
    with staged_folder(folder, ("new",)) as staging:
        (staging / "new").mkdir()
        (staging / "new" / "file").write_text("new")
        (staging / "link").symlink_to("nowhere")
    named = seen.index(("rename", "out"))
    before = {name for what, name in seen[:named] if what == "sync"}
    assert before >= {"other", "deep", "file", "new", staging.name}
    assert ("sync", tmp_path.name) in seen[named:]


def test_a_file_system_that_cannot_sync_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fsync = os.fsync

    def only_files(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(22, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", only_files)
    write_file(tmp_path / "a", b"1", durable=True)
    assert everything_in(tmp_path) == ["a"]


# A full disk


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_over_the_limit_leaves_nothing_and_keeps_the_old_one(
    tmp_path: Path, durable: bool
) -> None:
    code = f"""
import resource, sys
from pathlib import Path
from densify.outputs.atomic import write_file
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
for name in ("old", "new"):
    try:
        write_file(Path(sys.argv[1]) / name, bytes(5000), durable={durable})
    except OSError as error:
        print(error.strerror)
"""
    (tmp_path / "old").write_text("old")
    with in_subprocess(code, tmp_path) as process:
        out, err = process.communicate(timeout=60)
    assert (out, err) == ("File too large\n" * 2, "")
    assert everything_in(tmp_path) == ["old"]
    assert (tmp_path / "old").read_text() == "old"


@pytest.mark.parametrize("existing", [False, True])
def test_a_folder_that_cannot_be_put_on_the_disk_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: bool
) -> None:
    if existing:
        (tmp_path / "deep" / "out").mkdir(parents=True)
        (tmp_path / "deep" / "out" / "new").write_text("old")
    before = everything_in(tmp_path)
    sync = atomic._sync

    def full(path: Path | str) -> None:
        if Path(path).name == "new":
            raise OSError(28, "No space left on device")
        sync(path)

    monkeypatch.setattr(atomic, "_sync", full)
    with (
        pytest.raises(OSError, match="No space"),
        staged_folder(tmp_path / "deep" / "out", ("new",)) as staging,
    ):
        (staging / "new").write_text("new")
    assert everything_in(tmp_path) == before
    if existing:
        assert (tmp_path / "deep" / "out" / "new").read_text() == "old"


# What killed processes leave


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    place = tmp_path / "train" / "drive" / "proj_depth"
    place.mkdir(parents=True)
    killed_after_ready(IN_A_FILE, place / "a.png")
    killed_after_ready(IN_A_FOLDER, place / "000120")
    left = sorted(place.iterdir())
    assert [path.name.rsplit(".", 3)[0] for path in left] == [".000120", ".a.png"]
    (place / "b.png").write_text("whole")
    (place / ".hidden.tmp").write_text("the user's")
    assert sorted(clear_leftovers(tmp_path)) == left
    assert sorted(path.name for path in place.iterdir()) == [".hidden.tmp", "b.png"]
    assert clear_leftovers(tmp_path) == []


def test_a_folder_lost_between_two_names_comes_back(tmp_path: Path) -> None:
    out = tmp_path / "000120"
    out.mkdir()
    (out / "notes.txt").write_text("the user's")
    killed_after_ready(BETWEEN_RENAMES, out)
    assert not out.exists()
    assert len(clear_leftovers(tmp_path)) == 2
    assert everything_in(tmp_path) == ["000120", "000120/notes.txt"]


def test_a_replaced_folder_that_is_still_there_goes(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    old = atomic._aside(tmp_path / "out", "old")
    dead = old.with_name(old.name.replace(atomic._process(os.getpid()), "999999999-1"))
    dead.mkdir()
    (dead / "depth.png").write_text("old")
    assert clear_leftovers(tmp_path) == [dead]
    assert everything_in(tmp_path) == ["out"]


def test_what_living_processes_and_other_machines_have_aside_stays(tmp_path: Path) -> None:
    mine = atomic._aside(tmp_path / "mine.png", "tmp")
    mine.write_text("under way")
    here = f"{atomic._machine()}.{atomic._process(os.getpid())}"
    for machine in ("elsewhere-4026531836", atomic._machine() + "1"):  # no such process here
        mine.with_name(mine.name.replace(here, f"{machine}.999999999-1")).write_text("under way")
    with in_subprocess(IN_A_FILE, tmp_path / "theirs.png") as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            before = everything_in(tmp_path)
            assert clear_leftovers(tmp_path) == []
            assert everything_in(tmp_path) == before and len(before) == 4
        finally:
            process.kill()


def test_a_process_number_that_came_again_is_another_process(tmp_path: Path) -> None:
    mine = atomic._process(os.getpid())
    aside = atomic._aside(tmp_path / "a.png", "tmp")
    earlier = aside.with_name(aside.name.replace(mine, f"{os.getpid()}-1"))
    earlier.write_text("before the restart")
    assert clear_leftovers(tmp_path) == [earlier]


def test_one_that_has_ended_but_was_not_waited_for_is_dead(tmp_path: Path) -> None:
    process = in_subprocess(IN_A_FILE, tmp_path / "a.png")
    assert process.stdout is not None
    process.stdout.readline()
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it stays as a zombie
    assert len(clear_leftovers(tmp_path)) == 1
    process.communicate()


def test_what_cannot_be_removed_is_told_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    killed_after_ready(IN_A_FOLDER, tmp_path / "000120")
    killed_after_ready(IN_A_FILE, tmp_path / "a.png")

    def deny(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(shutil, "rmtree", deny)
    (gone,) = clear_leftovers(tmp_path)
    assert gone.name.startswith(".a.png.")
    (message,) = (record.getMessage() for record in caplog.records)
    assert "Permission denied" in message and "remove it by hand" in message


def test_host_names_of_every_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, host in enumerate(("node-1.cluster.example", "straße", "a_b", "")):
        monkeypatch.setattr(socket, "gethostname", lambda host=host: host)
        atomic._machine.cache_clear()
        try:
            aside = atomic._aside(tmp_path / f"{number}.png", "tmp")
            match = atomic._ASIDE.fullmatch(aside.name)
            assert match and match["name"] == f"{number}.png"
            assert match["machine"] == atomic._machine()
        finally:
            atomic._machine.cache_clear()


def test_a_record_of_a_file() -> None:
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert FileRecord.of(b"") == FileRecord(0, empty)
