# SPDX-License-Identifier: MIT
"""Keys as nuScenes' devkit and detectors on it read sweeps, images and depth: plain files by the
data set's names, without its tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from densify.geometry.types import Float32
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.timeline import Timeline, timelines

_LIDAR = "LIDAR_TOP"


def write_export(run: FinishedRun, folder: Path) -> None:
    """One key, see `write_drive`."""
    write_drive([run], folder)


def write_drive(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write of each key, microseconds in the names::

    samples/LIDAR_TOP/000120__LIDAR_TOP__1532402927647951.pcd.bin
        the accumulated cloud: float32 x y z (metres, key frame), intensity 0 to 255, and ring,
        which accumulated points lack: 0
    samples/CAM_FRONT/000120__CAM_FRONT__1532402927612460.jpg
    depth_gt/000120__CAM_FRONT__1532402927612460.jpg.bin
        measured depth as BEVDepth's (Li et al., AAAI 2023) training reads it: float32 rows of
        u, v (pixels) and metres; depth_gt_filled/ with the filled pixels too
    """
    for timeline in timelines(runs):
        _write_key(timeline, folder)


def _write_key(timeline: Timeline, folder: Path) -> None:
    cloud = timeline.cloud
    columns = [*cloud.points.T, 255 * cloud.intensity, np.zeros(len(cloud.points))]
    key_ns = next(s.stamp_ns for s in timeline.sweeps if s.frame == timeline.key)
    name = _name(timeline.key, _LIDAR, key_ns)
    table = np.stack(columns, axis=1).astype("<f4")
    _write(folder / "samples" / _LIDAR / f"{name}.pcd.bin", table.tobytes())
    for shot in timeline.shots:
        camera = shot.name.partition("/")[0]
        name = _name(timeline.key, camera, shot.stamp_ns)
        if shot.jpeg is not None:
            _write(folder / "samples" / camera / f"{name}.jpg", shot.jpeg)
        _write(folder / "depth_gt" / f"{name}.jpg.bin", _rows(shot.depth_m))
        _write(folder / "depth_gt_filled" / f"{name}.jpg.bin", _rows(shot.filled_m))


def _rows(depth_m: Float32) -> bytes:
    v, u = np.nonzero(depth_m)
    return np.stack([u, v, depth_m[v, u]], axis=1).astype("<f4").tobytes()


def _name(key: int, sensor: str, stamp_ns: int) -> str:
    return f"{key:06d}__{sensor}__{stamp_ns // 1000}"


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, data)
