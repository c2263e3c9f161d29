# SPDX-License-Identifier: MIT
"""Keys in the tree of KITTI's depth completion benchmark (`densify.outputs.kitti_tree`), with
images and intrinsics."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from densify.config.errors import InputError
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.kitti_tree import drive_folder, split_of
from densify.outputs.map_outputs import map_path
from densify.outputs.png import encode_png
from densify.readers.decoded_files import decode_image

_TREE = {"groundtruth": "depth", "groundtruth_filled": "depth_filled", "confidence": "confidence"}


def write_kitti(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``SPLIT/DRIVE/proj_depth/KIND/CAMERA/0000000120.png``, and beside proj_depth the image
    ``CAMERA/data/0000000120.png`` and ``intrinsics/CAMERA/0000000120.txt``, K row by row.

    KIND is groundtruth (measured), groundtruth_filled, confidence, and velodyne_raw, the key sweep
    alone, where the run has it. Recordings that the benchmark lacks are in train.
    """
    for run in runs:
        name = run.data.rstrip("/").rpartition("/")[2]
        if not name:
            raise InputError(f"{run.folder}/run.yaml: data: expected the recording's name")
        drive = folder / split_of(name) / drive_folder(name)
        for view in run.cameras:
            _write_view(run, view, drive)


def _write_view(run: FinishedRun, view: str, drive: Path) -> None:
    camera, _, number = view.partition("/")
    file, maps = number or f"{run.key:010d}", run.maps(view)
    for kind, product in _TREE.items():
        path = map_path(drive / "proj_depth" / kind, camera, file)
        write_file(path, encode_png(maps[product]))
    sweep = run.folder / "scene" / "none" / f"{view}.png"
    if sweep.is_file():
        shutil.copyfile(sweep, map_path(drive / "proj_depth" / "velodyne_raw", camera, file))
    if (jpeg := run.jpeg(view)) is not None:
        image = decode_image(jpeg, view)
        write_file(map_path(drive / camera, "data", file), encode_png(image))
    if view in run.views:
        numbers = " ".join(f"{value:.6f}" for value in run.views[view].camera.K.ravel())
        map_path(drive / "intrinsics", camera, file, ".txt").write_text(numbers + "\n")
