# SPDX-License-Identifier: MIT
"""Open recordings. `densify.config.plugins` has the table of readers."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, cast

from densify.config.errors import InputError, did_you_mean
from densify.config.plugins import READERS, Plugin
from densify.geometry.types import LidarSequence
from densify.readers.checks import drive_around
from densify.readers.file_sequence import FileSequence

_MOST_PLACES = 200  # files and folders searched inside a folder that is no recording


class ReaderModule(Protocol):
    """Interface of a reader's module."""

    def open_recording(self, path: Path, scene: str | None) -> LidarSequence:
        """Open a recording; ``scene`` is the text after ``#`` in ``--data``, None without it."""
        ...


class Spec(NamedTuple):
    """A recording as ``--data`` names it."""

    # Name in `READERS`; "street" for the simulated recording; None to recognise the files
    reader: str | None
    place: str  # path as typed by the user; for the street, the whole text with its options
    scene: str | None = None  # scene name or reader's option after ``#``

    @staticmethod
    def parse(text: str | Path) -> Spec:
        """Parse ``street[:PRESET][?...]`` or ``[READER:]PATH[#SCENE]``."""
        text = str(text)
        if text == "street" or text.startswith(("street:", "street?")):
            return Spec("street", text)
        name, colon, location = text.partition(":")
        reader = name if colon and name in READERS.names() else None
        location = text if reader is None else location
        # A # in the path of an existing file is part of the path. Without READER: it also is if no
        # file is named by the text before it.
        path, mark, scene = location.rpartition("#")
        if not mark or _exists(location) or (reader is None and not _exists(path)):
            return Spec(reader, location)
        return Spec(reader, path, scene)

    @property
    def path(self) -> Path:
        """Path with a leading ``~`` expanded, which shells do not do after ``READER:``."""
        return Path(self.place).expanduser()

    def absolute(self) -> str:
        """Return the text of the spec with an absolute path, valid in any working directory."""
        if self.reader == "street":
            return self.place
        reader = "" if self.reader is None else f"{self.reader}:"
        scene = "" if self.scene is None else f"#{self.scene}"
        return f"{reader}{self.path.absolute()}{scene}"


def _exists(location: str) -> bool:
    return os.path.exists(Path(location).expanduser())


def open_sequence(spec: str | Path = "street") -> LidarSequence:
    """Open a recording; sweeps and images are read later, on demand.

    ``spec`` is a path, ``READER:PATH[#SCENE]``, or ``street[:PRESET][?seed=N&sensor=NAME]`` for the
    built-in simulated street. Without ``READER:`` the reader is recognised by the files. The first
    image of each camera must fit its calibration.
    """
    parsed = Spec.parse(spec)
    if parsed.reader == "street":
        from densify.readers.street import Street

        return Street.from_spec(parsed.place)
    reader = _reader_of(parsed, f"--data {spec}")
    if parsed.scene is not None and not reader.scenes:
        raise InputError(
            f"--data {spec}: {reader.name} recordings have no scenes; leave #{parsed.scene} out"
        )
    module = cast(ReaderModule, reader.work())
    sequence = module.open_recording(parsed.path, parsed.scene)
    if isinstance(sequence, FileSequence):
        sequence.check_first_images()
    return sequence


def _reader_of(parsed: Spec, where: str) -> Plugin:
    """Return the named reader, or the first reader that recognises the path."""
    if parsed.reader is not None:
        return READERS.row(parsed.reader, where)
    if not parsed.path.exists():
        name, _, _ = parsed.place.partition(":")
        hint = did_you_mean(name, [*READERS.names(), "street"])
        raise InputError(
            f"{where}: no such folder; {hint}expected a recording's folder, READER:PATH with "
            f"READER one of {', '.join(READERS.names())}, or street[:PRESET]"
        )
    readers = list(READERS)
    for reader in readers:
        if reader.recognises(parsed.path):
            return reader
    inside = _recording_in(parsed.path, readers)
    if inside is not None:
        raise InputError(f"{where}: no recording itself; one in it is {inside}: name that")
    raise InputError(
        f"{where}: no recording: {_what_is_there(parsed.path)}; expected one of the readers "
        f"{', '.join(reader.name for reader in readers)} (densify info --help says what each reads)"
    )


def _what_is_there(path: Path) -> str:
    """Describe the contents of a path without a recording, as a clause for error messages."""
    if path.is_file():
        return f"it is a {path.suffix or 'file without a suffix'} file"
    counts = Counter(entry.suffix.lower() or "other" for entry in path.iterdir() if entry.is_file())
    contents = [f"{num} {suffix} file{'s' * (num > 1)}" for suffix, num in counts.most_common(3)]
    num_folders = sum(entry.is_dir() for entry in path.iterdir())
    contents += [f"{num_folders} folder{'s' * (num_folders > 1)}"] * bool(num_folders)
    text = f"it holds {', '.join(contents)}, no lidar sweeps" if contents else "it is empty"
    drive = drive_around(path)
    return text if drive is None else f"{text}, and is inside a KITTI drive: give {drive}"


def _recording_in(path: Path, readers: Sequence[Plugin]) -> Path | None:
    """Return the first recording in a folder, at most two levels down; None without one."""
    entries = [*path.glob("*"), *path.glob("*/*")][:_MOST_PLACES] if path.is_dir() else []
    entries = [entry for entry in sorted(entries) if entry.exists()]  # links may lead nowhere
    recordings = (entry for reader in readers for entry in entries if reader.recognises(entry))
    return next(recordings, None)
