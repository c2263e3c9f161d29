# SPDX-License-Identifier: MIT
"""The cloud as PLY (Turk, "The PLY Polygon File Format", 1994), binary little-endian."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from densify.geometry.arrays import table
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun

_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_export(run: FinishedRun, folder: Path) -> None:
    """``cloud.ply``: vertices with every column of cloud.laz, `StoredCloud.columns`."""
    write_ply(folder / "cloud.ply", run.cloud().columns())


def write_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write vertices of M rows. columns: (M,) float32, float64, int32 or uint8 each, by name."""
    rows = table({name: column.astype(column.dtype.newbyteorder("<"), copy=False)
                  for name, column in columns.items()})  # fmt: skip
    kinds = {name: _TYPES[rows.dtype[name].str.lstrip("<|")] for name in columns}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment densify, metres",
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        "end_header",
    ]
    write_file(path, "\n".join(header).encode("ascii") + b"\n" + rows.tobytes())
