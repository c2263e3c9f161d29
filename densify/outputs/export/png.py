# SPDX-License-Identifier: MIT
"""The maps as the run has them: depth, depth_filled, confidence and age, PNG."""

from __future__ import annotations

from pathlib import Path

from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.png import encode_png


def write_export(run: FinishedRun, folder: Path) -> None:
    """``depth/CAMERA.png`` and so on, see `densify.outputs.depth_maps`."""
    for camera in run.cameras:
        for product, stored in run.maps(camera).items():
            path = folder / product / f"{camera}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, encode_png(stored))
