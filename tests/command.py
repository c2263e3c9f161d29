# SPDX-License-Identifier: MIT
"""The command line as tests call it."""

from __future__ import annotations

from pathlib import Path

import pytest

from densify.cli import main


def exit_code(*arguments: str | Path) -> int:
    """Of `main`, or of argparse."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def refused(capsys: pytest.CaptureFixture[str], code: int, *arguments: str | Path) -> str:
    """The one line of a command that must fail with this code and print no result."""
    assert exit_code(*arguments) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    errors = [line for line in lines if not line.startswith("densify: warning: ")]
    assert len(errors) == 1 and errors[0].startswith("densify: "), captured.err
    return errors[0]


def files_in(folder: Path) -> dict[str, bytes]:
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
