# SPDX-License-Identifier: MIT
"""The output of depth completed with the user's prior: ``depth_full``, and ``confidence_full``,
in which the prior's pixels have 0.2 (52 as it is stored) at most and all others more; a PNG each
for every map."""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.context import Context
from densify.outputs.depth_png import write_confidence_png, write_depth_png


def write_output(result: Result, context: Context, folder: Path) -> None:
    """See `densify.outputs.store.OutputModule`."""
    for camera, full in result.full.items():
        for product in ("depth_full", "confidence_full"):
            (folder / product / camera).parent.mkdir(parents=True, exist_ok=True)
        name = f"{camera}.png"
        write_depth_png(folder / "depth_full" / name, full.depth_m)
        write_confidence_png(folder / "confidence_full" / name, full.confidence, full.depth_m)
