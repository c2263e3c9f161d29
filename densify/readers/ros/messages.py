# SPDX-License-Identifier: MIT
"""What ROS messages hold: points of any layout, images of any encoding, calibrations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Camera, Float
from densify.readers.decoded_files import decode_image
from densify.readers.file_sequence import rigid

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# of a lens's model: how densify calls it, and how many coefficients it has
_MODELS = {
    "plumb_bob": ("pinhole", (4, 5)),
    "radtan": ("pinhole", (4, 5)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "thin_prism": ("pinhole", (12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
    "kannala_brandt4": ("fisheye", (4,)),
}
_PACKED = {  # channels, and OpenCV's conversion to RGB
    "rgb8": (3, None),
    "bgr8": (3, "COLOR_BGR2RGB"),
    "rgba8": (4, "COLOR_RGBA2RGB"),
    "bgra8": (4, "COLOR_BGRA2RGB"),
    "8uc3": (3, "COLOR_BGR2RGB"),
    "mono8": (1, "COLOR_GRAY2RGB"),
    "8uc1": (1, "COLOR_GRAY2RGB"),
    # OpenCV names a mosaic by the second row's second and third pixel, ROS by its first two
    "bayer_rggb8": (1, "COLOR_BayerBG2RGB"),
    "bayer_bggr8": (1, "COLOR_BayerRG2RGB"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2RGB"),
    "bayer_grbg8": (1, "COLOR_BayerGB2RGB"),
    "yuv422": (2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": (2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2RGB_YUYV"),
    "yuyv": (2, "COLOR_YUV2RGB_YUYV"),
}


def cloud_columns(message: Any, where: str) -> dict[str, NDArray[Any]]:
    """The fields of a PointCloud2 by name, (N,) each as stored; those of several numbers are left
    out. Also of Livox's CustomMsg. Raises InputError if its layout contradicts itself."""
    if not hasattr(message, "point_step"):
        return _livox_columns(message)
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for entry in message.fields:
        if entry.count > 1 or not entry.name or entry.name in names:
            continue
        kind = _DATATYPES.get(entry.datatype)
        if kind is None or entry.offset + int(kind[1]) > message.point_step:
            raise InputError(
                f"{where}: field {entry.name}: got type {entry.datatype} at byte {entry.offset} of "
                f"{message.point_step}, expected one of ROS's eight types inside the point"
            )
        names.append(entry.name)
        formats.append(order + kind)
        offsets.append(entry.offset)
    layout: Any = {
        "names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step
    }  # fmt: skip
    data = np.ascontiguousarray(message.data, np.uint8)
    used = message.width * message.point_step
    if message.row_step < used or len(data) < message.height * message.row_step:
        raise InputError(
            f"{where}: got {len(data)} bytes and rows of {message.row_step}, expected "
            f"{message.height} rows of {message.width} points of {message.point_step} bytes"
        )
    rows = data[: message.height * message.row_step].reshape(message.height, message.row_step)
    points = np.ascontiguousarray(rows[:, :used]).reshape(-1).view(np.dtype(layout))
    return {name: points[name] for name in names}


def _livox_columns(message: Any) -> dict[str, NDArray[Any]]:
    names = ("x", "y", "z", "reflectivity", "offset_time", "line")
    table = np.array(
        [tuple(getattr(point, name) for name in names) for point in message.points],
        [("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("offset_time", "u4"),
         ("line", "u1")],
    )  # fmt: skip
    return {name: table[name] for name in names}


def image_rgb(message: Any, where: str) -> NDArray[np.uint8]:
    """(H,W,3) of an Image or CompressedImage. Raises InputError if its encoding is not known, or
    it is damaged."""
    import cv2

    data = np.ascontiguousarray(message.data, np.uint8)
    if hasattr(message, "format"):
        bgr = decode_image(data.tobytes(), where)
        return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
    encoding = message.encoding.lower()
    if encoding in ("mono16", "16uc1"):
        pixels = _pixels(message, data, 2, where).view(">u2" if message.is_bigendian else "<u2")
        gray = (pixels[:, :, 0] >> 8).astype(np.uint8)
        return cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB).astype(np.uint8)
    if encoding not in _PACKED:
        raise InputError(
            f"{where}: got the encoding {message.encoding}, expected one of "
            f"{', '.join(_PACKED)}, mono16; leave the camera out: name others with #images="
        )
    channels, conversion = _PACKED[encoding]
    pixels = _pixels(message, data, channels, where)
    if conversion is None:
        return np.ascontiguousarray(pixels)
    converted = cv2.cvtColor(np.ascontiguousarray(pixels), getattr(cv2, conversion))
    return np.ascontiguousarray(converted, dtype=np.uint8)


def _pixels(message: Any, data: NDArray[np.uint8], channels: int, where: str) -> NDArray[np.uint8]:
    used, height = message.width * channels, message.height
    if message.step < used or len(data) < message.step * height:
        raise InputError(
            f"{where}: got {len(data)} bytes and rows of {message.step}, expected {height} rows of "
            f"{message.width} pixels ({message.encoding})"
        )
    rows = data[: message.step * height].reshape(height, message.step)[:, :used]
    return np.ascontiguousarray(rows).reshape(height, message.width, channels)


def camera_of(info: Any, name: str, T_optical_lidar: Float, rectified: bool, where: str) -> Camera:
    """The camera of a CameraInfo.

    T_optical_lidar: (4,4) to the frame of the message. rectified: the images are of a topic that
    has been rectified: their calibration is P, turned by R; else it is K with D. Binning and a
    region of interest are taken into account. Raises InputError for a model that is not known or
    numbers that are no calibration.
    """
    matrix = {key: np.asarray(_member(info, key), np.float64) for key in "kdrp"}
    K = (matrix["p"].reshape(3, 4)[:, :3] if rectified else matrix["k"].reshape(3, 3)).copy()
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or abs(K[2, 2] - 1) > 1e-6:
        raise InputError(
            f"{where}: got {'P' if rectified else 'K'} = {np.round(K.ravel(), 4).tolist()}, "
            f"expected a calibration with positive focal lengths"
        )
    if min(info.width, info.height) < 1:
        raise InputError(f"{where}: got {info.width} x {info.height} px, expected the image's size")
    T = T_optical_lidar
    model, distortion = "pinhole", tuple(float(d) for d in matrix["d"])
    if rectified:
        R, distortion = np.eye(4), ()
        if matrix["r"].any():  # drivers leave zeros where they do not say
            R[:3, :3] = rigid(np.column_stack([matrix["r"].reshape(3, 3), np.zeros(3)]), where)[
                :3, :3
            ]
        T = R @ T
    else:
        model, distortion = _lens(info.distortion_model, distortion, where)
    camera = Camera(name, int(info.width), int(info.height), K, T, distortion, model)
    return _binned(camera, info)


def _lens(named: str, distortion: tuple[float, ...], where: str) -> tuple[str, tuple[float, ...]]:
    if not any(distortion) and _MODELS.get(named, ("pinhole",))[0] == "pinhole":
        return "pinhole", ()
    if named not in _MODELS:
        raise InputError(
            f"{where}: got the distortion model {named!r}, expected one of {', '.join(_MODELS)}; "
            f"name rectified images with #images="
        )
    model, counts = _MODELS[named]
    if len(distortion) not in counts:
        raise InputError(
            f"{where}: got {len(distortion)} coefficients of {named}, expected "
            f"{' or '.join(str(n) for n in counts)}"
        )
    return model, distortion


def _binned(camera: Camera, info: Any) -> Camera:
    """As the image is, which may be a part of the sensor and of fewer pixels: a pixel of the image
    is the mean of several, so centres shift by half a pixel."""
    roi, by = info.roi, np.array([max(1, info.binning_x), max(1, info.binning_y)])
    if not (roi.width or roi.height or (by > 1).any()):
        return camera
    size = [roi.width or camera.width_px, roi.height or camera.height_px]
    K = camera.K.copy()
    K[:2, 2] -= (roi.x_offset, roi.y_offset)
    K[:2, 2] = (K[:2, 2] + 0.5) / by - 0.5
    K[[0, 1], [0, 1]] /= by
    return replace(camera, K=K, width_px=int(size[0] // by[0]), height_px=int(size[1] // by[1]))


def _member(info: Any, key: str) -> Any:
    """ROS 1 writes K, ROS 2 k."""
    return getattr(info, key) if hasattr(info, key) else getattr(info, key.upper())
