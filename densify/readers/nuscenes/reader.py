# SPDX-License-Identifier: MIT
"""nuScenes (Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020),
without its devkit::

    ROOT/v1.0-trainval/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor}.json
    ROOT/v1.0-trainval/sample_annotation.json    optional: tracked boxes, see `.annotations`
    ROOT/samples/LIDAR_TOP/*.pcd.bin, ROOT/sweeps/LIDAR_TOP/*.pcd.bin    key frames, and the others
    ROOT/samples/CAM_FRONT/*.jpg ...

A scene is named by ``#scene-0061``. Its sweeps, key frames or not, are numbered from 0 in the order
of time, images likewise by camera; what is not on the disk leaves a gap. ``prev`` and ``next`` are
not used. Images are undistorted; their stamps are those of the exposure. Poses are the vehicle's in
the map's frame; every record has its own, and all of a scene together tell where the vehicle was at
any time. TruckScenes has the same tables: see `densify.readers.nuscenes.truckscenes`.

nuScenes: one HDL-32E at 20 Hz. Points are in the scanner's frame (x right, y forward, z up), all
carried by the vehicle's own motion to the stamp, which is that of the *last* packet. There are no
times per point; rows are columns of 32 rings in the order in which they fired, 46.08 µs apart
(HDL-32E manual, 2018, section 9.3), so that column c of n fired (c + 1 - n) · 46.08 µs after the
stamp. The compensation is undone with that (on a real sweep at 9 m/s the rings' elevations then
spread by 0.0016 degrees instead of 0.073). Rows without a return lie at the scanner's origin then
and are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.types import Int
from densify.readers.file_sequence import Returns, chosen_scene
from densify.readers.nuscenes.scene import Scene, SceneSequence
from densify.readers.nuscenes.tables import read_table
from densify.readers.recorded_poses import PoseTrack

NUM_RINGS = 32
COLUMN_NS = 46_080
"""From column to column of an HDL-32E."""

_NO_RETURN_M = 0.05


def open_recording(path: Path, scene: str | None) -> SceneSequence:
    """See `densify.readers.ReaderModule`. path: the folder that holds the tables, or the one above
    it, which may hold several versions."""
    folders = _versions(path)
    if not folders:
        raise InputError(
            f"{path}: no nuScenes tables; expected a folder such as v1.0-mini with scene.json and "
            f"sample_data.json in it"
        )
    scenes: dict[str, tuple[Path, str]] = {}
    for folder in folders:
        for token, record in read_table(folder / "scene.json").items():
            scenes.setdefault(record.text("name"), (folder, token))
    name = chosen_scene("nuscenes", path, scene, list(scenes))
    found = Scene.read(*scenes[name], name)
    lidars = list(found.lidars.values())
    if lidars[0].records[0].text("filename").endswith(".pcd"):
        from densify.readers.nuscenes.truckscenes import TruckScenes

        return TruckScenes(found)
    if len(lidars) > 1:
        raise InputError(
            f"{path}: {name} has the lidars {', '.join(found.lidars)}, expected one in .pcd.bin "
            f"files, as nuScenes has, or several in .pcd files, as TruckScenes has"
        )
    return NuScenes(found)


def _versions(path: Path) -> list[Path]:
    if (path / "sample_data.json").is_file():
        return [path]
    return sorted(found.parent for found in path.glob("v*/sample_data.json"))


class NuScenes(SceneSequence):
    """A scene of nuScenes as a `LidarSequence`."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError if the scene's sweeps are not there, or a camera is malformed."""
        super().__init__(scene, next(iter(scene.lidars.values())).T_ego_sensor[0])
        track = scene.track
        self._track = PoseTrack(track.where, track.stamp_ns, track.T_world_ego @ self._T_ego_frame)

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        path = self._file(self._lidar.records[frame])
        data = read_bytes(path)
        if len(data) % 20:
            raise InputError(
                f"{path}: truncated: got {len(data)} bytes, expected a multiple of 20 (x y z "
                f"intensity ring as float32); fetch the file again"
            )
        rows = np.frombuffer(data, "<f4").reshape(-1, 5).astype(np.float64)
        ring = rows[:, 4]
        if len(ring) and not ((ring >= 0) & (ring < NUM_RINGS) & (ring % 1 == 0)).all():
            raise InputError(
                f"{path}: got rings from {ring.min():g} to {ring.max():g}, expected whole numbers "
                f"from 0 to {NUM_RINGS - 1} in the fifth column"
            )
        column: Int = np.cumsum(np.diff(ring, prepend=0.0) < 0, dtype=np.int64)
        offset_ns: Int = (column - column[-1:]) * COLUMN_NS
        points = self._track.as_fired(rows[:, :3], self._lidar.stamps_ns[frame], offset_ns)
        points[np.linalg.norm(points, axis=1) < _NO_RETURN_M] = 0.0
        return path, Returns(points, (rows[:, 3] / 255).astype(np.float32), offset_ns)
