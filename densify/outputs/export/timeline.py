# SPDX-License-Identifier: MIT
"""Finished runs over time, for viewers with a time line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Bool, CameraView, Float, Float32, ObjectTrack
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.array_files import metres
from densify.outputs.export.finished_run import FinishedRun

_UNOBSERVED = np.array([140, 140, 140], np.uint8)


class ShownSweep(NamedTuple):
    """A sweep as it was measured, in the key frame, metres. stamp_ns: its reference time."""

    frame: int
    stamp_ns: int
    T_key_lidar: Float
    points: Float32
    rgb: NDArray[np.uint8]
    moving: Bool


class Shot(NamedTuple):
    """A map. stamp_ns: of its exposure. depth_m, filled_m: (H,W), 0 none. is_pinhole: without
    distortion, with depth along the axis."""

    name: str
    view: CameraView
    stamp_ns: int
    jpeg: bytes | None
    depth_m: Float32
    filled_m: Float32
    is_pinhole: bool


class Timeline(NamedTuple):
    """A key. T_world_key: (4,4), the world is the first key's frame. cloud: at the key's time.
    sweeps: one or more, by time."""

    key: int
    T_world_key: Float
    cloud: StoredCloud
    sweeps: list[ShownSweep]
    shots: list[Shot]
    tracks: list[ObjectTrack]


def timelines(runs: Sequence[FinishedRun]) -> Iterator[Timeline]:
    """Yield one key with all sweeps of its window, or several keys with their own sweeps.

    runs: ascending by key. Raises InputError where the windows of two consecutive keys have no
    sweep in common that is one of the keys, because their relative pose is then unknown.
    """
    T_world_key = np.eye(4)
    for before, run in zip([None, *runs], runs, strict=False):
        if before is not None:
            T_world_key = T_world_key @ _relative_pose(before, run)
        cloud = run.cloud()
        frames, rows = np.unique(cloud.frame, return_index=True)
        stamps_ns = dict(zip(frames.tolist(), cloud.stamp_ns[rows].tolist(), strict=True))
        for track in run.tracks:  # exact, and of sweeps without a point that is left
            stamps_ns |= dict(zip(track.frames, track.stamp_ns.tolist(), strict=True))
        key_ns = stamps_ns.setdefault(run.key, 0)
        shown = {*run.scene.T_key_lidar, run.key} if len(runs) == 1 else {run.key}
        sweeps = [_sweep(run, cloud, f, ns) for f, ns in stamps_ns.items() if f in shown]
        sweeps.sort(key=lambda sweep: sweep.stamp_ns)
        shots = [_shot(run, name, key_ns) for name in run.views]
        yield Timeline(run.key, T_world_key, cloud, sweeps, shots, run.tracks)


def colours(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (N,3) colours, gray for points that no camera observed."""
    return np.where(rgb.any(axis=1, keepdims=True), rgb, _UNOBSERVED)


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


def _sweep(run: FinishedRun, cloud: StoredCloud, frame: int, stamp_ns: int) -> ShownSweep:
    own = cloud.select((cloud.frame == frame) & ~cloud.far)
    T_key_lidar = run.scene.T_key_lidar.get(frame, np.eye(4))
    points = own.rigid_points.astype(np.float32)
    return ShownSweep(frame, stamp_ns, T_key_lidar, points, own.rgb, own.moving)


def _shot(run: FinishedRun, name: str, key_ns: int) -> Shot:
    view, maps = run.views[name], run.maps(name)
    stamp_ns = key_ns + round(1e9 * view.late_s)
    depth_m, filled_m = metres(maps["depth"]), metres(maps["depth_filled"])
    is_pinhole = view.camera.is_rectified and run.measure(name) == "z"
    return Shot(name, view, stamp_ns, run.jpeg(name), depth_m, filled_m, is_pinhole)
