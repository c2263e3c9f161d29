# SPDX-License-Identifier: MIT
"""``densify.yaml`` beside a recording of no known form: what its files do not say themselves. Every
key may be left out; `densify.readers.folder.reader` says what is then found or assumed. Whatever is
wrong is named by file, line and key."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import read_yaml
from densify.geometry.types import Camera, Float
from densify.readers.file_sequence import rigid
from densify.readers.point_fields import REFERENCES, UNIT_NS

NAME = "densify.yaml"
_MODELS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_AXES = {s + a: (-1.0 if s else 1.0) * np.eye(3)[i] for s in ("", "-") for i, a in enumerate("xyz")}

C = TypeVar("C")


@dataclass(frozen=True)
class Section:
    """A mapping in the file. name: keys down to it, "" for the whole. lines: of all keys."""

    path: Path
    name: str
    values: Mapping[str, Any]
    lines: Mapping[str, int]

    def place(self, key: str) -> str:
        """Return file, line and key, to begin a message with."""
        full = f"{self.name}.{key}" if self.name else key
        line = f"line {self.lines[full]}: " if full in self.lines else ""
        return f"{self.path}: {line}{full}"

    def wrong(self, key: str, expected: str) -> InputError:
        """Return the error that the value of this key is not what was expected."""
        got = self.values.get(key)
        shown = "nothing" if got is None else reprlib.repr(got)
        return InputError(f"{self.place(key)}: got {shown}, expected {expected}")

    def section(self, key: str) -> Section:
        """Return the mapping below this key, empty if it is not there."""
        value = self.values.get(key)
        value = {} if value is None else value
        if not isinstance(value, dict) or not all(isinstance(k, str) for k in value):
            raise self.wrong(key, "a mapping of keys to values")
        name = f"{self.name}.{key}" if self.name else key
        return Section(self.path, name, value, self.lines)

    def fill(self, kind: type[C]) -> C:
        """Return the dataclass whose fields, made by `_key`, are the keys of this section."""
        readers = {f.name: f.metadata["read"] for f in fields(kind)}  # type: ignore[arg-type]
        self.check_keys(readers)
        given = [key for key in readers if self.values.get(key) is not None]
        return kind(**{key: readers[key](self, key) for key in given})

    def check_keys(self, known: Mapping[str, Any] | Sequence[str]) -> None:
        """Raise InputError for a key that is none of these."""
        for key in self.values:
            if key not in known:
                raise InputError(
                    f"{self.place(key)}: unknown key; {did_you_mean(key, known)}expected some of "
                    f"{', '.join(sorted(known))}"
                )


Read = Callable[[Section, str], Any]


def _key(read: Read, default: Any = "") -> Any:
    return field(default=default, metadata={"read": read})


def _text(section: Section, key: str) -> str:
    value = section.values[key]
    if not isinstance(value, str):
        raise section.wrong(key, "a text")
    return value


def _choice(*choices: str) -> Read:
    def read(section: Section, key: str) -> str:
        if section.values[key] not in choices:
            raise section.wrong(key, f"one of {', '.join(choices)}")
        return str(section.values[key])

    return read


def _flag(section: Section, key: str) -> bool:
    value = section.values[key]
    if not isinstance(value, bool):
        raise section.wrong(key, "true or false")
    return value


def _number(above: float = -np.inf) -> Read:
    def read(section: Section, key: str) -> float:
        value = section.values[key]
        try:  # YAML 1.1 reads 1e-3 as text
            number = float("nan" if isinstance(value, bool) else value)
        except (TypeError, ValueError, OverflowError):
            number = np.nan
        if not (np.isfinite(number) and number > above):
            beyond = "" if above == -np.inf else f" above {above:g}"
            raise section.wrong(key, f"a finite number{beyond}")
        return number

    return read


def _names(section: Section, key: str) -> tuple[str, ...]:
    value = section.values[key]
    if not (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
        raise section.wrong(key, "a list of names")
    return tuple(value)


def _array(*shapes: tuple[int, ...]) -> Read:
    """An array of one of these shapes (-1: any number of rows), also written as one long list."""
    texts = ["(" + ", ".join("N" if n < 0 else str(n) for n in shape) + ")" for shape in shapes]
    expected = f"finite numbers of shape {' or '.join(texts)}"

    def read(section: Section, key: str) -> Float:
        try:
            array = np.array(section.values[key], dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            raise section.wrong(key, expected) from None
        for shape in shapes:
            size = int(np.prod(shape))
            fits = array.size == size if size > 0 else array.size % -size == 0
            if fits and array.ndim in (1, len(shape)) and np.isfinite(array).all():
                return array.reshape(shape)
        raise section.wrong(key, expected)

    return read


def _axes(section: Section, key: str) -> Float:
    """(3,3) of three names such as [z, -x, -y]: where the lidar's x, y and z are in the file."""
    R = np.array([_AXES.get(name, np.zeros(3)) for name in _names(section, key)])
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3)):
        raise section.wrong(key, "x, y and z in some order, some with a -, such as [z, -x, -y]")
    return R


def _pose(section: Section, key: str) -> Float:
    return rigid(_array((4, 4), (3, 4))(section, key), section.place(key))


def _intrinsics(section: Section, key: str) -> Float:
    K = _array((3, 3), (4,))(section, key)
    if K.shape == (4,):
        fx, fy, cx, cy = K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if min(K[0, 0], K[1, 1]) <= 0 or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise section.wrong(key, _REQUIRED["K"])
    return K


@dataclass(frozen=True)
class SweepFiles:
    """Section ``sweeps``.

    files: folder of the sweeps, "" to look for it. columns: of files without names. scale_m:
    metres of a unit of the points. axes: (3,3) turns (or mirrors) stored points to the lidar's
    frame, x forward, y left, z up; None leaves them. intensity, time, lidar, radial_velocity: which
    column plays that part, "" to find it by its name. intensity_scale: what is full brightness, 0
    to find it. time_unit, time_is, reference: see `densify.readers.point_fields.find_times`.
    stamps: ``names`` (of the files) or a file with one time for each sweep, "" to look for them;
    stamps_unit: theirs. rate_hz: of sweeps without stamps, 0 to take it from the points' times.
    compensated: the points were carried to the stamp by the vehicle's motion. scanner_origins:
    (S,3) metres, None where rays start at 0 0 0.
    """

    files: str = _key(_text)
    columns: tuple[str, ...] | None = _key(_names, None)
    scale_m: float = _key(_number(above=0.0), 1.0)
    axes: Float | None = _key(_axes, None)
    intensity: str = _key(_text)
    intensity_scale: float = _key(_number(above=0.0), 0.0)
    time: str = _key(_text)
    time_unit: str = _key(_choice(*UNIT_NS))
    time_is: str = _key(_choice("relative", "absolute"))
    reference: str = _key(_choice(*REFERENCES))
    lidar: str = _key(_text)
    radial_velocity: str = _key(_text)
    stamps: str = _key(_text)
    stamps_unit: str = _key(_choice(*UNIT_NS))
    rate_hz: float = _key(_number(above=0.0), 0.0)
    compensated: bool = _key(_flag, False)
    scanner_origins: Float | None = _key(_array((-1, 3)), None)


@dataclass(frozen=True)
class Poses:
    """Section ``poses``. file: "" to look for it. T_frame_lidar: (4,4) the lidar in the frame whose
    poses these are. inverse: the file has T_lidar_world, not T_world_lidar."""

    file: str = _key(_text)
    stamps_unit: str = _key(_choice(*UNIT_NS))
    T_frame_lidar: Float | None = _key(_pose, None)
    inverse: bool = _key(_flag, False)


@dataclass(frozen=True)
class CameraFiles:
    """One of the section ``cameras``. files: folder of its images. size: width, height in pixels.
    K: (3,3). T_cam_lidar: (4,4). stamps: ``names``, ``sweeps`` (an image is exposed when the sweep
    of its number is stamped), or a file, "" to look for them. clock_offset_s: is added to the
    stamps, to bring them to the sweeps' clock."""

    files: str = _key(_text)
    size: Float | None = _key(_array((2,)), None)
    K: Float | None = _key(_intrinsics, None)
    T_cam_lidar: Float | None = _key(_pose, None)
    model: str = _key(_choice(*_MODELS), "pinhole")
    distortion: Float | tuple[float, ...] = _key(_array((-1,)), ())
    max_angle_deg: float = _key(_number(above=0.0), 180.0)
    row_time_s: float = _key(_number(), 0.0)
    stamps: str = _key(_text)
    stamps_unit: str = _key(_choice(*UNIT_NS))
    clock_offset_s: float = _key(_number(), 0.0)


_REQUIRED = {
    "files": "the folder of its images",
    "size": "[width, height] in whole pixels",
    "K": "[fx, fy, cx, cy] or three rows, the last one 0 0 1, with fx and fy above 0",
    "T_cam_lidar": "four rows, from the lidar's frame to the camera's (x right, y down, z forward)",
}


@dataclass(frozen=True)
class FolderConfig:
    """path: of the file, None where there is none. cameras: each with its files, by name."""

    path: Path | None = None
    sweeps: SweepFiles = field(default_factory=SweepFiles)
    poses: Poses = field(default_factory=Poses)
    cameras: Mapping[str, tuple[Camera, CameraFiles]] = field(default_factory=dict)

    @staticmethod
    def read(folder: Path) -> FolderConfig:
        """Raises InputError that names file, line and key of whatever is wrong."""
        path = folder / NAME
        if not path.is_file():
            return FolderConfig()
        values, lines = read_yaml(path)
        values = {} if values is None else values
        if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
            raise InputError(
                f"{path}: got {reprlib.repr(values)}, expected a mapping such as sweeps: {{...}}"
            )
        root = Section(path, "", values, lines)
        root.check_keys(("sweeps", "poses", "cameras"))
        cameras = root.section("cameras")
        return FolderConfig(
            path,
            root.section("sweeps").fill(SweepFiles),
            root.section("poses").fill(Poses),
            {name: _camera(cameras.section(name), name) for name in cameras.values},
        )


def _camera(section: Section, name: str) -> tuple[Camera, CameraFiles]:
    if not re.fullmatch(r"[\w.-]+", name) or name.startswith("."):
        raise InputError(
            f"{section.path}: cameras: got the name {name!r}, expected letters, digits, _ - ."
        )
    given = section.fill(CameraFiles)
    for key, expected in _REQUIRED.items():
        if section.values.get(key) is None:
            raise section.wrong(key, expected)
    size, K, T_cam_lidar = (cast(Float, v) for v in (given.size, given.K, given.T_cam_lidar))
    if min(size) < 1 or any(size % 1):
        raise section.wrong("size", _REQUIRED["size"])
    coefficients = tuple(float(d) for d in given.distortion)
    if given.model == "pinhole" and not any(coefficients):
        coefficients = ()
    if len(coefficients) not in _MODELS[given.model]:
        counts = ", ".join(str(n) for n in _MODELS[given.model])
        raise section.wrong("distortion", f"{counts} coefficients for a {given.model} camera")
    camera = Camera(
        name=name,
        width_px=int(size[0]),
        height_px=int(size[1]),
        K=K,
        T_cam_lidar=T_cam_lidar,
        distortion=coefficients,
        model=given.model,
        max_angle_deg=given.max_angle_deg,
        row_time_s=given.row_time_s,
    )
    return camera, given
