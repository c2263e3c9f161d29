# SPDX-License-Identifier: MIT
"""Writes a street as a PandaSet sequence, which `densify.readers.pandaset.reader` opens::

    OUT/002/lidar/{00.pkl.gz, ..., poses.json, timestamps.json}
    OUT/002/camera/image_02/{00.jpg, ..., poses.json, timestamps.json, intrinsics.json}
    OUT/002/truth/  as in `densify.readers.truth_files`

The street's scanner stands where the Pandar64 does. Points are compensated with the poses that are
written, so that the reader's undoing is exact; the data set's were with poses at a higher rate.
"""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.errors import InputError
from densify.geometry import poses
from densify.readers.pandaset.reader import PANDAR_GT_M, T_POSE_LIDAR
from densify.readers.pose_track import PoseTrack
from densify.types import Camera, Float, Int, Progress
from densify.writers.excerpt import (
    Excerpt,
    check_plain_cameras,
    new_folder,
    put,
    quaternion,
)

_NAMES = ("x", "y", "z", "i", "t", "d")


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool, progress: Progress | None) -> Path:
    """See `densify.writers.TreeWriter`. The format has room for two or more sweeps of a single
    scanner or of the street's pandaset, and for rectified cameras."""
    _check(excerpt)
    street = excerpt.street
    half_ns = street.simulator.period_ns // 2
    stamps_ns = np.array([street.stamp_ns(f) + half_ns for f in excerpt.frames])
    track = PoseTrack(street.name, stamps_ns, excerpt.T_world_ego(stamps_ns))
    with new_folder(out / "002", overwrite) as folder:
        for number, frame in enumerate(excerpt.frames):
            if progress:
                progress("simulate", number, len(excerpt.frames))
            stamp_ns, returns = int(stamps_ns[number]), excerpt.returns(frame)
            fired = returns.points.astype(np.float64)
            offset_ns = returns.offset_ns - half_ns
            there = track.compensated(fired, stamp_ns, offset_ns)
            world = poses.transform(track.at(stamp_ns), there)
            columns = [*world.T, returns.intensity * 255, (stamp_ns + offset_ns) * 1e-9]
            data = _pickled(np.array(columns), returns.lidar.astype(np.int64)[None])
            put(folder / "lidar" / f"{number:02d}.pkl.gz", gzip.compress(data, 1, mtime=0))
        _write_stamps(folder / "lidar", stamps_ns, track.T_world_ego @ poses.inverse(T_POSE_LIDAR))
        for name in excerpt.cameras:
            _write_camera(folder / "camera" / name, excerpt, street.cameras[name])
        excerpt.write_truth(folder / "truth", stamps_ns.tolist())
        if progress:
            progress("simulate", len(excerpt.frames), len(excerpt.frames))
    return out / "002"


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


def _pickled(floats: Float, whole: NDArray[np.int64]) -> bytes:
    """(5,N), (1,N) -> the pickle that pandas 1.0 makes of a frame with these columns, opcode by
    opcode, since another pandas (or none) makes another."""
    num = floats.shape[1]
    blocks = [
        b"}(" + _text("values") + _array(values) + _text("mgr_locs")
        + b"cbuiltins\nslice\n(" + _data(first) + _data(last) + _data(1) + b"tRu"
        for values, first, last in ((floats, 0, 5), (whole, 5, 6))
    ]  # fmt: skip
    rows = b"cpandas.core.indexes.range\nRangeIndex\n}(" + b"".join(
        _text(key) + _data(value)
        for key, value in (("name", None), ("start", 0), ("stop", num), ("step", 1))
    )
    axes = b"](" + _names(_NAMES) + b"cpandas.core.indexes.base\n_new_Index\n" + rows + b"u\x86Re"
    old = b"](" + _array(floats) + _array(whole) + b"e](" + _names(_NAMES[:5]) + _names(_NAMES[5:])
    new = b"}" + _text("0.14.1") + b"}(" + _text("axes") + axes
    new += _text("blocks") + b"](" + b"".join(blocks) + b"eus"
    manager = (
        b"cpandas.core.internals.managers\nBlockManager\n)\x81(" + axes + old + b"e" + new + b"tb"
    )
    state = b"}(" + _text("_data") + manager + _text("_typ") + _text("dataframe")
    state += _text("_metadata") + b"]" + _text("attrs") + b"}ub."
    return b"\x80\x03cpandas.core.frame\nDataFrame\n)\x81" + state


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
