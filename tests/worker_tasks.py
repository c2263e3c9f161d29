# SPDX-License-Identifier: MIT
"""What the tests of the workers have called: a module of its own, for workers to import."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from pathlib import Path


class TwoPartError(Exception):
    """Pickles, but does not come out of the pickle."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first} {second}")


def square(number: int) -> int:
    return number * number


def process() -> int:
    return os.getpid()


def fail(error: type[Exception], *arguments: str) -> None:
    raise error(*arguments)


def unpicklable() -> object:
    return lambda: None


def warn(text: str) -> None:
    log = logging.getLogger("densify.registration.odometry")
    log.debug("not asked for")
    log.warning("%s by %d", text, os.getpid())
    raise ValueError(text)


def warn_together(number: int) -> None:
    """By two threads of this process, at the same time."""
    _TOGETHER.wait(30)
    logging.getLogger("densify").warning("%d", number)
    _TOGETHER.wait(30)


_TOGETHER = threading.Barrier(2)


def note(folder: Path, name: str, needs: list[str]) -> list[str]:
    """Leaves a file when it is over; the names of those that should have left theirs before."""
    missing = [need for need in needs if not (folder / need).exists()]
    time.sleep(0.01)
    (folder / name).touch()
    return missing


def square_at_second_try(folder: Path, number: int) -> int:
    """The first time it leaves the process that it runs in, and waits for its end."""
    place = folder / f"{number}.pid"
    if not place.exists():
        wait(place)
    return square(number)


def wait(place: Path) -> None:
    """Leave the process that it runs in, and never return."""
    aside = place.with_suffix(".part")
    aside.write_text(str(os.getpid()))
    aside.rename(place)
    time.sleep(600)


def write_aside(place: Path) -> None:
    """Have an unfinished file, never finish it, and remove it when interrupted."""
    place.touch()
    try:
        while True:
            time.sleep(0.01)
    finally:
        place.unlink()


def nap(seconds: float) -> None:
    time.sleep(seconds)


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fill_memory(num_bytes: int) -> None:
    kept = bytearray(num_bytes)
    kept[::4096] = b"x" * len(kept[::4096])
    time.sleep(600)


def keep_memory(num_bytes: int) -> int:
    """Take more each time, and never give it back."""
    _KEPT.append(b"x" * num_bytes)
    time.sleep(0.25)  # for who watches
    return os.getpid()


_KEPT: list[bytes] = []


def threads() -> tuple[str, int, bool]:
    """What OpenBLAS and numba are told, and whether any was loaded too early to hear it."""
    early = bool({"numba", "torch", "numpy"} & set(sys.modules))
    import numba

    return os.environ["OPENBLAS_NUM_THREADS"], numba.config.NUMBA_NUM_THREADS, early
