# SPDX-License-Identifier: MIT
"""``densify.yaml`` beside a recording of no known form: what its files do not say themselves. Every
key may be left out; `densify.readers.folder.reader` says what is then found or assumed. Whatever is
wrong is named by file, line and key."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import read_yaml
from densify.geometry.types import Camera, Float
from densify.readers.file_sequence import rigid
from densify.readers.point_fields import REFERENCES, UNIT_NS

NAME = "densify.yaml"
_NUM_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_AXES = {s + a: (-1.0 if s else 1.0) * np.eye(3)[i] for s in ("", "-") for i, a in enumerate("xyz")}

C = TypeVar("C")


@dataclass(frozen=True)
class Section:
    """A mapping in the file. name: keys down to it, "" for the whole. lines: of all keys."""

    path: Path
    name: str
    values: Mapping[str, Any]
    lines: Mapping[str, int]

    def wrong(self, key: str, expected: str) -> InputError:
        """Return the error that the value of this key is not what was expected."""
        got = self.values.get(key)
        shown = "nothing" if got is None else reprlib.repr(got)
        return InputError(f"{self._place(key)}: got {shown}, expected {expected}")

    def _place(self, key: str) -> str:
        full = f"{self.name}.{key}".lstrip(".")
        line = f"line {self.lines[full]}: " if full in self.lines else ""
        return f"{self.path}: {line}{full}"

    def section(self, key: str) -> Section:
        """Return the mapping below this key, empty if it is not there."""
        value = self.values.get(key)
        value = {} if value is None else value
        if not isinstance(value, dict) or not all(isinstance(k, str) for k in value):
            raise self.wrong(key, "a mapping of keys to values")
        return Section(self.path, f"{self.name}.{key}".lstrip("."), value, self.lines)

    def fill(self, kind: type[C]) -> C:
        """Return the dataclass whose fields are the keys of this section. Raises InputError for
        other keys and other values."""
        known, found = {f.name: f for f in fields(kind)}, {}  # type: ignore[arg-type]
        self.check_keys(known)
        for key, value in self.values.items():
            given = known[key]
            convert, expected = given.metadata.get("is") or _PLAIN[type(given.default)]
            try:
                if value is not None:
                    found[key] = convert(value)
            except (ValueError, TypeError, KeyError, OverflowError, InputError):
                raise self.wrong(key, expected) from None
        return kind(**found)

    def check_keys(self, known: Collection[str]) -> None:
        for key in self.values:
            if key not in known:
                raise InputError(
                    f"{self._place(key)}: unknown key; {did_you_mean(key, known)}expected some of "
                    f"{', '.join(sorted(known))}"
                )


def _key(convert: Callable[[Any], Any], expected: str, default: Any = None) -> Any:
    """Return a field. convert: raises ValueError or the like for a wrong value."""
    return field(default=default, metadata={"is": (convert, expected)})


def _only(kind: type) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        if not isinstance(value, kind):
            raise ValueError
        return value

    return convert


def _choice(choices: Collection[str], default: str = "") -> Any:
    named = {name: name for name in choices}
    return _key(named.__getitem__, f"one of {', '.join(choices)}", default)


def _number(value: Any) -> float:
    return float(_as_array(value))  # YAML 1.1 reads 1e-3 as text


def _above_0(default: float) -> Any:
    def convert(value: Any) -> float:
        if _number(value) <= 0:
            raise ValueError
        return _number(value)

    return _key(convert, "a finite number above 0", default)


def _as_array(value: Any, *shape: int) -> Float:
    array = np.array(value, dtype=np.float64).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError
    return array


def _names(value: Any) -> tuple[str, ...]:
    if not (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
        raise ValueError
    return tuple(value)


def _axes(value: Any) -> Float:
    """(3,3) of three names such as [z, -x, -y]: where the lidar's x, y and z are in the file."""
    R = np.array([_AXES[name] for name in _names(value)])
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3)):
        raise ValueError
    return R


def _numbers(value: Any) -> tuple[float, ...]:
    return tuple(_as_array(value, -1).tolist())


def _places(value: Any) -> Float:
    return _as_array(value, -1, 3)


def _pose(value: Any) -> Float:
    return rigid(_as_array(value, -1, 4), "")


def _intrinsics(value: Any) -> Float:
    numbers = _as_array(value, -1)
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    K = numbers.reshape(3, 3)
    if min(K[0, 0], K[1, 1]) <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise ValueError
    return K


def _size_px(value: Any) -> tuple[int, int]:
    width, height = _as_array(value, 2).tolist()
    if min(width, height) < 1 or width % 1 or height % 1:
        raise ValueError
    return int(width), int(height)


_PLAIN = {
    bool: (_only(bool), "true or false"),
    str: (_only(str), "a text"),
    float: (_number, "a finite number"),
}
_MOTION = "three or four rows of a rotation and translation"


@dataclass(frozen=True)
class SweepFiles:
    """Section ``sweeps``.

    files: folder of the sweeps, "" to look for it. columns: of files without names. scale_m:
    metres of a unit of the points. axes: (3,3) turns (or mirrors) stored points to the lidar's
    frame, x forward, y left, z up; None leaves them. intensity, time, lidar: which column
    plays that part, "" to find it by its name. intensity_scale: what is full brightness, 0
    to find it. time_unit, time_is, reference: see `densify.readers.point_fields.find_times`.
    stamps: ``names`` (of the files) or a file with one time for each sweep, "" to look for them;
    stamps_unit: theirs. rate_hz: of sweeps without stamps, 0 for 10 Hz.
    compensated: the points were carried to the stamp by the vehicle's motion. scanner_origins:
    (S,3) metres, None where rays start at 0 0 0.
    """

    files: str = ""
    columns: tuple[str, ...] | None = _key(_names, "a list of names")
    scale_m: float = _above_0(1.0)
    axes: Float | None = _key(_axes, "x, y and z in some order, such as [z, -x, -y]")
    intensity: str = ""
    intensity_scale: float = _above_0(0.0)
    time: str = ""
    time_unit: str = _choice(UNIT_NS)
    time_is: str = _choice(("relative", "absolute"))
    reference: str = _choice(REFERENCES)
    lidar: str = ""
    stamps: str = ""
    stamps_unit: str = _choice(UNIT_NS)
    rate_hz: float = _above_0(0.0)
    compensated: bool = False
    scanner_origins: Float | None = _key(_places, "finite numbers of shape (N, 3)")


@dataclass(frozen=True)
class Poses:
    """Section ``poses``. file: "" to look for it. T_frame_lidar: (4,4) the lidar in the frame whose
    poses these are. inverse: the file has T_lidar_world, not T_world_lidar."""

    file: str = ""
    stamps_unit: str = _choice(UNIT_NS)
    T_frame_lidar: Float | None = _key(_pose, _MOTION)
    inverse: bool = False


@dataclass(frozen=True)
class CameraFiles:
    """One of the section ``cameras``. files: folder of its images. size: width, height in pixels.
    K: (3,3). T_cam_lidar: (4,4). stamps: ``names``, ``sweeps`` (an image is exposed when the sweep
    of its number is stamped), or a file, "" to look for them. clock_offset_s: is added to the
    stamps, to bring them to the sweeps' clock."""

    size: tuple[int, int] = _key(_size_px, "[width, height] in whole pixels")
    K: Float = _key(_intrinsics, "[fx, fy, cx, cy] or three rows, with fx and fy above 0")
    T_cam_lidar: Float = _key(_pose, _MOTION)
    files: str = ""
    model: str = _choice(_NUM_COEFFICIENTS, "pinhole")
    distortion: tuple[float, ...] = _key(_numbers, "finite numbers", ())
    max_angle_deg: float = _above_0(180.0)
    row_time_s: float = 0.0
    stamps: str = ""
    stamps_unit: str = _choice(UNIT_NS)
    clock_offset_s: float = 0.0


@dataclass(frozen=True)
class FolderConfig:
    """path: of the file, None where there is none. cameras: each with its files, by name."""

    path: Path | None = None
    sweeps: SweepFiles = SweepFiles()
    poses: Poses = Poses()
    cameras: Mapping[str, tuple[Camera, CameraFiles]] = field(default_factory=dict)

    @staticmethod
    def read(folder: Path) -> FolderConfig:
        """Raises InputError that names file, line and key of whatever is wrong."""
        path = folder / NAME
        if not path.is_file():
            return FolderConfig()
        values, lines = read_yaml(path)
        root = Section(path, "", {"": values}, lines).section("")
        parts = {key: root.section(key) for key in ("sweeps", "poses", "cameras")}
        root.check_keys(parts)
        cameras = parts["cameras"]
        return FolderConfig(
            path,
            parts["sweeps"].fill(SweepFiles),
            parts["poses"].fill(Poses),
            {name: _camera(cameras, name) for name in cameras.values},
        )


def _camera(cameras: Section, name: str) -> tuple[Camera, CameraFiles]:
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise cameras.wrong(name, "a name of letters, digits, _ - .")
    section = cameras.section(name)
    given = section.fill(CameraFiles)
    for key in ("size", "K", "T_cam_lidar"):
        if getattr(given, key) is None:
            raise section.wrong(key, "it: cameras need size, K and T_cam_lidar")
    coefficients = given.distortion
    if given.model == "pinhole" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _NUM_COEFFICIENTS[given.model]:
        counts = ", ".join(str(n) for n in _NUM_COEFFICIENTS[given.model])
        raise section.wrong("distortion", f"{counts} coefficients for a {given.model} camera")
    camera = Camera(
        name,
        *given.size,
        given.K,
        given.T_cam_lidar,
        distortion=coefficients,
        model=given.model,
        max_angle_deg=given.max_angle_deg,
        row_time_s=given.row_time_s,
    )
    return camera, given
