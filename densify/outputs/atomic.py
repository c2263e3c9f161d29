# SPDX-License-Identifier: MIT
"""Write files and folders that appear only when they are complete. Failures raise OutputError."""

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

LEFT_AFTER_S = 600.0  # age of leftovers, longer than the writing of any file
_MOST_LETTERS = 100  # letters of a name; with random letters it stays below the system's limit, 255


def write_file(path: Path, data: bytes) -> None:
    """Write or replace a file. On any failure the old file stays, and no other file is left."""
    with file_aside(path) as aside:
        aside.write_bytes(data)


@contextmanager
def file_aside(path: Path) -> Iterator[Path]:
    """Yield a temporary path that is renamed to ``path`` if the block ends without an error."""
    with _hidden_folder(path) as hidden:
        yield hidden / path.name
        os.replace(hidden / path.name, path)


@contextmanager
def staged_folder(folder: Path, owned: Collection[str]) -> Iterator[Path]:
    """Yield a folder to write into, which becomes ``folder`` if the block ends without an error.

    ``owned`` names the entries of ``folder`` that are replaced or removed. An error changes
    nothing.
    """
    folder = Path(os.path.realpath(folder))
    missing_parents = [parent for parent in folder.parents if not parent.exists()]

    def skip(copied: str, names: list[str]) -> Collection[str]:
        return owned if Path(copied) == folder else ()

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
        for parent in missing_parents:  # from the deepest folder up
            with suppress(OSError):  # another process may have written into the folder
                parent.rmdir()
        raise


def clear_leftovers(root: Path, age_s: float = LEFT_AFTER_S) -> None:
    """Remove hidden folders under ``root`` that killed processes left ``age_s`` or more ago."""
    # Another process may still write in folders younger than ``age_s`` seconds.
    for folder, names, _ in os.walk(root):  # skips entries that other processes remove meanwhile
        for name in names:
            hidden = Path(folder, name)
            with suppress(OSError):
                if hidden.match(".*.tmp") and time.time() - hidden.stat().st_mtime >= age_s:
                    shutil.rmtree(hidden)


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``, on the same disk, and remove it afterwards."""
    prefix = f".{path.name[:_MOST_LETTERS]}."
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            ".tmp", prefix, path.parent, ignore_cleanup_errors=True
        ) as folder:
            yield Path(folder)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a mapping as indented JSON, after its conversion by `plain`."""
    write_file(path, (json.dumps(plain(value), indent=2, allow_nan=False) + "\n").encode())


def plain(value: Any) -> Any:
    """Return a value in the types of JSON and YAML: arrays become lists, NaN and infinity None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
