# SPDX-License-Identifier: MIT
"""Point files for ``densify flow``: reading the two clouds, writing the flow between them."""

from __future__ import annotations

import os
import tokenize
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from densify.errors import InputError
from densify.types import Float, FlowField, Int

_SUFFIXES = (".npy", ".npz", ".txt", ".bin")
_KITTI_ROW_BYTES = 16
# What numpy raises on damaged files; a flipped bit can ask zipfile for a password (RuntimeError).
_DAMAGE = (
    *(OSError, ValueError, EOFError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


@dataclass(frozen=True)
class PointFile:
    """points: (N,3) float64 metres. offset_ns: (N,) int64 when each was measured, lidar: (N,) int64
    which scanner did; None where the file does not say."""

    points: Float
    offset_ns: Int | None = None
    lidar: Int | None = None


def read_points(path: Path) -> PointFile:
    """Every row of the file in its order.

    .npy: (N,3 or more columns); .npz: the same as array ``points``, and beside it where there is
    ``offset_ns`` or ``time`` (seconds) and ``lidar``, (N,) each; .txt: columns; .bin: KITTI's
    float32 x y z reflectance. Raises InputError if the file is missing, has another form, or holds
    no point or one that is not finite (rows are not dropped: the flow lines up with them).
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a point file ({', '.join(_SUFFIXES)})")
    if path.suffix not in _SUFFIXES:
        raise InputError(
            f"{path}: got {path.suffix or 'no suffix'}, expected one of {', '.join(_SUFFIXES)}"
        )
    try:
        array, beside = _read_arrays(path)
    except _DAMAGE as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a readable {path.suffix} point file: {reason}") from error
    if array.size == 0:
        raise InputError(f"{path}: holds no points, expected at least one")
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: got an array of shape {array.shape} and type {array.dtype}, expected numbers "
            f"of shape (N,3) or more columns"
        )
    points = array[:, :3].astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of {len(points)} points are not finite, the first in row "
            f"{bad[0]}; remove them"
        )
    return PointFile(points, **_columns(path, beside, len(points)))


def check_new_file(path: Path, overwrite: bool, suffix: str = ".npz") -> None:
    """Raise InputError, before the computation, if ``path`` is there already or cannot be made."""
    if path.suffix != suffix:
        raise InputError(f"--out {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder, expected the name of a {suffix} file")
    if path.exists() and not overwrite:
        raise InputError(f"--out {path}: already there and kept; give --overwrite or another name")
    place = path.parent
    while not os.path.lexists(place):
        place = place.parent
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise InputError(f"--out {path}: cannot write in {place}; choose another --out")


def write_flow(path: Path, field: FlowField) -> None:
    """Write the flow as `densify.outputs.flow_npz.flow_npz` does, row by row as the source file.
    Appears only when complete.

    Raises InputError if it cannot be written.
    """
    from densify.outputs.atomic import write_file
    from densify.outputs.flow_npz import flow_npz

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, flow_npz(field))
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written: {error.strerror or error}") from error


def _columns(path: Path, beside: dict[str, NDArray[Any]], num_points: int) -> dict[str, Int]:
    columns = {}
    for name, array in beside.items():
        kinds = "iuf" if name == "time" else "iu"
        if (
            array.shape != (num_points,)
            or array.dtype.kind not in kinds
            or not np.isfinite(array).all()
        ):
            raise InputError(
                f"{path}: array {name}: got shape {array.shape} and type {array.dtype}, expected "
                f"({num_points},) {'seconds' if name == 'time' else 'whole numbers'}, one for each "
                f"point"
            )
        if name == "time":
            columns["offset_ns"] = np.rint(array * 1e9).astype(np.int64)
        else:
            columns[name] = array.astype(np.int64)
    return columns


def _read_arrays(path: Path) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    """The points, and what an .npz file holds beside them; ``time`` only without ``offset_ns``."""
    if path.suffix == ".txt":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file is refused in our words
            return np.loadtxt(path, ndmin=2), {}
    if path.suffix == ".bin":
        num_bytes = path.stat().st_size
        if num_bytes % _KITTI_ROW_BYTES:
            raise ValueError(
                f"got {num_bytes} bytes, expected a multiple of {_KITTI_ROW_BYTES}; it is cut off"
            )
        return np.fromfile(path, np.float32).reshape(-1, 4), {}
    loaded = np.load(path, allow_pickle=False)
    if not isinstance(loaded, NpzFile):
        if path.suffix == ".npz":
            raise ValueError("holds a single array; name it .npy")
        array: NDArray[Any] = loaded
        return array, {}
    with loaded as arrays:
        if path.suffix == ".npy":
            raise ValueError("holds an archive of arrays; name it .npz")
        if "points" not in arrays:
            raise ValueError(f"holds the arrays {', '.join(arrays)}, expected points")
        names = ["offset_ns" if "offset_ns" in arrays else "time", "lidar"]
        return arrays["points"], {name: arrays[name] for name in names if name in arrays}
