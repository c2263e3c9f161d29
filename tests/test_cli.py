# SPDX-License-Identifier: MIT
"""The command line: what it prints and writes, and one line and the right code for every error."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from densify.cli import recordings, runs
from densify.cli.commands import parse
from densify.cli.terminal import Answer, config_of, progress_on_stderr
from densify.config import as_mapping, resolve
from densify.config.errors import ComputationError, InputError
from densify.geometry.types import Result
from tests.command import exit_code, files_in, refused
from tests.dataset_scenes import BORDER, FRAMES, copy_drive, sweep_file
from tests.exported import result_of

STREET = "street?sensor=vlp16"
KNOBS = ("--set", "register.source=dataset", "--set", "objective.num_neighbors=40")
GIVEN = ("--window", "2", "--method", "icp", "--set", "register.source=dataset")


@pytest.fixture(scope="module")
def densified(border_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One command in a process of its own, as a user runs it."""
    out = tmp_path_factory.mktemp("densified") / "new" / "out"
    command = ["run", str(border_drive), "--key", str(BORDER), "--window", "1", "--config", "fast"]
    command += ["--out", str(out), *KNOBS]
    done = subprocess.run(
        [sys.executable, "-m", "densify", *command],
        capture_output=True,
        text=True,
        cwd=out.parent.parent,
    )
    assert done.returncode == 0, done.stderr
    return SimpleNamespace(out=out, stdout=done.stdout, stderr=done.stderr)


def test_run_writes_the_tree_and_names_it(border_drive: Path, densified: SimpleNamespace) -> None:
    files = set(files_in(densified.out))
    key = f"{BORDER:06d}"
    maps = ("depth", "depth_filled", "confidence", "age")
    others = ("cloud.laz", "metrics.json", "figure.png", "run.yaml", "movers.json")
    expected = {f"{key}/{name}" for name in (*others, "scene/scene.json")}
    expected |= {f"{key}/{kind}/image_02.png" for kind in maps}
    assert expected <= files
    assert f"\n{len(files)} files in {densified.out / key}\n" in densified.stdout
    assert densified.stdout.startswith(f"key {BORDER}, scene flow: ")
    assert "image_02: depth in " in densified.stdout
    first = densified.stdout.partition("open first:\n")[2].splitlines()
    names = ["figure.png", "image_02.png", "cloud.laz"]
    assert [Path(line.split()[0]).name for line in first] == names
    # No terminal: no bar, and each line is densify's.
    assert "%|" not in densified.stderr
    assert all(line.startswith("densify: ") for line in densified.stderr.splitlines())
    record = yaml.safe_load((densified.out / key / "run.yaml").read_text("utf-8"))
    expected_config = resolve("fast", KNOBS[1::2])
    assert record["config"] == as_mapping(expected_config)
    assert resolve(record["config"]) == expected_config
    assert (record["data"], record["frames"]) == (
        str(border_drive),
        [BORDER - 1, BORDER, BORDER + 1],
    )


def test_output_is_kept_or_replaced_by_the_same_bytes(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    command = ["run", border_drive, "--key", BORDER, *GIVEN, "--out", tmp_path]
    assert exit_code(*command) == 0 and capsys.readouterr()
    before = files_in(tmp_path)
    line = refused(capsys, 2, *command)
    assert str(tmp_path) in line and "--overwrite" in line
    assert files_in(tmp_path) == before
    (tmp_path / f"{BORDER:06d}" / "metrics.json").write_text("old")
    assert exit_code(*command, "--overwrite") == 0
    after = files_in(tmp_path)
    assert set(after) == set(before)
    changed = {name for name in before if after[name] != before[name]}
    assert changed <= {f"{BORDER:06d}/run.yaml"}  # holds seconds


def test_compare_prints_a_table_and_writes_it(border_drive: Path, tmp_path: Path, capsys) -> None:
    command = ["compare", border_drive, "--window", "1", "--config", "fast"]
    command += ["--set", "register.source=dataset", "--methods", "none, icp,flow"]
    assert exit_code(*command, "--out", tmp_path) == 0
    told, middle = capsys.readouterr(), FRAMES[len(FRAMES) // 2]
    assert f"no --key given: taking the middle frame, {middle}, of " in told.err
    assert [path.name for path in tmp_path.iterdir()] == [f"{middle:06d}"]
    lines = told.out.splitlines()
    assert re.split("  +", lines[0])[1:] == ["single sweep", "rigid accumulation", "scene flow"]
    for row in ("image_02 density, measured", "ghost rate", "image_02 key held out, all, coverage"):
        assert any(line.startswith(row) for line in lines), row
    table = json.loads(next(tmp_path.rglob("compare.json")).read_text("utf-8"))
    num_points = int(next(x for x in lines if x.startswith("points")).split()[3].replace(",", ""))
    assert num_points == table["methods"]["flow"]["num_points"]


FEW = {"num_pixels": 900, "num_compared": 14, "coverage": 0.1, "outliers": 1 / 7, "mae_m": 0.5}
MANY = FEW | {"num_compared": 2000, "outliers": 0.25}


def scored(method: str, all_: dict, moving: dict) -> Result:
    return result_of(
        method,
        cameras=("a",),
        density={"a": {"measured": 0.4, "filled": 0.5}},
        held_out={"a": {"measured": {"all": all_, "moving": moving}, "unjudged": None}},
    )


def test_a_share_of_few_pixels_is_a_dash_with_a_reason() -> None:
    results = {"icp": scored("icp", MANY, FEW), "flow": scored("flow", MANY, MANY)}
    lines = runs._comparison(results).splitlines()
    cells = {c[0]: c[1:] for c in (re.split("  +", line) for line in lines)}
    assert cells["a key held out, all, outliers"] == ["25.00 %", "25.00 %"]
    assert cells["a key held out, moving, outliers"] == ["-", "25.00 %"]
    assert cells["a key held out, moving, MAE"] == ["-", "0.500 m"]
    assert cells["a key held out, moving, coverage"] == ["10.0 %", "10.0 %"]
    assert lines[-1] == "-: no score, or fewer than 200 pixels to judge"
    results["icp"] = scored("icp", MANY, MANY)
    assert "fewer than" not in runs._comparison(results)
    told = runs._summary(scored("flow", MANY, FEW)).splitlines()
    assert told[-2:] == [
        "a, key held out: outliers, on moving objects: -",
        "-: fewer than 200 pixels to judge",
    ]
    assert "fewer than" not in runs._summary(scored("flow", MANY, MANY | {"num_compared": 0}))


def test_several_keys_and_one_that_cannot_be_read(border_drive: Path, tmp_path: Path, capsys):
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, BORDER).write_bytes(b"short")
    keys = ["--keys", f"{BORDER - 1}:{BORDER + 2}", "--key", BORDER - 1, "--out", tmp_path / "out"]
    assert exit_code("run", "--data", drive, *GIVEN, *keys, "--json") == 1
    told = capsys.readouterr()
    answer = json.loads(told.out)
    assert (answer["schema"], answer["verb"], answer["exit_code"]) == (1, "run", 1)
    assert "1 of 3 keys not made" in answer["error"] and answer["error"] in told.err
    assert any("the window is cut" in warning for warning in answer["warnings"])
    assert [key["key"] for key in answer["keys"]] == [BORDER - 1, BORDER, BORDER + 1]
    done, failed, _ = answer["keys"]
    assert "truncated" in failed["error"] and done["error"] is None
    assert done["num_points"] > 1000 and 0 < done["density"]["image_02"]["measured"] < 1
    assert len(answer["open_first"]) == 6 and set(answer["open_first"]) < set(answer["files"])
    assert all(Path(path).is_file() for path in answer["files"])
    before = files_in(tmp_path)
    assert exit_code("run", drive, *GIVEN, *keys) == 2  # finished keys are kept
    assert files_in(tmp_path) == before


def test_short_options_are_settings() -> None:
    command = "run --set output.movers=drop --flow npz:some/flow --report --score"
    short = ["flow.engine=npz:some/flow", "output.score=true"]
    short += ["output.report=true", "output.rejected=true"]
    config = config_of(parse(command.split()))
    assert config == resolve(None, ["output.movers=drop", *short])


def test_without_a_key_the_middle_frame_is_taken_and_named(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    assert exit_code("run", border_drive, *GIVEN, "--window", "0", "--out", tmp_path) == 0
    told, middle = capsys.readouterr(), FRAMES[len(FRAMES) // 2]
    named = (
        f"densify: no --key given: taking the middle frame, {middle}, of {FRAMES[0]}-{FRAMES[-1]}"
    )
    assert named in told.err.splitlines()
    assert told.out.startswith(f"key {middle}, ")
    assert [path.name for path in tmp_path.iterdir()] == [f"{middle:06d}"]


def test_the_recording_is_an_argument_or_an_option(border_drive: Path, capsys) -> None:
    told = []
    for arguments in ([border_drive], ["--data", border_drive]):
        assert exit_code("info", *arguments, "--json") == 0
        told.append(json.loads(capsys.readouterr().out))
    assert told[0] == told[1]
    assert BORDER in told[0]["frames"] and "image_02" in told[0]["cameras"]
    assert exit_code("info") == 0
    assert "no recording given: taking the simulator" in capsys.readouterr().err
    assert "got 2 recordings" in refused(capsys, 2, "info", "street", "--data", "street")


# One command each that cannot work, and what its one line must say. {tmp} is an empty folder.
RUN = ["run", "--key", "120", "--out", "{tmp}/out"]
BAD_COMMANDS: list[tuple[list[str], list[str]]] = [
    ([], ["COMMAND"]),
    (["comapre"], ["'comapre'", "did you mean compare?"]),
    ([*RUN, "--windw", "3"], ["--windw", "did you mean --window?", "run --help"]),
    ([*RUN, "--win", "3"], ["--win"]),
    (["info", "kiti:{tmp}/x"], ["kiti:{tmp}/x", "did you mean kitti?"]),
    ([*RUN[:-1], "/dev/null/out", STREET], ["--out /dev/null/out: /dev/null is not a folder"]),
    (["run", "--key", "x"], ["--key", "'x'", "whole number"]),
    (["run", "--key", "1" * 5000], ["argument --key: got '1111"]),
    (["run", "--out", ""], ["got an empty argument after '--out'"]),
    ([*RUN, "{tmp}/absent"], ["{tmp}/absent", "no such folder"]),
    (["run", STREET, "--key", "4000"], ["4000", "159"]),
    (["compare", STREET, "--key", "4000"], ["--key 4000: no such frame", "159"]),
    ([*RUN, STREET, "--camera", "image_07"], ["image_07", "image_02"]),
    ([*RUN, "--set", "objective.alfa=3"], ["objective.alfa", "did you mean alpha?"]),
    (
        ["dataset", "--out", "{tmp}/o", "--set", "dataset.max_gost=1"],
        ["dataset.max_gost", "did you mean max_ghost?"],
    ),
    (["simulate", "--out", "{tmp}/o", "--frames", "5:2"], ["A:B", "'5:2'"]),
]


@pytest.mark.parametrize("case", range(len(BAD_COMMANDS)))
def test_bad_command(case: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command, parts = BAD_COMMANDS[case]
    line = refused(capsys, 2, *(word.replace("{tmp}", str(tmp_path)) for word in command))
    assert len(line) < 1100
    for part in parts:
        assert part.replace("{tmp}", str(tmp_path)) in line
    assert not list(tmp_path.iterdir())


def test_a_bad_drive_is_a_line_and_leaves_nothing(border_drive: Path, tmp_path: Path, capsys):
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    path = sweep_file(drive, BORDER)
    content = path.read_bytes()
    for num_bytes, words in ((1601, [path.name, "1601"]), (800, [f"sweep {BORDER}", "50 points"])):
        path.unlink()
        path.write_bytes(content[:num_bytes])
        before = sorted(tmp_path.rglob("*"))
        command = ["run", drive, "--key", BORDER, "--window", 1, "--out", tmp_path / "o"]
        line = refused(capsys, 2, *command)
        assert all(word in line for word in words), line
        assert sorted(tmp_path.rglob("*")) == before


def answering(monkeypatch: pytest.MonkeyPatch, *answers: Answer | BaseException) -> None:
    """Let ``densify info`` give these answers, or raise."""

    def verb(_: Any) -> Any:
        for answer in answers:
            if isinstance(answer, BaseException):
                raise answer
            yield answer

    monkeypatch.setattr(recordings, "answer_info", verb)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (ComputationError("registration: sweep 3\nis odd"), 1, "registration: sweep 3 is odd"),
        (InputError("bad"), 2, "bad"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 1, "out of memory; try a smaller --window"),
        (PermissionError(13, "Permission denied", "/a/b"), 2, "/a/b: Permission denied"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_errors_are_one_line_and_a_code(error, code, words, monkeypatch, capsys) -> None:
    answering(monkeypatch, error)
    assert words in refused(capsys, code, "info")


def test_an_unforeseen_error_is_a_line_and_a_log(monkeypatch, capsys) -> None:
    answering(monkeypatch, ZeroDivisionError("not foreseen"))
    said = re.search(r"this is a bug in densify; .* (/\S+\.log)$", refused(capsys, 1, "info"))
    assert said is not None
    text = Path(said[1]).read_text()
    Path(said[1]).unlink()
    assert "Traceback" in text and "ZeroDivisionError: not foreseen" in text and "command:" in text


def test_json_joins_answers_and_says_what_went_wrong(monkeypatch, capsys) -> None:
    first = Answer("text", {"rows": [1], "share": float("nan")}, [Path("a")])
    second = Answer("text", {"rows": [2]}, [Path("b")], {Path("b"): "look"})
    answering(monkeypatch, first, second, InputError("bad"))
    assert exit_code("info", "--json") == 2
    answer = json.loads(capsys.readouterr().out)
    assert (answer["exit_code"], answer["error"]) == (2, "bad")
    assert answer["rows"] == [1, 2] and answer["share"] is None
    assert (answer["files"], answer["open_first"]) == (["a", "b"], ["b"])


def test_warnings_are_lines_on_stderr_and_those_of_others_are_not_shown(monkeypatch, capsys):
    import logging

    def warn(_: Any) -> list[Answer]:
        warnings.warn("divide by zero encountered", RuntimeWarning, stacklevel=1)
        logging.getLogger("densify").warning("window cut to frames %d to %d", 0, 5)
        return [Answer("result")]

    monkeypatch.setattr(recordings, "answer_info", warn)
    assert exit_code("info") == 0 and exit_code("info") == 0
    captured = capsys.readouterr()
    assert captured.out == "result\n" * 2
    assert captured.err == "densify: warning: window cut to frames 0 to 5\n" * 2


def test_a_reader_that_stops_reading_is_no_error_and_a_full_disk_is() -> None:
    command = [sys.executable, "-m", "densify", "--help"]
    reader, closed = os.pipe()
    os.close(reader)
    with open("/dev/full", "w") as full:
        for stdout, expected in (
            (closed, (0, "")),
            (full, (2, "densify: stdout: No space left on device\n")),
        ):
            done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True)
            assert (done.returncode, done.stderr) == expected
    os.close(closed)


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "densify", "run", "--key", "60", "--out", "out"]
    process = subprocess.Popen(
        command,
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
    assert (process.returncode, stdout) == (130, ""), stderr
    assert stderr.splitlines()[-1] == "densify: interrupted; what was unfinished is not kept"
    assert not list(tmp_path.iterdir())


def wait_until_computing(pid: int) -> None:
    """Wait until the process has used some processor time: imports are over, a result is far."""
    for _ in range(600):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") > 1.5:
            return
        time.sleep(0.05)
    pytest.fail("the process does not compute")


def test_without_a_terminal_progress_is_a_line_each_ten_seconds_and_at_the_end(
    monkeypatch, capsys
) -> None:
    times_s = iter([1.0, 4.0, 12.0, 12.0, 13.0, *[13.0] * 99])
    monkeypatch.setattr("time.monotonic", lambda: next(times_s))
    with progress_on_stderr() as progress:
        for done in (0, 1, 2, 9):
            progress("far", done, 9)
    title = "registering the road around"
    assert (
        capsys.readouterr().err
        == f"densify: 11 s: {title}, 1 of 9\ndensify: 12 s: {title}, 9 of 9\n"
    )


def test_flow_between_two_files(tmp_path: Path, capsys) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (300, 3)) + np.array([20.0, 0, 0])
    np.save(tmp_path / "a.npy", points)
    np.savez(tmp_path / "b.npz", points=points)
    out = tmp_path / "deep" / "flow.npz"
    command = ["flow", tmp_path / "a.npy", tmp_path / "b.npz", "--out", out]
    assert exit_code(*command) == 0
    assert capsys.readouterr().out.splitlines() == ["300 points, 0 moving", str(out)]
    with np.load(out) as arrays:
        flow = arrays["residual_flow"]
        assert flow.shape == (300, 3) and flow.dtype == np.float32 and not flow.any()
        assert not arrays["moving"].any()
        assert arrays["instance"].tolist() == [-1] * 300
    before = out.read_bytes()
    assert "--overwrite" in refused(capsys, 2, *command)
    assert exit_code(*command, "--overwrite") == 0
    assert out.read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == ["flow.npz"]


@pytest.mark.parametrize(
    ("name", "content", "out", "part"),
    [
        ("absent.npy", None, "f.npz", "absent.npy: cannot be read: No such file"),
        ("flat.npy", np.zeros(9), "f.npz", "flat.npy: got an array of shape (9,)"),
        ("nan.npy", np.diag([1, np.nan, 3]), "f.npz", "1 of 3 points are not finite, the first"),
        ("garbage.npz", b"no zip", "f.npz", "garbage.npz: not a readable .npz"),
        ("b.npy", np.ones((5, 3)), "flow.txt", "flow.txt: expected a name that ends in .npz"),
        ("b.npy", np.ones((5, 3)), "folder.npz", "folder.npz: is a folder"),
        ("b.npy", np.ones((5, 3)), "b.npy/deep/flow.npz", "cannot write in"),
    ],
)
def test_bad_point_files_and_places_for_the_flow(name, content, out, part, tmp_path, capsys):
    np.save(tmp_path / "good.npy", np.ones((5, 3)))
    (tmp_path / "folder.npz").mkdir()
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    elif content is not None:
        np.save(tmp_path / name, content)
    command = ["flow", tmp_path / "good.npy", tmp_path / name, "--out", tmp_path / out]
    assert part in refused(capsys, 2, *command)
