# SPDX-License-Identifier: MIT
"""A COLMAP model (https://colmap.github.io/format.html): cameras, images and points3D, binary and
as text. The world is the key frame; poses are world to camera.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.arrays import table
from densify.geometry.types import Camera, Float
from densify.outputs.atomic import write_file
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.pictures import Picture, intrinsics, seen, write_pictures

_MODELS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}


def write_export(run: FinishedRun, folder: Path) -> None:
    """``images/``, ``sparse/0/`` with cameras.bin, images.bin, points3D.bin (what a camera saw,
    without tracks), and the same as ``text/*.txt``.

    Raises InputError for lenses that COLMAP has no model of.
    """
    binary, text = folder / "sparse" / "0", folder / "text"
    for place in (binary, text):
        place.mkdir(parents=True)
    pictures, points = write_pictures(run, folder / "images"), seen(run.cloud())
    cameras, images = write_cameras(binary, pictures)
    write_file(binary / "points3D.bin", packed_points(points))
    write_file(text / "cameras.txt", "".join(c.line() for c in cameras).encode())
    write_file(text / "images.txt", "".join(i.lines() for i in images).encode())
    write_file(text / "points3D.txt", _point_lines(points))


def write_cameras(
    folder: Path, pictures: Sequence[Picture]
) -> tuple[list[ModelCamera], list[ModelImage]]:
    """Write cameras.bin and images.bin, and return what is in them."""
    cameras = _cameras(pictures)
    number = {camera.camera.name: camera.number for camera in cameras}
    images = [ModelImage.of(i, p, number[p.view.camera.name]) for i, p in enumerate(pictures, 1)]
    write_file(folder / "cameras.bin", _count(cameras) + b"".join(c.packed() for c in cameras))
    write_file(folder / "images.bin", _count(images) + b"".join(i.packed() for i in images))
    return cameras, images


@dataclass(frozen=True)
class ModelCamera:
    """number: in the model. model, params: as COLMAP has them."""

    number: int
    camera: Camera
    model: str
    params: tuple[float, ...]

    def packed(self) -> bytes:
        size = (self.camera.width_px, self.camera.height_px)
        head = struct.pack("<iiQQ", self.number, _MODELS[self.model], *size)
        return head + struct.pack(f"<{len(self.params)}d", *self.params)

    def line(self) -> str:
        numbers = " ".join(map(repr, self.params))
        size = f"{self.camera.width_px} {self.camera.height_px}"
        return f"{self.number} {self.model} {size} {numbers}\n"


def _cameras(pictures: Sequence[Picture]) -> list[ModelCamera]:
    """Each once, in order, however many images are of it."""
    known = {p.view.camera.name: p.view.camera for p in pictures}
    cameras = []
    for number, camera in enumerate(known.values(), 1):
        params = list(intrinsics(camera).values())
        model = "OPENCV_FISHEYE"
        if camera.model == "pinhole":
            model = {4: "PINHOLE", 8: "OPENCV"}.get(len(params), "FULL_OPENCV")
        if model == "FULL_OPENCV":
            params += [0.0] * (12 - len(params))
        cameras.append(ModelCamera(number, camera, model, tuple(params)))
    return cameras


@dataclass(frozen=True)
class ModelImage:
    """number: in the model. camera: its number. quaternion: (4,) w x y z of the turn from world to
    camera. t_m: (3,)."""

    number: int
    camera: int
    file: str
    quaternion: Float
    t_m: Float

    @staticmethod
    def of(number: int, picture: Picture, camera: int) -> ModelImage:
        T_cam_world = picture.view.T_cam_key
        quaternion = np.roll(Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(), 1)
        quaternion *= 1 if quaternion[0] >= 0 else -1
        return ModelImage(number, camera, picture.file, quaternion, T_cam_world[:3, 3])

    def packed(self) -> bytes:
        pose = struct.pack("<i7di", self.number, *self.quaternion, *self.t_m, self.camera)
        return pose + self.file.encode() + b"\0" + struct.pack("<Q", 0)

    def lines(self) -> str:
        pose = " ".join(repr(float(v)) for v in (*self.quaternion, *self.t_m))
        return f"{self.number} {pose} {self.camera} {self.file}\n\n"


def _count(entries: Sequence[object]) -> bytes:
    return struct.pack("<Q", len(entries))


def packed_points(points: StoredCloud) -> bytes:
    """points3D.bin. Each: number, place, colour, reprojection error 0, length of its track 0."""
    num_points = len(points.points)
    columns = {"number": np.arange(1, num_points + 1, dtype="<u8")}
    columns |= {axis: points.points[:, i].astype("<f8") for i, axis in enumerate("xyz")}
    columns |= {f"c{i}": points.rgb[:, i] for i in range(3)}
    columns |= {"error": np.zeros(num_points, "<f8"), "track": np.zeros(num_points, "<u8")}
    return struct.pack("<Q", num_points) + table(columns).tobytes()


def _point_lines(points: StoredCloud) -> bytes:
    buffer = io.BytesIO()
    number = np.arange(1, len(points.points) + 1)
    rows = np.column_stack([number, points.points, points.rgb])
    np.savetxt(buffer, rows, fmt="%d %.3f %.3f %.3f %d %d %d 0")
    return buffer.getvalue()
