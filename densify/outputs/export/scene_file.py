# SPDX-License-Identifier: MIT
"""What exports need of a run's scene.json, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from densify.config.errors import InputError
from densify.geometry.types import Camera, CameraView, Float
from densify.outputs.export.fields import Fields, is_number

_MODELS = ("pinhole", "fisheye", "mei")
_MOST_PX = 1 << 16


@dataclass(frozen=True)
class SceneFile:
    """views: from where each map looks. T_key_lidar: (4,4) of the window's sweeps, by frame."""

    views: Mapping[str, CameraView]
    T_key_lidar: Mapping[int, Float]


def read_scene(path: Path) -> SceneFile:
    """What `densify.outputs.scene` wrote. Raises InputError, which says what is amiss where."""
    fields = Fields.of_file(path, "the cameras")
    views = {name: _view(view) for name, view in fields.each("views")}
    T_key_lidar: dict[int, Float] = {}
    for of_sweep in fields.rows("sweeps"):
        frame = int(of_sweep.number("frame"))
        if of_sweep.table.get("T_key_lidar") is not None:
            T_key_lidar[frame] = of_sweep.pose("T_key_lidar")
    return SceneFile(views, T_key_lidar)


def _view(view: Fields) -> CameraView:
    model = view.value("model", lambda v: v in _MODELS, " or ".join(_MODELS))
    distortion = view.value(
        "distortion", lambda v: isinstance(v, list) and all(map(is_number, v)), "numbers"
    )
    number = None if view.table.get("number") is None else view.whole("number")
    camera = Camera(
        name=str(view.table.get("name")),
        width_px=int(view.number("width_px", 1, _MOST_PX)),
        height_px=int(view.number("height_px", 1, _MOST_PX)),
        K=view.matrix("K", 3),
        T_cam_lidar=view.pose("T_cam_lidar"),
        distortion=tuple(map(float, distortion)),
        model=model,
        row_time_s=view.number("row_time_s"),
        column_time_s=view.number("column_time_s"),
    )
    if min(camera.K[0, 0], camera.K[1, 1]) <= 0:
        raise InputError(f"{view.path}: {view.prefix}K: expected focal lengths above 0")
    T_cam_key, late_s = view.pose("T_cam_key"), view.number("late_s")
    return CameraView(camera, T_cam_key, late_s, number)
