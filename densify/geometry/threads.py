# SPDX-License-Identifier: MIT
"""Rows shared among plain threads, for functions that release Python's lock.

Numba's own parallel loops are not used: their order of summation depends on the number of threads,
their pools abort the process after a fork or when two threads enter them at once, and OpenMP waits
in busy loops, which costs tenfold where cores are shared.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any

import numba

_LEAST_ROWS = 4096  # to hand fewer to a second thread takes longer than most kernels do for them


def num_threads() -> int:
    """Return the number of cores this process may use, or NUMBA_NUM_THREADS if that is fewer."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def over_rows(function: Callable[..., None], num_rows: int, *arguments: Any) -> None:
    """Call ``function(begin, end, *arguments)`` for ranges that cover 0 to ``num_rows``.

    function: its result for a row must depend on that row alone. It may not call this one.
    """
    num_parts = min(num_threads(), num_rows // _LEAST_ROWS)
    if num_parts <= 1:
        function(0, num_rows, *arguments)
        return
    bounds = [num_rows * part // num_parts for part in range(num_parts + 1)]
    parts = list(pairwise(bounds))
    others = [_pool().submit(function, begin, end, *arguments) for begin, end in parts[1:]]
    try:
        function(*parts[0], *arguments)
    finally:
        wait(others)  # before any error is raised: they write into the caller's arrays
        for other in others:
            other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads(), "densify-kernel")


if hasattr(os, "register_at_fork"):  # a forked process has the pool but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
