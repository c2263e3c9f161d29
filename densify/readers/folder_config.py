# SPDX-License-Identifier: MIT
"""Read ``densify.yaml``: optional keys for what the files of a plain folder leave open."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import read_yaml
from densify.geometry.types import Camera, Float
from densify.readers import checks
from densify.readers.point_fields import REFERENCES, UNIT_NS

NAME = "densify.yaml"
AZIMUTH = "azimuth"
"""Value of ``sweeps.time`` for firing times by the azimuths of the points, without a column."""

_NUM_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
_AXES = {s + a: (-1.0 if s else 1.0) * np.eye(3)[i] for s in ("", "-") for i, a in enumerate("xyz")}

C = TypeVar("C")


class Kind(NamedTuple):
    """The type of a YAML value: how it is checked and converted, and how messages describe it."""

    convert: Callable[[Any], Any]  # returns the converted value; raises ValueError for a wrong one
    expected: str  # description, for messages

    def key(self, default: Any = MISSING) -> Any:
        """Return a dataclass field for a YAML key of this kind, required without a default."""
        return field(default=default, metadata={"kind": self})


def _require(is_right: Any, value: Any) -> Any:
    """Return the value, or raise ValueError if ``is_right`` is false."""
    if not is_right:
        raise ValueError
    return value


def _array(value: Any, *shape: int) -> Float:
    """Return finite numbers as an array of this shape. Raise ValueError for other values."""
    array = np.array(value, dtype=np.float64).reshape(shape)
    return _require(np.isfinite(array).all(), array)


def _rows(value: Any, length: int) -> Float:
    """Return rows of ``length`` numbers as an array. Raise InputError if one has another length."""
    rows = value if isinstance(value, list) else []
    for number, row in enumerate(rows, 1):
        if isinstance(row, list) and len(row) != length:
            raise InputError(f"row {number} has {len(row)} numbers, not {length}")
    return _array(value, -1, length)


def _above_0(value: Any) -> float:
    """Return a number above 0. Raise ValueError for other values."""
    number = float(_array(value))  # text too: YAML 1.1 reads 1e-3 as text
    return _require(number > 0, number)


def _names(value: Any) -> tuple[str, ...]:
    """Return a list of one or more names as a tuple. Raise ValueError for other values."""
    is_list = isinstance(value, list) and value and all(isinstance(name, str) for name in value)
    return tuple(_require(is_list, value))


def _axes(value: Any) -> Float:
    """Return the (3,3) rotation that puts three stored axes, as [z, -x, -y], along x, y and z."""
    R = np.array([_AXES[name] for name in _names(value)])
    return _require(R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3)), R)


def _intrinsics(value: Any) -> Float:
    """Return the (3,3) camera matrix of fx fy cx cy or of nine numbers."""
    K = _array(value, -1)
    if len(K) == 4:
        fx, fy, cx, cy = K
        K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    K = K.reshape(3, 3)
    has_zeros = np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
    return _require(min(K[0, 0], K[1, 1]) > 0 and has_zeros, K)


def _size_px(value: Any) -> tuple[int, int]:
    """Return width and height as whole numbers of pixels."""
    width, height = _array(value, 2).tolist()
    is_whole = min(width, height) >= 1 and not (width % 1 or height % 1)
    return _require(is_whole, (int(width), int(height)))


def _one_of(choices: Collection[str]) -> Kind:
    """Return the kind of values that are one of the names ``choices``."""
    return Kind({name: name for name in choices}.__getitem__, f"one of {', '.join(choices)}")


_TEXT = Kind(lambda value: _require(isinstance(value, str), value), "a text")
_FLAG = Kind(lambda value: _require(isinstance(value, bool), value), "true or false")
_NUMBER = Kind(lambda value: float(_array(value)), "a finite number")
_ABOVE_0 = Kind(_above_0, "a finite number above 0")
_UNIT = _one_of(UNIT_NS)
_MOTION = Kind(
    lambda value: checks.pose(_rows(value, 4), ""),
    "three or four rows of a rotation and translation",
)
_POINTS = Kind(lambda value: _rows(value, 3), "finite numbers of shape (N, 3)")


@dataclass(frozen=True)
class SweepFiles:
    """Section ``sweeps``: files and columns of the sweeps.

    Where a comment does not state its meaning, "" lets the reader detect the value.
    """

    files: str = _TEXT.key("")  # path of the folder of the sweeps
    # Names of the columns, for files that do not name them
    columns: tuple[str, ...] | None = Kind(_names, "a list of names").key(None)
    scale_m: float = _ABOVE_0.key(1.0)  # length of one unit of the stored points, in metres
    # (3,3) matrix that turns (or mirrors) stored points into the lidar frame, x forward, y left, z
    # up. None is the identity.
    axes: Float | None = Kind(_axes, "x, y and z in some order, such as [z, -x, -y]").key(None)
    intensity: str = _TEXT.key("")  # name of the column with intensities
    intensity_scale: float = _ABOVE_0.key(0.0)  # stored intensity that becomes 1, 0 to detect
    # Name of the column with the firing times of the points, or `AZIMUTH`
    time: str = _TEXT.key("")
    # Of times by azimuth: the direction of the turn seen from above, and the azimuth at which a
    # sweep starts, anticlockwise from x
    turn: str = _one_of(("clockwise", "anticlockwise")).key("clockwise")
    start_deg: float = _NUMBER.key(180.0)
    time_unit: str = _UNIT.key("")  # unit of the firing times
    # "relative" for times since the stamp, "absolute" for times since an epoch
    time_is: str = _one_of(("relative", "absolute")).key("")
    # Moment of the sweep that its stamp marks; "" to take the firing times as they are, or for the
    # middle of times by azimuth
    reference: str = _one_of(REFERENCES).key("")
    lidar: str = _TEXT.key("")  # name of the column with the index of the scanner
    # ``names`` if file names are stamps, or the path of a file with a stamp per sweep
    stamps: str = _TEXT.key("")
    stamps_unit: str = _UNIT.key("")  # unit of the stamps
    # Rate of sweeps without stamps, 0 for 10 Hz; of times by azimuth, turns per second
    rate_hz: float = _ABOVE_0.key(0.0)
    compensated: bool = _FLAG.key(False)  # points are ego-motion compensated to the stamp
    # Frame of the points: "lidar", or "poses" if each was placed with the pose of its moment
    frame: str = _one_of(("lidar", "poses")).key("lidar")
    # (S,3) metres, start of each scanner's rays; None for 0 0 0
    scanner_origins: Float | None = _POINTS.key(None)


@dataclass(frozen=True)
class Poses:
    """Section ``poses``: the file of poses, and what the poses mean."""

    file: str = _TEXT.key("")  # path of the pose file, "" to search for it
    stamps_unit: str = _UNIT.key("")  # unit of the stamps of the poses, "" to detect it
    # (4,4) pose of the lidar in the frame of the poses; None for the identity
    T_frame_lidar: Float | None = _MOTION.key(None)
    inverse: bool = _FLAG.key(False)  # the file stores T_lidar_world instead of T_world_lidar


@dataclass(frozen=True)
class CameraFiles:
    """One camera of the section ``cameras``. `Camera` describes the keys without a comment."""

    size: tuple[int, int] = Kind(_size_px, "[width, height] in whole pixels").key()
    K: Float = Kind(_intrinsics, "[fx, fy, cx, cy] or three rows, with fx and fy above 0").key()
    T_cam_lidar: Float = _MOTION.key()
    files: str = _TEXT.key("")  # path of the folder of images
    model: str = _one_of(_NUM_COEFFICIENTS).key("pinhole")
    distortion: tuple[float, ...] = Kind(
        lambda value: tuple(_array(value, -1).tolist()), "finite numbers"
    ).key(())
    max_angle_deg: float = _ABOVE_0.key(180.0)
    row_time_s: float = _NUMBER.key(0.0)
    # ``names`` if file names are stamps; ``sweeps`` if an image has the stamp of the sweep of the
    # same number; or the path of a file; "" to search for a file
    stamps: str = _TEXT.key("")
    stamps_unit: str = _UNIT.key("")  # unit of the stamps of the images, "" to detect it
    # Seconds added to the images' stamps, to convert them to the sweeps' clock
    clock_offset_s: float = _NUMBER.key(0.0)

    def camera(self, name: str) -> Camera:
        """Return the camera of this calibration with the given name."""
        is_bent = self.model != "pinhole" or any(self.distortion)
        distortion = self.distortion if is_bent else ()
        camera = Camera(name, *self.size, self.K, self.T_cam_lidar, distortion, self.model)
        return replace(camera, max_angle_deg=self.max_angle_deg, row_time_s=self.row_time_s)


@dataclass(frozen=True)
class FolderConfig:
    """The contents of densify.yaml."""

    path: Path | None = None  # path of densify.yaml, None if the folder has no such file
    sweeps: SweepFiles = SweepFiles()
    poses: Poses = Poses()
    cameras: Mapping[str, CameraFiles] = field(default_factory=dict)  # by name

    @staticmethod
    def read(folder: Path) -> FolderConfig:
        """Return a folder's densify.yaml, or the defaults. Raise InputError if malformed."""
        path = folder / NAME
        if not path.is_file():
            return FolderConfig()
        values, lines = read_yaml(path)
        file = _File(path, lines)
        values = file.mapping("", values, ("sweeps", "poses", "cameras"))
        cameras = file.mapping("cameras", values.get("cameras"), None)
        sweeps = file.filled(SweepFiles, "sweeps", values.get("sweeps"))
        for key in ("turn", "start_deg"):
            if sweeps.time != AZIMUTH and key in (values.get("sweeps") or {}):
                raise file.error(f"sweeps.{key}", f"only times by azimuth use it: time: {AZIMUTH}")
        return FolderConfig(
            path,
            sweeps,
            file.filled(Poses, "poses", values.get("poses")),
            {name: file.camera(name, camera) for name, camera in cameras.items()},
        )


class _File(NamedTuple):
    """The densify.yaml being read, with the line of each key by its dotted name, for messages."""

    path: Path
    lines: Mapping[str, int]

    def error(self, key: str, text: str) -> InputError:
        line = f"line {self.lines[key]}: " if key in self.lines else ""
        return InputError(f"{self.path}: {line}{key}: {text}")

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
                expected = f"{did_you_mean(name, known)}expected some of {', '.join(sorted(known))}"
                raise self.error(f"{key}.{name}".lstrip("."), f"unknown key; {expected}")
        return value

    def filled(self, section: type[C], key: str, value: Any) -> C:
        """Return a dataclass filled with the checked values of a YAML mapping."""
        known = {f.name: f for f in fields(section)}  # type: ignore[arg-type]
        settings = self.mapping(key, value, known)
        arguments = {}
        for name, key_field in known.items():
            kind, value_got = key_field.metadata["kind"], settings.get(name)
            try:
                if value_got is not None:
                    arguments[name] = kind.convert(value_got)
            except InputError as error:  # it says what is wrong
                expected = f"{kind.expected}; {str(error).removeprefix(': ')}"
                raise self.unfit(f"{key}.{name}", value_got, expected) from None
            except (ValueError, TypeError, KeyError, OverflowError):
                raise self.unfit(f"{key}.{name}", value_got, kind.expected) from None
            if value_got is None and key_field.default is MISSING:
                raise self.unfit(f"{key}.{name}", None, kind.expected)
        return section(**arguments)

    def camera(self, name: str, value: Any) -> CameraFiles:
        """Return the checked settings of a camera."""
        key = f"cameras.{name}"
        if not re.fullmatch(r"[\w-][\w.-]*", name):
            raise self.unfit(key, value, "a name of letters, digits, _ - .")
        settings = self.filled(CameraFiles, key, value)
        counts = _NUM_COEFFICIENTS[settings.model]
        # A camera drops coefficients that are all 0, so their number does not matter.
        if len(settings.camera(name).distortion) not in counts:
            expected = f"{', '.join(map(str, counts))} coefficients for a {settings.model} camera"
            raise self.unfit(f"{key}.distortion", settings.distortion, expected)
        return settings
