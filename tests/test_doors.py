# SPDX-License-Identifier: MIT
"""Reading of others' files is bounded, and refuses what is damaged or hostile in one line."""

from __future__ import annotations

import gzip
import os
import pickle
import re
import struct
import zipfile
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest

from densify.config import resolve
from densify.config.errors import ComputationError, InputError, OutputError, UnplacedSweepError
from densify.config.file_content import gunzip, parse_yaml, read_bytes
from densify.readers.decoded_files import (
    decode_image,
    decode_jpeg,
    read_array,
    read_arrays,
    read_image,
    read_las,
)

CHECKOUT = Path(__file__).parents[1]


def refused(call, *arguments, says: str, where: str | Path | None = None, **options) -> None:
    with pytest.raises(InputError, match=says) as caught:
        call(*arguments, **options)
    line = str(caught.value)
    assert line.startswith(str(arguments[0] if where is None else where)) and "\n" not in line
    assert len(line) <= 1000


def test_only_ordinary_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        refused(read_bytes, path, says="no file but a folder, pipe or device")
    for name in ("x" * 300, "a\0b", "nothing"):
        refused(read_bytes, tmp_path / name, says="cannot be read: ", where=tmp_path)
    sparse = tmp_path / "sparse"
    sparse.touch()
    os.truncate(sparse, 1 << 40)
    refused(read_bytes, sparse, says=r"holds 1,099,511,627,776 bytes .* 1,073,741,824 at most")


def test_a_gzip_bomb_is_not_unpacked() -> None:
    data = gzip.compress(bytes(1 << 20))
    assert gunzip(data, "x") == bytes(1 << 20)
    assert gunzip(data + gzip.compress(b"more"), "x") == bytes(1 << 20) + b"more"
    refused(gunzip, data, "x", 1 << 16, says="expected 65,536 at most", where="x")
    for damaged in (data[:-9], b"", b"text"):
        refused(gunzip, damaged, "x", says="not a whole gzip file", where="x")


def npy(shape: str = "(3,)", dtype: str = "<f8", data: bytes = bytes(24)) -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + data


BAD_NPY = {
    "more than there is": npy("(4,)"),
    "terabytes": npy("(1000000000000,)"),
    "objects": npy(dtype="|O", data=pickle.dumps([print])),
    "no shape": npy("3"),
    "text": b"\x93NUMPY\x01\0\xff\xffx",
}


@pytest.mark.parametrize("case", BAD_NPY)
def test_headers_of_arrays_are_not_believed(case: str, tmp_path: Path) -> None:
    alone, inside = tmp_path / "a.npy", tmp_path / "a.npz"
    alone.write_bytes(BAD_NPY[case])
    refused(read_array, alone, says="not a whole .npy file: .")
    with zipfile.ZipFile(inside, "w") as archive:
        archive.writestr("points.npy", BAD_NPY[case])
    refused(read_arrays, inside, says="not a readable .npz file: .")


IMAGE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def encoded(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, IMAGE, options)[1].tobytes()


@pytest.mark.parametrize(
    ("suffix", "options"), [(".png", ()), (".jpg", ()), (".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))]
)
def test_whole_images_are_decoded_and_cut_ones_are_not(suffix: str, options) -> None:
    data = encoded(suffix, *options)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decode_image(data, "x"), expected)
    damaged = [data[:length] for length in (0, 10, len(data) // 2, len(data) - 13)]
    if suffix == ".png":
        damaged.append(data[:2000] + bytes([data[2000] ^ 1]) + data[2001:])
    for content in damaged:
        refused(decode_image, content, "x", says="not a complete image", where="x")
    for other in (".bmp", ".tiff", ".webp"):
        refused(decode_image, encoded(other), "x", says="expected a PNG or JPEG", where="x")


def test_sizes_of_images_are_looked_at_before_decoding() -> None:
    data, start = bytearray(encoded(".jpg")), encoded(".jpg").index(b"\xff\xc0")
    data[start + 5 : start + 9] = b"\xff\xff\xff\xff"
    refused(decode_image, bytes(data), "x", says=".", where="x: not a complete image")
    data[start + 5 : start + 9] = b"\x2f\xff\x2f\xff"
    refused(decode_image, bytes(data), "x", says="134,217,728 pixels at most", where="x")


# JPEG files with all pixels are read, with a warning if libjpeg has one

PICTURE = cv2.GaussianBlur(np.tile(IMAGE, (3, 3, 1)), (0, 0), 2)


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


def test_the_marker_at_the_end_may_be_missing_but_no_data() -> None:
    for end in (b"", b"\xff"):
        pixels, mended = decode_jpeg(WHOLE[:-2] + end)
        np.testing.assert_array_equal(pixels, PIXELS)
        assert mended == "no marker at its end"
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


# Other files


@pytest.mark.parametrize("point_format", [3, 6])
def test_claims_of_las_headers_are_not_believed(point_format: int, tmp_path: Path) -> None:
    cloud = laspy.LasData(laspy.LasHeader(point_format=point_format, version="1.4"))
    cloud.x = cloud.y = cloud.z = np.arange(60.0)
    path = tmp_path / "a.laz"
    cloud.write(path)
    whole = path.read_bytes()
    assert len(read_las(path)) == 60
    (begin,) = struct.unpack_from("<I", whole, 96)
    (table,) = struct.unpack_from("<q", whole, begin)
    claims = [(247, "<Q", 10**15), (247, "<Q", 70), (100, "<I", 2**32 - 1), (243, "<I", 2**32 - 1)]
    claims += [(table + 4, "<I", 2**32 - 1), (begin, "<q", 2**40), (begin + 60, "<Q", 2**62)]
    for at, form, value in claims:
        data = bytearray(whole)
        struct.pack_into(form, data, at, value)
        path.write_bytes(data)
        refused(read_las, path, says=".")
    for length in (0, 100, len(whole) - 300, len(whole) - 3):
        path.write_bytes(whole[:length])
        refused(read_las, path, says="not a readable .laz")


LEVELS = [f"&{b} [{', '.join(['*' + a] * 10)}]" for a, b in zip("abcdef", "bcdefg", strict=True)]
BOMB = f"{{project: {{fill_reach: [&a [1,1,1,1,1,1,1,1,1,1], {', '.join(LEVELS)}]}}}}"


@pytest.mark.parametrize(
    "value",
    ["!!int ''", "!!timestamp x", "!!map [a]", "!!python/object:os.system x", "[" * 700,
     "{[a]: b}", "2001-99-99", "\x07", BOMB],
)  # fmt: skip
def test_yaml_that_is_none(value: str) -> None:
    refused(parse_yaml, value, "x", says="not YAML", where="x")
    with pytest.raises(InputError, match=r"--set project\.fill_reach=") as caught:
        resolve(None, [f"project.fill_reach={value}"])
    assert len(str(caught.value)) <= 1000 and "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [InputError, OutputError, ComputationError])
def test_messages_echo_no_more_than_a_line(kind: type[Exception]) -> None:
    for got in ("x" * 5000, f"'{'a b ' * 5000}'", str([*range(20_000)])):
        line = str(kind(f"/a/path: got {got}, expected a number"))
        assert len(line) <= 1000 and "..." in line
        assert line.startswith("/a/path: got ") and line.endswith(", expected a number")
    told = f"the sensor's file: {'one, ' * 50}or the car's"  # two apostrophes quote nothing
    assert str(kind(told)) == told
    error = pickle.loads(pickle.dumps(UnplacedSweepError("y" * 400, 3)))
    assert error.frame == 3 and len(str(error)) == 200


def test_readers_open_files_by_the_shared_functions() -> None:
    unguarded = r"np\.load\(|np\.fromfile|cv2\.imread\(|imdecode|\.read_bytes\(|\.read_text\("
    unguarded += r"|json\.load|yaml\.(safe_)?load|gzip\.|zipfile\.|Image\.open|laspy\.read"
    for path in (CHECKOUT / "densify" / "readers").rglob("*.py"):
        if path.name != "decoded_files.py":
            found = re.search(unguarded, path.read_text("utf-8"))
            name = path.relative_to(CHECKOUT)
            assert not found or "nuscenes" in str(name), f"{name}: {found and found.group()}"
