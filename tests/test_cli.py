# SPDX-License-Identifier: MIT
"""The command line: what it prints and writes, and one line and the right code for every error."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from densify.config import Config, as_mapping, resolve
from densify.config.errors import ComputationError
from tests.command import exit_code, files_in, refused

STREET = "street?sensor=vlp16"
SMALL = f"{STREET}&cameras=fast"
"""With a ninth of the pixels."""
FAST = ["--window", "1", "--config", "fast", "--camera", "fast", "--data", SMALL]


@pytest.fixture(scope="module")
def densified(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One command in a process of its own, as a user runs it."""
    out = tmp_path_factory.mktemp("densified") / "new" / "out"
    command = [
        "run",
        "--key",
        "120",
        *FAST,
        "--out",
        str(out),
        "--set",
        "objective.num_neighbors=40",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "densify", *command],
        capture_output=True,
        text=True,
        cwd=out.parent.parent,
    )
    assert done.returncode == 0, done.stderr
    return SimpleNamespace(out=out, stdout=done.stdout, stderr=done.stderr, command=command)


def test_run_writes_exactly_the_tree_and_names_every_file(densified: SimpleNamespace) -> None:
    expected = {
        "000120/depth/fast.png",
        "000120/depth_filled/fast.png",
        "000120/confidence/fast.png",
        "000120/age/fast.png",
        "000120/cloud.laz",
        "000120/metrics.json",
        "000120/figure.png",
        "000120/curve.png",
        "000120/run.yaml",
        "000120/movers.json",
        "000120/scene/scene.json",
        "000120/scene/image/fast.jpg",
        *(f"000120/scene/{k}/fast.png" for k in ("none", "icp", "truth", "sweep")),
    }
    assert set(files_in(densified.out)) == expected
    named = {line for line in densified.stdout.splitlines() if line.startswith(str(densified.out))}
    assert named == {str(densified.out / name) for name in expected}


def test_run_prints_results_on_stdout_and_no_progress_off_a_terminal(
    densified: SimpleNamespace,
) -> None:
    assert densified.stdout.startswith("key 120, flow: ")
    assert "fast: depth in " in densified.stdout
    assert "%|" not in densified.stderr and "\r" not in densified.stderr
    strangers = [x for x in densified.stderr.splitlines() if not x.startswith("densify: ")]
    assert strangers == []


def test_run_yaml_gives_back_the_configuration(densified: SimpleNamespace) -> None:
    record = yaml.safe_load((densified.out / "000120" / "run.yaml").read_text("utf-8"))
    expected = resolve("fast", ["objective.num_neighbors=40"])
    assert resolve(record["config"]) == expected
    assert record["config"] == as_mapping(expected)
    assert record["data"] == SMALL
    assert record["frames"] == [119, 120, 121]


def test_output_already_there_is_kept(
    densified: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_in(densified.out)
    line = refused(capsys, 2, *densified.command)
    assert str(densified.out) in line and "--overwrite" in line
    assert files_in(densified.out) == before


def test_overwrite_gives_the_same_bytes(densified: SimpleNamespace) -> None:
    before = files_in(densified.out)
    (densified.out / "000120" / "metrics.json").write_text("old")
    assert exit_code(*densified.command, "--overwrite") == 0
    after = files_in(densified.out)
    assert set(after) == set(before)
    for name in before:
        if not name.endswith("run.yaml"):  # holds seconds
            assert after[name] == before[name], name


def test_export_says_what_is_left_and_names_every_file(
    densified: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = densified.out / "000120", tmp_path / "out"
    before = files_in(densified.out)
    command = ["export", run, "--min-confidence", "0.5", "--max-age-ms", "80", "--out", out]
    assert exit_code(*command) == 0
    line, *paths = capsys.readouterr().out.splitlines()
    shares = [
        100 * np.count_nonzero(cv2.imread(str(folder / product / "fast.png"), -1)) / (125 * 414)
        for product in ("depth", "depth_filled")
        for folder in (run, out)
    ]
    named = [float(share) for share in re.findall(r"([\d.]+) %", line)]
    assert line.startswith("fast: depth in ")
    np.testing.assert_allclose(named, shares, atol=0.0501)
    assert shares[0] > shares[1] > 0 and shares[2] > shares[3] >= shares[1]
    assert sorted(paths) == sorted(str(out / name) for name in files_in(out))
    assert files_in(densified.out) == before
    assert "--overwrite" in refused(capsys, 2, *command)
    assert exit_code(*command, "--overwrite") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--min-confidence", "1.5"], "--min-confidence 1.5: expected a number from 0 to 1"),
        (["--min-confidence", "high"], "invalid float value: 'high'"),
        (["--max-age-ms", "-1"], "--max-age-ms"),
    ],
)
def test_export_refuses_in_one_line(
    densified: SimpleNamespace,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    run = densified.out / "000120"
    assert words in refused(capsys, 2, "export", run, *arguments)
    assert "no run.yaml" in refused(capsys, 2, "export", run.parent)


def test_compare_prints_a_table_and_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["compare", "--key", "120", *FAST, "--methods", "none, icp,flow"]
    assert exit_code(*command, "--out", tmp_path / "out") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["none", "icp", "flow"]
    for row in (
        *("points", "fast density, measured", "ghost rate"),
        *("fast truth, moving, outliers", "fast key held out, all, coverage"),
    ):
        assert any(line.startswith(row) for line in lines), row
    files = set(files_in(tmp_path / "out"))
    beside = {name for name in files if name.startswith("000120/compare/")}
    assert files - beside == {"000120/compare.json", "000120/compare.png"}
    assert {"000120/compare/depth/fast.png", "000120/compare/cloud.laz"} < beside
    table = json.loads((tmp_path / "out" / "000120" / "compare.json").read_text("utf-8"))
    assert list(table["methods"]) == ["none", "icp", "flow"]
    num_points = int(next(x for x in lines if x.startswith("points")).split()[3].replace(",", ""))
    assert num_points == table["methods"]["flow"]["num_points"]


@pytest.mark.parametrize("verb", ["run", "compare"])
def test_short_options_are_knobs(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from densify.pipeline import run as pipeline

    seen: list[Any] = []

    def stop(*arguments: Any) -> None:
        seen.extend(arguments)
        raise ComputationError("enough")

    monkeypatch.setattr(pipeline, {"run": "run_keys"}.get(verb, verb), stop)
    command = [verb, "--key", "120", "--out", tmp_path, "--set", "output.movers=drop"]
    short = ["--flow", "npz:some/flow", "--at", "sweep", "--movers", "separate"]
    assert exit_code(*command, *short) == 1
    (config,) = (a for a in seen if isinstance(a, Config))
    assert config.flow.engine == "npz:some/flow" and config.project.at == "sweep"
    assert config.output.movers == "separate"
    if verb == "compare":
        assert ("none", "icp", "icp-far", "paper", "flow") in seen
    seen.clear()
    assert exit_code(*command) == 1
    (config,) = (a for a in seen if isinstance(a, Config))
    assert config == resolve(None, ["output.movers=drop"])


def test_info_prints_what_the_street_holds(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("info", "--data", STREET) == 0
    out = capsys.readouterr().out
    assert "0-159" in out and "image_02" in out and "image_03" in out


def test_simulate_writes_a_drive_that_info_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "simulate",
        "--out",
        str(tmp_path / "sim"),
        "--sensor",
        "vlp16",
        "--frames",
        "120:122",
        *("--hz", "20", "--tilt", "-5"),
    ]
    assert exit_code(*command, "--camera", "image_02") == 0
    out = capsys.readouterr().out
    assert out.startswith("2 frames; open them with --data ")
    drive = Path(out.strip().rpartition(" ")[2])
    bins = sorted(path.name for path in (drive / "velodyne_points" / "data").iterdir())
    assert bins == ["0000000120.bin", "0000000121.bin"]
    assert exit_code("info", "--data", drive) == 0
    out = capsys.readouterr().out
    assert "120-121" in out and "20.00 Hz" in out
    before = files_in(tmp_path)
    assert "--overwrite" in refused(capsys, 2, *command, "--camera", "image_02")
    assert files_in(tmp_path) == before


# One command each that cannot work, and what its one line must say. {tmp} is an empty folder.
RUN = ["run", "--key", "120", "--out", "{tmp}/out"]
BAD_COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "no verb": ([], ["VERB"]),
    "unknown verb": (["densfy"], ["'densfy'", "compare"]),
    "no key": (["run"], ["--key", "densify run --help"]),
    "key is no number": (["run", "--key", "x"], ["--key", "'x'", "whole number"]),
    "negative window": ([*RUN, "--window", "-1"], ["--window", "-1"]),
    "abbreviated option": ([*RUN, "--win", "3"], ["--win"]),
    "unknown method": ([*RUN, "--method", "magic"], ["'magic'", "icp"]),
    "unknown method to compare": (
        ["compare", "--key", "120", "--data", STREET, "--methods", "icp,magic", "--out", "{tmp}/o"],
        ["--methods magic", "none, icp, "],
    ),
    "unknown engine": ([*RUN, "--flow", "magic"], ["flow.engine", "'magic'", "npz:DIR"]),
    "unknown moment": ([*RUN, "--at", "noon"], ["--at", "'noon'", "camera", "sweep"]),
    "unknown fate of movers": ([*RUN, "--movers", "hide"], ["--movers", "'hide'", "separate"]),
    "missing folder": ([*RUN, "--data", "{tmp}/absent"], ["{tmp}/absent", "no such folder"]),
    "empty folder": ([*RUN, "--data", "{tmp}"], ["{tmp}", "velodyne_points"]),
    "empty folder, info": (["info", "--data", "{tmp}"], ["{tmp}", "velodyne_points"]),
    "missing drive": ([*RUN, "--data", "kitti:{tmp}/absent"], ["{tmp}/absent"]),
    "key out of range": (
        ["run", "--key", "4000", "--data", STREET, "--out", "{tmp}/out"],
        ["4000", "159"],
    ),
    "unknown camera": (
        [*RUN, "--data", STREET, "--camera", "image_07"],
        ["image_07", "image_02", "image_03"],
    ),
    "unknown preset of the street": ([*RUN, "--data", "street:strt"], ["strt", "highway"]),
    "unknown config": ([*RUN, "--config", "fats"], ["fats", "did you mean fast?"]),
    "unknown key": ([*RUN, "--set", "objective.alfa=3"], ["objective.alfa", "did you mean alpha?"]),
    "unknown section": ([*RUN, "--set", "flwo.alpha=3"], ["flwo", "did you mean flow?"]),
    "wrong type": (
        [*RUN, "--set", "objective.alpha=ten"],
        ["objective.alpha", "'ten'", "a number"],
    ),
    "out of range": ([*RUN, "--set", "objective.alpha=-1"], ["objective.alpha", "-1", "from 0"]),
    "not an assignment": ([*RUN, "--set", "objective.alpha"], ["section.key=value"]),
    "frames reversed": (["simulate", "--out", "{tmp}/o", "--frames", "5:2"], ["A:B", "'5:2'"]),
    "frames beyond": (["simulate", "--out", "{tmp}/o", "--frames", "5:999"], ["5:999", "0:160"]),
    "unknown sensor": (["simulate", "--out", "{tmp}/o", "--sensor", "hdl65"], ["hdl65", "hdl64"]),
    "unknown rate": (["simulate", "--out", "{tmp}/o", "--hz", "15"], ["--hz", "'15'", "20"]),
    "unknown tilt": (["simulate", "--out", "{tmp}/o", "--tilt", "up"], ["tilt 'up'", "degrees"]),
    "sensor without KITTI's times": (
        ["simulate", "--out", "{tmp}/o", "--sensor", "panda"],
        ["carry neither a time", "os128"],
    ),
    "unknown simulated camera": (
        ["simulate", "--out", "{tmp}/o", "--camera", "image_07"],
        ["image_07", "image_02"],
    ),
}


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_bad_command(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command, parts = BAD_COMMANDS[case]
    line = refused(capsys, 2, *(word.replace("{tmp}", str(tmp_path)) for word in command))
    for part in parts:
        assert part.replace("{tmp}", str(tmp_path)) in line
    assert not list(tmp_path.iterdir())


def write_tiny_drive(folder: Path) -> Path:
    """A KITTI drive of five sweeps of 3000 points, with an image at the third."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0099_sync"
    sweeps = drive / "velodyne_points" / "data"
    sweeps.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for frame in range(5):
        columns = rng.uniform(0.1, 1, (3000, 4)) * [30, 20, 3, 1]
        columns.astype("<f4").tofile(sweeps / f"{frame:010d}.bin")
    (drive / "image_02" / "data").mkdir(parents=True)
    cv2.imwrite(
        str(drive / "image_02" / "data" / "0000000002.png"), np.zeros((20, 40, 3), np.uint8)
    )
    eye = "1 0 0 0 1 0 0 0 1"
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: {eye}\nS_rect_02: 40 20\nP_rect_02: 50 0 19.5 0 0 50 9.5 0 0 0 1 0\n"
    )
    (drive.parent / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    return drive


# What is wrong with a drive: a file of it, bytes of that file that are kept (None: the file is
# gone), the exit code, and what the one line must say besides.
SWEEP, CALIB = "velodyne_points/data/000000000{}.bin", "../calib_{}.txt"
BAD_DRIVES: dict[str, tuple[str, int | None, int, list[str]]] = {
    "truncated sweep": (SWEEP.format(2), 1601, 2, ["0000000002.bin", "1601"]),
    "missing key": (SWEEP.format(2), None, 2, ["--key 2", "no such frame"]),
    "sweep of no points": (SWEEP.format(2), 0, 2, ["0000000002.bin", "no points"]),
    "sweep of few points": (SWEEP.format(2), 50 * 16, 2, ["sweep 2", "50 points"]),
    "missing calibration": (CALIB.format("velo_to_cam"), None, 2, ["velo_to_cam.txt: missing"]),
    "malformed calibration": (CALIB.format("velo_to_cam"), 9, 2, ["velo_to_cam.txt: R", "9"]),
}


@pytest.mark.parametrize("case", BAD_DRIVES)
def test_bad_drive(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name, num_bytes, code, parts = BAD_DRIVES[case]
    drive = write_tiny_drive(tmp_path)
    path = drive / name
    if num_bytes is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:num_bytes])
    before = sorted(tmp_path.rglob("*"))
    frames = ["--key", "2", "--window", "2"]
    assert exit_code("run", *frames, "--data", drive, "--out", tmp_path / "out") == code
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("densify: ") and all(part in line for part in parts), line
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("verb", ["run", "compare"])
def test_unwritable_output_is_found_before_the_computation(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from densify.pipeline import run as pipeline

    (tmp_path / "file").write_text("kept")
    computes = {"run": "run_keys"}.get(verb, verb)
    monkeypatch.setattr(pipeline, computes, lambda *_, **__: pytest.fail("computed all the same"))
    line = refused(capsys, 2, verb, "--key", "120", "--out", tmp_path / "file" / "out")
    assert str(tmp_path / "file") in line
    assert files_in(tmp_path) == {"file": b"kept"}
