# SPDX-License-Identifier: MIT
"""What a set is to be: keys, recordings, options, and the gate; what is refused, and how."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from densify.config import resolve
from densify.config.errors import InputError
from densify.dataset import capacity, cluster, make
from densify.dataset.gate import Gate
from densify.dataset.manifest import Manifest
from densify.dataset.plan import Recipe, plan, read_plan
from tests.command import exit_code, files_in, refused
from tests.dataset_scenes import (
    DRIVE,
    FRAMES,
    OPTIONS,
    copy_drive,
    in_order,
    maps_in,
    records,
    statuses,
    sweep_file,
)

TWO_KEYS = ("--keys", "39:41")


def run(drive: Path, out: Path, *options: str | Path) -> int:
    return exit_code("dataset", "--data", drive, *OPTIONS, *TWO_KEYS, "--out", out, *options)


# Keys and recordings


@pytest.mark.parametrize(
    ("keys", "chosen"),
    [("all", [*FRAMES]), ("36:45", [*FRAMES]), ("38:45:3", [38, 41, 44]), ("40:41", [40])],
)
def test_keys_that_are_chosen(keys: str, chosen: list[int], border_drive: Path) -> None:
    wanted = None if keys == "all" else slice(*map(int, keys.split(":")))
    (planned,) = plan([str(border_drive)], wanted, Recipe())
    assert list(planned.keys) == chosen
    assert planned.source.folder == f"val/{DRIVE}"
    assert planned.source.cameras == ("image_02",)


@pytest.mark.parametrize("keys", ["30:40", "40:46", "0:9", "45:50", "36:60:5", "100:200"])
def test_unknown_frames(keys: str, border_drive: Path, tmp_path: Path, capsys) -> None:
    arguments = ["--data", border_drive, "--keys", keys, "--out", tmp_path / "out"]
    message = refused(capsys, 2, "dataset", *arguments)
    assert f"--keys {keys}: " in message and "36-44" in message and "36:45" in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("keys", ["", "5", "5:", ":5", "5:5", "6:5", "5:6:0", "a:b", "1:2:3:4"])
def test_what_is_no_range_of_keys(keys: str, tmp_path: Path, capsys) -> None:
    assert exit_code("dataset", f"--keys={keys}", "--out", tmp_path / "out") == 2
    assert "expected all, or A:B[:S]" in capsys.readouterr().err


@pytest.mark.parametrize("shard", ["", "1", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3", "1.5/2"])
def test_what_is_no_shard(shard: str, tmp_path: Path, capsys) -> None:
    assert exit_code("dataset", f"--shard={shard}", "--out", tmp_path / "out") == 2
    assert "expected i/n" in capsys.readouterr().err


def test_a_tree_of_one_map_per_sweep_says_where_each_image_has_one(tmp_path: Path, capsys) -> None:
    message = refused(capsys, 2, "dataset", "--per", "image", "--out", tmp_path / "out")
    assert "--per image" in message and "add --layout densify" in message
    assert not (tmp_path / "out").exists()


def test_more_shards_than_work(border_drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for i in range(1, 5):
        assert run(border_drive, out, "--shard", f"{i}/4") == 0
    assert statuses(out) == {39: "done", 40: "done"}
    in_order(out)


def test_keys_are_the_frames_that_exist(border_drive: Path, tmp_path: Path) -> None:
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, 40).unlink()
    out = tmp_path / "out"
    assert run(drive, out) == 0
    assert statuses(out) == {39: "done"}
    (planned,) = plan([str(drive)], None, Recipe())
    assert list(planned.keys) == [f for f in FRAMES if f != 40]
    with pytest.raises(InputError, match="--keys 40:41"):
        plan([str(drive)], slice(40, 41), Recipe())


def test_recordings_of_one_name(border_drive: Path, tmp_path: Path, capsys) -> None:
    other = copy_drive(border_drive, tmp_path / "2011_09_26")
    arguments = ["--data", border_drive, other, "--out", tmp_path / "out"]
    message = refused(capsys, 2, "dataset", *arguments)
    assert str(other) in message and str(border_drive) in message and "--out" in message


@pytest.mark.parametrize("layout", ["kitti-depth", "densify"])
def test_a_set_grows(layout: str, border_drive: Path, tmp_path: Path, capsys) -> None:
    other = copy_drive(border_drive, tmp_path / "raw")
    other = other.rename(other.with_name("2011_09_26_drive_0001_sync"))
    out = tmp_path / "out"
    layout = ["--layout", layout, "--method", "icp", *OPTIONS, "--out", out]
    both = ["--data", border_drive, "--data", other]
    assert exit_code("dataset", *both, "--keys", "39:40", *layout) == 0
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.png")}
    assert exit_code("dataset", *both, "--keys", "40:41", *layout) == 0
    assert exit_code("dataset", "--data", other, border_drive, "--keys", "41:42", *layout) == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert [(r["drive"], r["key"], r["status"]) for r in records(out)] == [
        (drive.name, key, "done") for drive in (other, border_drive) for key in (39, 40, 41)
    ]
    in_order(out)
    capsys.readouterr()
    assert exit_code("dataset", "--status", out) == 0
    assert capsys.readouterr().out.startswith("6 keys: 6 done\n")
    assert read_plan(out)["drives"][DRIVE]["frames"] == [[39, 41]]


def test_another_recording_joins_a_tree(border_drive: Path, tmp_path: Path) -> None:
    other = copy_drive(border_drive, tmp_path / "raw")
    other = other.rename(other.with_name("2011_09_26_drive_0001_sync"))
    out = tmp_path / "out"
    assert run(border_drive, out) == run(other, out) == 0
    assert {name.split("/")[0] for name in maps_in(out)} == {"val", "train"}
    in_order(out)


def test_another_recording_cannot_join_keys_without_its_folder(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    other = copy_drive(border_drive, tmp_path / "raw")
    other = other.rename(other.with_name("2011_09_26_drive_0001_sync"))
    options = ["--layout", "densify", "--method", "icp", *OPTIONS, "--out", tmp_path / "out"]
    assert exit_code("dataset", "--data", border_drive, "--keys", "40:41", *options) == 0
    before = files_in(tmp_path / "out")
    capsys.readouterr()
    message = refused(capsys, 2, "dataset", "--data", other, "--keys", "40:41", *options)
    assert "another recording" in message
    assert files_in(tmp_path / "out") == before


# Places


def test_no_place(border_drive: Path, capsys) -> None:
    assert "--out DIR" in refused(capsys, 2, "dataset", "--data", border_drive)


def test_a_foreign_folder_stays_as_it_is(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "photos"
    out.mkdir()
    (out / "holiday.jpg").write_text("sea")
    message = refused(capsys, 2, "dataset", "--data", border_drive, "--out", out)
    assert f"--out {out}: not empty" in message
    assert files_in(out) == {"holiday.jpg": b"sea"}


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"schema_version": 2}', "{}"])
def test_a_damaged_plan(text: str, border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "dataset.json").write_text(text)
    for arguments in (["--data", border_drive, "--out", out], ["--status", out]):
        assert str(out / "dataset.json") in refused(capsys, 2, "dataset", *arguments)
    assert files_in(out) == {"dataset.json": text.encode()}


@pytest.mark.parametrize("table", ['{"schema_version": 1}', '{"schema_version": 1, "drives": 3}'])
def test_a_plan_without_its_parts(table: str, border_drive: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "dataset.json").write_text(table)
    for arguments in (["--data", border_drive, "--out", tmp_path], ["--status", tmp_path]):
        assert str(tmp_path / "dataset.json") in refused(capsys, 2, "dataset", *arguments)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--max-ghost", "0.5"], "gate.max_ghost = None, got 0.5"),
        (["--window", "3"], "window = 2, got 3"),
        (["--method", "icp"], "method = flow, got icp"),
        (["--layout", "densify"], "layout = kitti-depth, got densify"),
        (["--camera", "image_02"], "cameras = None, got ['image_02']"),
        (["--split", "train"], "folder"),
        (["--set", "flow.look_around_s=0.1"], "config.flow.look_around_s = None, got 0.1"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_set_is_made_one_way(
    options: list[str], words: str, border_drive: Path, border_set: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    shutil.copytree(border_set, out)
    before = files_in(out)
    arguments = ["--data", border_drive, *OPTIONS, *options, "--out", out]
    message = refused(capsys, 2, "dataset", *arguments)
    assert f"--out {out}: " in message and words in message
    assert files_in(out) == before


def test_a_set_with_knobs_that_are_no_more(
    border_drive: Path, border_set: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    shutil.copytree(border_set, out)
    plan = json.loads((out / "dataset.json").read_text())
    plan["config"]["flow"]["alpha"] = 10.0
    (out / "dataset.json").write_text(json.dumps(plan))
    message = refused(capsys, 2, "dataset", "--data", border_drive, *OPTIONS, "--out", out)
    assert "config.flow.alpha = 10.0, got None" in message


def test_a_second_run_at_once(border_drive: Path, border_set: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    shutil.copytree(border_set, out)
    with Manifest(out):
        message = refused(capsys, 2, "dataset", "--data", border_drive, *OPTIONS, "--out", out)
        assert "another run is at work" in message
        assert exit_code("dataset", "--status", out) == 0
        # Another shard is another part.
        assert run(border_drive, out, "--shard", "1/2") == 0
    in_order(out)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_does_not_answer(
    address: str, border_drive: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 1)
    options = [*OPTIONS, *TWO_KEYS, "--scheduler", address, "--out", tmp_path / "out"]
    assert exit_code("dataset", "--data", border_drive, *options) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert f"scheduler {address}" in error
    assert run(border_drive, tmp_path / "out") == 0


# Memory


def test_too_little_memory(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(border_drive, out, "--memory", "1M") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "--memory: got 0.0 GB, expected at least 0." in error and "window 2" in error
    assert "Traceback" not in error and maps_in(out) == {}


@pytest.mark.parametrize("size", ["8", "G", "x", "-1G", "0M", "8 GB", "nanG", "infG", "1e400G"])
def test_what_is_no_size(size: str, tmp_path: Path, capsys) -> None:
    assert exit_code("dataset", f"--memory={size}", "--out", tmp_path / "out") == 2
    assert "expected" in capsys.readouterr().err


def test_as_many_workers_as_fit(border_drive: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    opened, real = [], make.open_workers

    def one_only(num_workers: int, *rest):
        opened.append(num_workers)
        return real(1)

    monkeypatch.setattr(make, "open_workers", one_only)
    assert run(border_drive, tmp_path / "a", "--memory", "1G", "--workers", "40") == 0
    assert "instead of 40" in capsys.readouterr().err
    assert run(border_drive, tmp_path / "b", "--memory", "900G", "--workers", "40") == 0
    assert 1 <= opened[0] < 4 and opened[1] == 40


def test_a_recipe_wants_a_configuration_and_no_name_of_one() -> None:
    for config in ("fast", {"flow": {"soft": False}}, None):
        with pytest.raises(InputError, match=r"expected a Config; densify.config.resolve makes"):
            Recipe(config=config)  # type: ignore[arg-type]


def test_as_many_workers_as_cores_free_memory_and_keys_suffice_for(
    border_drive: Path, monkeypatch
) -> None:
    recipe = Recipe(window=2)
    drives = 32 * plan([str(border_drive)], slice(39, 41), recipe)  # 64 keys
    monkeypatch.setattr(capacity, "num_threads", lambda: 6)
    monkeypatch.setattr(capacity, "available_bytes", lambda: 900e9)
    assert capacity.num_processes(None, None, recipe, drives) == 6
    assert capacity.num_processes(None, None, recipe, drives[:16]) == 4
    assert capacity.num_processes(None, None, recipe, drives[:1]) == 1
    assert capacity.num_processes(3, None, recipe, drives) == 3
    few = capacity.num_processes(None, int(4e9), recipe, drives)
    monkeypatch.setattr(capacity, "available_bytes", lambda: 4e9 / 0.7)
    assert capacity.num_processes(None, None, recipe, drives) == few and 1 <= few < 6
    monkeypatch.setattr(capacity, "available_bytes", lambda: None)
    assert capacity.num_processes(None, None, recipe, drives) == 6


def test_memory_is_reckoned_from_a_sweep_that_can_be_read(
    border_drive: Path, tmp_path: Path
) -> None:
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, 39).write_bytes(b"torn")
    assert run(drive, tmp_path / "out", "--memory", "4G") == 1
    assert statuses(tmp_path / "out") == {39: "failed", 40: "done"}


# Gate


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--min-sweeps", "5"], "3 sweeps, expected at least 5"),
        (["--min-density", "0.9"], "in image_02, expected at least 0.9"),
        (["--max-ghost", "0"], ", expected at most 0"),
    ],
    ids=["sweeps", "density", "ghost"],
)
def test_a_key_beyond_a_limit_is_put_aside(
    options: list[str], reason: str, border_drive: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    arguments = ["--data", border_drive, *OPTIONS, "--keys", "36:37", *options, "--out", out]
    assert exit_code("dataset", *arguments) == 0
    (record,) = records(out)
    assert record["status"] == "aside" and reason in record["reason"]
    assert record["files"] == {} and maps_in(out) == {}
    assert f"{DRIVE} 36 aside: {record['reason']}" in capsys.readouterr().out
    before = (out / "manifest.jsonl").read_bytes()
    assert exit_code("dataset", *arguments) == 0
    assert (out / "manifest.jsonl").read_bytes() == before  # it is not made again


SCORES = {
    "ghost": 0.02,
    "density": {"a": 0.3, "b": 0.2},
    "outliers": {"a": 0.01, "b": None},
}


@pytest.mark.parametrize(
    ("gate", "reason"),
    [
        (Gate(), None),
        (Gate(max_ghost=0.02, min_density=0.2, max_outliers=0.01, min_sweeps=5), None),
        (Gate(max_ghost=0.019), "ghost rate 0.02000, expected at most 0.019"),
        (Gate(min_density=0.25), "density 0.2000 in b, expected at least 0.25"),
        (Gate(max_outliers=0.005), "outliers 0.01000 in a, expected at most 0.005"),
        (Gate(min_sweeps=6), "5 sweeps, expected at least 6"),
    ],
)
def test_each_limit(gate: Gate, reason: str | None) -> None:
    assert gate.reason(SCORES, 5) == reason


def test_what_cannot_be_said_is_no_reason() -> None:
    nothing = {"ghost": None, "density": {}, "outliers": {}}
    assert Gate(0.0, 1.0, 0.0, 1).reason(nothing, 1) is None


@pytest.mark.parametrize("option", ["--max-ghost", "--min-density", "--max-outliers"])
@pytest.mark.parametrize("value", ["1.5", "-0.1", "nan"])
def test_limits_are_shares(
    option: str, value: str, border_drive: Path, tmp_path: Path, capsys
) -> None:
    arguments = ["--data", border_drive, f"{option}={value}", "--out", tmp_path / "out"]
    assert f"{option} {value}: expected a share" in refused(capsys, 2, "dataset", *arguments)


# Status


def test_status(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert "no dataset.json" in refused(capsys, 2, "dataset", "--status", out)
    assert not out.exists()
    assert run(border_drive, out) == 0
    capsys.readouterr()
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    assert exit_code("dataset", "--status", out) == 0
    said = capsys.readouterr().out.splitlines()
    assert (
        said[0] == "2 keys: 2 done"
        and said[1].startswith("density ")
        and said[2].startswith("log: ")
        and "DEBUG" not in said[2]
    )
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == before
    (out / "manifest.jsonl").write_text("")
    assert exit_code("dataset", "--status", out) == 0
    assert capsys.readouterr().out.splitlines()[0] == "2 keys: 0 done, 2 to make"


def test_status_in_the_middle(border_drive: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    out, seen = tmp_path / "out", []

    def look(summary) -> None:
        here, lines = make.status(out)
        seen.append((here.count("done"), here.num_keys, here.num_left))
        assert len(seen) == 1 or f"{len(seen) - 1} of 2" in lines[0]

    recipe = Recipe(2, config=resolve({"register": {"source": "dataset"}}))
    make.make_dataset([str(border_drive)], out, slice(39, 41), recipe, report=look)
    assert seen == [(0, 2, 2), (1, 2, 1), (2, 2, 0)]
