# SPDX-License-Identifier: MIT
"""Recordings preprocessed for OpenSceneFlow (https://github.com/KTH-RPL/OpenSceneFlow; its
``dataprocess/extract_*.py`` make them of Argoverse 2, nuScenes, Waymo and TruckScenes): one
``LOG.h5`` with a group for each sweep, named by its stamp::

    lidar (N,3 or more) float32 metres, a fourth column is the intensity     pose (4,4)
    ground_mask (N,)    lidar_id (N,)    lidar_dt (N,) s    lidar_center (L,4,4) or (L,3)
    flow (N,3) ...      labels and estimates, see `densify.readers.open_scene_flow.labels`

Stamps are in the unit that makes neighbouring sweeps lie 0.01 to 2 s apart: nanoseconds for files
made of Argoverse 2, microseconds for the others. Points lie at the stamp, carried there by the
vehicle's own motion, as in the data sets themselves; where ``lidar_dt`` tells when each was fired
after the stamp that is undone with the poses; elsewhere, and in a file of one sweep, there are no
point times. They are in the frame of ``pose``. (Files made of Argoverse 2 hold points in the frame
of ``up_lidar`` but poses of the vehicle, 1.35 m behind it: its own motion is then wrong by that
lever in bends. The default registration does not use the poses.) Scanners stand where
``lidar_center`` says, else all at the frame's origin. There are no images. ``ground_mask`` is not
used: the ground is found anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Float, Float32
from densify.readers.extras import needed
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    rigid,
    scanner_axes,
    truth_beside,
)
from densify.readers.recorded_poses import PoseTrack

_UNITS_NS = (1, 1_000, 1_000_000, 1_000_000_000)
_LEAST_STEP_NS, _MOST_STEP_NS = 10_000_000, 2_000_000_000


def open_recording(path: Path, scene: str | None) -> OpenSceneFlow:
    """See `densify.readers.ReaderModule`. path: a file, or a folder of files."""
    if path.suffix == ".h5":
        if scene not in (None, path.stem):
            raise InputError(f"{path}: is the recording {path.stem}; leave #{scene} out")
        return OpenSceneFlow(path)
    files = {file.stem: file for file in sorted(path.glob("*.h5"))}
    if not files:
        raise InputError(f"{path}: no recordings; expected files such as LOG.h5")
    return OpenSceneFlow(files[chosen_scene("opensceneflow", path, scene, list(files))])


@dataclass(frozen=True)
class SweepFile:
    """One ``.h5`` file. Opened for each use."""

    path: Path

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """The open file. Raises InputError if it is not there, or not whole."""
        h5py = needed("h5py", "opensceneflow", "OpenSceneFlow recordings")
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such file; expected sweeps in it")
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except (OSError, KeyError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self.path}: not a whole HDF5 file ({reason}); fetch it or make it again"
            ) from error

    @cached_property
    def names(self) -> list[str]:
        """The groups' names in the order of time. Raises InputError if there are none."""
        with self.opened() as file:
            names = sorted((name for name in file if name.isdecimal()), key=int)
        if not names:
            raise InputError(
                f"{self.path}: holds no sweeps; expected groups named by stamps, such as "
                f"315966265259836000"
            )
        return names

    @cached_property
    def stamps_ns(self) -> list[int]:
        """The sweeps' stamps. Raises InputError if no unit fits."""
        numbers = [int(name) for name in self.names]
        step = float(np.median(np.diff(numbers))) if len(numbers) > 1 else 0.0
        fit = [u for u in _UNITS_NS if _LEAST_STEP_NS <= step * u <= _MOST_STEP_NS]
        if len(numbers) == 1:
            fit = [1 if len(self.names[0]) > 16 else 1_000]
        if not fit or numbers[-1] * fit[0] > np.iinfo(np.int64).max:
            raise InputError(
                f"{self.path}: got sweeps named {self.names[0]} to {self.names[-1]} in steps of "
                f"{step:g}, expected stamps in ns, us or ms that are 0.01 to 2 s apart"
            )
        return [number * fit[0] for number in numbers]

    def array(
        self, group: Any, name: str, shape: Sequence[int | None], kinds: str = "f"
    ) -> NDArray[Any]:
        """A data set; None in ``shape`` is any number. Raises InputError if it is absent or of
        another shape or kind."""
        where = f"{self.path}: {group.name.strip('/')}/{name}"
        if name not in group:
            raise InputError(f"{where}: absent; got {', '.join(group) or 'an empty group'}")
        array: NDArray[Any] = np.asarray(group[name])
        same = len(array.shape) == len(shape) and all(
            want is None or want == got for want, got in zip(shape, array.shape, strict=True)
        )
        if not same or array.dtype.kind not in kinds:
            wanted = ", ".join("any" if s is None else str(s) for s in shape)
            raise InputError(
                f"{where}: got shape {array.shape} of {array.dtype}, expected numbers of shape "
                f"({wanted})"
            )
        return array

    @cached_property
    def poses(self) -> Float:
        """(n,4,4) of the sweeps. Raises InputError if one is absent or no rigid motion."""
        with self.opened() as file:
            return np.stack(
                [
                    rigid(self.array(file[name], "pose", (4, 4)), f"{self.path}: {name}/pose")
                    for name in self.names
                ]
            )

    @cached_property
    def track(self) -> PoseTrack:
        """The poses over time."""
        return PoseTrack(str(self.path), np.array(self.stamps_ns, np.int64), self.poses)


class OpenSceneFlow(FileSequence):
    """A file as a `LidarSequence`; the lidar frame is that of its points."""

    def __init__(self, path: Path) -> None:
        """Reads the names of the sweeps. Raises InputError if there are none."""
        self._file = SweepFile(path)
        super().__init__(
            path.stem,
            path,
            range(len(self._file.names)),
            truth=truth_beside(path.parent),
        )
        self._stamps_ns = self._file.stamps_ns

    def stamp_ns(self, frame: int) -> int:
        self.check_frame(frame)
        return self._stamps_ns[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        read, name = self._file.array, self._file.names[frame]
        offset_ns = lidar = origins = axes = None
        with self._file.opened() as file:
            group = file[name]
            rows = read(group, "lidar", (None, None))
            num = len(rows)
            if rows.shape[1] < 3:
                raise InputError(
                    f"{self.where}: {name}/lidar: got {rows.shape[1]} columns, expected x y z"
                )
            if "lidar_dt" in group and len(self.frames) > 1:
                offset_s = read(group, "lidar_dt", (num,)).astype(np.float64)
                if not (np.isfinite(offset_s) & (np.abs(offset_s) < 1)).all():
                    raise InputError(
                        f"{self.where}: {name}/lidar_dt: got {np.abs(offset_s).max():g}, expected "
                        f"seconds since the stamp, below 1"
                    )
                offset_ns = np.rint(offset_s * 1e9).astype(np.int64)
            if "lidar_id" in group:
                lidar = read(group, "lidar_id", (num,), "fiu").astype(np.uint8)
            if "lidar_center" in group:
                origins, axes = _mounts(np.asarray(group["lidar_center"]))
        points = rows[:, :3].astype(np.float64)
        if lidar is not None and origins is not None and lidar.max(initial=0) >= len(origins):
            raise InputError(
                f"{self.where}: {name}/lidar_center: got {len(origins)} places, expected one for "
                f"each lidar_id up to {lidar.max()}"
            )
        if offset_ns is not None:
            points = self._file.track.as_fired(points, self._stamps_ns[frame], offset_ns)
        intensity: Float32 | None = None
        if rows.shape[1] > 3:
            intensity = np.clip(rows[:, 3] / 255, 0, 1).astype(np.float32)
        return self.where, Returns(points, intensity, offset_ns, lidar, origins, axes)

    def _pose(self, frame: int) -> Float:
        return self._file.poses[frame]


def _mounts(places: NDArray[Any]) -> tuple[Float | None, Float | None]:
    """Origins (S,3) and axes (S,3,3) of poses, or origins of points."""
    if places.ndim == 3 and places.shape[1:] == (4, 4):
        T = places.astype(np.float64)
        return T[:, :3, 3], scanner_axes(T)
    if places.ndim == 2 and places.shape[1] == 3:
        return places.astype(np.float64), None
    return None, None
