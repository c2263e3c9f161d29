# SPDX-License-Identifier: MIT
"""Images. Whether a file is whole, and how large its image is, is looked at before it is decoded:
the decoders make room for whatever a header claims, fill what is missing with gray, and write to
stderr themselves."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import read_bytes

MOST_PIXELS = 1 << 27
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_PNG_BITS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PASSES = (  # of interlaced PNG: first column and row, steps
    *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4)),
    *((1, 0, 2, 2), (0, 1, 1, 2)),
)
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
        if data.startswith(_JPEG):
            _check_jpeg(data, where)
        flags = cv2.IMREAD_UNCHANGED if as_stored else cv2.IMREAD_COLOR
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is None:
            raise ValueError
    except (ValueError, IndexError, struct.error, cv2.error) as error:
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
    """Width and height, and the file with nothing but the image, of which libpng has no word to
    say. Raises ValueError unless all parts are there, whole and with the right checksums."""
    parts: dict[bytes, list[bytes]] = {}
    start, name = len(_PNG), b""
    while name != b"IEND":
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        name, checksum = data[start + 4 : start + 8], data[end - 4 : end]
        if end > len(data) or zlib.crc32(data[start + 4 : end - 4]).to_bytes(4, "big") != checksum:
            raise ValueError
        parts.setdefault(name, []).append(data[start + 8 : end - 4])
        start = end
    (header,), palette = parts.get(b"IHDR", []), parts.get(b"PLTE", [])
    width, height, bits, colour, *ways = struct.unpack(">IIBBBBB", header)
    if bits not in _PNG_BITS.get(colour, ()) or ways not in ([0, 0, 0], [0, 0, 1]):
        raise ValueError
    if not 0 < width * height <= MOST_PIXELS:
        return (width, height), b""  # is refused
    kept = [_part(b"IHDR", header)]
    if colour == 3:
        if not palette or len(palette[0]) % 3 or not 0 < len(palette[0]) <= 3 << bits:
            raise ValueError
        kept.append(_part(b"PLTE", palette[0]))
    pixels = b"".join(parts.get(b"IDAT", ()))
    kept.append(
        _part(b"IDAT", _whole(pixels, (width, height), bits * _PNG_CHANNELS[colour], ways[2] == 1))
    )
    return (width, height), b"".join([_PNG, *kept, _PNG_END])


def _part(name: bytes, content: bytes) -> bytes:
    length, checksum = len(content), zlib.crc32(name + content)
    return length.to_bytes(4, "big") + name + content + checksum.to_bytes(4, "big")


def _whole(packed: bytes, size_px: tuple[int, int], num_bits: int, interlaced: bool) -> bytes:
    """The packed rows, packed anew if there are more than the image has. Raises ValueError for
    fewer, and rows of a filter that does not exist."""
    width, height = size_px
    shapes = [
        (-(-(height - y) // down), 1 + -(-(-(-(width - x) // right) * num_bits) // 8))
        for x, y, right, down in (_PASSES if interlaced else ((0, 0, 1, 1),))
        if width > x and height > y
    ]
    num_bytes = sum(rows * row_bytes for rows, row_bytes in shapes)
    unpack = zlib.decompressobj()
    try:
        rows = unpack.decompress(packed, num_bytes + 1)
    except zlib.error as error:
        raise ValueError from error
    if len(rows) < num_bytes:
        raise ValueError
    at = 0
    for num_rows, row_bytes in shapes:
        if max(rows[at : at + num_rows * row_bytes : row_bytes]) > 4:
            raise ValueError
        at += num_rows * row_bytes
    if len(rows) == num_bytes and unpack.eof and not unpack.unused_data:
        return packed
    return zlib.compress(rows[:num_bytes], 1)


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


def _check_jpeg(data: bytes, where: Path | str) -> None:
    """Raise InputError if what is coded is damaged, which libjpeg decodes to wrong colours all the
    same. At an eighth of the size, which takes half as long."""
    try:
        simplejpeg.decode_jpeg(data, "GRAY", fastdct=True, min_height=1, min_width=1, strict=True)
    except ValueError as error:
        raise InputError(
            f"{where}: a damaged JPEG image ({error}); restore the file, or leave out its key or "
            f"camera"
        ) from error
