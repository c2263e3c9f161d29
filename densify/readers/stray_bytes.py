# SPDX-License-Identifier: MIT
"""Mend JPEG files that hold all pixels but break a rule of the format (ITU-T T.81, annex B)."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

_MARKER = re.compile(rb"\xff[\xd0-\xd7\xd9]")  # restart, or end of the image
_SCAN, _END = b"\xff\xda", b"\xff\xd9"
# Some USB cameras send a few bytes too many before a restart marker. Others leave out the marker at
# the end. libjpeg decodes all pixels of these files, and warns of them as of damaged files.
_STRAY, _CUT_OFF, _NO_END = "extraneous bytes", "premature end of data", "Premature end of JPEG"
_MOST_STRAY_BYTES = 16
"""Data that are decoded wrongly often leave more bytes, up to all of a restart interval."""
_MOST_MARKERS = 512  # each takes some milliseconds


def decode_strictly(data: bytes) -> tuple[NDArray[np.uint8], str]:
    """Return the pixels (H,W,3), as blue, green, red, of a JPEG, and what was mended, "" for none.

    Raise ValueError if pixels are missing or wrong.
    """
    pixels, complaint = _decoded(data)
    mended, said = data, ""
    if complaint.startswith(_NO_END):
        mended, said = data.rstrip(b"\xff") + _END, "no marker at its end"
        pixels, complaint = _decoded(mended)
    if _STRAY in complaint:
        mended, num_markers = _without_stray(mended)
        stray = f"stray bytes before {num_markers} marker{'s' * (num_markers > 1)}"
        said = " and ".join(filter(None, (said, stray)))
        pixels, complaint = _decoded(mended)
    if pixels is None:
        raise ValueError(complaint)
    return pixels, said


def _decoded(data: bytes) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the pixels, or None and the first complaint of libjpeg."""
    import simplejpeg

    try:
        # OpenCV and Pillow decode damaged JPEG data to wrong colours.
        return simplejpeg.decode_jpeg(data, "BGR", strict=True), ""
    except ValueError as error:
        return None, str(error)


def _without_stray(data: bytes) -> tuple[bytes, int]:
    """Return mended data, and the number of markers after stray bytes; ValueError if damaged."""
    num_markers, end = 0, data.rfind(_SCAN)
    for _ in range(_MOST_MARKERS):
        marker = _MARKER.search(data, end)
        if marker is None or data[end - len(_END) : end] == _END:
            return data, num_markers
        begin, tail = marker.start(), data[marker.start() :]
        # Without a byte that belongs to it, the interval before the marker is cut off.
        num = 0
        while num <= _MOST_STRAY_BYTES:
            _, complaint = _decoded(data[: begin - num - 1] + tail)
            if _CUT_OFF in complaint:
                break
            num += 1
        if num:
            data = data[: begin - num] + tail
            if num > _MOST_STRAY_BYTES or not _ends_in_ones(data, begin - num):
                raise ValueError(f"{num} bytes before the marker at {begin} are not decoded")
            num_markers += 1
        end = begin - num + len(_END)
    raise ValueError(f"more than {_MOST_MARKERS} restart markers")


def _ends_in_ones(data: bytes, end: int) -> bool:
    """Return True if the bits that fill up the last byte before a marker are ones, as must be."""
    # In an interval that is decoded wrongly these bits may be anything.
    last = data[end - 1]
    if data[end - 2 : end] == b"\xff\x00" or last == 0xFF:
        return True
    filled = last | (last + 1)  # the lowest zero becomes one
    changed = data[: end - 1] + bytes([filled]) + b"\x00" * (filled == 0xFF) + data[end:]
    # The lowest zero must be data, not filling.
    pixels, complaint = _decoded(data)
    changed_pixels, changed_complaint = _decoded(changed)
    return complaint != changed_complaint or not np.array_equal(pixels, changed_pixels)  # type: ignore
