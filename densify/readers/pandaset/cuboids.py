# SPDX-License-Identifier: MIT
"""Boxes of PandaSet. See `densify.readers.pandaset.reader`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.geometry.types import Boxes, Float
from densify.readers.file_sequence import checked_boxes, upright_poses
from densify.readers.pandaset.pickled_frame import read_columns

CENTRE = tuple(f"position.{axis}" for axis in "xyz")
WIDTH_LENGTH_HEIGHT = tuple(f"dimensions.{axis}" for axis in "xyz")
NAME, YAW, SCANNER = "uuid", "yaw", "cuboids.sensor_id"


def read_cuboids(path: Path, T_world_lidar: Float) -> Boxes:
    """The boxes of a frame, in the frame of the lidar. Raises InputError if the file is damaged, or
    is no table of boxes."""
    columns = read_columns(path)
    numbers = (*CENTRE, *WIDTH_LENGTH_HEIGHT, YAW, SCANNER)
    missing = [name for name in (NAME, *numbers) if name not in columns]
    if missing:
        raise InputError(
            f"{path}: no column {missing[0]}: got {' '.join(columns) or 'none'}; use the data "
            f"set's own cuboids"
        )
    for name in numbers:
        if columns[name].dtype.kind not in "fiu" or not np.isfinite(columns[name]).all():
            raise InputError(f"{path}: column {name}: expected finite numbers")
    names = columns[NAME].tolist()
    if not all(isinstance(name, str) and name for name in names):
        raise InputError(f"{path}: column {NAME}: expected a text for each box")
    scanner = columns[SCANNER]
    if not np.isin(scanner, (-1, 0, 1)).all():
        raise InputError(
            f"{path}: column {SCANNER}: got {scanner[~np.isin(scanner, (-1, 0, 1))][0]}, expected "
            f"-1, 0 or 1"
        )
    centre_m = np.stack([columns[name] for name in CENTRE], axis=1).astype(np.float64)
    width_m, length_m, height_m = (columns[name] for name in WIDTH_LENGTH_HEIGHT)
    T_world_box = upright_poses(centre_m, columns[YAW] + np.pi / 2)
    return checked_boxes(
        names,
        inverse(T_world_lidar) @ T_world_box,
        np.stack([length_m, width_m, height_m], axis=1).astype(np.float64),
        str(path),
        lidar=scanner.astype(np.int64),
    )
