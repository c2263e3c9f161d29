# SPDX-License-Identifier: MIT
"""What a set is to be: keys, recordings, options, and the gate; what is refused, and how."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from densify.config import resolve
from densify.config.errors import InputError
from densify.dataset import make
from densify.dataset.manifest import Manifest
from densify.dataset.plan import Gate, Recipe, plan, read_plan, write_plan
from tests.command import exit_code, files_in, refused
from tests.dataset_scenes import (
    DRIVE,
    FRAMES,
    OPTIONS,
    copy_drive,
    in_order,
    maps_in,
    records,
    sweep_file,
)

CHEAP = (*OPTIONS, "--method", "none")
# Keys and recordings


def test_keys_that_are_chosen(border_drive: Path, tmp_path: Path) -> None:
    for keys, chosen in (
        (None, [*FRAMES]),
        (slice(36, 45), [*FRAMES]),
        (slice(38, 45, 3), [38, 41, 44]),
        (slice(39), [36, 37, 38]),
        (slice(43, None), [43, 44]),
    ):
        (planned,) = plan([str(border_drive)], keys, Recipe())
        assert list(planned.keys) == chosen
    for keys in (slice(36, 40, 0), slice(36.5, 40), slice(-3, None)):
        with pytest.raises(InputError, match="keys"):
            plan([str(border_drive)], keys, Recipe())
    assert planned.folder == f"val/{DRIVE}" and tuple(planned.cameras) == ("image_02",)
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    sweep_file(drive, 40).unlink()
    assert plan([str(drive)], slice(39, 41), Recipe())[0].keys == (39,)  # that exist
    with pytest.raises(InputError, match="--keys 40:41"):
        plan([str(drive)], slice(40, 41), Recipe())


def test_options_that_cannot_be(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    for option, words in (
        *((f"--keys={keys}", "expected all, or A:B[:S]") for keys in ("5:", "6:5")),
        *((f"--keys={keys}", f"--keys {keys}: ") for keys in ("30:40", "36:60:5")),
        ("--keys=30:40", "36-44; expected A:B within 36:45"),
        *((f"--shard={shard}", "expected i/n") for shard in ("1", "3/2")),
        ("--set=dataset.max_ghost=1.5", "gate.max_ghost: got 1.5, expected"),
        ("--set=project.per=image", "project.per=image, expected sweep"),
    ):
        assert exit_code("dataset", "--data", border_drive, option, "--out", out) == 2
        assert words in capsys.readouterr().err
    assert "--out DIR" in refused(capsys, 2, "dataset", "--data", border_drive)
    same = copy_drive(border_drive, tmp_path / "2011_09_26")
    message = refused(capsys, 2, "dataset", border_drive, same, "--out", out)
    assert str(same) in message and str(border_drive) in message and "--out" in message
    with pytest.raises(InputError, match=r"--workers 0: expected 1"):
        make.make_dataset([str(border_drive)], out, num_workers=0)
    assert not out.exists()


def test_a_set_grows(border_drive: Path, tmp_path: Path, capsys) -> None:
    other, out = copy_drive(border_drive, tmp_path / "raw"), tmp_path / "out"
    other = other.rename(other.with_name("2011_09_26_drive_0001_sync"))
    options = [*CHEAP, "--out", out]
    assert exit_code("dataset", border_drive, other, "--keys", "39:40", *options) == 0
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.png")}
    assert exit_code("dataset", other, border_drive, "--keys", "41:42", *options) == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert [(r["drive"], r["key"], r["status"]) for r in records(out)] == [
        (drive.name, key, "done") for drive in (other, border_drive) for key in (39, 41)
    ]
    in_order(out)
    assert {name.split("/")[0] for name in maps_in(out)} == {"val", "train"}
    *_, last = capsys.readouterr().out.split("open first:")
    assert all(str(out / n) in last for n in ("report.html", "README.txt", "manifest.jsonl"))
    assert exit_code("dataset", "--status", out) == 0
    assert capsys.readouterr().out.startswith("4 keys: 4 done\n")
    assert read_plan(out)["drives"][DRIVE]["frames"] == [[39, 39], [41, 41]]


# Places


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("holiday.jpg", "sea"),
        *(("dataset.json", text) for text in ("", "{}", '{"schema_version": 2}')),
    ],
)
def test_foreign_and_damaged_folders_stay(
    name: str, text: str, border_drive: Path, tmp_path: Path, capsys
) -> None:
    (tmp_path / name).write_text(text)
    for arguments in (["--data", border_drive, "--out", tmp_path], ["--status", tmp_path]):
        message = refused(capsys, 2, "dataset", *arguments)
        assert str(tmp_path) in message and (name == "holiday.jpg" or name in message)
    assert files_in(tmp_path) == {name: text.encode()}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--set", "dataset.split=val"], "gate.split = kitti, got val"),
        (["--window", "3"], "window = 2, got 3"),
        ([], "config.flow.gone = 10.0, got None"),
    ],
    ids=str,
)
def test_a_set_is_made_one_way(
    options: list[str], words: str, border_drive: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    recipe = Recipe(2, config=resolve(None, [*OPTIONS[3::2]]))
    with Manifest(out):
        write_plan(out, recipe, plan([str(border_drive)], None, recipe))
    if not options:  # made by a version with another knob
        table = json.loads((out / "dataset.json").read_text())
        table["config"]["flow"]["gone"] = 10.0
        (out / "dataset.json").write_text(json.dumps(table))
    before = files_in(out)
    arguments = ["--data", border_drive, *OPTIONS, *options, "--out", out]
    message = refused(capsys, 2, "dataset", *arguments)
    assert f"--out {out}: " in message and words in message
    assert files_in(out) == before


# Gate


def test_a_key_beyond_a_limit_is_put_aside(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    arguments = ["--data", border_drive, *CHEAP, "--keys", "36:37", "--out", out]
    arguments += ["--set", "dataset.min_sweeps=5"]
    assert exit_code("dataset", *arguments) == 0
    (record,) = records(out)
    assert record["status"] == "aside" and "sweeps, expected at least 5" in record["reason"]
    assert [*record["files"]] == [f"aside/{DRIVE}/0000000036.jpg"] and maps_in(out) == {}
    assert f"{DRIVE} 36 aside: {record['reason']}" in capsys.readouterr().out
    before = (out / "manifest.jsonl").read_bytes()
    assert exit_code("dataset", *arguments) == 0
    assert (out / "manifest.jsonl").read_bytes() == before  # it is not made again


@pytest.mark.parametrize(
    ("gate", "reason"),
    [
        (Gate(max_ghost=0.02, min_density=0.2, max_outliers=0.01, min_sweeps=5), None),
        (Gate(max_ghost=0.019), "ghost rate 0.02000, expected at most 0.019"),
        (Gate(min_density=0.25), "density 0.2000 in b, expected at least 0.25"),
        (Gate(max_outliers=0.005), "outliers 0.01000 in a, expected at most 0.005"),
        (Gate(min_sweeps=6), "5 sweeps, expected at least 6"),
    ],
)
def test_each_limit(gate: Gate, reason: str | None) -> None:
    scores = {"ghost": 0.02, "density": {"a": 0.3, "b": 0.2}, "outliers": {"a": 0.01, "b": None}}
    assert gate.reason(scores, 5) == reason
    nothing = {"ghost": None, "density": {}, "outliers": {}}
    assert Gate(0.0, 1.0, 0.0, 1).reason(nothing, 1) is None


# Status


def test_status(border_drive: Path, tmp_path: Path, capsys) -> None:
    out, seen = tmp_path / "out", []
    assert "no dataset.json" in refused(capsys, 2, "dataset", "--status", out)
    assert not out.exists()

    def look(summary) -> None:
        stored = make.status(out)
        seen.append((stored.count("done"), stored.num_keys, stored.num_left))

    recipe = Recipe(2, "none", config=resolve({"register": {"source": "dataset"}}))
    make.make_dataset([str(border_drive)], out, slice(39, 41), recipe, report=look)
    assert seen == [(0, 2, 2), (1, 2, 1), (2, 2, 0)]
    assert exit_code("dataset", "--status", out, "--json", "--verify") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["means"]["density"] > 0 and answer["damaged"] == []
    (out / "manifest.jsonl").write_text("")
    assert exit_code("dataset", "--status", out) == 0
    assert capsys.readouterr().out.splitlines()[0] == "2 keys: 0 done, 2 to make"
