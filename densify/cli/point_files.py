# SPDX-License-Identifier: MIT
"""Point files for ``densify flow``: reading the two clouds, writing the flow between them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Float, FlowField, Int
from densify.readers.point_files import read_table


@dataclass(frozen=True)
class PointFile:
    """points: (N,3) float64 metres. offset_ns: (N,) int64 when each was measured, lidar: (N,) int64
    which scanner did; None where the file does not say."""

    points: Float
    offset_ns: Int | None = None
    lidar: Int | None = None


def read_points(path: Path) -> PointFile:
    """Every row of the file in its order: any format of `densify.readers.point_files`.

    An .npz file may hold, beside ``points``, ``offset_ns`` or ``time`` (seconds) and ``lidar``,
    (N,) each. Raises InputError if the file is missing, has another form, or holds no point or one
    that is not finite (rows are not dropped: the flow lines up with them).
    """
    table = read_table(path)
    for name in "xyz":
        if name not in table.columns:
            raise InputError(
                f"{path}: no column {name}: got {', '.join(table.columns)}, expected x, y and z"
            )
    points = np.column_stack([table.columns[name].astype(np.float64) for name in "xyz"])
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of {len(points)} points are not finite, the first in row "
            f"{bad[0]}; remove them"
        )
    names = ["offset_ns" if "offset_ns" in table.beside else "time", "lidar"]
    beside = {name: table.beside[name] for name in names if name in table.beside}
    return PointFile(points, **_columns(path, beside, len(points)))


def check_new_file(
    path: Path, overwrite: bool, suffix: str = ".npz", option: str = "--out"
) -> None:
    """Raise InputError, before the computation, if ``path`` is there already or cannot be made."""
    if path.suffix != suffix:
        raise InputError(f"{option} {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder, expected the name of a {suffix} file")
    if path.exists() and not overwrite:
        raise InputError(
            f"{option} {path}: already there and kept; give --overwrite or another name"
        )
    place = path.parent
    while not os.path.lexists(place):
        place = place.parent
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise InputError(f"{option} {path}: cannot write in {place}; choose another")


def write_flow(path: Path, field: FlowField) -> None:
    """Write `densify.outputs.flow_writers.flow_npz`, row by row as the source file.
    Appears only when complete.

    Raises InputError if it cannot be written.
    """
    from densify.outputs.atomic import write_file
    from densify.outputs.flow_writers import flow_npz

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
