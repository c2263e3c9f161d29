# SPDX-License-Identifier: MIT
"""Opening recordings. A new data set is one more module here and one more row in READERS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from densify.errors import InputError
from densify.types import LidarSequence


def _open_kitti_raw(folder: Path) -> LidarSequence:
    from densify.readers.kitti_raw import KittiRaw

    return KittiRaw(folder)


class Reader(NamedTuple):
    """How the recordings of one data set are opened, and told from those of others.

    holds: what a folder of it has inside, for messages. recognises: whether a folder is one.
    """

    open: Callable[[Path], LidarSequence]
    recognises: Callable[[Path], bool]
    holds: str


READERS: dict[str, Reader] = {
    "kitti": Reader(
        _open_kitti_raw,
        lambda folder: (folder / "velodyne_points").is_dir(),
        "a KITTI raw drive (a folder that holds velodyne_points/)",
    ),
}


class Spec(NamedTuple):
    """What ``--data`` names.

    reader: a row of `READERS`, "street" for the built-in one, None where the place tells. place: a
    path; of the street, preset and options. scene: what follows ``#``, None for no scene.
    """

    reader: str | None
    place: str
    scene: str | None = None

    @staticmethod
    def parse(text: str | Path) -> Spec:
        """``street[:PRESET][?...]``, ``READER:PATH[#SCENE]``, or else a path.

        A path that exists as it stands, ``#`` included, has no scene.
        """
        text = str(text)
        if text == "street" or text.startswith(("street:", "street?")):
            return Spec("street", text)
        name, colon, place = text.partition(":")
        if not (colon and name in READERS):
            return Spec(None, text)
        path, mark, scene = place.rpartition("#")
        if not mark or Path(place).expanduser().exists():
            return Spec(name, place)
        return Spec(name, path, scene)

    @property
    def path(self) -> Path:
        """The place; a leading ``~`` is expanded, as shells do not behind a colon."""
        return Path(self.place).expanduser()

    def absolute(self) -> str:
        """The same recording, whatever the working directory of the process that opens it."""
        if self.reader == "street":
            return self.place
        reader = "" if self.reader is None else f"{self.reader}:"
        scene = "" if self.scene is None else f"#{self.scene}"
        return f"{reader}{self.path.absolute()}{scene}"


def open_sequence(spec: str | Path = "street") -> LidarSequence:
    """Open a recording.

    spec: ``READER:PATH``, or a path whose reader is guessed from what lies there, or the built-in
    ``street[:PRESET][?seed=N&sensor=NAME]``.

    Raises InputError if there is nothing there or no reader knows it.
    """
    parsed = Spec.parse(spec)
    if parsed.reader == "street":
        from densify.readers.street import Street

        return Street.from_spec(parsed.place)
    if parsed.scene is not None:
        raise InputError(
            f"--data {spec}: {parsed.reader} recordings have no scenes; leave #{parsed.scene} out"
        )
    folder = parsed.path
    if parsed.reader is not None:
        return READERS[parsed.reader].open(folder)
    if not folder.exists():
        raise InputError(
            f"--data {spec}: no such folder; expected a recording's folder, READER:PATH with "
            f"READER one of {', '.join(READERS)}, or street[:PRESET]"
        )
    for reader in READERS.values():
        if reader.recognises(folder):
            return reader.open(folder)
    known = " or ".join(reader.holds for reader in READERS.values())
    raise InputError(f"--data {spec}: no known recording there; expected {known}")
