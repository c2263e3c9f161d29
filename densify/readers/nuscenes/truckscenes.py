# SPDX-License-Identifier: MIT
"""MAN TruckScenes (Fent et al., "MAN TruckScenes: A multimodal dataset for autonomous trucking in
diverse conditions", NeurIPS Datasets 2024), whose tables and folders are those of nuScenes.

Several lidars at 10 Hz, each sweep a ``.pcd`` file in its scanner's frame with the fields x y z
intensity timestamp. The timestamp tells in microseconds when each point was measured; points are
not compensated (the devkit's ``LidarPointCloud``; https://github.com/TUMFTM/truckscenes-devkit,
issues 9 and 11). A sweep here is one of the first lidar, by name, with those of the others that are
nearest to it in time, all in the vehicle's frame (x forward, y left, z up), each point where it was
when it was fired; its stamp is the first lidar's in the table. Lidars are numbered in the order of
their names. Some are on the cabin, which sways on the chassis: the calibration, and so this reader,
take it for rigid. Images are undistorted. Built on the devkit and its documentation; not tried on
real files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, Float32, Int
from densify.readers.file_sequence import Returns, scanner_axes
from densify.readers.nuscenes.scene import Channel, Scene, SceneSequence
from densify.readers.point_fields import full_scale, scaled
from densify.readers.point_files import read_table

_FIELDS = ("x", "y", "z", "intensity", "timestamp")
_NOMINAL_PERIOD_NS = 100_000_000
_MOST_LATE_NS = 500_000_000


class TruckScenes(SceneSequence):
    """A scene of TruckScenes as a `LidarSequence`."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError if the scene's sweeps are not there, or a camera is malformed."""
        super().__init__(scene, np.eye(4))
        stamps_ns = self._lidar.stamps_ns
        self._period_ns = (
            np.median(np.diff(stamps_ns)) if len(stamps_ns) > 1 else _NOMINAL_PERIOD_NS
        )

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        stamp_ns = self._lidar.stamps_ns[frame]
        parts, places = [], []
        for number, channel in enumerate(self._scene.lidars.values()):
            near = int(np.argmin(np.abs(np.array(channel.stamps_ns) - stamp_ns)))
            places.append(channel.T_ego_sensor[near])
            if abs(channel.stamps_ns[near] - stamp_ns) <= self._period_ns / 2:
                parts.append(self._scanner(channel, number, near, stamp_ns))
        points, intensity, offset_ns, lidar = (np.concatenate(c) for c in zip(*parts, strict=True))
        path = self._file(self._lidar.records[frame])
        T = np.stack(places)
        return path, Returns(points, intensity, offset_ns, lidar, T[:, :3, 3], scanner_axes(T))

    def _scanner(
        self, channel: Channel, number: int, near: int, stamp_ns: int
    ) -> tuple[Float, Float32, Int, NDArray[np.uint8]]:
        """Points, intensities, times and number of one scanner."""
        path = self._file(channel.records[near])
        columns = read_table(path).columns
        absent = [name for name in _FIELDS if name not in columns]
        if absent:
            raise InputError(f"{path}: no field {', '.join(absent)}; got {', '.join(columns)}")
        fired = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        valid: Bool = np.asarray(np.isfinite(fired).all(axis=1) & fired.any(axis=1))
        points = np.where(valid[:, None], transform(channel.T_ego_sensor[near], fired), np.nan)
        offset_ns = columns["timestamp"].astype(np.int64) * 1000 - stamp_ns
        late_ns = np.abs(offset_ns[valid]).max(initial=0)
        if late_ns > _MOST_LATE_NS:
            raise InputError(
                f"{path}: timestamp: got points {late_ns * 1e-9:g} s from the sweep's stamp, "
                f"expected microseconds within {_MOST_LATE_NS * 1e-9:g} s of it"
            )
        brightness = scaled(columns["intensity"], full_scale(columns["intensity"]))
        return points, brightness, offset_ns, np.full(len(points), number, np.uint8)
