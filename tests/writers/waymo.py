# SPDX-License-Identifier: MIT
"""A street of one spinning scanner as a segment of Waymo's version 2, see `densify.readers.waymo`.

A range image has a column for each firing of all beams. Cameras become FRONT, FRONT_LEFT, ... in
their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float, Int
from densify.readers.waymo import CAMERA, CAMERAS, LASER, OBJECT, STAMP, T_OPTICAL_WAYMO, full_name
from writers.excerpt import Excerpt, drawn_boxes

T_EGO_LIDAR = np.eye(4)  # the place of Waymo's TOP
T_EGO_LIDAR[:3, 3] = [1.43, 0.0, 2.18]
_SHUTTER_S = 0.005
_DOWN, _GLOBAL = 1, 5  # directions of a shutter's readout


def write_waymo(excerpt: Excerpt, out: Path) -> Path:
    street, root = excerpt.street, out / "street"
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    row_of = {frame: pixels(excerpt, frame) for frame in excerpt.frames}
    name = "world_from_vehicle.transform"
    vehicle = [{**_key(excerpt, ns), name: _T_world_ego(excerpt, ns).ravel()} for ns in stamps_ns]
    _put(root, "lidar_calibration", [_laser(excerpt)])
    _put(root, "vehicle_pose", vehicle)
    _put(root, "lidar", [_range_image(excerpt, *item) for item in row_of.items()])
    boxes = [box for frame in excerpt.frames for box in _boxes(excerpt, frame)]
    if boxes:
        _put(root, "lidar_box", boxes)
    names = dict(zip(excerpt.cameras, CAMERAS, strict=False))
    if excerpt.cameras:
        cameras = [street.cameras[name] for name in excerpt.cameras]
        _put(root, "camera_calibration", [_lens(c, i + 1) for i, c in enumerate(cameras)])
        _put(root, "camera_image", _images(excerpt))
    excerpt.write_truth(root / "truth", stamps_ns, inverse(T_EGO_LIDAR), row_of, names)
    return root


def _T_world_ego(excerpt: Excerpt, stamp_ns: int) -> Float:
    return excerpt.pose(stamp_ns, inverse(T_EGO_LIDAR))


def _beams_deg(excerpt: Excerpt) -> Float:
    return np.sort(excerpt.street.simulator.sensor.scanners[0].pattern.elevation_deg)


def pixels(excerpt: Excerpt, frame: int) -> Int:
    """(N,) pixel of each return in the range image, row by row."""
    num_rows = len(_beams_deg(excerpt))
    num_columns, column = excerpt.columns(frame, num_rows)
    return (num_rows - 1 - excerpt.rings(frame)) * num_columns + column


def _range_image(excerpt: Excerpt, frame: int, pixel: Int) -> dict[str, Any]:
    street, returns = excerpt.street, excerpt.returns(frame)
    num_rows = len(_beams_deg(excerpt))
    num_columns, _ = excerpt.columns(frame, num_rows)
    image = np.zeros((num_rows * num_columns, 4), np.float32)
    image[:, :2] = -1.0  # no return
    image[pixel, 0] = np.linalg.norm(excerpt.fired(frame), axis=1)
    image[pixel, 1] = np.arctanh(np.minimum(returns.intensity, 0.999))
    return {
        **_key(excerpt, street.stamp_ns(frame)),
        LASER: np.int8(1),
        "range_image_return1.values": image.ravel(),
        "range_image_return1.shape": np.array((num_rows, num_columns, 4), np.int32),
        "range_image_return2.values": None,
        "range_image_return2.shape": None,
    }


def _laser(excerpt: Excerpt) -> dict[str, Any]:
    beams_rad = np.radians(_beams_deg(excerpt))
    return {
        LASER: np.int8(1),
        "extrinsic.transform": T_EGO_LIDAR.ravel(),
        "beam_inclination.min": float(beams_rad[0]),
        "beam_inclination.max": float(beams_rad[-1]),
        "beam_inclination.values": beams_rad,
    }


def _boxes(excerpt: Excerpt, frame: int) -> Iterator[dict[str, Any]]:
    stamp_ns, boxes = excerpt.street.stamp_ns(frame), drawn_boxes(excerpt, frame)
    T_vehicle_box = inverse(_T_world_ego(excerpt, stamp_ns)) @ boxes.T_world_box
    for instance, T, size_m in zip(boxes.instance, T_vehicle_box, boxes.size_m, strict=True):
        yield {
            **_key(excerpt, stamp_ns),
            OBJECT: f"object_{instance}",
            **{f"box.center.{axis}": value for axis, value in zip("xyz", T[:3, 3], strict=True)},
            **{f"box.size.{axis}": value for axis, value in zip("xyz", size_m, strict=True)},
            "box.heading": float(np.arctan2(T[1, 0], T[0, 0])),
        }


def _lens(camera: Camera, number: int) -> dict[str, Any]:
    lens = {"f_u": camera.K[0, 0], "f_v": camera.K[1, 1]}
    lens |= {"c_u": camera.K[0, 2] + 0.5, "c_v": camera.K[1, 2] + 0.5}
    lens |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    T_vehicle_cam = T_EGO_LIDAR @ inverse(camera.T_cam_lidar) @ T_OPTICAL_WAYMO
    return {
        CAMERA: np.int8(number),
        **{f"intrinsic.{name}": float(value) for name, value in lens.items()},
        "extrinsic.transform": T_vehicle_cam.ravel(),
        "width": np.int32(camera.width_px),
        "height": np.int32(camera.height_px),
        "rolling_shutter_direction": np.int8(_DOWN if camera.row_time_s else _GLOBAL),
    }


def _images(excerpt: Excerpt) -> list[dict[str, Any]]:
    records, shutter = [], "rolling_shutter_params"
    for number, name in enumerate(excerpt.cameras, 1):
        half_s = (excerpt.street.cameras[name].readout_s + _SHUTTER_S) / 2
        exposed_ns = excerpt.street.image_stamps_ns(name)
        for frame, image in zip(excerpt.frames, excerpt.image_numbers(name), strict=True):
            stamp_ns = excerpt.street.stamp_ns(frame)
            pose_ns = stamp_ns if number == 1 else exposed_ns[image]
            records.append(
                {
                    **_key(excerpt, stamp_ns),
                    CAMERA: np.int8(number),
                    "image": excerpt.jpeg_image(name, image),
                    "pose.transform": _T_world_ego(excerpt, pose_ns).ravel(),
                    "pose_timestamp": pose_ns * 1e-9,
                    f"{shutter}.shutter": _SHUTTER_S,
                    f"{shutter}.camera_trigger_time": exposed_ns[image] * 1e-9 - half_s,
                    f"{shutter}.camera_readout_done_time": exposed_ns[image] * 1e-9 + half_s,
                }
            )
    return records


def _key(excerpt: Excerpt, stamp_ns: int) -> dict[str, Any]:
    return {STAMP: np.int64((stamp_ns - excerpt.street.simulator.period_ns // 2) // 1000)}


def _put(root: Path, component: str, records: Sequence[Mapping[str, Any]]) -> None:
    """A row group per record."""
    import pyarrow as arrow
    import pyarrow.parquet

    columns = {}
    for name in records[0]:
        kind = None
        if records[0][name] is None:
            kind = arrow.list_(arrow.int32() if name.endswith("shape") else arrow.float32())
        values = [record[name] for record in records]
        columns[full_name(component, name)] = arrow.array(values, kind)
    (root / component).mkdir(parents=True)
    table = arrow.table(columns)
    arrow.parquet.write_table(table, root / component / "street.parquet", row_group_size=1)
