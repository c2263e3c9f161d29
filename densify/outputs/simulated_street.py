# SPDX-License-Identifier: MIT
"""Write frames of the built-in street, with exact truth, as a KITTI raw drive or a plain folder.

The plain folder, which `densify.readers.folder` opens::

    OUT/street/densify.yaml
    OUT/street/sweeps/000000.bin, ...  float32 x y z intensity time lidar, time in s since the
                                       stamp, and radial_velocity of sensors that measure it
    OUT/street/timestamps.txt          one time per sweep, s since 1970
    OUT/street/poses.txt               the lidar's path (TUM): time x y z qx qy qz qw
    OUT/street/images/CAMERA/1781258406000000000.png, ...  named by their times in ns
    OUT/street/truth/                  see `densify.readers.truth_files`
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry.types import Camera, Float, Int, Progress
from densify.outputs.atomic import staged_folder
from densify.outputs.png import encode_png
from densify.readers.file_sequence import camera_named
from densify.readers.folder.config import NAME
from densify.readers.recorded_poses import PoseTrack
from densify.readers.street import Street
from densify.readers.truth_files import write_bodies, write_depth, write_points
from densify.street.simulator import Bodies

FORMATS = ("kitti", "folder")
_POSE_STEP_NS = 5_000_000
_MARGIN_NS = 150_000_000  # poses start this long before the first sweep and end after the last


def write_street(
    format: str,
    street: Street,
    out: Path,
    frames: Sequence[int],
    cameras: Sequence[str] | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Write frames of a street and return the place that ``--data`` opens, complete or not there.

    format: one of `FORMATS`. frames: absolute numbers. cameras: names, None for all of the street.
    Raises InputError for a format, frame or camera that does not exist or does not fit, and for a
    place that exists, unless ``overwrite`` is set.
    """
    if format not in FORMATS:
        raise InputError(f"--format {format}: expected one of {', '.join(FORMATS)}")
    excerpt = Excerpt.of(street, frames, cameras, progress)
    try:
        if format == "folder":
            return _write_folder(excerpt, out / "street", overwrite)
        from densify.outputs.simulated_kitti import write_drive

        return write_drive(excerpt, out, overwrite)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class Excerpt:
    """Frames of a street. frames: ascending. cameras: names."""

    street: Street
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    progress: Progress | None = None

    @classmethod
    def of(
        cls,
        street: Street,
        frames: Sequence[int],
        cameras: Sequence[str] | None = None,
        progress: Progress | None = None,
    ) -> Excerpt:
        """cameras: None for all of the street. Raises InputError for what does not exist."""
        names = tuple(street.cameras if cameras is None else cameras)
        for name in names:
            camera_named(street.cameras, name, Path(street.name))
        unknown = [frame for frame in frames if frame not in street.frames]
        if unknown or not frames:
            raise InputError(
                f"{street.name}: frames to write: got {unknown[:5] or 'none'}, expected some of 0 "
                f"to {street.frames[-1]}"
            )
        return cls(street, tuple(sorted(frames)), names, progress)

    def numbered(self) -> Iterator[tuple[int, int]]:
        """Each sweep's number from 0 and its frame; tells the progress."""
        for number, frame in enumerate(self.frames):
            if self.progress:
                self.progress("simulate", number, len(self.frames))
            yield number, frame
        if self.progress:
            self.progress("simulate", len(self.frames), len(self.frames))

    def image_numbers(self, camera: str) -> list[int]:
        """The images exposed from half a period before the first stamp to half a period after the
        last stamp."""
        half_ns = self.street.simulator.period_ns // 2
        begin_ns = self.street.stamp_ns(self.frames[0]) - half_ns
        end_ns = self.street.stamp_ns(self.frames[-1]) + half_ns
        exposed_ns = self.street.image_stamps_ns(camera)
        return [n for n, ns in exposed_ns.items() if begin_ns <= ns < end_ns]

    def png_image(self, camera: str, number: int) -> bytes:
        """Bytes of a PNG file."""
        return encode_png(np.ascontiguousarray(self.street.image(camera, number)[:, :, ::-1]))

    def T_world_ego(self, stamp_ns: Int, T_lidar_ego: Float | None = None) -> Float:
        """(n,) times -> (n,4,4) true poses of the scanner, or of a frame fixed to it."""
        T_world_lidar = [self.street.simulator.T_world_lidar_at(int(t)) for t in stamp_ns]
        return np.stack(T_world_lidar) @ (np.eye(4) if T_lidar_ego is None else T_lidar_ego)

    def poses(self, T_lidar_ego: Float | None = None) -> PoseTrack:
        """The true path of the scanner, or of a frame fixed to it, every 5 ms."""
        first_ns, last_ns = (self.street.stamp_ns(f) for f in (self.frames[0], self.frames[-1]))
        stamp_ns = np.arange(first_ns - _MARGIN_NS, last_ns + _MARGIN_NS + 1, _POSE_STEP_NS)
        return PoseTrack(self.street.name, stamp_ns, self.T_world_ego(stamp_ns, T_lidar_ego))


def write_truth(folder: Path, excerpt: Excerpt, bodies: Bodies, renumbered: bool) -> None:
    """Write the truth folder of the layout in `densify.readers.truth_files`.

    bodies: poses at the stamp of each sweep. renumbered: sweeps and images are numbered from 0.
    """
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


def put(path: Path, data: bytes | str) -> None:
    """Write a file and make the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def _write_folder(excerpt: Excerpt, place: Path, overwrite: bool) -> Path:
    if place.exists() and not overwrite:
        raise InputError(f"{place}: exists; give --overwrite to replace it")
    street = excerpt.street
    stamps_ns = [street.stamp_ns(frame) for frame in excerpt.frames]
    owned = [path.name for path in place.iterdir()] if place.is_dir() else []
    with staged_folder(place, owned) as folder:
        for number, frame in excerpt.numbered():
            returns = street.returns(frame)
            columns = [returns.intensity, returns.offset_ns * 1e-9, returns.lidar]
            if returns.radial_velocity_m_s is not None:
                columns.append(returns.radial_velocity_m_s)
            table = np.column_stack([returns.points, *columns]).astype("<f4")
            put(folder / "sweeps" / f"{number:06d}.bin", table.tobytes())
        put(folder / "timestamps.txt", "".join(f"{_seconds(ns)}\n" for ns in stamps_ns))
        put(folder / "poses.txt", _tum(excerpt.poses()))
        for name in excerpt.cameras:
            exposed_ns = street.image_stamps_ns(name)
            for image in excerpt.image_numbers(name):
                path = folder / "images" / name / f"{exposed_ns[image]}.png"
                put(path, excerpt.png_image(name, image))
        put(folder / NAME, config_text(excerpt))
        write_truth(folder / "truth", excerpt, street.simulator.bodies_at(stamps_ns), True)
    return place


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def _tum(track: PoseTrack) -> str:
    lines = ["# time x y z qx qy qz qw: the lidar's pose in the world"]
    for stamp_ns, T in zip(track.stamp_ns.tolist(), track.T_world_ego, strict=True):
        x_y_z_w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
        values = " ".join(f"{float(v):.12g}" for v in (*T[:3, 3], *x_y_z_w))
        lines.append(f"{_seconds(stamp_ns)} {values}")
    return "\n".join(lines) + "\n"


def config_text(excerpt: Excerpt) -> str:
    """The densify.yaml of the excerpt."""
    import yaml

    sensor = excerpt.street.simulator.sensor
    columns = ["x", "y", "z", "intensity", "time", "lidar"]
    config = {
        "sweeps": {
            "files": "sweeps",
            "columns": columns + ["radial_velocity"] * sensor.measures_velocity,
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
    return f"# What the other files of this folder do not say.\n{text}"


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        **{"files": f"images/{camera.name}", "stamps": "names", "stamps_unit": "ns"},
        **{name: getattr(camera, name) for name in ("model", "max_angle_deg", "row_time_s")},
        "size": [camera.width_px, camera.height_px],
        "K": camera.K.tolist(),
        "distortion": list(camera.distortion),
        "T_cam_lidar": camera.T_cam_lidar.tolist(),
    }
