# SPDX-License-Identifier: MIT
"""Truth beside a recording: how every body moves, and which body every point belongs to.

Layout of a ``truth/`` folder, frames numbered as the recording's files are::

    bodies.npz             T_world_lidar (F,4,4) the scanner at the reference time of frames 0..F-1,
                           T_world_body (F,B,4,4) every body then (body 0 is the static world),
                           moving (F,B) whether the body's object moves around that time
    points/0000000120.npz  of each point of the sweep, row by row: body (N,) int32,
                           instance (N,) int32 (-1 none), point (N,3) float64 in the body's frame
    depth/image_02/0000000120.npz  depth_m (H,W) float32 camera z at the camera's own time, 0 none,
                           moving (H,W) bool
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, Float32, SweepTruth
from densify.readers.decoded_files import read_arrays
from densify.street.simulator import Bodies


def write_bodies(folder: Path, bodies: Bodies) -> None:
    """folder: the ``truth`` folder, made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        folder / "bodies.npz",
        T_world_lidar=bodies.T_world_lidar,
        T_world_body=bodies.T_world_body,
        moving=bodies.moving,
    )


def write_points(
    folder: Path, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], point: Float
) -> None:
    """What each point of a sweep belongs to; point: (N,3) in its body's frame."""
    path = folder / "points" / f"{frame:010d}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, body=body, instance=instance, point=point)


def write_depth(folder: Path, camera: str, frame: int, depth_m: Float32, moving: Bool) -> None:
    """A camera's depth and what moves in it, (H,W) each."""
    path = folder / "depth" / camera / f"{frame:010d}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, depth_m=depth_m, moving=moving)


class FileTruth:
    """`Truth` from a truth folder."""

    def __init__(self, folder: Path) -> None:
        """Raises InputError if the folder's bodies.npz is missing or malformed."""
        self._folder = folder
        T_world_lidar, T_world_body, moving = self._load(
            folder / "bodies.npz", "T_world_lidar", "T_world_body", "moving"
        )
        shape = T_world_body.shape
        if (
            len(shape) != 4
            or shape[2:] != (4, 4)
            or T_world_lidar.shape != (shape[0], 4, 4)
            or moving.shape != shape[:2]
        ):
            raise InputError(
                f"{folder / 'bodies.npz'}: expected T_world_lidar (F,4,4), T_world_body (F,B,4,4) "
                f"and moving (F,B), got {T_world_lidar.shape}, {shape} and {moving.shape}"
            )
        self.bodies = Bodies(T_world_lidar, T_world_body, moving)

    @staticmethod
    def open(folder: Path) -> FileTruth | None:
        """The truth in that folder, or None if there is no such folder."""
        return FileTruth(folder) if folder.is_dir() else None

    def sweep(self, frame: int) -> SweepTruth:
        body, instance, point = self._points(frame)
        return self.bodies.sweep(frame, body, instance, point)

    def displacement(self, frame: int, target: int) -> Float:
        body, _, point = self._points(frame)
        return self.bodies.displacement(frame, target, body, point)

    def depth_m(self, camera: str, frame: int) -> Float32:
        depth_m: Float32 = self._load(self._depth_path(camera, frame), "depth_m")[0]
        return depth_m

    def moving_mask(self, camera: str, frame: int) -> Bool:
        moving: Bool = self._load(self._depth_path(camera, frame), "moving")[0]
        return moving

    def _depth_path(self, camera: str, frame: int) -> Path:
        return self._folder / "depth" / camera / f"{frame:010d}.npz"

    def _points(self, frame: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Float]:
        self.bodies.check(frame)
        path = self._folder / "points" / f"{frame:010d}.npz"
        body, instance, point = self._load(path, "body", "instance", "point")
        num_bodies = self.bodies.moving.shape[1]
        n = len(body)
        if (
            instance.shape != (n,)
            or point.shape != (n, 3)
            or np.any((body < 0) | (body >= num_bodies))
        ):
            raise InputError(
                f"{path}: expected instance ({n},), point ({n}, 3) and bodies below {num_bodies}, "
                f"got {instance.shape}, {point.shape} and bodies {body.min()} to {body.max()}"
            )
        return body, instance, point

    @staticmethod
    def _load(path: Path, *names: str) -> list[NDArray]:  # type: ignore[type-arg]
        if not path.exists():
            raise InputError(f"{path}: no such truth file; write the frame again")
        arrays = read_arrays(path, names)
        if missing := [name for name in names if name not in arrays]:
            raise InputError(f"{path}: holds no {', '.join(missing)}; write the truth again")
        return [arrays[name] for name in names]
