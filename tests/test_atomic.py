# SPDX-License-Identifier: MIT
"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from densify.config.errors import OutputError
from densify.outputs.folders import clear_leftovers, file_aside, staged_folder, write_file


def everything_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_a_file_is_replaced_and_has_usual_permissions(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text("old")
    write_file(path, b"new")
    (tmp_path / "usual").write_text("")
    assert path.read_bytes() == b"new" and everything_in(tmp_path) == ["a.png", "usual"]
    assert path.stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path, failure, existing) -> None:
    if existing:
        (tmp_path / "a.h5").write_text("old")
    raised = OutputError if failure is OSError else failure
    with pytest.raises(raised), file_aside(tmp_path / "a.h5") as aside:
        aside.write_text("half")
        raise failure
    assert everything_in(tmp_path) == ["a.h5"] * existing


@pytest.mark.parametrize("linked", [False, True])
def test_a_folder_is_replaced_and_the_entries_of_others_stay(tmp_path: Path, linked: bool) -> None:
    folder = tmp_path / "out"
    real = tmp_path / "elsewhere" / "key" if linked else folder
    (real / "notes" / "deep").mkdir(parents=True)
    if linked:
        folder.symlink_to(real)
    (real / "notes" / "mine").write_text("mine")
    (real / "link").symlink_to("notes")
    (real / "depth").mkdir()
    (real / "depth" / "old").write_text("old")
    with staged_folder(folder, ("depth", "cloud")) as staging:
        (staging / "depth").write_text("new")
    assert everything_in(real) == ["depth", "link", "notes", "notes/deep", "notes/mine"]
    assert (real / "link").is_symlink() and folder.is_symlink() == linked
    assert [p.name for p in real.parent.iterdir()] == [real.name]


@pytest.mark.parametrize("failing_rename", [None, 1, 2])
def test_a_failure_leaves_the_old_folder(tmp_path: Path, monkeypatch, failing_rename) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "depth").write_text("old")
    rename, calls = os.rename, []

    def fail(source, target):
        calls.append(source)
        if len(calls) == failing_rename:
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(os, "rename", fail)
    with pytest.raises(KeyboardInterrupt), staged_folder(tmp_path / "out", ("depth",)) as staging:
        (staging / "depth").write_text("new")
        if failing_rename is None:
            raise KeyboardInterrupt
    assert everything_in(tmp_path) == ["out", "out/depth"]
    assert (tmp_path / "out" / "depth").read_text() == "old"


def test_what_killed_processes_left_goes_and_what_others_write_now_stays(tmp_path: Path) -> None:
    code = """
import os, sys
from pathlib import Path
from densify.outputs.folders import staged_folder
with staged_folder(Path(sys.argv[1]), ()) as staging:
    (staging / "half").write_text("half")
    os._exit(1)
"""
    (tmp_path / "train").mkdir()
    subprocess.run([sys.executable, "-c", code, tmp_path / "train" / "000120"], check=False)
    (tmp_path / "notes.tmp").mkdir()
    left = everything_in(tmp_path)
    assert len(left) == 5
    clear_leftovers(tmp_path)
    assert everything_in(tmp_path) == left
    clear_leftovers(tmp_path, age_s=0)
    assert everything_in(tmp_path) == ["notes.tmp", "train"]
