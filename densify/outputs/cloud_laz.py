# SPDX-License-Identifier: MIT
"""The accumulated cloud as LAZ (LAS 1.4, point format 7) for CloudCompare, PDAL and QGIS."""

from __future__ import annotations

import datetime
import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Cloud, Float, Float32, Int, Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.readers.decoded_files import read_las

_SCALE_M = 0.001
_UNIX_DAY_0, _DAY_NS = datetime.date(1970, 1, 1), 86400 * 10**9
_LAS_EPOCH_NS = (315_964_800 + 10**9) * 10**9  # 1980-01-06, and what LAS takes off
_MAX_COORDINATE_M = _SCALE_M * np.iinfo(np.int32).max
_EXTRA_DIMENSIONS = (
    ("frame", "int32", "source sweep"),
    ("moving", "uint8", "1 proven to move"),
    ("instance", "int32", "moving object, -1 none"),
    ("confidence", "float32", "0 to 1"),
    ("displaced", "float32", "m beyond rigid alignment"),
    ("far", "uint8", "1 from beyond the window"),
    ("displaced_x", "float32", "m, displaced as a vector"),
    ("displaced_y", "float32", "m"),
    ("displaced_z", "float32", "m"),
)
_OF_THE_FORMAT = {"intensity", "gps_time", "red", "green", "blue"}
_SINCE = {"far", "displaced_x", "displaced_y", "displaced_z"}
"""Dimensions that older clouds lack."""


@dataclass(frozen=True)
class StoredCloud:
    """A cloud as it was written: M points, key frame, metres, rounded to the millimetre.

    frame, instance: (M,) int32. moving, far: (M,) bool. confidence, displaced, intensity: (M,)
    float32. rgb: (M,3) uint8. displacement: (M,3) float32 metres, by which a point was moved beyond
    the rigid alignment; None in clouds of older versions. gps_time: (M,) as `write_cloud` has it.
    """

    points: Float
    frame: NDArray[np.int32]
    moving: Bool
    instance: NDArray[np.int32]
    confidence: Float32
    displaced: Float32
    intensity: Float32
    rgb: NDArray[np.uint8]
    far: Bool
    displacement: Float32 | None
    gps_time: Float

    @property
    def rigid_points(self) -> Float:
        """(M,3) where registration alone puts them; as ``points`` in clouds of older versions."""
        return self.points if self.displacement is None else self.points - self.displacement

    @property
    def stamp_ns(self) -> Int:
        """(M,) reference time of the sweep that measured the point, to the microsecond."""
        return np.rint(self.gps_time * 1e6).astype(np.int64) * 1000 + _LAS_EPOCH_NS

    def select(self, keep: Bool) -> StoredCloud:
        """The points where ``keep`` (M,) is True."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        kept: dict[str, Any] = {n: None if c is None else c[keep] for n, c in columns.items()}
        return StoredCloud(**kept)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Everything as (M,) columns, for formats of named columns: x y z red green blue intensity
        confidence frame instance moving far displaced displaced_x displaced_y displaced_z gps_time.
        What is true or false as uint8, places as float32, which keeps the millimetre up to
        8 km."""
        by_axis = {"": self.points, "displaced_": self.displacement}
        vectors = {
            f"{name}{axis}": np.ascontiguousarray(values[:, i], np.float32)
            for name, values in by_axis.items()
            if values is not None
            for i, axis in enumerate("xyz")
        }
        columns: dict[str, NDArray[Any]] = {name: vectors.pop(name) for name in "xyz"}
        columns |= {n: self.rgb[:, i].copy() for i, n in enumerate(("red", "green", "blue"))}
        columns |= {n: getattr(self, n) for n in ("intensity", "confidence", "frame", "instance")}
        columns |= {n: getattr(self, n).astype(np.uint8) for n in ("moving", "far")}
        return columns | {"displaced": self.displaced} | vectors | {"gps_time": self.gps_time}


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``cloud.laz``."""
    write_cloud(folder / "cloud.laz", result.cloud, result.stamp_ns)


def write_cloud(path: Path, cloud: Cloud, stamp_ns: int = 0) -> None:
    """Write a cloud with the extra dimensions frame, moving, instance, confidence, displaced, far,
    displaced_x, displaced_y and displaced_z.

    stamp_ns: the key's reference time. ``gps_time`` is the reference time of the sweep that
    measured the point, as LAS 1.4 has it: seconds since 1980-01-06, less 10^9, by the recording's
    clock taken as UNIX time, without leap seconds. The header's date is the key's.

    Coordinates are rounded to 1 mm, intensity and colour widened to the format's 16 bits. The same
    cloud gives the same bytes. Raises ValueError for coordinates that are not finite or beyond
    2,147 km.
    """
    import laspy

    if len(cloud) and not np.abs(cloud.points).max() < _MAX_COORDINATE_M:
        raise ValueError(f"cloud: expected finite points within {_MAX_COORDINATE_M:.0f} m")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.zeros(3)
    header.creation_date = _UNIX_DAY_0 + datetime.timedelta(days=stamp_ns // _DAY_NS)
    header.generating_software = "densify"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True  # demanded by LAS 1.4 for this point format
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, kind, text) for name, kind, text in _EXTRA_DIMENSIONS]
    )
    las = laspy.LasData(header)
    las.xyz = cloud.points
    las.gps_time = (stamp_ns - _LAS_EPOCH_NS + cloud.since_key_ns) * 1e-9
    las.intensity = np.rint(65535 * np.clip(cloud.intensity, 0, 1)).astype(np.uint16)
    las.red, las.green, las.blue = (cloud.rgb.astype(np.uint16) * 257).T
    las.return_number = np.ones(len(cloud), np.uint8)
    las.number_of_returns = np.ones(len(cloud), np.uint8)
    displacement = cloud.points - cloud.rigid_points
    vector = dict(zip(("displaced_x", "displaced_y", "displaced_z"), displacement.T, strict=True))
    for name, kind, _ in _EXTRA_DIMENSIONS:
        las[name] = (vector[name] if name in vector else getattr(cloud, name)).astype(kind)
    buffer = io.BytesIO()
    las.write(buffer, do_compress=True)
    write_file(path, buffer.getvalue())


def read_cloud(path: Path) -> StoredCloud:
    """Read back what `write_cloud` wrote. Raises InputError for any other file."""
    las = read_las(path)
    names = set(las.point_format.dimension_names)
    missing = {*_OF_THE_FORMAT, *(n for n, _, _ in _EXTRA_DIMENSIONS)} - names - _SINCE
    if missing:
        raise InputError(
            f"{path}: no dimension {', '.join(sorted(missing))}; expected a cloud densify wrote"
        )
    rgb = np.stack([las.red, las.green, las.blue], axis=1)
    displacement = None
    if names >= _SINCE:
        vector = [np.array(las[f"displaced_{axis}"], np.float32) for axis in "xyz"]
        displacement = np.stack(vector, axis=1)
    return StoredCloud(
        points=np.array(las.xyz),
        frame=np.array(las["frame"], np.int32),
        moving=np.array(las["moving"], bool),
        instance=np.array(las["instance"], np.int32),
        confidence=np.array(las["confidence"], np.float32),
        displaced=np.array(las["displaced"], np.float32),
        intensity=np.array(las.intensity, np.float32) / np.float32(65535),
        rgb=(rgb // 257).astype(np.uint8),
        far=np.array(las["far"], bool) if "far" in names else np.zeros(len(rgb), bool),
        displacement=displacement,
        gps_time=np.array(las.gps_time),
    )
