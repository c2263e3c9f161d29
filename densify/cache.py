# SPDX-License-Identifier: MIT
"""What was made once is kept on disk, found again by all that it was made from. The one door to
joblib.

Entries are written aside and renamed, so that several processes can share the folder; one that is
damaged is made anew; a folder that cannot be written, or a full disk, only costs time. The cache
lies in the user's cache directory, or in the folder named by the environment variable
DENSIFY_CACHE_DIR; it can be deleted at any time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs

from densify.version import __version__

T = TypeVar("T")
_log = logging.getLogger("densify")


class Cache:
    """limit_bytes: when it holds more, what was used longest ago is removed (`trim`)."""

    def __init__(self, limit_bytes: int, folder: Path | None = None) -> None:
        """folder: None for the user's."""
        from joblib import Memory

        root = os.environ.get("DENSIFY_CACHE_DIR") or platformdirs.user_cache_dir("densify")
        folder = folder or Path(root) / "dataset"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            place: Path | None = folder
        except OSError as error:
            _log.warning("%s: %s; nothing is kept for later", folder, error.strerror or error)
            place = None
        # Compressed entries carry a checksum: what a power failure left half-written is noticed.
        with _silent_joblib():
            self._memory = Memory(place, verbose=0, compress=1)
        self._made = self._memory.cache(_made, ignore=["make"])
        self._limit_bytes = limit_bytes

    def get(self, stage: str, inputs: Any, make: Callable[[], T]) -> T:
        """What ``make`` returns, made now or at any earlier time.

        inputs: everything that the outcome depends on beside the package's own code; see `digest`.
        """
        with _silent_joblib():
            made: T = self._made(stage, digest((code(), inputs)), make)
        return made

    def trim(self) -> None:
        """Keep the bound. Other processes may go on reading and writing meanwhile."""
        self._memory.reduce_size(bytes_limit=self._limit_bytes)


def digest(value: Any) -> str:
    """Digest of anything made of arrays, numbers, text, dataclasses, sequences and mappings."""
    state = hashlib.blake2b(digest_size=20)
    _feed(state, value)
    return state.hexdigest()


@contextmanager
def _silent_joblib() -> Iterator[None]:
    """It warns, in two ways, of entries that cannot be kept or read."""
    log = logging.getLogger("joblib")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


def _feed(state: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        state.update(f"array {value.dtype} {value.shape} ".encode())
        state.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value):
        _feed(state, [(f.name, getattr(value, f.name)) for f in fields(value)])
    elif isinstance(value, dict):
        _feed(state, sorted(value.items()))
    elif isinstance(value, tuple | list):
        state.update(f"{len(value)} of ".encode())
        for item in value:
            _feed(state, item)
    elif value is None or isinstance(value, str | int | float | bool):
        state.update(f"{type(value).__name__} {value!r} ".encode())
    else:
        raise TypeError(f"cannot be told from others: {type(value).__name__}")


def _made(stage: str, inputs: str, make: Callable[[], Any]) -> Any:
    return make()


@cache
def code() -> str:
    """Digest of this package's code: another version may make something else of the same inputs."""
    package = Path(__file__).parent
    sources = sorted(package.rglob("*.py"))
    texts = [(str(path.relative_to(package)), path.read_text("utf-8")) for path in sources]
    return digest([__version__, texts])
