# SPDX-License-Identifier: MIT
"""What the tests of the executor have called: a module of its own, for workers to import."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from pathlib import Path


def square(number: int) -> int:
    if number < 0:
        raise KeyError("negative")
    if number >= 1000:
        logging.getLogger("densify.dataset").warning("large: %d", number)
    return number * number


def note(item: tuple[Path, int, bool]) -> bool:
    """Leave a file; return whether the group's first item had left its own."""
    folder, group, is_first = item[0], item[1] // 10, item[2]
    there = (folder / f"{group}").exists()
    if is_first:
        time.sleep(0.05)
        (folder / f"{group}").touch()
    return there


def die_once(item: tuple[Path, int]) -> int:
    """Number 3 kills its process the first time, number 7 always."""
    folder, number = item
    if number == 7 or (number == 3 and not (folder / "died").exists()):
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def wait(place: Path) -> None:
    """Leave the process number in a file, and never return."""
    aside = place.with_suffix(".part")
    aside.write_text(str(os.getpid()))
    aside.rename(place)
    time.sleep(600)


def threads(_: int) -> tuple[str, int, bool]:
    """Return what OpenBLAS and numba are told, and whether any was loaded too early to hear it."""
    early = bool({"numba", "torch", "numpy"} & set(sys.modules))
    import numba

    return os.environ["OPENBLAS_NUM_THREADS"], numba.config.NUMBA_NUM_THREADS, early
