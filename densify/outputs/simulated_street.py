# SPDX-License-Identifier: MIT
"""Write frames of the simulated street with ground truth, as docs/formats/reading.md has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float, Float32, Int, Progress
from densify.outputs.depth_png import encode_png
from densify.outputs.folders import staged_folder
from densify.readers import checks
from densify.readers.folder_config import NAME
from densify.readers.kitti import KITTI_TRIGGER_LATENCY_NS
from densify.readers.recorded_poses import PoseTrack
from densify.readers.street import Street, write_bodies, write_depth, write_points
from densify.street.cameras import CAMERAS, T_RECTIFIED_LIDAR, USUAL, T_level_lidar
from densify.street.lidar import SENSORS
from densify.street.simulator import EPOCH_NS, Bodies

FORMATS = ("kitti", "folder")
_DATE = np.datetime64(EPOCH_NS, "ns").astype("datetime64[D]").astype(str).replace("-", "_")
_DRIVE = f"{_DATE}_drive_0001_sync"
_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
_KITTI = (_DRIVE, *_CALIBRATION)
_FOLDER = (NAME, "sweeps", "timestamps.txt", "poses.txt", "images", "truth")
_POSE_STEP_NS = 5_000_000
_MARGIN_NS = 150_000_000  # poses start this long before the first sweep and end after the last
# The inertial unit is behind and below the scanner, slightly rotated.
_T_LEVEL_IMU = poses.exp(np.array([0.012, -0.003, -0.001, -0.81, 0.32, -0.80]))
_LATITUDE_DEG, _LONGITUDE_DEG, _ALTITUDE_M = 49.0, 8.4, 115.0
_EARTH_RADIUS_M = 6_378_137.0
_NUM_MOTIONS = 17  # velocities, accelerations and turn rates of an oxts record


def write_street(
    format: str,
    street: Street,
    out: Path,
    frames: Sequence[int],
    cameras: Sequence[str] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Write frames of a street, all or none, and return the path to give to ``--data``.

    Args:
        format: ``kitti`` or ``folder``.
        street: The street.
        out: Folder in which the recording's folder is made.
        frames: Frame numbers of the sweeps, in any order.
        cameras: Names of the cameras, None for all.
        progress: Function that is called with the progress, None for none.
        overwrite: True to replace existing files, which else raise InputError.
    """
    if format not in FORMATS:
        raise InputError(f"--format {format}: expected one of {', '.join(FORMATS)}")
    excerpt, is_kitti = Excerpt.of(street, frames, cameras), format == "kitti"
    if is_kitti and not street.simulator.sensor.azimuth_tells_time:
        fit = [sensor.name for sensor in SENSORS.values() if sensor.azimuth_tells_time]
        raise InputError(
            f"{street.name}: cannot be written as KITTI, whose points have neither a time nor a "
            f"scanner; choose a single scanner that spins: {', '.join(fit)}"
        )
    if is_kitti:  # KITTI's cameras alone have a place in its calibration file
        for name in excerpt.cameras:
            checks.camera_named({usual: CAMERAS[usual] for usual in USUAL}, name, out)
    folder, owned = (out / _DATE, _KITTI) if is_kitti else (out / "street", _FOLDER)
    for name in owned:
        if (folder / name).exists() and not overwrite:
            raise InputError(f"{folder / name}: exists; give --overwrite to replace it")
    write = _write_kitti if is_kitti else _write_folder
    with staged_folder(folder, owned) as staging:
        write(excerpt, staging, progress or (lambda *_: None))
    return folder / _DRIVE if is_kitti else folder


@dataclass(frozen=True)
class Excerpt:
    """Chosen frames and cameras of a simulated street."""

    street: Street
    frames: tuple[int, ...]  # frame numbers, ascending
    cameras: tuple[str, ...]  # names of the cameras

    @classmethod
    def of(
        cls, street: Street, frames: Sequence[int], cameras: Sequence[str] | None = None
    ) -> Excerpt:
        """Return the excerpt of these frames and cameras (None: all), or raise InputError."""
        names = tuple(street.cameras if cameras is None else cameras)
        for name in names:
            checks.camera_named(street.cameras, name, Path(street.name))
        unknown = [frame for frame in frames if frame not in street.frames]
        if unknown or not frames:
            raise InputError(
                f"{street.name}: frames to write: got {unknown[:5] or 'none'}, expected some of 0 "
                f"to {street.frames[-1]}"
            )
        return cls(street, tuple(sorted(frames)), names)

    def image_numbers(self, camera: str) -> list[int]:
        """Return the numbers of the images exposed up to half a sweep period around the excerpt."""
        half_ns = self.street.simulator.period_ns // 2
        begin_ns = self.street.stamp_ns(self.frames[0]) - half_ns
        end_ns = self.street.stamp_ns(self.frames[-1]) + half_ns
        exposed_ns = self.street.image_stamps_ns(camera)
        return [n for n, ns in exposed_ns.items() if begin_ns <= ns < end_ns]

    def png_image(self, camera: str, number: int) -> bytes:
        """Return the bytes of an image as a PNG file."""
        return encode_png(self.street.image(camera, number)[:, :, ::-1])

    def T_world_ego(self, stamp_ns: Int, T_lidar_ego: Float | None = None) -> Float:
        """Return the true poses (n,4,4) of an ego frame (None: the lidar) at (n,) times in ns."""
        T_world_lidar = [self.street.simulator.T_world_lidar_at(int(ns)) for ns in stamp_ns]
        return np.stack(T_world_lidar) @ (np.eye(4) if T_lidar_ego is None else T_lidar_ego)

    def poses(self, T_lidar_ego: Float | None = None) -> PoseTrack:
        """Return the true poses of an ego frame every 5 ms, as a track. None takes the lidar."""
        first_ns, last_ns = (self.street.stamp_ns(f) for f in (self.frames[0], self.frames[-1]))
        stamp_ns = np.arange(first_ns - _MARGIN_NS, last_ns + _MARGIN_NS + 1, _POSE_STEP_NS)
        return PoseTrack(self.street.name, stamp_ns, self.T_world_ego(stamp_ns, T_lidar_ego))


def put(path: Path, data: bytes | str) -> None:
    """Write a file, and make its parent folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def _numbered(frames: Sequence[int], progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield (number from 0, frame number) and report the progress."""
    for number, frame in enumerate(frames):
        progress("simulate", number, len(frames))
        yield number, frame
    progress("simulate", len(frames), len(frames))


def _write_truth(folder: Path, excerpt: Excerpt, bodies: Bodies, renumbered: bool) -> None:
    """Write the ground truth folder, numbered from 0 if ``renumbered``, else by frame number."""
    street = excerpt.street
    write_bodies(folder, bodies)
    for number, frame in enumerate(excerpt.frames):
        returns = street.returns(frame)
        points = street.simulator.in_bodies(frame, returns)
        written = number if renumbered else frame
        write_points(folder, written, returns.body, returns.instance, points)
    for camera in excerpt.cameras:
        images = excerpt.image_numbers(camera) if renumbered else excerpt.frames
        for number, image in enumerate(images):
            depth_m = street.truth.depth_m(camera, image)
            moving = street.truth.moving_mask(camera, image)
            write_depth(folder, camera, number if renumbered else image, depth_m, moving)


def _write_folder(excerpt: Excerpt, folder: Path, progress: Progress) -> None:
    """Write the excerpt as a plain folder, with sweeps and images numbered from 0."""
    street = excerpt.street
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    for number, frame in _numbered(excerpt.frames, progress):
        returns = street.returns(frame)
        columns = [returns.points, returns.intensity, returns.offset_ns * 1e-9, returns.lidar]
        put(folder / f"sweeps/{number:06d}.bin", np.column_stack(columns).astype("<f4").tobytes())
    put(folder / "timestamps.txt", "".join(f"{_seconds(ns)}\n" for ns in stamps_ns))
    lines = ["# time x y z qx qy qz qw: the lidar's pose in the world\n"]
    track = excerpt.poses()
    for stamp_ns, T in zip(track.stamp_ns.tolist(), track.T_world_ego, strict=True):
        x_y_z_w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
        values = " ".join(f"{float(v):.12g}" for v in (*T[:3, 3], *x_y_z_w))
        lines.append(f"{_seconds(stamp_ns)} {values}\n")
    put(folder / "poses.txt", "".join(lines))
    for name in excerpt.cameras:
        exposed_ns = street.image_stamps_ns(name)
        for image in excerpt.image_numbers(name):
            path = folder / f"images/{name}/{exposed_ns[image]}.png"
            put(path, excerpt.png_image(name, image))
    put(folder / NAME, config_text(excerpt))
    _write_truth(folder / "truth", excerpt, street.simulator.bodies_at(stamps_ns), renumbered=True)


def _seconds(time_ns: int) -> str:
    """Return a time in seconds with every digit."""
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def config_text(excerpt: Excerpt) -> str:
    """Return the text of densify.yaml for the excerpt."""
    sweeps = {
        "files": "sweeps",
        "columns": ["x", "y", "z", "intensity", "time", "lidar"],
        "intensity_scale": 1.0,
        "time_unit": "s",
        "time_is": "relative",
        "stamps": "timestamps.txt",
        "stamps_unit": "s",
        "scanner_origins": excerpt.street.simulator.sensor.origins_m.tolist(),
    }
    cameras = {}
    for name in excerpt.cameras:
        camera = excerpt.street.cameras[name]
        cameras[name] = {
            **{"files": f"images/{name}", "stamps": "names", "stamps_unit": "ns"},
            **{key: getattr(camera, key) for key in ("model", "max_angle_deg", "row_time_s")},
            "size": [camera.width_px, camera.height_px],
            "K": camera.K.tolist(),
            "distortion": list(camera.distortion),
            "T_cam_lidar": camera.T_cam_lidar.tolist(),
        }
    poses_file = {"file": "poses.txt", "stamps_unit": "s"}
    config = {"sweeps": sweeps, "poses": poses_file, "cameras": cameras}
    text = yaml.safe_dump(config, sort_keys=False, default_flow_style=None, width=100)
    return f"# What the other files of this folder do not say.\n{text}"


def _write_kitti(excerpt: Excerpt, folder: Path, progress: Progress) -> None:
    """Write the excerpt as a KITTI raw drive with its calibration."""
    street, drive = excerpt.street, folder / _DRIVE
    tilt_deg, usual = street.simulator.tilt_deg, CAMERAS[USUAL[0]]
    sizes = [f"S_rect_0{n}: {usual.width_px} {usual.height_px}\n" for n in range(4)]
    turns = [f"R_rect_0{n}: {numbers(np.eye(3))}\n" for n in range(4)]
    calibration = ["".join([projections("P_rect_0{}"), *sizes, *turns])]
    for T in (T_RECTIFIED_LIDAR @ T_level_lidar(tilt_deg), T_lidar_imu(tilt_deg)):
        calibration.append(f"R: {numbers(T[:3, :3])}\nT: {numbers(T[:3, 3])}\n")
    for name, text in zip(_CALIBRATION, calibration, strict=True):
        put(folder / name, text)
    for _, frame in _numbered(excerpt.frames, progress):
        put(drive / f"velodyne_points/data/{frame:010d}.bin", sweep_data(street, frame))
        for name in excerpt.cameras:
            put(drive / f"{name}/data/{frame:010d}.png", excerpt.png_image(name, frame))
        put(drive / f"oxts/data/{frame:010d}.txt", oxts_line(street, frame, excerpt.frames[0]))
    middle_ns = np.array([street.stamp_ns(frame) for frame in street.frames])
    half_ns = street.simulator.period_ns // 2
    stamps = {
        "oxts/timestamps": middle_ns,
        "velodyne_points/timestamps": middle_ns,
        "velodyne_points/timestamps_start": middle_ns - half_ns,
        "velodyne_points/timestamps_end": middle_ns + half_ns,
    }
    for name in excerpt.cameras:
        exposed_ns = np.array(list(street.image_stamps_ns(name).values()))
        stamps[f"{name}/timestamps"] = exposed_ns + KITTI_TRIGGER_LATENCY_NS
    for name, stamps_ns in stamps.items():
        put(drive / f"{name}.txt", stamp_lines(stamps_ns))
    _write_truth(drive / "truth", excerpt, street.bodies, renumbered=False)


def numbers(values: Float) -> str:
    """Return values as a line of KITTI's text files, with every digit."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


def projections(key: str) -> str:
    """Return the calibration lines of cameras 0 to 3 with label ``key``, such as ``P_rect_0{}``.

    A line has P = K [I | t], where t is the position of rectified camera 0 in the camera's frame in
    metres.
    """
    lines = ""
    for number in range(4):  # gray cameras 0 and 1 share the poses of colour cameras 2 and 3
        camera = CAMERAS[f"image_0{2 + number % 2}"]
        offset_m = (camera.T_cam_lidar - T_RECTIFIED_LIDAR)[:3, 3]
        P = camera.K @ np.column_stack([np.eye(3), offset_m])
        lines += f"{key.format(number)}: {numbers(P)}\n"
    return lines


def stamp_lines(stamps_ns: Int) -> str:
    """Return the text of a KITTI timestamps file for (n,) times in ns since 1970."""
    texts = stamps_ns.astype("datetime64[ns]").astype(str)
    return "".join(text.replace("T", " ") + "\n" for text in texts)


def sweep_data(street: Street, frame: int, points: Float | Float32 | None = None) -> bytes:
    """Return the bytes of a KITTI sweep file, float32 x y z intensity for each return.

    ``points`` (N,3) replaces the positions if given.
    """
    returns = street.returns(frame)
    columns = [returns.points if points is None else points, returns.intensity]
    return np.column_stack(columns).astype("<f4").tobytes()


def T_lidar_imu(tilt_deg: float) -> Float:
    """Return the (4,4) pose of the inertial unit in the frame of the tilted scanner."""
    return poses.inverse(T_level_lidar(tilt_deg)) @ _T_LEVEL_IMU


def oxts_line(street: Street, frame: int, first: int) -> str:
    """Return the oxts line of a frame: the inertial unit's true pose, and velocities of 0."""
    # Inverse of KITTI's projection, whose scale readers take from the latitude of frame ``first``:
    # x = scale lon, y = scale ln tan((90 deg + lat) / 2)
    T_lidar_ego = T_lidar_imu(street.simulator.tilt_deg)
    T_world_now, T_world_first = (
        street.simulator.T_world_lidar_at(street.stamp_ns(f)) @ T_lidar_ego for f in (frame, first)
    )
    east_m, north_m, up_m = T_world_now[:3, 3] - T_world_first[:3, 3]
    scale_m = np.cos(np.radians(_LATITUDE_DEG)) * _EARTH_RADIUS_M
    longitude_deg = _LONGITUDE_DEG + np.degrees(east_m / scale_m)
    mercator = np.log(np.tan(np.radians(90 + _LATITUDE_DEG) / 2)) + north_m / scale_m
    latitude_deg = np.degrees(2 * np.arctan(np.exp(mercator))) - 90
    yaw, pitch, roll = Rotation.from_matrix(T_world_now[:3, :3]).as_euler("ZYX")
    pose = [latitude_deg, longitude_deg, _ALTITUDE_M + up_m, roll, pitch, yaw]
    accuracies = [0.05, 0.02]  # of position (m) and velocity (m/s)
    values = np.array([*pose, *[0.0] * _NUM_MOTIONS, *accuracies])
    return f"{numbers(values)} 4 10 4 4 0\n"
