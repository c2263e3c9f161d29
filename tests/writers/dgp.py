# SPDX-License-Identifier: MIT
"""A street as a DGP scene, see `densify.readers.dgp`: points are compensated to the middle of the
sweep, and stamps are tenths of microseconds taken for microseconds, as DDAD's are."""

from __future__ import annotations

import io
import json
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Float
from writers.excerpt import Excerpt, put, quaternion

_T_EGO_LIDAR = np.eye(4)
_T_EGO_LIDAR[:3, 3] = [1.1, 0.0, 1.73]


def write_dgp(excerpt: Excerpt, out: Path) -> Path:
    street, folder, data = excerpt.street, out / "scene_01", []
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    for frame, stamp_ns in zip(excerpt.frames, stamps_ns, strict=True):
        returns, file = excerpt.returns(frame), io.BytesIO()
        points = excerpt.poses().compensate(excerpt.fired(frame), stamp_ns, returns.offset_ns)
        np.savez(file, data=np.column_stack([points, returns.intensity]))
        name = f"point_cloud/LIDAR/{stamp_ns // 100}.npz"
        put(folder / name, file.getvalue())
        fields = {"point_format": ["X", "Y", "Z", "INTENSITY"]}
        data.append(_datum("point_cloud", "LIDAR", stamp_ns, name, excerpt.pose(stamp_ns), fields))
    for name in excerpt.cameras:
        camera = street.cameras[name]
        for image in excerpt.image_numbers(name):
            stamp_ns = street.image_stamps_ns(name)[image]
            file_name = f"rgb/{name}/{stamp_ns // 100}.png"
            put(folder / file_name, excerpt.png_image(name, image))
            size = {"width": camera.width_px, "height": camera.height_px}
            T = excerpt.pose(stamp_ns, poses.inverse(camera.T_cam_lidar))
            data.append(_datum("image", name, stamp_ns, file_name, T, size))
    put(folder / "calibration" / "abc.json", json.dumps(_calibration(excerpt)))
    sample = {"calibration_key": "abc", "datum_keys": [datum["key"] for datum in data]}
    put(folder / "scene_abc.json", json.dumps({"data": data, "samples": [sample]}))
    excerpt.write_truth(folder / "truth", stamps_ns)
    return folder


def _datum(
    kind: str, sensor: str, stamp_ns: int, file: str, T_world_sensor: Float, more: dict[str, Any]
) -> dict[str, Any]:
    date = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(microseconds=stamp_ns // 100)
    text = date.isoformat(timespec="microseconds").replace("+00:00", "Z")
    return {
        "id": {"name": sensor, "timestamp": text},
        "key": file,
        "datum": {kind: {"filename": file, "pose": _pose(T_world_sensor), **more}},
    }


def _pose(T: Float) -> dict[str, dict[str, float]]:
    turn = dict(zip(("qw", "qx", "qy", "qz"), quaternion(T).tolist(), strict=True))
    return {"rotation": turn, "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True))}


def _calibration(excerpt: Excerpt) -> dict[str, Any]:
    cameras = [excerpt.street.cameras[name] for name in excerpt.cameras]
    K = [np.zeros((3, 3)), *(camera.K for camera in cameras)]
    T_ego_sensor = [_T_EGO_LIDAR, *(_T_EGO_LIDAR @ poses.inverse(c.T_cam_lidar) for c in cameras)]
    return {
        "names": ["LIDAR", *excerpt.cameras],
        "extrinsics": [_pose(T) for T in T_ego_sensor],
        "intrinsics": [
            {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "skew": 0.0} for k in K
        ],
    }
