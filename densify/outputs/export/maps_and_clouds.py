# SPDX-License-Identifier: MIT
"""Write depth maps (npy, exr, kitti) and the cloud (ply, pcd) of a finished run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.config.file_content import needed
from densify.geometry.arrays import table
from densify.geometry.types import Float32
from densify.outputs.atomic import write_file, write_json
from densify.outputs.depth_png import encode_png, map_path, metres
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.kitti_tree import drive_folder, split_of
from densify.readers.decoded_files import decode_image

_TREE = {"groundtruth": "depth", "groundtruth_filled": "depth_filled", "confidence": "confidence"}
_PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar", "u2": "ushort"}


def write_npy(run: FinishedRun, folder: Path) -> None:
    """Write (H,W) float32 .npy: depth, depth_filled (metres, 0 none) and confidence (0 to 1)."""
    _write_maps(run, folder, ".npy", lambda path, _, values: np.save(path, values))


def write_exr(run: FinishedRun, folder: Path) -> None:
    """Write the maps of `write_npy` as 32-bit OpenEXR, channel Z for depth, Y for confidence."""
    library = needed("OpenEXR", "exr", "EXR files")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}

    def save(path: Path, kind: str, values: Float32) -> None:
        channel = "Y" if kind == "confidence" else "Z"
        library.File(header, {channel: values}).write(str(path))

    _write_maps(run, folder, ".exr", save)


def _write_maps(
    run: FinishedRun, folder: Path, suffix: str, save: Callable[[Path, str, Float32], None]
) -> None:
    for camera in run.cameras:
        maps = run.maps(camera)
        levels = np.maximum(maps["confidence"].astype(np.float32) - 1, 0)
        values = {kind: metres(maps[kind]) for kind in ("depth", "depth_filled")}
        for kind, array in {**values, "confidence": levels / np.float32(254)}.items():
            path = map_path(folder, kind, camera, suffix)
            path.parent.mkdir(parents=True, exist_ok=True)
            save(path, kind, array)


def write_kitti(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a KITTI depth completion tree (`densify.outputs.kitti_tree`).

    Maps are ``SPLIT/DRIVE/proj_depth/KIND/CAMERA/0000000120.png``, KIND as in that module. Beside
    proj_depth are ``CAMERA/data/0000000120.png`` and K in ``intrinsics/CAMERA/0000000120.txt``.
    Recordings unknown to the benchmark are in train. files.txt has a line for each map: paths of
    image, measured and filled depth. annotations.json adds ``cam_in`` (fx fy cx cy) and
    ``depth_scale``, for Metric3D.
    """
    files: list[dict[str, Any]] = []
    for run in runs:
        if not run.recording:
            raise InputError(f"{run.folder}/run.yaml: recording: expected the recording's name")
        drive = folder / split_of(run.recording) / drive_folder(run.recording)
        for view in run.cameras:
            files += _write_view(run, view, drive, folder)
    lines = [f"{file['rgb']} {file['depth']} {file['depth_filled']}\n" for file in files]
    write_file(folder / "files.txt", "".join(lines).encode())
    write_json(folder / "annotations.json", {"files": files})


def _write_view(run: FinishedRun, view: str, drive: Path, root: Path) -> list[dict[str, Any]]:
    """Write the files of a map and return its annotations.json entries, none without an image."""
    camera, _, number = view.partition("/")
    file, maps = number or f"{run.key:010d}", run.maps(view)
    for kind, product in _TREE.items():
        write_file(map_path(drive / "proj_depth" / kind, camera, file), encode_png(maps[product]))
    sweep = map_path(run.folder / "scene", "none", view)
    if sweep.is_file():
        raw = map_path(drive / "proj_depth" / "velodyne_raw", camera, file)
        write_file(raw, sweep.read_bytes())
    if view in run.views:
        numbers = " ".join(f"{value:.6f}" for value in run.views[view].camera.K.ravel())
        path = map_path(drive / "intrinsics", camera, file, ".txt")
        write_file(path, f"{numbers}\n".encode())
    if (jpeg := run.jpeg(view)) is None:
        return []
    image = map_path(drive / camera, "data", file)
    write_file(image, encode_png(decode_image(jpeg, view)))
    depth, filled = (map_path(drive / "proj_depth" / k, camera, file) for k in list(_TREE)[:2])
    paths = {"rgb": image, "depth": depth, "depth_filled": filled}
    entry: dict[str, Any] = {n: p.relative_to(root).as_posix() for n, p in paths.items()}
    fx, fy, cx, cy = run.views[view].camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return [entry | {"cam_in": [fx, fy, cx, cy], "depth_scale": 256.0}]


def write_ply(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.ply`` with every column of cloud.laz (`StoredCloud.columns`)."""
    save_ply(folder / "cloud.ply", run.cloud().columns())


def save_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write (N,) columns by name as vertices of PLY (Turk, 1994), binary, little-endian."""
    rows = table(columns)
    rows = rows.astype(rows.dtype.newbyteorder("<"), copy=False)
    kinds = {name: _PLY_TYPES[rows.dtype[name].str.lstrip("<|")] for name in columns}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment densify, metres",
        f"element vertex {len(rows)}",
        *(f"property {kind} {name}" for name, kind in kinds.items()),
        "end_header",
    ]
    write_file(path, "\n".join(header).encode("ascii") + b"\n" + rows.tobytes())


def write_pcd(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.pcd``, binary PCD 0.7 with the same columns, colour as one float ``rgb``."""
    from pypcd4 import Encoding, PointCloud

    columns = run.cloud().columns()
    rgb = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    columns["rgb"] = PointCloud.encode_rgb(rgb)
    kinds = [column.dtype.type for column in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), kinds)
    cloud.save(folder / "cloud.pcd", Encoding.BINARY)
