# SPDX-License-Identifier: MIT
"""The command as a process: exit codes, warnings, progress, pipes and Ctrl-C."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import Any

import pytest

from densify.cli import main, verbs
from densify.errors import ComputationError
from tests.command import exit_code, refused


def failing(error: BaseException) -> Any:
    def verb(_: Any) -> None:
        raise error

    return verb


def test_exit_codes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(verbs, "info", failing(ComputationError("registration: sweep 3\nis odd")))
    assert refused(capsys, 1, "info") == "densify: registration: sweep 3 is odd"
    monkeypatch.setattr(verbs, "info", failing(KeyboardInterrupt()))
    assert "interrupted" in refused(capsys, 130, "info")
    monkeypatch.setattr(verbs, "info", failing(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        main(["info"])


def test_an_unknown_error_keeps_its_traceback() -> None:
    code = (
        "import sys; from densify import cli; from densify.cli import verbs\n"
        "verbs.info = lambda options: 1 / 0\n"
        "sys.exit(cli.main(['info']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "Traceback" in done.stderr and "ZeroDivisionError" in done.stderr


def test_warnings_are_one_line_on_stderr(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import logging

    def warn(_: Any) -> None:
        logging.getLogger("densify").warning("window cut to frames %d to %d", 0, 5)
        print("result")

    monkeypatch.setattr(verbs, "info", warn)
    assert exit_code("info") == 0 and exit_code("info") == 0
    captured = capsys.readouterr()
    assert captured.out == "result\n" * 2
    assert captured.err == "densify: warning: window cut to frames 0 to 5\n" * 2


def test_progress_shows_on_a_terminal_and_goes_away() -> None:
    code = (
        "import sys; from densify.cli import main, verbs; from densify.cli.screen import *\n"
        "def verb(options):\n"
        "    with progress_on_stderr() as progress:\n"
        "        progress('register', 3, 11)\n"
        "        logging.getLogger('densify').warning('cut')\n"
        "        progress('project', 1, 2)\n"
        "verbs.info = verb; sys.exit(main(['info']))"
    )
    terminal, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    done = subprocess.run([sys.executable, "-c", code], stderr=side, stdout=subprocess.PIPE)
    os.close(side)
    shown = os.read(terminal, 100_000).decode()
    os.close(terminal)
    assert done.returncode == 0 and done.stdout == b""
    assert re.search(r"register\W+27%.*3/11", shown) and re.search(r"project\W+50%.*1/2", shown)
    assert "densify: warning: cut\r\n" in shown
    assert shown.rpartition("1/2")[2].strip(" \r\n").endswith("]")  # wiped by blanks


@pytest.mark.parametrize("command", ["--help", "info"])
def test_a_reader_that_stops_reading_is_no_error(command: str) -> None:
    code = (
        "import sys; from densify import cli; from densify.cli import verbs\n"
        "verbs.info = lambda options: print('result')\n"
        "cli.script()"
    )
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", code, command], stdout=writer, stderr=subprocess.PIPE, text=True
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_interrupt_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["run", "--key", "60", "--window", "5", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "densify", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        # A shell starts its background jobs deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    with process:
        wait_until_computing(process.pid)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert stdout == ""
    errors = [x for x in stderr.splitlines() if not x.startswith("densify: warning: ")]
    assert errors == ["densify: interrupted; nothing was kept of the unfinished result"]
    assert not list(tmp_path.iterdir())


def wait_until_computing(pid: int) -> None:
    """Until the process has used a second of processor time: imports are over, a result is far."""
    for _ in range(600):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") > 2.0:
            return
        time.sleep(0.05)
    pytest.fail("the process does not compute")
