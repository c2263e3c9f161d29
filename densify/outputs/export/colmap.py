# SPDX-License-Identifier: MIT
"""Images with cameras and points for structure-from-motion and splatting tools, as a COLMAP model
in text (https://colmap.github.io/format.html).

The world is the key frame. The centre of the upper left pixel is (0.5, 0.5), lenses are OpenCV's,
and poses are world to camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import Camera, CameraView, Float
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.cloud_files import save_ply
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.map_outputs import map_path
from densify.outputs.plain import write_json
from densify.outputs.table_outputs import tracks_table

_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")


class Picture(NamedTuple):
    """name: of the map. file: of its image, in the folder of images. view: camera and pose."""

    name: str
    file: str
    view: CameraView


def write_pictures(run: FinishedRun, folder: Path) -> list[Picture]:
    """Write the images of the run's maps as ``images/CAMERA.jpg``. Raises InputError if there is
    none."""
    pictures = []
    for name in run.cameras:
        if (data := run.jpeg(name)) is not None:
            map_path(folder, "images", name, ".jpg").write_bytes(data)
            pictures.append(Picture(name, f"{name}.jpg", run.views[name]))
    if not pictures:
        raise InputError(
            f"{run.folder}: no images in scene/image of {', '.join(run.cameras)}; densify the key "
            f"with a camera that has images"
        )
    return pictures


def intrinsics(camera: Camera) -> dict[str, float]:
    """Return fx, fy, cx, cy in pixels and the lens: k1 k2 p1 p2 and as many of k3 k4 k5 k6 as it
    has, or k1 to k4 of a fisheye.

    Raises InputError for a lens that OpenCV's eight coefficients cannot describe.
    """
    names = _FISHEYE_LENS if camera.model == "fisheye" else _LENS
    lens, K = list(camera.distortion), camera.K
    if camera.model == "mei" or any(lens[len(names) :]) or K[0, 1]:
        raise InputError(
            f"{camera.name}: its lens ({camera.model}, {len(lens)} coefficients) has no equal "
            f"there; leave it out by naming the others with --camera"
        )
    number = max(4, len(lens)) if any(lens) or camera.model == "fisheye" else 0
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    padded = dict(zip(names[:number], lens + [0.0] * len(names), strict=False))
    return {name: float(value) for name, value in (pinhole | padded).items()}


def write_colmap(run: FinishedRun, folder: Path) -> None:
    """Write ``images/`` and ``sparse/0/`` with cameras.txt, images.txt and points3D.txt, the points
    that a camera observed. Raises InputError for lenses that COLMAP has no model of."""
    sparse = _write_cameras(write_pictures(run, folder), folder)
    _write_points(sparse / "points3D.txt", observed(run.cloud()))


def write_splats(run: FinishedRun, folder: Path) -> None:
    """Write what 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023) starts from: a COLMAP model
    of the static world, also as points3D.ply, and each moving object in its own frame.

    ``movers/0003.ply`` has all points of object 3, ``movers/others.ply`` moving points without a
    track, in the key frame. ``tracks.json`` is the run's movers.json. Points have x y z, normals
    of 0 and a colour, as the method's own code reads them.
    """
    sparse = _write_cameras(write_pictures(run, folder), folder)
    whole = run.cloud()
    static = observed(whole.select(~whole.moving))
    _write_points(sparse / "points3D.txt", static)
    _save_splats(sparse / "points3D.ply", static.points, static.rgb)
    moving = [whole.select(whole.moving), *run.mover_clouds()]
    points, rgb, instance = (
        np.concatenate([getattr(cloud, name) for cloud in moving])
        for name in ("points", "rgb", "instance")
    )
    (folder / "movers").mkdir()
    tracked = np.zeros(len(points), bool)
    for track in run.tracks:
        own = instance == track.instance
        tracked |= own
        if own.any():
            T_object_key = poses.inverse(track.T_key_object[track.frames.index(run.key)])
            in_object = poses.transform(T_object_key, points[own])
            _save_splats(folder / "movers" / f"{track.instance:04d}.ply", in_object, rgb[own])
    if not tracked.all():
        _save_splats(folder / "movers" / "others.ply", points[~tracked], rgb[~tracked])
    write_json(folder / "tracks.json", tracks_table(run.key, run.tracks))


def observed(cloud: StoredCloud) -> StoredCloud:
    """Return the points that a camera observed. Others have no colour."""
    return cloud.select(np.any(cloud.rgb > 0, axis=1))


def _write_cameras(pictures: Sequence[Picture], folder: Path) -> Path:
    """Write cameras.txt and images.txt, and return their folder."""
    cameras, images, number_of = [], [], dict[str, int]()
    for number, picture in enumerate(pictures, 1):
        camera, T_cam_world = picture.view.camera, picture.view.T_cam_key
        if camera.name not in number_of:
            number_of[camera.name] = len(number_of) + 1
            model, params = _model(camera)
            size = f"{camera.width_px} {camera.height_px}"
            cameras.append(f"{number_of[camera.name]} {model} {size} {_text(params)}\n")
        x, y, z, w = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(canonical=True)
        pose = _text([w, x, y, z, *T_cam_world[:3, 3]])
        images.append(f"{number} {pose} {number_of[camera.name]} {picture.file}\n\n")
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text("".join(cameras))
    (sparse / "images.txt").write_text("".join(images))
    return sparse


def _model(camera: Camera) -> tuple[str, list[float]]:
    params = list(intrinsics(camera).values())
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    if len(params) in (4, 8):
        return "PINHOLE" if len(params) == 4 else "OPENCV", params
    return "FULL_OPENCV", params + [0.0] * (12 - len(params))


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _write_points(path: Path, cloud: StoredCloud) -> None:
    """Each: number, position, colour, reprojection error 0, no observations."""
    rows = np.column_stack([np.arange(1, len(cloud.points) + 1), cloud.points, cloud.rgb])
    np.savetxt(path, rows, fmt="%d %.3f %.3f %.3f %d %d %d 0")


def _save_splats(path: Path, points: Float, rgb: NDArray[np.uint8]) -> None:
    columns: dict[str, NDArray[Any]] = {
        axis: points[:, i].astype(np.float32) for i, axis in enumerate("xyz")
    }
    columns |= {name: np.zeros(len(points), np.float32) for name in ("nx", "ny", "nz")}
    save_ply(path, columns | {n: rgb[:, i] for i, n in enumerate(("red", "green", "blue"))})
