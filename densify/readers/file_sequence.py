# SPDX-License-Identifier: MIT
"""Provide the base class of readers of recorded files, which checks requests and contents."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import described_in, read_bytes
from densify.geometry.types import Camera, Float, Float32, Int, Sweep, Truth
from densify.geometry.types.recordings import in_one_line
from densify.readers import checks
from densify.readers.decoded_files import stated_size_px


@dataclass(frozen=True)
class Returns:
    """All N rows of a sweep's file, valid or not, not deskewed, measured by S scanners."""

    points: Float  # (N,3) metres, lidar frame at each point's own firing time; 0 0 0 if invalid
    intensity: Float32 | None = None  # (N,) 0 to 1; None if the file has none
    offset_ns: Int | None = None  # (N,) int64 since the sweep's reference time; None if unknown
    # (N,) index of the scanner that fired, 0 to S - 1; None for a single scanner
    lidar: NDArray[np.integer[Any]] | None = None
    # (S,3) metres, start of each scanner's rays in the lidar frame; None if rays start at 0 0 0
    scanner_origins: Float | None = None
    # (S,3,3) rotations from the lidar frame to the axes of each scanner, which spins about its z
    # axis; None if the axes are equal
    R_scanner_lidar: Float | None = None
    num_untimed: int = 0  # rows set to 0 0 0 because their time cannot belong to this sweep


class FileSequence(ABC):
    """A `LidarSequence` of files. A reader sets ``_stamps_ns`` or overrides `stamp_ns`."""

    _stamps_ns: Mapping[int, int] | Sequence[int] | Int

    def __init__(
        self,
        name: str,  # name of the recording, for people and outputs
        where: Path,  # path of the recording, for messages
        frames: Sequence[int],  # numbers of the existing sweeps, ascending
        cameras: Mapping[str, Camera] | None = None,  # cameras by name, None for none
        # Exposure time of each existing image in ns, by camera and image number
        exposed_ns: Mapping[str, Mapping[int, int]] | None = None,
        truth: Truth | None = None,  # ground truth of a simulated recording
        files: Mapping[int, Path] | None = None,  # file of each sweep, None if sweeps share files
        # PNG or JPEG file of each image, by camera and number. None if the reader has an `_image`
        images: Mapping[str, Mapping[int, Path]] | None = None,
    ) -> None:
        """Store what the reader found. Raise InputError if all files of sweeps are empty."""
        self.name = name
        self.where = where
        self.frames: Sequence[int] = frames
        self.cameras: Mapping[str, Camera] = cameras or {}
        self.truth = truth
        self._frames = dict.fromkeys(frames)
        self._exposed_ns = dict(exposed_ns or {})
        self._files = files or {}
        self._image_files = images or {}
        if self._files and not any(path.stat().st_size for path in self._files.values()):
            raise InputError(
                f"{where}: all {len(self._files)} files of sweeps are empty; fetch them again"
            )

    def __repr__(self) -> str:
        return in_one_line(self)

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep in nanoseconds, without reading its points."""
        self.check_frame(frame)
        return int(self._stamps_ns[frame])

    @abstractmethod
    def _returns(self, frame: int) -> Returns:
        """Read all rows of an existing sweep. Any exception is reported as a malformed file."""

    def _checked_returns(self, frame: int) -> tuple[Path, Returns]:
        """Return the path of a sweep's file, for messages, and all rows of the file."""
        self.check_frame(frame)
        path = self._files.get(frame, self.where)
        with described_in(path, f"sweep {frame} in the data set's own form"):
            return path, self._returns(frame)

    def sweep_bytes(self) -> dict[int, int]:
        """Return the size of each sweep's file in bytes, by frame, empty if sweeps share files."""
        return {frame: path.stat().st_size for frame, path in self._files.items()}

    def check_first_images(self) -> None:
        """Raise InputError if the size of a camera's first image differs from its calibration."""
        for name, files in self._image_files.items():
            path = next(iter(files.values()))
            size_px = stated_size_px(path)
            if name in self.cameras and size_px is not None:
                checks.check_image_size(size_px[::-1], self.cameras[name], path)

    def _image(self, camera: Camera, number: int) -> NDArray[np.uint8]:
        """Return an existing image, (H,W,3) uint8 RGB."""
        path = self._image_files[camera.name][number]
        return checks.decode_rgb(read_bytes(path), camera, path)

    def _pose(self, frame: int) -> Float:
        """Return the (4,4) T_world_lidar of an existing sweep. Raise InputError without poses."""
        raise InputError(
            f"{self.where}: no poses; let the sweeps register themselves with "
            f"--set register.source=kiss-icp"
        )

    def __getitem__(self, frame: int) -> Sweep:
        """Return the valid points of a sweep, in file order, at their own firing times.

        Rows at 0 0 0 (padding) or not finite are dropped; intensities that are not finite become 0.
        Raise InputError if the sweep is missing, malformed or without valid points.
        """
        path, returns = self._checked_returns(frame)
        x, y, z = returns.points.T  # by columns: reductions over rows of three are far slower
        is_finite = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
        is_padding = (x == 0) & (y == 0) & (z == 0)
        row = np.flatnonzero(is_finite & ~is_padding)
        if not len(row):
            untimed = f", {returns.num_untimed} with a time of another sweep"
            raise InputError(
                f"{path}: holds no points (frame {frame}: {len(returns.points)} rows, none valid"
                f"{untimed * bool(returns.num_untimed)}); choose a key or window without this frame"
            )
        zeros = np.zeros(len(returns.points), np.uint8)
        intensity = (zeros if returns.intensity is None else returns.intensity)[row]
        lidar = (zeros if returns.lidar is None else returns.lidar)[row]
        # Numbers of scanners are stored in 8 bits.
        origins = returns.scanner_origins
        num_scanners = 256 if origins is None else len(origins)
        if not 0 <= lidar.min() <= lidar.max() < num_scanners:
            raise InputError(
                f"{path}: got points of scanner {lidar.min()} to {lidar.max()}, expected 0 to "
                f"{num_scanners - 1}"
            )
        return Sweep(
            frame=int(frame),
            stamp_ns=self.stamp_ns(frame),
            points=np.asarray(returns.points.take(row, axis=0), np.float64),
            intensity=np.where(np.isfinite(intensity), intensity, 0).astype(np.float32),
            offset_ns=None if returns.offset_ns is None else returns.offset_ns[row],
            lidar=lidar.astype(np.uint8),
            row=row.astype(np.int64, copy=False),
            scanner_origins=origins,
            R_scanner_lidar=returns.R_scanner_lidar,
            num_untimed=returns.num_untimed,
        )

    def num_rows(self, frame: int) -> int:
        """Return the number of rows, valid or not, in the file of a sweep."""
        return len(self._checked_returns(frame)[1].points)

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return the exposure time (ns) of each existing image of a camera, by image number."""
        checks.camera_named(self.cameras, camera, self.where)
        return self._exposed_ns.get(camera, {})

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return an image as (H,W,3) uint8 RGB. Raise InputError if missing or of another size."""
        return self._image(self.check_image(camera, number), number)

    def T_world_lidar(self, frame: int) -> Float:
        """Return the recorded (4,4) lidar pose at a sweep's stamp, or raise InputError."""
        self.check_frame(frame)
        return checks.pose(self._pose(frame), f"{self.where}: pose of frame {frame}")

    def check_frame(self, frame: int) -> None:
        """Raise InputError, with the existing frame numbers, if the sweep does not exist."""
        checks.find_entry(self._frames, frame, "sweep", self.where)

    def check_image(self, camera: str, number: int) -> Camera:
        """Return the camera of an image. Raise InputError if the image does not exist."""
        calibrated = checks.camera_named(self.cameras, camera, self.where)
        checks.find_entry(self._exposed_ns.get(camera, {}), number, f"{camera} image", self.where)
        return calibrated
