# SPDX-License-Identifier: MIT
"""The cloud as PCD 0.7 of the Point Cloud Library, binary."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun


def write_export(run: FinishedRun, folder: Path) -> None:
    """``cloud.pcd``: every column of cloud.laz, `StoredCloud.columns`; the colour as the library
    has it, ``rgb``, three bytes in one float."""
    from pypcd4 import Encoding, PointCloud

    columns = run.cloud().columns()
    rgb = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    columns["rgb"] = PointCloud.encode_rgb(rgb)
    kinds = [column.dtype.type for column in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), kinds)
    buffer = io.BytesIO()
    cloud.save(buffer, Encoding.BINARY)
    write_file(folder / "cloud.pcd", buffer.getvalue())
