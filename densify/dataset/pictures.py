# SPDX-License-Identifier: MIT
"""Draw small pictures of a key of a training set, and keep one of a key that is put aside."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord
from densify.dataset.plan import Drive
from densify.depth.exposure import key_shots
from densify.geometry.types import Float32, LidarSequence
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import Picture, encode_jpeg
from densify.outputs.plots import depth_over_image, order_front_first
from densify.readers import open_sequence

FILLED = ("depth_filled", "groundtruth_filled")
"""Folders of the maps of filled depth, in the two layouts."""
PICTURE_FOLDER = "aside"
"""Folder of the pictures of keys that are put aside, in a training set."""
_WIDTH_PX = 400
_QUALITY = 80


def front_camera(drive: Drive) -> str:
    """Return the name of a recording's camera that is shown: by its name the front camera."""
    return order_front_first([*drive.cameras], {}, {})[0]


def find_map(record: KeyRecord, kinds: tuple[str, ...], camera: str) -> str | None:
    """Return the path, relative to the set, of a camera's first map of one of these kinds."""
    paths = [PurePosixPath(name) for name in record.files]
    of_camera = (p for p in paths if camera in (p.stem, p.parent.name) and {*kinds} & {*p.parts})
    return next(map(str, of_camera), None)


def shrink(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map with every n-th row and column, about as wide as a picture."""
    step = max(1, values.shape[1] // _WIDTH_PX)
    return np.ascontiguousarray(values[::step, ::step])


def small_image(drive: Drive, key: int, size_px: tuple[int, int]) -> Picture | None:
    """Return the RGB image at a key sweep, resized to (width, height); None if there is none."""
    camera = drive.cameras[front_camera(drive)]
    try:
        sequence = _open(drive.data)
        number = key_shots(sequence, [camera], key)[camera.name].number
        image = None if number is None else sequence.image(camera.name, number)
    except (InputError, KeyError):  # the recording has moved, or no longer holds the sweep
        return None
    if image is None:
        return None
    return cv2.resize(image, size_px, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


@lru_cache(maxsize=1)
def _open(data: str) -> LidarSequence:
    """Open a recording, and keep the last one open."""
    return open_sequence(data)


def draw_depth(depth_m: Float32, image: Picture | None) -> Picture:
    """Return an RGB picture of depth (h,w) over an image of that size, over black without one."""
    below = np.zeros((*depth_m.shape, 3), np.uint8) if image is None else image
    return np.ascontiguousarray(depth_over_image(below, depth_m)[:, :, ::-1])


def keep_picture(out: Path, drive: Drive, key: int, filled_m: Float32) -> Path:
    """Write the picture of a key whose maps are not kept, and return its path.

    Args:
        out: Folder of the training set.
        drive: Recording of the key.
        key: Frame number of the key.
        filled_m: (H,W) filled depth of the `front_camera` in metres, 0 for no depth.
    """
    small_m = shrink(filled_m)
    picture = draw_depth(small_m, small_image(drive, key, small_m.shape[::-1]))
    path = out / PICTURE_FOLDER / drive.name / f"{key:010d}.jpg"
    write_file(path, encode_jpeg(picture, _QUALITY))
    return path
