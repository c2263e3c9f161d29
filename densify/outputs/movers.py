# SPDX-License-Identifier: MIT
"""The output of moving objects: cloud and depth of each by itself, where they are separated."""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.cloud_laz import write_cloud
from densify.outputs.context import Context
from densify.outputs.depth_png import write_depth_png


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``movers/0007/`` for instance 7, ``movers/others/`` for what moves without one."""
    for instance, mover in result.movers.items():
        apart = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
        apart.mkdir(parents=True)
        for name, maps in mover.depth.items():
            (apart / "depth" / name).parent.mkdir(parents=True, exist_ok=True)
            write_depth_png(apart / "depth" / f"{name}.png", maps.depth_m)
        write_cloud(apart / "cloud.laz", mover.cloud, result.stamp_ns)
