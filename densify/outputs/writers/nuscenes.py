# SPDX-License-Identifier: MIT
"""Writes a street as a nuScenes tree of one scene with its truth::

    OUT/street/v1.0-mini/{scene,sample,sample_data,ego_pose,calibrated_sensor,sensor,log}.json
    OUT/street/v1.0-mini/{sample_annotation,instance,category}.json    boxes of the key frames
    OUT/street/{samples,sweeps}/{LIDAR_TOP/*.pcd.bin, NAME/*.jpg}
    OUT/street/truth/    as in `densify.readers.truth_files`

Stamps are those of the last column, in microseconds; points are carried to them by the vehicle's
own motion, those of pulses without a return too.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float, Int
from densify.outputs.writers.boxes import drawn_boxes
from densify.outputs.writers.excerpt import (
    Excerpt,
    check_plain_cameras,
    new_folder,
    put,
    quaternion,
)
from densify.readers.nuscenes.reader import COLUMN_NS, NUM_RINGS
from densify.street.sensors import Spinning

T_LIDAR_POINTS = np.eye(4)  # x right, y forward
T_LIDAR_POINTS[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
T_EGO_LIDAR = np.eye(4)  # where nuScenes' LIDAR_TOP stands
T_EGO_LIDAR[:3, 3] = [0.94, 0.0, 1.84]
T_LIDAR_EGO = inverse(T_EGO_LIDAR)
SCENE, VERSION = "scene-0001", "v1.0-mini"
_LIDAR = "LIDAR_TOP"
_KEY_FRAME_NS = 500_000_000


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format's point times are those of an HDL-32E; cameras
    are rectified."""
    street = excerpt.street
    check_plain_cameras(excerpt, "nuScenes")
    scanners = street.simulator.sensor.scanners
    period_ns = street.simulator.period_ns
    num_columns = round(period_ns / COLUMN_NS)
    pattern = scanners[0].pattern
    if (
        len(scanners) > 1
        or not isinstance(pattern, Spinning)
        or pattern.num_pulses(period_ns * 1e-9) // NUM_RINGS not in range(num_columns - 5, 2**15)
        or len(pattern.elevation_deg) != NUM_RINGS
    ):
        raise InputError(
            f"{street.name}: cannot be written as nuScenes, whose points' times are those of a "
            f"single HDL-32E; choose hdl32, at 20 Hz as there: --sensor hdl32 --hz 20"
        )
    tables, row_of, stamps_ns = _Tables(excerpt), {}, []
    with new_folder(out / "street", overwrite) as root:
        for _, frame in excerpt.numbered():
            stamp_ns = last_column_ns(excerpt, frame)
            row_of[frame], data = _sweep(excerpt, frame, stamp_ns)
            put(root / tables.add(_LIDAR, stamp_ns, ".pcd.bin"), data)
            if tables.records["sample_data"][-1]["is_key_frame"]:
                tables.annotate(frame)
            stamps_ns.append(stamp_ns)
        for name in excerpt.cameras:
            exposed_ns = street.image_stamps_ns(name)
            for number in excerpt.image_numbers(name):
                file = tables.add(name, exposed_ns[number], ".jpg")
                put(root / file, excerpt.jpeg_image(name, number))
        for name, records in tables.finished().items():
            put(root / VERSION / f"{name}.json", json.dumps(records, indent=0).encode())
        excerpt.write_truth(root / "truth", stamps_ns, T_LIDAR_POINTS, row_of)
    return out / "street"


def last_column_ns(excerpt: Excerpt, frame: int) -> int:
    """When the last column of a sweep fires, in whole microseconds."""
    simulator = excerpt.street.simulator
    period_ns = simulator.period_ns
    num_columns = simulator.sensor.scanners[0].pattern.num_pulses(period_ns * 1e-9) // NUM_RINGS
    since_ns = period_ns // 2 - period_ns / num_columns
    return round((simulator.stamp_ns(frame) + since_ns) / 1000) * 1000


def _sweep(excerpt: Excerpt, frame: int, stamp_ns: int) -> tuple[Int, bytes]:
    """The (N,) rows of the returns, and the file: every column has a row for each ring, from the
    lowest."""
    simulator = excerpt.street.simulator
    returns = excerpt.returns(frame)
    num = simulator.sensor.scanners[0].pattern.num_pulses(simulator.period_ns * 1e-9)
    fired_ns = -simulator.period_ns // 2 + np.arange(num) * simulator.period_ns // num
    pulse = np.searchsorted(fired_ns, returns.offset_ns)
    rows = pulse // NUM_RINGS * NUM_RINGS + excerpt.rings(returns)
    points, intensity = np.zeros((num, 3)), np.zeros(num)
    points[rows] = transform(inverse(T_LIDAR_POINTS), returns.points.astype(np.float64))
    intensity[rows] = np.rint(returns.intensity * 255)
    late_ns = simulator.stamp_ns(frame) - stamp_ns
    offset_ns = np.repeat(fired_ns[::NUM_RINGS], NUM_RINGS) + late_ns
    offset_ns[rows] = returns.offset_ns + late_ns
    stored = excerpt.poses(T_LIDAR_POINTS).compensated(points, stamp_ns, offset_ns)
    ring = np.arange(num) % NUM_RINGS
    return rows, np.column_stack([stored, intensity, ring]).astype("<f4").tobytes()


@dataclass
class _Tables:
    """The records of one scene, as they are added."""

    excerpt: Excerpt
    records: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = ("sample_data", "ego_pose", "calibrated_sensor", "sensor", "sample_annotation")
        self.records = {name: [] for name in names}
        self._add_sensor(_LIDAR, "lidar", T_EGO_LIDAR @ T_LIDAR_POINTS, [])
        for name in self.excerpt.cameras:
            camera = self.excerpt.street.cameras[name]
            T_ego_cam = T_EGO_LIDAR @ inverse(camera.T_cam_lidar)
            self._add_sensor(name, "camera", T_ego_cam, camera.K.tolist())

    def _add_sensor(self, channel: str, modality: str, T_ego_sensor: Float, K: list[Any]) -> None:
        token = _token("sensor", channel)
        self.records["sensor"].append({"token": token, "channel": channel, "modality": modality})
        self.records["calibrated_sensor"].append(
            {
                "token": _token("calibrated_sensor", channel),
                "sensor_token": token,
                **_pose(T_ego_sensor),
                "camera_intrinsic": K,
            }
        )

    def add(self, channel: str, stamp_ns: int, suffix: str) -> str:
        """A record of data and its pose; returns the file's name."""
        first_ns = last_column_ns(self.excerpt, self.excerpt.frames[0])
        sample = max(0, -(-(stamp_ns - first_ns) // _KEY_FRAME_NS))
        is_key = (stamp_ns - first_ns) % _KEY_FRAME_NS == 0
        stamp_us = round(stamp_ns / 1000)
        token = _token(channel, str(stamp_us))
        folder = "samples" if is_key else "sweeps"
        camera = self.excerpt.street.cameras.get(channel)
        T_world_ego = self.excerpt.T_world_ego(np.array([stamp_us * 1000]), T_LIDAR_EGO)[0]
        self.records["ego_pose"].append(
            {"token": token, "timestamp": stamp_us, **_pose(T_world_ego)}
        )
        same = [r for r in self.records["sample_data"] if r["filename"].split("/")[1] == channel]
        if same:
            same[-1]["next"] = token
        self.records["sample_data"].append(
            {
                "token": token,
                "sample_token": _token("sample", str(sample)),
                "ego_pose_token": token,
                "calibrated_sensor_token": _token("calibrated_sensor", channel),
                "timestamp": stamp_us,
                "fileformat": "jpg" if camera else "pcd",
                "is_key_frame": is_key,
                "height": camera.height_px if camera else 0,
                "width": camera.width_px if camera else 0,
                "filename": f"{folder}/{channel}/street__{channel}__{stamp_us}{suffix}",
                "prev": same[-1]["token"] if same else "",
                "next": "",
            }
        )
        return str(self.records["sample_data"][-1]["filename"])

    def annotate(self, frame: int) -> None:
        """The boxes of a key frame, whose record of data is the last one."""
        sample = self.records["sample_data"][-1]["sample_token"]
        returns, boxes = self.excerpt.returns(frame), drawn_boxes(self.excerpt, frame)
        annotations = self.records["sample_annotation"]
        for instance, T, size_m in zip(
            boxes.instance, boxes.T_world_box, boxes.size_m, strict=True
        ):
            of_instance = _token("instance", str(instance))
            before = [r for r in annotations if r["instance_token"] == of_instance]
            token = _token(sample, str(instance))
            if before:
                before[-1]["next"] = token
            length, width, height = size_m.tolist()
            annotations.append(
                {
                    "token": token,
                    "sample_token": sample,
                    "instance_token": of_instance,
                    "visibility_token": "4",
                    "attribute_tokens": [],
                    **_pose(T),
                    "size": [width, length, height],
                    "prev": before[-1]["token"] if before else "",
                    "next": "",
                    "num_lidar_pts": int((returns.instance == instance).sum()),
                    "num_radar_pts": 0,
                }
            )

    def _instances(self) -> list[dict[str, Any]]:
        """The objects of the annotations."""
        found: dict[str, list[str]] = {}
        for record in self.records["sample_annotation"]:
            found.setdefault(record["instance_token"], []).append(record["token"])
        return [
            {
                "token": instance,
                "category_token": _CATEGORY["token"],
                "nbr_annotations": len(tokens),
                "first_annotation_token": tokens[0],
                "last_annotation_token": tokens[-1],
            }
            for instance, tokens in found.items()
        ]

    def finished(self) -> dict[str, list[dict[str, Any]]]:
        """All tables by name."""
        first_us = last_column_ns(self.excerpt, self.excerpt.frames[0]) // 1000
        tokens = sorted({r["sample_token"] for r in self.records["sample_data"]})
        numbers = {_token("sample", str(n)): n for n in range(len(tokens) + 1)}
        samples = sorted(tokens, key=numbers.__getitem__)
        scene = {
            "token": _token("scene", SCENE),
            "log_token": _token("log", SCENE),
            "nbr_samples": len(samples),
            "first_sample_token": samples[0],
            "last_sample_token": samples[-1],
            "name": SCENE,
            "description": self.excerpt.street.name,
        }
        return {
            **self.records,
            "scene": [scene],
            "sample": [
                {
                    "token": token,
                    "timestamp": first_us + number * _KEY_FRAME_NS // 1000,
                    "prev": samples[number - 1] if number else "",
                    "next": samples[number + 1] if number + 1 < len(samples) else "",
                    "scene_token": scene["token"],
                }
                for number, token in enumerate(samples)
            ],
            "log": [{"token": scene["log_token"], "logfile": "street", "location": "street"}],
            "category": [_CATEGORY],
            "instance": self._instances(),
            **{name: [] for name in ("attribute", "visibility", "map")},
        }


def _pose(T: Float) -> dict[str, list[float]]:
    return {"translation": T[:3, 3].tolist(), "rotation": quaternion(T).tolist()}


def _token(kind: str, name: str) -> str:
    return hashlib.md5(f"{kind} {name}".encode(), usedforsecurity=False).hexdigest()


_CATEGORY = {"token": _token("category", "vehicle.car"), "name": "vehicle.car", "description": ""}
