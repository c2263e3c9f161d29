# SPDX-License-Identifier: MIT
"""Any folder of sweeps: numbered files of points, and beside them whatever there is of stamps,
poses and images. A small ``densify.yaml`` in the folder (`densify.readers.folder.config`) says what
the files cannot; a folder without one opens as far as can be told.

points
    in the lidar's frame, as fired. ``compensated`` says that they were carried to the stamp by the
    vehicle's motion; it is undone where points have times and poses have stamps, else the times are
    left out.
numbers and stamps
    files are numbered as their names say, or from 0 in the order of time where the names are times
    (``1317042651.468569638.pcd``). Times come from names, from a file beside the sweeps such as
    ``timestamps.txt``, or else from the rate. The stamp is the reference time; points' times are
    since it (or absolute, on its clock) unless ``reference`` says otherwise. Their unit is the one
    in which a sweep takes about a period.
poses
    KITTI's 3x4, 4x4, TUM, tables with quaternions, or the VIEWPOINT of .pcd files. With stamps they
    are interpolated to the sweeps' stamps; without, there is one for each sweep or each number.
images
    need a calibration. Their stamps come from names, a file, or the sweeps of the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Float
from densify.readers.file_sequence import (
    FileSequence,
    Returns,
    of_frame,
    quaternion_pose,
    truth_beside,
)
from densify.readers.folder.columns import SweepColumns
from densify.readers.folder.config import CameraFiles, FolderConfig
from densify.readers.folder.series import (
    Series,
    find_images,
    find_pose_file,
    find_sweeps,
    images_in,
    in_time,
)
from densify.readers.point_files import read_viewpoint
from densify.readers.recorded_poses import PoseFile, PoseTrack
from densify.readers.timeline import format_frames

_NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def open_recording(path: Path, scene: str | None) -> Folder:
    """See `densify.readers.ReaderModule`; a folder has no scenes."""
    return Folder(path)


class Folder(FileSequence):
    """A folder of sweeps as a `LidarSequence`; `findings` says what was found."""

    def __init__(self, path: Path | str) -> None:
        """Reads names, densify.yaml, stamps and poses at once, sweeps and images on demand. Raises
        InputError if there are no sweeps, or what is beside them is malformed or contradicts."""
        folder = Path(path)
        self._config = FolderConfig.read(folder)
        known, cameras = self._config.sweeps, self._config.cameras
        files = find_sweeps(folder, known.files)
        self._sweeps = in_time(folder, files, known.stamps, known.stamps_unit)
        self._columns = SweepColumns(self._sweeps, known, self._config.path)
        images = {name: _images(folder, name, given) for name, (_, given) in cameras.items()}
        super().__init__(
            folder.resolve().name,
            folder,
            tuple(self._sweeps.paths),
            {name: camera for name, (camera, _) in cameras.items()},
            truth=truth_beside(folder),
            files=self._sweeps.paths,
            images={name: series.paths for name, series in images.items()},
        )
        by_number = {frame: self.stamp_ns(frame) for frame in self.frames} if images else {}
        for name, series in images.items():
            shift_ns = round(cameras[name][1].clock_offset_s * 1e9)
            own = series.stamps_ns or {n: ns for n, ns in by_number.items() if n in series.paths}
            self._exposed_ns[name] = {number: ns + shift_ns for number, ns in own.items()}
        self._read_poses()

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep."""
        self.check_frame(frame)
        if self._sweeps.stamps_ns is None:
            return int(frame) * self._columns.period_ns
        return self._sweeps.stamps_ns[frame]

    def findings(self) -> Sequence[tuple[str, str]]:
        """See `LidarSequence`."""
        layout, first = self._columns.layout, self._sweeps.paths[self.frames[0]]
        fields = [f"{part} = {name}" for part, name in vars(layout.fields).items() if name]
        unused = ", ".join(self._columns.unused())
        times, told_by = layout.time_words, self._sweeps.told_by
        if self._config.sweeps.compensated and self._track is None:
            times = (
                "left out: the points are compensated, and no poses with stamps tell by how much"
            )
        if not told_by:
            how = "the" if self._config.sweeps.rate_hz else "an assumed"
            told_by = f"number, at {how} {1e9 / self._columns.period_ns:g} Hz (rate_hz)"
        lines = [
            ("files", f"{(first.parent / '*').relative_to(self.where)}{first.suffix}"),
            ("fields", ", ".join(fields) + (f"; not used: {unused}" if unused else "")),
            ("intensity", f"divided by {layout.intensity_scale:g}"),
            ("times", times),
            ("stamped by", told_by),
        ]
        if self._poses is not None:
            lines.append(("poses from", f"{self._poses.path.name} ({self._poses.form})"))
        elif self._has_viewpoints:
            lines.append(("poses from", "VIEWPOINT of the sweeps"))
        used = {str(Path(given.files)) for _, given in self._config.cameras.values()}
        for name, images in find_images(self.where).items():
            if name not in used:
                text = f"{name} holds {len(images)} images without a calibration"
                lines.append(("no camera", text))
        return lines

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        stamp_ns = self.stamp_ns(frame)
        path, found = self._columns.returns(frame, stamp_ns)
        if not self._config.sweeps.compensated or found.offset_ns is None:
            return path, found
        if self._track is None:
            return path, replace(found, offset_ns=None)
        points = self._track.as_fired(found.points, stamp_ns, found.offset_ns)
        return path, replace(found, points=points)

    def _pose(self, frame: int) -> Float:
        if self._track is not None:
            return self._track.at(self.stamp_ns(frame))
        if self._poses is not None:
            return of_frame(self._T_world_lidar, frame, "pose", self._poses.path)
        if not self._has_viewpoints:
            return super()._pose(frame)
        path = self._sweeps.paths[frame]
        x, y, z, *quaternion = read_viewpoint(path) or _NO_VIEWPOINT
        return quaternion_pose(quaternion, (x, y, z), f"{path}: VIEWPOINT")

    def _read_poses(self) -> None:
        """Read the lidar's path where the poses have stamps, else its pose by frame."""
        known, frames = self._config.poses, self.frames
        self._poses: PoseFile | None = None
        self._track: PoseTrack | None = None
        path = find_pose_file(self.where, known.file)
        if path is None:
            return
        self._poses = found = PoseFile.read(path, known.stamps_unit)
        T = poses.inverse(found.T) if known.inverse else found.T
        T = T if known.T_frame_lidar is None else T @ known.T_frame_lidar
        if found.stamps_ns is not None:
            self._track = PoseTrack(str(path), np.array(found.stamps_ns, np.int64), T)
            return
        if len(T) != len(frames) and len(T) <= frames[-1]:
            raise InputError(
                f"{path}: got {len(T)} poses for {len(frames)} sweeps numbered "
                f"{format_frames(frames)}, expected one for each, or for each number from 0"
            )
        numbers = frames if len(T) == len(frames) else range(len(T))
        self._T_world_lidar = dict(zip(numbers, T, strict=True))

    @cached_property
    def _has_viewpoints(self) -> bool:
        """Return True if VIEWPOINT holds poses; many drives begin with sweeps at the origin."""
        tried = {self.frames[0], self.frames[len(self.frames) // 2], self.frames[-1]}
        found = [read_viewpoint(self._sweeps.paths[frame]) for frame in sorted(tried)]
        return any(one not in (None, _NO_VIEWPOINT) for one in found)


def _images(folder: Path, name: str, given: CameraFiles) -> Series:
    paths = images_in(folder / given.files)
    if not paths:
        key = f"cameras: {{{name}: {{files: {given.files}}}}}"
        raise InputError(f"{folder / given.files}: no images, though densify.yaml names it: {key}")
    return in_time(folder, paths, given.stamps, given.stamps_unit, shared=False)
