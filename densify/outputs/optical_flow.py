# SPDX-License-Identifier: MIT
"""The output of optical flow: to the previous and the next image, where it is asked for."""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.context import Context
from densify.outputs.depth_png import write_flow_png


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``optical_flow/previous/CAMERA.png`` and ``optical_flow/next/CAMERA.png``."""
    for camera, flows in result.optical_flow.items():
        for other, flow_px in flows.items():
            (folder / "optical_flow" / other / camera).parent.mkdir(parents=True, exist_ok=True)
            write_flow_png(folder / "optical_flow" / other / f"{camera}.png", flow_px)
