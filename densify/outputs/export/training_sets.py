# SPDX-License-Identifier: MIT
"""Write training sets of depth networks: a scene for map-anything, a data set for MoGe."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import needed
from densify.geometry import poses
from densify.geometry.types import Float32
from densify.outputs.atomic import write_file, write_json
from densify.outputs.depth_png import metres
from densify.outputs.export.camera_files import Picture, intrinsics, pictures_of, write_images
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.kitti_tree import drive_folder

_LOG_STEPS = 65533  # MoGe divides by this number


def write_wai(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a scene that map-anything reads (format: its data_processing/README.md).

    Poses are camera to world. ``depth/NAME.exr`` is measured depth in metres, 0 for no depth.
    """
    library = needed("OpenEXR", "exr", "EXR files")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    frames = []
    for picture in write_images(runs, folder, flat=True):
        picture.run.full_m(picture.map)
        _require_pinhole(picture, "wai")
        lens, depth = intrinsics(picture.camera), f"depth/{picture.name}.exr"
        (folder / depth).parent.mkdir(parents=True, exist_ok=True)
        depth_m = metres(picture.run.maps(picture.map)["depth"])
        library.File(header, {"Y": depth_m}).write(str(folder / depth))
        frames.append(
            {
                "frame_name": picture.name,
                "file_path": f"images/{picture.name}.jpg",
                "image": f"images/{picture.name}.jpg",
                "depth": depth,
                "transform_matrix": poses.inverse(picture.T_cam_world),
                **{f"fl_{axis}": lens[f"f{axis}"] for axis in "xy"},
                **{f"c{axis}": lens[f"c{axis}"] for axis in "xy"},
                "w": picture.camera.width_px,
                "h": picture.camera.height_px,
            }
        )
    modalities = {name: {"frame_key": name, "format": name} for name in ("image", "depth")}
    meta = {
        "scene_name": f"{drive_folder(runs[0].recording)}-{runs[0].key:06d}",
        "dataset_name": "densify",
        "version": "0.1",
        "shared_intrinsics": False,
        "camera_model": "PINHOLE",
        "camera_convention": "opencv",
        "frames": frames,
        "scene_modalities": {},
        "frame_modalities": modalities,
    }
    write_json(folder / "scene_meta.json", meta)


def write_moge(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a training set that MoGe reads (format: its docs/train.md and moge/utils/io.py).

    .index.txt lists the folders with image.jpg, meta.json (K for width and height 1) and depth.png:
    16 bits, measured depth on a logarithmic scale from ``near`` to ``far``, 0 for no depth.
    """
    names = []
    for run in runs:
        drive = drive_folder(run.recording)
        for picture in pictures_of([run], flat=True):
            picture.run.full_m(picture.map)
            _require_pinhole(picture, "moge")
            name = f"keys/{drive}/{run.key:06d}_{picture.name}"
            names.append(name)
            camera = picture.camera
            K = (camera.K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) / np.array(
                [[camera.width_px], [camera.height_px], [1]]
            )
            write_file(folder / name / "image.jpg", picture.jpeg)
            write_json(folder / name / "meta.json", {"intrinsics": K})
            depth_m = metres(run.maps(picture.map)["depth"])
            write_file(folder / name / "depth.png", _logarithmic_png(depth_m))
    write_file(folder / ".index.txt", "".join(f"{name}\n" for name in names).encode())


def _logarithmic_png(depth_m: Float32) -> bytes:
    """Return the bytes of depth.png for (H,W) metres, see `write_moge`."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    known, steps = depth_m > 0, np.zeros(depth_m.shape, np.uint16)
    near, far = (float(f(depth_m[known], initial=1.0)) for f in (np.min, np.max))
    far = max(far, 1.1 * near)
    share = np.log(depth_m[known] / near) / np.log(far / near)
    steps[known] = 1 + np.rint(share * _LOG_STEPS)
    info, file = PngInfo(), io.BytesIO()
    info.add_text("near", repr(near))
    info.add_text("far", repr(far))
    Image.fromarray(steps).save(file, "PNG", pnginfo=info)
    return file.getvalue()


def _require_pinhole(picture: Picture, to: str) -> None:
    if not picture.camera.is_rectified:
        raise InputError(
            f"{picture.name}: --to {to} takes images without distortion; leave the camera out by "
            f"naming the others with --camera"
        )
