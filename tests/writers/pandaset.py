# SPDX-License-Identifier: MIT
"""A street as a PandaSet sequence, see `densify.readers.pandaset`: the scanner stands where the
Pandar64 does, and points are compensated with the poses that are written."""

from __future__ import annotations

import gzip
import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from densify.geometry import poses
from densify.geometry.types import Float, Int
from densify.readers.pandaset import T_POSE_LIDAR
from densify.readers.recorded_poses import PoseTrack
from writers.excerpt import Excerpt, drawn_boxes, put, quaternion


def write_pandaset(excerpt: Excerpt, out: Path) -> Path:
    street, folder = excerpt.street, out / "002"
    half_ns = street.simulator.period_ns // 2
    stamps_ns = np.array([street.stamp_ns(f) + half_ns for f in excerpt.frames])
    track = PoseTrack(street.name, stamps_ns, excerpt.T_world_ego(stamps_ns))
    for number, frame in enumerate(excerpt.frames):
        stamp_ns, returns = int(stamps_ns[number]), excerpt.returns(frame)
        offset_ns = returns.offset_ns - half_ns
        there = track.compensate(excerpt.fired(frame), stamp_ns, offset_ns)
        world = poses.transform(track.at(stamp_ns), there)
        columns = dict(zip("xyz", world.T, strict=True))
        columns |= {"i": returns.intensity * 255.0, "t": (stamp_ns + offset_ns) * 1e-9}
        columns = {name: values.astype(np.float64) for name, values in columns.items()}
        columns["d"] = returns.lidar.astype(np.int64)
        put_frame(folder / "lidar" / f"{number:02d}.pkl.gz", columns)
        boxes = _cuboids(excerpt, frame)
        put_frame(folder / "annotations" / "cuboids" / f"{number:02d}.pkl.gz", boxes)
    _put_poses(folder / "lidar", stamps_ns, track.T_world_ego @ poses.inverse(T_POSE_LIDAR))
    for name in excerpt.cameras:
        camera, place = street.cameras[name], folder / "camera" / name
        numbers = excerpt.image_numbers(name)
        exposed_ns = np.array([street.image_stamps_ns(name)[n] for n in numbers])
        T_world_cam = excerpt.T_world_ego(exposed_ns, poses.inverse(camera.T_cam_lidar))
        _put_poses(place, exposed_ns, T_world_cam)
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        put(place / "intrinsics.json", json.dumps({"fx": fx, "fy": fy, "cx": cx, "cy": cy}))
        for i, number in enumerate(numbers):
            put(place / f"{i:02d}.jpg", excerpt.jpeg_image(name, number))
    excerpt.write_truth(folder / "truth", stamps_ns.tolist())
    return folder


def _put_poses(folder: Path, stamps_ns: Int, T_world: Float) -> None:
    entries = [
        {
            "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "heading": dict(zip("wxyz", quaternion(T).tolist(), strict=True)),
        }
        for T in T_world
    ]
    put(folder / "poses.json", json.dumps(entries))
    put(folder / "timestamps.json", json.dumps([ns / 1e9 for ns in stamps_ns.tolist()]))


def _cuboids(excerpt: Excerpt, frame: int) -> dict[str, NDArray[Any]]:
    """The columns of a frame's boxes; what moves before two scanners has one for each."""
    together = drawn_boxes(excerpt, frame)
    scanners = range(len(excerpt.street.simulator.sensor.scanners))
    apart = {lidar: drawn_boxes(excerpt, frame, lidar) for lidar in scanners}
    boxes = []  # number of the box, scanner, pose, size
    for row, instance in enumerate(together.instance.tolist()):
        seen_by = [lidar for lidar in scanners if instance in apart[lidar].instance]
        drawn = {-1: together}
        if together.moving[row] and len(seen_by) == 2:
            drawn = apart
        for lidar, drawing in drawn.items():
            at = drawing.instance.tolist().index(instance)
            number = 2 * instance + max(lidar, 0)
            boxes.append((number, lidar, drawing.T_world_box[at], drawing.size_m[at]))
    numbers, lidars, T, size_m = zip(*boxes, strict=True) if boxes else ((), (), (), ())
    T_world_box, size_m = np.reshape(T, (-1, 4, 4)), np.reshape(size_m, (-1, 3))
    return {
        "uuid": np.array([str(UUID(int=number)) for number in numbers], object),
        "yaw": np.arctan2(T_world_box[:, 1, 0], T_world_box[:, 0, 0]) - np.pi / 2,
        **{f"position.{axis}": T_world_box[:, i, 3] for i, axis in enumerate("xyz")},
        **{f"dimensions.{axis}": size_m[:, i] for i, axis in enumerate("yxz")},
        "cuboids.sensor_id": np.array(lidars, np.int64),
    }


# The pickle that pandas 1.0 makes of a data frame, without pandas


class _Made(NamedTuple):
    """What a pickle calls, with which arguments (None: it is only named), and the state it sets."""

    name: str
    args: tuple[Any, ...] | None = None
    state: Any = None


class _Pickler(pickle._Pickler):
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if not isinstance(obj, _Made):
            super().save(obj, save_persistent_id)
            return
        module, _, name = obj.name.rpartition(".")
        self.write(f"c{module}\n{name}\n".encode())
        if obj.args is not None:
            self.save(obj.args)
            self.write(pickle.REDUCE)
        if obj.state is not None:
            self.save(obj.state)
            self.write(pickle.BUILD)


def put_frame(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write (N,) columns; those of a kind lie together, as pandas stores them."""
    names, base = list(columns), "pandas.core.indexes.base"
    blocks = []
    for kind in dict.fromkeys(column.dtype for column in columns.values()):
        numbers = [i for i, name in enumerate(names) if columns[name].dtype == kind]
        rows: Any = np.array(numbers)
        if numbers[-1] + 1 - numbers[0] == len(numbers):
            rows = _Made("builtins.slice", (numbers[0], numbers[-1] + 1, 1))
        values = np.stack([columns[names[i]] for i in numbers])
        blocks.append({"values": values, "mgr_locs": rows})
    rows_index = {"name": None, "start": 0, "stop": len(columns[names[0]]), "step": 1}
    indices = {
        f"{base}.Index": {"data": np.array(names, object), "name": None},
        "pandas.core.indexes.range.RangeIndex": rows_index,
    }
    axes = [_Made(f"{base}._new_Index", (_Made(n), state)) for n, state in indices.items()]
    state = (None, {"0.14.1": {"axes": axes, "blocks": blocks}})
    manager = _Made("pandas.core.internals.managers.BlockManager", (), state)
    data = {"_data": manager, "_typ": "dataframe"}
    file = io.BytesIO()
    _Pickler(file, 3).dump(_Made("pandas.core.frame.DataFrame", (), data))
    put(path, gzip.compress(file.getvalue(), 1, mtime=0))
