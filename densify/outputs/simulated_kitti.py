# SPDX-License-Identifier: MIT
"""Write a street as a KITTI raw drive with its truth, which `densify.readers.kitti.raw` opens::

    OUT/2026_06_12/calib_cam_to_cam.txt calib_velo_to_cam.txt calib_imu_to_velo.txt
    OUT/2026_06_12/2026_06_12_drive_0001_sync/
        velodyne_points/{data/0000000120.bin, timestamps.txt, timestamps_start.txt, ..._end.txt}
        image_02/{data/0000000120.png, timestamps.txt}  image_03/...
        oxts/{data/0000000120.txt, timestamps.txt}
        truth/  see `densify.readers.truth_files`

Timestamp files have a line per frame of the street, since a line's number is a frame's. The other
files exist for the frames written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int
from densify.outputs.atomic import staged_folder
from densify.outputs.simulated_street import Excerpt, put, write_truth
from densify.readers.file_sequence import camera_named
from densify.readers.kitti.raw import KITTI_TRIGGER_LATENCY_NS
from densify.readers.street import Street
from densify.street.cameras import CAMERAS, T_RECTIFIED_LIDAR, USUAL, T_level_lidar
from densify.street.sensors import SENSORS
from densify.street.simulator import EPOCH_NS

_DATE = np.datetime64(EPOCH_NS, "ns").astype("datetime64[D]").astype(str).replace("-", "_")
_DRIVE = f"{_DATE}_drive_0001_sync"
T_LEVEL_IMU = np.eye(4)  # the inertial unit is behind and below the scanner, slightly turned
T_LEVEL_IMU[:3, :3] = Rotation.from_rotvec([0.012, -0.003, -0.001]).as_matrix()
T_LEVEL_IMU[:3, 3] = [-0.81, 0.32, -0.80]
_LATITUDE_DEG, _LONGITUDE_DEG, _ALTITUDE_M = 49.0, 8.4, 115.0
_EARTH_RADIUS_M = 6_378_137.0


def write_drive(excerpt: Excerpt, out: Path, overwrite: bool) -> Path:
    """Write the drive and return its folder, complete or not there.

    Raises InputError for a camera other than image_02 and image_03, a sensor whose azimuths do not
    tell the points' times, and for a drive or calibration that exists, unless ``overwrite`` is set.
    """
    street = excerpt.street
    for name in excerpt.cameras:
        camera_named({n: street.cameras[n] for n in excerpt.cameras if n in USUAL}, name, out)
    check_azimuth_tells_time(street)
    folder, calibration = out / _DATE, _calibration(street.simulator.tilt_deg)
    for name in (_DRIVE, *calibration):
        if (folder / name).exists() and not overwrite:
            raise InputError(f"{folder / name}: exists; give --overwrite to replace it")
    with staged_folder(folder, (_DRIVE, *calibration)) as staging:
        for name, data in calibration.items():
            put(staging / name, data)
        drive = staging / _DRIVE
        _write_stamps(drive, street, excerpt.cameras)
        for _, frame in excerpt.numbered():
            put(drive / "velodyne_points" / "data" / f"{frame:010d}.bin", sweep_data(street, frame))
            for name in excerpt.cameras:
                image = drive / name / "data" / f"{frame:010d}.png"
                put(image, excerpt.png_image(name, frame))
            record = oxts_line(street, frame, excerpt.frames[0])
            put(drive / "oxts" / "data" / f"{frame:010d}.txt", record)
        write_truth(drive / "truth", excerpt, street.bodies, renumbered=False)
    return folder / _DRIVE


def check_azimuth_tells_time(street: Street) -> None:
    """Raise InputError for a sensor whose azimuths do not tell the points' times."""
    if not street.simulator.sensor.azimuth_tells_time:
        fit = [sensor.name for sensor in SENSORS.values() if sensor.azimuth_tells_time]
        raise InputError(
            f"{street.name}: cannot be written as KITTI, whose points have neither a time nor a "
            f"scanner; choose a single scanner that spins: {', '.join(fit)}"
        )


def numbers(values: Float) -> str:
    """A line of KITTI's text files, with every digit."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


def projections(key: str) -> str:
    """Lines of the keys of cameras 0 to 3, such as ``P{}``: K [I | t], with t from the rectified
    camera 0."""
    lines = ""
    for number in range(4):  # 0 and 1 are the gray cameras beside them
        camera = CAMERAS[f"image_0{2 + number % 2}"]
        away = (camera.T_cam_lidar - T_RECTIFIED_LIDAR)[:3, 3]
        lines += f"{key.format(number)}: {numbers(camera.K @ np.column_stack([np.eye(3), away]))}\n"
    return lines


def stamp_lines(stamps_ns: Int) -> str:
    """A timestamps file."""
    texts = stamps_ns.astype("datetime64[ns]").astype(str)
    return "".join(text.replace("T", " ") + "\n" for text in texts)


def sweep_data(street: Street, frame: int, points: Float | Float32 | None = None) -> bytes:
    """A sweep's file. points: (N,3), None for the points as fired."""
    returns = street.returns(frame)
    columns = [returns.points if points is None else points, returns.intensity]
    return np.column_stack(columns).astype("<f4").tobytes()


def _calibration(tilt_deg: float) -> dict[str, str]:
    """The files in the folder above the drive: name to content."""
    usual = CAMERAS[USUAL[0]]
    lines = projections("P_rect_0{}")
    for number in range(4):
        lines += f"S_rect_0{number}: {usual.width_px} {usual.height_px}\n"
        lines += f"R_rect_0{number}: {numbers(np.eye(3))}\n"
    files = {"calib_cam_to_cam.txt": lines}
    for name, T in (
        ("velo_to_cam", T_RECTIFIED_LIDAR @ T_level_lidar(tilt_deg)),
        ("imu_to_velo", T_lidar_imu(tilt_deg)),
    ):
        files[f"calib_{name}.txt"] = f"R: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n"
    return files


def T_lidar_imu(tilt_deg: float) -> Float:
    """(4,4) from the inertial unit to the scanner, whose mount is tilted."""
    return poses.inverse(T_level_lidar(tilt_deg)) @ T_LEVEL_IMU


def _write_stamps(drive: Path, street: Street, cameras: Sequence[str]) -> None:
    centre = np.array([street.stamp_ns(frame) for frame in street.frames])
    half = street.simulator.period_ns // 2
    files = {
        "velodyne_points/timestamps.txt": centre,
        "velodyne_points/timestamps_start.txt": centre - half,
        "velodyne_points/timestamps_end.txt": centre + half,
        "oxts/timestamps.txt": centre,
    }
    for name in cameras:
        exposed = np.array(list(street.image_stamps_ns(name).values()))
        files[f"{name}/timestamps.txt"] = exposed + KITTI_TRIGGER_LATENCY_NS
    for path, stamps in files.items():
        put(drive / path, stamp_lines(stamps))


def oxts_line(street: Street, frame: int, first: int) -> str:
    """An oxts record of the true pose; its velocities, accelerations and turn rates are 0.

    first: the frame at the fixed latitude, which is the first frame written: readers take the scale
    of the Mercator projection from the first record.
    """
    T_lidar = T_lidar_imu(street.simulator.tilt_deg)
    here, start = (
        street.simulator.T_world_lidar_at(street.stamp_ns(f)) @ T_lidar for f in (frame, first)
    )
    east_north_up = here[:3, 3] - start[:3, 3]
    scale_m = np.cos(np.radians(_LATITUDE_DEG)) * _EARTH_RADIUS_M
    lon_deg = _LONGITUDE_DEG + np.degrees(east_north_up[0] / scale_m)
    mercator = np.log(np.tan(np.radians(90 + _LATITUDE_DEG) / 2)) + east_north_up[1] / scale_m
    lat_deg = np.degrees(2 * np.arctan(np.exp(mercator))) - 90
    yaw, pitch, roll = Rotation.from_matrix(here[:3, :3]).as_euler("ZYX")
    place = [lat_deg, lon_deg, _ALTITUDE_M + east_north_up[2], roll, pitch, yaw]
    return f"{numbers(np.array([*place, *[0.0] * 17, 0.05, 0.02]))} 4 10 4 4 0\n"
