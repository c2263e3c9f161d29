# SPDX-License-Identifier: MIT
"""Writes a street as an Argoverse 2 sensor log with its truth, see `densify.readers.argoverse2`::

    OUT/street/sensors/{lidar/NS.feather, cameras/NAME/NS.jpg}
    OUT/…/annotations.feather
    OUT/…/city_SE3_egovehicle.feather, calibration/{egovehicle_SE3_sensor,intrinsics}.feather
    OUT/…/truth/    as in `densify.readers.truth_files`

Stamps are the starts of the sweeps; points are carried to them by the vehicle's own motion and
stored as float16.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float
from densify.outputs.writers.boxes import drawn_boxes
from densify.outputs.writers.excerpt import (
    Excerpt,
    check_plain_cameras,
    new_folder,
    put,
    quaternion,
)
from densify.readers.argoverse2 import (
    ANNOTATIONS,
    BOX_SIZE,
    LASERS_PER_SCANNER,
    POSES,
    SCANNERS,
)
from densify.readers.extras import needed
from densify.street.sensors import Spinning

T_EGO_LIDAR = np.eye(4)  # where Argoverse's up_lidar stands
T_EGO_LIDAR[:3, 3] = [1.35, 0.0, 1.64]
LOG = "street"


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for two scanners of up to 32 rings, and
    for rectified cameras."""
    street = excerpt.street
    check_plain_cameras(excerpt, "Argoverse 2")
    patterns = [scanner.pattern for scanner in street.simulator.sensor.scanners]
    if len(patterns) > len(SCANNERS) or not all(
        isinstance(pattern, Spinning) and len(pattern.elevation_deg) <= LASERS_PER_SCANNER
        for pattern in patterns
    ):
        raise InputError(
            f"{street.name}: cannot be written as Argoverse 2, which has two scanners of 32 rings; "
            f"choose dual32, hdl32 or vlp16"
        )
    half_ns = street.simulator.period_ns // 2
    track = excerpt.poses(inverse(T_EGO_LIDAR))
    with new_folder(out / LOG, overwrite) as log:
        _put_table(
            log / POSES, {"timestamp_ns": track.stamp_ns, **_pose_columns(track.T_world_ego)}
        )
        _put_calibration(log / "calibration", excerpt)
        _put_boxes(log / ANNOTATIONS, excerpt, half_ns)
        for _, frame in excerpt.numbered():
            returns = excerpt.returns(frame)
            stamp_ns = street.stamp_ns(frame) - half_ns
            laser = returns.lidar * LASERS_PER_SCANNER + excerpt.rings(returns)
            offset_ns = returns.offset_ns + half_ns
            fired = transform(T_EGO_LIDAR, returns.points.astype(np.float64))
            points = track.compensated(fired, stamp_ns, offset_ns).astype(np.float16)
            columns = {
                **dict(zip("xyz", points.T, strict=True)),
                "intensity": np.rint(returns.intensity * 255).astype(np.uint8),
                "laser_number": laser.astype(np.uint8),
                "offset_ns": offset_ns.astype(np.int32),
            }
            _put_table(log / "sensors" / "lidar" / f"{stamp_ns}.feather", columns)
        for name in excerpt.cameras:
            exposed_ns = street.image_stamps_ns(name)
            for number in excerpt.image_numbers(name):
                path = log / "sensors" / "cameras" / name / f"{exposed_ns[number]}.jpg"
                put(path, excerpt.jpeg_image(name, number))
        stamps_ns = [street.stamp_ns(frame) - half_ns for frame in excerpt.frames]
        excerpt.write_truth(log / "truth", stamps_ns, inverse(T_EGO_LIDAR))
    return out / LOG


def _put_boxes(path: Path, excerpt: Excerpt, half_ns: int) -> None:
    """Write the boxes in the vehicle's frame at each sweep's stamp."""
    tables: list[dict[str, NDArray[Any]]] = []
    for frame in excerpt.frames:
        stamp_ns = excerpt.street.stamp_ns(frame) - half_ns
        T_world_ego = excerpt.T_world_ego(np.array([stamp_ns]), inverse(T_EGO_LIDAR))[0]
        boxes = drawn_boxes(excerpt, frame)
        num = len(boxes.instance)
        tables.append(
            {
                "timestamp_ns": np.full(num, stamp_ns),
                "track_uuid": np.array([f"{i:032x}" for i in boxes.instance], object),
                "category": np.array(["REGULAR_VEHICLE"] * num, object),
                **dict(zip(BOX_SIZE, boxes.size_m.T, strict=True)),
                **_pose_columns(inverse(T_world_ego) @ boxes.T_world_box),
            }
        )
    _put_table(path, {n: np.concatenate([t[n] for t in tables]) for n in tables[0]})


def _put_calibration(folder: Path, excerpt: Excerpt) -> None:
    cameras = [excerpt.street.cameras[name] for name in excerpt.cameras]
    origins_m = excerpt.street.simulator.sensor.origins_m
    T_ego_sensor = []
    for number in range(len(SCANNERS)):  # a second one that is not there measures nothing
        T_lidar_scanner = np.eye(4)
        T_lidar_scanner[:3, 3] = origins_m[min(number, len(origins_m) - 1)]
        T_ego_sensor.append(T_EGO_LIDAR @ T_lidar_scanner)
    T_ego_sensor += [T_EGO_LIDAR @ inverse(camera.T_cam_lidar) for camera in cameras]
    names = np.array([*SCANNERS, *excerpt.cameras], object)
    poses = {"sensor_name": names, **_pose_columns(np.stack(T_ego_sensor))}
    _put_table(folder / "egovehicle_SE3_sensor.feather", poses)
    K = np.array([camera.K for camera in cameras]).reshape(-1, 3, 3)
    intrinsics = {
        "sensor_name": np.array(excerpt.cameras, object),
        "fx_px": K[:, 0, 0],
        "fy_px": K[:, 1, 1],
        "cx_px": K[:, 0, 2],
        "cy_px": K[:, 1, 2],
        **{f"k{i}": np.zeros(len(cameras)) for i in (1, 2, 3)},
        "height_px": np.array([camera.height_px for camera in cameras], np.uint16),
        "width_px": np.array([camera.width_px for camera in cameras], np.uint16),
    }
    _put_table(folder / "intrinsics.feather", intrinsics)


def _pose_columns(T: Float) -> dict[str, Float]:
    """(n,4,4) -> the columns of a table of poses."""
    columns = dict(zip(("qw", "qx", "qy", "qz"), quaternion(T).T, strict=True))
    return columns | dict(zip(("tx_m", "ty_m", "tz_m"), T[:, :3, 3].T, strict=True))


def _put_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    arrow = needed("pyarrow", "argoverse", "Argoverse 2 recordings")
    feather = needed("pyarrow.feather", "argoverse", "Argoverse 2 recordings")
    arrays = {
        name: arrow.array(column.tolist(), arrow.string())
        if column.dtype == object
        else arrow.array(np.ascontiguousarray(column))
        for name, column in columns.items()
    }
    sink = arrow.BufferOutputStream()
    feather.write_feather(arrow.table(arrays), sink)
    put(path, sink.getvalue().to_pybytes())
