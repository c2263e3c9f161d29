# SPDX-License-Identifier: MIT
"""`densify dataset` from end to end: the same set however it is made, and whatever happens."""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from densify.config.errors import InputError
from densify.dataset import make
from densify.dataset.loader import DepthDataset
from densify.dataset.make import worse_than_neighbours
from densify.dataset.manifest import KeyRecord
from densify.dataset.report import write_report
from tests.command import exit_code, files_in
from tests.dataset_scenes import (
    BORDER,
    DRIVE,
    FRAMES,
    OPTIONS,
    across_border,
    command,
    copy_drive,
    in_order,
    keys_of,
    maps_in,
    records,
    statuses,
    story,
    sweep_file,
    write_drive,
    write_sweep,
)

PATIENCE_S = 120
CAMERA = "image_02"
CHEAP = (*OPTIONS, "--method", "none")


def times(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in out.rglob("*.png")}


def is_whole(out: Path, whole: Path) -> None:
    in_order(out)
    assert maps_in(out) == maps_in(whole)
    assert story(out) == story(whole)


# The same set


def test_a_set_is_what_it_says(border_set: Path, capsys) -> None:
    in_order(border_set)
    assert keys_of(maps_in(border_set)) == set(FRAMES)
    products = {Path(name).parts[:5] for name in maps_in(border_set)}
    kinds = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
    assert products == {("val", DRIVE, "proj_depth", kind, CAMERA) for kind in kinds}
    for record in records(border_set):
        near = [f for f in FRAMES if abs(f - record["key"]) <= 2]
        assert (record["status"], record["frames"]) == ("done", near)
        assert record["scores"]["ghost"] < 0.01
        assert record["scores"]["num_moving"] > 100
    assert {p.name for p in border_set.iterdir()} == {
        *("val", "dataset.json", "manifest.jsonl", ".manifest.lock", "densify.log", "README.txt"),
        "report.html",
    }
    data = DepthDataset(border_set)
    assert [sample["frame"] for sample in data] == list(FRAMES)
    dense, sparse = data[3]["dense_depth_m"], data[3]["sparse_depth_m"]
    assert (dense > 0).sum() > 2 * (sparse > 0).sum() > 1000
    maps = border_set / "val" / DRIVE / "proj_depth"
    assert exit_code("evaluate", maps / "groundtruth", border_set, "--json") == 0
    assert json.loads(capsys.readouterr().out)["scores"]["parts"]["all"]["outliers"] == 0.0


def test_a_preview_is_a_part_of_the_set(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    arguments = ("dataset", "--data", border_drive, *CHEAP, "--out", out)
    assert exit_code(*arguments, "--preview", "3") == 0
    shown, page = capsys.readouterr().out, (out / "report.html").read_text()
    assert keys_of(maps_in(out)) == set(FRAMES[1::3])  # not the first, whose window is cut
    command = shlex.join(["densify", *map(str, arguments)])
    rest = next(line for line in shown.splitlines() if line.startswith("the other 6 keys take"))
    assert rest.endswith(f": {command}") and "<b>Preview: 3 of 9 keys</b>" in page
    assert html.escape(command) in page
    assert exit_code("report", out) == 0  # replaces the page
    assert exit_code(*arguments) == 0
    page = (out / "report.html").read_text()
    assert "9 done" in page and "Preview" not in page


def test_a_later_limit_of_outliers_scores_finished_keys_once(
    border_drive: Path, tmp_path: Path, capsys
) -> None:
    arguments = ("dataset", "--data", border_drive, *OPTIONS, "--keys", "39:41", "--out", tmp_path)
    limit, none = ("--set", "dataset.max_outliers=0.9"), ("--method", "none")
    for method in (("--method", "icp"), none):  # nothing of a single sweep can be held out
        out = tmp_path / method[1]
        made = []
        for options in ((), limit, limit):
            assert exit_code(*arguments[:-1], out, *method, *options) == 0
            made.append(re.findall(r"; (\d+) now", capsys.readouterr().out))
        assert made == [["2"], ["2"], []], method
        assert [bool(r["scores"]["outliers"]) for r in records(out)] == [method != none] * 2


def test_a_preview_measures_outliers(border_drive: Path, tmp_path: Path) -> None:
    arguments = ("dataset", "--data", border_drive, *OPTIONS, "--method", "icp", "--out", tmp_path)
    assert exit_code(*arguments, "--preview", "1") == 0
    (record,) = records(tmp_path)
    assert record["scores"]["outliers"][CAMERA] is not None
    assert "Outliers of the median key, held out" in (tmp_path / "report.html").read_text()
    config = json.loads((tmp_path / "dataset.json").read_text())["config"]
    assert config["output"]["score"] is False  # the others are made without


def test_shards_workers_and_a_killed_run_make_what_one_makes(
    empty_cache: Path, tmp_path: Path, monkeypatch
) -> None:
    """Of two blocks, with a hole in time between them."""
    frames = [*range(BORDER - 3, BORDER), *range(BORDER + 5, BORDER + 8)]
    drive = write_drive(across_border(frames), tmp_path / "2011_09_26")
    out, whole = tmp_path / "out", tmp_path / "whole"
    assert exit_code("dataset", "--data", drive, *OPTIONS, "--out", whole) == 0
    shutil.rmtree(empty_cache)
    arguments = ["--data", drive, *OPTIONS, "--out", out]
    with command(*arguments, "--shard", "1/2", "--workers", "2") as process:
        end = time.monotonic() + PATIENCE_S
        while not any('"done"' in p.read_text() for p in out.glob("manifest*.jsonl")):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.002)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE_S)
    finished = [key for key, status in statuses(out).items() if status == "done"]
    kept = {path: at for path, at in times(out).items() if int(path.stem) in finished}
    assert finished
    for shard, workers, keys in (("1/2", 2, frames[:3]), ("2/2", 1, frames)):
        assert exit_code("dataset", *arguments, "--shard", shard, "--workers", workers) == 0
        assert keys_of(maps_in(out)) == set(keys)
    assert kept.items() <= times(out).items()
    # Another run makes nothing again, and clears what the killed one has left.
    before = times(out)
    monkeypatch.setattr(make, "call_all", lambda _, groups, *rest: iter(groups))
    assert exit_code("dataset", *arguments) == 0
    assert times(out) == before
    is_whole(out, whole)
    assert (out / "dataset.json").read_bytes() == (whole / "dataset.json").read_bytes()


def test_damaged_files_are_made_again(
    border_drive: Path, border_set: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    shutil.copytree(border_set, out)
    maps = out / "val" / DRIVE / "proj_depth"
    (maps / "confidence" / CAMERA / "0000000038.png").unlink()
    changed = maps / "groundtruth" / CAMERA / "0000000040.png"
    changed.write_bytes(changed.read_bytes()[:-20] + bytes(20))  # of the right size
    path = maps / "groundtruth" / CAMERA / "0000000042.png"
    path.write_bytes(path.read_bytes()[:-1])
    manifest = out / "manifest.jsonl"
    lines = manifest.read_bytes().splitlines(keepends=True)
    manifest.write_bytes(b"".join(lines[:-1]) + lines[-1][:50])
    before = times(out)
    arguments = ["dataset", "--data", border_drive, *OPTIONS, "--out", out]
    assert exit_code(*arguments) == 0
    assert {int(p.stem) for p, at in times(out).items() if at != before.get(p)} == {38, 42, 44}
    with pytest.raises(InputError, match=r"0000000040.png.*again with --verify"):
        list(DepthDataset(out))
    capsys.readouterr()
    assert exit_code("dataset", "--status", out) == 0  # looks at no content
    assert exit_code("dataset", "--status", out, "--verify") == 1
    captured = capsys.readouterr()
    damaged = [line for line in captured.out.splitlines() if line.startswith("damaged: ")]
    assert damaged == [f"damaged: {changed.relative_to(out)}"]
    assert "1 damaged or missing files" in captured.err
    assert exit_code(*arguments, "--verify") == 0
    is_whole(out, border_set)
    assert exit_code("dataset", "--status", out, "--verify") == 0


def test_the_densify_layout_is_what_run_writes(tmp_path: Path) -> None:
    """In a recording within the window, to the last byte but for what the run has cost."""
    short = write_drive(across_border(range(BORDER, BORDER + 4)), tmp_path / "2011_09_26")
    given = ["--data", short, "--window", 4, "--set", "register.source=dataset"]
    keys = ["--keys", f"{BORDER + 1}:{BORDER + 2}", "--layout", "densify"]
    out, run = tmp_path / "set", tmp_path / "run"
    assert exit_code("dataset", *given, *keys, "--out", out) == 0
    assert exit_code("run", *given, "--key", BORDER + 1, "--out", run) == 0
    (record,) = records(out)
    made, alone = files_in(out / "000041"), files_in(run / "000041")
    assert made.keys() == alone.keys() == {n.removeprefix("000041/") for n in record["files"]}
    assert [name for name in made if made[name] != alone[name]] == ["run.yaml"]
    with pytest.raises(InputError, match="layout"):
        DepthDataset(out)


# What goes wrong


def test_a_corrupt_sweep_costs_its_key_alone(border_drive: Path, tmp_path: Path, capsys) -> None:
    drive, out = copy_drive(border_drive, tmp_path / "2011_09_26"), tmp_path / "out"
    bad, keys = BORDER + 1, range(BORDER - 1, BORDER + 3)
    path = sweep_file(drive, bad)
    path.write_bytes(path.read_bytes()[:-5])
    arguments = ["--data", drive, *OPTIONS, "--method", "icp", "--out", out]
    arguments += ["--keys", f"{keys.start}:{keys.stop}"]
    assert exit_code("dataset", *arguments) == 1
    text, errors = capsys.readouterr()
    assert f"{drive.name} {bad} failed: " in text and str(path) in text
    assert errors.splitlines()[-1] == "densify: 1 of 4 keys not made"
    assert "Traceback" not in errors
    assert statuses(out) == {f: "failed" if f == bad else "done" for f in keys}
    for record in [r for r in records(out) if r["key"] != bad]:
        near = [f for f in FRAMES if abs(f - record["key"]) <= 2 and f != bad]
        assert record["frames"] == [f for f in near if (f < bad) == (record["key"] < bad)]
    before = times(out)
    # The same process goes on after it has been mended.
    write_sweep(across_border(), drive, bad)
    assert exit_code("dataset", *arguments) == 0
    assert set(statuses(out).values()) == {"done"}
    in_order(out)
    assert before.items() <= times(out).items()


def test_an_error_in_one_key_costs_that_key_and_an_interrupted_run_goes_on(
    border_drive: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    densified, out = make._densified, tmp_path / "out"
    arguments = ["dataset", "--data", border_drive, *CHEAP, "--keys", "36:40", "--out", out]

    def failing(job, key):
        if key == 37:
            raise ZeroDivisionError("by zero")
        if key == 38:
            raise KeyboardInterrupt
        return densified(job, key)

    with monkeypatch.context() as patch:
        patch.setattr(make, "_densified", failing)
        assert exit_code(*arguments) == 130
    lines = capsys.readouterr().err.splitlines()[-2:]
    assert lines[0].endswith("1 of 4 keys are finished and kept") and "interrupted" in lines[1]
    assert statuses(out) == {36: "done", 37: "failed"}
    assert "this is a bug in densify; please report" in records(out)[1]["reason"]
    assert "in failing" in (out / "densify.log").read_text()  # the traceback
    assert exit_code(*arguments) == 0
    assert set(statuses(out).values()) == {"done"}
    in_order(out)


# Keys far worse than their neighbours

USUAL = [0.0003 + 0.0001 * (key % 3) for key in range(30)]


def drive_of(shares: list[float | None], **scores) -> dict:
    """Records of a drive by ghost rate, with windows of five sweeps that the ends cut."""
    ends = (0, len(shares) - 1)
    records = (
        KeyRecord(
            DRIVE,
            key,
            "done",
            frames=tuple(range(max(ends[0], key - 2), min(ends[1], key + 2) + 1)),
            scores={"ghost": share, **scores},
        )
        for key, share in enumerate(shares)
    )
    return {record.name: record for record in records}


@pytest.mark.parametrize(
    ("shares", "worse"),
    [
        (USUAL, []),
        ([0.016, 0.012, *USUAL, 0.009], [0, 1, 32]),  # the ends stand out
        ([0.01] * 20, []),  # worse than other drives, everywhere
        ([0.001 * 1.15**key for key in range(30)], []),  # or slowly becoming so
        ([0.007, *[0.0] * 20], []),  # no more ghosts than usual
        ([None] * 9, []),
        ([0.5, 0.0], []),  # which of two is unusual?
        ([], []),
    ],
)
def test_keys_far_worse_than_those_around(shares: list, worse: list[int]) -> None:
    assert [key for _, key in worse_than_neighbours(drive_of(shares), 4.0)] == worse


def test_outliers_count_by_the_worst_camera_and_only_of_keys_that_are_made() -> None:
    records = drive_of([0.0] * 12, outliers={"a": 0.01, "b": None})
    bad = replace(records[DRIVE, 4], scores={"ghost": 0, "outliers": {"a": 0.01, "b": 0.05}})
    records[bad.name] = bad
    ((name, text),) = worse_than_neighbours(records, 4.0).items()
    assert name == (DRIVE, 4) and text.startswith("held-out outliers 5 %, more than 4 times the")
    assert "ghosts" not in text
    records[bad.name] = replace(bad, status="aside", reason="outliers")
    assert [*worse_than_neighbours(records, 4.0)] == [bad.name]  # it would be so again
    records[bad.name] = replace(bad, status="failed", reason="torn")
    assert not worse_than_neighbours(records, 4.0)


def test_a_key_far_worse_than_its_neighbours_is_put_aside(
    border_drive: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """Its files go, default loading leaves it out, and command, status and page say so."""
    make_key = make.make_key

    def made(job_and_key) -> KeyRecord:
        record = make_key(job_and_key)
        return replace(record, scores={**record.scores, "ghost": 0.02 * (record.key == FRAMES[0])})

    monkeypatch.setattr(make, "make_key", made)
    out, cheap = tmp_path / "set", (*CHEAP, "--workers", "1")
    reason = "ghosts 2 %, more than 4 times the 0 % of the neighbouring keys (median)"
    assert exit_code("dataset", border_drive, *cheap, "--out", out, "--preview", "8") == 0
    assert "aside" not in capsys.readouterr().out  # neighbours of a preview may be far away
    for arguments in (("--data", border_drive, *cheap, "--out", out), ("--status", out)):
        assert exit_code("dataset", *arguments) == 0
        assert f"{DRIVE} {FRAMES[0]} aside: {reason}" in capsys.readouterr().out
    assert keys_of(maps_in(out)) == {*FRAMES} - {FRAMES[0]}
    assert [sample["frame"] for sample in DepthDataset(out)] == [*FRAMES][1:]
    (page,) = write_report(out)
    assert page.read_text().count(reason) == 3  # with its picture, counted, and in the table
    assert (out / "aside" / DRIVE / f"{FRAMES[0]:010d}.jpg").is_file()
    assert f"put aside ({reason})" in (out / "densify.log").read_text()

    # Other limits make it again, and put the same key aside for another reason.
    again = ("dataset", "--data", border_drive, *cheap, "--out", out, "--set")
    assert exit_code(*again, "dataset.max_ratio=null") == 0
    assert keys_of(maps_in(out)) == {*FRAMES} and not [*out.rglob("*.jpg")]
    both = ("dataset.max_ratio=null", "--set", "dataset.max_ghost=0.01")
    assert exit_code(*again, *both) == 0
    assert keys_of(maps_in(out)) == {*FRAMES} - {FRAMES[0]}
    assert "expected at most 0.01" in records(out)[0]["reason"]
