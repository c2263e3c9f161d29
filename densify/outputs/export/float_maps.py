# SPDX-License-Identifier: MIT
"""Maps as plain numbers, one file each, whatever the file's format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float32
from densify.outputs.export.finished_run import FinishedRun


def write_maps(run: FinishedRun, folder: Path, suffix: str, write: Callable[..., None]) -> None:
    """``depth`` and ``depth_filled`` (metres, 0 none) and ``confidence`` (0 to 1, 0 too where there
    is no depth), ``CAMERA`` and suffix each. write: called with the path and (H,W) float32."""
    for camera in run.cameras:
        maps = run.maps(camera)
        for product, values in (
            ("depth", depth_m(maps["depth"])),
            ("depth_filled", depth_m(maps["depth_filled"])),
            ("confidence", _confidence(maps["confidence"])),
        ):
            path = folder / product / f"{camera}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path, values)


def depth_m(stored: NDArray[Any]) -> Float32:
    """(H,W) float32 metres of a stored depth map, to the last bit."""
    return stored.astype(np.float32) / np.float32(256)


def _confidence(stored: NDArray[Any]) -> Float32:
    return np.maximum(stored.astype(np.float32) - 1, 0) / np.float32(254)
