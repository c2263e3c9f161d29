# SPDX-License-Identifier: MIT
"""Decode arrays, images and LAS files; sizes in headers are checked before memory is allocated."""

from __future__ import annotations

import io
import logging
import math
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import MOST_BYTES, check_size, open_file, read_bytes, reason
from densify.readers.stray_bytes import decode_strictly

Arrays = dict[str, NDArray[Any]]

MOST_PIXELS = 1 << 27
_log = logging.getLogger("densify")
_folders_told: set[Path] = set()
# Offset of the points, number of records, bytes per point, number of points.
_LAS_HEADER = struct.Struct("<96xIIxHI")
# LAS 1.4 only: offset and number of extended records, number of points.
_LAS_EXTENDED = struct.Struct("<235xQIQ")
_RECORD_BYTES = 54  # smallest size of a variable length record


def read_array(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file."""
    data = read_bytes(path)
    try:
        return _array(data)
    except Exception as error:  # a damaged header raises anything
        raise InputError(f"{path}: not a whole .npy file: {reason(error)}") from error


def read_arrays(
    path: Path, names: Sequence[str] | None = None, most_bytes: int = MOST_BYTES
) -> Arrays:
    """Return the arrays of a .npz file by name: those in ``names``, None for all."""
    data = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {m.filename[:-4]: m for m in archive.infolist() if m.filename[-4:] == ".npy"}
            wanted = {n: m for n, m in members.items() if names is None or n in names}
            check_size(sum(member.file_size for member in wanted.values()), path, most_bytes)
            return {name: _array(archive.read(member)) for name, member in wanted.items()}
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not a readable .npz file: {reason(error)}") from error


def _array(data: bytes) -> NDArray[Any]:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    header = np.lib.format
    read = header.read_array_header_1_0 if version == (1, 0) else header.read_array_header_2_0
    shape, _, dtype = read(file)
    num_bytes = len(data) - file.tell()
    if math.prod(shape) * dtype.itemsize > num_bytes and not dtype.hasobject:
        raise ValueError(f"it claims {dtype} of shape {shape}, and {num_bytes} bytes follow")
    file.seek(0)
    array: NDArray[Any] = np.load(file, allow_pickle=False)
    return array


def read_image(path: Path, as_stored: bool = False) -> NDArray[Any]:
    """Return the pixels of a PNG or JPEG file, as `decode_image` does with its bytes."""
    return decode_image(read_bytes(path), path, as_stored)


def decode_image(data: bytes, where: Path | str, as_stored: bool = False) -> NDArray[Any]:
    """Decode the bytes of a PNG or JPEG file to (H,W,3) uint8 pixels in blue, green, red.

    ``as_stored`` keeps the file's data type and channels, such as (H,W) uint16.
    """
    import cv2

    try:
        if _checked_format(data, where) == "JPEG" and not as_stored:
            pixels, mended = decode_strictly(data)
            if mended:
                _tell_mended(where, mended)
            return pixels
        flags = cv2.IMREAD_UNCHANGED if as_stored else cv2.IMREAD_COLOR
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is None:
            raise ValueError("OpenCV cannot decode it")
        return image
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{where}: not a complete image, or damaged ({len(data)} bytes); expected a PNG or "
            f"JPEG file"
        ) from error


def _tell_mended(where: Path | str, mended: str) -> None:
    """Warn of an image that breaks the rules of its format; once for a folder or topic."""
    if (folder := Path(where).parent) not in _folders_told:
        _folders_told.add(folder)
        _log.warning(
            "%s: %s; all of its pixels are there and are read. Others like it in %s are not named",
            where,
            mended,
            folder,
        )


def _checked_format(data: bytes, where: Path | str) -> str:
    """Return "PNG" or "JPEG", the format of an image file; raise an exception if damaged."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
        check_pixels(image.size, where)
        image.verify()
        return str(image.format)


def image_size_px(path: Path) -> tuple[int, int]:
    """Return the width and height (px) of an image file after decoding all pixels."""
    height, width = read_image(path).shape[:2]
    return width, height


def stated_size_px(path: Path) -> tuple[int, int] | None:
    """Return the width and height (px) that an image's header states, None without a header."""
    from PIL import Image

    try:
        with open_file(path) as file, Image.open(file, formats=("PNG", "JPEG")) as image:
            return image.size
    except (InputError, OSError, ValueError, SyntaxError):  # reported when the image is read
        return None


def check_pixels(size_px: tuple[int, int], where: Path | str) -> None:
    """Raise InputError if an image (width, height) is empty or exceeds `MOST_PIXELS`."""
    width, height = size_px
    if min(size_px) < 1 or width * height > MOST_PIXELS:
        raise InputError(
            f"{where}: got an image of {width} x {height} px, expected {MOST_PIXELS:,} pixels at "
            f"most"
        )


def read_las(path: Path) -> Any:
    """Return a `laspy.LasData` with all points of a LAS or LAZ file."""
    import laspy

    data = read_bytes(path)
    try:
        _check_las(data, path)
        # laspy's parallel backend would allocate the size stated in a damaged chunk.
        with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as file:
            num_points, cloud = file.header.point_count, file.read()
        if len(cloud) != num_points:
            raise ValueError(f"got {len(cloud)} points, expected {num_points}; it is cut off")
        return cloud
    except (InputError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # lazrs, written in Rust, panics
        raise InputError(f"{path}: not a readable {path.suffix} file: {reason(error)}") from error


def _check_las(data: bytes, path: Path) -> None:
    """Raise an exception if the points, records and chunks stated in a LAS header do not fit."""
    begin, num_records, num_bytes, num_points = _LAS_HEADER.unpack_from(data)
    kind, version = data[104], data[25]
    if version >= 4:
        _, num_late, num_points = _LAS_EXTENDED.unpack_from(data)
        num_records += num_late
    check_size(num_points * num_bytes, path)
    if num_records * _RECORD_BYTES > len(data):
        raise ValueError(f"its header claims {num_records:,} records; it is damaged")
    if kind & 0x80 and num_points:  # compressed
        (table,) = struct.unpack_from("<q", data, begin)
        if table == -1:
            (table,) = struct.unpack_from("<q", data, len(data) - 8)
        (num_chunks,) = struct.unpack_from("<I", data, table + 4)
        if num_chunks * num_bytes > len(data):
            raise ValueError(f"it claims {num_chunks:,} chunks; it is cut off or damaged")
