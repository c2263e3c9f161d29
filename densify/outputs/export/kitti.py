# SPDX-License-Identifier: MIT
"""Keys in the tree of KITTI's depth completion benchmark, as `densify.outputs.kitti_tree` has it,
with images and intrinsics, for loaders of that benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from densify.config.errors import InputError
from densify.config.file_content import read_bytes, read_yaml
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.pictures import jpeg_of
from densify.outputs.kitti_tree import drive_folder, split_of
from densify.outputs.png import encode_png
from densify.readers.decoded_files import decode_image

_TREE = {
    "groundtruth": "depth",
    "groundtruth_filled": "depth_filled",
    "confidence": "confidence",
}


def write_export(run: FinishedRun, folder: Path) -> None:
    """``SPLIT/DRIVE/proj_depth/KIND/CAMERA/0000000120.png``: KIND is groundtruth (measured),
    groundtruth_filled, confidence, and velodyne_raw, the key sweep alone, where the run has it.
    Beside proj_depth ``CAMERA/data/0000000120.png``, the image, and
    ``intrinsics/CAMERA/0000000120.txt``, K row by row, as the benchmark's selection has it.

    SPLIT and DRIVE are the benchmark's own; of other recordings train and a name for a folder.
    """
    name = _drive(run)
    drive = folder / split_of(name) / drive_folder(name)
    for view in run.cameras:
        camera, _, number = view.partition("/")
        file = number or f"{run.key:010d}"
        maps = run.maps(view)
        for kind, product in _TREE.items():
            _write(drive / "proj_depth" / kind / camera / f"{file}.png", encode_png(maps[product]))
        sweep = run.folder / "scene" / "none" / f"{view}.png"
        if sweep.is_file():
            _write(
                drive / "proj_depth" / "velodyne_raw" / camera / f"{file}.png", read_bytes(sweep)
            )
        jpeg = jpeg_of(run, view)
        if jpeg is not None:
            image = decode_image(jpeg, run.folder / "scene" / "image" / f"{view}.jpg")
            _write(drive / camera / "data" / f"{file}.png", encode_png(image))
        if view in run.scene.views:
            K = run.scene.views[view].camera.K.ravel()
            text = " ".join(f"{number:.6f}" for number in K) + "\n"
            _write(drive / "intrinsics" / camera / f"{file}.txt", text.encode())


def write_drive(runs: Sequence[FinishedRun], folder: Path) -> None:
    """As `write_export`, in one tree."""
    for run in runs:
        write_export(run, folder)


def _drive(run: FinishedRun) -> str:
    path = run.folder / "run.yaml"
    record, _ = read_yaml(path)
    data = record.get("data") if isinstance(record, dict) else None
    if not isinstance(data, str) or not data.strip("/"):
        raise InputError(f"{path}: data: got {data!r}, expected the recording's name")
    return data.rstrip("/").rpartition("/")[2]


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, data)
