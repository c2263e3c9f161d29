# SPDX-License-Identifier: MIT
"""The bytes of a file: an ordinary one, and not too many of them."""

from __future__ import annotations

import errno
import os
import stat
import time
import zlib
from pathlib import Path
from typing import BinaryIO

from densify.config.errors import InputError

MOST_BYTES = 1 << 30
"""No file is larger in memory, compressed or not; a sweep has 2 to 10 MB."""
_PASSING = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EAGAIN)
_PAUSES_S = (0.05, 0.5)


def open_file(path: Path) -> BinaryIO:
    """A file for reading, that of whom it is to be closed by. Raises InputError if it is missing
    or unreadable, and at once for pipes and devices, which are not waited for."""
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise InputError(f"{path}: cannot be read: it is no file but a folder, pipe or device")
    return os.fdopen(number, "rb")


def read_bytes(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """The whole content. Raises InputError if it is missing, unreadable, no ordinary file, or has
    more bytes than that."""
    with open_file(path) as file:
        num_bytes = os.fstat(file.fileno()).st_size
        check_size(num_bytes, path, most_bytes)
        try:
            return _read(file, num_bytes)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {reason(error)}") from error


def _read(file: BinaryIO, num_bytes: int) -> bytes:
    """Tried again after what disks and network folders recover from: a sweep that is missing only
    now would be missing for good from what is made of its neighbours."""
    for pause_s in _PAUSES_S:
        try:
            return file.read(num_bytes)
        except OSError as error:
            if error.errno not in _PASSING:
                raise
        time.sleep(pause_s)
        file.seek(0)
    return file.read(num_bytes)


def gunzipped(data: bytes, where: Path | str, most_bytes: int = MOST_BYTES) -> bytes:
    """What gzipped bytes hold. Raises InputError if they are damaged or hold more than that."""
    unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        content = unpack.decompress(data, most_bytes + 1)
    except zlib.error as error:
        raise InputError(f"{where}: not a whole gzip file: {error}; fetch it again") from error
    check_size(len(content), where, most_bytes)
    if not unpack.eof:
        raise InputError(f"{where}: not a whole gzip file: it is cut off; fetch it again")
    return content


def check_size(num_bytes: int, where: Path | str, most_bytes: int = MOST_BYTES) -> None:
    """Raise InputError for more bytes than that."""
    if num_bytes > most_bytes:
        raise InputError(
            f"{where}: holds {num_bytes:,} bytes or claims to, expected {most_bytes:,} at most"
        )


def reason(error: Exception) -> str:
    """What an exception says, on one line."""
    said = error.strerror if isinstance(error, OSError) else None
    return said or " ".join(str(error).split()) or type(error).__name__
