# SPDX-License-Identifier: MIT
"""Write images with cameras, depth and points, for COLMAP, Gaussian splatting and nerfstudio.

The world is the lidar frame of the first key sweep. The centre of the upper left pixel is (0.5,
0.5). COLMAP's poses are world to camera, see https://colmap.github.io/format.html.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry import poses
from densify.geometry.types import Camera, Float
from densify.outputs.atomic import write_file, write_json
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.depth_png import encode_png, map_path, metres
from densify.outputs.export.finished_run import FinishedRun, key_poses
from densify.outputs.export.maps_and_clouds import save_ply
from densify.readers.decoded_files import decode_image

_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")
_INVERSE_STEPS = 65536  # the training of Gaussian splatting divides by this number
# nerfstudio's poses are camera to world. In OpenGL's axes y is up and the camera looks along -z.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Picture(NamedTuple):
    """An image of a finished run, with its camera and pose."""

    name: str  # name of the image's files
    run: FinishedRun  # the finished run
    map: str  # name of the depth map in the run that shows this image
    camera: Camera  # the camera
    T_cam_world: Float  # (4,4) pose from the world, the first key sweep's lidar frame
    jpeg: bytes  # bytes of the image file


def write_colmap(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``images/`` and COLMAP's model ``sparse/0/`` of the points that a camera observed."""
    pictures = write_images(runs, folder)
    _write_model(pictures, _observed(_world_cloud(runs)), folder)


def write_splats(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write the input of 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023).

    The static world is a COLMAP model, also as points3D.ply. Depth maps are for ``-d depths``:
    inverse depth is ``value / 65536 * scale + offset``, by ``sparse/0/depth_params.json``. The
    training takes an empty pixel as infinitely far. Images are therefore transparent, and not
    trained, where no depth is measured, filled or from a prior.

    ``movers/0003.ply`` has the points of object 3 in its own frame, ``movers/others.ply`` moving
    points without a track in the key sweep's lidar frame. ``tracks.json`` is the run's movers.json.
    With several runs, each has its folder ``movers/000120/``.
    """
    pictures = pictures_of(runs, flat=True)
    static = _world_cloud(runs)
    static = _observed(static.select(~static.moving))
    _write_depths(pictures, folder)
    _write_model(pictures, static, folder, ".png")
    _save_splats(folder / "sparse" / "0" / "points3D.ply", static.points, static.rgb)
    for run in runs:
        several = len(runs) > 1
        movers = folder / "movers" / f"{run.key:06d}" if several else folder / "movers"
        _write_movers(run, movers)
        tracks = (movers if several else folder) / "tracks.json"
        write_file(tracks, read_bytes(run.folder / "movers.json"))


def _write_depths(pictures: Sequence[Picture], folder: Path) -> None:
    """Write inverse depth of each picture, its scale, and the image transparent without depth."""
    depths_m = {picture.name: picture.run.full_m(picture.map) for picture in pictures}
    nearest_m = min(float(d[d > 0].min(initial=np.inf)) for d in depths_m.values())
    scale = 1 / nearest_m if np.isfinite(nearest_m) else 1.0
    for picture in pictures:
        depth_m = depths_m[picture.name]
        inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        steps = np.minimum(np.rint(inverse * (_INVERSE_STEPS / scale)), _INVERSE_STEPS - 1)
        write_file(folder / "depths" / f"{picture.name}.png", encode_png(steps.astype(np.uint16)))
        image = decode_image(picture.jpeg, picture.name)
        clear = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
        clear[depth_m == 0] = 0
        write_file(folder / "images" / f"{picture.name}.png", encode_png(clear))
    params = {picture.name: {"scale": scale, "offset": 0.0} for picture in pictures}
    write_json(folder / "sparse" / "0" / "depth_params.json", params)


def _write_movers(run: FinishedRun, folder: Path) -> None:
    whole = run.cloud()
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
            _save_splats(folder / f"{track.instance:04d}.ply", in_object, rgb[own])
    if not tracked.all():
        _save_splats(folder / "others.ply", points[~tracked], rgb[~tracked])


def write_nerfstudio(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write transforms.json, images, depth and cloud for ``ns-train depth-nerfacto --data DIR``.

    ``depth/CAMERA.npy`` has measured depth in float32 millimetres, 0 for no depth.
    """
    pictures = write_images(runs, folder)
    fisheyes = {picture.camera.model == "fisheye" for picture in pictures}
    if len(fisheyes) > 1:
        raise InputError(
            "--to nerfstudio: it has one camera model for all images, and there are fisheyes and "
            "others; choose among them with --camera"
        )
    for picture in pictures:
        picture.run.full_m(picture.map)
        path = map_path(folder, "depth", picture.name, ".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, metres(picture.run.maps(picture.map)["depth"]) * np.float32(1000))
    columns = _observed(_world_cloud(runs)).columns()
    vertex = ("x", "y", "z", "red", "green", "blue")
    save_ply(folder / "cloud.ply", {name: columns[name] for name in vertex})
    transforms = {
        "camera_model": "OPENCV_FISHEYE" if fisheyes.pop() else "OPENCV",
        "ply_file_path": "cloud.ply",
        "frames": [_frame(picture) for picture in pictures],
    }
    write_json(folder / "transforms.json", transforms)


def _frame(picture: Picture) -> dict[str, Any]:
    camera, lens = picture.camera, intrinsics(picture.camera)
    K = {"fl_x": lens.pop("fx"), "fl_y": lens.pop("fy"), "cx": lens.pop("cx"), "cy": lens.pop("cy")}
    known = _FISHEYE_LENS if camera.model == "fisheye" else _LENS[:5]
    if unknown := [n for n, value in lens.items() if value and n not in known]:
        raise InputError(
            f"{picture.name}: nerfstudio has no lens with {', '.join(unknown)}; leave it out by "
            f"naming the others with --camera"
        )
    return {
        "file_path": f"images/{picture.name}.jpg",
        "depth_file_path": f"depth/{picture.name}.npy",
        **K,
        "w": camera.width_px,
        "h": camera.height_px,
        **{n: lens.get(n, 0.0) for n in known},
        "transform_matrix": poses.inverse(picture.T_cam_world) @ _OPENGL,
    }


def pictures_of(runs: Sequence[FinishedRun], flat: bool = False) -> list[Picture]:
    """Return the images of the runs with poses in the lidar frame of the first key sweep."""
    pictures = []
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        for name in run.cameras:
            if (data := run.jpeg(name)) is not None:
                view, file = run.views[name], name
                if len(runs) > 1:
                    file = f"{run.key:06d}/{name}"
                T_cam_world = view.T_cam_key @ poses.inverse(T_world_key)
                # The reader of Gaussian splatting drops folders from file names.
                file = file.replace("/", "_") if flat else file
                pictures.append(Picture(file, run, name, view.camera, T_cam_world, data))
    if not pictures:
        raise InputError(
            f"{runs[0].folder}: no images in scene/image of {', '.join(runs[0].cameras)}; densify "
            f"the key with a camera that has images"
        )
    return pictures


def write_images(runs: Sequence[FinishedRun], folder: Path, flat: bool = False) -> list[Picture]:
    """Write the images as ``images/NAME.jpg`` and return them. Arguments as in `pictures_of`."""
    pictures = pictures_of(runs, flat)
    for picture in pictures:
        write_file(map_path(folder, "images", picture.name, ".jpg"), picture.jpeg)
    return pictures


def _world_cloud(runs: Sequence[FinishedRun]) -> StoredCloud:
    """Return the whole cloud of one run, or the key sweeps' points of several runs in one world."""
    if len(runs) == 1:
        return runs[0].cloud()
    parts = []
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        cloud = run.cloud()
        own = cloud.select(cloud.frame == run.key)
        parts.append(replace(own, points=poses.transform(T_world_key, own.points)))
    return StoredCloud.joined(parts)


def intrinsics(camera: Camera) -> dict[str, float]:
    """Return fx, fy, cx, cy in pixels and the lens coefficients, if any, by OpenCV's names."""
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
    """Return the points that a camera observed. All other points have no colour."""
    return cloud.select(np.any(cloud.rgb, axis=1))


def _write_model(
    pictures: Sequence[Picture], cloud: StoredCloud, folder: Path, suffix: str = ".jpg"
) -> None:
    """Write COLMAP's text model of the pictures and points. No image refers to a point."""
    cameras, images, number_of = "", "", dict[str, int]()
    for number, picture in enumerate(pictures, 1):
        camera, T_cam_world = picture.camera, picture.T_cam_world
        if camera.name not in number_of:
            number_of[camera.name] = len(number_of) + 1
            model, params = _model(camera)
            size = f"{camera.width_px} {camera.height_px}"
            cameras += f"{number_of[camera.name]} {model} {size} {_text(params)}\n"
        x, y, z, w = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(canonical=True)
        pose = _text([w, x, y, z, *T_cam_world[:3, 3]])
        images += f"{number} {pose} {number_of[camera.name]} {picture.name}{suffix}\n\n"
    sparse = folder / "sparse" / "0"
    write_file(sparse / "cameras.txt", cameras.encode())
    write_file(sparse / "images.txt", images.encode())
    # A row has the point's number, position, colour and reprojection error.
    rows = np.column_stack([np.arange(1, len(cloud.points) + 1), cloud.points, cloud.rgb])
    np.savetxt(sparse / "points3D.txt", rows, fmt="%d %.3f %.3f %.3f %d %d %d 0")


def _model(camera: Camera) -> tuple[str, list[float]]:
    params = list(intrinsics(camera).values())
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    if len(params) in (4, 8):
        return "PINHOLE" if len(params) == 4 else "OPENCV", params
    return "FULL_OPENCV", params + [0.0] * (12 - len(params))


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _save_splats(path: Path, points: Float, rgb: NDArray[np.uint8]) -> None:
    """Write points with normals of 0, as the code of Gaussian splatting reads them."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    columns |= {name: np.zeros(len(points), np.float32) for name in ("nx", "ny", "nz")}
    save_ply(path, columns | dict(zip(("red", "green", "blue"), rgb.T, strict=True)))
