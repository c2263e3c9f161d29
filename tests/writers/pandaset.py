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
        there = track.compensated(excerpt.fired(frame), stamp_ns, offset_ns)
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
    apart = [
        drawn_boxes(excerpt, frame, lidar)
        for lidar in range(len(excerpt.street.simulator.sensor.scanners))
    ]
    names, scanners, T, size_m = [], [], [], []
    for row, instance in enumerate(together.instance.tolist()):
        rows = [np.flatnonzero(boxes.instance == instance).tolist() for boxes in apart]
        drawn = [(-1, together, row)]
        if together.moving[row] and len(rows) == 2 and all(rows):
            drawn = [(lidar, apart[lidar], rows[lidar][0]) for lidar in range(2)]
        for scanner, boxes, at in drawn:
            names.append(str(UUID(int=2 * instance + max(scanner, 0))))
            scanners.append(scanner)
            T.append(boxes.T_world_box[at])
            size_m.append(boxes.size_m[at])
    T_world_box = np.reshape(T, (-1, 4, 4))
    length_m, width_m, height_m = np.reshape(size_m, (-1, 3)).T
    x, y, z = T_world_box[:, :3, 3].T
    return {
        "uuid": np.array(names, object),
        "yaw": np.arctan2(T_world_box[:, 1, 0], T_world_box[:, 0, 0]) - np.pi / 2,
        **{"position.x": x, "position.y": y, "position.z": z},
        **{"dimensions.x": width_m, "dimensions.y": length_m, "dimensions.z": height_m},
        "cuboids.sensor_id": np.array(scanners, np.int64),
    }


# The pickle that pandas 1.0 makes of a data frame, without pandas


class _Name(NamedTuple):
    """A name that a pickle refers to."""

    module: str
    name: str


class _Made(NamedTuple):
    """What a name is called with, and the state set on the outcome."""

    name: _Name
    args: tuple[Any, ...]
    state: Any = None


class _Pickler(pickle._Pickler):
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, _Name):
            self.write(f"c{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, _Made):
            self.save(obj.name)
            self.save(obj.args)
            self.write(pickle.REDUCE)
            if obj.state is not None:
                self.save(obj.state)
                self.write(pickle.BUILD)
        else:
            super().save(obj, save_persistent_id)


def put_frame(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write (N,) columns; those of a kind lie together, as pandas stores them."""
    names = list(columns)
    kinds = dict.fromkeys(column.dtype for column in columns.values())
    base = "pandas.core.indexes.base"

    def index(of: list[str]) -> _Made:
        made = (_Name(base, "Index"), {"data": np.array(of, object), "name": None})
        return _Made(_Name(base, "_new_Index"), made)

    blocks = []
    for kind in kinds:
        places = [i for i, name in enumerate(names) if columns[name].dtype == kind]
        values = np.stack([columns[names[i]] for i in places])
        rows: Any = np.array(places)
        if places[-1] + 1 - places[0] == len(places):
            rows = _Made(_Name("builtins", "slice"), (places[0], places[-1] + 1, 1))
        blocks.append({"values": values, "mgr_locs": rows})
    num = {"name": None, "start": 0, "stop": len(columns[names[0]]), "step": 1}
    rows_index = _Made(
        _Name(base, "_new_Index"), (_Name("pandas.core.indexes.range", "RangeIndex"), num)
    )
    state = {"0.14.1": {"axes": [index(names), rows_index], "blocks": blocks}}
    manager = _Name("pandas.core.internals.managers", "BlockManager")
    data = {"_data": _Made(manager, (), (None, state)), "_typ": "dataframe"}
    file = io.BytesIO()
    _Pickler(file, 3).dump(_Made(_Name("pandas.core.frame", "DataFrame"), (), data))
    put(path, gzip.compress(file.getvalue(), 1, mtime=0))
