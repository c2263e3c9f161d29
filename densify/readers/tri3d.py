# SPDX-License-Identifier: MIT
"""ONCE (https://once-for-auto-driving.github.io) and the Frames of the Zenseact Open Dataset (ZOD),
through the library tri3d (https://github.com/CEA-LIST/tri3d, 0.2)::

    tri3d:/data/once#Once/000076        ROOT/data/000076/ or ROOT/SPLIT/data/000076/,
                                        each with 000076.json, lidar_roof/*.bin, cam01/*.jpg
    tri3d:/data/zod#ZODFrames/000001    ROOT/trainval-frames-*.json, ROOT/single_frames/000001/

The library reads JSON, plain arrays (``np.load`` without pickles) and the headers of images, and
runs nothing in the data. Limits of the library and the data:

- No point times, so nothing is deskewed: ``offset_ns`` is None. ZOD's sweeps are compensated to
  their stamps (https://github.com/zenseact/zod/issues/59) and have no intensities here; ONCE does
  not say.
- Stamps are float seconds, made of ONCE's milliseconds and ZOD's microseconds, to which they are
  rounded. ONCE has two sweeps a second.
- Points, calibration and poses are in the scanner's frame, turned by the library to x forward, y
  left. ONCE has a pose per sweep, ZOD a track of the vehicle, which is interpolated here (the
  library turns the long way round where a quaternion changes its sign).
- ONCE's images have the stamps of the sweeps and an OpenCV pinhole. ZOD's front camera is a
  fisheye, with one image in the middle of each recording.
- A whole split is opened at once. ONCE's sequences must all have labels: the library fails on the
  raw sequences and on the test split.
- A damaged rotation is not noticed: the library makes a proper one of any matrix or quaternion.

Frames, and each camera's images, are numbered from 0 in the library's order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os.path import isfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_json
from densify.geometry.types import Camera, Float, Int
from densify.readers.extras import needed
from densify.readers.file_sequence import FileSequence, Returns, chosen_scene, pinhole, rigid
from densify.readers.recorded_poses import PoseTrack

_MODELS = {"pinhole": "pinhole", "kannala": "fisheye"}
_ANONYMIZED = ("dnat", "blur", "original")


class _Class(NamedTuple):
    """A class of the library. tick_ns: unit of its stamps. compensation: of its sweeps, in
    words."""

    lidar: str
    tick_ns: int
    compensation: str


_CLASSES = {
    "Once": _Class("lidar_roof", 1_000_000, "not known (ONCE does not say)"),
    "ZODFrames": _Class("velodyne", 1_000, "to the stamps; cannot be undone without point times"),
}


def open_recording(path: Path, scene: str | None) -> Tri3d:
    """See `densify.readers.ReaderModule`. scene: CLASS/SEQUENCE."""
    found = {f"Once/{name}": options for name, options in _find_once(path).items()}
    found |= {f"ZODFrames/{name}": options for name, options in _find_zod(path).items()}
    if not found:
        raise InputError(
            f"{path}: nothing that tri3d is asked for; expected ONCE (data/000076/000076.json, "
            f"also in a split's folder) or ZOD Frames (trainval-frames-*.json)"
        )
    chosen = chosen_scene("tri3d", path, scene, tuple(found))
    return Tri3d(path, chosen, found[chosen])


class Tri3d(FileSequence):
    """A sequence of tri3d as a `LidarSequence`."""

    def __init__(self, path: Path, scene: str, options: Mapping[str, Any]) -> None:
        """path: the data set's. scene: CLASS/SEQUENCE. options: of the library's class.

        Raises InputError if the library is not installed or cannot read the split."""
        kind, _, name = scene.partition("/")
        library = needed("tri3d", "tri3d", "ONCE and ZOD (from Python 3.11 on)")
        self._class, self._place = _CLASSES[kind], f"{path}#{scene}"
        self._as_matrix = library.geometry.as_matrix
        with self._asked("the JSON files of its split (ONCE's sequences all need labels)"):
            self._data = getattr(library.datasets, kind)(**options)
            names = self._data.scenes if kind == "Once" else [s["id"] for s in self._data.metadata]
            self._number = list(names).index(name)
            self._stamp_ns = self._stamps_ns(self._class.lidar)
            self._ego_ns = self._stamps_ns("ego")
            self._T_world_ego = self._data.poses(self._number, "ego")
            self._T_ego_lidar = self._calibrated(self._class.lidar, "ego")
        if not len(self._stamp_ns) or np.any(np.diff(self._stamp_ns) <= 0):
            raise InputError(
                f"{self._place}: got {len(self._stamp_ns)} sweeps, expected some with stamps that "
                f"ascend"
            )
        cameras, exposed_ns = {}, {}
        for sensor in self._data.cam_sensors:
            with self._asked(f"images of {sensor}"):
                sizes_px, exposed = self._find_images(sensor)
            if exposed:
                cameras[sensor] = self._camera(sensor, sizes_px)
                exposed_ns[sensor] = exposed
        super().__init__(name, path, range(len(self._stamp_ns)), cameras, exposed_ns)

    def findings(self) -> Sequence[tuple[str, str]]:
        """See `LidarSequence`."""
        return [("compensated", self._class.compensation)]

    def stamp_ns(self, frame: int) -> int:
        """Return the data set's own stamp."""
        self.check_frame(frame)
        return int(self._stamp_ns[frame])

    def _returns(self, frame: int) -> tuple[Path, Returns]:
        with self._asked(f"sweep {frame}"):
            columns = np.asarray(self._data.points(self._number, frame, self._class.lidar))
            points = columns[:, :3].astype(np.float64)
            intensity = np.zeros(len(points)) if columns.shape[1] < 4 else columns[:, 3]
        brightness = np.clip(np.nan_to_num(intensity), 0, 1).astype(np.float32)
        return self.where, Returns(points, brightness)

    def _encoded_image(self, camera: str, number: int) -> tuple[Path, bytes]:
        with (
            self._asked(f"image {number} of {camera}"),
            self._data.image(self._number, number, camera) as image,
        ):
            path = Path(image.filename)
        return path, read_bytes(path)

    def _pose(self, frame: int) -> Float:
        at_ns = int(self._stamp_ns[frame])
        i = int(np.searchsorted(self._ego_ns, at_ns, "right")) - 1
        if i >= 0 and self._ego_ns[i] == at_ns:
            return self._ego_pose(i) @ self._T_ego_lidar
        i = int(np.clip(i, 0, max(len(self._ego_ns) - 2, 0)))
        T = np.stack([self._ego_pose(n) for n in range(i, min(i + 2, len(self._ego_ns)))])
        return PoseTrack(self._place, self._ego_ns[i : i + 2], T).at(at_ns) @ self._T_ego_lidar

    def _ego_pose(self, number: int) -> Float:
        with self._asked("poses"):
            T = self._as_matrix(self._T_world_ego[number])
        return rigid(T, f"{self._place}: pose {number}")

    def _calibrated(self, source: str, target: str) -> Float:
        """Return (4,4) T_target_source. The library's public alignment would add the vehicle's
        motion."""
        T = self._as_matrix(self._data._calibration(self._number, source, target))
        return rigid(T, f"{self._place}: calibration of {source} and {target}")

    def _stamps_ns(self, sensor: str) -> Int:
        seconds = np.asarray(self._data.timestamps(self._number, sensor), np.float64)
        ticks = np.rint(seconds * (1e9 / self._class.tick_ns))
        return ticks.astype(np.int64) * self._class.tick_ns

    def _find_images(self, sensor: str) -> tuple[list[tuple[int, int]], dict[int, int]]:
        """Return sizes and exposure times of the camera's images that are there."""
        sizes_px, exposed_ns = [], {}
        for number, stamp_ns in enumerate(self._stamps_ns(sensor).tolist()):
            try:
                with self._data.image(self._number, number, sensor) as image:
                    sizes_px.append(image.size)
            except FileNotFoundError:
                continue
            except OSError:
                pass  # damaged, which is said when it is asked for
            exposed_ns[number] = stamp_ns
        return sizes_px, exposed_ns

    def _camera(self, sensor: str, sizes_px: Sequence[tuple[int, int]]) -> Camera:
        with self._asked(f"calibration of {sensor}"):
            image = self._data.img_sensors[self._data.cam_sensors.index(sensor)]
            lens = self._data._calibration(self._number, sensor, image).operations[-1]
            values = np.asarray(lens.intrinsics, np.float64)
            T_cam_lidar = self._calibrated(self._class.lidar, sensor)
        if not sizes_px:
            raise InputError(f"{self._place}: none of the images of {sensor} is a whole one")
        return pinhole(
            sensor,
            sizes_px[0],
            values[:4].tolist(),
            T_cam_lidar,
            f"{self._place}: calibration of {sensor}",
            distortion=tuple(values[4:].tolist()) if values[4:].any() else (),
            model=_MODELS[lens.model],
        )

    @contextmanager
    def _asked(self, what: str) -> Iterator[None]:
        """Turn whatever the library raises for a damaged file into an InputError."""
        try:
            with np.errstate(all="ignore"):
                yield
        except InputError:
            raise
        except Exception as error:
            said = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(
                f"{self._place}: {what}: tri3d cannot read it ({said}); fetch it again"
            ) from error


def _find_once(path: Path) -> dict[str, dict[str, Any]]:
    """Return the options that open each sequence's split, by the sequence's name."""
    files = (*path.glob("data/*/*.json"), *path.glob("*/data/*/*.json"))
    return {
        file.stem: {"root": file.parents[2], "subset": "."}
        for file in sorted(files)
        if file.stem == file.parent.name
    }


def _find_zod(path: Path) -> dict[str, dict[str, Any]]:
    """Return the same of ZOD, from the shortest list of frames that is there."""
    lists = sorted(path.glob("trainval-frames-*.json"), key=lambda file: file.stat().st_size)
    if not lists:
        return {}
    splits = read_json(lists[0])
    try:
        return {
            str(sequence["id"]): {
                "root": path,
                "metadata": lists[0].name,
                "split": split,
                "anon_method": _anonymized(path, sequence["camera_frames"]),
            }
            for split, sequences in splits.items()
            for sequence in sequences
        }
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise InputError(
            f"{lists[0]}: no {error}; expected ZOD's list of frames: splits with the id and the "
            f"camera_frames of each; fetch it again"
        ) from None


def _anonymized(path: Path, images: Mapping[str, Any]) -> str:
    """Return how the front camera's images that are there were made anonymous."""
    for method in _ANONYMIZED:
        listed = images.get(f"front_{method}")
        if listed and isfile(path / listed[0]["filepath"]):
            return method
    return next((m for m in _ANONYMIZED if f"front_{m}" in images), _ANONYMIZED[0])
