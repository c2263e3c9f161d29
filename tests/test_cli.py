# SPDX-License-Identifier: MIT
"""The command line: what it prints and writes, and one line and the right code for every error."""

from __future__ import annotations

import fcntl
import json
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
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from densify import types
from densify.cli import main, tables, verbs
from densify.config import as_mapping, resolve
from densify.errors import ComputationError, InputError

STREET = "street?sensor=vlp16"
FAST = ["--window", "1", "--config", "fast", "--camera", "image_02", "--data", STREET]


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


@pytest.fixture(scope="module")
def densified(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One command in a process of its own, as a user runs it."""
    out = tmp_path_factory.mktemp("densified") / "new" / "out"
    command = ["run", "--key", "120", *FAST, "--out", str(out), "--set", "flow.num_neighbors=40"]
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
        "000120/depth/image_02.png",
        "000120/depth_filled/image_02.png",
        "000120/confidence/image_02.png",
        "000120/age/image_02.png",
        "000120/cloud.laz",
        "000120/metrics.json",
        "000120/figure.png",
        "000120/run.yaml",
    }
    assert set(files_in(densified.out)) == expected
    named = {line for line in densified.stdout.splitlines() if line.startswith(str(densified.out))}
    assert named == {str(densified.out / name) for name in expected}


def test_run_prints_results_on_stdout_and_no_progress_off_a_terminal(
    densified: SimpleNamespace,
) -> None:
    assert densified.stdout.startswith("key 120, flow: ")
    assert "image_02: depth in " in densified.stdout
    assert "%|" not in densified.stderr and "\r" not in densified.stderr
    strangers = [x for x in densified.stderr.splitlines() if not x.startswith("densify: ")]
    assert strangers == []


def test_run_yaml_gives_back_the_configuration(densified: SimpleNamespace) -> None:
    record = yaml.safe_load((densified.out / "000120" / "run.yaml").read_text("utf-8"))
    expected = resolve("fast", ["flow.num_neighbors=40"])
    assert resolve(record["config"]) == expected
    assert record["config"] == as_mapping(expected)
    assert record["data"] == STREET
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
    command = ["export", run, "--min-confidence", "0.8", "--max-age-ms", "80", "--out", out]
    assert exit_code(*command) == 0
    line, *paths = capsys.readouterr().out.splitlines()
    shares = [
        100
        * np.count_nonzero(cv2.imread(str(folder / product / "image_02.png"), -1))
        / (375 * 1242)
        for product in ("depth", "depth_filled")
        for folder in (run, out)
    ]
    named = [float(share) for share in re.findall(r"([\d.]+) %", line)]
    assert line.startswith("image_02: depth in ")
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
    assert exit_code("compare", "--key", "120", *FAST, "--out", tmp_path / "out") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["none", "icp", "flow"]
    for row in ("points", "image_02 density, measured", "ghost rate", "image_02 moving, outliers"):
        assert any(line.startswith(row) for line in lines), row
    assert set(files_in(tmp_path / "out")) == {"000120/compare.json", "000120/compare.png"}
    table = json.loads((tmp_path / "out" / "000120" / "compare.json").read_text("utf-8"))
    assert list(table["methods"]) == ["none", "icp", "flow"]
    num_points = int(next(x for x in lines if x.startswith("points")).split()[3].replace(",", ""))
    assert num_points == table["methods"]["flow"]["num_points"]


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
    ]
    assert exit_code(*command, "--camera", "image_02") == 0
    out = capsys.readouterr().out
    assert out.startswith("2 frames; open them with --data ")
    drive = Path(out.strip().rpartition(" ")[2])
    bins = sorted(path.name for path in (drive / "velodyne_points" / "data").iterdir())
    assert bins == ["0000000120.bin", "0000000121.bin"]
    assert exit_code("info", "--data", drive) == 0
    assert "120-121" in capsys.readouterr().out
    before = files_in(tmp_path)
    assert "--overwrite" in refused(capsys, 2, *command, "--camera", "image_02")
    assert files_in(tmp_path) == before


def test_flow_between_two_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (300, 3)) + np.array([20.0, 0, 0])
    np.save(tmp_path / "a.npy", points)
    np.savez(tmp_path / "b.npz", points=points)
    out = tmp_path / "deep" / "flow.npz"
    command = ["flow", str(tmp_path / "a.npy"), str(tmp_path / "b.npz"), "--out", str(out)]
    assert exit_code(*command) == 0
    captured = capsys.readouterr().out
    assert captured.splitlines() == ["300 points, 0 moving", str(out)]
    with np.load(out) as arrays:
        assert arrays["flow"].shape == (300, 3) and arrays["flow"].dtype == np.float32
        assert not arrays["flow"].any() and not arrays["moving"].any()
        assert arrays["instance"].tolist() == [-1] * 300
    before = out.read_bytes()
    assert "--overwrite" in refused(capsys, 2, *command)
    assert exit_code(*command, "--overwrite") == 0
    assert out.read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == ["flow.npz"]


def bad_point_files(folder: Path) -> dict[str, Any]:
    """Name of a file made in `folder` -> what the message must say."""
    np.save(folder / "flat.npy", np.zeros(9))
    np.save(folder / "narrow.npy", np.zeros((9, 2)))
    np.save(folder / "words.npy", np.array([["a", "b", "c"]]))
    np.save(folder / "objects.npy", np.array([[{}, {}, {}]], dtype=object), allow_pickle=True)
    np.save(folder / "none.npy", np.zeros((0, 3)))
    np.save(folder / "nan.npy", np.array([[1.0, 2, 3], [1, np.nan, 3]]))
    np.savez(folder / "wrong.npz", cloud=np.zeros((3, 3)))
    np.save(folder / "npy", np.ones((3, 3)))
    (folder / "npy.npy").rename(folder / "array.npz")
    np.savez(folder / "npz", points=np.ones((3, 3)))
    (folder / "npz.npz").rename(folder / "archive.npy")
    np.savez_compressed(folder / "damaged.npz", points=np.arange(300.0).reshape(100, 3))
    damaged = bytearray((folder / "damaged.npz").read_bytes())
    damaged[80:90] = b"\xff" * 10
    (folder / "damaged.npz").write_bytes(damaged)
    (folder / "empty.txt").write_text("")
    (folder / "cut.bin").write_bytes(bytes(37))
    (folder / "garbage.npz").write_bytes(b"no zip")
    (folder / "empty.npy").write_bytes(b"")
    (folder / "words.txt").write_text("x y z\n")
    (folder / "cloud.pcd").write_text("VERSION .7\n")
    return {
        "absent.npy": "no such file",
        "flat.npy": "shape (9,)",
        "narrow.npy": "shape (9, 2)",
        "words.npy": "expected numbers",
        "objects.npy": "not a readable .npy",
        "none.npy": "holds no points",
        "nan.npy": "1 of 2 points are not finite, the first in row 1",
        "wrong.npz": "holds the arrays cloud, expected points",
        "array.npz": "holds a single array; name it .npy",
        "archive.npy": "holds an archive of arrays; name it .npz",
        "damaged.npz": "not a readable .npz",
        "empty.txt": "holds no points",
        "cut.bin": "got 37 bytes, expected a multiple of 16",
        "garbage.npz": "not a readable .npz",
        "empty.npy": "not a readable .npy",
        "words.txt": "not a readable .txt",
        "cloud.pcd": "got .pcd, expected one of .npy, .npz, .txt, .bin",
    }


def test_bad_point_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "good.npy", np.ones((5, 3)))
    for name, part in bad_point_files(tmp_path).items():
        out = tmp_path / "f.npz"
        line = refused(capsys, 2, "flow", tmp_path / "good.npy", tmp_path / name, "--out", out)
        assert name in line and part in line
        assert not out.exists()


@pytest.mark.parametrize("name", ["p.npy", "p.npz"])
def test_flipped_bytes_in_a_point_file_are_no_traceback(name: str, tmp_path: Path) -> None:
    from densify.cli.point_files import read_points

    path = tmp_path / name
    points = np.linspace(-1, 1, 30).reshape(10, 3)
    np.save(path, points) if name == "p.npy" else np.savez_compressed(path, points=points)
    whole = path.read_bytes()
    num_refused = 0
    for i in range(len(whole)):
        for mask in (0x01, 0x08, 0xFF):
            path.write_bytes(whole[:i] + bytes([whole[i] ^ mask]) + whole[i + 1 :])
            try:
                read_points(path)
            except InputError as error:
                num_refused += 1
                assert str(path) in str(error) and "\n" not in str(error)
    assert num_refused > 100


def test_point_files_of_every_kind_agree(tmp_path: Path) -> None:
    from densify.cli.point_files import read_points

    points = np.arange(12, dtype=np.float32).reshape(3, 4) / 8
    np.save(tmp_path / "p.npy", points)
    np.savez(tmp_path / "p.npz", points=points)
    np.savetxt(tmp_path / "p.txt", points)
    points.tofile(tmp_path / "p.bin")
    for name in ("p.npy", "p.npz", "p.txt", "p.bin"):
        read = read_points(tmp_path / name).points
        assert read.dtype == np.float64
        assert np.array_equal(read, points[:, :3])


def test_times_and_scanners_beside_the_points(tmp_path: Path) -> None:
    from densify.cli.point_files import read_points

    points, time_s, lidar = (
        np.ones((3, 3)),
        np.array([1.5, 1.6, 1.75]),
        np.array([0, 1, 1], np.uint8),
    )
    np.savez(tmp_path / "time.npz", points=points, time=time_s, lidar=lidar)
    np.savez(tmp_path / "offset.npz", points=points, time=time_s, offset_ns=np.arange(3))
    np.savez(tmp_path / "none.npz", points=points)
    timed = read_points(tmp_path / "time.npz")
    assert timed.offset_ns is not None and timed.lidar is not None
    assert timed.offset_ns.tolist() == [1_500_000_000, 1_600_000_000, 1_750_000_000]
    assert timed.offset_ns.dtype == np.int64 and timed.lidar.tolist() == [0, 1, 1]
    offset = read_points(tmp_path / "offset.npz")
    assert offset.offset_ns is not None and offset.offset_ns.tolist() == [0, 1, 2]
    assert offset.lidar is None
    none = read_points(tmp_path / "none.npz")
    assert none.offset_ns is None and none.lidar is None


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("offset_ns", np.arange(4)),
        ("offset_ns", np.arange(3.0)),
        ("time", np.array([0, np.nan, 1])),
        ("lidar", np.array(["a", "b", "c"])),
        ("lidar", np.zeros((3, 1), int)),
    ],
)
def test_bad_columns_beside_the_points(name: str, column: np.ndarray, tmp_path: Path) -> None:
    from densify.cli.point_files import read_points

    np.savez(tmp_path / "p.npz", points=np.ones((3, 3)), **{name: column})
    with pytest.raises(InputError, match=rf"p\.npz: array {name}: .*expected \(3,\)") as caught:
        read_points(tmp_path / "p.npz")
    assert "\n" not in str(caught.value)


def test_flow_uses_times_where_both_files_have_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-9, 9, 900), np.full(900, 6.0), rng.uniform(0, 3, 900)])
    box = rng.uniform(0, 1, (500, 3)) * [1.5, 1.5, 1.5]
    times = np.concatenate([rng.integers(0, 10**8, 900), np.full(500, 2 * 10**7)])
    later = np.concatenate([times[:900], np.full(500, 6 * 10**7)])  # the box 40 ms late
    np.savez(tmp_path / "a.npz", points=np.vstack([wall, box]), offset_ns=times)
    np.savez(tmp_path / "b.npz", points=np.vstack([wall, box + [1.4, 0, 0]]), offset_ns=later)
    np.savez(tmp_path / "c.npz", points=np.vstack([wall, box + [1.4, 0, 0]]))
    for target, step_m in (("b.npz", 1.0), ("c.npz", 1.4)):
        out = tmp_path / f"flow_{target}"
        assert exit_code("flow", tmp_path / "a.npz", tmp_path / target, "--out", out) == 0
        with np.load(out) as arrays:
            assert arrays["moving"][900:].mean() > 0.8 and not arrays["moving"][:900].any()
            assert abs(np.median(arrays["flow"][arrays["moving"], 0]) - step_m) < 0.05
            assert ("to_reference" in arrays) == (target == "b.npz")
    capsys.readouterr()


@pytest.mark.parametrize("out", ["flow.txt", "folder.npz", "file/deep/flow.npz"])
def test_bad_place_for_the_flow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    np.save(tmp_path / "good.npy", np.ones((5, 3)))
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "file").write_text("")
    good = tmp_path / "good.npy"
    assert str(tmp_path / out) in refused(capsys, 2, "flow", good, good, "--out", tmp_path / out)


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
    "unknown key": ([*RUN, "--set", "flow.alfa=3"], ["flow.alfa", "did you mean alpha?"]),
    "unknown section": ([*RUN, "--set", "flwo.alpha=3"], ["flwo", "did you mean flow?"]),
    "wrong type": ([*RUN, "--set", "flow.alpha=ten"], ["flow.alpha", "'ten'", "a number"]),
    "out of range": ([*RUN, "--set", "flow.alpha=-1"], ["flow.alpha", "-1", "from 0"]),
    "not an assignment": ([*RUN, "--set", "flow.alpha"], ["section.key=value"]),
    "frames reversed": (["simulate", "--out", "{tmp}/o", "--frames", "5:2"], ["A:B", "'5:2'"]),
    "frames beyond": (["simulate", "--out", "{tmp}/o", "--frames", "5:999"], ["5:999", "0:160"]),
    "unknown sensor": (["simulate", "--out", "{tmp}/o", "--sensor", "hdl65"], ["hdl65", "hdl64"]),
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
    "missing sweep": (SWEEP.format(1), None, 2, ["--key 2", "frame 1"]),
    "sweep of no points": (SWEEP.format(2), 0, 2, ["0000000002.bin", "no points"]),
    "sweep of few points": (SWEEP.format(2), 50 * 16, 1, ["sweep 2", "50 points"]),
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
    from densify import pipeline

    (tmp_path / "file").write_text("kept")
    monkeypatch.setattr(pipeline, verb, lambda *_, **__: pytest.fail("computed all the same"))
    line = refused(capsys, 2, verb, "--key", "120", "--out", tmp_path / "file" / "out")
    assert str(tmp_path / "file") in line
    assert files_in(tmp_path) == {"file": b"kept"}


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


def result_with(metrics: dict[str, Any], method: str, num_points: int) -> types.Result:
    depth_m = np.zeros((4, 5), np.float32)
    depth_m[0, 0] = 3
    filled_m = np.where(np.arange(20).reshape(4, 5) < 10, 3, 0).astype(np.float32)
    depth = types.DepthMap("cam", depth_m, filled_m, filled_m / 3, np.full((4, 5), -1, np.int32))
    n = num_points
    cloud = types.Cloud(
        points=np.zeros((n, 3)),
        rigid_points=np.zeros((n, 3)),
        frame=np.zeros(n, np.int32),
        row=np.arange(n),
        moving=np.arange(n) < 2,
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.ones(n, np.float32),
        intensity=np.ones(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
    )
    return types.Result(method, 7, (6, 7, 8), cloud, {"cam": depth}, metrics)


def test_summary_says_the_numbers() -> None:
    text = tables.summary(result_with({"ghosts": {"all": 0.0123}}, "icp", 1234))
    assert text.splitlines() == [
        "key 7, icp: 1,234 points of 3 sweeps (6-8), 2 on moving objects",
        "cam: depth in 5.0 % of the pixels, 50.0 % with filled ones",
        "ghosts: 1.23 % of the accumulated points",
    ]
    assert "ghosts" not in tables.summary(result_with({"ghosts": {"all": None}}, "none", 2))


def test_comparison_table_is_aligned_and_complete() -> None:
    errors = {"coverage": 0.5, "mae_m": 0.25, "rmse_m": 1.0, "outliers": 0.0625}
    nothing = dict.fromkeys(errors)
    truth = {"cam": {"measured": {"all": errors, "moving": nothing, "static": errors}}}
    results = {
        "none": result_with({"ghosts": {"all": None}, "depth": truth}, "none", 10),
        "icp": result_with({"ghosts": {"all": 0.02}, "depth": truth}, "icp", 1000),
        "flow": result_with({"ghosts": {"all": 0.001}, "depth": truth}, "flow", 999),
    }
    lines = tables.comparison(results).splitlines()
    cells = [re.split(r"\s{2,}", line) for line in lines]
    rows = {title: values for title, *values in cells}
    assert rows["points"] == ["10", "1,000", "999"]
    assert rows["ghost rate"] == ["-", "2.00 %", "0.10 %"]
    assert rows["cam all, MAE"] == ["0.250 m"] * 3
    assert rows["cam static, outliers"] == ["6.25 %"] * 3
    assert rows["cam moving, coverage"] == ["-"] * 3
    assert len({len(line) for line in lines if line}) == 1
    without = {m: result_with({"ghosts": {"all": 0.0}}, m, 5) for m in ("none", "icp", "flow")}
    assert "MAE" not in tables.comparison(without)
