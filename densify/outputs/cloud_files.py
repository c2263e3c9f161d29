# SPDX-License-Identifier: MIT
"""Write and read the cloud as LAZ (LAS 1.4, point format 7), and write any points as PLY."""

from __future__ import annotations

import datetime
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.arrays import select_rows, table
from densify.geometry.types import Bool, Cloud, Float, Float32, Int
from densify.outputs.folders import write_file
from densify.readers.decoded_files import read_las

_SCALE_M = 0.001
_ONE_RETURN = 0x11  # bits of a pulse's only return: its number and the number of returns
_MOST_LEVEL = 65535  # of the 16 bits of intensity and colours
_TO_16_BITS = 257  # 255 becomes 65535
_UNIX_DAY_0, _DAY_NS = datetime.date(1970, 1, 1), 86400 * 10**9
_LAS_EPOCH_NS = (315_964_800 + 10**9) * 10**9  # 1980-01-06, and the offset of LAS
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
_DISPLACED = ("displaced_x", "displaced_y", "displaced_z")
_COLOURS = ("red", "green", "blue")
_DIMENSIONS = {"intensity", "gps_time", *_COLOURS, *(name for name, *_ in _EXTRA_DIMENSIONS)}
_PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar", "u2": "ushort"}
_UNOBSERVED = np.array([140, 140, 140], np.uint8)  # gray


@dataclass(frozen=True)
class StoredCloud:
    """M points as stored in ``cloud.laz``, at the key sweep's reference time."""

    points: Float  # (M,3) metres, lidar frame of the key sweep, rounded to 1 mm
    frame: NDArray[np.int32]  # (M,) frame number of the source sweep
    moving: Bool  # (M,) True for points confirmed to move
    instance: NDArray[np.int32]  # (M,) number of the moving object, -1 for none
    confidence: Float32  # (M,) 0 to 1
    displaced: Float32  # (M,) length of ``displacement`` in metres
    intensity: Float32  # (M,) 0 to 1
    rgb: NDArray[np.uint8]  # (M,3) colour, 0 where no camera observed the point
    far: Bool  # (M,) True for points of sweeps beyond the window
    displacement: Float32  # (M,3) metres from the rigidly accumulated position to ``points``
    gps_time: Float  # (M,) reference time of the source sweep, s since 1980-01-06 minus 10^9

    @property
    def rigid_points(self) -> Float:
        """The (M,3) positions of rigid accumulation in metres, key sweep's lidar frame."""
        return self.points - self.displacement

    @property
    def stamp_ns(self) -> Int:
        """(M,) int64 reference time of each point's source sweep, ns since 1970, exact to 1 µs."""
        return np.rint(self.gps_time * 1e6).astype(np.int64) * 1000 + _LAS_EPOCH_NS

    @property
    def observed(self) -> Bool:
        """(M,) True for points whose colour a camera observed."""
        return np.asarray(self.rgb.any(axis=1), bool)

    @property
    def shown_rgb(self) -> NDArray[np.uint8]:
        """The (M,3) colours, gray for points that no camera observed."""
        return np.where(self.observed[:, None], self.rgb, _UNOBSERVED)

    def sweep(self, frame: int) -> StoredCloud:
        """Return the points of a sweep by its frame number, without points beyond the window."""
        return self.select((self.frame == frame) & ~self.far)

    def select(self, keep: Bool | Int) -> StoredCloud:
        """Return a cloud with only the points of a mask (M,), or of an array of point indices."""
        return select_rows(self, keep)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the (M,) columns by their names in cloud.laz: booleans uint8, position float32."""
        names = ("intensity", "confidence", "displaced", "frame", "instance", "gps_time")
        return {  # float32 keeps 1 mm up to 8 km
            **dict(zip("xyz", self.points.T.astype(np.float32), strict=True)),
            **dict(zip(_DISPLACED, self.displacement.T, strict=True)),
            **dict(zip(_COLOURS, self.rgb.T, strict=True)),
            **{name: getattr(self, name) for name in names},
            **{name: getattr(self, name).astype(np.uint8) for name in ("moving", "far")},
        }


def write_cloud(path: Path, cloud: Cloud, stamp_ns: int = 0) -> None:
    """Write a cloud as LAZ with positions rounded to 1 mm.

    ``stamp_ns`` is the key sweep's reference time in ns since 1970, whose day is in the header. A
    point's ``gps_time`` is the reference time of its source sweep as in LAS 1.4: seconds since
    1980-01-06 minus 10^9, without leap seconds. Equal clouds give equal bytes. Raise ValueError for
    points that are not finite or beyond 2,147 km.
    """
    import laspy

    if len(cloud) and not max(cloud.points.max(), -cloud.points.min()) < _MAX_COORDINATE_M:
        raise ValueError(f"cloud: expected finite points within {_MAX_COORDINATE_M:.0f} m")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, _SCALE_M), np.zeros(3)
    header.creation_date = _UNIX_DAY_0 + datetime.timedelta(days=stamp_ns // _DAY_NS)
    header.generating_software = "densify"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True  # demanded by LAS 1.4 for this point format
    header.add_extra_dims([laspy.ExtraBytesParams(*dimension) for dimension in _EXTRA_DIMENSIONS])
    points = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    displacement = cloud.points - cloud.rigid_points
    # Columns of the plain array: those of laspy are several times slower.
    for axis, (name, displaced, colour) in enumerate(zip("XYZ", _DISPLACED, _COLOURS, strict=True)):
        points.array[name] = np.rint(cloud.points[:, axis] / _SCALE_M)
        points.array[displaced] = displacement[:, axis]
        points.array[colour] = cloud.rgb[:, axis].astype(np.uint16) * _TO_16_BITS
    points.array["gps_time"] = (stamp_ns - _LAS_EPOCH_NS + cloud.since_key_ns) * 1e-9
    points.array["intensity"] = np.rint(_MOST_LEVEL * np.clip(cloud.intensity, 0, 1))
    points.array["bit_fields"] = _ONE_RETURN
    for name, *_ in _EXTRA_DIMENSIONS:
        if name not in _DISPLACED:
            points.array[name] = getattr(cloud, name)
    buffer = io.BytesIO()
    laspy.LasData(header, points).write(buffer, do_compress=True)
    write_file(path, buffer.getvalue())


def read_cloud(path: Path) -> StoredCloud:
    """Return the cloud in a file of `write_cloud`. Raise InputError for other files."""
    las = read_las(path)
    if missing := _DIMENSIONS - set(las.point_format.dimension_names):
        raise InputError(
            f"{path}: no dimension {', '.join(sorted(missing))}; expected a cloud of this version "
            f"of densify; densify the key again"
        )
    columns: dict[str, Any] = {n: np.array(las[n], kind) for n, kind, _ in _EXTRA_DIMENSIONS}
    displacement = np.stack([columns.pop(name) for name in _DISPLACED], axis=1)
    masks = {name: columns.pop(name) > 0 for name in ("moving", "far")}
    rgb = np.stack([las[colour] for colour in _COLOURS], axis=1) // _TO_16_BITS
    return StoredCloud(
        points=np.array(las.xyz),
        intensity=np.array(las.intensity, np.float32) / np.float32(_MOST_LEVEL),
        rgb=rgb.astype(np.uint8),
        gps_time=np.array(las.gps_time),
        displacement=displacement,
        **masks,
        **columns,
    )


def save_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write (N,) columns of types f4, f8, i4, u1 and u2 by name as PLY vertices (Turk, 1994)."""
    rows = table(columns)
    rows = rows.astype(rows.dtype.newbyteorder("<"), copy=False)
    kinds = {name: _PLY_TYPES[rows.dtype[name].str.lstrip("<|")] for name in columns}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment densify, metres",
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        "end_header",
    ]
    write_file(path, "\n".join(header).encode("ascii") + b"\n" + rows.tobytes())
