# SPDX-License-Identifier: MIT
"""What exports need of a run's scene.json, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.errors import InputError, brief
from densify.files.texts import read_json
from densify.types import Camera, CameraView, Float

_MODELS = ("pinhole", "fisheye", "mei")
_MOST_PX = 1 << 16


@dataclass(frozen=True)
class SceneFile:
    """views: from where each map looks. T_key_lidar: (4,4) of the window's sweeps, by frame."""

    views: Mapping[str, CameraView]
    T_key_lidar: Mapping[int, Float]


def read_scene(path: Path) -> SceneFile:
    """What `densify.outputs.scene` wrote. Raises InputError, which says what is amiss where."""
    if not path.is_file():
        raise InputError(
            f"{path}: not there, and has the cameras; densify the key again (run --overwrite)"
        )
    fields = _Fields(path, "", read_json(path))
    views = {name: _view(view) for name, view in fields.each("views")}
    sweeps = fields.value("sweeps", lambda v: isinstance(v, list), "a list")
    T_key_lidar: dict[int, Float] = {}
    for i, sweep in enumerate(sweeps):
        of_sweep = _Fields(path, f"sweeps[{i}].", sweep)
        frame = int(of_sweep.number("frame"))
        if of_sweep.table.get("T_key_lidar") is not None:
            T_key_lidar[frame] = of_sweep.matrix("T_key_lidar", 4)
    return SceneFile(views, T_key_lidar)


def _view(view: _Fields) -> CameraView:
    model = view.value("model", lambda v: v in _MODELS, " or ".join(_MODELS))
    distortion = view.value(
        "distortion", lambda v: isinstance(v, list) and all(map(_is_number, v)), "numbers"
    )
    number = view.table.get("number")
    camera = Camera(
        name=str(view.table.get("name")),
        width_px=int(view.number("width_px", 1, _MOST_PX)),
        height_px=int(view.number("height_px", 1, _MOST_PX)),
        K=view.matrix("K", 3),
        T_cam_lidar=view.matrix("T_cam_lidar", 4),
        distortion=tuple(map(float, distortion)),
        model=model,
        row_time_s=view.number("row_time_s"),
        column_time_s=view.number("column_time_s"),
    )
    if min(camera.K[0, 0], camera.K[1, 1]) <= 0:
        raise InputError(f"{view.path}: {view.prefix}K: expected focal lengths above 0")
    T_cam_key, late_s = view.matrix("T_cam_key", 4), view.number("late_s")
    return CameraView(camera, T_cam_key, late_s, None if number is None else int(number))


@dataclass(frozen=True)
class _Fields:
    """A mapping in the file. prefix: where, for messages."""

    path: Path
    prefix: str
    table: Mapping[str, Any]

    def __post_init__(self) -> None:
        if not isinstance(self.table, dict):
            where = self.prefix.rstrip(".") or "the file"
            raise InputError(f"{self.path}: {where}: expected a mapping; densify the key again")

    def value(self, name: str, fits: Callable[[Any], bool], what: str) -> Any:
        value = self.table.get(name)
        if not fits(value):
            raise InputError(
                f"{self.path}: {self.prefix}{name}: got {brief(repr(value))}, expected {what}; "
                f"densify the key again"
            )
        return value

    def number(self, name: str, least: float = -np.inf, most: float = np.inf) -> float:
        what = "a number" if least == -np.inf else f"a number from {least:g} to {most:g}"
        return float(self.value(name, lambda v: _is_number(v) and least <= v <= most, what))

    def matrix(self, name: str, size: int) -> Float:
        """(size,size)"""

        def fits(value: Any) -> bool:
            rows = value if isinstance(value, list) and len(value) == size else []
            return len(rows) == size and all(
                isinstance(row, list) and len(row) == size and all(map(_is_number, row))
                for row in rows
            )

        return np.array(self.value(name, fits, f"{size} x {size} numbers"), np.float64)

    def each(self, name: str) -> list[tuple[str, _Fields]]:
        inner = self.value(name, lambda v: isinstance(v, dict), "a mapping")
        return [(n, _Fields(self.path, f"{name}.{n}.", v)) for n, v in inner.items()]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e15
