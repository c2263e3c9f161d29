# SPDX-License-Identifier: MIT
"""`densify dataset` through kills, damaged input, full disks and damaged caches: what is finished
stays, the rest is made by the same command, and it is the same set."""

from __future__ import annotations

import errno
import logging
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from densify.config import resolve
from densify.dataset import work
from densify.dataset.make import make_dataset
from densify.dataset.manifest import finished, read_manifests
from densify.dataset.plan import Recipe
from densify.outputs import atomic
from tests.command import exit_code, files_in
from tests.dataset_scenes import (
    BORDER,
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
    write_sweep,
)

PATIENCE_S = 120
TWO_KEYS = ("--keys", "39:41")


def progress(out: Path) -> int:
    """How much there is of a set: grows with everything that is done."""
    log = out / "densify.log"
    return len(list(out.rglob("*"))) + (log.read_bytes().count(b"\n") if log.exists() else 0)


def kept(out: Path) -> dict[Path, int]:
    """When the files of finished keys were written."""
    found = read_manifests(out)
    whole = finished(found.values(), out)
    return {out / n: (out / n).stat().st_mtime_ns for key in whole for n in found[key].files}


def kill_at(target: int, out: Path, *arguments: str | Path) -> None:
    """Start the command and kill it with all that it started when it has come so far."""
    with command(*arguments, "--out", out) as process:
        end = time.monotonic() + PATIENCE_S
        while progress(out) < target and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.002)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize(("workers", "seed", "num_kills"), [(1, 1, 3), (2, 1, 2)])
def test_killed_at_any_moment(
    workers: int,
    seed: int,
    num_kills: int,
    border_drive: Path,
    border_set: Path,
    empty_cache: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    arguments = ["--data", border_drive, *OPTIONS, "--workers", str(workers)]
    rng = random.Random(seed)
    for _ in range(num_kills):
        before = kept(out) if out.exists() else {}
        target = (progress(out) if out.exists() else 0) + rng.randint(5, 50)
        kill_at(target, out, *arguments)
        now = kept(out)
        assert {path: now.get(path) for path in before} == before
    before = kept(out)
    assert exit_code("dataset", *arguments[:-2], "--out", out) == 0
    in_order(out)
    assert maps_in(out) == maps_in(border_set)
    assert story(out) == story(border_set)
    now = kept(out)
    assert {path: now[path] for path in before} == before


def test_a_worker_killed_in_the_middle_costs_no_key(
    border_drive: Path, border_set: Path, empty_cache: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["--data", border_drive, *OPTIONS, "--workers", "2", "--out", out]
    with command(*arguments) as process:
        end = time.monotonic() + PATIENCE_S
        while not list(out.rglob("*.png")) and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.01)
        (victim, *_) = workers_of(process.pid)
        os.kill(victim, signal.SIGKILL)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "9 keys: 9 done; 9 now" in said
    in_order(out)
    assert maps_in(out) == maps_in(border_set)


def workers_of(pid: int) -> list[int]:
    """Processes below it that have worked most."""
    below, found = [pid], []
    while below:
        children = Path(f"/proc/{below[0]}/task/{below[0]}/children")
        below = [*below[1:], *map(int, children.read_text().split())]
        found += below[-1:]
    times = {}
    for one in set(found) | set(below):
        fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        times[one] = int(fields[11]) + int(fields[12])
    return sorted(times, key=lambda one: -times[one])


# Sweeps in the way


@pytest.mark.parametrize(("bad", "how"), [(BORDER - 1, "torn"), (BORDER + 1, "noise")])
def test_a_corrupt_sweep_costs_its_key_alone(
    bad: int, how: str, border_drive: Path, border_set: Path, tmp_path: Path, capsys
) -> None:
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    out = tmp_path / "out"
    path = sweep_file(drive, bad)
    if how == "torn":
        path.write_bytes(path.read_bytes()[:-5])
        reason = str(path)
    else:
        noise = np.random.default_rng(1).uniform(-40, 40, (8000, 4))
        path.write_bytes(noise.astype("<f4").tobytes())
        reason = "registration fails"
    arguments = ["--data", drive, *OPTIONS, "--out", out]
    assert exit_code("dataset", *arguments) == 1
    said, errors = capsys.readouterr()
    assert f"{drive.name} {bad} failed: " in said and reason in said
    assert errors.splitlines()[-1] == "densify: 1 of 9 keys not made"
    assert "Traceback" not in errors
    assert statuses(out) == {f: "failed" if f == bad else "done" for f in FRAMES}
    for record in records(out):
        if record["key"] != bad:
            near = [f for f in FRAMES if abs(f - record["key"]) <= 2 and f != bad]
            assert record["frames"] == [f for f in near if (f < bad) == (record["key"] < bad)]
    in_order(out)
    before = kept(out)
    # The same process goes on after it has been mended.
    write_sweep(across_border(), drive, bad)
    assert exit_code("dataset", *arguments) == 0
    assert set(statuses(out).values()) == {"done"}
    in_order(out)
    now = kept(out)
    assert {path: now[path] for path in before} == before
    assert {n: d for n, d in maps_in(out).items() if keys_of([n]) == {bad}} == {
        n: d for n, d in maps_in(border_set).items() if keys_of([n]) == {bad}
    }


def test_a_bug_in_one_key_costs_that_key(
    border_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    made = work._made

    def failing(job, key):
        if key == 40:
            raise ZeroDivisionError("by zero")
        return made(job, key)

    monkeypatch.setattr(work, "_made", failing)
    out = tmp_path / "out"
    summary = make_dataset(
        [str(border_drive)], out, slice(39, 42), Recipe(2, config=resolve(GIVEN))
    )
    assert (summary.count("done"), summary.count("failed"), summary.num_left) == (2, 1, 0)
    (failed,) = [r for r in records(out) if r["status"] == "failed"]
    told = "this is a bug in densify; please report it with densify.log: ZeroDivisionError: by zero"
    assert (failed["key"], failed["reason"]) == (40, told)
    assert "failing" in (out / "densify.log").read_text()  # the traceback
    shown = [r.getMessage() for r in caplog.records if r.levelno > logging.DEBUG]
    assert not any("Traceback" in text for text in shown)


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")], ids=str)
def test_no_memory_for_one_key_costs_that_key(
    error: Exception, border_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(job, key):
        raise error

    monkeypatch.setattr(work, "_made", failing)
    out = tmp_path / "out"
    make_dataset([str(border_drive)], out, slice(39, 40), Recipe(2, config=resolve(GIVEN)))
    (failed,) = records(out)
    assert failed["status"] == "failed" and failed["reason"].startswith("out of memory (")


GIVEN = {"register": {"source": "dataset"}}


def test_interrupted(
    border_drive: Path, border_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    made = work._made

    def interrupted(job, key):
        if key == 38:
            raise KeyboardInterrupt
        return made(job, key)

    out = tmp_path / "out"
    arguments = ["--data", border_drive, *OPTIONS, "--out", out]
    with monkeypatch.context() as patch:
        patch.setattr(work, "_made", interrupted)
        assert exit_code("dataset", *arguments) == 130
    first, last = told(capsys)
    assert first.endswith("2 of 9 keys are finished and kept") and "interrupted" in last
    assert statuses(out) == {36: "done", 37: "done"}
    assert exit_code("dataset", *arguments) == 0
    in_order(out)
    assert maps_in(out) == maps_in(border_set)


# Disks


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 600 KB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "none", str(place)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no file system can be mounted here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill(disk: Path, num_free: int) -> Path:
    """With a file, but for so many pages."""
    filler, page = disk / "filler", b"x" * 4096
    with filler.open("wb", buffering=0) as file:
        try:
            while file.write(page) == len(page):
                pass
        except OSError as error:
            assert error.errno == errno.ENOSPC
        file.truncate(max(0, file.tell() // len(page) - num_free) * len(page))
    return filler


@pytest.mark.parametrize("num_free", [0, 1, 2, 4, 6, 11])
def test_a_full_disk(
    num_free: int, border_drive: Path, border_set: Path, small_disk: Path, capsys
) -> None:
    """num_free: pages that are free at the start."""
    out, filler = small_disk / "out", fill(small_disk, num_free)
    arguments = ["--data", border_drive, *OPTIONS, "--keys", "38:42", "--out", out]
    # A place that cannot even hold the plan is no place for a set.
    assert exit_code("dataset", *arguments) == (2 if num_free < 2 else 1)
    said, errors = capsys.readouterr()
    wrong = [x for x in errors.splitlines() if not x.startswith("densify: warning: ")]
    wrong = [x for x in wrong if "to make with" not in x]
    assert len(wrong) == 1, errors
    assert wrong[0].startswith("densify: --out") and "No space left on device" in wrong[0]
    assert said == ""
    assert not [n for n in files_in(small_disk) if n.endswith((".tmp", ".old"))]
    left = kept(out) if out.exists() else {}
    filler.unlink()
    assert exit_code("dataset", *arguments) == 0
    in_order(out)
    asked = {n: d for n, d in maps_in(border_set).items() if keys_of([n]) <= set(range(38, 42))}
    assert maps_in(out) == asked
    now = kept(out)
    assert {path: now[path] for path in left} == left


def test_a_disk_that_fills_up_between_two_files(
    border_drive: Path, border_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    out = tmp_path / "out"
    replace, num_pngs = os.replace, 0

    def full(source: Path, target: Path) -> None:
        nonlocal num_pngs
        num_pngs += str(target).endswith(".png")
        if num_pngs > 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    arguments = ["--data", border_drive, *OPTIONS, "--out", out]
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", full)
        assert exit_code("dataset", *arguments) == 1
    _, errors = capsys.readouterr()
    assert errors.splitlines()[-1].endswith("1 of 9 keys are finished and kept")
    assert statuses(out) == {FRAMES[0]: "done"}
    assert not [n for n in files_in(out) if n.endswith(".tmp")]
    assert exit_code("dataset", *arguments) == 0
    in_order(out)
    assert maps_in(out) == maps_in(border_set)


# Caches


def files_of(cache: Path) -> list[Path]:
    return sorted(p for p in (cache / "steps").rglob("*") if p.is_file())


@pytest.fixture(scope="module")
def used_cache(border_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Left by a run for two keys."""
    cache = tmp_path_factory.mktemp("used") / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DENSIFY_CACHE_DIR", str(cache))
        out = cache.with_name("out")
        assert exit_code("dataset", "--data", border_drive, *OPTIONS, *TWO_KEYS, "--out", out) == 0
    return cache


@pytest.mark.parametrize("how", ["cut", "zeroed", "garbage", "gone", "a folder"])
def test_a_damaged_cache_is_made_anew(
    how: str,
    used_cache: Path,
    border_drive: Path,
    border_set: Path,
    empty_cache: Path,
    tmp_path: Path,
    capsys,
) -> None:
    shutil.copytree(used_cache, empty_cache)
    files = files_of(empty_cache)
    assert len(files) > 10
    rng = random.Random(5)
    for path in files:
        data = path.read_bytes()
        path.unlink()
        if how == "a folder":
            path.mkdir()
        elif how != "gone":
            path.write_bytes(
                {
                    "cut": data[: len(data) // 2],
                    "zeroed": bytes(len(data)),
                    "garbage": rng.randbytes(len(data)),
                }[how]
            )
    capsys.readouterr()
    out = tmp_path / "out"
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, *TWO_KEYS, "--out", out) == 0
    assert told(capsys) == []
    assert keys_of(maps_in(out)) == {39, 40}
    assert maps_in(out).items() <= maps_in(border_set).items()


def test_a_cache_that_cannot_be_made_only_costs_time(
    border_drive: Path, border_set: Path, empty_cache: Path, tmp_path: Path, capsys
) -> None:
    empty_cache.write_text("in the way")
    arguments = ["--data", border_drive, *OPTIONS, *TWO_KEYS, "--out", tmp_path / "out"]
    assert exit_code("dataset", *arguments) == 0
    (warned,) = told(capsys)
    assert warned.startswith("densify: warning: ") and str(empty_cache) in warned
    assert maps_in(tmp_path / "out").items() <= maps_in(border_set).items()


@pytest.mark.parametrize("num_free", [0, 10])
def test_a_full_cache_only_costs_time(
    num_free: int,
    border_drive: Path,
    border_set: Path,
    small_disk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys,
) -> None:
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(small_disk / "cache"))
    fill(small_disk, num_free)
    arguments = ["--data", border_drive, *OPTIONS, *TWO_KEYS, "--out", tmp_path / "out"]
    assert exit_code("dataset", *arguments) == 0
    assert [line for line in told(capsys) if "nothing is kept" not in line] == []
    assert maps_in(tmp_path / "out").items() <= maps_in(border_set).items()
    assert keys_of(maps_in(tmp_path / "out")) == {39, 40}


def told(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Lines on stderr but for the one before the work."""
    return [line for line in capsys.readouterr().err.splitlines() if "to make with" not in line]
