# SPDX-License-Identifier: MIT
"""Name folders of results, and write files and folders that appear only when complete."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from densify.config.errors import InputError, OutputError
from densify.config.file_content import read_json, read_yaml
from densify.readers import Spec
from densify.readers.decoded_files import read_arrays

RESULTS = Path("densify-out")
"""The folder of all results for which the user names no folder."""

Split = Literal["train", "val"]

_VALIDATION = {
    *(f"2011_09_26_drive_{n:04d}" for n in (2, 5, 13, 20, 23, 36, 79, 95, 113)),
    *("2011_09_28_drive_0037", "2011_09_29_drive_0026", "2011_09_30_drive_0016"),
    "2011_10_03_drive_0047",
}
_KITTI_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d_drive_\d{4})(?:_sync|_extract)?", re.ASCII)
_DEFAULT_STREET = "street:street?seed=0&sensor=hdl64"
_PUNCTUATION = str.maketrans({":": "-", "?": "_", "=": "-", "&": "_"})
_FOLDER_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_MOST_READABLE = 80  # letters of a name that a hash makes unique


_Stored = tuple[Path, str, str]
"""File that names the recording of a result, the recording's name, and its text of ``--data``."""


def split_of(recording: str) -> Split:
    """Return "val" for the 13 validation drives of KITTI's depth benchmark, else "train"."""
    match = _KITTI_DRIVE.fullmatch(recording)
    return "val" if match and match[1] in _VALIDATION else "train"


def drive_folder(recording: str) -> str:
    """Return a folder name for a recording's name, different for different recordings."""
    # street:highway?seed=0&sensor=hdl64 -> street-highway_seed-0_sensor-hdl64
    if recording == _DEFAULT_STREET:
        return "street"
    folder = recording.translate(_PUNCTUATION)
    if _FOLDER_NAME.fullmatch(folder):
        return folder
    readable = re.sub(r"[^A-Za-z0-9_.]+", "-", folder)[:_MOST_READABLE].strip(".-") or "drive"
    return f"{readable}-{hashlib.sha256(recording.encode()).hexdigest()[:8]}"


def default_folder(recording: str) -> Path:
    """Return the folder for the results of a recording, by its name."""
    return RESULTS / drive_folder(recording)


def check_recording(out: Path, recording: str, data: str, keys: Iterable[int] = ()) -> None:
    """Raise InputError if results in ``out`` are of another recording.

    The first and the last key, the ``keys`` to be written, and the first file of flow are tested.
    ``data`` is the recording's text of ``--data``.
    """
    for result in _stored_results(out, keys):
        if not any(is_same(recording, data, *stored) for _, *stored in result):
            path, stored_recording, stored_data = result[0]
            source = f" ({stored_data})" if stored_data else ""
            raise InputError(
                f"--out {out}: {path.relative_to(out)} is of another recording, "
                f"{stored_recording}{source}; got {recording} ({data}); choose another --out DIR"
            )


def is_same(recording: str, data: str, stored_recording: str, stored_data: str) -> bool:
    """Return True if two pairs of name and ``--data`` mean one recording, which may have moved."""
    if drive_folder(recording) != drive_folder(stored_recording):
        return False
    path, stored_path = (Spec.parse(text).path.resolve() for text in (data, stored_data))
    if not (data and stored_data and path.exists() and stored_path.exists()):
        return True
    # A file in the recording is the same recording.
    return path.is_relative_to(stored_path) or stored_path.is_relative_to(path)


def _stored_results(out: Path, keys: Iterable[int]) -> Iterator[list[_Stored]]:
    """Yield the recordings of each result in a folder: a training set, keys, files of flow."""
    path = out / "dataset.json"
    if drives := mapping_or_empty(_content(path).get("drives")):
        yield [
            (path, name, str(mapping_or_empty(drive).get("data") or ""))
            for name, drive in drives.items()
        ]
    folders = sorted(path for path in out.glob("[0-9]*") if path.is_dir())
    # The first key, the last one, and those to be written
    for folder in sorted({*folders[:1], *folders[-1:], *(out / f"{key:06d}" for key in keys)}):
        for path in (folder / "run.yaml", folder / "compare.json"):
            if name := (table := _content(path)).get("recording"):
                yield [(path, str(name), str(table.get("data") or ""))]
    for path in sorted(out.glob("[0-9]*_[0-9]*.npz"))[:1]:
        with suppress(InputError):
            if "recording" in (arrays := read_arrays(path, ("recording",))):
                yield [(path, str(arrays["recording"]), "")]


def _content(path: Path) -> Mapping[str, Any]:
    """Return the mapping in a YAML or JSON file, or {} for a missing or damaged file."""
    with suppress(InputError):
        if path.is_file():
            return mapping_or_empty(
                read_yaml(path)[0] if path.suffix == ".yaml" else read_json(path)
            )
    return {}


def mapping_or_empty(value: Any) -> Mapping[str, Any]:
    """Return a value that is a mapping, or {} for another value."""
    return value if isinstance(value, Mapping) else {}


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


@contextmanager
def writing(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield the `staged_folder` for the entries ``owned``, after the checks of `check_folder`."""
    check_folder(folder, owned, out, overwrite)
    with staged_folder(folder, owned) as staging:
        yield staging


def check_folder(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> None:
    """Raise InputError unless the entries ``owned`` can be written into a folder below ``out``."""
    existing = folder
    while not os.path.lexists(existing):
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(
            f"--out {out}: {existing} is not a folder; choose another one with --out DIR"
        )
    # An existing folder is renamed, and a new folder beside it takes its place.
    parents = [Path(os.path.realpath(existing)).parent] if existing == folder else []
    for touched in (existing, *parents):
        if not os.access(touched, os.W_OK | os.X_OK):
            raise InputError(
                f"--out {out}: no permission to write in {touched}; choose another one with --out"
            )
    present = [name for name in owned if (folder / name).exists()]
    if present and not overwrite:
        raise InputError(
            f"{folder}: {', '.join(present)} already there and kept; "
            f"give --overwrite to replace them or another --out DIR"
        )
