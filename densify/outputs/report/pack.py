# SPDX-License-Identifier: MIT
"""Arrays as text that a page can carry and a browser unpacks fast: differences, bytes by
significance, deflate, base64. `page/unpack.js` is the other half.

Browsers decode 16-bit PNG to 8 bits, so depth goes this way.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TRIAL_LEVEL, _LEVEL = 1, 7


class Blobs:
    """The packed arrays of a page. texts: name -> base64. first: number of the first name."""

    def __init__(self, first: int = 0) -> None:
        self._first = first
        self.texts: dict[str, str] = {}

    @property
    def num_bytes(self) -> int:
        return sum(map(len, self.texts.values()))

    def add(self, array: NDArray[Any]) -> Mapping[str, Any]:
        """Pack an unsigned array (N,) or (H,W) of 8, 16 or 32 bits; returns what the page needs to
        find and unpack it.

        Along the last axis each value is stored as such or as its difference to the one before,
        whichever packs smaller at a glance.
        """
        steps = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        plain, different = (len(_deflated(values, _TRIAL_LEVEL)) for values in (array, steps))
        is_delta = different < plain
        return {
            "blob": self._keep(_deflated(steps if is_delta else array, _LEVEL)),
            "bytes": array.dtype.itemsize,
            "shape": list(array.shape),
            "delta": is_delta,
        }

    def add_file(self, data: bytes, mime: str) -> Mapping[str, Any]:
        """Keep an image file as it is."""
        return {"blob": self._keep(data), "mime": mime}

    def _keep(self, data: bytes) -> str:
        name = f"blob-{self._first + len(self.texts)}"
        self.texts[name] = base64.b64encode(data).decode()
        return name


def smallest(array: NDArray[Any]) -> NDArray[Any]:
    """The same whole numbers, 0 or more, in as few bits as they need. Raises ValueError beyond 32
    bits."""
    largest = int(array.max(initial=0))
    for kind in (np.uint8, np.uint16, np.uint32):
        if largest <= np.iinfo(kind).max:
            return array.astype(kind)
    raise ValueError(f"numbers up to {largest}, expected 32 bits at most")


def _deflated(array: NDArray[Any], level: int) -> bytes:
    values = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    planes = values.view(np.uint8).reshape(-1, array.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), level)
