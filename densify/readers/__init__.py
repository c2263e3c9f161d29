# SPDX-License-Identifier: MIT
"""Opening recordings. A new data set is one more module here and one more line in READERS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from densify.errors import InputError
from densify.types import LidarSequence


def _open_kitti_raw(path: str) -> LidarSequence:
    from densify.readers.kitti_raw import KittiRaw

    return KittiRaw(Path(path))


def _open_street(spec: str) -> LidarSequence:
    from densify.readers.street import Street

    return Street.from_spec(spec)


READERS: dict[str, Callable[[str], LidarSequence]] = {
    "kitti": _open_kitti_raw,
    "street": _open_street,
}


def open_sequence(spec: str | Path = "street") -> LidarSequence:
    """Open a recording.

    spec: ``READER:PATH``, or a path whose reader is guessed from what lies there, or the built-in
    ``street[:PRESET][?seed=N&sensor=NAME]``.

    Raises InputError if there is nothing there or no reader knows it.
    """
    text = str(spec)
    if text == "street" or text.startswith(("street:", "street?")):
        return _open_street(text)
    reader, colon, path = text.partition(":")
    if colon and reader in READERS:
        return READERS[reader](path)
    folder = Path(text)
    if not folder.exists():
        raise InputError(
            f"--data {text}: no such folder; expected a recording's folder, READER:PATH with "
            f"READER one of {', '.join(READERS)}, or street[:PRESET]"
        )
    if (folder / "velodyne_points").is_dir():
        return _open_kitti_raw(text)
    raise InputError(
        f"--data {text}: no known recording there; expected a KITTI raw drive (a folder that holds "
        f"velodyne_points/)"
    )
