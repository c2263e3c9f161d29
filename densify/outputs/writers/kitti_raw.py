# SPDX-License-Identifier: MIT
"""Writes a street as a KITTI raw drive with its truth, which the KITTI reader opens again::

    OUT/2026_06_12/calib_cam_to_cam.txt calib_velo_to_cam.txt calib_imu_to_velo.txt
    OUT/2026_06_12/2026_06_12_drive_0001_sync/
        velodyne_points/{data/0000000120.bin, timestamps.txt, timestamps_start.txt, ..._end.txt}
        image_02/{data/0000000120.png, timestamps.txt}  image_03/...
        oxts/{data/0000000120.txt, timestamps.txt, dataformat.txt}
        truth/  as in `densify.readers.truth_files`

Timestamp files have a line for every frame of the street, so that a line's number is a frame's;
the other files are there for the frames asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int
from densify.outputs.atomic import staged_folder
from densify.outputs.writers.excerpt import Excerpt, put
from densify.readers.file_sequence import camera_named
from densify.readers.kitti.raw import KITTI_TRIGGER_LATENCY_NS
from densify.readers.street import Street
from densify.readers.truth_files import write_bodies, write_depth, write_points
from densify.street.cameras import CAMERAS, T_RECTIFIED_LIDAR, USUAL, T_level_lidar
from densify.street.sensors import SENSORS
from densify.street.simulator import EPOCH_NS

_DATE = np.datetime64(EPOCH_NS, "ns").astype("datetime64[D]").astype(str).replace("-", "_")
DRIVE = f"{_DATE}_drive_0001_sync"
T_LEVEL_IMU = np.eye(4)  # the inertial unit sits behind and below the scanner, a little off true
T_LEVEL_IMU[:3, :3] = Rotation.from_rotvec([0.012, -0.003, -0.001]).as_matrix()
T_LEVEL_IMU[:3, 3] = [-0.81, 0.32, -0.80]
_LATITUDE_DEG, _LONGITUDE_DEG, _ALTITUDE_M = 49.0, 8.4, 115.0
_EARTH_RADIUS_M = 6_378_137.0
_GRAVITY_M_S2 = 9.81
_STEP_NS = 5_000_000  # of the differences that velocities are taken from
_OXTS_FORMAT = (
    "lat lon alt roll pitch yaw vn ve vf vl vu ax ay az af al au wx wy wz wf wl wu "
    "pos_accuracy vel_accuracy navstat numsats posmode velmode orimode"
)


def write_tree(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """See `TreeWriter`. The format has room for the cameras image_02 and image_03,
    and for a sensor whose points' times follow from their azimuth."""
    street = excerpt.street
    names = [name for name in excerpt.cameras if name in USUAL]
    for name in excerpt.cameras:
        camera_named({n: street.cameras[n] for n in names}, name, out)
    check_azimuth_tells_time(street, "KITTI raw")
    folder = out / _DATE
    calibration = _calibration(T_level_lidar(street.simulator.tilt_deg))
    if not overwrite:
        _check_kept(folder, calibration)
    with staged_folder(folder, (DRIVE, *calibration)) as staging:
        for name, data in calibration.items():
            put(staging / name, data)
        _write_stamps(staging / DRIVE, street, names)
        write_bodies(staging / DRIVE / "truth", street.bodies)
        for _, frame in excerpt.numbered():
            _write_frame(staging / DRIVE, excerpt, frame)
    return folder / DRIVE


def _check_kept(folder: Path, calibration: Mapping[str, bytes]) -> None:
    if (folder / DRIVE).exists():
        raise InputError(f"{folder / DRIVE}: there already, kept; give --overwrite to replace it")
    for name, data in calibration.items():
        path = folder / name
        if path.exists() and not (path.is_file() and path.read_bytes() == data):
            raise InputError(
                f"{path}: another calibration is there already, kept; choose another --out, or "
                f"give --overwrite to replace it"
            )


def _write_frame(drive: Path, excerpt: Excerpt, frame: int) -> None:
    street, returns = excerpt.street, excerpt.returns(frame)
    data = velodyne_bytes(returns.points, returns.intensity)
    put(drive / "velodyne_points" / "data" / f"{frame:010d}.bin", data)
    in_bodies = street.simulator.in_bodies(frame, returns)
    write_points(drive / "truth", frame, returns.body, returns.instance, in_bodies)
    for name in excerpt.cameras:
        put(drive / name / "data" / f"{frame:010d}.png", excerpt.encoded_image(name, frame))
        depth_m, moving = street.truth.depth_m(name, frame), street.truth.moving_mask(name, frame)
        write_depth(drive / "truth", name, frame, depth_m, moving)
    record = oxts_line(street, frame, excerpt.frames[0])
    put(drive / "oxts" / "data" / f"{frame:010d}.txt", record.encode())


def numbers(values: Float) -> str:
    """As KITTI's text files have them, every digit kept."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


def projections(key: str) -> list[str]:
    """Lines of the keys of cameras 0 to 3, such as ``P{}``: K [I | t], moved by t from the
    rectified camera 0."""
    lines = []
    for number in range(4):  # 0 and 1 would be the gray ones beside them
        camera = CAMERAS[f"image_0{2 + number % 2}"]
        away = (camera.T_cam_lidar - T_RECTIFIED_LIDAR)[:3, 3]
        P = camera.K @ np.column_stack([np.eye(3), away])
        lines.append(f"{key.format(number)}: {numbers(P)}\n")
    return lines


def stamp_lines(stamps_ns: Int) -> bytes:
    """A timestamps file."""
    texts = stamps_ns.astype("datetime64[ns]").astype(str)
    return "".join(text.replace("T", " ") + "\n" for text in texts).encode()


def oxts_line(street: Street, frame: int, first: int) -> str:
    """A frame's record. first: the frame of the first one, which lies at a fixed latitude."""
    return " ".join(repr(float(v)) for v in _oxts(street, frame, first)) + " 4 10 4 4 0\n"


def check_azimuth_tells_time(street: Street, format: str) -> None:
    """Raise InputError for a sensor whose points' times do not follow from their azimuth."""
    if not street.simulator.sensor.azimuth_tells_time:
        fit = [sensor.name for sensor in SENSORS.values() if sensor.azimuth_tells_time]
        raise InputError(
            f"{street.name}: cannot be written as {format}, whose points carry neither a time nor "
            f"a scanner; choose a single scanner that spins: {', '.join(fit)}"
        )


def velodyne_bytes(points: Float | Float32, intensity: Float32) -> bytes:
    """A sweep's file: (N,3), (N,)."""
    return np.column_stack([points, intensity]).astype("<f4").tobytes()


def _calibration(T_level_lidar: Float) -> dict[str, bytes]:
    """The files of the folder above the drive: name to content.

    T_level_lidar: (4,4) how the scanner's mount is turned about its origin.
    """
    usual = CAMERAS[USUAL[0]]
    lines = projections("P_rect_0{}")
    for number in range(4):
        lines.append(f"S_rect_0{number}: {usual.width_px} {usual.height_px}\n")
        lines.append(f"R_rect_0{number}: {numbers(np.eye(3))}\n")
    files = {"calib_cam_to_cam.txt": "".join(lines)}
    T_lidar_imu = poses.inverse(T_level_lidar) @ T_LEVEL_IMU
    for name, T in (
        ("velo_to_cam", T_RECTIFIED_LIDAR @ T_level_lidar),
        ("imu_to_velo", T_lidar_imu),
    ):
        files[f"calib_{name}.txt"] = f"R: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n"
    return {name: text.encode() for name, text in files.items()}


def _write_stamps(drive: Path, street: Street, names: list[str]) -> None:
    centre = np.array([street.stamp_ns(frame) for frame in street.frames])
    half = street.simulator.period_ns // 2
    files = {
        "velodyne_points/timestamps.txt": centre,
        "velodyne_points/timestamps_start.txt": centre - half,
        "velodyne_points/timestamps_end.txt": centre + half,
        "oxts/timestamps.txt": centre,
    }
    for name in names:
        exposed = np.array(list(street.image_stamps_ns(name).values()))
        files[f"{name}/timestamps.txt"] = exposed + KITTI_TRIGGER_LATENCY_NS
    for path, stamps in files.items():
        put(drive / path, stamp_lines(stamps))
    put(drive / "oxts" / "dataformat.txt", _OXTS_FORMAT.replace(" ", "\n").encode() + b"\n")


def _oxts(street: Street, frame: int, first: int) -> Float:
    """(25,) all of an oxts record but the last five, from the true motion.

    The first frame written lies at a fixed latitude, since readers take the Mercator projection's
    scale from the first record they find.
    """
    simulator, stamp = street.simulator, street.stamp_ns(frame)
    T_lidar_imu = poses.inverse(T_level_lidar(simulator.tilt_deg)) @ T_LEVEL_IMU

    def T_world_imu(time_ns: int) -> Float:
        return simulator.T_world_lidar_at(time_ns) @ T_lidar_imu

    before, here, after = (T_world_imu(stamp + i * _STEP_NS) for i in (-1, 0, 1))
    step_s = _STEP_NS * 1e-9
    east_north_up = here[:3, 3] - T_world_imu(street.stamp_ns(first))[:3, 3]
    scale_m = np.cos(np.radians(_LATITUDE_DEG)) * _EARTH_RADIUS_M
    lon_deg = _LONGITUDE_DEG + np.degrees(east_north_up[0] / scale_m)
    mercator = np.log(np.tan(np.radians(90 + _LATITUDE_DEG) / 2)) + east_north_up[1] / scale_m
    lat_deg = np.degrees(2 * np.arctan(np.exp(mercator))) - 90
    yaw, pitch, roll = Rotation.from_matrix(here[:3, :3]).as_euler("ZYX")
    level = Rotation.from_euler("Z", yaw).as_matrix()
    velocity = (after - before)[:3, 3] / (2 * step_s)
    acceleration = (after - 2 * here + before)[:3, 3] / step_s**2 + [0, 0, _GRAVITY_M_S2]
    rate = poses.log(poses.inverse(before) @ after)[:3] / (2 * step_s)
    return np.concatenate(
        [
            [lat_deg, lon_deg, _ALTITUDE_M + east_north_up[2], roll, pitch, yaw],
            [velocity[1], velocity[0]],
            level.T @ velocity,
            here[:3, :3].T @ acceleration,
            level.T @ acceleration,
            rate,
            level.T @ here[:3, :3] @ rate,
            [0.05, 0.02],
        ]
    )
