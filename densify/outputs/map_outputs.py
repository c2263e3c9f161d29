# SPDX-License-Identifier: MIT
"""The outputs that are maps of a camera, a PNG each, and the moving objects by themselves.

A map of one image of several (``project.per=image``) is named ``CAMERA/NUMBER.png``.
"""

from __future__ import annotations

from pathlib import Path

from densify.geometry.types import Result
from densify.outputs.cloud_laz import write_cloud
from densify.outputs.context import Context
from densify.outputs.depth_png import (
    write_age_png,
    write_confidence_png,
    write_depth_png,
    write_flow_png,
)


def write_depth(result: Result, context: Context, folder: Path) -> None:
    """Write ``depth``, ``depth_filled``, ``confidence`` and ``age``.

    Age is the time between the camera's exposure and the sweep that measured the pixel. A filled
    pixel has the age of the nearest measured pixel. Raises ValueError for maps without ages.
    """
    for camera, depth in result.depth.items():
        if depth.age_s is None:
            raise ValueError(f"depth map of {camera}: expected ages (with_ages)")
        write_depth_png(map_path(folder, "depth", camera), depth.depth_m)
        write_depth_png(map_path(folder, "depth_filled", camera), depth.filled_m)
        path = map_path(folder, "confidence", camera)
        write_confidence_png(path, depth.confidence, depth.filled_m)
        write_age_png(map_path(folder, "age", camera), depth.age_s, depth.filled_m)


def write_full(result: Result, context: Context, folder: Path) -> None:
    """Write ``depth_full``, depth completed with the user's prior, and ``confidence_full``, which
    is at most 0.2 where the depth is the prior's."""
    for camera, full in result.full.items():
        write_depth_png(map_path(folder, "depth_full", camera), full.depth_m)
        path = map_path(folder, "confidence_full", camera)
        write_confidence_png(path, full.confidence, full.depth_m)


def write_optical_flow(result: Result, context: Context, folder: Path) -> None:
    """Write ``optical_flow/previous`` and ``optical_flow/next``, if they were asked for."""
    for camera, flows in result.optical_flow.items():
        for other, flow_px in flows.items():
            write_flow_png(map_path(folder / "optical_flow", other, camera), flow_px)


def write_movers(result: Result, context: Context, folder: Path) -> None:
    """Write cloud and depth of each object, if they are separated: ``movers/0007/`` for instance 7,
    ``movers/others/`` for moving points of no object."""
    for instance, mover in result.movers.items():
        place = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
        place.mkdir(parents=True)
        for name, maps in mover.depth.items():
            write_depth_png(map_path(place, "depth", name), maps.depth_m)
        write_cloud(place / "cloud.laz", mover.cloud, result.stamp_ns)


def map_path(folder: Path, kind: str, name: str, suffix: str = ".png") -> Path:
    """Return ``folder/kind/name.png``. Its folder is made."""
    path = folder / kind / f"{name}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
