# SPDX-License-Identifier: MIT
"""Where moving objects were, as a table and as JSON, for whatever reads tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.types import ObjectTrack
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.plain import write_json

_COLUMNS = (
    "object",
    "frame",
    "stamp_ns",
    "x_m",
    "y_m",
    "z_m",
    "qw",
    "qx",
    "qy",
    "qz",
    "length_m",
    "width_m",
    "height_m",
    "vx_m_s",
    "vy_m_s",
    "vz_m_s",
    "num_points",
)


def write_export(run: FinishedRun, folder: Path) -> None:
    """``tracks.csv``, a row for each object and moment, and ``tracks.json``, a list of the same
    rows by name: the middle of the object's box, the turn of its axes as a quaternion, size and
    velocity in key coordinates, see `ObjectTrack`.

    Raises InputError where thresholds are given, which say nothing of objects.
    """
    run.check_no_thresholds("tracks")
    rows = [row for track in run.tracks for row in _rows(track)]
    buffer = io.StringIO()
    table = csv.writer(buffer, lineterminator="\n")
    table.writerow(_COLUMNS)
    table.writerows(rows)
    write_file(folder / "tracks.csv", buffer.getvalue().encode())
    named = [dict(zip(_COLUMNS, row, strict=True)) for row in rows]
    write_json(folder / "tracks.json", {"key": run.key, "tracks": named})


def _rows(track: ObjectTrack) -> Iterator[list[int | float]]:
    turns = np.roll(Rotation.from_matrix(track.T_key_object[:, :3, :3]).as_quat(), 1, axis=1)
    turns *= np.where(turns[:, :1] < 0, -1.0, 1.0)
    for i, frame in enumerate(track.frames):
        place_m = track.T_key_object[i, :3, 3]
        numbers = [*place_m, *turns[i], *track.size_m, *track.velocity_m_s[i]]
        exact = [float(number) for number in numbers]
        yield [track.instance, frame, int(track.stamp_ns[i]), *exact, int(track.num_points[i])]
