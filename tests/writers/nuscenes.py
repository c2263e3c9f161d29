# SPDX-License-Identifier: MIT
"""A street of an HDL-32E as a nuScenes tree of one scene, see `densify.readers.nuscenes`: stamps
are those of the last column, and points are carried to them by the vehicle's motion."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float, Int
from writers.excerpt import Excerpt, drawn_boxes, put, quaternion

T_LIDAR_POINTS = np.eye(4)  # x right, y forward
T_LIDAR_POINTS[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
T_EGO_LIDAR = np.eye(4)  # the place of nuScenes' LIDAR_TOP
T_EGO_LIDAR[:3, 3] = [0.94, 0.0, 1.84]
_KEY_FRAME_NS = 500_000_000
_RINGS = 32


def write_nuscenes(excerpt: Excerpt, out: Path) -> Path:
    street, root, tables = excerpt.street, out / "street", defaultdict(list)
    T_ego_sensor = {"LIDAR_TOP": (T_EGO_LIDAR @ T_LIDAR_POINTS, [])}
    for name in excerpt.cameras:
        camera = street.cameras[name]
        T_ego_sensor[name] = (T_EGO_LIDAR @ inverse(camera.T_cam_lidar), camera.K.tolist())
    for name, (T, K) in T_ego_sensor.items():
        modality = "camera" if K else "lidar"
        tables["sensor"].append({"token": name, "channel": name, "modality": modality})
        calibration = {"token": f"c{name}", "sensor_token": name, "camera_intrinsic": K}
        tables["calibrated_sensor"].append(calibration | _pose(T))
    row_of, stamps_ns = {}, [last_column_ns(excerpt, frame) for frame in excerpt.frames]
    for frame, stamp_ns in zip(excerpt.frames, stamps_ns, strict=True):
        row_of[frame], data = _sweep(excerpt, frame, stamp_ns)
        put(root / _add(tables, excerpt, "LIDAR_TOP", stamp_ns, ".pcd.bin"), data)
        if (stamp_ns - stamps_ns[0]) % _KEY_FRAME_NS == 0:
            _annotate(tables, excerpt, frame)
    for name in excerpt.cameras:
        for number in excerpt.image_numbers(name):
            file = _add(tables, excerpt, name, street.image_stamps_ns(name)[number], ".jpg")
            put(root / file, excerpt.jpeg_image(name, number))
    samples = {record["sample_token"] for record in tables["sample_data"]}
    tables["sample"] = [
        {
            "token": token,
            "timestamp": (stamps_ns[0] + int(token) * _KEY_FRAME_NS) // 1000,
            "scene_token": "s",
        }
        for token in sorted(samples, key=int)
    ]
    tables["scene"] = [{"token": "s", "name": "scene-0001"}]
    for name, records in tables.items():
        put(root / "v1.0-mini" / f"{name}.json", json.dumps(records, indent=0))
    excerpt.write_truth(root / "truth", stamps_ns, T_LIDAR_POINTS, row_of)
    return root


def last_column_ns(excerpt: Excerpt, frame: int) -> int:
    """The time of the last column of a sweep, in whole microseconds."""
    period_ns = excerpt.street.simulator.period_ns
    num_columns, _ = excerpt.columns(frame, _RINGS)
    since_ns = period_ns // 2 - period_ns / num_columns
    return round((excerpt.street.stamp_ns(frame) + since_ns) / 1000) * 1000


def _sweep(excerpt: Excerpt, frame: int, stamp_ns: int) -> tuple[Int, bytes]:
    """The (N,) rows of the returns, and the file: a row for each ring of each column."""
    returns, period_ns = excerpt.returns(frame), excerpt.street.simulator.period_ns
    num_columns, column = excerpt.columns(frame, _RINGS)
    rows, num = column * _RINGS + excerpt.rings(frame), num_columns * _RINGS
    points, intensity = np.zeros((num, 3)), np.zeros(num)
    points[rows] = transform(inverse(T_LIDAR_POINTS), excerpt.fired(frame))
    intensity[rows] = np.rint(returns.intensity * 255)
    late_ns = excerpt.street.stamp_ns(frame) - stamp_ns
    offset_ns = np.arange(num) // _RINGS * period_ns // num_columns - period_ns // 2 + late_ns
    offset_ns[rows] = returns.offset_ns + late_ns
    stored = excerpt.poses(T_LIDAR_POINTS).compensate(points, stamp_ns, offset_ns)
    ring = np.arange(num) % _RINGS
    return rows, np.column_stack([stored, intensity, ring]).astype("<f4").tobytes()


def _add(tables: Any, excerpt: Excerpt, channel: str, stamp_ns: int, suffix: str) -> str:
    """Add a record of data and its pose, and return the file's name."""
    sample = max(0, -(-(stamp_ns - last_column_ns(excerpt, excerpt.frames[0])) // _KEY_FRAME_NS))
    stamp_us, camera = round(stamp_ns / 1000), excerpt.street.cameras.get(channel)
    token = f"{channel}{stamp_us}"
    T_world_ego = excerpt.pose(stamp_us * 1000, inverse(T_EGO_LIDAR))
    pose = {"token": token, "timestamp": stamp_us, **_pose(T_world_ego)}
    tables["ego_pose"].append(pose)
    record = {
        "token": token,
        "sample_token": str(sample),
        "ego_pose_token": token,
        "calibrated_sensor_token": f"c{channel}",
        "timestamp": stamp_us,
        "height": camera.height_px if camera else 0,
        "width": camera.width_px if camera else 0,
        "filename": f"samples/{channel}/street__{channel}__{stamp_us}{suffix}",
    }
    tables["sample_data"].append(record)
    return record["filename"]


def _annotate(tables: Any, excerpt: Excerpt, frame: int) -> None:
    """Add the boxes of a key frame, whose record of data is the last one."""
    sample, boxes = tables["sample_data"][-1]["sample_token"], drawn_boxes(excerpt, frame)
    for instance, T, size_m in zip(boxes.instance, boxes.T_world_box, boxes.size_m, strict=True):
        length, width, height = size_m.tolist()
        record = {"token": f"{sample} {instance}", "sample_token": sample}
        record |= {"instance_token": str(instance), "size": [width, length, height], **_pose(T)}
        tables["sample_annotation"].append(record)


def _pose(T: Float) -> dict[str, list[float]]:
    return {"translation": T[:3, 3].tolist(), "rotation": quaternion(T).tolist()}
