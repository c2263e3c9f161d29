# SPDX-License-Identifier: MIT
"""Several keys by one command: what is written, and what becomes of keys that cannot be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command import exit_code, files_in, refused
from tests.dataset_scenes import BORDER, copy_drive, sweep_file

GIVEN = ("--window", "2", "--method", "icp", "--set", "register.source=dataset")


def run(drive: Path, out: Path, *options: str | int) -> int:
    return exit_code("run", "--data", drive, *GIVEN, "--out", out, *options)


def test_key_and_keys_together(border_drive: Path, tmp_path: Path, capsys) -> None:
    keys = ["--key", BORDER, "--key", BORDER + 2, "--keys", f"{BORDER - 1}:{BORDER + 2}:2"]
    assert run(border_drive, tmp_path, *keys) == 0
    made = [BORDER - 1, BORDER, BORDER + 1, BORDER + 2]
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{key:06d}" for key in made]
    out = capsys.readouterr().out
    assert [line.split(",")[0] for line in out.splitlines() if line.startswith("key ")] == [
        f"key {key}" for key in made
    ]


def test_a_key_that_cannot_be_read_costs_only_itself(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, BORDER).write_bytes(b"short")
    out = tmp_path / "out"
    assert run(drive, out, "--keys", f"{BORDER - 1}:{BORDER + 2}") == 1
    told = capsys.readouterr()
    assert sorted(p.name for p in out.iterdir()) == [f"{BORDER - 1:06d}", f"{BORDER + 1:06d}"]
    last = told.err.splitlines()[-1]
    assert "1 of 3 keys not made" in last and f"{BORDER:010d}.bin: truncated" in last
    assert f"key {BORDER - 1}: the window is cut" in told.err
    assert run(drive, tmp_path / "alone", "--key", BORDER) == 2
    assert not (tmp_path / "alone").exists()


def test_finished_keys_are_kept_when_another_is_there_already(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    assert run(border_drive, tmp_path, "--key", BORDER) == 0
    before = files_in(tmp_path)
    assert run(border_drive, tmp_path, "--keys", f"{BORDER - 1}:{BORDER + 2}") == 2
    assert files_in(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ([], ["--key K", "--keys A:B"]),
        (["--keys", "500:510"], ["--keys 500:510", "36-44"]),
        (["--key", "500"], ["--key 500: no such frame", "36-44"]),
        (["--keys", "41"], ["--keys", "A:B"]),
    ],
)
def test_keys_that_are_none(
    options: list[str], parts: list[str], border_drive: Path, tmp_path: Path, capsys
) -> None:
    line = refused(
        capsys, 2, "run", "--data", border_drive, *GIVEN, "--out", tmp_path / "out", *options
    )
    assert all(part in line for part in parts)
    assert not (tmp_path / "out").exists()
