# SPDX-License-Identifier: MIT
"""Rows shared out among plain threads, around functions that let go of Python's lock.

Numba's own parallel loops are not used: their order of summation follows the number of threads,
their pools abort the process when two threads enter them at once or after a fork, and OpenMP waits
in busy loops, which costs tenfold where cores are shared."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import numba

_LEAST_ROWS = 4096  # to hand fewer to a second thread takes longer than most kernels do for them


def num_threads() -> int:
    """The cores this process may use, or fewer where NUMBA_NUM_THREADS says so."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


@contextmanager
def tasks() -> Iterator[Executor]:
    """A pool of `num_threads` threads, of tasks that wait for none but those submitted before: so
    one thread is enough. What has not begun when an error leaves the block never does; an
    interruption does not wait for the rest either."""
    pool = ThreadPoolExecutor(num_threads())
    try:
        yield pool
    except KeyboardInterrupt:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    except BaseException:
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def over_rows(function: Callable[..., None], num_rows: int, *arguments: Any) -> None:
    """Call ``function(begin, end, *arguments)`` so that the ranges cover 0 to ``num_rows``.

    function: what it writes for a row must depend on that row alone. It may not call this one.
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
