# SPDX-License-Identifier: MIT
"""Read bytes, text, JSON and YAML with size limits, and import optional packages."""

from __future__ import annotations

import codecs
import gzip
import io
import json
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from densify.config.errors import InputError, how_to_install

MOST_BYTES = 1 << 30
"""Largest content that is read into memory, unpacked. A sweep has 2 to 10 MB."""
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_MOST_YAML_BYTES = 1 << 22
_MOST_ALIASES = 30  # nested aliases multiply: 30 of them make at most 60,000 values of one
_MALFORMED = (LookupError, TypeError, ValueError, AttributeError, OverflowError)


def open_file(path: Path) -> BinaryIO:
    """Return a file opened for reading bytes, which the caller closes; InputError if unreadable."""
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise InputError(f"{path}: cannot be read: it is no file but a folder, pipe or device")
    file = os.fdopen(number, "rb")
    if file.peek(len(_LFS_POINTER)).startswith(_LFS_POINTER):
        file.close()
        raise InputError(f"{path}: is a Git LFS pointer, not the data; run git lfs pull")
    return file


def read_bytes(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Return the content of a file; raise InputError if unreadable or over ``most_bytes``."""
    with open_file(path) as file:
        num_bytes = os.fstat(file.fileno()).st_size
        check_size(num_bytes, path, most_bytes)
        try:
            return file.read(num_bytes)  # with a larger number Python reserves as much memory
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {reason(error)}") from error


def gunzip(data: bytes, where: Path | str, most_bytes: int = MOST_BYTES) -> bytes:
    """Return decompressed gzip data; raise InputError if damaged, empty or too large unpacked."""
    try:
        with gzip.open(io.BytesIO(data)) as file:
            content = file.read(most_bytes + 1)
        if not data:
            raise EOFError("it is empty")
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{where}: not a whole gzip file: {error}; fetch it again") from error
    check_size(len(content), where, most_bytes)
    return content


def check_size(num_bytes: int, where: Path | str, most_bytes: int = MOST_BYTES) -> None:
    """Raise InputError if ``num_bytes`` exceeds ``most_bytes``; ``where`` begins the message."""
    if num_bytes > most_bytes:
        raise InputError(
            f"{where}: holds {num_bytes:,} bytes or claims to, expected {most_bytes:,} at most"
        )


def reason(error: BaseException) -> str:
    """Return the message of an exception on one line, or the name of its type without a message."""
    said = error.strerror if isinstance(error, OSError) else None
    return said or " ".join(str(error).split()) or type(error).__name__


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """Return the text of a UTF-8 file without a byte order mark; InputError for other files."""
    return decode_text(read_bytes(path, most_bytes), path)


def decode_text(data: bytes, where: Path | str) -> str:
    """Return UTF-8 bytes as text without a byte order mark; InputError of ``where`` for others."""
    # Every second byte of plain words in UTF-16 is zero.
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or data[:2].count(0) == 1:
        raise InputError(f"{where}: is text in UTF-16, expected UTF-8; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: cannot be read: not a text file") from error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file as Python values; raise InputError if it is damaged."""
    return parse_json(read_bytes(path), path)


def parse_json(data: bytes, where: Path | str) -> Any:
    """Return the value of JSON bytes; raise InputError, starting with ``where``, if invalid."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{where}: not a whole JSON file ({reason(error)}); fetch it again"
        ) from error


def read_yaml(path: Path) -> tuple[Any, dict[str, int]]:
    """Return a YAML file's content, None if empty, and the line number of each dotted key."""
    return parse_yaml(read_text(path, _MOST_YAML_BYTES), path)


def parse_yaml(text: str, where: Path | str) -> tuple[Any, dict[str, int]]:
    """Return the content of YAML text, None if empty, and the line number of each dotted key.

    A key ``b`` in a mapping ``a`` is ``a.b``. Raise InputError, whose message begins with
    ``where``, for invalid text, a key that is given twice, or more than 30 aliases.
    """
    import yaml

    try:
        events = yaml.parse(text, yaml.SafeLoader)
        num_aliases = sum(isinstance(event, yaml.AliasEvent) for event in events)
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            return None, {}
        if num_aliases > _MOST_ALIASES:
            raise ValueError(f"expected {_MOST_ALIASES} aliases at most, got {num_aliases}")
        lines: dict[str, int] = {}
        _note_lines(root, "", lines)
        return loader.construct_document(root), lines
    except RecursionError as error:
        raise InputError(f"{where}: not YAML: nested too deeply") from error
    except Exception as error:  # a tag on a value that does not fit it raises anything
        raise InputError(f"{where}: not YAML: {reason(error)}") from error


def _note_lines(node: Any, name: str, lines: dict[str, int]) -> None:
    """Enter the line of each key below a node; raise ValueError for a repeated key."""
    if node.id != "mapping":
        return
    for key, value in node.value:
        dotted_key = f"{name}.{key.value}" if name else str(key.value)
        line = key.start_mark.line + 1
        if dotted_key in lines:
            raise ValueError(f"line {line}: {dotted_key} is given twice; keep one")
        lines[dotted_key] = line
        _note_lines(value, dotted_key, lines)


def import_extra(module: str, extra: str, needed_by: str) -> Any:
    """Return an optional module after importing it; raise InputError if that fails.

    Args:
        module: Import path of the module.
        extra: Extra of this package that installs it.
        needed_by: What needs the module, in the plural, for messages.
    """
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{needed_by} need the package {package} ({error}); {how_to_install(extra)}"
        ) from None
    except ImportError as error:
        raise InputError(
            f"{needed_by} need the package {package}, which is installed and cannot be loaded here "
            f"({error}); install the system's library that it names"
        ) from None


@contextmanager
def described_in(where: Path | str, expected: str) -> Iterator[None]:
    """Turn malformed content in the block into an InputError of ``where`` with ``expected``."""
    try:
        yield
    except InputError:
        raise
    except _MALFORMED as error:
        got = f"no {error}" if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{where}: {got:.200}; expected {expected}; fetch it again") from None
