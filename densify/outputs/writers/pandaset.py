# SPDX-License-Identifier: MIT
"""Writes a street as a PandaSet sequence, which `densify.readers.pandaset.reader` opens::

    OUT/002/lidar/{00.pkl.gz, ..., poses.json, timestamps.json}
    OUT/002/camera/image_02/{00.jpg, ..., poses.json, timestamps.json, intrinsics.json}
    OUT/002/annotations/cuboids/{00.pkl.gz, ...}
    OUT/002/truth/  as in `densify.readers.truth_files`

The street's scanner stands where the Pandar64 does. Points are compensated with the poses that are
written, so that the reader's undoing is exact; the data set's were with poses at a higher rate.
"""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, Float, Int
from densify.outputs.writers.boxes import drawn_boxes
from densify.outputs.writers.excerpt import (
    Excerpt,
    check_plain_cameras,
    new_folder,
    put,
    quaternion,
)
from densify.readers.pandaset.cuboids import (
    CENTRE,
    NAME,
    SCANNER,
    WIDTH_LENGTH_HEIGHT,
    YAW,
)
from densify.readers.pandaset.reader import PANDAR_GT_M, T_POSE_LIDAR
from densify.readers.pose_track import PoseTrack

_FLOATS = ("x", "y", "z", "i", "t")


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for two or more sweeps of a single
    scanner or of the street's pandaset, and for rectified cameras."""
    _check(excerpt)
    street = excerpt.street
    half_ns = street.simulator.period_ns // 2
    stamps_ns = np.array([street.stamp_ns(f) + half_ns for f in excerpt.frames])
    track = PoseTrack(street.name, stamps_ns, excerpt.T_world_ego(stamps_ns))
    with new_folder(out / "002", overwrite) as folder:
        for number, frame in excerpt.numbered():
            stamp_ns, returns = int(stamps_ns[number]), excerpt.returns(frame)
            fired = returns.points.astype(np.float64)
            offset_ns = returns.offset_ns - half_ns
            there = track.compensated(fired, stamp_ns, offset_ns)
            world = poses.transform(track.at(stamp_ns), there)
            floats = [*world.T, returns.intensity * 255.0, (stamp_ns + offset_ns) * 1e-9]
            columns = dict(zip(_FLOATS, (f.astype(np.float64) for f in floats), strict=True))
            columns |= {"d": returns.lidar.astype(np.int64)}
            _put(folder / "lidar" / f"{number:02d}.pkl.gz", columns)
            cuboids = folder / "annotations" / "cuboids" / f"{number:02d}.pkl.gz"
            _put(cuboids, _cuboids(excerpt, frame))
        _write_stamps(folder / "lidar", stamps_ns, track.T_world_ego @ poses.inverse(T_POSE_LIDAR))
        for name in excerpt.cameras:
            _write_camera(folder / "camera" / name, excerpt, street.cameras[name])
        excerpt.write_truth(folder / "truth", stamps_ns.tolist())
    return out / "002"


def _put(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    put(path, gzip.compress(_pickled(columns), 1, mtime=0))


def _check(excerpt: Excerpt) -> None:
    street = excerpt.street
    places = np.stack([np.zeros(3), PANDAR_GT_M])
    origins = street.simulator.sensor.origins_m
    if len(origins) > 2 or not np.array_equal(origins, places[: len(origins)]):
        raise InputError(
            f"{street.name}: cannot be written as PandaSet, whose two scanners stand at fixed "
            f"places; choose --sensor pandaset or a sensor of one scanner such as hdl64"
        )
    if len(excerpt.frames) < 2:
        raise InputError(
            f"{street.name}: cannot be written as PandaSet: got {len(excerpt.frames)} frame, "
            f"expected two or more (points are placed between poses); add frames"
        )
    check_plain_cameras(excerpt, "PandaSet")


def _write_stamps(folder: Path, stamps_ns: Int, T_world: Float) -> None:
    entries = [
        {
            "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "heading": dict(zip("wxyz", quaternion(T).tolist(), strict=True)),
        }
        for T in T_world
    ]
    put(folder / "poses.json", json.dumps(entries).encode())
    put(folder / "timestamps.json", json.dumps([ns / 1e9 for ns in stamps_ns.tolist()]).encode())


def _write_camera(folder: Path, excerpt: Excerpt, camera: Camera) -> None:
    numbers = excerpt.image_numbers(camera.name)
    exposed_ns = np.array([excerpt.street.image_stamps_ns(camera.name)[n] for n in numbers])
    T_lidar_cam = poses.inverse(camera.T_cam_lidar)
    _write_stamps(folder, exposed_ns, excerpt.T_world_ego(exposed_ns, T_lidar_cam))
    K = camera.K
    given = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    put(folder / "intrinsics.json", json.dumps(given).encode())
    for i, number in enumerate(numbers):
        put(folder / f"{i:02d}.jpg", excerpt.jpeg_image(camera.name, number))


def _cuboids(excerpt: Excerpt, frame: int) -> dict[str, NDArray[Any]]:
    """The columns of a frame's boxes; what moves before two scanners has one for each."""
    together = drawn_boxes(excerpt, frame)
    apart = [
        drawn_boxes(excerpt, frame, lidar)
        for lidar in range(len(excerpt.street.simulator.sensor.scanners))
    ]
    names, siblings, scanners, T, size_m, stands = [], [], [], [], [], []
    for row, instance in enumerate(together.instance.tolist()):
        rows = [np.flatnonzero(boxes.instance == instance).tolist() for boxes in apart]
        drawn = [(-1, together, row)]
        if together.moving[row] and len(rows) == 2 and all(rows):
            drawn = [(lidar, apart[lidar], rows[lidar][0]) for lidar in range(2)]
        for scanner, boxes, at in drawn:
            names.append(str(UUID(int=2 * instance + max(scanner, 0))))
            siblings.append("-" if scanner < 0 else str(UUID(int=2 * instance + 1 - scanner)))
            scanners.append(scanner)
            T.append(boxes.T_world_box[at])
            size_m.append(boxes.size_m[at])
            stands.append(not boxes.moving[at])
    T_world_box, size = np.reshape(T, (-1, 4, 4)), np.reshape(size_m, (-1, 3))
    num = len(names)
    return {
        NAME: np.array(names, object),
        "label": np.array(["Car"] * num, object),
        YAW: np.arctan2(T_world_box[:, 1, 0], T_world_box[:, 0, 0]) - np.pi / 2,
        "stationary": np.array(stands, bool),
        "camera_used": np.full(num, -1),
        **dict(zip(CENTRE, T_world_box[:, :3, 3].T, strict=True)),
        **dict(zip(WIDTH_LENGTH_HEIGHT, size[:, [1, 0, 2]].T, strict=True)),
        "cuboids.sibling_id": np.array(siblings, object),
        SCANNER: np.array(scanners, np.int64),
    }


def _pickled(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """(N,) columns -> the pickle that pandas 1.0 makes of a frame with them, opcode by opcode,
    since another pandas (or none) makes another. Columns of a kind lie together."""
    names = list(columns)
    num = len(columns[names[0]])
    kinds = dict.fromkeys(column.dtype for column in columns.values())
    together = [[i for i, n in enumerate(names) if columns[n].dtype == kind] for kind in kinds]
    arrays = [_array(np.stack([columns[names[i]] for i in places])) for places in together]
    blocks = [
        b"}(" + _text("values") + array + _text("mgr_locs") + _places(places) + b"u"
        for array, places in zip(arrays, together, strict=True)
    ]
    rows = b"cpandas.core.indexes.range\nRangeIndex\n}(" + b"".join(
        _text(key) + _data(value)
        for key, value in (("name", None), ("start", 0), ("stop", num), ("step", 1))
    )
    axes = b"](" + _names(names) + b"cpandas.core.indexes.base\n_new_Index\n" + rows + b"u\x86Re"
    of_blocks = b"".join(_names([names[i] for i in places]) for places in together)
    old = b"](" + b"".join(arrays) + b"e](" + of_blocks
    new = b"}" + _text("0.14.1") + b"}(" + _text("axes") + axes
    new += _text("blocks") + b"](" + b"".join(blocks) + b"eus"
    manager = (
        b"cpandas.core.internals.managers\nBlockManager\n)\x81(" + axes + old + b"e" + new + b"tb"
    )
    state = b"}(" + _text("_data") + manager + _text("_typ") + _text("dataframe")
    state += _text("_metadata") + b"]" + _text("attrs") + b"}ub."
    return b"\x80\x03cpandas.core.frame\nDataFrame\n)\x81" + state


def _places(columns: Sequence[int]) -> bytes:
    """Which columns a block has: a slice where they follow each other."""
    first, last = columns[0], columns[-1] + 1
    if last - first == len(columns):
        return b"cbuiltins\nslice\n(" + _data(first) + _data(last) + _data(1) + b"tR"
    return _array(np.array(columns))


def _data(value: Any) -> bytes:
    """Opcodes that put a plain value on the stack."""
    return pickle.dumps(value, 3)[2:-1]


def _text(value: str) -> bytes:
    return b"X" + len(value).to_bytes(4, "little") + value.encode()


def _array(values: NDArray[Any]) -> bytes:
    """As older numpys name their own function."""
    return _data(np.ascontiguousarray(values)).replace(b"numpy._core", b"numpy.core", 1)


def _names(names: Sequence[str]) -> bytes:
    data = _text("data") + _array(np.array(names, object)) + _text("name") + b"N"
    index = b"cpandas.core.indexes.base\nIndex\n}(" + data + b"u"
    return b"cpandas.core.indexes.base\n_new_Index\n" + index + b"\x86R"
