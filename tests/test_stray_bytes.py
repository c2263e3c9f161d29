# SPDX-License-Identifier: MIT
"""JPEG files with all pixels are read, with a warning if libjpeg has one. Damaged ones are not."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.config.errors import InputError
from densify.readers.decoded_files import decode_jpeg, read_image

RNG = np.random.default_rng(4)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (120, 160, 3), np.uint8), (0, 0), 2)


def jpeg(interval: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_RST_INTERVAL, interval]
    return cv2.imencode(".jpg", PICTURE, options)[1].tobytes()


WHOLE = jpeg(10)
PIXELS, _ = decode_jpeg(WHOLE)
MARKERS = [m.start() for m in re.finditer(rb"\xff[\xd0-\xd7\xd9]", WHOLE)]


@pytest.mark.parametrize("stray", [b"\x55\x12\x99" * 4, b"\xff" * 3 + b"\x00" * 9])
@pytest.mark.parametrize("rows", [[-1], [0, 1, 6]])
def test_stray_bytes_before_markers_are_passed_over(stray: bytes, rows: list[int]) -> None:
    data = WHOLE
    for at in sorted((MARKERS[row] for row in rows), reverse=True):
        data = data[:at] + stray + data[at:]
    pixels, mended = decode_jpeg(data)
    np.testing.assert_array_equal(pixels, PIXELS)
    assert mended == f"stray bytes before {len(rows)} marker{'s' * (len(rows) > 1)}"


@pytest.mark.parametrize("end", [b"", b"\xff"])
def test_the_marker_at_the_end_may_be_missing(end: bytes) -> None:
    pixels, mended = decode_jpeg(WHOLE[:-2] + end)
    np.testing.assert_array_equal(pixels, PIXELS)
    assert mended == "no marker at its end"


def test_missing_data_are_refused() -> None:
    for cut in (3, 10, 500, len(WHOLE) // 2):
        with pytest.raises(ValueError, match="premature end"):
            decode_jpeg(WHOLE[:-cut])
    at = MARKERS[3]
    for data in (WHOLE[: at - 5] + WHOLE[at:], WHOLE[:at] + bytes(40) + WHOLE[at:]):
        with pytest.raises(ValueError):
            decode_jpeg(data)


@pytest.mark.parametrize("interval", [0, 10])
def test_wrong_bits_are_not_taken_for_stray_bytes(interval: int) -> None:
    whole, rng = jpeg(interval), np.random.default_rng(interval)
    begin = whole.rfind(b"\xff\xda") + 14
    num_refused = num_mended = 0
    for place in rng.integers(begin, len(whole) - 2, 150):
        wrong = bytearray(whole)
        wrong[place] ^= 1 << int(rng.integers(8))
        try:
            num_mended += decode_jpeg(bytes(wrong))[1] != ""
        except ValueError:
            num_refused += 1
    assert num_refused > 10 and num_mended <= num_refused // 5  # short intervals leave few bytes


def test_the_image_is_named_once_for_its_folder(tmp_path: Path, caplog) -> None:
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(WHOLE[: MARKERS[0]] + bytes(9) + WHOLE[MARKERS[0] :])
        np.testing.assert_array_equal(read_image(tmp_path / name), PIXELS)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert f"{tmp_path / 'a.jpg'}: stray bytes before 1 marker" in record.getMessage()
    (tmp_path / "c.jpg").write_bytes(WHOLE[:-99])
    with pytest.raises(InputError, match=r"c\.jpg: not a complete image, or damaged"):
        read_image(tmp_path / "c.jpg")
