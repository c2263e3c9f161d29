# SPDX-License-Identifier: MIT
"""`densify dataset` from end to end: the same set however it is made."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from densify.config.cache import Cache, steps_folder
from densify.config.errors import InputError
from densify.dataset import make, work
from densify.dataset.loader import DepthDataset
from densify.dataset.plan import Recipe, Source
from densify.dataset.work import Job, tasks
from densify.pipeline.blocks import Cut
from densify.readers.timeline import Timeline
from tests.command import exit_code, files_in
from tests.dataset_scenes import (
    BORDER,
    DRIVE,
    FRAMES,
    OPTIONS,
    across_border,
    copy_drive,
    in_order,
    keys_of,
    maps_in,
    records,
    statuses,
    story,
    sweep_file,
    write_drive,
)

PATIENCE_S = 120
CAMERA = "image_02"


# The same set


def test_a_set_is_what_it_says(border_set: Path) -> None:
    in_order(border_set)
    assert keys_of(maps_in(border_set)) == set(FRAMES)
    products = {Path(name).parts[:5] for name in maps_in(border_set)}
    kinds = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
    assert products == {("val", DRIVE, "proj_depth", kind, CAMERA) for kind in kinds}
    for record in records(border_set):
        near = [f for f in FRAMES if abs(f - record["key"]) <= 2]
        assert (record["status"], record["frames"]) == ("done", near)
        assert len(record["files"]) == 4
        assert record["scores"]["ghost"] < 0.01
        assert record["scores"]["num_moving"] > 100
    assert {p.name for p in border_set.iterdir()} == {
        *("val", "dataset.json", "manifest.jsonl", ".manifest.lock", "densify.log", "README.txt")
    }


@pytest.mark.parametrize(
    "how",
    [
        ["--keys", "38:41"],
        ["--keys", "36:45:4"],
        ["--keys", "41:42", "--cache-size", "1K"],
    ],
    ids=" ".join,
)
def test_keys_do_not_depend_on_which_are_asked_for(
    how: list[str], border_drive: Path, border_set: Path, empty_cache: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, *how, "--out", out) == 0
    in_order(out)
    asked = keys_of(maps_in(out))
    assert asked == set(range(*map(int, how[1].split(":"))))
    assert maps_in(out) == {n: d for n, d in maps_in(border_set).items() if keys_of([n]) <= asked}


def test_two_workers_make_what_one_makes(
    border_drive: Path, border_set: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, "--workers", 2, "--out", out) == 0
    in_order(out)
    assert maps_in(out) == maps_in(border_set)
    assert story(out) == story(border_set)


def test_a_scheduler_whose_workers_live_on(
    border_drive: Path, border_set: Path, empty_cache: Path, tmp_path: Path
) -> None:
    """What they remember of one run is nothing to the next."""
    distributed = pytest.importorskip("distributed")
    drive, out = copy_drive(border_drive, tmp_path / "2011_09_26"), tmp_path / "out"
    torn = sweep_file(drive, 40)
    sweep = torn.read_bytes()
    torn.write_bytes(sweep[:-1])
    options = {"dashboard_address": "127.0.0.1:0", "threads_per_worker": 1}
    with distributed.LocalCluster(n_workers=1, **options) as cluster:
        arguments = ["--data", drive, *OPTIONS, "--scheduler", cluster.scheduler_address]
        assert exit_code("dataset", *arguments, "--keys", "39:41", "--out", out) == 1
        assert statuses(out) == {39: "done", 40: "failed"}
        torn.write_bytes(sweep)
        assert exit_code("dataset", *arguments, "--keys", "39:41", "--out", out) == 0
    in_order(out)
    again = {n: d for n, d in maps_in(out).items() if keys_of([n]) == {40}}
    assert again == {n: d for n, d in maps_in(border_set).items() if keys_of([n]) == {40}}


def test_shards_make_what_one_makes(border_drive: Path, border_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    made = []
    for shard in ("1/3", "2/3", "3/3"):
        arguments = ["--data", border_drive, *OPTIONS, "--shard", shard, "--out", out]
        assert exit_code("dataset", *arguments) == 0
        made.append(keys_of(maps_in(out)))
    assert made[0] <= made[1] <= made[2] == set(FRAMES)
    in_order(out)
    assert maps_in(out) == maps_in(border_set)
    assert story(out) == story(border_set)
    assert (out / "dataset.json").read_bytes() == (border_set / "dataset.json").read_bytes()
    # Who goes on without shards keeps all that.
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.png")}
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, "--out", out) == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.png")} == before


def test_another_run_makes_nothing_again(
    border_drive: Path, border_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make, "open_workers", None)
    before = {p: p.stat().st_mtime_ns for p in border_set.rglob("*") if p.name != "densify.log"}
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, "--out", border_set) == 0
    after = {p: p.stat().st_mtime_ns for p in border_set.rglob("*") if p.name != "densify.log"}
    assert {p: t for p, t in after.items() if before[p] != t}.keys() <= {
        border_set,
        border_set / "README.txt",
        border_set / ".manifest.lock",
    }


def test_a_damaged_set_is_made_whole(border_drive: Path, border_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(border_set, out)
    maps = out / "val" / DRIVE / "proj_depth"
    (maps / "confidence" / CAMERA / "0000000038.png").unlink()
    path = maps / "groundtruth" / CAMERA / "0000000042.png"
    path.write_bytes(path.read_bytes()[:-1])
    manifest = out / "manifest.jsonl"
    lines = manifest.read_bytes().splitlines(keepends=True)
    lines[5] = lines[5][:40] + b"\n"
    manifest.write_bytes(b"".join(lines[:-1]) + lines[-1][:50])
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.png")}
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, "--out", out) == 0
    in_order(out)
    assert maps_in(out) == maps_in(border_set)
    assert story(out) == story(border_set)
    changed = {p for p in out.rglob("*.png") if p.stat().st_mtime_ns != before.get(p)}
    assert keys_of(map(str, changed)) == {38, 41, 42, 44}


@pytest.mark.parametrize(
    "options",
    [[], ["--method", "icp"], ["--set", "flow.engine=paper", "--window", "1"]],
    ids=" ".join,
)
def test_no_task_makes_what_another_is_for(
    options: list[str], border_drive: Path, empty_cache: Path, tmp_path: Path, monkeypatch
) -> None:
    """Else workers would do it several times."""
    made, get, run_tasks = [], Cache.get, make.run_tasks

    def watched(self, stage, kind, inputs, make):
        return get(self, stage, kind, inputs, lambda: made.append(stage) or make())

    def watched_tasks(tasks, workers):
        for outcome in run_tasks(tasks, workers):
            what = outcome.name[0]
            own = {what, "digests"} if what == "registration" else {what}
            assert outcome.error is None and set(made) <= own
            assert sum(task.name == outcome.name for task in tasks) == 1
            made.clear()
            yield outcome

    monkeypatch.setattr(Cache, "get", watched)
    monkeypatch.setattr(make, "run_tasks", watched_tasks)
    arguments = [*OPTIONS, *options, "--keys", "39:41", "--out", tmp_path / "out"]
    assert exit_code("dataset", "--data", border_drive, *arguments) == 0
    assert statuses(tmp_path / "out") == {39: "done", 40: "done"}
    kept = {path.name.partition("-")[0] for path in steps_folder().iterdir()}
    wanted = {"digests", "registration"}
    if "icp" not in options:
        wanted |= {"ground", "far"} if "flow.engine=paper" in options else {*work._NEEDS}
    assert kept == wanted


@pytest.mark.parametrize("window", [5, 14, 15, 30, 50])
def test_tasks_wait_for_all_that_they_look_at(window: int) -> None:
    job = Job(Source("a", "a", "a", ()), Recipe(window), Path("out"), 0, "", "")
    stamps_ns = 10**8 * np.arange(400)
    cut = Cut.whole(Timeline("a", tuple(range(400)), stamps_ns, {}), window)
    listed = list(tasks(job, [210, 231], cut))
    done = set()
    for task in listed:
        assert task.needs <= done
        done.add(task.name)
    assert len(done) == len(listed)
    found = {task.name: task.needs for task in listed}
    farthest = max(15, window + 5) + 1  # sweeps beyond a block
    blocks = range((200 - farthest) // 20, (219 + farthest) // 20 + 1)
    assert {("evidence", "a", b) for b in blocks} <= found["motion", "a", 10]
    assert {("registration", "a", b) for b in blocks} <= found["key", "a", 210]
    assert ("motion", "a", 11) in found["key", "a", 231]
    assert listed[-1].name == ("key", "a", 231)
    assert found.keys() > {("key", "a", 210), ("motion", "a", 11)}


# As `run`


@pytest.mark.parametrize("source", ["dataset", "kiss-icp"])
def test_the_densify_layout_is_what_run_writes(source: str, tmp_path: Path) -> None:
    """In a recording within the window, to the last byte but for what the run has cost."""
    short = write_drive(across_border(range(BORDER, BORDER + 4)), tmp_path / "2011_09_26")
    method = "flow" if source == "dataset" else "icp"
    given = ["--data", short, "--window", 4, "--method", method]
    given += ["--set", f"register.source={source}"]
    keys = ["--keys", f"{BORDER + 1}:{BORDER + 2}", "--layout", "densify"]
    out, run = tmp_path / "set", tmp_path / "run"
    assert exit_code("dataset", *given, *keys, "--out", out) == 0
    assert exit_code("run", *given, "--key", BORDER + 1, "--out", run) == 0
    (record,) = records(out)
    made, alone = files_in(out / "000041"), files_in(run / "000041")
    assert made.keys() == alone.keys() == {n.removeprefix("000041/") for n in record["files"]}
    assert [name for name in made if made[name] != alone[name]] == ["run.yaml"]
    with pytest.raises(InputError, match="layout") as error:
        DepthDataset(out)
    assert "\n" not in str(error.value)


def test_the_tree_is_read_back(
    border_set: Path, border_drive: Path, tmp_path: Path, capsys
) -> None:
    data = DepthDataset(border_set)
    assert [sample["frame"] for sample in data] == list(FRAMES)
    sample = data[3]
    dense, sparse = sample["dense_depth_m"], sample["sparse_depth_m"]
    assert (dense > 0).sum() > 2 * (sparse > 0).sum() > 1000
    assert ((sample["confidence"] > 0) == (dense > 0)).all()
    scores = tmp_path / "scores.json"
    maps = border_set / "val" / DRIVE / "proj_depth"
    assert exit_code("evaluate", maps / "groundtruth", border_set, "--out", scores) == 0
    assert json.dumps(json.loads(scores.read_text())).count('"outliers": 0.0') > 0
