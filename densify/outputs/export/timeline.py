# SPDX-License-Identifier: MIT
"""Finished runs over time, for viewers with a time line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import CameraView, Float, Float32
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.depth_png import metres
from densify.outputs.export.finished_run import FinishedRun

_UNOBSERVED = np.array([140, 140, 140], np.uint8)


class ShownSweep(NamedTuple):
    """A sweep as it was measured: its points where registration places them (``rigid_points``).
    stamp_ns: its reference time."""

    frame: int
    stamp_ns: int
    T_key_lidar: Float
    points: StoredCloud


class Shot(NamedTuple):
    """A camera. stamp_ns: of its exposure. maps_m: "depth" and "depth_filled", (H,W) float32, 0
    none. is_pinhole: without distortion, with depth along the axis."""

    name: str
    view: CameraView
    stamp_ns: int
    jpeg: bytes | None
    maps_m: dict[str, Float32]
    is_pinhole: bool


class Timeline(NamedTuple):
    """A key. T_world_key: (4,4), the world is the first key's frame. cloud: at the key's time.
    sweeps: one or more, by time."""

    run: FinishedRun
    T_world_key: Float
    cloud: StoredCloud
    sweeps: list[ShownSweep]
    shots: list[Shot]


def timelines(runs: Sequence[FinishedRun]) -> Iterator[Timeline]:
    """Yield one key with all sweeps of its window, or several keys with their own sweeps.

    runs: ascending by key. Raises InputError where the windows of two consecutive keys have no
    sweep in common that is one of the keys, because their relative pose is then unknown.
    """
    T_world_key = np.eye(4)
    for before, run in zip([None, *runs], runs, strict=False):
        if before is not None:
            T_world_key = T_world_key @ _relative_pose(before, run)
        cloud, sweeps = run.cloud(), []
        for sweep in run.scene.table["sweeps"]:
            frame, since_s, T = sweep["frame"], sweep["since_key_s"], sweep["T_key_lidar"]
            if frame == run.key or (len(runs) == 1 and None not in (since_s, T)):
                own = cloud.select((cloud.frame == frame) & ~cloud.far)
                stamp_ns = run.stamp_ns + round(1e9 * (since_s or 0.0))
                sweeps.append(ShownSweep(frame, stamp_ns, np.array(T), own))
        shots = [_shot(run, name) for name in run.views]
        yield Timeline(run, T_world_key, cloud, sweeps, shots)


def colours(cloud: StoredCloud) -> NDArray[np.uint8]:
    """Return (N,3) colours, gray for points that no camera observed."""
    return np.where(cloud.rgb.any(axis=1, keepdims=True), cloud.rgb, _UNOBSERVED)


def _relative_pose(run: FinishedRun, other: FinishedRun) -> Float:
    """Return (4,4), the other's key frame in the run's."""
    if other.key in run.scene.T_key_lidar:
        return run.scene.T_key_lidar[other.key]
    if run.key in other.scene.T_key_lidar:
        return poses.inverse(other.scene.T_key_lidar[run.key])
    raise InputError(
        f"{other.folder}: neither key {other.key} nor {run.key} is in the other's window, and "
        f"their relative pose is unknown; densify keys nearer to each other"
    )


def _shot(run: FinishedRun, name: str) -> Shot:
    view, maps = run.views[name], run.maps(name)
    stamp_ns = run.stamp_ns + round(1e9 * view.late_s)
    maps_m = {kind: metres(maps[kind]) for kind in ("depth", "depth_filled")}
    is_pinhole = view.camera.is_rectified and run.measure(name) == "z"
    return Shot(name, view, stamp_ns, run.jpeg(name), maps_m, is_pinhole)
