# SPDX-License-Identifier: MIT
"""Maps as arrays of numpy."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from densify.geometry.types import Float32
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.float_maps import write_maps


def write_export(run: FinishedRun, folder: Path) -> None:
    """``depth/CAMERA.npy`` and so on, (H,W) float32, see `write_maps`."""
    write_maps(run, folder, ".npy", write_array)


def write_array(path: Path, values: Float32) -> None:
    """Write an array as .npy."""
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    write_file(path, buffer.getvalue())
