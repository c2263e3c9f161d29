# SPDX-License-Identifier: MIT
"""A key's scene.json and movers.json (`densify.outputs.table_outputs`), read and checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from densify.config.errors import InputError, brief
from densify.config.file_content import read_json
from densify.geometry.types import Camera, CameraView, Float, ObjectTrack

T = TypeVar("T")

_MODELS = ("pinhole", "fisheye", "mei")
_MOST_PX = 1 << 16
_LARGEST = 1e20


@dataclass(frozen=True)
class SceneFile:
    """views: map -> its camera and pose. T_key_lidar: frame -> (4,4), sweeps of the window."""

    views: Mapping[str, CameraView]
    T_key_lidar: Mapping[int, Float]


def read_scene(path: Path) -> SceneFile:
    """Read scene.json. Raises InputError if it is missing or damaged."""

    def scene(table: Any) -> SceneFile:
        known = [sweep for sweep in table["sweeps"] if sweep["T_key_lidar"] is not None]
        return SceneFile(
            {name: _view(view) for name, view in table["views"].items()},
            {_whole(sweep["frame"]): _pose(sweep["T_key_lidar"]) for sweep in known},
        )

    return _checked(path, scene)


def read_tracks(path: Path) -> list[ObjectTrack]:
    """Read movers.json. Raises InputError if it is missing or damaged."""
    return _checked(path, lambda table: [_track(entry) for entry in table["objects"]])


def _checked(path: Path, build: Callable[[Any], T]) -> T:
    try:
        return build(read_json(path))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = brief(f"{type(error).__name__}: {error}")
        raise InputError(
            f"{path}: damaged, or of another version ({reason}); densify the key again"
        ) from error


def _view(view: Mapping[str, Any]) -> CameraView:
    number = view.get("number")
    camera = Camera(
        name=str(view["name"]),
        width_px=_whole(view["width_px"]),
        height_px=_whole(view["height_px"]),
        K=_array(view["K"], 3, 3),
        T_cam_lidar=_pose(view["T_cam_lidar"]),
        distortion=tuple(_array(view["distortion"], len(view["distortion"])).tolist()),
        model=str(view["model"]),
        row_time_s=float(_array(view["row_time_s"])),
        column_time_s=float(_array(view["column_time_s"])),
    )
    if camera.model not in _MODELS or min(camera.K[0, 0], camera.K[1, 1]) <= 0:
        raise ValueError(f"camera {camera.name}: model or K")
    if not (0 < camera.width_px <= _MOST_PX and 0 < camera.height_px <= _MOST_PX):
        raise ValueError(f"camera {camera.name}: {camera.width_px} x {camera.height_px} px")
    late_s = float(_array(view["late_s"]))
    return CameraView(
        camera, _pose(view["T_cam_key"]), late_s, None if number is None else _whole(number)
    )


def _track(entry: Mapping[str, Any]) -> ObjectTrack:
    poses = entry["poses"]
    return ObjectTrack(
        instance=_whole(entry["instance"]),
        size_m=_array(entry["size_m"], 3),
        frames=tuple(_whole(pose["frame"]) for pose in poses),
        stamp_ns=np.array([_whole(pose["stamp_ns"]) for pose in poses], np.int64),
        T_key_object=np.stack([_pose(pose["T_key_object"]) for pose in poses]),
        velocity_m_s=np.stack([_array(pose["velocity_m_s"], 3) for pose in poses]),
        num_points=np.array([_whole(pose["num_points"]) for pose in poses], np.int64),
    )


def _whole(value: Any) -> int:
    if type(value) is not int or abs(value) >= 1 << 63:
        raise ValueError(f"got {value!r}, expected a whole number")
    return value


def _array(value: Any, *shape: int) -> Float:
    array = np.array(value, np.float64)
    if array.shape != shape or not (np.abs(array) < _LARGEST).all():
        raise ValueError(f"got {value!r}, expected {' x '.join(map(str, shape)) or 'a'} number")
    return array


def _pose(value: Any) -> Float:
    """Return (4,4), a rotation and a translation."""
    T = _array(value, 4, 4)
    R = T[:3, :3]
    is_rotation = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    if not is_rotation or T[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(f"got {value!r}, expected a rotation and a translation")
    return T
