# SPDX-License-Identifier: MIT
"""The output of depth: ``depth``, ``depth_filled``, ``confidence`` and ``age``, a PNG each for
every camera, or for every image as ``CAMERA/NUMBER.png`` (``project.per=image``).

``age/CAMERA.png`` holds, as 16 bit, milliseconds between the camera's exposure and the sweep that
measured the pixel, plus 1; 0 is no depth, and 65535 says 65.5 s or more. It covers the pixels of
``depth_filled``; filled ones have the age of the nearest measured pixel.
"""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.context import Context
from densify.outputs.depth_png import write_age_png, write_confidence_png, write_depth_png


def write_output(result: Result, context: Context, folder: Path) -> None:
    """See `densify.outputs.store.OutputModule`. Raises ValueError for maps without ages."""
    for camera, depth in result.depth.items():
        if depth.age_s is None:
            raise ValueError(f"depth map of {camera}: expected ages, see densify.depth.age")
        for product in ("depth", "depth_filled", "confidence", "age"):
            (folder / product / camera).parent.mkdir(parents=True, exist_ok=True)
        name = f"{camera}.png"
        write_depth_png(folder / "depth" / name, depth.depth_m)
        write_depth_png(folder / "depth_filled" / name, depth.filled_m)
        write_confidence_png(folder / "confidence" / name, depth.confidence, depth.filled_m)
        write_age_png(folder / "age" / name, depth.age_s, depth.filled_m)
