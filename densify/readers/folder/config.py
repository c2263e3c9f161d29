# SPDX-License-Identifier: MIT
"""Read ``densify.yaml``: optional keys for what the files of a plain folder leave open."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import read_yaml
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.point_fields import REFERENCES, UNIT_NS

NAME = "densify.yaml"
_NUM_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_AXES = {s + a: (-1.0 if s else 1.0) * np.eye(3)[i] for s in ("", "-") for i, a in enumerate("xyz")}

C = TypeVar("C")
Check = tuple[Callable[[Any], Any], str]
"""A function that converts the value of a YAML key, and the expected value in words. The function
raises an exception, such as ValueError, for a wrong value."""


def _only(kind: type, value: Any) -> Any:
    if not isinstance(value, kind):
        raise ValueError
    return value


def _array(value: Any, *shape: int) -> Float:
    array = np.array(value, dtype=np.float64).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError
    return array


def _number(value: Any) -> float:
    return float(_array(value))  # YAML 1.1 reads 1e-3 as text


def _above_0(value: Any) -> float:
    if _number(value) <= 0:
        raise ValueError
    return _number(value)


def _names(value: Any) -> tuple[str, ...]:
    if not (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
        raise ValueError
    return tuple(value)


def _axes(value: Any) -> Float:
    """Return the (3,3) rotation that puts three stored axes, as [z, -x, -y], along x, y and z."""
    R = np.array([_AXES[name] for name in _names(value)])
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3)):
        raise ValueError
    return R


def _intrinsics(value: Any) -> Float:
    numbers = _array(value, -1)
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    K = numbers.reshape(3, 3)
    if min(K[0, 0], K[1, 1]) <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise ValueError
    return K


def _size_px(value: Any) -> tuple[int, int]:
    width, height = _array(value, 2).tolist()
    if min(width, height) < 1 or width % 1 or height % 1:
        raise ValueError
    return int(width), int(height)


def _choice(choices: Collection[str]) -> Check:
    return {name: name for name in choices}.__getitem__, f"one of {', '.join(choices)}"


_TEXT: Check = (lambda value: _only(str, value), "a text")
_FLAG: Check = (lambda value: _only(bool, value), "true or false")
_NUMBER: Check = (_number, "a finite number")
_ABOVE_0: Check = (_above_0, "a finite number above 0")
_MOTION: Check = (
    lambda value: checks.rigid(_array(value, -1, 4), ""),
    "three or four rows of a rotation and translation",
)
_CHECKS: dict[str, Check] = {
    "columns": (_names, "a list of names"),
    "scale_m": _ABOVE_0,
    "axes": (_axes, "x, y and z in some order, such as [z, -x, -y]"),
    "intensity_scale": _ABOVE_0,
    "time_unit": _choice(UNIT_NS),
    "time_is": _choice(("relative", "absolute")),
    "reference": _choice(REFERENCES),
    "stamps_unit": _choice(UNIT_NS),
    "rate_hz": _ABOVE_0,
    "compensated": _FLAG,
    "frame": _choice(("lidar", "poses")),
    "scanner_origins": (lambda value: _array(value, -1, 3), "finite numbers of shape (N, 3)"),
    "T_frame_lidar": _MOTION,
    "inverse": _FLAG,
    "size": (_size_px, "[width, height] in whole pixels"),
    "K": (_intrinsics, "[fx, fy, cx, cy] or three rows, with fx and fy above 0"),
    "T_cam_lidar": _MOTION,
    "model": _choice(_NUM_COEFFICIENTS),
    "distortion": (lambda value: tuple(_array(value, -1).tolist()), "finite numbers"),
    "max_angle_deg": _ABOVE_0,
    "row_time_s": _NUMBER,
    "clock_offset_s": _NUMBER,
}
"""Check of each YAML key whose value is not a plain text."""


@dataclass(frozen=True)
class SweepFiles:
    """Section ``sweeps``. By default ("" or 0) the reader finds the value in the files."""

    files: str = ""  # path of the folder of the sweeps
    columns: tuple[str, ...] | None = None  # names of the columns, for files that do not name them
    scale_m: float = 1.0  # length of one unit of the stored points, in metres
    # (3,3) matrix that turns (or mirrors) stored points into the lidar frame, x forward, y left, z
    # up; None for the identity
    axes: Float | None = None
    intensity: str = ""  # name of the column with intensities
    intensity_scale: float = 0.0  # stored intensity that becomes 1
    time: str = ""  # name of the column with the firing times of the points
    time_unit: str = ""  # unit of the firing times, in `densify.readers.point_fields.UNIT_NS`
    time_is: str = ""  # "relative" for times since the stamp, "absolute" for times since an epoch
    reference: str = ""  # moment of the sweep that its stamp marks: "start", "middle" or "end"
    lidar: str = ""  # name of the column with the index of the scanner
    # ``names`` if file names are stamps, or the path of a file with a stamp per sweep
    stamps: str = ""
    stamps_unit: str = ""  # unit of the stamps
    rate_hz: float = 0.0  # rate of sweeps without stamps; 0 for 10 Hz
    compensated: bool = False  # True if the points are ego-motion compensated to the stamp
    # Frame of the points: "lidar", or "poses" if each was placed with the pose of its moment
    frame: str = "lidar"
    # (S,3) metres, start of each scanner's rays; None for 0 0 0
    scanner_origins: Float | None = None


@dataclass(frozen=True)
class Poses:
    """Section ``poses``."""

    file: str = ""  # path of the pose file, "" to search for it
    stamps_unit: str = ""  # unit of the stamps of the poses, "" to detect it
    # (4,4) pose of the lidar in the frame of the poses; None for the identity
    T_frame_lidar: Float | None = None
    inverse: bool = False  # True if the file stores T_lidar_world instead of T_world_lidar


@dataclass(frozen=True)
class CameraFiles:
    """One camera of the section ``cameras``; `Camera` describes the fields without a comment."""

    size: tuple[int, int]  # width and height of the images in pixels
    K: Float  # (3,3) intrinsics in pixels
    T_cam_lidar: Float  # (4,4) transform from the lidar frame to the camera frame
    files: str = ""  # path of the folder of images
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()
    max_angle_deg: float = 180.0
    row_time_s: float = 0.0
    # ``names`` if file names are stamps; ``sweeps`` if an image has the stamp of the sweep of the
    # same number; or the path of a file; "" to search for a file
    stamps: str = ""
    stamps_unit: str = ""  # unit of the stamps of the images, "" to detect it
    # Seconds added to the images' stamps, to convert them to the sweeps' clock
    clock_offset_s: float = 0.0


class _File(NamedTuple):
    """The densify.yaml being read, with the line of each key by its dotted name, for messages."""

    path: Path
    lines: Mapping[str, int]

    def error(self, key: str, said: str) -> InputError:
        line = f"line {self.lines[key]}: " if key in self.lines else ""
        return InputError(f"{self.path}: {line}{key}: {said}")

    def unfit(self, key: str, got: Any, expected: str) -> InputError:
        shown = "nothing" if got is None else reprlib.repr(got)
        return self.error(key, f"got {shown}, expected {expected}")

    def mapping(self, key: str, value: Any, known: Collection[str] | None) -> dict[str, Any]:
        """Return a YAML key's mapping, {} for None, if all its names are among ``known``."""
        value = {} if value is None else value
        if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
            raise self.unfit(key, value, "a mapping of keys to values")
        for name in value:
            if known is not None and name not in known:
                raise self.error(
                    f"{key}.{name}".lstrip("."),
                    f"unknown key; {did_you_mean(name, known)}expected some of "
                    f"{', '.join(sorted(known))}",
                )
        return value

    def filled(self, kind: type[C], key: str, value: Any) -> C:
        """Return a dataclass ``kind`` filled with the checked values of a YAML mapping."""
        known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
        arguments = {}
        for name, setting in self.mapping(key, value, known).items():
            convert, expected = _CHECKS.get(name, _TEXT)
            try:
                if setting is not None:
                    arguments[name] = convert(setting)
            except (ValueError, TypeError, KeyError, OverflowError, InputError):
                raise self.unfit(f"{key}.{name}", setting, expected) from None
        for name, known_field in known.items():
            if known_field.default is MISSING and name not in arguments:
                raise self.unfit(f"{key}.{name}", None, _CHECKS[name][1])
        return kind(**arguments)


@dataclass(frozen=True)
class FolderConfig:
    """The contents of densify.yaml."""

    path: Path | None = None  # path of densify.yaml, None if the folder has no such file
    sweeps: SweepFiles = SweepFiles()
    poses: Poses = Poses()
    # Calibration and file settings of each camera, by name
    cameras: Mapping[str, tuple[Camera, CameraFiles]] = field(default_factory=dict)

    @staticmethod
    def read(folder: Path) -> FolderConfig:
        """Read the densify.yaml of a folder; return the defaults if the folder has none."""
        path = folder / NAME
        if not path.is_file():
            return FolderConfig()
        values, lines = read_yaml(path)
        file = _File(path, lines)
        values = file.mapping("", values, ("sweeps", "poses", "cameras"))
        cameras = file.mapping("cameras", values.get("cameras"), None)
        return FolderConfig(
            path,
            file.filled(SweepFiles, "sweeps", values.get("sweeps")),
            file.filled(Poses, "poses", values.get("poses")),
            {name: _camera(file, name, camera) for name, camera in cameras.items()},
        )


def _camera(file: _File, name: str, value: Any) -> tuple[Camera, CameraFiles]:
    key = f"cameras.{name}"
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise file.unfit(key, value, "a name of letters, digits, _ - .")
    settings = file.filled(CameraFiles, key, value)
    coefficients = settings.distortion
    if settings.model == "pinhole" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _NUM_COEFFICIENTS[settings.model]:
        counts = ", ".join(str(n) for n in _NUM_COEFFICIENTS[settings.model])
        expected = f"{counts} coefficients for a {settings.model} camera"
        raise file.unfit(f"{key}.distortion", coefficients, expected)
    camera = Camera(
        name,
        *settings.size,
        settings.K,
        settings.T_cam_lidar,
        distortion=coefficients,
        model=settings.model,
        max_angle_deg=settings.max_angle_deg,
        row_time_s=settings.row_time_s,
    )
    return camera, settings
