# SPDX-License-Identifier: MIT
"""Read any folder of numbered point files, with stamps, poses and images beside them.

``densify.yaml`` (`densify.readers.folder_config`) states what the files leave open.

points: in the lidar's frame, not deskewed. With ``compensated`` they are ego-motion compensated to
    the stamp. The reader undoes this if points have times and poses have stamps. Otherwise it
    discards the times.
numbers: of file names; files named by times (``1317042651.468569638.pcd``) are numbered from 0.
stamps: reference times, from names, a file such as ``timestamps.txt``, or the rate. Times of points
    count from the stamp, or are absolute; their unit is that in which a sweep takes a period. With
    ``time: azimuth`` they are computed from the azimuths of the points.
poses: KITTI's 3x4, 4x4, TUM, tables with quaternions, or VIEWPOINT of PCD files. Poses with stamps
    are interpolated. Poses without stamps belong to the sweeps in order, or to the numbers from 0.
images: need a calibration; stamped by names, a file, or the sweeps of the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.clock import share_of_turn
from densify.geometry.types import Float, Int
from densify.readers import checks
from densify.readers.file_sequence import FileSequence, Returns
from densify.readers.folder_config import AZIMUTH, NAME, CameraFiles, FolderConfig, SweepFiles
from densify.readers.point_fields import Columns, PointLayout, PointTimes, sample_columns
from densify.readers.point_files import SUFFIXES, read_table
from densify.readers.recorded_poses import PoseFile, PoseTrack, transform_from_world
from densify.readers.stamped_files import NamedFile, Series, files_below, order_files, require_path
from densify.readers.timeline import median_period_ns

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_SEARCH_DEPTH = 2  # levels of subfolders
_ASSUMED_HZ = 10.0
_NAMED = ("intensity", "time", "lidar")  # quantities whose column densify.yaml may name
_SINCE_MIDDLE = {"start": -0.5, "middle": 0.0, "end": 0.5}  # turns from the middle to the reference
_UNTIMED = (
    "times of points are left out: they are compensated, and no poses with stamps tell by how much"
)


def open_recording(path: Path, scene: str | None) -> Folder:
    """Return the recording in a folder of sweeps, which has no scenes."""
    return Folder(path)


@dataclass(frozen=True)
class Turn:
    """How a scanner turns in each sweep, for firing times by azimuth."""

    settings: SweepFiles  # direction, azimuth of the start, and reference of the stamp
    duration_ns: int  # duration of a turn

    def offset_ns(self, returns: Returns, points: Float) -> Int:
        """Return the firing times (N,) since the stamp of points (N,3) of ``returns``, as fired."""
        if returns.scanner_origins is not None:
            lidar = 0 if returns.lidar is None else returns.lidar
            points = points - returns.scanner_origins.take(lidar, axis=0, mode="clip")
        is_clockwise = self.settings.turn == "clockwise"
        middle_rad = np.deg2rad(self.settings.start_deg - 180.0)
        share = share_of_turn(points, middle_rad, is_clockwise)
        share -= _SINCE_MIDDLE[self.settings.reference or "middle"]
        return np.rint(share * self.duration_ns).astype(np.int64)

    def __str__(self) -> str:
        return (
            f"by azimuth, {self.settings.turn} turns of {self.duration_ns * 1e-6:.1f} ms from "
            f"{self.settings.start_deg:g} deg, the stamp is the "
            f"{self.settings.reference or 'middle'}"
        )


class Folder(FileSequence):
    """A folder of sweeps as a `LidarSequence`. `findings` states what the reader detected."""

    def __init__(self, path: Path | str) -> None:
        folder = Path(path)
        self._config = FolderConfig.read(folder)
        self._settings, cameras = self._config.sweeps, self._config.cameras
        files = _find_sweeps(folder, self._settings.files)
        sweeps = order_files(folder, files, self._settings.stamps, self._settings.stamps_unit)
        self._sweep_stamps_ns, self._stamped_by = sweeps.stamps_ns, sweeps.stamped_by
        self._point_stamps_ns: dict[int, int] = {}  # stamps made of point times, by frame
        images = {name: _find_images(folder, name, files) for name, files in cameras.items()}
        super().__init__(
            folder.resolve().name,
            folder,
            tuple(sweeps.paths),
            {name: files.camera(name) for name, files in cameras.items()},
            truth=checks.truth_beside(folder),
            files=sweeps.paths,
            images={name: series.paths for name, series in images.items()},
        )
        self._stamped_by_sweeps: dict[str, str] = {}  # a note for each camera
        for name, series in images.items():
            shift_ns = round(cameras[name].clock_offset_s * 1e9)
            stamps_ns = series.stamps_ns
            if stamps_ns is None:
                stamps_ns = {n: self.stamp_ns(n) for n in self.frames if n in series.paths}
                if cameras[name].stamps != "sweeps":
                    self._stamped_by_sweeps[name] = self._pairing(series.paths)
            self._exposed_ns[name] = {number: ns + shift_ns for number, ns in stamps_ns.items()}
        self._read_poses()
        self._is_untimed = self._settings.compensated and self._track is None

    def _pairing(self, images: Mapping[int, Path]) -> str:
        """Describe that images have the stamps of sweeps, which is an assumption of the reader."""
        text = (
            f"{len(images)} images without stamps beside {len(self.frames)} sweeps: each is taken "
            f"as exposed when the sweep of its number is stamped"
        )
        if images.keys() != set(self.frames):
            text += "; if their rates differ, give the images' times (stamps in densify.yaml)"
        return text

    def _read_poses(self) -> None:
        """Read the poses into ``_track`` if they have stamps, else by frame number."""
        settings = self._config.poses
        file = PoseFile.of_folder(self.where, settings.file, settings.stamps_unit, self._files)
        if file is None and self._settings.frame == "poses":
            raise InputError(
                f"{self._config.path}: sweeps.frame: got poses, but there are no poses; give those "
                f"that placed the sweeps (poses: {{file: NAME}})"
            )
        self._poses = file
        self._track: PoseTrack | None = None
        if file is None:
            return
        T = poses.inverse(file.T) if settings.inverse else file.T
        T = T if settings.T_frame_lidar is None else T @ settings.T_frame_lidar
        if file.stamps_ns is not None:
            self._track = PoseTrack(str(file.path), np.array(file.stamps_ns, np.int64), T)
        else:
            self._T_world_lidar = replace(file, T=T).by_frame(self.frames)

    def gaps(self) -> list[str]:
        """Return a sentence for each missing part, which says what is assumed instead."""
        notes, drive = [], checks.drive_around(self.where)
        if not (self._sweep_stamps_ns or self._point_clock or self._settings.rate_hz):
            notes.append(
                f"the sweeps have no stamps: they are taken for {1e9 / self._period_ns:g} Hz by "
                f"their numbers; give rate_hz or stamps in densify.yaml"
            )
        if drive is not None:
            notes.append(
                f"{self.where} is a part of the KITTI drive {drive}: read alone it has no times of "
                f"points, images and poses; give the drive"
            )
        if self._is_untimed:
            notes.append(_UNTIMED)
        return notes + [f"{name}: {text}" for name, text in self._stamped_by_sweeps.items()]

    def findings(self) -> Sequence[tuple[str, str]]:
        """Return what the reader detected, such as columns and stamps, as (name, text) pairs."""
        layout, first = self._layout, self._files[self.frames[0]]
        lines = [
            ("files", f"{(first.parent / '*').relative_to(self.where)}{first.suffix}"),
            ("fields", self._describe_columns()),
            ("intensity", f"divided by {layout.intensity_scale:g}"),
            ("times", _UNTIMED if self._is_untimed else layout.time_words),
            ("stamped by", self._describe_stamps()),
            *self._stamped_by_sweeps.items(),
        ]
        if drive := checks.drive_around(self.where):
            lines.insert(0, ("part of", f"the KITTI drive {drive}, which has more: name that"))
        if self._poses is not None:
            lines.append(("poses from", f"{self._poses.path.name} ({self._poses.form})"))
        used = {str(Path(config.files)) for config in self._config.cameras.values()}
        for name, images in files_below(self.where, _IMAGE_SUFFIXES, _SEARCH_DEPTH).items():
            if name not in used:
                text = (
                    f"{name} holds {len(images)} images without a calibration; give in "
                    f"densify.yaml: cameras: {{{Path(name).name}: {{files: {name}, size: "
                    f"[width, height], K: [fx, fy, cx, cy], T_cam_lidar: three rows}}}}"
                )
                lines.append(("no camera", text))
        return lines

    def _describe_columns(self) -> str:
        """Return a text of the columns in use, and of the unused ones with ranges of values."""
        unused = [
            f"{name} ({np.nanmin(column):g} to {np.nanmax(column):g})"
            for name, column in next(iter(self._samples.values())).items()
            if name not in self._layout.fields.values()
        ]
        return f"{self._layout}; not used: {', '.join(unused)}" if unused else str(self._layout)

    def _describe_stamps(self) -> str:
        """Return the source of the stamps as text."""
        if self._stamped_by:
            return self._stamped_by
        if self._point_clock is not None:
            return f"the times of the points ({self._point_clock.field})"
        article = "the" if self._settings.rate_hz else "an assumed"
        return f"number, at {article} {1e9 / self._period_ns:g} Hz (rate_hz)"

    def stamp_ns(self, frame: int) -> int:
        """Return a sweep's stamp in ns, else a time of its points, else frame times period."""
        self.check_frame(frame)
        if self._sweep_stamps_ns is not None:
            return self._sweep_stamps_ns[frame]
        times = self._point_clock
        if times is None:
            return int(frame) * self._period_ns
        if frame not in self._point_stamps_ns:
            path = self._files[frame]
            columns = self._columns(path)
            stamp_ns = times.own_stamp_ns(columns[times.field]) if times.field in columns else None
            if stamp_ns is None:
                raise InputError(f"{path}: no time of a point in {times.field}, which others have")
            self._point_stamps_ns[frame] = stamp_ns
        return self._point_stamps_ns[frame]

    @cached_property
    def _point_clock(self) -> PointTimes | None:
        """The column of absolute point times that replaces missing stamps, None without one."""
        try:
            times = self._layout.times
        except InputError:  # raised again when a sweep is read
            return None
        return times if times is not None and times.absolute else None

    @cached_property
    def _period_ns(self) -> int:
        """The median time between stamps in ns, or the assumed period without stamps."""
        assumed_ns = round(1e9 / (self._settings.rate_hz or _ASSUMED_HZ))
        return median_period_ns([*(self._sweep_stamps_ns or {}).values()], assumed_ns)

    @cached_property
    def _layout(self) -> PointLayout:
        """The meaning of the columns, found in a few sweeps."""
        frame, columns = next(iter(self._samples.items()))
        path, settings, stamps_ns = self._files[frame], self._settings, self._sweep_stamps_ns
        column_of = {quantity: getattr(settings, quantity) for quantity in _NAMED}
        if self._turn is not None:
            del column_of["time"]
        column_of = {quantity: name for quantity, name in column_of.items() if name}
        for quantity, name in column_of.items():
            if name not in columns:
                raise InputError(
                    f"{self._config.path}: sweeps.{quantity}: got {name!r}, expected a column of "
                    f"{path.name}: {', '.join(columns)}"
                )
        layout = PointLayout.find(
            [*self._samples.values()],
            path,
            self._period_ns,
            stamps_ns=None if stamps_ns is None else [stamps_ns[f] for f in self._samples],
            named=column_of,
            intensity_scale=settings.intensity_scale,
            unit=settings.time_unit,
            absolute=settings.time_is == "absolute" if settings.time_is else None,
            reference=settings.reference,
        )
        if self._turn is None:
            return layout
        fields = {quantity: name for quantity, name in layout.fields.items() if quantity != "time"}
        return replace(layout, fields=fields, times=None, time_words=str(self._turn))

    @cached_property
    def _turn(self) -> Turn | None:
        """The turn that gives points their times, None if they have times of their own or none."""
        if self._settings.time != AZIMUTH:
            return None
        rate_hz = self._settings.rate_hz
        return Turn(self._settings, round(1e9 / rate_hz) if rate_hz else self._period_ns)

    @cached_property
    def _samples(self) -> dict[int, Columns]:
        """The columns of a few sweeps spread over the recording, by frame number."""
        return sample_columns(self.frames, lambda frame: self._columns(self._files[frame]))

    def _columns(self, path: Path) -> Columns:
        """Read the numeric columns (N,) of a file."""
        columns = read_table(path, self._settings.columns)
        return {name: column for name, column in columns.items() if column.dtype.kind in "fiu"}

    def _returns(self, frame: int) -> Returns:
        """Read all rows of a sweep, and undo what the files did to its points."""
        stamp_ns, path, settings = self.stamp_ns(frame), self._files[frame], self._settings
        columns = self._columns(path)
        returns = self._layout.returns(columns, path, stamp_ns)
        lidar = None
        if name := self._layout.fields.get("lidar"):
            # Invalid rows may hold any number.
            numbers = np.where(returns.points.any(axis=1), columns[name], 0)
            if not np.isin(numbers, np.arange(256)).all():
                raise InputError(f"{path}: {name}: expected the number of a scanner, 0 to 255")
            lidar = numbers.astype(np.uint8)
        points, origins = settings.scale_m * returns.points, settings.scanner_origins
        if settings.axes is not None:
            points = points @ settings.axes.T
        returns = replace(returns, lidar=lidar, scanner_origins=origins)
        if settings.frame == "poses":  # compensated to the pose
            points = transform_from_world(points, self._pose(frame))
        points, offset_ns = self._as_fired(replace(returns, points=points), stamp_ns)
        return replace(returns, points=points, offset_ns=offset_ns)

    def _as_fired(self, returns: Returns, stamp_ns: int) -> tuple[Float, Int | None]:
        """Return the points (N,3) without compensation to ``stamp_ns``, and their times or None."""
        points, offset_ns, track = returns.points, returns.offset_ns, self._track
        times_of = None if self._turn is None else partial(self._turn.offset_ns, returns)
        if not self._settings.compensated and self._settings.frame == "lidar":
            return points, offset_ns if times_of is None else times_of(points)
        if track is None:  # the compensation cannot be undone, so the times do not apply
            return points, None
        if times_of is not None:
            return track.undo_compensation_by(times_of, points, stamp_ns)
        if offset_ns is not None:
            points = track.undo_compensation(points, stamp_ns, offset_ns)
        return points, offset_ns

    def _pose(self, frame: int) -> Float:
        if self._track is not None:
            return self._track.at(self.stamp_ns(frame))
        if self._poses is not None:
            return checks.find_entry(self._T_world_lidar, frame, "pose", self._poses.path)
        return super()._pose(frame)


def _find_sweeps(folder: Path, files: str) -> list[Path]:
    """Return the numbered point files in ``files`` ("": two levels deep), all of one suffix."""
    if files:
        require_path(folder, files, "sweeps: {files: ...}", is_folder=True)
    below = files_below(folder / files, SUFFIXES, 0 if files else _SEARCH_DEPTH)
    for suffix in SUFFIXES:
        groups = {
            name: numbered
            for name, paths in below.items()
            if (numbered := [p for p in paths if p.suffix.lower() == suffix and _is_numbered(p)])
        }
        if len(groups) > 1:
            raise InputError(
                f"{folder}: several folders hold sweeps: {', '.join(groups)}; name one in "
                f"{folder / NAME}: sweeps: {{files: ...}}"
            )
        for paths in groups.values():
            return paths
    raise InputError(
        f"{folder / files}: no sweeps; expected numbered files such as 000120.bin "
        f"({', '.join(SUFFIXES)}) in the folder or below it"
    )


def _is_numbered(path: Path) -> bool:
    """Return True if the name of a file has a number or a time."""
    named_file = NamedFile.of(path)
    return named_file.number is not None or named_file.stamp_ns is not None


def _find_images(folder: Path, name: str, config: CameraFiles) -> Series:
    """Return the images of a camera in the order of time. Raise InputError without any."""
    below = files_below(folder / config.files, _IMAGE_SUFFIXES, 0)
    if not below:
        key = f"cameras: {{{name}: {{files: {config.files}}}}}"
        raise InputError(f"{folder / config.files}: no images, though densify.yaml names it: {key}")
    (paths,) = below.values()
    return order_files(folder, paths, config.stamps, config.stamps_unit, shared=False)
