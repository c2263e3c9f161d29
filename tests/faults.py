# SPDX-License-Identifier: MIT
"""``python -m tests.faults``: training sets made on bad days, each then made whole by the same
command: equal to an undisturbed one byte for byte, nothing half-written or left over, no process.

Full and read-only disks need the right to mount; failing file calls and clocks a C compiler.
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from tests.command import files_in
from tests.dataset_scenes import (
    OPTIONS,
    across_border,
    command,
    in_order,
    maps_in,
    story,
    write_drive,
)

KEYS = ("--keys", "38:42")
_PATIENCE_S = 300
_MARK = "DENSIFY_FAULTS"
CALLS = ("write", "fsync", "rename", "open", "read")


@dataclass(frozen=True)
class Bench:
    """drive: a recording. whole: the set of it, made undisturbed. place: for everything else.
    usual_s: how long that takes."""

    drive: Path
    whole: Path
    place: Path
    usual_s: float = 0.0

    @staticmethod
    def of(place: Path) -> Bench:
        drive = write_drive(across_border(), place / "2011_09_26")
        bench = Bench(drive, place / "whole", place)
        code, errors = bench.made(bench.whole)
        if code:
            raise RuntimeError(errors)
        start_s = time.monotonic()
        bench.made(bench.fresh())
        return replace(bench, usual_s=time.monotonic() - start_s)

    def start(self, out: Path, *more: str, **environment: str) -> subprocess.Popen[str]:
        """The command. Its temporary files and its cache are its own."""
        own = {"TMPDIR": str(self.place / "tmp"), _MARK: str(self.place)}
        own["DENSIFY_CACHE_DIR"] = str(self.place / "cache")
        (self.place / "tmp").mkdir(exist_ok=True)
        arguments = ("--data", str(self.drive), *OPTIONS, *KEYS, *more, "--out", str(out))
        return command(*arguments, **(own | environment))

    def made(self, out: Path, *more: str, **environment: str) -> tuple[int, str]:
        """Exit code, and what stderr says."""
        with self.start(out, *more, **environment) as process:
            _, errors = process.communicate(timeout=_PATIENCE_S)
        return process.returncode, errors

    def fresh(self) -> Path:
        """Where the next set goes; no step is known from before."""
        for name in ("out", "cache"):
            shutil.rmtree(self.place / name, ignore_errors=True)
        return self.place / "out"

    def check(self, out: Path) -> None:
        """As an undisturbed one, and nothing left. Raises AssertionError."""
        in_order(out)
        assert maps_in(out) == maps_in(self.whole), "other maps"
        assert story(out) == story(self.whole), "another story"
        self.check_nothing_left()

    def check_nothing_left(self) -> None:
        for _ in range(50):
            if not self._processes():
                break
            time.sleep(0.1)
        assert not self._processes(), f"processes {self._processes()}"
        assert not list((self.place / "tmp").rglob("*")), "temporary files"

    def _processes(self) -> list[int]:
        found = []
        mark = f"{_MARK}={self.place}".encode()
        for folder in Path("/proc").iterdir():
            try:
                if mark in (folder / "environ").read_bytes() and folder.name != str(os.getpid()):
                    found.append(int(folder.name))
            except (OSError, ValueError):
                continue
        return found


def told_in_a_line(code: int, errors: str) -> None:
    """Why it failed."""
    assert "Traceback" not in errors and "this is a bug" not in errors, errors
    lines = [x for x in errors.splitlines() if not x.startswith("densify: warning: ")]
    lines = [x for x in lines if "to make with" not in x and "s a key, " not in x]
    assert (len(lines) == 1) == (code != 0) and len(lines) <= 1, errors


# Faults: each leaves OUT in some state; returns what is worth telling


def killed(bench: Bench, out: Path, rng: random.Random, number: int, workers: int) -> str:
    """With a signal, somewhere among the keys."""
    before: dict[Path, int] = {}
    after_s = rng.uniform(0.2, 0.9) * bench.usual_s
    with bench.start(out, "--workers", str(workers)) as process:
        try:
            process.communicate(timeout=after_s)
            return "over before"
        except subprocess.TimeoutExpired:
            before = {p: p.stat().st_mtime_ns for p in out.rglob("*.png")} if out.exists() else {}
            os.kill(process.pid, number)
        _, errors = process.communicate(timeout=_PATIENCE_S)
    if number != signal.SIGKILL:
        assert process.returncode == 130, (process.returncode, errors)
        left = [n for n in files_in(out) if n.endswith(".tmp")] if out.exists() else []
        assert not left, left
    bench.check_nothing_left()
    assert all(p.stat().st_mtime_ns == at for p, at in before.items()), "a finished file is gone"
    return f"after {after_s:.1f} s"


@cache
def preload(folder: Path) -> Path | None:
    """The compiled library; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    library, source = folder / "faults.so", Path(__file__).with_name("faults.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return library


def failing(
    bench: Bench, out: Path, rng: random.Random, call: str, number: int, workers: int
) -> str:
    """A file call below OUT, or a read of the recording, once."""
    library = preload(bench.place)
    if library is None:
        return "no compiler"
    environment = {
        "LD_PRELOAD": str(library),
        "FAULT_PATH": str(bench.drive if call == "read" else out),
        "FAULT_CALL": call,
        "FAULT_NTH": str(rng.randrange(24)),
        "FAULT_ERRNO": str(number),
    }
    code, errors = bench.made(out, "--workers", str(workers), **environment)
    if number == errno.EINTR and call != "rename":  # which no Python tries again
        assert code == 0, errors
    told_in_a_line(code, errors)
    return f"call {environment['FAULT_NTH']}: exit {code}"


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[Path]:
    place.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(place)]
    subprocess.run(mount, check=True, capture_output=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def full(bench: Bench, out: Path, rng: random.Random) -> str:
    size = rng.choice(("4k", "12k", "24k", "60k", "120k", "200k"))
    with small_disk(bench.place / "disk", size) as disk:
        code, errors = bench.made(disk / "out")
        told_in_a_line(code, errors)
        assert code in (0, 1, 2)
        asides = [n for n in files_in(disk) if n.endswith(".tmp")]
        assert not asides, asides
        shutil.copytree(disk / "out", out) if (disk / "out").exists() else None
    return f"{size}: exit {code}"


def read_only(bench: Bench, out: Path, rng: random.Random) -> str:
    with small_disk(bench.place / "disk", "4M") as disk:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        code, errors = bench.made(disk / "out")
        told_in_a_line(code, errors)
        assert code == 2
    return f"exit {code}"


def limited(bench: Bench, out: Path, rng: random.Random, what: str, most: int) -> str:
    """By ulimit: the address space, or the size of a file."""
    limit = f"ulimit -{what} {most} && exec "
    arguments = ["--data", str(bench.drive), *OPTIONS, *KEYS, "--out", str(out)]
    own = {"TMPDIR": str(bench.place / "tmp"), "DENSIFY_CACHE_DIR": str(bench.place / "cache")}
    done = subprocess.run(
        ["sh", "-c", limit + '"$@"', "sh", sys.executable, "-m", "densify", "dataset", *arguments],
        env={**os.environ, **own, _MARK: str(bench.place)},
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
    )
    told_in_a_line(done.returncode, done.stderr)
    assert not out.exists() or not [n for n in files_in(out) if n.endswith(".tmp")]
    return f"exit {done.returncode}: {(done.stderr.splitlines() or [''])[-1][:90]}"


def clock_back(bench: Bench, out: Path, rng: random.Random) -> str:
    """By a year, after half of the keys."""
    library = preload(bench.place)
    if library is None:
        return "no compiler"
    assert bench.made(out, "--keys", "38:40")[0] == 0
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.png")}
    back = {"LD_PRELOAD": str(library), "FAULT_CLOCK_S": str(-365 * 86400)}
    code, errors = bench.made(out, **back)
    assert code == 0, errors
    assert before and all(p.stat().st_mtime_ns == at for p, at in before.items())
    return ""


def two_at_once(bench: Bench, out: Path, rng: random.Random, shards: bool) -> str:
    """On one folder: parts of the work, or the same work."""
    mores = [("--shard", "1/2"), ("--shard", "2/2")] if shards else [(), ()]
    processes = [bench.start(out, *more) for more in mores]
    errors = [process.communicate(timeout=_PATIENCE_S)[1] for process in processes]
    codes = sorted(process.returncode for process in processes)
    if shards:
        assert codes == [0, 0], errors
        shutil.rmtree(out)  # whose manifests are other files than those of one run
    else:
        assert codes in ([0, 2], [0, 0]), errors
        for process, said in zip(processes, errors, strict=True):
            assert process.returncode == 0 or "another run is at work there" in said
    return f"exit {codes}"


def eight_with_one_cache(bench: Bench, out: Path, rng: random.Random) -> str:
    places = [bench.place / f"of-{i}" for i in range(8)]
    processes = [bench.start(place) for place in places]
    for process, place in zip(processes, places, strict=True):
        errors = process.communicate(timeout=3 * _PATIENCE_S)[1]
        assert process.returncode == 0, errors
        in_order(place)
        assert maps_in(place) == maps_in(bench.whole)
        shutil.rmtree(place)
    assert not [p for p in (bench.place / "cache").rglob("*.tmp")]
    return ""


Fault = Callable[[Bench, Path, random.Random], str]


def faults() -> dict[str, Fault]:
    """By name."""
    table: dict[str, Fault] = {}
    for name in ("SIGTERM", "SIGHUP", "SIGINT", "SIGKILL"):
        for workers in (1, 2):
            number = getattr(signal, name)
            table[f"{name}, {workers} worker(s)"] = lambda b, o, r, n=number, w=workers: killed(
                b, o, r, n, w
            )
    for call in CALLS:
        for name in ("EIO", "EINTR", "ENOSPC"):
            if name == "ENOSPC" and call in ("open", "read"):
                continue
            number = getattr(errno, name)
            table[f"{name} of {call}"] = lambda b, o, r, c=call, n=number: failing(b, o, r, c, n, 1)
    table["EIO of write, 2 workers"] = lambda b, o, r: failing(b, o, r, "write", errno.EIO, 2)
    table["full disk"] = full
    table["read-only disk"] = read_only
    for kilobytes in (600_000, 1_200_000, 2_000_000):
        table[f"ulimit -v {kilobytes}"] = lambda b, o, r, k=kilobytes: limited(b, o, r, "v", k)
    table["ulimit -f 8"] = lambda b, o, r: limited(b, o, r, "f", 8)
    table["clock set back a year"] = clock_back
    table["two shards on one folder"] = lambda b, o, r: two_at_once(b, o, r, True)
    table["two runs on one folder"] = lambda b, o, r: two_at_once(b, o, r, False)
    table["eight runs with one cache"] = eight_with_one_cache
    return table


def tried(bench: Bench, fault: Fault, rng: random.Random) -> str:
    """What the fault did. Raises AssertionError unless the same command makes the set whole."""
    out = bench.fresh()
    said = fault(bench, out, rng)
    code, errors = bench.made(out)
    assert code == 0, errors
    bench.check(out)
    return said


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="faults whose names have this in them")
    options = parser.parse_args()
    rng, num_bad = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench.of(Path(folder).resolve())
        for name, fault in faults().items():
            if options.only and options.only not in name:
                continue
            for _ in range(options.rounds):
                try:
                    said = "ok  " + tried(bench, fault, rng)
                except (AssertionError, subprocess.SubprocessError) as error:
                    num_bad, said = num_bad + 1, f"BAD {' '.join(str(error).split())[:600]}"
                print(f"{name:28}{said}", flush=True)
    return bool(num_bad)


if __name__ == "__main__":
    sys.exit(main())
