# SPDX-License-Identifier: MIT
"""Decode arrays, images, LAS files, and columns of feather, parquet and pickled files.

Sizes in headers are checked before memory is allocated. JPEG files that hold all pixels but break a
rule of the format (ITU-T T.81, annex B) are mended. No code of a pickle is run: imported names
become classes that only store their arguments, from which the columns are taken. Names of other
packages than pandas and NumPy are refused.
"""

from __future__ import annotations

import io
import logging
import math
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import (
    MOST_BYTES,
    check_size,
    gunzip,
    import_extra,
    open_file,
    read_bytes,
    reason,
)

Arrays = dict[str, NDArray[Any]]

MOST_PIXELS = 1 << 27
_log = logging.getLogger("densify")
_folders_warned_of: set[Path] = set()

# Some USB cameras send a few bytes too many before a restart marker. Others leave out the marker at
# the end. libjpeg decodes all pixels of these files, and warns of them as of damaged files.
_STRAY, _CUT_OFF, _NO_END = "extraneous bytes", "premature end of data", "Premature end of JPEG"
_RESTART_OR_END = re.compile(rb"\xff[\xd0-\xd7\xd9]")
_SCAN, _END = b"\xff\xda", b"\xff\xd9"
_MOST_STRAY_BYTES = 16  # wrongly decoded data often leave more, up to all of a restart interval
_MOST_MARKERS = 512  # each takes some milliseconds

_RECORD_BYTES = 54  # smallest size of a variable length record of a LAS file


def read_array(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file. Raise InputError for a damaged file."""
    data = read_bytes(path)
    try:
        return _array(data)
    except Exception as error:  # a damaged header raises anything
        raise InputError(f"{path}: not a whole .npy file: {reason(error)}") from error


def read_arrays(
    path: Path, names: Sequence[str] | None = None, most_bytes: int = MOST_BYTES
) -> Arrays:
    """Return arrays of a .npz by name, all for None. Raise InputError if over ``most_bytes``."""
    data = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            stored = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            members = {member.filename.removesuffix(".npy"): member for member in stored}
            wanted = {name: members[name] for name in members if names is None or name in names}
            check_size(sum(member.file_size for member in wanted.values()), path, most_bytes)
            return {name: _array(archive.read(member)) for name, member in wanted.items()}
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not a readable .npz file: {reason(error)}") from error


def _array(data: bytes) -> NDArray[Any]:
    """Return the array of .npy data. Raise ValueError if the header claims more than follows."""
    file, header = io.BytesIO(data), np.lib.format
    version = header.read_magic(file)
    read = header.read_array_header_1_0 if version == (1, 0) else header.read_array_header_2_0
    shape, _, dtype = read(file)
    num_bytes = len(data) - file.tell()
    if math.prod(shape) * dtype.itemsize > num_bytes and not dtype.hasobject:
        raise ValueError(f"it claims {dtype} of shape {shape}, and {num_bytes} bytes follow")
    file.seek(0)
    array: NDArray[Any] = np.load(file, allow_pickle=False)
    return array


# Images


def read_image(path: Path, as_stored: bool = False) -> NDArray[Any]:
    """Return a PNG or JPEG file's pixels: (H,W,3) uint8 blue, green, red, unless ``as_stored``."""
    return decode_image(read_bytes(path), path, as_stored)


def decode_image(data: bytes, where: Path | str, as_stored: bool = False) -> NDArray[Any]:
    """Return the (H,W,3) uint8 pixels of PNG or JPEG bytes as blue, green, red.

    ``as_stored`` keeps the file's data type and channels, such as (H,W) uint16. Raise InputError,
    whose message begins with ``where``, for damaged bytes.
    """
    import cv2
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as header:
            check_pixels(header.size, where)
            header.verify()
        if header.format == "JPEG" and not as_stored:
            pixels, mended = decode_jpeg(data)
            folder = Path(where).parent
            if mended and folder not in _folders_warned_of:
                _folders_warned_of.add(folder)
                message = "%s: %s; all of its pixels are there and are read. Others like it in %s "
                _log.warning(message + "are not named", where, mended, folder)
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


def image_size_px(path: Path) -> tuple[int, int]:
    """Return the width and height (px) of an image file. Raise InputError if it is damaged."""
    height, width = read_image(path).shape[:2]
    return width, height


def stated_size_px(path: Path) -> tuple[int, int] | None:
    """Return the width and height (px) that an image's header states, or None if unreadable."""
    from PIL import Image

    try:
        with open_file(path) as file, Image.open(file, formats=("PNG", "JPEG")) as image:
            return image.size
    except (InputError, OSError, ValueError, SyntaxError):  # reported when the image is read
        return None


def check_pixels(size_px: tuple[int, int], where: Path | str) -> None:
    """Raise InputError if an image (width, height) is empty or has over `MOST_PIXELS` pixels."""
    width, height = size_px
    if min(size_px) < 1 or width * height > MOST_PIXELS:
        raise InputError(
            f"{where}: got an image of {width} x {height} px, expected {MOST_PIXELS:,} pixels at "
            f"most"
        )


def decode_jpeg(data: bytes) -> tuple[NDArray[np.uint8], str]:
    """Return a JPEG's (H,W,3) BGR pixels and repairs ("" for none). Raise ValueError if damaged."""
    pixels, complaint = _decoded_strictly(data)
    repairs = []
    if complaint.startswith(_NO_END):
        data = data.rstrip(b"\xff") + _END
        repairs.append("no marker at its end")
        pixels, complaint = _decoded_strictly(data)
    if _STRAY in complaint:
        data, num_markers = _without_stray_bytes(data)
        repairs.append(f"stray bytes before {num_markers} marker{'s' * (num_markers > 1)}")
        pixels, complaint = _decoded_strictly(data)
    if pixels is None:
        raise ValueError(complaint)
    return pixels, " and ".join(repairs)


def _decoded_strictly(data: bytes) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the pixels, or None and the first complaint of libjpeg."""
    import simplejpeg

    try:
        # OpenCV and Pillow decode damaged JPEG data to wrong colours.
        return simplejpeg.decode_jpeg(data, "BGR", strict=True), ""
    except ValueError as error:
        return None, str(error)


def _without_stray_bytes(data: bytes) -> tuple[bytes, int]:
    """Return mended data and the number of mended markers. Raise ValueError if damaged."""
    num_mended = 0
    end = data.rfind(_SCAN)  # end of the marker before
    for _ in range(_MOST_MARKERS):
        marker = _RESTART_OR_END.search(data, end)
        if marker is None or data[end - 2 : end] == _END:
            return data, num_mended
        begin = marker.start()
        tail = data[begin:]
        # Bytes are removed before the marker until the decoder misses one: the last removed byte
        # belongs to the image, those before it were stray.
        num_stray = 0
        while num_stray <= _MOST_STRAY_BYTES:
            if _CUT_OFF in _decoded_strictly(data[: begin - num_stray - 1] + tail)[1]:
                break
            num_stray += 1
        if num_stray:
            data = data[: begin - num_stray] + tail
            if num_stray > _MOST_STRAY_BYTES or not _ends_in_ones(data, begin - num_stray):
                raise ValueError(f"{num_stray} bytes before the marker at {begin} are not decoded")
            num_mended += 1
        end = begin - num_stray + 2  # bytes of a marker
    raise ValueError(f"more than {_MOST_MARKERS} restart markers")


def _ends_in_ones(data: bytes, end: int) -> bool:
    """Return True if the bits that fill up the last byte before a marker are ones, as must be."""
    # Correct data end in ones. Where the decoder lost its place, the bits are arbitrary.
    last = data[end - 1]
    if data[end - 2 : end] == b"\xff\x00" or last == 0xFF:
        return True
    filled = last | (last + 1)  # the lowest zero becomes one
    changed = data[: end - 1] + bytes([filled]) + b"\x00" * (filled == 0xFF) + data[end:]
    # If the lowest zero is data, setting it to one changes the picture. Filling would not.
    pixels, complaint = _decoded_strictly(data)
    changed_pixels, changed_complaint = _decoded_strictly(changed)
    return complaint != changed_complaint or not np.array_equal(pixels, changed_pixels)  # type: ignore


# LAS


def read_las(path: Path) -> Any:
    """Return all points of a LAS or LAZ file as `laspy.LasData`. Raise InputError if damaged."""
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
    # Offset of the points, number of records, point format, bytes per point, number of points
    begin, num_records, kind, num_bytes, num_points = struct.unpack_from("<IIBHI", data, 96)
    if data[25] >= 4:  # LAS 1.4: number of extended records, number of points
        num_late, num_points = struct.unpack_from("<IQ", data, 243)
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


# Letter of a kind -> words for messages, and kinds of NumPy types (a text) or names of Arrow types
_KINDS = {
    "n": ("finite numbers", "iuf"),
    "m": ("numbers", "iuf"),
    "i": ("whole numbers", "iu"),
    "t": ("truth values", "b"),
    "s": ("texts", ("string", "large_string")),
    "b": ("bytes", ("binary", "large_binary")),
    "l": ("lists of numbers", ("float", "double", "int")),
}


def read_arrow(
    path: Path,
    columns: Mapping[str, str],
    data_set: tuple[str, str],
    where: Mapping[str, int] | None = None,
) -> dict[str, NDArray[Any]]:
    """Return columns (N,) of a feather or parquet file by name.

    Args:
        path: File whose suffix is .feather or .parquet.
        columns: Name of a column -> its kind: "n" finite numbers, "m" numbers or NaN, "i" integers,
            "s" strings, "b" bytes, "t" booleans, "l" lists of numbers (an object array of arrays or
            None).
        data_set: Extra that installs pyarrow, and the name of the recordings for messages.
        where: Name of a column -> value that the rows to read have there, for a parquet file; None
            for all rows.

    Raises:
        InputError: The file is missing or damaged, or a column is missing or of another kind.
    """
    import_extra("pyarrow", *data_set)
    is_feather = path.suffix == ".feather"
    library = import_extra("pyarrow.feather" if is_feather else "pyarrow.parquet", *data_set)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected the columns {', '.join(columns)} in it")
    open_file(path).close()  # raises a clearer error if the file cannot be opened
    try:
        if is_feather:
            table = library.read_table(path, memory_map=False)
        else:
            present = [name for name in columns if name in library.read_schema(path).names]
            filters = [(name, "=", value) for name, value in (where or {}).items()]
            table = library.read_table(path, columns=present, filters=filters or None)
        names = table.column_names
        table.validate(full=True)  # offsets in a damaged column may lie outside the file
    except Exception as error:  # a damaged schema raises anything
        kind = path.suffix.removeprefix(".")
        raise InputError(
            f"{path}: not a whole {kind} file ({reason(error)}); fetch it again"
        ) from error
    absent = [name for name in columns if name not in names]
    if absent:
        raise InputError(f"{path}: no column {', '.join(absent)}; got {', '.join(names) or 'none'}")
    return {
        name: _arrow_array(table[name], kind, f"{path}: {name}") for name, kind in columns.items()
    }


def _arrow_array(column: Any, kind: str, where: str) -> NDArray[Any]:
    """Return a column of Arrow as an array. Raise InputError if it is not of the kind."""
    expected, types = _KINDS[kind]
    type_name = str(column.type)
    num_null = column.null_count
    num_not_finite = 0
    if kind == "l":  # each row has a list of its own length
        if "list" in type_name and any(name in type_name for name in types):
            lists = np.empty(len(column), object)
            for row, scalar in enumerate(column):
                values = scalar.values
                lists[row] = None if values is None else values.to_numpy(zero_copy_only=False)
            return lists
    elif isinstance(types, str) or type_name in types:
        array = np.asarray(column.to_numpy())
        if kind == "n" and array.dtype.kind == "f":
            num_not_finite = int((~np.isfinite(array)).sum())
        fits = isinstance(types, tuple) or array.dtype.kind in types
        if fits and not num_null and not num_not_finite:
            return array
    got = f"{type_name}, {num_null} of them missing" if num_null else type_name
    got += f", {num_not_finite} not finite" if num_not_finite else ""
    raise InputError(f"{where}: got {got}, expected {expected}")


# Pickles

_PACKAGES = ("pandas", "numpy")  # whose names a pickled data frame needs, besides slice
_NUMBERS = re.compile(r"[fiu][1248]|b1")


class _Record:
    """Store the constructor arguments and the state of a pickled object, without making it."""

    args: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *args: Any) -> _Record:
        record = super().__new__(cls)
        record.args = args
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle._Unpickler):
    """Unpickle in pure Python, where a damaged file cannot read outside its buffers."""

    def find_class(self, module: str, name: str) -> type[_Record]:
        is_slice = (module, name) == ("builtins", "slice")
        if module.partition(".")[0] not in _PACKAGES and not is_slice:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return type(name, (_Record,), {})


def read_pickled(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns (N,) of a gzipped, pickled pandas data frame, by name.

    No code of the file is run. A column of texts holds Python objects, whose type the caller must
    check. Raise InputError if the file is no such data frame.
    """
    data = read_bytes(path)
    try:
        return _pickled_columns(_Unpickler(io.BytesIO(gunzip(data, path))).load())
    except Exception as error:  # a damaged file can raise any type
        raise InputError(
            f"{path}: not a gzipped pandas data frame of numbers and texts ({reason(error)}); "
            f"nothing in it was run; fetch the file again from where the data set is published"
        ) from error


def _pickled_columns(frame: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of a frame, of which pandas stores those of one type as (C,N)."""
    if type(frame).__name__ != "DataFrame":
        raise ValueError(f"it holds a {type(frame).__name__}")
    manager_state = frame.state["_data"].state[-1]["0.14.1"]
    names = manager_state["axes"][0].args[1]["data"].state[-1]
    columns: dict[str, NDArray[Any]] = {}
    for block in manager_state["blocks"]:
        values = _pickled_array(block["values"])
        # Numbers of the block's columns in the frame, as a slice or an array
        placement = block["mgr_locs"]
        is_slice = type(placement).__name__ == "slice"
        numbers = range(*placement.args) if is_slice else _pickled_array(placement).tolist()
        columns |= {str(names[number]): row for number, row in zip(numbers, values, strict=True)}
    return columns


def _pickled_array(record: _Record) -> NDArray[Any]:
    """Rebuild a NumPy array from the stored state of its pickle."""
    _, shape, dtype, by_columns, data = record.state  # as ndarray.__setstate__ takes them
    kind, order = dtype.args[0], dtype.state[1]
    if kind == "O8" and isinstance(data, list):
        array: NDArray[Any] = np.empty(len(data), object)
        array[:] = data
    elif _NUMBERS.fullmatch(kind):
        array = np.frombuffer(data, np.dtype(kind).newbyteorder(order))
    else:
        raise ValueError(f"a column of the kind {kind!r}")
    return array.reshape(shape, order="F" if by_columns else "C")
