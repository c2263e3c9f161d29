# SPDX-License-Identifier: MIT
"""The cloud as COPC (https://copc.io), a LAZ file that viewers in a browser open part by part, by
copclib (``densify[copc]``)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Int
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.export.finished_run import FinishedRun
from densify.readers.extras import needed

_SCALE_M = 0.001
_CELLS = 64  # of a node, along each axis: one point of each is shown first
_MOST_IN_LEAF = 20_000
_DEEPEST = 12
_FORMAT_7 = np.dtype(
    [
        *((axis, "<i4") for axis in "xyz"),
        ("intensity", "<u2"),
        *((name, "u1") for name in ("returns", "flags", "classification", "user_data")),
        *(("scan_angle", "<i2"), ("point_source_id", "<u2"), ("gps_time", "<f8")),
        *((colour, "<u2") for colour in ("red", "green", "blue")),
    ]
)


def write_export(run: FinishedRun, folder: Path) -> None:
    """``cloud.copc.laz``: places, colour, intensity, gps_time; ``user_data`` 1 for what moves,
    ``point_source_id`` 1 + object, 0 none; copclib writes no dimensions with names of their own.
    Raises InputError without copclib, or if nothing is left of the cloud."""
    copclib = needed("copclib", "copc", "COPC files")
    cloud = run.cloud()
    if not len(cloud.points):
        raise InputError(f"{run.folder}: nothing is left of the cloud; lower --min-confidence")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    size_m = float((high - low).max()) + _SCALE_M
    scale, zero = (copclib.Vector3(*3 * [value]) for value in (_SCALE_M, 0.0))
    config = copclib.CopcConfigWriter(7, scale, zero)
    header, info = config.las_header, config.copc_info
    header.min, header.max = copclib.Vector3(*low), copclib.Vector3(*high)
    info.center_x, info.center_y, info.center_z = (low + size_m / 2).tolist()
    info.halfsize, info.spacing = size_m / 2, size_m / _CELLS
    records = _records(cloud)
    writer = copclib.FileWriter(str(folder / "cloud.copc.laz"), config)
    for level, node, rows in _nodes((cloud.points - low) / size_m):
        data = copclib.VectorChar(records[rows].view(np.int8))
        writer.AddNode(copclib.VoxelKey(level, *node), data)
    writer.Close()


def _nodes(unit: NDArray[Any]) -> Iterator[tuple[int, list[int], Int]]:
    """Level, place and points of each node of an octree over points (N,3) within [0, 1): of each of
    a node's cells one point, the others below it; all where few are left."""
    left = np.arange(len(unit))
    for level in range(_DEEPEST + 1):
        nodes = np.floor(unit[left] * 2**level).astype(np.int64)
        number = _number(nodes)
        _, of_node, counts = np.unique(number, return_inverse=True, return_counts=True)
        cells = np.floor(unit[left] * 2**level * _CELLS).astype(np.int64)
        first = np.zeros(len(left), bool)
        first[np.unique(_number(cells), return_index=True)[1]] = True
        here = first | (counts[of_node] <= _MOST_IN_LEAF) | (level == _DEEPEST)
        order = np.argsort(number[here], kind="stable")
        rows, places = left[here][order], nodes[here][order]
        starts = np.flatnonzero(np.diff(number[here][order], prepend=-1))
        for start, own in zip(starts, np.split(rows, starts[1:]), strict=True):
            yield level, places[start].tolist(), own
        left = left[~here]
        if not len(left):
            return


def _number(places: Int) -> Int:
    return (places[:, 0] << 42) | (places[:, 1] << 21) | places[:, 2]


def _records(cloud: StoredCloud) -> NDArray[Any]:
    """(N,) records of LAS point format 7."""
    records = np.zeros(len(cloud.points), _FORMAT_7)
    for axis, values in zip("xyz", cloud.points.T, strict=True):
        records[axis] = np.rint(values / _SCALE_M)
    records["intensity"] = np.rint(65535 * np.clip(cloud.intensity, 0, 1))
    records["returns"] = 1 | (1 << 4)  # the first of one
    records["user_data"] = cloud.moving
    records["point_source_id"] = cloud.instance + 1
    records["gps_time"] = cloud.gps_time
    for name, values in zip(("red", "green", "blue"), cloud.rgb.T, strict=True):
        records[name] = values.astype(np.uint16) * 257
    return records
