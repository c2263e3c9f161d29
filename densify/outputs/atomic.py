# SPDX-License-Identifier: MIT
"""Write files and folders that appear when they are complete.

They are written in a hidden folder, then renamed. Missing folders above them are made. A failure to
write is an OutputError that names the place.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import OutputError

LEFT_AFTER_S = 600.0  # no file takes as long to write


def write_file(path: Path, data: bytes) -> None:
    """Write or replace a file. On any failure the old file stays, and nothing else is left."""
    with file_aside(path) as aside:
        aside.write_bytes(data)


@contextmanager
def file_aside(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which becomes ``path`` if the block ends without an error."""
    with _hidden_folder(path) as hidden:
        yield hidden / path.name
        os.replace(hidden / path.name, path)


@contextmanager
def staged_folder(folder: Path, owned: Collection[str]) -> Iterator[Path]:
    """Yield a folder to write into, which becomes ``folder`` if the block ends without an error.

    On any exception ``folder`` and the folders above it are as they were before.

    Args:
        owned: Entries of the writer, which are replaced or removed if ``folder`` exists. Others
            are kept.
    """
    folder = Path(os.path.realpath(folder))
    missing = [place for place in folder.parents if not place.exists()]

    def skip(place: str, names: list[str]) -> Collection[str]:
        return owned if Path(place) == folder else ()

    try:
        with _hidden_folder(folder) as hidden:
            staging = hidden / "new"
            staging.mkdir()
            yield staging
            if folder.exists():
                shutil.copytree(folder, staging, symlinks=True, ignore=skip, dirs_exist_ok=True)
                os.rename(folder, hidden / "old")
            try:
                os.rename(staging, folder)
            except BaseException:
                if (hidden / "old").exists():
                    os.rename(hidden / "old", folder)
                raise
    except BaseException:
        for place in missing:  # from the deepest up
            with suppress(OSError):  # others wrote into it meanwhile
                place.rmdir()
        raise


def clear_leftovers(root: Path, age_s: float = LEFT_AFTER_S) -> None:
    """Remove the hidden folders that killed processes left anywhere under ``root``.

    A folder younger than ``age_s`` seconds stays, because another process may be writing there.
    """
    for folder, names, _ in os.walk(root):  # skips files that others remove meanwhile
        for name in names:
            hidden = Path(folder, name)
            with suppress(OSError):
                if hidden.match(".*.tmp") and time.time() - hidden.stat().st_mtime >= age_s:
                    shutil.rmtree(hidden)


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    prefix = f".{path.name[:100]}."
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            ".tmp", prefix, path.parent, ignore_cleanup_errors=True
        ) as place:
            yield Path(place)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write `plain` of a mapping, indented."""
    write_file(path, (json.dumps(plain(value), indent=2, allow_nan=False) + "\n").encode())


def plain(value: Any) -> Any:
    """Return a value as JSON and YAML can write it.

    Numpy's numbers become Python's, tuples lists, and numbers that are not finite None.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
