# SPDX-License-Identifier: MIT
"""What finished runs show when, for viewers with a time line: sweeps as they were measured, images
with their depth, and the accumulated cloud, all in their key's coordinates, and where those are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, CameraView, Float, Float32, ObjectTrack
from densify.geometry.types.rigid import inverse
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.pictures import jpeg_of

_M_PER_STEP = np.float32(1 / 256)


@dataclass(frozen=True)
class SweepShown:
    """One sweep of the window. stamp_ns: its reference time. T_key_lidar: (4,4). points: (N,3)
    metres, key frame, where registration alone puts them, which is where they were then. rgb: (N,3)
    uint8, black where no camera saw the point. moving: (N,)."""

    frame: int
    stamp_ns: int
    T_key_lidar: Float
    points: Float32
    rgb: NDArray[np.uint8]
    moving: Bool


@dataclass(frozen=True)
class Shot:
    """One map. stamp_ns: of its exposure. jpeg: its image, if there is one. depth_m, filled_m:
    (H,W) metres, 0 none. is_pinhole: without a lens' distortion and with depth along the axis, so
    that viewers may lay it into the scene."""

    name: str
    view: CameraView
    stamp_ns: int
    jpeg: bytes | None
    depth_m: Float32
    filled_m: Float32
    is_pinhole: bool


@dataclass(frozen=True)
class Timeline:
    """One key. T_world_key: (4,4), world: the first key. cloud: at the key's moment. sweeps: one or
    more, by time. tracks: of moving objects."""

    key: int
    T_world_key: Float
    cloud: StoredCloud
    sweeps: tuple[SweepShown, ...]
    shots: tuple[Shot, ...]
    tracks: tuple[ObjectTrack, ...]


def timelines(runs: Sequence[FinishedRun]) -> Iterator[Timeline]:
    """One key with all sweeps of its window, or several keys of a drive, ascending, with their own
    sweeps.

    Raises InputError where a run lacks what this needs, or is damaged, and where the windows of two
    keys in a row have no sweep in common that is the key of one, so that nothing says how they lie
    to each other.
    """
    T_world_key, before = np.eye(4), None
    for run in runs:
        if before is not None:
            T_world_key = T_world_key @ _T_between(before, run)
        before = run
        cloud = run.cloud()
        stamps_ns = _stamps_ns(run, cloud)
        shown = stamps_ns if len(runs) == 1 else {run.key: stamps_ns[run.key]}
        yield Timeline(
            run.key,
            T_world_key,
            cloud,
            tuple(_sweeps(run, cloud, shown)),
            tuple(_shot(run, name, stamps_ns[run.key]) for name in run.chosen_views),
            tuple(run.tracks),
        )


def _T_between(run: FinishedRun, other: FinishedRun) -> Float:
    """The pose (4,4) of the other's key in the run's."""
    if other.key in run.scene.T_key_lidar:
        return run.scene.T_key_lidar[other.key]
    if run.key in other.scene.T_key_lidar:
        return inverse(other.scene.T_key_lidar[run.key])
    raise InputError(
        f"{other.folder}: key {other.key} is in no window of key {run.key}, nor the other way "
        f"round: nothing says how they lie to each other; densify keys nearer to each other, or "
        f"export them one by one"
    )


def _stamps_ns(run: FinishedRun, cloud: StoredCloud) -> dict[int, int]:
    """Reference times of the window's frames, and of the key in any case."""
    frames, rows = np.unique(cloud.frame, return_index=True)
    stamps_ns = dict(zip(frames.tolist(), cloud.stamp_ns[rows].tolist(), strict=True))
    for track in run.tracks:  # exact, and of sweeps of which no point is left
        stamps_ns |= dict(zip(track.frames, track.stamp_ns.tolist(), strict=True))
    stamps_ns.setdefault(run.key, 0)
    return {f: ns for f, ns in stamps_ns.items() if f in run.scene.T_key_lidar or f == run.key}


def _sweeps(run: FinishedRun, cloud: StoredCloud, stamps_ns: dict[int, int]) -> list[SweepShown]:
    points, shown = cloud.rigid_points.astype(np.float32), []
    for frame in sorted(stamps_ns, key=lambda f: stamps_ns[f]):
        own = (cloud.frame == frame) & ~cloud.far
        pose = run.scene.T_key_lidar.get(frame, np.eye(4))
        shown.append(
            SweepShown(
                frame, stamps_ns[frame], pose, points[own], cloud.rgb[own], cloud.moving[own]
            )
        )
    return shown


def _shot(run: FinishedRun, name: str, key_ns: int) -> Shot:
    view, maps = run.chosen_views[name], run.maps(name)
    camera = view.camera
    return Shot(
        name,
        view,
        key_ns + round(1e9 * view.late_s),
        jpeg_of(run, name),
        maps["depth"] * _M_PER_STEP,
        maps["depth_filled"] * _M_PER_STEP,
        camera.is_rectified and run.measure(name) == "z",
    )
