# SPDX-License-Identifier: MIT
"""Writes a street as a segment of Waymo's version 2 with its truth::

    OUT/street/{lidar,lidar_pose,lidar_calibration,vehicle_pose}/street.parquet
    OUT/street/{camera_image,camera_calibration}/street.parquet
    OUT/street/lidar_box/street.parquet
    OUT/street/truth/    as in `densify.readers.truth_files`, cameras by Waymo's names

A range image has a column for each firing of all beams: within it, beams that fire one after the
other get the azimuth of the column's middle. Cameras become FRONT, FRONT_LEFT, ... in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Camera, Float, Float32, Int
from densify.outputs.writers.boxes import drawn_boxes
from densify.outputs.writers.excerpt import Excerpt, new_folder, put
from densify.readers.extras import needed
from densify.readers.waymo.components import (
    BOX_CENTRE,
    BOX_HEADING,
    BOX_SIZE,
    CAMERA,
    CAMERAS,
    DOWN,
    LASER,
    OBJECT,
    STAMP,
    T_OPTICAL_WAYMO,
    UP,
)
from densify.street.sensors import Spinning

T_EGO_LIDAR = np.eye(4)  # where Waymo's TOP stands
T_EGO_LIDAR[:3, 3] = [1.43, 0.0, 2.18]
CONTEXT = "street"
_CONTEXT_KEY = "key.segment_context_name"
_SHUTTER_S = 0.005
_GLOBAL_SHUTTER = 5
_TOP = 1


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has times for a single spinning lidar only, and
    room for five pinholes with an image for each sweep."""
    street = excerpt.street
    scanners = street.simulator.sensor.scanners
    pattern = scanners[0].pattern
    if len(scanners) > 1 or not isinstance(pattern, Spinning):
        raise InputError(
            f"{street.name}: cannot be written as Waymo's, which has times for a single spinning "
            f"lidar; choose hdl64, hdl32, vlp16, os128 or vls128"
        )
    _check_cameras(excerpt)
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    row_of = {frame: _pixels(excerpt, frame, pattern) for frame in excerpt.frames}
    with new_folder(out / "street", overwrite) as root:
        _put(root, "lidar_calibration", [_laser(excerpt, pattern)])
        _put(root, "vehicle_pose", [_vehicle(excerpt, ns) for ns in stamps_ns])
        ranges, poses = [], []
        for _, frame in excerpt.numbered():
            image, pose = _range_image(excerpt, frame, pattern, row_of[frame])
            ranges.append(image)
            poses.append(pose)
        _put(root, "lidar", ranges)
        _put(root, "lidar_pose", poses)
        boxes = [box for frame in excerpt.frames for box in _boxes(excerpt, frame)]
        if boxes:
            _put(root, "lidar_box", boxes)
        if excerpt.cameras:
            cameras = [street.cameras[name] for name in excerpt.cameras]
            _put(root, "camera_calibration", [_lens(c, i + 1) for i, c in enumerate(cameras)])
            _put(root, "camera_image", _images(excerpt))
        excerpt.write_truth(root / "truth", stamps_ns, inverse(T_EGO_LIDAR), row_of)
        for name, theirs in zip(excerpt.cameras, CAMERAS, strict=False):
            (root / "truth" / "depth" / name).rename(root / "truth" / "depth" / theirs)
    return out / "street"


def _check_cameras(excerpt: Excerpt) -> None:
    for name in excerpt.cameras:
        camera, num = excerpt.street.cameras[name], len(excerpt.image_numbers(name))
        fits = camera.model == "pinhole" and len(camera.distortion) <= 5
        if not fits or num != len(excerpt.frames) or len(excerpt.cameras) > len(CAMERAS):
            raise InputError(
                f"{excerpt.street.name}: camera {name} cannot be written as Waymo's, which are up "
                f"to {len(CAMERAS)} pinholes with an image for each sweep; got a {camera.model} "
                f"with {num} images in {len(excerpt.frames)} sweeps; leave it out"
            )


def _size(excerpt: Excerpt, pattern: Spinning) -> tuple[int, int]:
    """Rows and columns of the range image."""
    num_beams = len(pattern.elevation_deg)
    return num_beams, pattern.num_pulses(excerpt.street.simulator.period_ns * 1e-9) // num_beams


def _pixels(excerpt: Excerpt, frame: int, pattern: Spinning) -> Int:
    """(N,) pixel of each return, row by row."""
    num_rows, num_columns = _size(excerpt, pattern)
    returns, period_ns = excerpt.returns(frame), excerpt.street.simulator.period_ns
    num = num_rows * num_columns
    fired_ns = -period_ns // 2 + np.arange(num, dtype=np.int64) * period_ns // num
    column = np.searchsorted(fired_ns, returns.offset_ns) // num_rows
    return (num_rows - 1 - excerpt.rings(returns)) * num_columns + column


def _range_image(
    excerpt: Excerpt, frame: int, pattern: Spinning, pixel: Int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The records of the ranges and of the poses."""
    num_rows, num_columns = _size(excerpt, pattern)
    street, returns = excerpt.street, excerpt.returns(frame)
    stamp_ns, period_ns = street.stamp_ns(frame), street.simulator.period_ns
    image = np.zeros((num_rows * num_columns, 4), np.float32)
    image[:, :2] = -1.0  # no return
    image[pixel, 0] = np.linalg.norm(returns.points.astype(np.float64), axis=1)
    image[pixel, 1] = np.arctanh(np.minimum(returns.intensity, 0.999))
    share = (np.arange(num_columns) + 0.5) / num_columns - 0.5
    times_ns = stamp_ns + np.rint(share * period_ns).astype(np.int64)
    columns = pixel_poses(excerpt.T_world_ego(times_ns, inverse(T_EGO_LIDAR)))
    pose = np.broadcast_to(columns, (num_rows, *columns.shape)).astype(np.float32)
    key = {**_key(excerpt, stamp_ns), LASER: np.int8(_TOP)}
    ranges = {
        **key,
        **_matrix("[LiDARComponent].range_image_return1", image, (num_rows, num_columns, 4)),
        "[LiDARComponent].range_image_return2.values": None,
        "[LiDARComponent].range_image_return2.shape": None,
    }
    return ranges, {**key, **_matrix("[LiDARPoseComponent].range_image_return1", pose, pose.shape)}


def pixel_poses(T_world_vehicle: Float) -> Float:
    """(...,4,4) -> (...,6) roll pitch yaw x y z, as ``lidar_pose`` stores poses."""
    yaw_pitch_roll = Rotation.from_matrix(T_world_vehicle[..., :3, :3]).as_euler("ZYX")
    return np.concatenate([yaw_pitch_roll[..., ::-1], T_world_vehicle[..., :3, 3]], axis=-1)


def _laser(excerpt: Excerpt, pattern: Spinning) -> dict[str, Any]:
    T_lidar_scanner = np.eye(4)
    T_lidar_scanner[:3, 3] = excerpt.street.simulator.sensor.origins_m[0]
    beams_rad = np.radians(np.sort(pattern.elevation_deg))
    head = "[LiDARCalibrationComponent]"
    return {
        _CONTEXT_KEY: CONTEXT,
        LASER: np.int8(_TOP),
        f"{head}.extrinsic.transform": (T_EGO_LIDAR @ T_lidar_scanner).ravel(),
        f"{head}.beam_inclination.min": float(beams_rad[0]),
        f"{head}.beam_inclination.max": float(beams_rad[-1]),
        f"{head}.beam_inclination.values": beams_rad,
    }


def _vehicle(excerpt: Excerpt, stamp_ns: int) -> dict[str, Any]:
    T = excerpt.T_world_ego(np.array([stamp_ns]), inverse(T_EGO_LIDAR))[0]
    name = "[VehiclePoseComponent].world_from_vehicle.transform"
    return {**_key(excerpt, stamp_ns), name: T.ravel()}


def _boxes(excerpt: Excerpt, frame: int) -> Iterator[dict[str, Any]]:
    stamp_ns, boxes = excerpt.street.stamp_ns(frame), drawn_boxes(excerpt, frame)
    T_world_vehicle = excerpt.T_world_ego(np.array([stamp_ns]), inverse(T_EGO_LIDAR))[0]
    T_vehicle_box = inverse(T_world_vehicle) @ boxes.T_world_box
    for instance, T, size_m in zip(boxes.instance, T_vehicle_box, boxes.size_m, strict=True):
        yield {
            **_key(excerpt, stamp_ns),
            OBJECT: f"object_{instance}",
            **dict(zip(BOX_CENTRE, T[:3, 3].tolist(), strict=True)),
            **dict(zip(BOX_SIZE, size_m.tolist(), strict=True)),
            BOX_HEADING: float(np.arctan2(T[1, 0], T[0, 0])),
            "[LiDARBoxComponent].type": np.int8(1),
        }


def _lens(camera: Camera, number: int) -> dict[str, Any]:
    head = "[CameraCalibrationComponent]"
    k1, k2, p1, p2, k3 = (*camera.distortion, *(0.0,) * (5 - len(camera.distortion)))
    lens = {"f_u": camera.K[0, 0], "f_v": camera.K[1, 1]}
    lens |= {"c_u": camera.K[0, 2] + 0.5, "c_v": camera.K[1, 2] + 0.5}
    lens |= {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
    T_vehicle_cam = T_EGO_LIDAR @ inverse(camera.T_cam_lidar) @ T_OPTICAL_WAYMO
    direction = DOWN if camera.row_time_s > 0 else UP if camera.row_time_s else _GLOBAL_SHUTTER
    return {
        _CONTEXT_KEY: CONTEXT,
        CAMERA: np.int8(number),
        **{f"{head}.intrinsic.{name}": float(value) for name, value in lens.items()},
        f"{head}.extrinsic.transform": T_vehicle_cam.ravel(),
        f"{head}.width": np.int32(camera.width_px),
        f"{head}.height": np.int32(camera.height_px),
        f"{head}.rolling_shutter_direction": np.int8(direction),
    }


def _images(excerpt: Excerpt) -> list[dict[str, Any]]:
    records, head = [], "[CameraImageComponent]"
    for number, name in enumerate(excerpt.cameras, 1):
        readout_s = excerpt.street.cameras[name].readout_s
        exposed_ns = excerpt.street.image_stamps_ns(name)
        for frame, image in zip(excerpt.frames, excerpt.image_numbers(name), strict=True):
            stamp_ns = excerpt.street.stamp_ns(frame)
            pose_ns = stamp_ns if number == 1 else exposed_ns[image]
            T = excerpt.T_world_ego(np.array([pose_ns]), inverse(T_EGO_LIDAR))[0]
            half_s = (readout_s + _SHUTTER_S) / 2
            shutter = f"{head}.rolling_shutter_params"
            records.append(
                {
                    **_key(excerpt, stamp_ns),
                    CAMERA: np.int8(number),
                    f"{head}.image": excerpt.jpeg_image(name, image),
                    f"{head}.pose.transform": T.ravel(),
                    f"{head}.pose_timestamp": pose_ns * 1e-9,
                    f"{shutter}.shutter": _SHUTTER_S,
                    f"{shutter}.camera_trigger_time": exposed_ns[image] * 1e-9 - half_s,
                    f"{shutter}.camera_readout_done_time": exposed_ns[image] * 1e-9 + half_s,
                }
            )
    return records


def _key(excerpt: Excerpt, stamp_ns: int) -> dict[str, Any]:
    start_ns = stamp_ns - excerpt.street.simulator.period_ns // 2
    return {_CONTEXT_KEY: CONTEXT, STAMP: np.int64(start_ns // 1000)}


def _matrix(name: str, array: Float32, shape: Sequence[int]) -> dict[str, Any]:
    return {f"{name}.values": array.ravel(), f"{name}.shape": np.array(shape, np.int32)}


def _put(root: Path, component: str, records: Sequence[Mapping[str, Any]]) -> None:
    """A row, and a group of rows, for each record."""
    arrow = needed("pyarrow", "waymo", "Waymo recordings")
    parquet = needed("pyarrow.parquet", "waymo", "Waymo recordings")
    columns = {}
    for name in records[0]:
        values = [record[name] for record in records]
        kind = None
        if values[0] is None:
            is_shape = name.endswith("shape")
            kind = arrow.list_(arrow.int32()) if is_shape else arrow.list_(arrow.float32())
        columns[name] = arrow.array(values, kind)
    sink = arrow.BufferOutputStream()
    parquet.write_table(arrow.table(columns), sink, row_group_size=1, compression="zstd")
    put(root / component / f"{CONTEXT}.parquet", sink.getvalue().to_pybytes())
