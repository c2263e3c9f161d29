# SPDX-License-Identifier: MIT
"""Writes a street as a plain folder with its truth, which `densify.readers.folder.reader` opens::

OUT/street/densify.yaml
OUT/street/sweeps/000000.bin, ...   float32 x y z intensity time lidar, time in s since the stamp,
                                    and radial_velocity of sensors that measure it
OUT/street/timestamps.txt           one time for each sweep (s since 1970)
OUT/street/poses.txt                the lidar's path, TUM: time x y z qx qy qz qw
OUT/street/images/CAMERA/1781258406000000000.png, ...  named by their times (ns)
OUT/street/truth/                   as in `densify.readers.truth_files`
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.types import Camera
from densify.outputs.writers.excerpt import Excerpt, new_folder, put, quaternion
from densify.readers.folder.config import NAME

FOLDER = "street"
COLUMNS = ("x", "y", "z", "intensity", "time", "lidar")


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for everything."""
    street = excerpt.street
    with new_folder(out / FOLDER, overwrite) as folder:
        stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
        for done, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            columns = [returns.intensity, returns.offset_ns * 1e-9, returns.lidar]
            if returns.radial_velocity_m_s is not None:
                columns.append(returns.radial_velocity_m_s)
            table = np.column_stack([returns.points, *columns]).astype("<f4")
            put(folder / "sweeps" / f"{done:06d}.bin", table.tobytes())
        put(folder / "timestamps.txt", "".join(f"{_seconds(ns)}\n" for ns in stamps_ns).encode())
        put(folder / "poses.txt", _tum(excerpt).encode())
        for name in excerpt.cameras:
            exposed_ns = street.image_stamps_ns(name)
            for number in excerpt.image_numbers(name):
                image = excerpt.encoded_image(name, number)
                put(folder / "images" / name / f"{exposed_ns[number]}.png", image)
        put(folder / NAME, config_text(excerpt).encode())
        excerpt.write_truth(folder / "truth", stamps_ns)
    return out / FOLDER


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def _tum(excerpt: Excerpt) -> str:
    track = excerpt.poses()
    lines = ["# time x y z qx qy qz qw: the lidar's pose in the world"]
    for stamp_ns, T in zip(track.stamp_ns.tolist(), track.T_world_ego, strict=True):
        w, *vector = quaternion(T)
        values = (float(v) for v in (*T[:3, 3], *vector, w))
        lines.append(f"{_seconds(stamp_ns)} {' '.join(f'{v:.12g}' for v in values)}")
    return "\n".join(lines) + "\n"


def config_text(excerpt: Excerpt) -> str:
    """The densify.yaml of the excerpt."""
    import yaml

    sensor = excerpt.street.simulator.sensor
    config = {
        "sweeps": {
            "files": "sweeps",
            "columns": [*COLUMNS, *["radial_velocity"] * sensor.measures_velocity],
            "intensity_scale": 1.0,
            "time_unit": "s",
            "time_is": "relative",
            "stamps": "timestamps.txt",
            "stamps_unit": "s",
            "scanner_origins": sensor.origins_m.tolist(),
        },
        "poses": {"file": "poses.txt", "stamps_unit": "s"},
        "cameras": {name: _camera(excerpt.street.cameras[name]) for name in excerpt.cameras},
    }
    text = yaml.safe_dump(config, sort_keys=False, default_flow_style=None, width=100)
    return f"# What the files beside this one cannot say themselves.\n{text}"


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "files": f"images/{camera.name}",
        "stamps": "names",
        "stamps_unit": "ns",
        "model": camera.model,
        "size": [camera.width_px, camera.height_px],
        "K": camera.K.tolist(),
        "distortion": list(camera.distortion),
        "max_angle_deg": camera.max_angle_deg,
        "row_time_s": camera.row_time_s,
        "T_cam_lidar": camera.T_cam_lidar.tolist(),
    }
