# SPDX-License-Identifier: MIT
"""Images. Whether a file is whole, and how large its image is, is looked at before it is decoded:
the decoders make room for whatever a header claims, fill what is missing with gray, and write to
stderr themselves."""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.files.content import read_bytes

MOST_PIXELS = 1 << 27
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_PNG_PARTS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"eXIf", b"IEND")  # of others, libpng complains
_MARKER = re.compile(rb"\xff+[^\x00\xff\xd0-\xd7]")  # other than a byte FF, fill and restarts
_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_SCAN, _END = 0xDA, 0xD9


def read_image(path: Path, as_stored: bool = False) -> NDArray[Any]:
    """`decode_image` of a file."""
    return decode_image(read_bytes(path), path, as_stored)


def decode_image(data: bytes, where: Path | str, as_stored: bool = False) -> NDArray[Any]:
    """(H,W,3) uint8, blue, green, red; as_stored: of any depth, (H,W) if gray.

    Raises InputError, which begins with ``where``, if it is no whole PNG or JPEG file, or has more
    than `MOST_PIXELS`.
    """
    try:
        if data.startswith(_PNG):
            size_px, data = _png(data)
        elif data.startswith(_JPEG):
            size_px = _jpeg_size_px(data)
        else:
            raise ValueError
        check_pixels(size_px, where)
        flags = cv2.IMREAD_UNCHANGED if as_stored else cv2.IMREAD_COLOR
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is None:
            raise ValueError
    except (ValueError, IndexError, cv2.error) as error:
        raise InputError(
            f"{where}: not a complete image ({len(data)} bytes); expected a PNG or JPEG file"
        ) from error
    return image


def image_size_px(path: Path) -> tuple[int, int]:
    """Width and height of an image file, for data sets that write them nowhere else. Raises
    InputError if it is no whole image."""
    height, width = read_image(path).shape[:2]
    return width, height


def check_pixels(size_px: tuple[int, int], where: Path | str) -> None:
    """Raise InputError for an image (width, height) that is empty or too large."""
    width, height = size_px
    if min(size_px) < 1 or width * height > MOST_PIXELS:
        raise InputError(
            f"{where}: got an image of {width} x {height} px, expected {MOST_PIXELS:,} pixels at "
            f"most"
        )


def _png(data: bytes) -> tuple[tuple[int, int], bytes]:
    """Width and height, and the file without what is no part of the image. Raises ValueError
    unless all parts are there with the right checksums."""
    parts, start, name = [_PNG], len(_PNG), b""
    while name != b"IEND":
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        name, checksum = data[start + 4 : start + 8], data[end - 4 : end]
        if end > len(data) or zlib.crc32(data[start + 4 : end - 4]).to_bytes(4, "big") != checksum:
            raise ValueError
        if name in _PNG_PARTS:
            parts.append(data[start:end])
        start = end
    if parts[1][4:8] != b"IHDR" or not any(part[4:8] == b"IDAT" for part in parts[2:]):
        raise ValueError
    width, height = (int.from_bytes(parts[1][at : at + 4], "big") for at in (8, 12))
    return (width, height), b"".join(parts)


def _jpeg_size_px(data: bytes) -> tuple[int, int]:
    """Width and height. Raises ValueError or IndexError unless the file goes on to its end."""
    at, size_px, scanned = 2, None, False
    while True:
        found = _MARKER.search(data, at) if scanned else _MARKER.match(data, at)
        if found is None:
            raise ValueError
        at, kind = found.end(), found[0][-1]
        if kind == _END:
            break
        if kind in _FRAMES:
            height, width = (int.from_bytes(data[at + i : at + i + 2], "big") for i in (3, 5))
            size_px = width, height
        scanned = kind == _SCAN
        at += int.from_bytes(data[at : at + 2], "big")
    if size_px is None:
        raise ValueError
    return size_px
