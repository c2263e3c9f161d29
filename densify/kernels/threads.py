# SPDX-License-Identifier: MIT
"""Compiled functions on all cores: plain threads around functions that let go of Python's lock.

Numba's own parallel loops are not used: their order of summation follows the number of threads,
their pools may not be entered from two threads at once, and OpenMP waits in busy loops, which
costs tenfold where cores are shared."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

_LEAST_ITEMS = 2048  # below this a second thread costs more than it saves


def num_threads() -> int:
    """The cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_parallel(kernel: Callable[..., None], num_items: int, *arguments: Any) -> None:
    """Call ``kernel(begin, end, *arguments)`` so that the ranges cover 0 to ``num_items``.

    kernel: nogil; what it writes for an item must depend on that item alone.
    """
    num_parts = min(num_threads(), max(1, num_items // _LEAST_ITEMS))
    bounds = [num_items * part // num_parts for part in range(num_parts + 1)]
    parts = list(pairwise(bounds))
    others = [_pool().submit(kernel, begin, end, *arguments) for begin, end in parts[1:]]
    try:
        kernel(*parts[0], *arguments)
    finally:
        for other in others:
            other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads(), "densify-kernel")
