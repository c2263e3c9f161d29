# SPDX-License-Identifier: MIT
"""Read the columns of point files; no content of a file is run as code."""

from __future__ import annotations

import codecs
import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import check_size, decode_text, import_extra, read_bytes, reason
from densify.readers.decoded_files import read_array, read_arrays, read_las

Columns = dict[str, NDArray[Any]]

_UNNAMED = ("x", "y", "z", "intensity")  # KITTI's order, which most data sets follow
_ALIKE = 0.5  # largest median step between scanned rows, as a share of the coordinates
_FEWEST_ROWS = 20  # least number of rows for the test by this step
_NAME_COLUMNS = (
    "name all of them in densify.yaml beside the sweeps' folder, such as "
    "sweeps: {columns: [x, y, z, intensity, time]}"
)
_MOST_COLUMNS = 100  # a wider array is probably transposed
_MOST_ORGANISED = 16  # values of a point in an organised array; more may be its width
_ROWS_LOOKED_AT = 4000
_BIN_LAYOUTS = {
    4: _UNNAMED,
    5: (*_UNNAMED, "ring"),  # nuScenes
    6: (*_UNNAMED, "elongation", "timestamp"),  # Waymo, as mmdetection3d writes it
}
_MOST_RINGS, _MOST_ELONGATION, _MOST_ASCENDING = 256, 2.0, 0.9


def read_table(path: Path, names: Sequence[str] | None = None) -> Columns:
    """Return the columns (N,) of a point file, as stored, in file order.

    ``names`` are the names of the columns in .bin, .csv, .txt and unstructured arrays. None takes
    the names of the first line, or x, y, z, intensity, column4, column5 and so on. Raise InputError
    if the file is damaged or holds no points.

    .bin        float32 columns. Without ``names``, those of KITTI, nuScenes or Waymo if size and
                values fit one of them
    .npy, .npz  an (N,3 or more) array, called ``points`` in an .npz, or organised (H,W,3 or more),
                or structured, or an .npz of x, y, z. Other arrays (N,) of an .npz are columns too
    .csv, .txt  numbers, NaN where blank. A first line of words names the columns
    .pcd        ascii, binary, binary_compressed
    .ply        properties of its vertices (extra ``ply``)
    .las, .laz  dimensions
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: got {path.suffix or 'no suffix'}, expected one of {', '.join(SUFFIXES)}"
        )
    try:
        columns = _READERS[suffix](path, names)
    except InputError:
        raise
    except Exception as error:  # parsers raise anything on a damaged file
        said = f"it has no {error}" if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{path}: not a readable {suffix} point file: {said}") from error
    if not len(next(iter(columns.values()), ())):
        raise InputError(f"{path}: holds no points, expected at least one")
    return columns


def _matrix(array: NDArray[Any], names: Sequence[str] | None, path: Path) -> Columns:
    """Return the k columns of an (N,k) array, or the fields of a structured array, by name."""
    fields = array.dtype.names
    if fields and array.ndim in (1, 2):
        array = array.ravel()
        return {name: array[name] for name in fields if array[name].ndim == 1}
    if array.size == 0:
        return {}
    if array.ndim == 3 and array.shape[2] <= _MOST_ORGANISED:  # (H,W,C): rings, columns, values
        array = array.reshape(-1, array.shape[2])
    fits = array.ndim == 2 and 3 <= array.shape[1] <= _MOST_COLUMNS
    if not fits or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: got an array of shape {array.shape} and type {array.dtype}, expected numbers "
            f"of shape (N,3) or more columns, {_MOST_COLUMNS} at most"
        )
    num_columns = array.shape[1]
    if names is None:
        names = [*_UNNAMED, *(f"column{number}" for number in range(4, num_columns))][:num_columns]
    if len(names) != num_columns:
        raise InputError(
            f"{path}: got {num_columns} columns, expected {len(names)}: {' '.join(names)}"
        )
    return {name: array[:, column] for column, name in enumerate(names)}


def _read_bin(path: Path, names: Sequence[str] | None) -> Columns:
    """Read float32 columns of the named columns, or of the known layout that fits."""
    data = read_bytes(path)
    if names is None:
        fitting = [known for num, known in _BIN_LAYOUTS.items() if _fits(data, num)]
        if len(fitting) > 1:
            counts = " and ".join(str(len(known)) for known in fitting)
            raise ValueError(f"it fits {counts} float32 columns alike; {_NAME_COLUMNS}")
        names = fitting[0] if fitting else None
    num_columns = len(_UNNAMED) if names is None else len(names)
    if len(data) % (4 * num_columns):
        raise ValueError(
            f"got {len(data)} bytes, expected a multiple of {4 * num_columns} "
            f"({num_columns} float32 columns); it is cut off, or has other columns: {_NAME_COLUMNS}"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, num_columns)
    if names is None and not _are_scanned(rows[:_ROWS_LOOKED_AT, :3]):
        raise ValueError(
            "read as rows of 4 little-endian float32 columns, neighbouring points are not alike; "
            f"if it has other columns, {_NAME_COLUMNS}"
        )
    return _matrix(rows, names, path)


def _fits(data: bytes, num_columns: int) -> bool:
    """Return True if the size and values of .bin data fit the layout of this many columns."""
    if len(data) % (4 * num_columns):
        return False
    rows = np.frombuffer(data, "<f4").reshape(-1, num_columns)[:_ROWS_LOOKED_AT]
    if len(rows) < _FEWEST_ROWS or not _are_scanned(rows[:, :3]):
        return False
    with np.errstate(invalid="ignore"):
        if num_columns > 4 and not (np.isfinite(rows[:, 3:]) & (rows[:, 3:] >= 0)).all():
            return False
        if num_columns == 5:
            return bool(((rows[:, 4] % 1 == 0) & (rows[:, 4] < _MOST_RINGS)).all())
        if num_columns == 6:  # column 4 may be a time of another layout, but times ascend
            ascending = np.mean(np.diff(rows[:, 4]) >= 0)
            return bool(rows[:, 4].max() < _MOST_ELONGATION and ascending < _MOST_ASCENDING)
    return True


def _are_scanned(points: NDArray[Any]) -> bool:
    """Return True if consecutive (N,3) points are close to each other, because a scan is."""
    # Rows read with a wrong number of columns mix x with y, and their points lie far apart.
    with np.errstate(invalid="ignore"):  # wrongly read bytes may be signalling NaN
        finite = np.nan_to_num(points.astype(np.float64), posinf=0, neginf=0)
    step = np.abs(np.diff(finite, axis=0)).sum(axis=1)
    size = np.abs(finite).sum(axis=1)
    share = step / (size[1:] + size[:-1] + 1e-9)
    return len(finite) < _FEWEST_ROWS or 0 < np.median(share) < _ALIKE


def _read_npy(path: Path, names: Sequence[str] | None) -> Columns:
    """Read a .npy or .npz file."""
    if path.suffix.lower() == ".npy":
        return _matrix(read_array(path), names, path)
    arrays = read_arrays(path)
    if "points" in arrays:
        columns = _matrix(arrays.pop("points"), names, path)
        shape = next(iter(columns.values()), np.zeros(0)).shape
    elif {"x", "y", "z"} <= arrays.keys():
        columns, shape = {}, arrays["x"].shape
        if len(shape) != 1 or any(arrays[axis].shape != shape for axis in "yz"):
            raise ValueError("the arrays x, y and z have other shapes than (N,)")
    else:
        raise ValueError(f"holds the arrays {', '.join(arrays)}, expected points, or x, y and z")
    beside = {name: array for name, array in arrays.items() if array.shape == shape}
    return columns | {name: array for name, array in beside.items() if array.dtype.kind in "fiu"}


def _read_text(path: Path, names: Sequence[str] | None) -> Columns:
    """Read a .csv or .txt file."""
    lines = decode_text(read_bytes(path), path).splitlines()
    skip, words, delimiter = _header(lines)
    rows = lines[skip:]
    if delimiter:
        blank = re.compile(f"(^|{delimiter}) *(?={delimiter}|$)")
        rows = [blank.sub(r"\1nan", line) if line.strip() else "" for line in rows]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty file is refused in our words
        try:
            array = np.loadtxt(rows, delimiter=delimiter, ndmin=2)
        except ValueError as error:
            raise ValueError(str(error).partition("; use ")[0]) from None
    if words and names is None:
        if not _names_axes(words):
            line = lines[skip - 1][:60]
            raise ValueError(f"got the first line {line!r}, expected names such as x,y,z")
        names = words
    return _matrix(array, names, path)


def _header(lines: Sequence[str]) -> tuple[int, list[str], str | None]:
    """Return the number of header lines, the column names and the delimiter (None: whitespace)."""
    for number, line in enumerate(lines, 1):
        text = line.strip().lstrip("#").strip()
        if not text:
            continue
        delimiter = next((d for d in (";", "\t", ",") if d in text), None)
        words = [word.strip().strip('"') for word in text.split(delimiter)]
        if _are_numbers(words):
            return number - 1, [], delimiter
        if not line.strip().startswith("#") or _names_axes(words):
            return number, words, delimiter
    return len(lines), [], None


def _names_axes(words: Sequence[str]) -> bool:
    return any(word.lower() in ("x", "y", "z") for word in words)


def _are_numbers(words: Sequence[str]) -> bool:
    try:
        return bool([float(word) for word in words if word])
    except ValueError:
        return False


def _pcd_header(file: Any) -> list[str]:
    """Read a .pcd header up to DATA, and return its lines as the parser expects them."""
    # The parser knows no padding fields (COUNT 0) and no defaults of optional lines.
    table: dict[str, list[str]] = {}
    while "DATA" not in table and len(table) < 20:
        raw = file.readline(65536)
        if not raw:
            raise ValueError("the header ends before DATA; it is cut off")
        words = raw.decode("ascii").split()
        if words and not words[0].startswith("#"):
            table[words[0]] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA") if not table.get(key)]
    if missing:
        raise ValueError(f"the header has no {', '.join(missing)}")
    table = {
        "VERSION": ["0.7"],
        "HEIGHT": ["1"],
        "COUNT": ["1"] * len(table["FIELDS"]),
        "POINTS": [str(int(table["WIDTH"][0]) * int(table.get("HEIGHT", ["1"])[0]))],
        **table,
    }
    per_field = ("FIELDS", "SIZE", "TYPE", "COUNT")
    if len({len(table[key]) for key in per_field}) != 1:
        raise ValueError(
            "the header names " + ", ".join(f"{len(table[key])} {key}" for key in per_field)
        )
    if not all(re.fullmatch(r"[0-9]{1,4}", count) for count in table["COUNT"]):
        raise ValueError("COUNT: expected a small whole number for each field")
    kept = [i for i, count in enumerate(table["COUNT"]) if count != "0"]
    table |= {key: [table[key][i] for i in kept] for key in per_field}
    data = table.pop("DATA")
    return [f"{key} {' '.join(values)}" for key, values in table.items()] + [f"DATA {data[0]}"]


def _read_pcd(path: Path, names: Sequence[str] | None) -> Columns:
    """Read a .pcd file."""
    from pypcd4 import PointCloud

    file = io.BytesIO(read_bytes(path).removeprefix(codecs.BOM_UTF8))
    header = _pcd_header(file)
    body = file.read()
    if header[-1] == "DATA ascii":  # one blank between numbers, none at the end
        body = b"\n".join(b" ".join(line.split()) for line in body.splitlines())
    if header[-1] == "DATA binary_compressed":
        if len(body) < 8:
            raise ValueError("it ends where its points should begin; it is cut off")
        check_size(int.from_bytes(body[4:8], "little"), path)
    cloud = PointCloud.from_fileobj(
        io.BytesIO("\n".join(header).encode() + b"\n" + body)  # type: ignore[arg-type]
    )
    rows = np.atleast_1d(cloud.pc_data)
    if len(rows) != cloud.points:
        raise ValueError(
            f"got {len(rows)} points, expected {cloud.points} as its header says; it is cut off"
        )
    return {name: rows[name] for name in rows.dtype.names or () if not name.startswith("#")}


def _read_ply(path: Path, names: Sequence[str] | None) -> Columns:
    """Read the vertices of a .ply file."""
    ply = import_extra("trimesh.exchange.ply", "ply", ".ply files")
    file = io.BytesIO(read_bytes(path).removeprefix(codecs.BOM_UTF8))
    vertex = ply.load_ply(file)["metadata"]["_ply_raw"]["vertex"]
    names = [name for name, kind in vertex["properties"].items() if "LIST" not in kind]
    columns = {name: np.ravel(vertex["data"][name]) for name in names}
    if any(len(column) != vertex["length"] for column in columns.values()):
        raise ValueError(f"holds fewer than the {vertex['length']} vertices of its header")
    if any(column.dtype.kind not in "fiub" for column in columns.values()):
        raise ValueError("its vertices are no numbers")
    return columns


def _read_las(path: Path, names: Sequence[str] | None) -> Columns:
    """Read the dimensions of a .las or .laz file."""
    cloud = read_las(path)
    coordinates = {axis: np.asarray(getattr(cloud, axis)) for axis in "xyz"}
    attributes = [n for n in cloud.point_format.dimension_names if n not in ("X", "Y", "Z")]
    return coordinates | {name: np.asarray(cloud[name]) for name in attributes}


_READERS: Mapping[str, Callable[[Path, Sequence[str] | None], Columns]] = {
    ".pcd": _read_pcd,
    ".bin": _read_bin,
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
    ".npy": _read_npy,
    ".npz": _read_npy,
    ".txt": _read_text,
    ".csv": _read_text,
}

SUFFIXES = tuple(_READERS)
"""Suffixes of point files; suffixes that only point files have come first."""
