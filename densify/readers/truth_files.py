# SPDX-License-Identifier: MIT
"""Read and write exact ground truth of a simulated recording: body motion and each point's body.

A body is a rigid part of the scene; body 0 is the static world. A ``truth/`` folder has::

    bodies.npz             T_world_lidar (F,4,4): scanner poses at the reference times of F frames
                           T_world_body (F,B,4,4): poses of B bodies at the reference times
                           moving (F,B) bool: the body's object moves around the reference time
    points/0000000120.npz  arrays for the N raw points of the sweep, row by row: body (N,) int32,
                           instance (N,) int32 (-1 none), point (N,3) float64 in the body's frame
    depth/image_02/0000000120.npz  depth_m (H,W) float32: camera z at the exposure, 0 if empty
                           moving (H,W) bool: pixels of moving objects
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, Float32, SweepTruth
from densify.readers.decoded_files import read_arrays
from densify.street.simulator import Bodies

_BODIES = ("T_world_lidar", "T_world_body", "moving")


def write_bodies(folder: Path, bodies: Bodies) -> None:
    """Write the poses of the scanner and all bodies to ``bodies.npz`` in the ``truth`` folder."""
    _save(folder / "bodies.npz", **{name: getattr(bodies, name) for name in _BODIES})


def write_points(
    folder: Path, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], point: Float
) -> None:
    """Write the ground truth of a sweep's N raw points, row by row.

    Args:
        body: (N,) index of the body of each point.
        instance: (N,) number of its object, -1 for none.
        point: (N,3) position in metres in the frame of the body.
    """
    path = folder / "points" / f"{frame:010d}.npz"
    _save(path, body=body, instance=instance, point=point)


def write_depth(folder: Path, camera: str, frame: int, depth_m: Float32, moving: Bool) -> None:
    """Write the true depth (H,W) in metres and the mask (H,W) of moving objects of an image."""
    _save(folder / "depth" / camera / f"{frame:010d}.npz", depth_m=depth_m, moving=moving)


def _save(path: Path, **arrays: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


class FileTruth:
    """Ground truth (`Truth`) read from a ``truth`` folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.bodies = Bodies(*self._load("bodies.npz", *_BODIES))

    def sweep(self, frame: int) -> SweepTruth:
        """Return the ground truth of a sweep's N raw points, in the lidar frame at its stamp."""
        body, instance, point = self._points(frame)
        return self.bodies.sweep(frame, body, instance, point)

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) true scene flow (m) of a sweep's points to the time of ``target``."""
        body, _, point = self._points(frame)
        return self.bodies.displacement(frame, target, body, point)

    def depth_m(self, camera: str, frame: int) -> Float32:
        """Return the true depth (H,W) of an image in metres, 0 for pixels without a surface."""
        depth_m: Float32 = self._load(f"depth/{camera}/{frame:010d}.npz", "depth_m")[0]
        return depth_m

    def moving_mask(self, camera: str, frame: int) -> Bool:
        """Return an (H,W) mask of an image, True for pixels of moving objects."""
        moving: Bool = self._load(f"depth/{camera}/{frame:010d}.npz", "moving")[0]
        return moving

    def _points(self, frame: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Float]:
        """Return body (N,), instance (N,) and body-fixed position (N,3) of a sweep's points."""
        self.bodies.check(frame)
        name, num_bodies = f"points/{frame:010d}.npz", self.bodies.moving.shape[1]
        body, instance, point = self._load(name, "body", "instance", "point")
        if ((body < 0) | (body >= num_bodies)).any():
            raise InputError(
                f"{self._folder / name}: got bodies {body.min()} to {body.max()}, expected bodies "
                f"below {num_bodies}"
            )
        return body, instance, point

    def _load(self, name: str, *columns: str) -> list[NDArray[Any]]:
        path = self._folder / name
        if not path.exists():
            raise InputError(f"{path}: no such truth file; write the frame again")
        arrays = read_arrays(path, columns)
        if missing := [column for column in columns if column not in arrays]:
            raise InputError(f"{path}: holds no {', '.join(missing)}; write the truth again")
        return [arrays[column] for column in columns]
