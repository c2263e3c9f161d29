# SPDX-License-Identifier: MIT
"""Find and check numbered files, cameras, poses and boxes; errors begin with the file or folder."""

from __future__ import annotations

import os
import re
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

_NUMBER = re.compile(r"(\d+)")
_ORTHONORMAL_TOLERANCE = 1e-3  # far above the rounding of text and float32 files (7 digits)


def numbered_files(
    folder: Path, *suffixes: str, stem: re.Pattern[str] = _NUMBER
) -> dict[int, Path]:
    """Return the numbered files of a folder, such as ``0000000120.bin``, by ascending number.

    Raise InputError if two files of one suffix have the same number.

    Args:
        folder: Folder to search without its subfolders, or one file. It may be missing.
        *suffixes: Accepted suffixes. Of files with the same number, the earliest suffix is taken.
        stem: Pattern of a whole name without suffix. The pattern's first group is the number.
    """
    entries = [folder] if folder.is_file() else folder.glob("*")
    files = [
        (suffixes.index(suffix), int(match[1]), path)
        for path in entries
        if (suffix := path.suffix.lower()) in suffixes and (match := stem.fullmatch(path.stem))
    ]
    path_of_number: dict[int, Path] = {}
    for _, number, path in sorted(files):
        before = path_of_number.setdefault(number, path)
        if before.stem != path.stem and before.suffix.lower() == path.suffix.lower():
            raise InputError(
                f"{path}: has the number {number}, as {before.name} has; expected one file of each "
                f"number; move one of them away"
            )
    return dict(sorted(path_of_number.items()))


def file_within(root: Path, name: str, where: Path | str) -> Path:
    """Return the path of ``name`` in the folder ``root``. Raise InputError if it leads outside."""
    path = root / name
    if not Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)):
        raise InputError(
            f"{where}: names the file {name!r}, outside of {root}; expected a path within it"
        )
    return path


def drive_around(path: Path) -> Path | None:
    """Return the KITTI raw drive that holds a path one or two levels below, None without one."""
    parents = path.absolute().parents[:2]
    return next((parent for parent in parents if (parent / "velodyne_points").is_dir()), None)


def find_entry(entries: Mapping[int, T], frame: int, kind: str, where: Path) -> T:
    """Return the entry of a frame. Raise InputError about ``kind`` and ``where`` without one."""
    if frame not in entries:
        raise InputError(
            f"{where}: no {kind} of frame {frame}; frames that exist: {format_frames(entries)}"
        )
    return entries[frame]


def camera_named(cameras: Mapping[str, Camera], name: str, where: Path) -> Camera:
    """Return the camera of a name. Raise InputError, with the known names, for another name."""
    if name not in cameras:
        raise InputError(
            f"{where}: no camera {name!r}; cameras that exist: {', '.join(cameras) or 'none'}"
        )
    return cameras[name]


def decode_rgb(data: bytes, camera: Camera, where: Path | str) -> NDArray[np.uint8]:
    """Return the (H,W,3) uint8 RGB pixels of an image file's bytes, checked for their size."""
    bgr = decode_image(data, where)
    check_image_size(bgr.shape, camera, where)
    return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)


def check_image_size(shape: tuple[int, ...], camera: Camera, where: Path | str) -> None:
    """Raise InputError if an image's shape (H,W,...) differs from its camera's height and width."""
    if shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            f"{where}: got an image of {shape[1]} x {shape[0]} px; expected {camera.width_px} x "
            f"{camera.height_px}, as the calibration of {camera.name} says; correct its size "
            f"and K, which go with the size of the images"
        )


def pinhole(
    name: str,
    size_px: tuple[int, int],  # width, height
    fx_fy_cx_cy: Sequence[float],  # pixels
    T_cam_lidar: Float,  # (4,4)
    where: str,
    **lens: Any,
) -> Camera:
    """Return a camera with zero skew. ``lens`` has further arguments of `Camera`.

    Raise InputError, whose message begins with ``where``, if a number is not finite, or a focal
    length or size is not above 0.
    """
    fx, fy, cx, cy = (float(value) for value in fx_fy_cx_cy)
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, *size_px) > 0):
        raise InputError(
            f"{where}: got fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} and {size_px[0]} x "
            f"{size_px[1]} px, expected finite numbers, positive focal lengths and sizes"
        )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(name, *size_px, K, T_cam_lidar, **lens)


def chosen_scene(
    reader: str, path: Path, scene: str | None, names: Sequence[str], none: str
) -> str:
    """Return the name of the requested scene, or of the only scene. Else raise InputError.

    Args:
        reader, path: Name of the reader and path of the recordings, for messages.
        scene: Name of the requested scene, None for the only scene.
        names: Names of the existing scenes.
        none: Message of the InputError if there are no scenes.
    """
    if not names:
        raise InputError(f"{path}: {none}")
    if scene in names or (scene is None and len(names) == 1):
        return scene or names[0]
    shown = ", ".join(names[:4]) + f", ... {names[-1]} ({len(names)} in all)" * (len(names) > 4)
    got = f"holds {len(names)} recordings" if scene is None else f"no recording {scene}"
    raise InputError(f"{path}: {got}; choose one by {reader}:{path}#NAME, NAME one of {shown}")


def truth_beside(recording: Path) -> Truth | None:
    """Return the ground truth in a simulated recording's folder ``truth``, None if none exists."""
    if not (recording / "truth").is_dir():
        return None
    from densify.readers.street import FileTruth

    return FileTruth(recording / "truth")


def parse_numbers(text: str, where: str, count: int) -> Float:
    """Return the ``count`` finite numbers in a text as (count,). Raise InputError otherwise."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError as error:
        raise InputError(f"{where}: {error}; expected {count} numbers") from None
    if len(values) != count:
        raise InputError(f"{where}: got {len(values)} values, expected {count} numbers")
    if not np.isfinite(values).all():
        raise InputError(f"{where}: got a value that is not finite, expected {count} numbers")
    return values


def pose(T: Any, where: str) -> Float:
    """Return a (4,4) rigid transform from (4,4), (3,4), or their 16 or 12 numbers, row by row.

    Raise InputError, whose message begins with ``where``, if a number is not finite, or the
    rotation is mirrored or not orthonormal to 0.001.
    """
    T = np.asarray(T, np.float64)
    is_pose = T.size in (12, 16)
    if not is_pose or not np.isfinite(T).all():
        got = "NaN or infinity" if is_pose else f"shape {T.shape}"
        raise InputError(f"{where}: got {got}, expected a (4,4) pose of finite numbers")
    T = T.reshape(-1, 4)
    R = T[:3, :3]
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(R) < 0:
        raise InputError(
            f"{where}: got a matrix that is not a rotation (R Rᵀ is off by {error:.2g}, "
            f"determinant {np.linalg.det(R):.3f}), expected an orthonormal one"
        )
    return np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])


def scanner_axes(T_lidar_scanner: Float) -> Float:
    """Return the (S,3,3) rotations from lidar axes to the axes of each scanner, z up.

    ``T_lidar_scanner`` are the mounting poses (S,4,4). The axes of a scanner that is mounted upside
    down are turned by 180 degrees about its x axis.
    """
    R = T_lidar_scanner[:, :3, :3]
    upright = np.where(R[:, 2:, 2:] < 0, R * [1.0, -1.0, -1.0], R)
    return np.ascontiguousarray(upright.transpose(0, 2, 1))


def quaternion_pose(
    w_x_y_z: Sequence[float] | Float, translation_m: Sequence[float] | Float, where: str
) -> Float:
    """Return the (4,4) pose of a unit quaternion, scalar first, and a translation in metres.

    Raise InputError, whose message begins with ``where``, unless these are 4 and 3 finite numbers
    and the quaternion's length is within 0.01 of 1.
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
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(numbers[[1, 2, 3, 0]]).as_matrix()
    T[:3, 3] = numbers[4:]
    return T


def upright_poses(centre_m: Float, heading_rad: Float) -> Float:
    """Return (K,4,4) poses at centres (K,3) in metres, turned from x to y by (K,) angles in rad."""
    T = np.tile(np.eye(4), (len(centre_m), 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(heading_rad)
    T[:, 1, 0] = np.sin(heading_rad)
    T[:, 0, 1] = -T[:, 1, 0]
    T[:, :3, 3] = centre_m
    return T


def boxes(
    track: Sequence[str] | NDArray[Any],
    T_lidar_box: Float | Sequence[Float],
    size_m: Float,
    where: str,
    lidar: Int | None = None,
) -> Boxes:
    """Return the K annotated boxes of a sweep.

    Args:
        track: (K,) name of each object in all sweeps, "" for an untracked object.
        T_lidar_box: (K,4,4) poses of the boxes: origin in the middle, x to the front, z up.
        size_m: (K,3) length, width and height.
        where: File, with which messages begin.
        lidar: (K,) index of the scanner whose points a box encloses, -1 for all scanners; None if
            every box encloses the points of all scanners.

    Raises:
        InputError: A size is not above 0, a pose is not finite, or a name occurs twice.
    """
    wrong_rows = np.flatnonzero(~((size_m > 0) & (size_m < np.inf)).all(axis=1))
    if len(wrong_rows):
        raise InputError(
            f"{where}: a box has no size: got {size_m[wrong_rows[0]].tolist()}, expected length, "
            f"width and height in metres above 0"
        )
    T_lidar_box = np.reshape(T_lidar_box, (-1, 4, 4))
    if not np.isfinite(T_lidar_box).all():
        raise InputError(f"{where}: a box is nowhere: got NaN or infinity, expected a place")
    names = np.array(track, np.str_)
    unique, counts = np.unique(names[names != ""], return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{where}: the box {unique[counts > 1][0]} is there twice, expected once")
    return Boxes(names, T_lidar_box, size_m.reshape(-1, 3), lidar=lidar)
