# SPDX-License-Identifier: MIT
"""What readers of recordings kept as one file per frame share: finding a frame's file, saying which
frames exist when it is not there, and loading an image of the size its camera promises.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.types import Camera

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


def read_text(path: Path) -> str:
    """The text of a small file. Raises InputError if it is missing, unreadable or not text."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(f"{path}: cannot be read: {reason}") from error


def read_json(path: Path) -> Any:
    """What a JSON file holds. Raises InputError if it is missing, unreadable or broken."""
    try:
        return json.loads(read_text(path))
    except ValueError as error:
        raise InputError(f"{path}: not a whole JSON file ({error}); fetch it again") from error


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


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises InputError if it is missing or unreadable."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def decoded_image(data: bytes, camera: Camera, where: Path) -> NDArray[np.uint8]:
    """(H,W,3) uint8 RGB of an image file's bytes; gray ones get three equal channels.

    Raises InputError, which names the place, if it is no whole image or not of the camera's size.
    """
    bgr = _decoded(data, where)
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


def image_size_px(path: Path) -> tuple[int, int]:
    """Width and height of an image file, for data sets that write them nowhere else. Raises
    InputError if it is no whole image."""
    height, width = _decoded(read_bytes(path), path).shape[:2]
    return width, height


def _decoded(data: bytes, where: Path) -> NDArray[Any]:
    """(H,W,3) BGR."""
    import cv2

    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if bgr is None:
        raise InputError(
            f"{where}: not a complete image ({len(data)} bytes); expected a PNG or JPEG file"
        )
    return bgr
