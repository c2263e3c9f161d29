# SPDX-License-Identifier: MIT
"""Read and check the files scene.json and movers.json (`densify.outputs.key_outputs`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError, brief
from densify.config.file_content import read_json
from densify.geometry.types import Camera, CameraView, Float, ObjectTrack
from densify.readers import checks


@dataclass(frozen=True)
class SceneFile:
    """The content of scene.json."""

    table: Mapping[str, Any]  # the parsed JSON of the whole file
    views: Mapping[str, CameraView]  # name of the depth map -> its camera and pose
    # Frame number of a sweep of the window -> (4,4) pose in the key sweep's lidar frame
    T_key_lidar: Mapping[int, Float]


def read_scene(path: Path) -> SceneFile:
    """Read scene.json."""
    with damage_named(path):
        table = read_json(path)
        poses = {sweep["frame"]: sweep["T_key_lidar"] for sweep in table["sweeps"]}
        return SceneFile(
            table,
            {name: _view(view) for name, view in table["views"].items()},
            {frame: checks.rigid(T, "T_key_lidar") for frame, T in poses.items() if T is not None},
        )


def read_tracks(path: Path) -> list[ObjectTrack]:
    """Return the tracks of moving objects in movers.json."""
    with damage_named(path):
        table = read_json(path)
        tracks = [_track(entry) for entry in table["objects"]]
        if any(table["key"] not in track.frames for track in tracks):
            raise ValueError("an object has no pose at the key")
        return tracks


@contextmanager
def damage_named(path: Path) -> Iterator[None]:
    """Turn errors by unexpected file content within the block into InputError with the path."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, InputError) as error:
        if str(error).startswith(str(path)):
            raise
        reason = brief(f"{type(error).__name__}: {error}")
        raise InputError(
            f"{path}: damaged, or of another version ({reason}); densify the key again"
        ) from error


def _view(view: Mapping[str, Any]) -> CameraView:
    own = {f.name: view[f.name] for f in fields(Camera)}
    own |= {
        "K": _array(view["K"], 3, 3),
        "T_cam_lidar": checks.rigid(view["T_cam_lidar"], "T_cam_lidar"),
    }
    camera = Camera(**{**own, "distortion": tuple(map(float, view["distortion"]))})
    is_known = camera.model in ("pinhole", "fisheye", "mei")
    if not is_known or not min(camera.width_px, camera.height_px, camera.K[0, 0]) > 0:
        raise ValueError(f"camera {camera.name}: size, model or K")
    T_cam_key = checks.rigid(view["T_cam_key"], "T_cam_key")
    return CameraView(camera, T_cam_key, float(view["late_s"]), view["number"])


def _track(entry: Mapping[str, Any]) -> ObjectTrack:
    poses = entry["poses"]
    return ObjectTrack(
        instance=int(entry["instance"]),
        size_m=_array(entry["size_m"], 3),
        frames=tuple(int(pose["frame"]) for pose in poses),
        stamp_ns=np.array([pose["stamp_ns"] for pose in poses], np.int64),
        T_key_object=np.stack(
            [checks.rigid(pose["T_key_object"], "T_key_object") for pose in poses]
        ),
        velocity_m_s=_array([pose["velocity_m_s"] for pose in poses], len(poses), 3),
        num_points=np.array([pose["num_points"] for pose in poses], np.int64),
        seen_size_m=_array(entry["seen_size_m"], 3),
        sides_seen=tuple(map(str, entry["sides_seen"])),
    )


def _array(value: Any, *shape: int) -> Float:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected {' x '.join(map(str, shape))} numbers")
    return array
