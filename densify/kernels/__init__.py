# SPDX-License-Identifier: MIT
"""Compiled inner loops; the only door to numba.

A kernel takes arrays of fixed types, writes into arrays it is given and raises nothing. It lets go
of the interpreter while it works, and rows are shared out among plain threads: numba's own parallel
loops abort the process when two threads enter them at once, or after a fork.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, TypeVar

import numba

_log = logging.getLogger("densify")
_MIN_ROWS_PER_THREAD = 50_000
_Function = TypeVar("_Function", bound=Callable[..., Any])

# No fastmath, and divisions as numpy has them: a result is the same on every machine.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def inlined(function: _Function) -> _Function:
    """Compiled as a part of the kernels that call it; they must stand in the same file, or a change
    would not be seen by their cached code."""
    compiled: _Function = numba.njit(**_OPTIONS)(function)
    return compiled


class Kernel:
    """A function that is compiled when first called with new types, and kept for later runs.

    The cache lies beside the source file, else in the user's cache directory, or where the
    environment variable NUMBA_CACHE_DIR says. Where none can be written, or what lies there is
    damaged, it is compiled anew in every run.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.__doc__ = function.__doc__
        self._function = function
        try:
            self._compiled = numba.njit(function, cache=True, **_OPTIONS)
        except RuntimeError as error:  # no place for a cache
            self._do_without_cache(error)

    def __call__(self, *arguments: Any) -> None:
        try:
            self._compiled(*arguments)
        except Exception as error:  # a full disk, a damaged file: unpickling can raise anything
            self._do_without_cache(error)
            self._compiled(*arguments)

    def over_rows(self, num_rows: int, *arguments: Any) -> None:
        """Call with (first, last, *arguments) for parts of the rows, on all cores.

        The parts do not change the result where a kernel treats every row by itself.
        NUMBA_NUM_THREADS limits the threads.
        """
        cores = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        num_threads = min(cores, num_rows // _MIN_ROWS_PER_THREAD)
        if num_threads < 2:
            self(0, num_rows, *arguments)
            return
        bounds = [num_rows * k // num_threads for k in range(num_threads + 1)]
        with ThreadPoolExecutor(num_threads) as pool:
            parts = [pool.submit(self, first, last, *arguments) for first, last in pairwise(bounds)]
        for part in parts:
            part.result()

    def _do_without_cache(self, error: Exception) -> None:
        _log.debug("%s is compiled without a cache: %s", self._function.__name__, error)
        self._compiled = numba.njit(self._function, **_OPTIONS)
