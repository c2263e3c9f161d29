# SPDX-License-Identifier: MIT
"""What was made once is kept on disk, found again by all that it was made from.

Entries are written aside and renamed, so that several processes can share the folder; one that is
damaged or foreign is made anew; a folder that cannot be written, or a full disk, only costs time.
Entries hold arrays and plain numbers (`config.cache_codec`), and lie where nobody else can put
any (`config.user_folder`). The cache can be deleted at any time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from densify import __version__
from densify.config.cache_codec import MOST_BYTES, DamagedError, decode, encode
from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.config.user_folder import own_folder

T = TypeVar("T")
_log = logging.getLogger("densify")

_ENTRY, _ASIDE = ".entry", ".tmp"
_LEFT_S = 3600.0  # what is aside for longer was left by a killed process


def steps_folder() -> Path:
    """Where a `Cache` keeps its entries. Raises InputError if others can write to it."""
    return own_folder("steps")


class Cache:
    """limit_bytes: when it holds more, what was used longest ago is removed (`trim`)."""

    def __init__(self, limit_bytes: int, folder: Path | None = None) -> None:
        """folder: None for the user's. Raises InputError if others can write to that."""
        self._folder = folder or steps_folder()
        self._limit_bytes = limit_bytes
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            _log.warning("%s: %s; nothing is kept for later", self._folder, error.strerror or error)

    def get(self, stage: str, kind: type[T], inputs: Any, make: Callable[[], T]) -> T:
        """What ``make`` returns, made now or at any earlier time.

        kind: its type, by which it is read again, such as ``dict[int, Registration]``; see
        `config.cache_codec`. inputs: everything that the outcome depends on beside the package's
        own code; see `digest`.
        """
        path = self._folder / f"{stage}-{digest((code(), inputs))}{_ENTRY}"
        try:
            value: T = decode(self._read(path), kind)
            return value
        except (InputError, DamagedError) as error:
            _log.debug("%s: made anew: %s", path, error)
        value = make()
        try:
            _write(path, encode(value, kind))
        except (OSError, TypeError, ValueError) as error:
            _log.debug("%s: not kept: %s", path, error)
        return value

    def trim(self) -> None:
        """Keep the bound. Other processes may go on reading and writing meanwhile."""
        found = []
        with suppress(OSError):
            for entry in os.scandir(self._folder):
                with suppress(OSError):  # another process was first
                    status = entry.stat(follow_symlinks=False)
                    if entry.name.endswith(_ENTRY):
                        found.append((status.st_mtime_ns, status.st_size, entry.path))
                    elif entry.name.endswith(_ASIDE) and status.st_mtime < time.time() - _LEFT_S:
                        os.unlink(entry.path)
        left = sum(num_bytes for _, num_bytes, _ in found)
        for _, num_bytes, path in sorted(found):
            if left <= self._limit_bytes:
                return
            with suppress(OSError):
                os.unlink(path)
            left -= num_bytes

    def _read(self, path: Path) -> bytes:
        data = read_bytes(path, MOST_BYTES)
        with suppress(OSError):
            os.utime(path)  # it was used
        return data


def kept(
    cache: Cache | None, stage: str, kind: type[T], inputs: Callable[[], Any], make: Callable[[], T]
) -> T:
    """What ``make`` returns, now or when it was made of the same inputs before."""
    return make() if cache is None else cache.get(stage, kind, inputs(), make)


def _write(path: Path, data: bytes) -> None:
    """Complete or not at all."""
    number, aside = tempfile.mkstemp(_ASIDE, dir=path.parent)
    try:
        with open(number, "wb") as file:
            file.write(data)
        os.replace(aside, path)
    except BaseException:
        os.unlink(aside)
        raise


def digest(value: Any) -> str:
    """Digest of anything made of arrays, numbers, text, dataclasses, sequences and mappings."""
    state = hashlib.blake2b(digest_size=20)
    _feed(state, value)
    return state.hexdigest()


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


@cache
def code() -> str:
    """Digest of this package's code: another version may make something else of the same inputs."""
    package = Path(__file__).parents[1]
    sources = sorted(package.rglob("*.py"))
    texts = [(str(path.relative_to(package)), path.read_text("utf-8")) for path in sources]
    return digest([__version__, texts])
