# SPDX-License-Identifier: MIT
"""One bar with the time left, what is opened first, and answers for programs."""

from __future__ import annotations

import fcntl
import itertools
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any

import pytest

from densify.cli.answer import Answer, first_of
from densify.cli.progress import Course
from densify.cli.results import FIRST_OF_COMPARISON, FIRST_OF_RUN
from densify.cli.verbs import info
from densify.config.errors import ComputationError, InputError
from densify.pipeline.methods import engines
from tests.command import exit_code
from tests.dataset_scenes import BORDER, FRAMES, copy_drive, sweep_file

# Stages of `densify run` as reported on KITTI drive 0013, key 115; without the short ones and what
# is reported again and again. Two cores that others use too.
REPORTED = (
    *((1.0, "read", 0, 1), (1.4, "register", 0, 1), (5.0, "register", 1, 1)),
    *((5.3, "flow", 0, 1), (5.3, "ground", 0, 1), (5.9, "far", 0, 1)),
    *((6.4, "ground", 1, 1), (6.4, "flow", 0, 1), (7.2, "flow", 1, 1)),
    *((7.7, "flow", 0, 1), (10.7, "flow", 1, 1), (15.7, "far", 1, 1)),
    *((15.7, "far", 0, 1), (17.4, "far", 1, 1), (17.4, "project", 0, 1)),
    *((20.0, "project", 1, 1), (20.0, "score", 0, 1), (20.2, "score", 1, 1)),
    *((20.2, "project", 0, 1), (20.3, "flow", 1, 1), (22.1, "project", 0, 1)),
    *((22.2, "project", 1, 1), (22.2, "score", 0, 1), (24.0, "score", 1, 1)),
    *((24.0, "held out", 0, 1), (24.3, "held out", 1, 1), (24.3, "held out", 0, 1)),
    *((24.3, "held out", 1, 1), (24.3, "held out", 0, 1), (26.1, "held out", 1, 1)),
    *((27.7, "project", 1, 1), (27.7, "score", 0, 1), (28.3, "score", 1, 1)),
    *((28.3, "held out", 0, 1), (31.0, "held out", 1, 1), (31.0, "write", 0, 1)),
)
END_S = 33.8


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def replay(course: Course, clock: Clock, slower: float = 1.0) -> list[tuple[float, float, float]]:
    """(seconds, share, seconds left) twice a second, stages arriving in between."""
    start_s, told, waiting = clock.now_s, [], [*REPORTED]
    while clock.now_s < start_s + END_S * slower:
        clock.now_s += 0.5
        while waiting and start_s + waiting[0][0] * slower <= clock.now_s:
            course.step(*waiting.pop(0)[1:])
        told.append((clock.now_s, *course.at()))
    return told


@pytest.mark.parametrize("slower", [0.5, 1.0, 3.0])
def test_the_bar_never_falls_and_the_time_left_comes_true(slower: float) -> None:
    clock = Clock()
    course = Course(engines(("none", "icp", "flow"), "densify"), clock=clock)
    told = replay(course, clock, slower)
    shares = [share for _, share, _ in told]
    assert shares == sorted(shares) and shares[0] < 0.15 and shares[-1] > 0.95
    steps = [b - a for a, b in itertools.pairwise(shares)]
    assert max(steps) < 0.15  # it does not jump
    end_s = END_S * slower
    for now_s, _, left_s in told:
        if 0.2 * end_s < now_s < 0.8 * end_s:
            assert abs(now_s + left_s - end_s) < 0.35 * end_s, now_s


def test_several_keys_are_one_bar() -> None:
    clock = Clock()
    course = Course(engines(("none", "icp", "flow"), "densify"), 3, clock)
    shares = []
    for _ in range(3):
        shares += [share for _, share, _ in replay(course, clock)]
        course.key_done()
    assert shares == sorted(shares) and shares[-1] > 0.95
    assert course.at() == (1.0, 0.0)
    assert 0.4 < shares[len(shares) // 3 - 1] < 0.6  # the first key takes longest
    course.key_done()
    course.step("flow", 0, 1)  # more than was said does no harm
    assert course.at()[0] == 1.0


def test_the_published_flow_is_known_to_take_long() -> None:
    methods = ("none", "icp", "icp-far", "paper", "flow")
    assert engines(methods, "densify") == ["", "", "", "paper", "densify"]
    clock = Clock()
    with_paper, without = (Course(engines(m, "densify"), clock=clock) for m in (methods, ("flow",)))
    for course in (with_paper, without):
        course.step("ground", 1, 1)
    assert with_paper.at()[1] > 2 * without.at()[1]


def test_a_run_shows_one_bar_on_a_terminal(border_drive: Path, tmp_path: Path) -> None:
    command = [
        *("run", "--key", "40", "--window", "1", "--config", "fast", "--camera", "image_02"),
        *("--data", str(border_drive), "--out", str(tmp_path / "out")),
    ]
    terminal, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "densify", *command], stderr=side, stdout=subprocess.PIPE, text=True
    )
    os.close(side)
    shown = b""
    while True:
        try:
            shown += os.read(terminal, 1 << 16)
        except OSError:  # the other side is closed
            break
    os.close(terminal)
    stdout, _ = process.communicate()
    assert process.returncode == 0
    percents = [int(p) for p in re.findall(r"(\d+)%\|", shown.decode("utf-8", "replace"))]
    assert percents and percents == sorted(percents)
    assert re.search(r"\d+ (s|min) left, [a-z]+", shown.decode("utf-8", "replace"))
    lines = stdout.splitlines()
    first = [line.split()[0] for line in lines[lines.index("open first:") + 1 :]]
    names = ["figure.png", "depth_filled/image_02.png", "cloud.laz"]
    assert first == [str(tmp_path / "out" / "000040" / name) for name in names]
    assert all(Path(path).is_file() for path in first)


def test_what_is_opened_first() -> None:
    key = Path("out/000120")
    names = ["depth/a.png", "depth_filled/a.png", "cloud.laz", "metrics.json", "figure.png"]
    files = [key / name for name in [*names, "run.yaml"]]
    assert [p.name for p in first_of(files, FIRST_OF_RUN)] == ["figure.png", "a.png", "cloud.laz"]
    page = [*files, key / "report.html", Path("film.webp")]
    assert [p.name for p in first_of(page, FIRST_OF_RUN)][:2] == ["report.html", "film.webp"]
    bare = [key / name for name in ("cloud.laz", "metrics.json", "run.yaml", "figure.png")]
    assert len(first_of(bare, FIRST_OF_RUN)) == 3
    compared = [key / name for name in ("compare.json", "compare.png", "compare/cloud.laz")]
    assert len(first_of(compared, FIRST_OF_COMPARISON)) == 3


GIVEN = ("--window", "2", "--method", "icp", "--set", "register.source=dataset", "--json")


def test_json_is_one_object_and_nothing_else(border_drive: Path, tmp_path: Path, capsys) -> None:
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, BORDER).write_bytes(b"short")
    keys = ["--keys", f"{BORDER - 1}:{BORDER + 2}", "--out", tmp_path / "out"]
    assert exit_code("run", "--data", drive, *GIVEN, *keys) == 1
    told = capsys.readouterr()
    answer = json.loads(told.out)
    assert (answer["schema"], answer["verb"], answer["exit_code"]) == (1, "run", 1)
    assert "1 of 3 keys not made" in answer["error"] and answer["error"] in told.err
    assert any("the window is cut" in warning for warning in answer["warnings"])
    assert [key["key"] for key in answer["keys"]] == [BORDER - 1, BORDER, BORDER + 1]
    done, failed, _ = answer["keys"]
    assert "truncated" in failed["error"] and done["error"] is None
    assert done["num_points"] > 1000 and 0 < done["density"]["image_02"]["measured"] < 1
    assert len(answer["open_first"]) == 6
    assert {Path(p) for p in answer["open_first"]} < {Path(p) for p in answer["files"]}
    assert all(Path(path).is_file() for path in answer["files"])


def test_quiet_says_nothing(border_drive: Path, tmp_path: Path, capsys) -> None:
    run = [
        "run",
        "--data",
        border_drive,
        *GIVEN[:-1],
        "--key",
        FRAMES[0],
        "--out",
        tmp_path / "out",
    ]
    assert exit_code(*run, "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / "out" / f"{FRAMES[0]:06d}" / "cloud.laz").is_file()
    assert exit_code(*run, "--quiet") == 2
    told = capsys.readouterr()
    assert told.out == "" and len(told.err.splitlines()) == 1
    assert exit_code(*run, "--quiet", "--json", "--overwrite") == 0
    told = capsys.readouterr()
    (warning,) = json.loads(told.out)["warnings"]
    assert "the window is cut" in warning and told.err == ""


@pytest.mark.parametrize(
    ("error", "code"), [(InputError("bad"), 2), (ComputationError("odd"), 1), (KeyError("x"), 1)]
)
def test_json_says_what_went_wrong(error, code, monkeypatch, capsys) -> None:
    def verb(_: Any) -> Any:
        yield Answer("text", {"rows": [1], "share": float("nan")}, [Path("a")])
        yield Answer("text", {"rows": [2]}, [Path("b")], {Path("b"): "look"})
        raise error

    monkeypatch.setattr(info, "answer", verb)
    assert exit_code("info", "--json") == code
    answer = json.loads(capsys.readouterr().out)
    assert answer["exit_code"] == code and answer["error"]
    assert answer["rows"] == [1, 2] and answer["share"] is None
    assert (answer["files"], answer["open_first"]) == (["a", "b"], ["b"])


def test_json_of_other_verbs(border_drive: Path, tmp_path: Path, capsys) -> None:
    assert exit_code("info", "--data", border_drive, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert BORDER in answer["frames"] and "image_02" in answer["cameras"]
    out = tmp_path / "set"
    made = ["--window", "1", "--method", "icp", "--set", "register.source=dataset"]
    keys = ["--keys", f"{BORDER}:{BORDER + 1}"]
    assert exit_code("dataset", "--data", border_drive, *keys, *made, "--out", out, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["num_keys"], answer["num_done"], answer["num_left"]) == (1, 1, 0)
    assert answer["means"]["density"] > 0 and len(answer["open_first"]) == 3
    assert exit_code("dataset", "--status", out, "--json", "--verify") == 0
    assert json.loads(capsys.readouterr().out)["damaged"] == []
