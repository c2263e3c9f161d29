# SPDX-License-Identifier: MIT
"""Read and write exact truth beside a recording: the motion of bodies, and the body of each point.

Layout of a ``truth/`` folder, with the frame numbers of the recording::

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, Float32, SweepTruth
from densify.readers.decoded_files import read_arrays
from densify.street.simulator import Bodies

_BODIES = ("T_world_lidar", "T_world_body", "moving")


def write_bodies(folder: Path, bodies: Bodies) -> None:
    """Write the poses of bodies.

    Args:
        folder: The ``truth`` folder, made if needed.
    """
    _save(folder / "bodies.npz", **{name: getattr(bodies, name) for name in _BODIES})


def write_points(
    folder: Path, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], point: Float
) -> None:
    """Write the body of each point of a sweep.

    Args:
        point: (N,3) in the frame of its body.
    """
    _save(_points_path(folder, frame), body=body, instance=instance, point=point)


def write_depth(folder: Path, camera: str, frame: int, depth_m: Float32, moving: Bool) -> None:
    """Write the depth of a camera and a mask of moving objects, (H,W) each."""
    _save(_depth_path(folder, camera, frame), depth_m=depth_m, moving=moving)


def _save(path: Path, **arrays: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def _points_path(folder: Path, frame: int) -> Path:
    return folder / "points" / f"{frame:010d}.npz"


def _depth_path(folder: Path, camera: str, frame: int) -> Path:
    return folder / "depth" / camera / f"{frame:010d}.npz"


class FileTruth:
    """`Truth` from a truth folder."""

    def __init__(self, folder: Path) -> None:
        """Open a truth folder. Raise InputError if its bodies.npz is missing or damaged."""
        self._folder = folder
        self.bodies = Bodies(*_load(folder / "bodies.npz", *_BODIES))

    def sweep(self, frame: int) -> SweepTruth:
        """Return the truth of a sweep."""
        body, instance, point = self._points(frame)
        return self.bodies.sweep(frame, body, instance, point)

    def displacement(self, frame: int, target: int) -> Float:
        """Return (N,3) true displacements."""
        body, _, point = self._points(frame)
        return self.bodies.displacement(frame, target, body, point)

    def depth_m(self, camera: str, frame: int) -> Float32:
        """Return (H,W) the exact depth of an image, 0 for none."""
        depth_m: Float32 = _load(_depth_path(self._folder, camera, frame), "depth_m")[0]
        return depth_m

    def moving_mask(self, camera: str, frame: int) -> Bool:
        """Return (H,W) True at moving objects of an image."""
        moving: Bool = _load(_depth_path(self._folder, camera, frame), "moving")[0]
        return moving

    def _points(self, frame: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Float]:
        self.bodies.check(frame)
        path, num_bodies = _points_path(self._folder, frame), self.bodies.moving.shape[1]
        body, instance, point = _load(path, "body", "instance", "point")
        if ((body < 0) | (body >= num_bodies)).any():
            raise InputError(
                f"{path}: got bodies {body.min()} to {body.max()}, expected bodies below "
                f"{num_bodies}"
            )
        return body, instance, point


def _load(path: Path, *names: str) -> list[NDArray[Any]]:
    if not path.exists():
        raise InputError(f"{path}: no such truth file; write the frame again")
    arrays = read_arrays(path, names)
    if missing := [name for name in names if name not in arrays]:
        raise InputError(f"{path}: holds no {', '.join(missing)}; write the truth again")
    return [arrays[name] for name in names]
