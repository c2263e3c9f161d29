# SPDX-License-Identifier: MIT
"""The cloud as PLY (Turk, "The PLY Polygon File Format", 1994) and as PCD 0.7 of the Point Cloud
Library, binary, with every column of cloud.laz (`StoredCloud.columns`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import table
from densify.outputs.export.finished_run import FinishedRun

_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_ply(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.ply``."""
    save_ply(folder / "cloud.ply", run.cloud().columns())


def save_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write vertices, little-endian. columns: (N,) float32, float64, int32 or uint8 each."""
    rows = table(columns)
    rows = rows.astype(rows.dtype.newbyteorder("<"), copy=False)
    kinds = {name: _TYPES[rows.dtype[name].str.lstrip("<|")] for name in columns}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment densify, metres",
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        "end_header",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + b"\n" + rows.tobytes())


def write_pcd(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.pcd``. The colour is the column ``rgb``, three bytes packed into a float."""
    from pypcd4 import Encoding, PointCloud

    columns = run.cloud().columns()
    rgb = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    columns["rgb"] = PointCloud.encode_rgb(rgb)
    kinds = [column.dtype.type for column in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), kinds)
    cloud.save(folder / "cloud.pcd", Encoding.BINARY)
