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


def open_sequence(spec: str | Path = "street") -> LidarSequence:
    """Open a recording.

    spec: ``READER:PATH``, or a path whose reader is guessed from what lies there, or the built-in
    ``street[:PRESET][?seed=N&sensor=NAME]``.

    Raises InputError if there is nothing there or no reader knows it.
    """
    text = str(spec)
    if text == "street" or text.startswith(("street:", "street?")):
        from densify.readers.street import Street

        return Street.from_spec(text)
    name, colon, path = text.partition(":")
    if colon and name in READERS:
        return READERS[name].open(Path(path))
    folder = Path(text)
    if not folder.exists():
        raise InputError(
            f"--data {text}: no such folder; expected a recording's folder, READER:PATH with "
            f"READER one of {', '.join(READERS)}, or street[:PRESET]"
        )
    for reader in READERS.values():
        if reader.recognises(folder):
            return reader.open(folder)
    known = " or ".join(reader.holds for reader in READERS.values())
    raise InputError(f"--data {text}: no known recording there; expected {known}")
