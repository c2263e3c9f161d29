# SPDX-License-Identifier: MIT
"""A street as an Argoverse 2 sensor log, see `densify.readers.argoverse2`: stamps are the starts of
the sweeps, points are carried to them by the vehicle's motion and stored as float16."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float
from densify.readers.argoverse2 import BOX_SIZE, LASERS_PER_SCANNER, SCANNERS
from writers.excerpt import Excerpt, drawn_boxes, put, quaternion

T_EGO_LIDAR = np.eye(4)  # the place of Argoverse's up_lidar
T_EGO_LIDAR[:3, 3] = [1.35, 0.0, 1.64]
T_LIDAR_EGO = inverse(T_EGO_LIDAR)


def write_argoverse2(excerpt: Excerpt, out: Path) -> Path:
    street, log = excerpt.street, out / "street"
    half_ns = street.simulator.period_ns // 2
    track = excerpt.poses(T_LIDAR_EGO)
    poses = {"timestamp_ns": track.stamp_ns, **_pose_columns(track.T_world_ego)}
    _put_table(log / "city_SE3_egovehicle.feather", poses)
    _put_calibration(log / "calibration", excerpt)
    _put_boxes(log / "annotations.feather", excerpt, half_ns)
    stamps_ns = [street.stamp_ns(frame) - half_ns for frame in excerpt.frames]
    for frame, stamp_ns in zip(excerpt.frames, stamps_ns, strict=True):
        returns, offset_ns = excerpt.returns(frame), excerpt.returns(frame).offset_ns + half_ns
        laser = returns.lidar * LASERS_PER_SCANNER + excerpt.rings(frame)
        fired = transform(T_EGO_LIDAR, excerpt.fired(frame))
        points = track.compensate(fired, stamp_ns, offset_ns).astype(np.float16)
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
    excerpt.write_truth(log / "truth", stamps_ns, T_LIDAR_EGO)
    return log


def _put_boxes(path: Path, excerpt: Excerpt, half_ns: int) -> None:
    tables: list[dict[str, NDArray[Any]]] = []
    for frame in excerpt.frames:
        stamp_ns, boxes = excerpt.street.stamp_ns(frame) - half_ns, drawn_boxes(excerpt, frame)
        tables.append(
            {
                "timestamp_ns": np.full(len(boxes.instance), stamp_ns),
                "track_uuid": np.array([f"{i:032x}" for i in boxes.instance], object),
                **dict(zip(BOX_SIZE, boxes.size_m.T, strict=True)),
                **_pose_columns(inverse(excerpt.pose(stamp_ns, T_LIDAR_EGO)) @ boxes.T_world_box),
            }
        )
    _put_table(path, {n: np.concatenate([t[n] for t in tables]) for n in tables[0]})


def _put_calibration(folder: Path, excerpt: Excerpt) -> None:
    cameras = [excerpt.street.cameras[name] for name in excerpt.cameras]
    origins_m = excerpt.street.simulator.sensor.origins_m
    T_lidar_scanner = np.tile(np.eye(4), (2, 1, 1))
    T_lidar_scanner[:, :3, 3] = origins_m[[0, -1]]  # without a second one it measures nothing
    T_ego_sensor = [T_EGO_LIDAR @ T for T in T_lidar_scanner]
    T_ego_sensor += [T_EGO_LIDAR @ inverse(camera.T_cam_lidar) for camera in cameras]
    names = np.array([*SCANNERS, *excerpt.cameras], object)
    poses = {"sensor_name": names, **_pose_columns(np.stack(T_ego_sensor))}
    _put_table(folder / "egovehicle_SE3_sensor.feather", poses)
    K = np.array([camera.K for camera in cameras]).reshape(-1, 3, 3)
    intrinsics = {
        "sensor_name": np.array(excerpt.cameras, object),
        **{"fx_px": K[:, 0, 0], "fy_px": K[:, 1, 1], "cx_px": K[:, 0, 2], "cy_px": K[:, 1, 2]},
        "height_px": np.array([camera.height_px for camera in cameras], np.uint16),
        "width_px": np.array([camera.width_px for camera in cameras], np.uint16),
    }
    _put_table(folder / "intrinsics.feather", intrinsics)


def _pose_columns(T: Float) -> dict[str, Float]:
    """(n,4,4) -> the columns of a table of poses."""
    columns = dict(zip(("qw", "qx", "qy", "qz"), quaternion(T).T, strict=True))
    return columns | dict(zip(("tx_m", "ty_m", "tz_m"), T[:, :3, 3].T, strict=True))


def _put_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    import pyarrow
    import pyarrow.feather

    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        name: pyarrow.array(column.tolist() if column.dtype == object else column.copy())
        for name, column in columns.items()
    }
    pyarrow.feather.write_feather(pyarrow.table(arrays), path)
