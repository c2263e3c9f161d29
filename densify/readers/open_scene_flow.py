# SPDX-License-Identifier: MIT
"""Files of OpenSceneFlow (https://github.com/KTH-RPL/OpenSceneFlow), made of Argoverse 2, nuScenes,
Waymo and TruckScenes: recordings, and sources of scene flow. One ``LOG.h5`` has a group for each
sweep, named by its stamp::

    lidar (N,3 or more) float32 metres, a fourth column is the intensity     pose (4,4)
    lidar_id (N,)    lidar_dt (N,) s    lidar_center (L,4,4) or (L,3)    ground_mask (N,), not used
    flow (N,3), flow_is_valid (N,), flow_instance_id (N,) 0 none; a network's flow has another name

Stamps are in the unit that puts neighbouring sweeps 0.01 to 2 s apart: nanoseconds for files made
of Argoverse 2, microseconds for the others. Points are compensated to the stamp. Where ``lidar_dt``
tells when each was fired, that is undone with the poses; otherwise, and in a file of one sweep,
there are no point times. Points are in the frame of ``pose``. There are no
images. Files made of Argoverse 2 hold points in the frame of ``up_lidar`` but poses of the vehicle,
1.35 m behind it: their ego motion is wrong by that lever in bends. The default registration does
not use the poses.

The flow is from each sweep to the next, ego motion included: a point p of a sweep is at p + flow in
the next one's frame. The ego motion is removed with the file's own poses. There is no flow
backwards. Towards an earlier sweep a point takes the reversed flow of that earlier sweep's point
that arrives nearest to it, and is static if none arrives within 0.5 m.
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
from scipy.spatial import cKDTree

from densify.config import Config
from densify.config.errors import InputError
from densify.config.file_content import reason
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, Stretch
from densify.readers.extras import needed
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    chosen_scene,
    rigid,
    scanner_axes,
    truth_beside,
)
from densify.readers.flow_files import MOVES_M
from densify.readers.recorded_poses import PoseTrack

_UNITS_NS = (1, 1_000, 1_000_000, 1_000_000_000)
_LEAST_STEP_NS, _MOST_STEP_NS = 10_000_000, 2_000_000_000
_ARRIVES_M = 0.5


def open_recording(path: Path, scene: str | None) -> OpenSceneFlow:
    """See `densify.readers.ReaderModule`. path: a file, or a folder of files."""
    files = {path.stem: path} if path.suffix == ".h5" else {f.stem: f for f in path.glob("*.h5")}
    if not files:
        raise InputError(f"{path}: no recordings; expected files such as LOG.h5")
    return OpenSceneFlow(files[chosen_scene("opensceneflow", path, scene, sorted(files))])


@dataclass(frozen=True)
class SweepFile:
    """One ``.h5`` file. Opened for each use."""

    path: Path

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the file. Raises InputError if it is not there, or not whole."""
        h5py = needed("h5py", "opensceneflow", "OpenSceneFlow recordings")
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such file; expected sweeps in it")
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except (OSError, KeyError, RuntimeError) as error:
            raise InputError(
                f"{self.path}: not a whole HDF5 file ({reason(error)}); fetch it or make it again"
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
        """Return a data set; None in ``shape`` is any number. Raises InputError if it is absent or
        of another shape or kind."""
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
            found = [(name, self.array(file[name], "pose", (4, 4))) for name in self.names]
        return np.stack([rigid(T, f"{self.path}: {name}/pose") for name, T in found])

    @cached_property
    def track(self) -> PoseTrack:
        """The poses over time."""
        return PoseTrack(str(self.path), np.array(self.stamps_ns, np.int64), self.poses)


class OpenSceneFlow(FileSequence):
    """A file as a `LidarSequence`; the lidar frame is that of its points."""

    def __init__(self, path: Path) -> None:
        """Read the names of the sweeps. Raises InputError if there are none."""
        self._file = SweepFile(path)
        frames = range(len(self._file.names))
        super().__init__(path.stem, path, frames, truth=truth_beside(path.parent))
        self._stamps_ns = self._file.stamps_ns

    def stamp_ns(self, frame: int) -> int:
        self.check_frame(frame)
        return self._stamps_ns[frame]

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        read, where = self._file.array, f"{self.where}: {self._file.names[frame]}"
        offset_ns = lidar = origins = axes = None
        with self._file.opened() as file:
            group = file[self._file.names[frame]]
            rows = read(group, "lidar", (None, None))
            num = len(rows)
            if rows.shape[1] < 3:
                raise InputError(f"{where}/lidar: got {rows.shape[1]} columns, expected x y z")
            if "lidar_dt" in group and len(self.frames) > 1:
                offset_s = read(group, "lidar_dt", (num,)).astype(np.float64)
                if not (np.abs(offset_s) < 1).all():
                    raise InputError(f"{where}/lidar_dt: expected seconds since the stamp, below 1")
                offset_ns = np.rint(offset_s * 1e9).astype(np.int64)
            if "lidar_id" in group:
                lidar = read(group, "lidar_id", (num,), "fiu").astype(np.uint8)
            if "lidar_center" in group:
                origins, axes = _mounts(np.asarray(group["lidar_center"]))
        points = rows[:, :3].astype(np.float64)
        if lidar is not None and origins is not None and lidar.max(initial=0) >= len(origins):
            raise InputError(
                f"{where}/lidar_center: got {len(origins)} places, expected one for each lidar_id "
                f"up to {lidar.max()}"
            )
        if offset_ns is not None:
            points = self._file.track.as_fired(points, self._stamps_ns[frame], offset_ns)
        intensity = np.clip(rows[:, 3] / 255, 0, 1) if rows.shape[1] > 3 else np.zeros(num)
        returns = Returns(points, intensity.astype(np.float32), offset_ns, lidar, origins, axes)
        return self.where, returns

    def _pose(self, frame: int) -> Float:
        return self._file.poses[frame]


def _mounts(places: NDArray[Any]) -> tuple[Float | None, Float | None]:
    """Return origins (S,3) and axes (S,3,3) of poses, or origins of points."""
    if places.ndim == 3 and places.shape[1:] == (4, 4):
        T = places.astype(np.float64)
        return T[:, :3, 3], scanner_axes(T)
    if places.ndim == 2 and places.shape[1] == 3:
        return places.astype(np.float64), None
    return None, None


def estimate_motion(scene: Scene, settings: Config, argument: str) -> ChainedMotion:
    """Read the flow of a file as an engine, see `densify.flow.engines.EngineModule`.

    argument: ``FILE.h5``, or ``FILE.h5#NAME`` for another flow than ``flow``.
    """
    path, _, name = argument.partition("#")
    labels = FlowLabels(SweepFile(Path(path)), name or "flow", scene.stretch)
    return ChainedMotion(scene.stretch, labels.step)


def check_argument(argument: str) -> None:
    """Raise InputError unless the file is there and holds such a flow."""
    path, _, name = argument.partition("#")
    file = SweepFile(Path(path))
    with file.opened() as groups:
        if not any((name or "flow") in groups[group] for group in file.names):
            held = {key for group in file.names for key in groups[group]}
            raise InputError(
                f"flow.engine opensceneflow:{argument}: no sweep has {name or 'flow'}; got "
                f"{', '.join(sorted(held))}"
            )


@dataclass(frozen=True)
class FlowLabels:
    """The flow ``name`` in the file that the stretch's sweeps were read from."""

    file: SweepFile
    name: str
    stretch: Stretch

    def step(self, here: int, there: int) -> FlowField:
        """Return the flow of sweep number ``here`` to its neighbour ``there``.

        Raises InputError where the file has no flow of that sweep, or is another recording's.
        """
        sweep = self.stretch.sweeps[here].sweep
        step_ns = self.stretch.sweeps[there].sweep.stamp_ns - sweep.stamp_ns
        find = self._forward if there > here else self._backward
        residual, moving, instance = find(here, there)
        residual[~moving] = 0.0
        to_reference = None
        if sweep.offset_ns is not None:
            to_reference = -(sweep.offset_ns / step_ns)[:, None] * residual
        objects = np.where(moving, instance, -1).astype(np.int32)
        return FlowField(residual, moving, objects, np.zeros(len(sweep), bool), to_reference)

    def _forward(self, here: int, there: int) -> tuple[Float, Bool, NDArray[Any]]:
        frame, row = self.stretch.frames[here], self.stretch.sweeps[here].sweep.row
        target = self.stretch.frames[there]
        if target != frame + 1 or target >= len(self.file.names):
            raise InputError(
                f"{self.file.path}: no flow from sweep {frame} to {target}: got "
                f"{len(self.file.names)} sweeps, each with the flow to the next one only"
            )
        residual, valid, instance = self.read(frame, int(row.max(initial=-1)) + 1)
        moving: Bool = valid[row] & (np.linalg.norm(residual[row], axis=1) >= MOVES_M)
        return residual[row], moving, instance[row]

    def _backward(self, here: int, there: int) -> tuple[Float, Bool, NDArray[Any]]:
        before = self.step(there, here)
        points = self.stretch.sweeps[there].sweep.points + before.total
        T = self.stretch.T_target_source(self.stretch.frames[here], self.stretch.frames[there])
        arrived = cKDTree(poses.transform(T, points))
        gap_m, nearest = arrived.query(self.stretch.sweeps[here].sweep.points)
        moving: Bool = before.moving[nearest] & (gap_m <= _ARRIVES_M)
        return -poses.rotate(T, before.displacement[nearest]), moving, before.instance[nearest]

    def read(self, frame: int, num_rows: int) -> tuple[Float, Bool, NDArray[Any]]:
        """Return the flow without ego motion (N,3), whether it is valid (N,), and the object, -1
        none (N,), of all rows. num_rows: expected at least. Raises InputError where the file has no
        such flow."""
        read = self.file.array
        with self.file.opened() as groups:
            group = groups[self.file.names[frame]]
            if self.name not in group:
                raise InputError(
                    f"{self.file.path}: sweep {frame} ({self.file.names[frame]}) has no "
                    f"{self.name}; got {', '.join(group)}; choose another key or window"
                )
            points = read(group, "lidar", (None, None))[:, :3].astype(np.float64)
            total = read(group, self.name, (len(points), 3)).astype(np.float64)
            valid, instance = np.ones(len(points), bool), np.full(len(points), -1)
            if "flow_is_valid" in group and self.name == "flow":
                valid = read(group, "flow_is_valid", (len(points),), "biu").astype(bool)
            if "flow_instance_id" in group and self.name == "flow":
                ids = read(group, "flow_instance_id", (len(points),), "iu").astype(np.int64)
                instance = ids - 1  # 0 is none
        if len(points) < num_rows:
            raise InputError(
                f"{self.file.path}: sweep {frame} has {len(points)} points, expected {num_rows} or "
                f"more, as the recording has; give the file that --data names"
            )
        valid &= np.isfinite(total).all(axis=1)
        T_here_next = poses.inverse(self.file.poses[frame]) @ self.file.poses[frame + 1]
        return poses.transform(T_here_next, points + total) - points, valid, instance
