# SPDX-License-Identifier: MIT
"""Cache results of pipeline steps on disk, addressed by a digest of all their inputs.

An entry is an ``.npz`` file without pickles: the arrays, and everything else as JSON. A damaged
entry is computed again. Only the user can write to the folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs

from densify import __version__
from densify.config.errors import InputError

T = TypeVar("T")
_log = logging.getLogger("densify")
# Raise a step's number when its result for the same inputs changes. Steps build on each other,
# and an entry depends on all of them.
_STEP_VERSIONS = "digests 1, registration 2, motion 12, far 5"
_MOST_ENTRIES = 10_000


class Cache:
    """A folder of cached results."""

    def __init__(self, limit_bytes: int = 10 * 1024**3, folder: Path | None = None) -> None:
        """Open a cache.

        Args:
            limit_bytes: Greatest total size, enforced by `trim`.
            folder: Folder of the entries; None for the user's cache directory.

        Raises:
            InputError: Other users can write to the folder.
        """
        self._folder, self._limit_bytes = folder or own_folder("steps"), limit_bytes
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            _log.warning("%s: %s; nothing is kept for later", self._folder, error.strerror or error)

    def get(self, step: str, inputs: Any, make: Callable[[], T]) -> T:
        """Return the cached result for these inputs, or else compute and cache it.

        Args:
            step: Name of the pipeline step.
            inputs: Everything the result depends on, as `digest` accepts.
            make: Computes the result.
        """
        path = self._folder / f"{step}-{digest((__version__, _STEP_VERSIONS, inputs))}.npz"
        try:
            with np.load(path, allow_pickle=False) as arrays:
                value: T = _unpacked(json.loads(arrays["json"].tobytes()), arrays)
            os.utime(path)  # the entry was used
            return value
        except FileNotFoundError:
            pass
        except Exception as error:  # a damaged file raises anything
            _log.debug("%s: made again: %s", path, error)
        value = make()
        try:
            text, arrays = _packed(value)
            save_arrays(path, {"json": np.frombuffer(text, np.uint8), **arrays})
        except (OSError, TypeError) as error:
            _log.debug("%s: not kept: %s", path, error)
        return value

    def trim(self) -> None:
        """Delete the least recently used entries until the size is within the limit."""
        with suppress(OSError):  # another process deletes too
            entries = [(e.stat().st_mtime_ns, e, e.stat().st_size) for e in self._folder.iterdir()]
            left = sum(num_bytes for *_, num_bytes in entries)
            for number, (_, entry, num_bytes) in enumerate(sorted(entries)):
                if left > self._limit_bytes or len(entries) - number > _MOST_ENTRIES:
                    entry.unlink()
                    left -= num_bytes


def kept(cache: Cache | None, step: str, inputs: Callable[[], Any], make: Callable[[], T]) -> T:
    """Return the result from the cache if one is given, else from ``make``; see `Cache.get`."""
    return make() if cache is None else cache.get(step, inputs(), make)


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
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
    """Return a hash of arrays, numbers, text, dataclasses, sequences and mappings."""
    text, arrays = _packed(value)
    state = hashlib.blake2b(text, digest_size=20)
    for array in arrays.values():
        state.update(f"{array.dtype} {array.shape} ".encode())
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()


def _packed(value: Any) -> tuple[bytes, dict[str, np.ndarray]]:
    """Return the value as JSON, and its arrays by the names used there.

    Types that JSON lacks are written as ``{KIND: content}``. Raises TypeError for other types.
    """
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
            parts = [tree(getattr(value, name)) for name in names]
            return {f"{kind.__module__}:{kind.__qualname__}": parts}
        if isinstance(value, tuple):
            return {"tuple": [*map(tree, value)]}
        return [*map(tree, value)] if isinstance(value, list) else value

    return json.dumps(tree(value)).encode(), arrays


def _unpacked(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the value that `_packed` converted.

    Only dataclasses and named tuples of already imported modules are built, without calling their
    code.
    """
    if isinstance(tree, list):
        return [_unpacked(part, arrays) for part in tree]
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind in ("array", "scalar"):
        return arrays[content] if kind == "array" else arrays[content][()]
    parts = _unpacked(content, arrays)
    if kind in ("tuple", "mapping"):
        return tuple(parts) if kind == "tuple" else dict(parts)
    module, _, name = kind.partition(":")
    made = getattr(sys.modules[module], name)
    if issubclass(made, tuple):
        return tuple.__new__(made, parts)
    value = object.__new__(made)
    value.__dict__.update(zip((f.name for f in fields(made)), parts, strict=True))
    return value


def own_folder(name: str) -> Path:
    """Return the folder of this name in the user's cache directory.

    The environment variable DENSIFY_CACHE_DIR replaces that directory. The folder is created with
    mode 0700 if possible.

    Raises:
        InputError: Other users can write to the folder.
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
    """Return True if users other than this user and root can write to an existing folder."""
    try:
        found = folder.stat()
    except OSError:
        return False
    mine = found.st_uid in (0, os.getuid())
    return not mine or bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
