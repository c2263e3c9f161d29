# SPDX-License-Identifier: MIT
"""The output of what was left out: a picture for each camera, where it is asked for."""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.context import Context
from densify.outputs.figure import draw_rejected
from densify.outputs.png import write_picture


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``rejected/CAMERA.png``."""
    for camera, reason in result.rejected.items():
        (folder / "rejected" / camera).parent.mkdir(parents=True, exist_ok=True)
        picture = draw_rejected(context.image(camera, reason.shape), reason)
        write_picture(folder / "rejected" / f"{camera}.png", picture)
