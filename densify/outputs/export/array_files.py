# SPDX-License-Identifier: MIT
"""Maps as floating-point arrays, .npy and OpenEXR: ``depth`` and ``depth_filled`` in metres, 0
none, and ``confidence``, 0 to 1, with a file for each camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float32
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.map_outputs import map_path
from densify.readers.extras import needed


def write_npy(run: FinishedRun, folder: Path) -> None:
    """Write (H,W) float32 arrays."""
    for kind, camera, values in _maps(run):
        np.save(map_path(folder, kind, camera, ".npy"), values, allow_pickle=False)


def write_exr(run: FinishedRun, folder: Path) -> None:
    """Write OpenEXR files of one 32-bit channel, ``Z`` of depth and ``Y`` of confidence, without
    loss. Raises InputError without OpenEXR."""
    library = needed("OpenEXR", "exr", "EXR files")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    for kind, camera, values in _maps(run):
        channel = "Y" if kind == "confidence" else "Z"
        library.File(header, {channel: values}).write(str(map_path(folder, kind, camera, ".exr")))


def metres(stored: NDArray[Any]) -> Float32:
    """Return (H,W) float32 metres of a stored depth map, exact to the last bit."""
    return stored.astype(np.float32) / np.float32(256)


def _maps(run: FinishedRun) -> Iterator[tuple[str, str, Float32]]:
    for camera in run.cameras:
        maps = run.maps(camera)
        yield "depth", camera, metres(maps["depth"])
        yield "depth_filled", camera, metres(maps["depth_filled"])
        steps = np.maximum(maps["confidence"].astype(np.float32) - 1, 0)
        yield "confidence", camera, steps / np.float32(254)
