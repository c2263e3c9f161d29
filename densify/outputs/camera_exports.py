# SPDX-License-Identifier: MIT
"""Write images with cameras, depth and points for COLMAP, splatting and depth networks.

The world is the lidar frame of the first key sweep. In COLMAP's and nerfstudio's files the centre
of the upper left pixel is (0.5, 0.5). COLMAP's poses are world to camera, see
https://colmap.github.io/format.html; those of the other formats are camera to world.
"""

from __future__ import annotations

import io
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
from densify.geometry.arrays import joined_rows
from densify.geometry.types import Camera, Float, Float32
from densify.outputs.cloud_files import StoredCloud, save_ply
from densify.outputs.depth_png import encode_png, metres
from densify.outputs.finished_run import FinishedRun, key_poses, save_exr
from densify.outputs.folders import drive_folder, write_file, write_json
from densify.readers.decoded_files import decode_image

_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")
# COLMAP's model without fisheye -> number of its parameters: fx, fy, cx, cy and the lens
_COLMAP_MODELS = {"PINHOLE": 4, "OPENCV": 8, "FULL_OPENCV": 12}
_INVERSE_STEPS = 65536  # the training of Gaussian splatting divides by this number
_LOG_STEPS = 65533  # MoGe divides by this number
# In OpenGL's axes, which nerfstudio has, y is up and the camera looks along -z.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Picture(NamedTuple):
    """An image of a finished run, with its camera and pose."""

    name: str  # name of the image's files
    run: FinishedRun  # the finished run
    map: str  # name of the depth map in the run that shows this image
    camera: Camera  # the camera
    T_cam_world: Float  # (4,4) pose from the world, the first key sweep's lidar frame
    jpeg: bytes  # bytes of the image file

    def measured_m(self) -> Float32:
        """Return the measured depth (H,W) along the camera's axis in metres, 0 for no depth."""
        self.run.require_z(self.map)
        return metres(self.run.maps(self.map)["depth"])

    def rectified_m(self, to: str) -> Float32:
        """Return `measured_m`. Raise InputError, for format ``to``, if the image has distortion."""
        depth_m = self.measured_m()
        if not self.camera.is_rectified:
            raise InputError(
                f"{self.name}: --to {to} takes images without distortion; leave the camera out by "
                f"naming the others with --camera"
            )
        return depth_m


def write_colmap(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``images/`` and COLMAP's model ``sparse/0/`` of the points that a camera observed."""
    pictures = _pictures(runs)
    _write_jpegs(pictures, folder)
    _write_model(pictures, ".jpg", _world_cloud(runs), folder)


def write_splats(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write the input of 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023).

    - ``sparse/0``: the static world as a COLMAP model.
    - ``depths``: inverse depth is ``value / 65536 * scale + offset``, with the scale and offset of
      ``sparse/0/depth_params.json``. The trainer reads it with its option ``-d depths``.
    - ``images``: transparent where the depth is unknown. The trainer would take an empty pixel
      as infinitely far, and leaves transparent pixels out.
    - ``movers/0003.ply``: the points of object 3 in its own frame. ``movers/others.ply``: moving
      points without a track in the key sweep's lidar frame. With several runs, the folder is
      ``movers/000120``, by the key. ``tracks.json`` there is the run's ``movers.json``.
    """
    pictures = _pictures(runs, flat=True)
    cloud = _world_cloud(runs)
    static = cloud.select(~cloud.moving)
    _write_inverse_depths(pictures, folder)
    _write_model(pictures, ".png", static, folder)
    _save_splats(folder / "sparse" / "0" / "points3D.ply", static.points, static.rgb)
    for run in runs:
        movers = folder / "movers" / f"{run.key:06d}" if len(runs) > 1 else folder / "movers"
        _write_movers(run, movers)
        tracks = (movers if len(runs) > 1 else folder) / "tracks.json"
        write_file(tracks, read_bytes(run.folder / "movers.json"))


def write_nerfstudio(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write transforms.json, images, depth and cloud for ``ns-train depth-nerfacto --data DIR``.

    ``depth/CAMERA.npy`` has measured depth in float32 millimetres, 0 for no depth.
    """
    pictures = _pictures(runs)
    _write_jpegs(pictures, folder)
    fisheyes = {picture.camera.model == "fisheye" for picture in pictures}
    if len(fisheyes) > 1:
        raise InputError(
            "--to nerfstudio: it has one camera model for all images, and there are fisheyes and "
            "others; choose among them with --camera"
        )
    frames = []
    for picture in pictures:
        depth = f"depth/{picture.name}.npy"
        (folder / depth).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / depth, picture.measured_m() * np.float32(1000))
        frames.append(_nerfstudio_frame(picture, depth))
    columns = _world_cloud(runs).columns()
    vertex = ("x", "y", "z", "red", "green", "blue")
    save_ply(folder / "cloud.ply", {name: columns[name] for name in vertex})
    model = "OPENCV_FISHEYE" if fisheyes.pop() else "OPENCV"
    table = {"camera_model": model, "ply_file_path": "cloud.ply", "frames": frames}
    write_json(folder / "transforms.json", table)


def write_wai(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a scene in map-anything's format (data_processing/README.md), depth in m, 0: none."""
    pictures = _pictures(runs, flat=True)
    _write_jpegs(pictures, folder)
    frames = []
    for picture in pictures:
        depth_m, depth = picture.rectified_m("wai"), f"depth/{picture.name}.exr"
        save_exr(folder / depth, "Y", depth_m)
        files = {"image": f"images/{picture.name}.jpg", "depth": depth}
        frames.append({"frame_name": picture.name, **files, **_shared_fields(picture)})
    meta = {
        "scene_name": f"{drive_folder(runs[0].recording)}-{runs[0].key:06d}",
        "dataset_name": "densify",
        "version": "0.1",
        "shared_intrinsics": False,
        "camera_model": "PINHOLE",
        "camera_convention": "opencv",
        "frames": frames,
        "scene_modalities": {},
        "frame_modalities": {n: {"frame_key": n, "format": n} for n in ("image", "depth")},
    }
    write_json(folder / "scene_meta.json", meta)


def write_moge(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a training set in MoGe's format (docs/train.md), depth on a log scale, 0 for none."""
    names = []
    for run in runs:
        for picture in _pictures([run], flat=True):
            depth_m, camera = picture.rectified_m("moge"), picture.camera
            name = f"keys/{drive_folder(run.recording)}/{run.key:06d}_{picture.name}"
            names.append(name)
            K = camera.K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
            size = np.array([[camera.width_px], [camera.height_px], [1]])
            write_file(folder / name / "image.jpg", picture.jpeg)
            write_json(folder / name / "meta.json", {"intrinsics": K / size})
            write_file(folder / name / "depth.png", _logarithmic_png(depth_m))
    write_file(folder / ".index.txt", "".join(f"{name}\n" for name in names).encode())


def _pictures(runs: Sequence[FinishedRun], flat: bool = False) -> list[Picture]:
    """Return the images of the runs. ``flat`` names have no folders, which some readers drop."""
    pictures = []
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        for map_name in run.chosen_maps:
            if (jpeg := run.jpeg(map_name)) is not None:
                view = run.scene.views[map_name]
                name = f"{run.key:06d}/{map_name}" if len(runs) > 1 else map_name
                name = name.replace("/", "_") if flat else name
                T_cam_world = view.T_cam_key @ poses.inverse(T_world_key)
                pictures.append(Picture(name, run, map_name, view.camera, T_cam_world, jpeg))
    if not pictures:
        raise InputError(
            f"{runs[0].folder}: no images in scene/image of {', '.join(runs[0].chosen_maps)}; "
            f"densify the key with a camera that has images"
        )
    return pictures


def _write_jpegs(pictures: Sequence[Picture], folder: Path) -> None:
    for picture in pictures:
        write_file(folder / "images" / f"{picture.name}.jpg", picture.jpeg)


def _world_cloud(runs: Sequence[FinishedRun]) -> StoredCloud:
    """Return the points, world, that a camera observed, of several runs only their key sweeps'."""
    clouds = []
    for T_world_key, run in zip(key_poses(runs), runs, strict=True):
        cloud = run.cloud()
        if len(runs) > 1:
            cloud = cloud.select(cloud.frame == run.key)
            cloud = replace(cloud, points=poses.transform(T_world_key, cloud.points))
        clouds.append(cloud.select(cloud.observed))
    return joined_rows(clouds)


def _write_model(
    pictures: Sequence[Picture], suffix: str, cloud: StoredCloud, folder: Path
) -> None:
    """Write COLMAP's text model of the pictures and points. No image refers to a point."""
    cameras, images, camera_numbers = "", "", dict[str, int]()
    for number, picture in enumerate(pictures, 1):
        camera, T_cam_world = picture.camera, picture.T_cam_world
        if camera.name not in camera_numbers:
            camera_numbers[camera.name] = len(camera_numbers) + 1
            model, params = _colmap_model(camera)
            size = f"{camera.width_px} {camera.height_px}"
            cameras += f"{camera_numbers[camera.name]} {model} {size} {_text(params)}\n"
        x, y, z, w = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(canonical=True)
        pose = _text([w, x, y, z, *T_cam_world[:3, 3]])
        images += f"{number} {pose} {camera_numbers[camera.name]} {picture.name}{suffix}\n\n"
    sparse = folder / "sparse" / "0"
    write_file(sparse / "cameras.txt", cameras.encode())
    write_file(sparse / "images.txt", images.encode())
    # A row has the point's number, position, colour and reprojection error.
    rows = np.column_stack([np.arange(1, len(cloud.points) + 1), cloud.points, cloud.rgb])
    np.savetxt(sparse / "points3D.txt", rows, fmt="%d %.3f %.3f %.3f %d %d %d 0")


def _colmap_model(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's name of the camera model and its parameters."""
    params = list(_intrinsics(camera).values())
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", params
    model, size = next(item for item in _COLMAP_MODELS.items() if item[1] >= len(params))
    return model, params + [0.0] * (size - len(params))


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return fx, fy, cx, cy in pixels and the lens coefficients, if any, by OpenCV's names."""
    names = _FISHEYE_LENS if camera.model == "fisheye" else _LENS
    lens, K = list(camera.distortion), camera.K
    if camera.model == "mei" or any(lens[len(names) :]) or K[0, 1]:
        raise InputError(
            f"{camera.name}: its lens ({camera.model}, {len(lens)} coefficients) has no equal "
            f"there; leave it out by naming the others with --camera"
        )
    # OpenCV has no model with fewer than four coefficients.
    num_coefficients = max(4, len(lens)) if any(lens) or camera.model == "fisheye" else 0
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    padded = dict(zip(names[:num_coefficients], lens + [0.0] * len(names), strict=False))
    return {name: float(value) for name, value in (pinhole | padded).items()}


def _shared_fields(picture: Picture) -> dict[str, Any]:
    """Return the fields that nerfstudio and map-anything share, pose in OpenCV's axes."""
    fx, fy, cx, cy, *_ = _intrinsics(picture.camera).values()
    return {
        "file_path": f"images/{picture.name}.jpg",
        "transform_matrix": poses.inverse(picture.T_cam_world),
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **{"w": picture.camera.width_px, "h": picture.camera.height_px},
    }


def _nerfstudio_frame(picture: Picture, depth: str) -> dict[str, Any]:
    """Return the entry of a picture in transforms.json, whose depth file is ``depth``."""
    frame, lens = _shared_fields(picture), _intrinsics(picture.camera)
    supported = _FISHEYE_LENS if picture.camera.model == "fisheye" else _LENS[:5]
    if unknown := [name for name in _LENS if lens.get(name) and name not in supported]:
        raise InputError(
            f"{picture.name}: nerfstudio has no lens with {', '.join(unknown)}; leave it out by "
            f"naming the others with --camera"
        )
    coefficients = {name: lens.get(name, 0.0) for name in supported}
    frame["transform_matrix"] = frame["transform_matrix"] @ _OPENGL
    return {**frame, "depth_file_path": depth, **coefficients}


def _write_inverse_depths(pictures: Sequence[Picture], folder: Path) -> None:
    """Write inverse depth of each picture, its scale, and the image transparent without depth."""
    depths_m = {}
    for picture in pictures:
        picture.run.require_z(picture.map)
        depths_m[picture.name] = picture.run.full_m(picture.map)
    nearest_m = min(float(d[d > 0].min(initial=np.inf)) for d in depths_m.values())
    # One scale for all pictures: inverse depth = scale * step / 65536
    scale = 1 / nearest_m if np.isfinite(nearest_m) else 1.0
    for picture in pictures:
        depth_m = depths_m[picture.name]
        inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        steps = np.minimum(np.rint(inverse * (_INVERSE_STEPS / scale)), _INVERSE_STEPS - 1)
        write_file(folder / "depths" / f"{picture.name}.png", encode_png(steps.astype(np.uint16)))
        image = decode_image(picture.jpeg, picture.name)
        transparent = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
        transparent[depth_m == 0] = 0
        write_file(folder / "images" / f"{picture.name}.png", encode_png(transparent))
    params = {picture.name: {"scale": scale, "offset": 0.0} for picture in pictures}
    write_json(folder / "sparse" / "0" / "depth_params.json", params)


def _write_movers(run: FinishedRun, folder: Path) -> None:
    """Write the moving points of a run: a file for each tracked object, and the others."""
    cloud = run.whole_cloud()
    moving = cloud.select(cloud.moving)
    is_tracked = np.zeros(len(moving.points), bool)
    for track in run.tracks:
        of_track = moving.instance == track.instance
        is_tracked |= of_track
        if of_track.any():
            T_object_key = poses.inverse(track.T_key_object[track.frames.index(run.key)])
            points = poses.transform(T_object_key, moving.points[of_track])
            _save_splats(folder / f"{track.instance:04d}.ply", points, moving.rgb[of_track])
    if not is_tracked.all():
        untracked = moving.select(~is_tracked)
        _save_splats(folder / "others.ply", untracked.points, untracked.rgb)


def _save_splats(path: Path, points: Float, rgb: NDArray[np.uint8]) -> None:
    """Write points with normals of 0, as the code of Gaussian splatting reads them."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    columns |= {name: np.zeros(len(points), np.float32) for name in ("nx", "ny", "nz")}
    save_ply(path, columns | dict(zip(("red", "green", "blue"), rgb.T, strict=True)))


def _logarithmic_png(depth_m: Float32) -> bytes:
    """Return the PNG of depth (H,W) in metres on a log scale of 16 bits, 0 for no depth."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    # step = 1 + 65533 ln(depth / near) / ln(far / near)
    known, steps = depth_m > 0, np.zeros(depth_m.shape, np.uint16)
    near_m = float(depth_m[known].min(initial=1.0))
    far_m = max(float(depth_m[known].max(initial=1.0)), 1.1 * near_m)  # above near, for the log
    fraction = np.log(depth_m[known] / near_m) / np.log(far_m / near_m)
    steps[known] = 1 + np.rint(fraction * _LOG_STEPS)
    info, file = PngInfo(), io.BytesIO()
    info.add_text("near", repr(near_m))
    info.add_text("far", repr(far_m))
    Image.fromarray(steps).save(file, "PNG", pnginfo=info)
    return file.getvalue()


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)
