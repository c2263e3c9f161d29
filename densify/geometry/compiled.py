# SPDX-License-Identifier: MIT
"""Compile inner loops by numba. No other module imports numba.

A kernel takes arrays of fixed types, writes into given arrays and raises nothing. It releases the
interpreter while it runs, and threads can share its rows.

Compiling takes a quarter of a first run. Rows are assigned number by number: an array or a tuple at
once takes 1.6 s to compile. A literal argument of an inlined function compiles it once more.
Numba's own parallel loops are not used. Their order of summation depends on the number of threads.
Their pools abort the process after a fork or when two threads enter them at once. OpenMP waits in
busy loops, which costs tenfold where cores are shared.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

from densify.config.cache import others_can_write

_log = logging.getLogger("densify")
_progress = logging.getLogger("densify.progress")
_Function = TypeVar("_Function", bound=Callable[..., Any])

# No fastmath, and divisions as in numpy: results are the same on every machine. Wrappers for
# unused kinds of callers would take a tenth of the compile time.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_NOT_FROM_PYTHON: dict[str, Any] = {"no_cpython_wrapper": True}
_LEAST_ROWS = 4096  # a second thread for fewer rows takes longer than most kernels


class _Compiling(event.Listener):
    """Log once that this run takes longer, when numba compiles."""

    said = False

    def on_start(self, event: event.Event) -> None:
        if not self.said and str(event.data["dispatcher"].__module__).startswith("densify."):
            self.said = True
            _progress.info(
                "compiling inner loops that this installation has not used yet: up to half a minute"
            )

    def on_end(self, event: event.Event) -> None:
        """Do nothing; numba calls it."""


_compiling = _Compiling()
event.register("numba:compile", _compiling)


def inlined(function: _Function) -> _Function:
    """Compile a function as a part of the kernels that call it, from this or another file."""
    compiled: _Function = numba.njit(**_OPTIONS, **_NOT_FROM_PYTHON)(function)
    return compiled


def _imported_code(function: Callable[..., Any]) -> str:
    """Return a digest of the source files of inlined functions, "" if all are in the same file."""
    # Numba's cache detects changes of the function's own file only.
    files = {
        value.__code__.co_filename
        for value in function.__globals__.values()
        if isinstance(value, Dispatcher)
    }
    other_files = sorted(files - {function.__code__.co_filename})
    code = b"".join(Path(file).read_bytes() for file in other_files)
    return hashlib.sha256(code).hexdigest()[:12] if other_files else ""


@cache
def _is_open(folder: Path) -> bool:
    """Return True, and warn, if other users can write to the folder or to its parent."""
    open_folder = next(
        (place for place in (folder, folder.parent) if others_can_write(place)), None
    )
    if open_folder is not None:
        _log.warning(
            "%s: others can write to it; compiled code is not kept there: chmod 700 it, or name "
            "another folder by NUMBA_CACHE_DIR",
            open_folder,
        )
    return open_folder is not None


class _DiskCache(FunctionCache):
    """Numba's cache of one function on disk. If it fails, the function is compiled in every run."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for these types, None if none can be loaded."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged file: unpickling can raise anything
            _log.debug("%s: compiled code cannot be loaded: %s", self.cache_path, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the compiled function for these types, if possible."""
        try:
            super().save_overload(sig, data)
        except Exception as error:  # a full disk, a damaged index
            _log.debug("%s: compiled code cannot be kept: %s", self.cache_path, error)


class Kernel:
    """A function compiled by numba at the first call with new types, and cached for later runs.

    The cache is beside the source file, in the user's cache directory, or in NUMBA_CACHE_DIR. It is
    loaded as code, and therefore ignored if users who cannot change the source could have written
    it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.__doc__ = function.__doc__
        function.__qualname__ += _imported_code(function)  # part of the name of the cache file
        self._compiled = numba.njit(function, **_OPTIONS)
        try:
            cache = _DiskCache(function)
        except RuntimeError as error:  # no place for a cache
            _log.debug("%s is compiled without a cache: %s", function.__name__, error)
            return
        folder = Path(cache.cache_path)
        is_beside_source = folder.parent == Path(function.__code__.co_filename).parent
        if is_beside_source or not _is_open(folder):
            self._compiled._cache = cache  # type: ignore[attr-defined]

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function."""
        return self._compiled(*arguments)

    def over_rows(self, num_rows: int, *arguments: Any) -> None:
        """Call ``kernel(begin, end, *arguments)`` on all cores, for ranges that cover all rows.

        The kernel must not call `over_rows`. The result for a row must depend on that row alone.
        """
        num_parts = min(num_threads(), num_rows // _LEAST_ROWS)
        if num_parts <= 1:
            self(0, num_rows, *arguments)
            return
        ranges = list(pairwise(num_rows * i // num_parts for i in range(num_parts + 1)))
        futures = [_pool().submit(self, begin, end, *arguments) for begin, end in ranges[1:]]
        try:
            self(*ranges[0], *arguments)
        finally:
            wait(futures)  # before any error is raised: they write into the caller's arrays
            for future in futures:
                future.result()


def num_threads() -> int:
    """Return the number of cores this process may use, or NUMBA_NUM_THREADS if that is smaller."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the threads that share the rows of kernels."""
    return ThreadPoolExecutor(num_threads(), "densify-kernel")


if hasattr(os, "register_at_fork"):  # a forked process has the pool but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
