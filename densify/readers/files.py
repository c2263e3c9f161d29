# SPDX-License-Identifier: MIT
"""What readers of recordings kept as one file per frame share: finding a frame's file, saying which
frames exist when it is not there, and loading an image of the size its camera promises.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Camera
from densify.readers.image_files import decode_image

T = TypeVar("T")

_MAX_RANGES_SHOWN = 8


def numbered_files(folder: Path, *suffixes: str) -> dict[int, Path]:
    """Files of a folder named by a frame number, as ``{frame: path}`` by ascending frame.

    suffixes: those accepted, with the dot and in lower case. Empty if there is no such folder.
    """
    if not folder.is_dir():
        return {}
    found = {
        int(path.stem): path
        for path in folder.iterdir()
        if path.stem.isdecimal() and path.suffix.lower() in suffixes
    }
    return dict(sorted(found.items()))


def runs(frames: Iterable[int]) -> list[range]:
    """Frames, ascending, cut where a number is missing."""
    found: list[range] = []
    for frame in frames:
        if found and frame == found[-1].stop:
            found[-1] = range(found[-1].start, frame + 1)
        else:
            found.append(range(frame, frame + 1))
    return found


def format_frames(frames: Iterable[int]) -> str:
    """Frame numbers as a person writes them: ``96-135, 140``; long lists are cut in the middle."""
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs(sorted(frames))]
    if len(texts) > _MAX_RANGES_SHOWN:
        texts = [*texts[: _MAX_RANGES_SHOWN - 1], "...", texts[-1]]
    return ", ".join(texts) if texts else "none"


def of_frame(entries: Mapping[int, T], frame: int, what: str, where: Path) -> T:
    """The entry of a frame, or an InputError that names the frames that exist.

    what, where: for the message, such as ``"sweep"`` and the recording's folder.
    """
    try:
        return entries[frame]
    except KeyError:
        raise InputError(
            f"{where}: no {what} of frame {frame}; frames that exist: {format_frames(entries)}"
        ) from None


def camera_named(cameras: Mapping[str, Camera], name: str, where: Path) -> Camera:
    """The camera, or an InputError that names those that exist."""
    if name not in cameras:
        raise InputError(
            f"{where}: no camera {name!r}; cameras that exist: {', '.join(cameras) or 'none'}"
        )
    return cameras[name]


def decoded_image(data: bytes, camera: Camera, where: Path) -> NDArray[np.uint8]:
    """(H,W,3) uint8 RGB of an image file's bytes; gray ones get three equal channels.

    Raises InputError, which names the place, if it is no whole image or not of the camera's size.
    """
    bgr = decode_image(data, where)
    check_image_size(bgr.shape, camera, where)
    return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)


def check_image_size(shape: tuple[int, ...], camera: Camera, where: Path | str) -> None:
    """Raises InputError, which names the place, if an image (H,W,...) is not of the camera's
    size."""
    height, width = shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise InputError(
            f"{where}: got an image of {width} x {height} px; expected "
            f"{camera.width_px} x {camera.height_px}, as the calibration of {camera.name} says"
        )
