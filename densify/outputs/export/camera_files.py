# SPDX-License-Identifier: MIT
"""Write images with cameras and points, for COLMAP, Gaussian splatting and nerfstudio.

COLMAP's text model: https://colmap.github.io/format.html. nerfstudio's folder: ``ns-train
depth-nerfacto --data DIR``.

The world is the key frame. The centre of the upper left pixel is (0.5, 0.5). Lenses are OpenCV's.
COLMAP's poses are world to camera. nerfstudio's are camera to world with OpenGL's axes: x right, y
up, the camera looks along -z. Its depth is in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry import poses
from densify.geometry.types import Camera, CameraView, Float
from densify.outputs.atomic import write_file, write_json
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.depth_png import map_path, metres
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.maps_and_clouds import save_ply

_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_colmap(run: FinishedRun, folder: Path) -> None:
    """Write ``images/`` and ``sparse/0/`` with cameras.txt, images.txt and points3D.txt.

    The points are those that a camera observed.

    Raises:
        InputError: COLMAP has no model of the lens.
    """
    _write_model(run, _observed(run.cloud()), folder)


def write_splats(run: FinishedRun, folder: Path) -> None:
    """Write the input of 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023).

    It is a COLMAP model of the static world, also as points3D.ply, and each moving object in its
    own frame. ``movers/0003.ply`` has all points of object 3, ``movers/others.ply`` moving points
    without a track, in the key frame. ``tracks.json`` is the movers.json of the run.
    """
    whole = run.cloud()
    static = _observed(whole.select(~whole.moving))
    _write_model(run, static, folder)
    _save_splats(folder / "sparse" / "0" / "points3D.ply", static.points, static.rgb)
    moving = [whole.select(whole.moving), *run.mover_clouds()]
    points, rgb, instance = (
        np.concatenate([getattr(cloud, name) for cloud in moving])
        for name in ("points", "rgb", "instance")
    )
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
    write_file(folder / "tracks.json", read_bytes(run.folder / "movers.json"))


def write_nerfstudio(run: FinishedRun, folder: Path) -> None:
    """Write ``transforms.json``, ``images/``, ``depth/CAMERA.npy`` and ``cloud.ply``.

    Depth is the measured one, float32 millimetres, 0 none. The cloud has the points that a camera
    observed.

    Raises:
        InputError: The maps hold ranges, a lens is not OpenCV's with k1 k2 k3 p1 p2, or
            fisheyes are together with other cameras.
    """
    views = _write_images(run, folder)
    fisheyes = {view.camera.model == "fisheye" for view in views.values()}
    if len(fisheyes) > 1:
        raise InputError(
            "--to nerfstudio: it has one camera model for all images, and there are fisheyes and "
            "others; choose among them with --camera"
        )
    for name in views:
        path = map_path(folder, "depth", name, ".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, metres(run.maps(name)["depth"]) * np.float32(1000))
    columns = _observed(run.cloud()).columns()
    vertex = ("x", "y", "z", "red", "green", "blue")
    save_ply(folder / "cloud.ply", {name: columns[name] for name in vertex})
    transforms = {
        "camera_model": "OPENCV_FISHEYE" if fisheyes.pop() else "OPENCV",
        "ply_file_path": "cloud.ply",
        "frames": [_frame(run, name, view) for name, view in views.items()],
    }
    write_json(folder / "transforms.json", transforms)


def _frame(run: FinishedRun, name: str, view: CameraView) -> dict[str, Any]:
    if run.measure(name) != "z":
        raise InputError(
            f"{name}: its depth is the range from the lens, and nerfstudio takes camera z; densify "
            f"it with --set project.depth=z, or leave it out by naming the others with --camera"
        )
    camera, lens = view.camera, _intrinsics(view.camera)
    K = {"fl_x": lens.pop("fx"), "fl_y": lens.pop("fy"), "cx": lens.pop("cx"), "cy": lens.pop("cy")}
    known = _FISHEYE_LENS if camera.model == "fisheye" else _LENS[:5]
    if unknown := [n for n, value in lens.items() if value and n not in known]:
        raise InputError(
            f"{name}: nerfstudio has no lens with {', '.join(unknown)}; leave it out by naming the "
            f"others with --camera"
        )
    return {
        "file_path": f"images/{name}.jpg",
        "depth_file_path": f"depth/{name}.npy",
        **K,
        "w": camera.width_px,
        "h": camera.height_px,
        **{n: lens.get(n, 0.0) for n in known},
        "transform_matrix": poses.inverse(view.T_cam_key) @ _OPENGL,
    }


def _write_images(run: FinishedRun, folder: Path) -> Mapping[str, CameraView]:
    """Write the images of the run's maps as ``images/CAMERA.jpg``; return their cameras and poses.

    Raises InputError if there is none.
    """
    views = {}
    for name in run.cameras:
        if (data := run.jpeg(name)) is not None:
            write_file(map_path(folder, "images", name, ".jpg"), data)
            views[name] = run.views[name]
    if not views:
        raise InputError(
            f"{run.folder}: no images in scene/image of {', '.join(run.cameras)}; densify the key "
            f"with a camera that has images"
        )
    return views


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return fx, fy, cx, cy in pixels and the coefficients of the lens.

    They are k1 k2 p1 p2 and the existing ones of k3 k4 k5 k6, or k1 to k4 of a fisheye. Raises
    InputError for a lens that OpenCV's eight coefficients cannot describe.
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


def _observed(cloud: StoredCloud) -> StoredCloud:
    """Return the points that a camera observed. Others have no colour."""
    return cloud.select(np.any(cloud.rgb, axis=1))


def _write_model(run: FinishedRun, cloud: StoredCloud, folder: Path) -> None:
    """Write the images and COLMAP's text model with these points, which no image refers to."""
    cameras, images, number_of = "", "", dict[str, int]()
    for number, (name, view) in enumerate(_write_images(run, folder).items(), 1):
        camera, T_cam_world = view.camera, view.T_cam_key
        if camera.name not in number_of:
            number_of[camera.name] = len(number_of) + 1
            model, params = _model(camera)
            size = f"{camera.width_px} {camera.height_px}"
            cameras += f"{number_of[camera.name]} {model} {size} {_text(params)}\n"
        x, y, z, w = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(canonical=True)
        pose = _text([w, x, y, z, *T_cam_world[:3, 3]])
        images += f"{number} {pose} {number_of[camera.name]} {name}.jpg\n\n"
    sparse = folder / "sparse" / "0"
    write_file(sparse / "cameras.txt", cameras.encode())
    write_file(sparse / "images.txt", images.encode())
    # Each: number, position, colour, reprojection error
    rows = np.column_stack([np.arange(1, len(cloud.points) + 1), cloud.points, cloud.rgb])
    np.savetxt(sparse / "points3D.txt", rows, fmt="%d %.3f %.3f %.3f %d %d %d 0")


def _model(camera: Camera) -> tuple[str, list[float]]:
    params = list(_intrinsics(camera).values())
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    if len(params) in (4, 8):
        return "PINHOLE" if len(params) == 4 else "OPENCV", params
    return "FULL_OPENCV", params + [0.0] * (12 - len(params))


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _save_splats(path: Path, points: Float, rgb: NDArray[np.uint8]) -> None:
    """Write points with normals of 0, as the method's own code reads them."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    columns |= {name: np.zeros(len(points), np.float32) for name in ("nx", "ny", "nz")}
    save_ply(path, columns | dict(zip(("red", "green", "blue"), rgb.T, strict=True)))
