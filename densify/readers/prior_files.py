# SPDX-License-Identifier: MIT
"""Read depth priors: depth images that the user provides, such as from a monocular network.

    DIR/[CAMERA/[data/]]FRAME.npy, .exr or .png    CAMERA may be omitted for a single camera
    DIR/sky/[CAMERA/]FRAME.png    optional masks, nonzero for sky

FRAME is the image's number: 120, 0000000120, 0000000120_depth or _disp. Arrays are (H,W) of any
number type; EXR files have one channel, or one called Z, Y or depth; PNG files are 16 bit gray. A
pixel that is not finite or not above 0 has no value. A single file is accepted too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import import_extra, open_file, reason
from densify.geometry.types import Bool, Camera, Float32, Prior
from densify.readers import checks
from densify.readers.decoded_files import check_pixels, read_array, read_image
from densify.readers.timeline import format_frames

_SUFFIXES = (".npy", ".exr", ".png")  # descending precision
_STEM = re.compile(r"(\d+)(?:[_-](?:depth|disp|disparity|pred|prior))?", re.IGNORECASE)
_CHANNELS = ("Z", "Y", "depth", "Depth")
_SAME_ASPECT = 0.02


@dataclass(frozen=True)
class PriorFiles:
    """The files of the user's depth priors."""

    place: Path  # folder or file that the user named
    values: Mapping[str, Mapping[int, Path]]  # depth files, by camera name and image number
    sky: Mapping[str, Mapping[int, Path]]  # files of sky masks, by camera name and image number

    @staticmethod
    def open(path: Path, cameras: Sequence[str]) -> PriorFiles:
        """Return the prior files of the cameras in a folder, or of one camera in a file or folder.

        Raise InputError if nothing is found, or if files of one camera have to serve several.
        """
        where = f"prior {path}"
        example = "0000000120.npy, .exr or .png"
        if not path.exists():
            raise InputError(f"{where}: no such folder or file; expected DIR/CAMERA/{example}")
        values = {camera: _find_numbered(path / camera) for camera in cameras}
        sky = {camera: _find_numbered(path / "sky" / camera) for camera in cameras}
        if not any(values.values()) and (flat := _find_numbered(path)):
            if len(cameras) > 1:
                raise InputError(
                    f"{where}: holds depth images of one camera, and there are "
                    f"{', '.join(cameras)}; choose one with --camera, or put them into "
                    f"{path / 'CAMERA'}"
                )
            values, sky = {cameras[0]: flat}, {cameras[0]: _find_numbered(path / "sky")}
        if not any(values.values()):
            inside = path / (cameras[0] if cameras else "CAMERA")
            raise InputError(
                f"{where}: holds no depth images named by frame; expected {inside}/{example}"
                if path.is_dir()
                else f"{where}: names no frame; expected {example}"
            )
        return PriorFiles(path, values, sky)

    def describe_available(self, camera: str) -> str:
        """Return a clause on the images of ``camera`` with priors, such as "there are 96-135"."""
        return f"there are {format_frames(self.values[camera])}"

    def prior(self, camera: Camera, number: int) -> Prior | None:
        """Return an image's prior at the camera's size (H,W), or None if the image has no prior.

        A prior of another size is resized. Raise InputError if its aspect ratio differs by over 2
        %.
        """
        path = self.values[camera.name].get(number)
        if path is None:
            return None
        value = _resized(_read_values(path), camera, path)
        mask = self.sky[camera.name].get(number)
        sky = np.zeros(value.shape, bool) if mask is None else _read_sky(mask, camera)
        return Prior(value, sky, str(path))


def _find_numbered(folder: Path) -> dict[int, Path]:
    """Return the prior files of a folder or its ``data`` subfolder by image number."""
    # Suffixes are ordered, because a PNG may be only a preview of the .npy.
    folders = (folder, folder / "data")
    numbered = (checks.numbered_files(path, *_SUFFIXES, stem=_STEM) for path in folders)
    return next(filter(None, numbered), {})


def _read_values(path: Path) -> Float32:
    """Read the values of a prior as (H,W) float32, 0 for pixels without a value."""
    read = {".npy": read_array, ".exr": _read_exr, ".png": _read_png}[path.suffix.lower()]
    image = read(path)
    image = image.squeeze() if image.ndim > 2 else image
    if image.ndim != 2 or image.dtype.kind not in "fui":
        raise InputError(
            f"{path}: got {image.dtype} of shape {image.shape}, expected numbers (H,W): one depth "
            f"or inverse depth for each pixel"
        )
    with np.errstate(over="ignore"):
        value = image.astype(np.float32)
    value[~(np.isfinite(value) & (value > 0))] = 0
    if not value.any():
        raise InputError(f"{path}: holds no number above 0, expected depth or inverse depth")
    return value


def _read_exr(path: Path) -> NDArray[Any]:
    """Read the channel of depth of an EXR file."""
    library = import_extra("OpenEXR", "exr", "EXR files")
    open_file(path).close()
    try:
        header = library.File(str(path), header_only=True).header()
        (left, top), (right, bottom) = header["dataWindow"]
        check_pixels((int(right) - int(left) + 1, int(bottom) - int(top) + 1), path)
        channels = library.File(str(path)).channels()
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a whole EXR file ({reason(error)})") from error
    for name in _CHANNELS if len(channels) > 1 else channels:
        if name in channels:
            return np.asarray(channels[name].pixels)
    raise InputError(
        f"{path}: has the channels {', '.join(channels)}, expected one, or Z, Y or depth"
    )


def _read_png(path: Path) -> NDArray[Any]:
    """Read a PNG file of one channel of 16 bits."""
    image = read_image(path, as_stored=True)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(
            f"{path}: got {8 * image.dtype.itemsize} bit of shape {image.shape}, expected 16 bit "
            f"and one channel; pictures of depth are too coarse: save it as .npy"
        )
    return image


def _resized(value: Float32, camera: Camera, path: Path) -> Float32:
    """Resize values (H,W) to the camera's size, 0 for pixels beside an empty pixel."""
    if value.shape == (camera.height_px, camera.width_px):
        return value
    # Share of the pixels with a value that a resized pixel is interpolated from
    share = _at_size((value > 0).astype(np.float32), camera, path)
    is_full = share > 1 - 1e-3  # 1 but for rounding
    return np.where(is_full, _at_size(value, camera, path), 0).astype(np.float32)


def _read_sky(path: Path, camera: Camera) -> Bool:
    """Read a sky mask at the camera's size (H,W), True for sky."""
    mask = read_image(path, as_stored=True)
    mask = mask if mask.ndim == 2 else mask[:, :, :3].max(axis=2)
    sky: Bool = _at_size((mask > 0).astype(np.float32), camera, path) >= 0.5
    return sky


def _at_size(image: Float32, camera: Camera, path: Path) -> Float32:
    """Resize an image linearly to the camera's size. Raise InputError for another aspect."""
    import cv2

    height, width = image.shape
    if abs(width * camera.height_px / (height * camera.width_px) - 1) > _SAME_ASPECT:
        raise InputError(
            f"{path}: got {width} x {height} px, expected {camera.width_px} x "
            f"{camera.height_px} as {camera.name} has, or another size of that aspect"
        )
    size_px = camera.width_px, camera.height_px
    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_LINEAR), np.float32)
