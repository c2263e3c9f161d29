# SPDX-License-Identifier: MIT
"""Check the parts that readers share: files by number, cameras, poses and boxes.

Each error is an InputError that begins with the place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Boxes, Camera, Float, Int, Truth
from densify.readers.decoded_files import decode_image
from densify.readers.timeline import format_frames

T = TypeVar("T")

_ORTHONORMAL_TOLERANCE = 1e-3  # text files carry seven digits, float32 files as many


def numbered_files(folder: Path, *suffixes: str) -> dict[int, Path]:
    """Return the files of a folder that are named by a frame number, by ascending frame.

    Without such a folder the result is empty.

    Args:
        suffixes: Accepted suffixes, with the dot and in lower case.
    """
    if not folder.is_dir():
        return {}
    found = {
        int(path.stem): path
        for path in folder.iterdir()
        if path.stem.isdecimal() and path.suffix.lower() in suffixes
    }
    return dict(sorted(found.items()))


def drive_around(path: Path) -> Path | None:
    """Return the KITTI drive around a place, None without one."""
    return next((p for p in path.absolute().parents[:2] if (p / "velodyne_points").is_dir()), None)


def of_frame(entries: Mapping[int, T], frame: int, what: str, where: Path) -> T:
    """Return the entry of a frame.

    Args:
        what: The kind of entry, for the message, such as ``"sweep"``.
        where: The recording's folder, for the message.

    Raises:
        InputError: There is no entry. The message names the existing frames.
    """
    if frame not in entries:
        raise InputError(
            f"{where}: no {what} of frame {frame}; frames that exist: {format_frames(entries)}"
        )
    return entries[frame]


def camera_named(cameras: Mapping[str, Camera], name: str, where: Path) -> Camera:
    """Return the camera. Raise InputError, which names the existing cameras, if there is none."""
    if name not in cameras:
        raise InputError(
            f"{where}: no camera {name!r}; cameras that exist: {', '.join(cameras) or 'none'}"
        )
    return cameras[name]


def decoded_image(data: bytes, camera: Camera, where: Path | str) -> NDArray[np.uint8]:
    """Return (H,W,3) uint8 RGB of an image file's bytes, gray in three equal channels.

    Raises:
        InputError: It is no whole image or not of the camera's size. The message names the
            place.
    """
    bgr = decode_image(data, where)
    image_size(bgr.shape, camera, where)
    return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)


def image_size(shape: tuple[int, ...], camera: Camera, where: Path | str) -> None:
    """Raise InputError if an image (H,W,...) has another size than the camera."""
    if shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            f"{where}: got an image of {shape[1]} x {shape[0]} px; expected {camera.width_px} x "
            f"{camera.height_px}, as the calibration of {camera.name} says; correct its size "
            f"and K, which go with the size of the images"
        )


def pinhole(
    name: str,
    size_px: tuple[int, int],
    fx_fy_cx_cy: Sequence[float],
    T_cam_lidar: Float,
    where: str,
    **lens: Any,
) -> Camera:
    """Return a camera without skew.

    Args:
        lens: Further arguments of `Camera`, such as its distortion.

    Raises:
        InputError: The numbers are not finite, or the focal lengths or the size (width, height) are
            not positive. The message starts with ``where``.
    """
    fx, fy, cx, cy = (float(value) for value in fx_fy_cx_cy)
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, *size_px) > 0):
        raise InputError(
            f"{where}: got fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} and {size_px[0]} x "
            f"{size_px[1]} px, expected finite numbers, positive focal lengths and sizes"
        )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(name, *size_px, K, T_cam_lidar, **lens)


def chosen_scene(reader: str, path: Path, scene: str | None, names: Sequence[str]) -> str:
    """Return the scene of a place: the one named, or the only one.

    Raises:
        InputError: There are several, or none of that name. The message lists them.
    """
    if scene in names or (scene is None and len(names) == 1):
        return scene or names[0]
    shown = ", ".join(names[:4]) + f", ... {names[-1]} ({len(names)} in all)" * (len(names) > 4)
    got = f"holds {len(names)} recordings" if scene is None else f"no recording {scene}"
    raise InputError(f"{path}: {got}; choose one by {reader}:{path}#NAME, NAME one of {shown}")


def truth_beside(recording: Path) -> Truth | None:
    """Return the exact truth in the folder ``truth`` of a simulated recording."""
    if not (recording / "truth").is_dir():
        return None
    from densify.readers.truth_files import FileTruth

    return FileTruth(recording / "truth")


def parse_numbers(text: str, where: str, count: int) -> Float:
    """Return the (count,) finite numbers of a line or file.

    Raises:
        InputError: The numbers are others. The message starts with ``where``.
    """
    try:
        values = np.array(text.split(), np.float64)
    except ValueError as error:
        raise InputError(f"{where}: {error}; expected {count} numbers") from None
    if len(values) != count:
        raise InputError(f"{where}: got {len(values)} values, expected {count} numbers")
    if not np.isfinite(values).all():
        raise InputError(f"{where}: got a value that is not finite, expected {count} numbers")
    return values


def rigid(T: Any, where: str) -> Float:
    """Return the (4,4) float64 pose of a (4,4) or (3,4) matrix, or of its 16 or 12 numbers.

    Raises:
        InputError: It is not finite, or its rotation is none. The message starts with
            ``where``.
    """
    T = np.asarray(T, np.float64)
    T = T.reshape(-1, 4) if T.size in (12, 16) else T
    if T.shape not in ((4, 4), (3, 4)) or not np.isfinite(T).all():
        got = "NaN or infinity" if T.shape in ((4, 4), (3, 4)) else f"shape {T.shape}"
        raise InputError(f"{where}: got {got}, expected a (4,4) pose of finite numbers")
    rotation(T[:3, :3], where)
    return np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])


def rotation(R: Float, where: str) -> Float:
    """Return the (3,3) matrix.

    Raises:
        InputError: It is no rotation. The message starts with ``where``.
    """
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(R) < 0:
        raise InputError(
            f"{where}: got a matrix that is not a rotation (R Rᵀ is off by {error:.2g}, "
            f"determinant {np.linalg.det(R):.3f}), expected an orthonormal one"
        )
    return R


def scanner_axes(T_lidar_scanner: Float) -> Float:
    """Return (S,3,3) `Returns.R_scanner_lidar` of scanners with these (S,4,4) mounting poses.

    An upside-down scanner is turned about its x axis until z points upwards.
    """
    R = T_lidar_scanner[:, :3, :3]
    upright = np.where(R[:, 2:, 2:] < 0, R * [1.0, -1.0, -1.0], R)
    return np.ascontiguousarray(upright.transpose(0, 2, 1))


def quaternion_pose(
    w_x_y_z: Sequence[float] | Float, translation_m: Sequence[float] | Float, where: str
) -> Float:
    """Return the (4,4) pose of a unit quaternion and a translation.

    The length of the quaternion is made exactly 1.

    Raises:
        InputError: The numbers are not finite or not four and three, or the length differs from
            1 by more than 0.01. The message starts with ``where``.
    """
    from scipy.spatial.transform import Rotation

    try:
        numbers = np.array([*w_x_y_z, *translation_m], np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}; expected numbers") from None
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(numbers[:4]))
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or abs(length - 1) > 0.01:
        raise InputError(
            f"{where}: got a quaternion of length {length:.4g} and the translation "
            f"{numbers[4:].tolist()}, expected a unit quaternion w x y z and metres x y z"
        )
    quaternion, translation = numbers[:4], numbers[4:]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
    T[:3, 3] = translation
    return T


def upright_poses(centre_m: Float, heading_rad: Float) -> Float:
    """Return the (K,4,4) poses of boxes whose z axis is that of the frame.

    Args:
        centre_m: (K,3).
        heading_rad: (K,) direction of the front, from x towards y.
    """
    T = np.tile(np.eye(4), (len(centre_m), 1, 1))
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :3, 3] = centre_m
    return T


def boxes(
    track: Sequence[str] | NDArray[Any],
    T_lidar_box: Float | Sequence[Float],
    size_m: Float,
    where: str,
    lidar: Int | None = None,
) -> Boxes:
    """Return the boxes of a sweep, checked.

    Raises:
        InputError: A box has no size or position, or is there twice. The message starts with
            ``where``.
    """
    bad = np.flatnonzero(~((size_m > 0) & (size_m < np.inf)).all(axis=1))
    if len(bad):
        raise InputError(
            f"{where}: a box has no size: got {size_m[bad[0]].tolist()}, expected length, width "
            f"and height in metres above 0"
        )
    T_lidar_box = np.reshape(T_lidar_box, (-1, 4, 4))
    if not np.isfinite(T_lidar_box).all():
        raise InputError(f"{where}: a box is nowhere: got NaN or infinity, expected a place")
    names = np.array(track, np.str_)
    found, times = np.unique(names[names != ""], return_counts=True)
    if (times > 1).any():
        raise InputError(f"{where}: the box {found[times > 1][0]} is there twice, expected once")
    return Boxes(names, T_lidar_box, size_m.reshape(-1, 3), lidar=lidar)
