# SPDX-License-Identifier: MIT
"""Completion in shells, by the shells themselves."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.command import exit_code


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert exit_code("completion", shell) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ex", {"export"}),
        ("run --ke", {"--key", "--keys"}),
        ("run --method ", {"none", "icp", "flow"}),
        ("bench me", {"memory"}),
    ],
)
def test_bash(typed: str, offered: set[str], tmp_path: Path, capsys) -> None:
    (tmp_path / "script").write_text(script("bash", capsys))
    words = ["densify", *typed.split(" ")]
    shown = " ".join(f"'{word}'" for word in words)
    code = (
        f"source {tmp_path}/script; COMP_WORDS=({shown}); COMP_CWORD={len(words) - 1}; "
        "$(complete -p densify | sed 's/.*-F \\([^ ]*\\).*/\\1/'); echo \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == offered


@pytest.mark.parametrize("shell", ["zsh", "fish", "tcsh"])
def test_other_shells_take_the_script(shell: str, tmp_path: Path, capsys) -> None:
    text = script(shell, capsys)
    assert "export" in text and "densify" in text
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell} here")
    (tmp_path / "script").write_text(text)
    subprocess.run([program, "-n", tmp_path / "script"], check=True)
