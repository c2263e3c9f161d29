# SPDX-License-Identifier: MIT
"""A run's images with their cameras, as structure-from-motion tools have them: the upper left
pixel's middle is at (0.5, 0.5), and lenses are OpenCV's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import read_bytes
from densify.geometry.types import Camera, CameraView
from densify.outputs.atomic import write_file
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.finished_run import FinishedRun
from densify.readers.decoded_files import decode_image

_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_NAMES = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class Picture:
    """name: of the map. file: of the image, in the folder of images. view: from where it looks."""

    name: str
    file: str
    view: CameraView


def write_pictures(run: FinishedRun, folder: Path) -> list[Picture]:
    """Write the images of the run's maps as ``CAMERA.jpg``, as scene/image has them.

    Raises InputError if there is none, or as `jpeg_of`.
    """
    pictures = []
    for name in run.cameras:
        data = jpeg_of(run, name)
        if data is None:
            continue
        path = folder / f"{name}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, data)
        pictures.append(Picture(name, f"{name}.jpg", run.scene.views[name]))
    if not pictures:
        raise InputError(
            f"{run.folder}: no images in scene/image of {', '.join(run.cameras)}; densify the key "
            f"with a camera that has images"
        )
    return pictures


def jpeg_of(run: FinishedRun, name: str) -> bytes | None:
    """The image of a map, as scene/image has it; None where there is none. Raises InputError if it
    is damaged or not of its camera's size."""
    source = run.folder / "scene" / "image" / f"{name}.jpg"
    if name not in run.scene.views or not source.is_file():
        return None
    camera, data = run.scene.views[name].camera, read_bytes(source)
    height, width = decode_image(data, source).shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise InputError(
            f"{source}: got {width} x {height} px, expected {camera.width_px} x "
            f"{camera.height_px} as scene.json says; densify the key again"
        )
    return data


def intrinsics(camera: Camera) -> dict[str, float]:
    """fx, fy, cx, cy in pixels, and the lens: k1 k2 p1 p2 and as many of k3 k4 k5 k6 as it has;
    k1 to k4 of a fisheye.

    Raises InputError for a lens that OpenCV's eight coefficients cannot say.
    """
    names = _FISHEYE_NAMES if camera.model == "fisheye" else _NAMES
    lens = list(camera.distortion)
    if camera.model == "mei" or any(lens[len(names) :]) or camera.K[0, 1]:
        raise InputError(
            f"{camera.name}: its lens ({camera.model}, {len(lens)} coefficients) has no equal "
            f"there; leave it out by naming the others with --camera"
        )
    num_given = max(4, len(lens)) if any(lens) or camera.model == "fisheye" else 0
    padded = [*lens, *[0.0] * len(names)]
    K = camera.K
    return {
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]) + 0.5,
        "cy": float(K[1, 2]) + 0.5,
        **dict(zip(names[:num_given], padded, strict=False)),
    }


def seen(cloud: StoredCloud) -> StoredCloud:
    """The points that a camera saw; others have no colour."""
    return cloud.select(np.any(cloud.rgb > 0, axis=1))
