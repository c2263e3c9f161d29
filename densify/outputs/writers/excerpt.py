# SPDX-License-Identifier: MIT
"""Some frames of a street, and what every format writes of them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry.types import Float, Int, Progress
from densify.outputs.atomic import staged_folder
from densify.outputs.png import encode_png
from densify.readers.file_sequence import camera_named
from densify.readers.pose_track import PoseTrack
from densify.readers.street import Street
from densify.readers.truth_files import write_bodies, write_depth, write_points
from densify.street.lidar import Returns
from densify.street.sensors import SENSORS, Spinning

_POSE_STEP_NS = 5_000_000
_MARGIN_NS = 150_000_000  # poses reach so far beyond the first and the last sweep


@dataclass(frozen=True)
class Excerpt:
    """street: whose. frames: ascending, of the street. cameras: names. progress: told of what is
    written."""

    street: Street
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    progress: Progress | None = None

    @staticmethod
    def of(
        street: Street,
        frames: Sequence[int],
        cameras: Sequence[str] | None,
        progress: Progress | None = None,
    ) -> Excerpt:
        """cameras: all of the street if None. Raises InputError for what does not exist."""
        names = tuple(street.cameras if cameras is None else cameras)
        for name in names:
            camera_named(street.cameras, name, Path(street.name))
        unknown = [frame for frame in frames if frame not in street.frames]
        if unknown or not frames:
            raise InputError(
                f"{street.name}: frames to write: got {unknown[:5] or 'none'}, expected some of 0 "
                f"to {street.frames[-1]}"
            )
        return Excerpt(street, tuple(sorted(frames)), names, progress)

    def numbered(self) -> Iterator[tuple[int, int]]:
        """Each sweep's number, from 0, and its frame, as it is about to be written."""
        for number, frame in enumerate(self.frames):
            self.tell(number)
            yield number, frame

    def tell(self, num_done: int) -> None:
        """Tell that so many sweeps are written."""
        if self.progress:
            self.progress("simulate", num_done, len(self.frames))

    def returns(self, frame: int) -> Returns:
        """A sweep's returns as they were fired, in the scanner's frame."""
        return self.street.returns(frame)

    def image_numbers(self, camera: str) -> list[int]:
        """The camera's images that were exposed between half a period before the first sweep's
        reference time and half a period after the last's."""
        half_ns = self.street.simulator.period_ns // 2
        begin_ns = self.street.stamp_ns(self.frames[0]) - half_ns
        end_ns = self.street.stamp_ns(self.frames[-1]) + half_ns
        exposed_ns = self.street.image_stamps_ns(camera)
        return [n for n, ns in exposed_ns.items() if begin_ns <= ns < end_ns]

    def encoded_image(self, camera: str, number: int) -> bytes:
        """A PNG file's bytes."""
        rgb = self.street.image(camera, number)
        return encode_png(np.ascontiguousarray(rgb[:, :, ::-1]))

    def jpeg_image(self, camera: str, number: int) -> bytes:
        """A JPEG file's bytes."""
        import cv2

        bgr = np.ascontiguousarray(self.street.image(camera, number)[:, :, ::-1])
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    def rings(self, returns: Returns) -> Int:
        """(N,) int64 which of its scanner's beams measured each return, counted from the lowest.

        Raises InputError if a scanner does not spin."""
        ring = np.zeros(len(returns.points), np.int64)
        for number, scanner in enumerate(self.street.simulator.sensor.scanners):
            if not isinstance(scanner.pattern, Spinning):
                fit = [s.name for s in SENSORS.values() if s.spins]
                raise InputError(
                    f"{self.street.name}: cannot be written in this format, whose points have "
                    f"rings; choose a sensor that spins: {', '.join(fit)}"
                )
            rows = np.flatnonzero(returns.lidar == number)
            away = returns.points[rows] - np.array(scanner.origin_m)
            elevation_deg = np.degrees(np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1])))
            beams_deg = np.sort(scanner.pattern.elevation_deg)
            between_deg = (beams_deg[1:] + beams_deg[:-1]) / 2
            ring[rows] = np.searchsorted(between_deg, elevation_deg)
        return ring

    def poses(self, T_lidar_ego: Float | None = None, step_ns: int = _POSE_STEP_NS) -> PoseTrack:
        """The true path of the scanner, or of a frame fixed to it, every ``step_ns``, from 0.15 s
        before the first sweep to 0.15 s after the last."""
        first_ns, last_ns = (self.street.stamp_ns(f) for f in (self.frames[0], self.frames[-1]))
        stamp_ns = np.arange(first_ns - _MARGIN_NS, last_ns + _MARGIN_NS + 1, step_ns)
        return PoseTrack(self.street.name, stamp_ns, self.T_world_ego(stamp_ns, T_lidar_ego))

    def T_world_ego(self, stamp_ns: Int, T_lidar_ego: Float | None = None) -> Float:
        """(n,) times -> (n,4,4) true poses of the scanner, or of a frame fixed to it."""
        simulator = self.street.simulator
        T_world_lidar = np.stack([simulator.T_world_lidar_at(int(t)) for t in stamp_ns])
        return T_world_lidar if T_lidar_ego is None else T_world_lidar @ T_lidar_ego

    def write_truth(
        self,
        folder: Path,
        stamp_ns: Sequence[int],
        T_lidar_ego: Float | None = None,
        row_of: Mapping[int, Int] | None = None,
        names: Mapping[str, str] | None = None,
    ) -> None:
        """Exact truth as `densify.readers.truth_files` lays it out, for readers that number the
        sweeps and each camera's images from 0.

        stamp_ns: the reference time that the format gives each sweep. T_lidar_ego: (4,4) the frame
        in which the format has the points, the scanner's if None. row_of: by frame the (N,) rows of
        the returns in the format's file, where it sorts or pads them; rows of none are the world's
        origin. names: what the format calls the street's cameras, if not the same.
        """
        simulator = self.street.simulator
        bodies = simulator.bodies_at(stamp_ns)
        T_ego = np.eye(4) if T_lidar_ego is None else T_lidar_ego
        write_bodies(
            folder,
            type(bodies)(bodies.T_world_lidar @ T_ego, bodies.T_world_body, bodies.moving),
        )
        for number, frame in enumerate(self.frames):
            returns = self.returns(frame)
            in_bodies = simulator.in_bodies(frame, returns)
            rows = np.arange(len(in_bodies)) if row_of is None else row_of[frame]
            num_rows = int(rows.max(initial=-1)) + 1
            body, instance = np.zeros(num_rows, np.int32), np.full(num_rows, -1, np.int32)
            points = np.zeros((num_rows, 3))
            body[rows], instance[rows], points[rows] = returns.body, returns.instance, in_bodies
            write_points(folder, number, body, instance, points)
        truth = self.street.truth
        for camera in self.cameras:
            for number, image in enumerate(self.image_numbers(camera)):
                depth_m, moving = truth.depth_m(camera, image), truth.moving_mask(camera, image)
                write_depth(folder, (names or {}).get(camera, camera), number, depth_m, moving)


def check_cameras_fit(excerpt: Excerpt, format: str, fit: Collection[str]) -> None:
    """Raise InputError for a camera that is not among those that the format has room for."""
    for name in excerpt.cameras:
        if name not in fit:
            raise InputError(
                f"{excerpt.street.name}: camera {name} cannot be written as {format}; choose among "
                f"{', '.join(fit)}"
            )


def quaternion(T: Float) -> Float:
    """(...,4,4) poses -> (...,4) their rotations as unit quaternions w x y z, w not negative."""
    x_y_z_w = Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return x_y_z_w[..., [3, 0, 1, 2]]


def check_plain_cameras(excerpt: Excerpt, format: str) -> None:
    """Raise InputError for a camera with a lens or a rolling shutter, where the format has room for
    neither."""
    for name in excerpt.cameras:
        camera = excerpt.street.cameras[name]
        if not camera.is_rectified or camera.is_rolling:
            cameras = excerpt.street.cameras.items()
            fit = [n for n, c in cameras if c.is_rectified and not c.is_rolling]
            raise InputError(
                f"{excerpt.street.name}: camera {name} cannot be written as {format}, whose images "
                f"are rectified and exposed all at once; choose among {', '.join(fit) or 'none'}"
            )


@contextmanager
def new_folder(folder: Path, overwrite: bool) -> Iterator[Path]:
    """A folder to write into that becomes ``folder``, all of it new, when the block ends well.

    Raises InputError if it is there already and ``overwrite`` is not set."""
    if folder.exists() and not overwrite:
        raise InputError(f"{folder}: there already, kept; give --overwrite to replace it")
    owned = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    with staged_folder(folder, owned) as staging:
        yield staging


def put(path: Path, data: bytes) -> None:
    """Write a file and make the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
