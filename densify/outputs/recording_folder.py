# SPDX-License-Identifier: MIT
"""Keep the results of different recordings in different folders."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from densify.config.errors import InputError
from densify.config.file_content import read_json, read_yaml
from densify.outputs.kitti_tree import drive_folder
from densify.readers import Spec
from densify.readers.decoded_files import read_arrays

RESULTS = Path("densify-out")
"""The folder of all results for which the user names no folder."""


class Stored(NamedTuple):
    """The recording of a result, as its file says."""

    file: Path  # file that names the recording
    recording: str  # name of the recording
    data: str  # text of ``--data``, "" if the file lacks it


def default_folder(recording: str) -> Path:
    """Return the folder for the results of a recording, by its name."""
    return RESULTS / drive_folder(recording)


def check_recording(out: Path, recording: str, data: str, keys: Iterable[int] = ()) -> None:
    """Raise InputError if a folder holds results of another recording, by `is_same`.

    Results without the name of a recording are not compared. ``recording`` and ``data`` (text of
    ``--data``) are of the results to be written, for the frame numbers ``keys``.
    """
    for stored_here in _stored_in(out, keys):
        if not any(is_same(recording, data, s.recording, s.data) for s in stored_here):
            stored = stored_here[0]
            source = f" ({stored.data})" if stored.data else ""
            raise InputError(
                f"--out {out}: {stored.file.relative_to(out)} is of another recording, "
                f"{stored.recording}{source}; got {recording} ({data}); choose another --out DIR"
            )


def is_same(recording: str, data: str, other: str, other_data: str) -> bool:
    """Return True if two names and texts of ``--data`` are of one recording, moved or not."""
    if drive_folder(recording) != drive_folder(other):
        return False
    path, other_path = (Spec.parse(text).path.resolve() for text in (data, other_data))
    if not (data and other_data and path.exists() and other_path.exists()):
        return True
    # A file in the recording is the same recording.
    return path.is_relative_to(other_path) or other_path.is_relative_to(path)


def _stored_in(out: Path, keys: Iterable[int]) -> Iterator[list[Stored]]:
    """Yield the recordings of the results in a folder: a training set, keys, files of flow."""
    drives = _mapping(out / "dataset.json").get("drives")
    if isinstance(drives, Mapping) and drives:
        yield [_stored(out / "dataset.json", name, drive) for name, drive in drives.items()]
    folders = sorted(path for path in out.glob("[0-9]*") if path.is_dir())
    # The first key, the last one, and those to be written
    for folder in sorted({*folders[:1], *folders[-1:], *(out / f"{key:06d}" for key in keys)}):
        for path in (folder / "run.yaml", folder / "compare.json"):
            if name := (table := _mapping(path)).get("recording"):
                yield [_stored(path, name, table)]
    for path in sorted(out.glob("[0-9]*_[0-9]*.npz"))[:1]:
        with suppress(InputError):
            if "recording" in (arrays := read_arrays(path, ("recording",))):
                yield [Stored(path, str(arrays["recording"]), "")]


def _stored(path: Path, name: Any, table: Any) -> Stored:
    data = table.get("data") if isinstance(table, Mapping) else None
    return Stored(path, str(name), str(data or ""))


def _mapping(path: Path) -> Mapping[str, Any]:
    """Return the content of a YAML or JSON file, {} if it is missing or damaged."""
    content: Any = None
    with suppress(InputError):
        if path.is_file():
            content = read_yaml(path)[0] if path.suffix == ".yaml" else read_json(path)
    return content if isinstance(content, Mapping) else {}
