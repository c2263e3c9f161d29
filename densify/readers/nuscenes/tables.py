# SPDX-License-Identifier: MIT
"""Tables of a data set kept as JSON files, each a list of flat records with a token.

The tables of a whole data set have millions of records; of these files only the records asked for
are parsed.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import open_file, parse_json, read_json, reason
from densify.geometry.types import Float

_RECORD = re.compile(rb"\{[^{}]*\}")


@dataclass(frozen=True)
class Record:
    """One record. where: file and token, for messages."""

    where: str
    values: Mapping[str, Any]

    def text(self, key: str) -> str:
        value = self._value(key)
        if not isinstance(value, str):
            raise InputError(f"{self.where}: {key}: got {value!r:.60}, expected a text")
        return value

    def whole(self, key: str) -> int:
        value = self._value(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise InputError(f"{self.where}: {key}: got {value!r:.60}, expected a whole number")
        return value

    def numbers(self, key: str, *shape: int) -> Float:
        """Finite numbers of that shape."""
        value = self._value(key)
        try:
            array = np.array(value, np.float64)
        except (TypeError, ValueError):
            array = np.zeros(0)
        if array.shape != shape or not np.isfinite(array).all():
            size = " x ".join(map(str, shape))
            raise InputError(
                f"{self.where}: {key}: got {value!r:.60}, expected {size} finite numbers"
            )
        return array

    def _value(self, key: str) -> Any:
        if key not in self.values:
            raise InputError(
                f"{self.where}: no {key}; got {', '.join(self.values) or 'an empty record'}"
            )
        return self.values[key]


def read_table(path: Path) -> dict[str, Record]:
    """All records by their token. Raises InputError if the file is missing or no such table."""
    found = read_json(_there(path))
    if not isinstance(found, list) or not all(isinstance(r, dict) for r in found):
        raise InputError(f"{path}: got no list of records, expected [{{...}}, ...]")
    return _by_token(path, found)


def find_records(path: Path, key: str, wanted: Collection[str]) -> dict[str, Record]:
    """Records, by token, whose ``key`` is one of ``wanted``; the others are not parsed.

    Raises InputError if the file is missing or cut off, or one of the records is malformed.
    """
    pattern = re.compile(rb'"%s"\s*:\s*"([^"]*)"' % key.encode())
    names = frozenset(name.encode() for name in wanted)
    found = []
    try:
        with (
            open_file(_there(path)) as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            if data[:4096].lstrip()[:1] != b"[" or data[-4096:].rstrip()[-1:] != b"]":
                raise ValueError("it does not begin with [ or end with ]")
            for match in _RECORD.finditer(data):
                of = pattern.search(match[0])
                if of and of[1] in names:
                    found.append(parse_json(match[0], path))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not a whole JSON table: {reason(error)}; fetch it again"
        ) from error
    return _by_token(path, found)


def _there(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"{path}: no such table; fetch the data set's metadata")
    return path


def _by_token(path: Path, records: list[dict[str, Any]]) -> dict[str, Record]:
    named = [Record(f"{path}: record {r.get('token', i)}", r) for i, r in enumerate(records)]
    return {record.text("token"): record for record in named}
