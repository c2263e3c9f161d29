# SPDX-License-Identifier: MIT
"""Cache results of pipeline steps on disk, addressed by a digest of all their inputs."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import platformdirs

from densify.config.errors import InputError
from densify.version import __version__

T = TypeVar("T")
_log = logging.getLogger("densify")
_STEP_ROOMS = (
    "readers/**/*.py",
    "registration/*.py",
    "free_space/*.py",
    "flow/**/*.py",
    "flow/**/*.json",
    "geometry/**/*.py",
    "pipeline/*.py",
    "depth/far.py",
)
_MOST_ENTRIES = 10_000


class Cache:
    """A folder of cached results of pipeline steps, each in a ``.npz`` file."""

    def __init__(self, limit_bytes: int = 10 * 1024**3, folder: Path | None = None) -> None:
        """Open a folder of entries. If it cannot be made, warn, and keep no results.

        `trim` reduces the folder to ``limit_bytes``. None takes ``steps`` in the user's cache
        folder.
        """
        self._folder = folder or own_folder("steps")
        self._limit_bytes = limit_bytes
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            _log.warning("%s: %s; nothing is kept for later", self._folder, error.strerror or error)

    def get(self, step: str, inputs: Any, make: Callable[[], T]) -> T:
        """Return the cached result of a step, or make and keep it.

        A result that cannot be stored is returned all the same.

        Args:
            step: Name of the step, with which the entry's file name begins.
            inputs: All that the result depends on, of types that `digest` accepts.
            make: Function that makes the result. If files can be locked, one process calls it.
        """
        path = self._folder / f"{step}-{digest((__version__, inputs))}.npz"
        if (entry := _read(path)) is not None:
            return cast(T, entry[0])
        with _only_maker(path):
            if (entry := _read(path)) is not None:  # another thread or process made it
                return cast(T, entry[0])
            value = make()
            try:
                text, arrays = _packed(value)
                _save_arrays(path, {"json": np.frombuffer(text, np.uint8), **arrays})
            except (OSError, TypeError) as error:
                _log.debug("%s: not kept: %s", path, error)
            return value

    def trim(self) -> None:
        """Delete the least recently used entries beyond ``limit_bytes`` or 10,000 files."""
        entries: list[tuple[int, Path, int]] = []
        if not self._folder.is_dir():
            return
        for path in self._folder.iterdir():
            with suppress(OSError):  # another process deletes too
                status = path.stat()
                entries.append((status.st_mtime_ns, path, status.st_size))
        bytes_left = sum(num_bytes for *_, num_bytes in entries)
        for num_passed, (_, path, num_bytes) in enumerate(sorted(entries)):
            if bytes_left > self._limit_bytes or len(entries) - num_passed > _MOST_ENTRIES:
                with suppress(OSError):
                    path.unlink()
                bytes_left -= num_bytes


def _read(path: Path) -> tuple[Any] | None:
    """Return the value of an entry, None if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            value = _unpacked(json.loads(arrays["json"].tobytes()), arrays)
        os.utime(path)  # the entry was used
        return (value,)
    except FileNotFoundError:
        return None
    except Exception as error:  # a damaged file raises anything
        _log.debug("%s: made again: %s", path, error)
        return None


@contextmanager
def _only_maker(path: Path) -> Iterator[None]:
    """Hold a lock file, so that one thread or process at a time makes the entry."""
    lock, number = path.with_suffix(".lock"), None
    with suppress(OSError):  # where nothing can be written or locked, each makes its own
        number = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
        fcntl.flock(number, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if number is not None:
            with suppress(OSError):
                lock.unlink()
            with suppress(OSError):  # a forked process has the file open, too
                fcntl.flock(number, fcntl.LOCK_UN)
            os.close(number)


@lru_cache(maxsize=1)
def code_digest() -> str:
    """Return the hexadecimal hash of the source files that make the pipeline's cached results."""
    state = hashlib.blake2b(digest_size=20)
    package = Path(__file__).parents[1]
    for path in sorted(path for room in _STEP_ROOMS for path in package.glob(room)):
        state.update(path.read_bytes())
    return state.hexdigest()


def get_cached(
    cache: Cache | None, step: str, inputs: Callable[[], Any], make: Callable[[], T]
) -> T:
    """Return the cached result of a step, or make it. Without a cache ``make`` alone is called.

    ``inputs`` returns all that the result depends on, which can take long to collect.
    """
    return make() if cache is None else cache.get(step, inputs(), make)


def _save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an ``.npz`` file atomically, through a temporary file in the same folder."""
    number, aside = tempfile.mkstemp(".tmp", dir=path.parent)
    try:
        with open(number, "wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(aside, path)
    except BaseException:
        os.unlink(aside)
        raise


def digest(value: Any) -> str:
    """Return a hash of a value made of arrays, numbers, text, dataclasses, sequences, mappings."""
    text, arrays = _packed(value)
    state = hashlib.blake2b(text, digest_size=20)
    for array in arrays.values():
        state.update(f"{array.dtype} {array.shape} ".encode())
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()


def _packed(value: Any) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return the value as JSON, types it lacks as ``{KIND: content}``, and its arrays by name."""
    arrays: dict[str, np.ndarray] = {}

    def tree(value: Any) -> Any:
        kind = type(value)
        if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            arrays[name := str(len(arrays))] = np.asarray(value)
            return {"array" if isinstance(value, np.ndarray) else "scalar": name}
        if isinstance(value, Mapping):
            return {"mapping": [[tree(key), tree(item)] for key, item in value.items()]}
        if is_dataclass(value) or hasattr(value, "_fields"):
            names = getattr(value, "_fields", None) or [f.name for f in fields(value)]
            members = [tree(getattr(value, name)) for name in names]
            return {f"{kind.__module__}:{kind.__qualname__}": members}
        if isinstance(value, tuple):
            return {"tuple": [*map(tree, value)]}
        return [*map(tree, value)] if isinstance(value, list) else value

    return json.dumps(tree(value)).encode(), arrays


def _unpacked(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the value that `_packed` converted, with classes of imported modules alone."""
    if isinstance(tree, list):
        return [_unpacked(element, arrays) for element in tree]
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind in ("array", "scalar"):
        return arrays[content] if kind == "array" else arrays[content][()]
    elements = _unpacked(content, arrays)
    if kind in ("tuple", "mapping"):
        return tuple(elements) if kind == "tuple" else dict(elements)
    module, _, name = kind.partition(":")
    cls = getattr(sys.modules[module], name)
    if issubclass(cls, tuple):
        return tuple.__new__(cls, elements)
    value = object.__new__(cls)
    value.__dict__.update(zip((f.name for f in fields(cls)), elements, strict=True))
    return value


def own_folder(name: str) -> Path:
    """Return the folder ``name`` in the user's cache folder, made if it does not exist.

    The cache folder is DENSIFY_CACHE_DIR, or else the system's usual one. Raise InputError if other
    users can write to either folder. A folder that cannot be made is no error here.
    """
    named = os.environ.get("DENSIFY_CACHE_DIR")
    root = Path(named or platformdirs.user_cache_dir("densify"))
    for folder in (root, root / name):
        with suppress(OSError):  # a writer reports the error
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if others_can_write(folder):
            raise InputError(
                f"cache {folder}: others can write to it, expected a folder of yours alone; "
                f"chmod 700 {folder}, or name another by DENSIFY_CACHE_DIR"
            )
    return root / name


def others_can_write(folder: Path) -> bool:
    """Return True if others than this user and root can write to a folder, False without it."""
    try:
        status = folder.stat()
    except OSError:
        return False
    is_owner_trusted = status.st_uid in (0, os.getuid())
    return not is_owner_trusted or bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
