# SPDX-License-Identifier: MIT
"""``python -m tests.fuzz --minutes N``: mutated files at every door of `tests.fuzz_doors`, in a
process that may crash, hang or run out of memory.

What is found lies in ``--keep``, one folder for each kind of finding, with the file as it was and
what happened; a small one belongs into ``tests/corpus/DOOR/``, where `tests.test_fuzz` tries it
from then on. Real recordings are used where DENSIFY_TEST_DATA names some.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import NamedTuple

from tests.fuzz_doors import ALLOWED, Door, door, file_doors, real_trees, trees
from tests.mutations import mutated

PATIENCE_S = 60.0
SAY = ("words",)  # argparse
_MEMORY_BYTES = 4 << 30  # beyond what the process has
_FILES_TO_A_TREE = 12  # how often a door of files is tried for each time that a tree is
_STATE = struct.Struct("<qd")


class Case(NamedTuple):
    door: Door
    name: str
    content: bytes


def case(chosen: Door, rng: Random) -> Case:
    """A file of the door, changed."""
    names = sorted(chosen.seeds)
    name = rng.choice(names)
    alike = [n for n in names if Path(n).suffix == Path(name).suffix]
    return Case(chosen, name, mutated(rng, chosen.seeds[name], chosen.seeds[rng.choice(alike)]))


def what_is_wrong(tried: Case, scratch: Path) -> str | None:
    """None if the door took the file or refused it as it should: in one line, soon, without a word
    on stderr."""
    start, said = time.process_time(), os.fstat(2).st_size
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tried.door.attempt(tried.name, tried.content, scratch)
    except ALLOWED as error:
        line = str(error)
        if "\n" in line or not 0 < len(line) <= 1000:
            return f"a message of {len(line)} characters: {line[:300]!r}"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        ours = [f for f in traceback.extract_tb(error.__traceback__) if "/densify/" in f.filename]
        where = f"{ours[-1].filename}:{ours[-1].lineno}" if ours else ""
        return f"{type(error).__name__} at {last.filename}:{last.lineno} by {where}\n" + "".join(
            traceback.format_exception(error)
        )
    seconds = time.process_time() - start
    if seconds > PATIENCE_S / 3:
        return f"{seconds:.0f} s"
    lines = os.pread(2, os.fstat(2).st_size - said, said).splitlines()
    if lines and tried.door.name not in SAY:
        return f"on stderr: {lines[0]!r}"
    return None


def schedule(files: Sequence[str], recordings: Sequence[str]) -> list[str]:
    """Names of doors, to be gone through again and again."""
    return [*files] * _FILES_TO_A_TREE + [*recordings]


def nth(number: int, seed: int, order: Sequence[str], root: Path) -> Case:
    """The same for the same seed."""
    return case(door(order[number % len(order)], root), Random(f"{seed} {number}"))


def _work(first: int, end_s: float, seed: int, order: Sequence[str], root: Path, state: mmap.mmap,
          keep: Path) -> None:  # fmt: skip
    """In a process of its own."""
    logging.disable()  # what the log is told is meant
    log = os.open(root / "stderr", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 2)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY_BYTES,) * 2)
    scratch, number = root / "scratch", first
    scratch.mkdir(exist_ok=True)
    while time.monotonic() < end_s:
        state[: _STATE.size] = _STATE.pack(number, time.monotonic())
        tried = nth(number, seed, order, root)
        wrong = what_is_wrong(tried, scratch)
        if wrong is not None:
            _keep(keep, tried, wrong)
        number += 1
    state[: _STATE.size] = _STATE.pack(number, time.monotonic())


def _keep(keep: Path, tried: Case, wrong: str) -> None:
    kind = hashlib.sha256(wrong.split("\n")[0].encode()).hexdigest()[:8]
    folder = keep / tried.door.name / kind
    if not folder.exists():
        (folder / tried.name).parent.mkdir(parents=True)
        (folder / tried.name).write_bytes(tried.content)
        (folder / "WHAT").write_text(wrong)


def fuzz(
    minutes: float, seed: int, files: Sequence[str], recordings: Sequence[str], keep: Path
) -> Counter[str]:
    """How many cases each door had."""
    order, end_s, number = schedule(files, recordings), time.monotonic() + 60 * minutes, 0
    with tempfile.TemporaryDirectory() as place:
        root, state = Path(place), mmap.mmap(-1, _STATE.size)
        for name in dict.fromkeys(order):
            door(name, root)
        end_s = time.monotonic() + 60 * minutes
        while time.monotonic() < end_s:
            state[:] = _STATE.pack(number, time.monotonic())
            child = os.fork()
            if child == 0:
                try:
                    _work(number, end_s, seed, order, root, state, keep)
                    os._exit(0)
                finally:
                    os._exit(1)
            status = _waited(child, state)
            number = _STATE.unpack(state[:])[0]
            if status:
                tried = nth(number, seed, order, root)
                if tried.door.home is not None:
                    (tried.door.home / tried.name).write_bytes(tried.door.seeds[tried.name])
                _keep(keep, tried, f"the process ended with {status}")
                number += 1
    rounds = Counter({name: number // len(order) * order.count(name) for name in order})
    return rounds + Counter(order[: number % len(order)])


def _waited(child: int, state: mmap.mmap) -> int:
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status
        if time.monotonic() > _STATE.unpack(state[:])[1] + PATIENCE_S:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--door", action="append", help="only this one; may be given several times")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-found"))
    options = parser.parse_args()
    files, recordings = file_doors(), [*trees(), *real_trees()]
    if options.door:
        files = [name for name in files if name in options.door]
        recordings = [name for name in recordings if name in options.door]
    counts = fuzz(options.minutes, options.seed, files, recordings, options.keep)
    found = sorted(path.parent for path in options.keep.rglob("WHAT"))
    print(", ".join(f"{name} {number}" for name, number in counts.items()))
    print(f"{counts.total():,} inputs, {counts.total() / options.minutes * 60:,.0f} an hour")
    for folder in found:
        print(f"{folder}: {(folder / 'WHAT').read_text().splitlines()[0]}")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
