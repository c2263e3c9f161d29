# SPDX-License-Identifier: MIT
"""Maps as TIFF of one channel of 32-bit floating-point numbers."""

from __future__ import annotations

from pathlib import Path

import cv2

from densify.geometry.types import Float32
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.float_maps import write_maps

_DEFLATE = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE]


def write_export(run: FinishedRun, folder: Path) -> None:
    """``depth/CAMERA.tiff`` and so on, see `write_maps`."""
    write_maps(run, folder, ".tiff", _write)


def _write(path: Path, values: Float32) -> None:
    done, data = cv2.imencode(".tiff", values, _DEFLATE)
    if not done:
        raise ValueError(f"{path.name}: an image of shape {values.shape} cannot be written as TIFF")
    write_file(path, data.tobytes())
