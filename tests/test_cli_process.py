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

from densify.cli.answer import Answer
from densify.cli.verbs import info
from densify.config.errors import ComputationError
from tests.command import exit_code, refused


def failing(error: BaseException) -> Any:
    def verb(_: Any) -> None:
        raise error

    return verb


def test_exit_codes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(info, "answer", failing(ComputationError("registration: sweep 3\nis odd")))
    assert refused(capsys, 1, "info") == "densify: registration: sweep 3 is odd"
    monkeypatch.setattr(info, "answer", failing(KeyboardInterrupt()))
    assert "interrupted" in refused(capsys, 130, "info")
    monkeypatch.setattr(info, "answer", failing(MemoryError()))
    assert "out of memory; try a smaller --window" in refused(capsys, 1, "info")
    monkeypatch.setattr(info, "answer", failing(PermissionError(13, "Permission denied", "/a/b")))
    assert refused(capsys, 2, "info") == "densify: /a/b: Permission denied"


@pytest.mark.parametrize("writable", [True, False], ids=["cache", "no cache"])
def test_what_nobody_foresaw_is_a_line_and_a_log(writable, monkeypatch, tmp_path, capsys) -> None:
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700 if writable else 0o777)
    folder.chmod(0o700 if writable else 0o777)  # a folder of everybody's is refused
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(folder))
    monkeypatch.setattr(info, "answer", failing(ZeroDivisionError("not foreseen")))
    line = refused(capsys, 1, "info")
    said = re.fullmatch(
        r"densify: this is a bug in densify; please report it with the log at (/\S+\.log)", line
    )
    assert said is not None
    log = Path(said[1])
    assert (folder / "bugs" in log.parents) == writable
    text = log.read_text()
    log.unlink()
    assert "Traceback" in text and "ZeroDivisionError: not foreseen" in text
    assert text.startswith("densify ") and "command: " in text


def command(redirected: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", "-c", f"{sys.executable} -m densify {redirected}"],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def test_stdout_that_cannot_be_written() -> None:
    full = command("--version >/dev/full")
    assert (full.returncode, full.stderr) == (2, "densify: stdout: No space left on device\n")
    for redirected in ("--version >&-", "--version >&- 2>&- <&-"):
        closed = command(redirected)
        assert (closed.returncode, closed.stdout, closed.stderr) == (0, "", "")
    assert command("info --data nowhere 2>&-").returncode == 2
    assert command("info --data nowhere 2>/dev/full").returncode == 2


def test_a_terminal_of_ascii_only() -> None:
    done = command("run --help", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == 0 and "\\u2026" in done.stdout and done.stderr == ""


def test_warnings_of_others_are_not_shown(monkeypatch, capsys) -> None:
    import warnings

    def warn(_: Any) -> list[Answer]:
        warnings.warn("divide by zero encountered", RuntimeWarning, stacklevel=1)
        return []

    monkeypatch.setattr(info, "answer", warn)
    assert exit_code("info") == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("run", "--key", "120", "--window", "9" * 19), "argument --window: got '999"),
        (("run", "--key", "1" * 5000), "argument --key: got '1111"),
        (("run", "--key", "120", "--cache-size", "1e300T"), "got '1e300T', expected a size"),
        (("run", "--key", "120", "--cache-size", "nanG"), "expected a number above 0"),
        (("info", "--data", "street?seed=1&seed=2"), "an option is given twice"),
        (("info", "--data", f"street?seed={'1' * 5000}"), "of up to 18 digits"),
        (("info", "--data", "x" * 5000), "File name too long"),
        (("evaluate", "x" * 5000, "y"), "File name too long"),
        (("flow", f"{'x' * 5000}.npy", "y.npy"), "File name too long"),
        (("run", "--key", "120", "--prior", "x" * 5000), "File name too long"),
        (("run", "--key", "120", "--config", "x" * 5000), "File name too long"),
        (("export", "x" * 5000), "File name too long"),
        (("dataset", "--status", "x" * 5000), "File name too long"),
        (("dataset", "--out", "x" * 5000), "File name too long"),
        (("run", "--key", "120", "--out", ""), "got an empty argument after '--out'"),
    ],
    ids=lambda value: " ".join(value)[:60] if isinstance(value, tuple) else "",
)
def test_hostile_arguments_are_refused_in_a_line(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, 2, *arguments)
    assert says in line and len(line) < 1100
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (("--workers", "0"), "--workers 0: expected 1 or more"),
        (("--scheduler", "x"), "scheduler x: "),
    ],
    ids=str,
)
def test_a_set_is_not_begun_before_all_is_known_to_fit(option, says, capsys, tmp_path):
    out = tmp_path / "set"
    assert says in refused(capsys, 2, "dataset", "--out", out, "--keys", "100:102", *option)
    assert not out.exists()


def test_arguments_of_python_of_a_wrong_kind() -> None:
    import densify
    from densify.config.errors import InputError

    street = densify.open_sequence("street")
    with pytest.raises(InputError, match=r"--window '1': expected a whole number"):
        densify.run(street, 120, "1")
    with pytest.raises(InputError, match=r"cameras: got 'image_02', expected a list"):
        densify.run(street, 120, 1, cameras="image_02")


def test_warnings_are_one_line_on_stderr(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import logging

    def warn(_: Any) -> list[Answer]:
        logging.getLogger("densify").warning("window cut to frames %d to %d", 0, 5)
        return [Answer("result")]

    monkeypatch.setattr(info, "answer", warn)
    assert exit_code("info") == 0 and exit_code("info") == 0
    captured = capsys.readouterr()
    assert captured.out == "result\n" * 2
    assert captured.err == "densify: warning: window cut to frames 0 to 5\n" * 2


def test_progress_shows_on_a_terminal_and_goes_away() -> None:
    code = (
        "import logging, sys; from densify.cli import main; from densify.cli.verbs import info\n"
        "from densify.cli.progress import progress_on_stderr\n"
        "def verb(options):\n"
        "    with progress_on_stderr() as progress:\n"
        "        progress('register', 3, 11)\n"
        "        logging.getLogger('densify').warning('cut')\n"
        "        progress('project', 1, 2)\n"
        "    return []\n"
        "info.answer = verb; sys.exit(main(['info']))"
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
        "import sys; from densify import cli; from densify.cli.verbs import info\n"
        "info.answer = lambda options: [cli.answer.Answer('result')]\n"
        "cli.script()"
    )
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", code, command], stdout=writer, stderr=subprocess.PIPE, text=True
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_leaving_says_nothing_and_does_what_others_registered() -> None:
    pytest.importorskip("velodyne_decoder")  # whose binding reports what is not given back
    code = (
        "import atexit, sys, velodyne_decoder; from densify import cli\n"
        "from densify.cli.verbs import info\n"
        "def answer(options):\n"
        "    atexit.register(print, 'registered', flush=True)\n"
        "    raise cli.InputError('bad')\n"
        "info.answer = answer; cli.script()"
    )
    command = [sys.executable, "-c", code, "info"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, "registered\n", "densify: bad\n")


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
    besides = ("densify: warning: ", "densify: rendering ", "densify: compiling ")
    errors = [x for x in stderr.splitlines() if not x.startswith(besides)]
    assert errors == ["densify: interrupted; what was unfinished is not kept"]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_signals_end_it_as_cleanly(number: int) -> None:
    code = (
        "import os, sys; from densify import cli; from densify.cli.verbs import info\n"
        f"info.answer = lambda options: os.kill(os.getpid(), {int(number)}) or []\n"
        "cli.script()"
    )
    for ignored, expected in ((False, 130), (True, 0)):
        before = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n" * ignored
        if ignored and number != signal.SIGHUP:  # as nohup has it
            continue
        done = subprocess.run(
            [sys.executable, "-c", before + code, "info"], capture_output=True, text=True
        )
        assert (done.returncode, "interrupted" in done.stderr) == (expected, not ignored)


def wait_until_computing(pid: int) -> None:
    """Until the process has used a second of processor time: imports are over, a result is far."""
    for _ in range(600):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") > 2.0:
            return
        time.sleep(0.05)
    pytest.fail("the process does not compute")
