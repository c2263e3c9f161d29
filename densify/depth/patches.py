# SPDX-License-Identifier: MIT
"""What each accumulated point stands for, before any camera looks: a patch of surface as large as
the gap to the neighbouring rays of its own sweep, slanted as its neighbours there tell; and whether
the key sweep saw through the place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config import ProjectSettings
from densify.depth import tangents as kernels
from densify.free_space.range_image import RangeImage
from densify.free_space.sensor import Sensors
from densify.geometry.types import Bool, Cloud, Float, Float32, Patches

_MIN_FILLED = 6


class Tangents:
    """What `tangents` finds, kept for those who ask again: methods differ in where they put what
    moves, not in what was measured. The largest cloud is kept. May be asked by several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._asked: tuple[NDArray[Any], ...] = (np.zeros((0, 3)),) * 3
        self._wanted = np.zeros(0, bool)
        self._normal, self._spacing_m = np.zeros((2, 0, 3), np.float32)

    def of(
        self,
        cloud: Cloud,
        sweep: NDArray[np.int32],
        wanted: Bool,
        sensors: Sensors,
        origins: Sequence[Float],
    ) -> tuple[Float32, Float32]:
        """As `tangents`, of the rigidly registered points."""
        points, lidar = cloud.rigid_points, cloud.lidar
        asked: tuple[NDArray[Any], ...] = (points, lidar, sweep)
        if len(points) < len(self._asked[0]):
            return tangents(points, lidar, sweep, wanted, sensors, origins)
        with self._lock:
            again = all(np.array_equal(a, b) for a, b in zip(asked, self._asked, strict=True))
            known = wanted & self._wanted if again else np.zeros(len(cloud), bool)
            new = wanted & ~known
            normal, spacing_m = tangents(points, lidar, sweep, new, sensors, origins)
            rows = np.flatnonzero(known)
            if len(rows):
                normal[rows], spacing_m[rows] = self._normal[rows], self._spacing_m[rows]
            self._asked, self._wanted = asked, wanted
            self._normal, self._spacing_m = normal, spacing_m
        return normal, spacing_m


def patches(
    cloud: Cloud,
    key: int,
    settings: ProjectSettings,
    sensors: Sensors,
    origins: Mapping[int, Float],
    key_image: RangeImage | None = None,
    wanted: Bool | None = None,
    shared: Tangents | None = None,
) -> Patches:
    """The patches of ``cloud``, of any use to every camera.

    sensors: the scanners that measured it. origins: (S,3) where each of them stood in each source
    sweep, key frame, by frame. key_image: what the key sweep saw; without it nothing is ``free``.
    wanted: (M,) the points that some camera sees, all if None; of others no more than ``sweep`` is
    told. shared: with other methods, by the same sensors and origins.

    The tangent plane is from the neighbours in azimuth and elevation of the same scanner in the
    same sweep; where they tell of no single surface the patch faces the scanner. A point of another
    sweep is free where the key sweep saw through it and all around (`RangeImage.sees_through`): by
    more than ``veto_m`` and ``veto_fraction`` in at least six of the nine cells around. Only the
    key's rays count: other sweeps rightly saw through the place where a mover was not yet.
    """
    frames, inverse = np.unique(cloud.frame, return_inverse=True)
    sweep: NDArray[np.int32] = inverse.ravel().astype(np.int32)
    if wanted is None:
        wanted = np.ones(len(cloud), bool)
    places = [origins[int(f)] for f in frames]
    normal, spacing_m = (shared or Tangents()).of(cloud, sweep, wanted, sensors, places)
    free = np.zeros(len(cloud), bool)
    other = np.flatnonzero(wanted & (cloud.frame != key))
    if key_image is not None and len(other):
        points = cloud.points.take(other, axis=0)
        velocity_m_s = cloud.velocity_m_s.take(other, axis=0)
        free[other] = vetoed(points, velocity_m_s, key_image, settings)
    return Patches(normal, spacing_m, free, sweep, np.full(len(cloud), -1, np.int32))


def vetoed(
    points: Float, velocity_m_s: Float32, key_image: RangeImage, settings: ProjectSettings
) -> Bool:
    """(N,3) of other sweeps at the key's moment, key frame -> (N,) where the key sweep saw through
    them."""
    return key_image.sees_through(
        points,
        settings.veto_m,
        settings.veto_fraction,
        _MIN_FILLED,
        velocity_m_s,
    )


def tangents(
    points: Float,
    lidar: NDArray[np.uint8],
    sweep: NDArray[np.int32],
    wanted: Bool,
    sensors: Sensors,
    origins: Sequence[Float],
) -> tuple[Float32, Float32]:
    """Normals (M,3) and spacings (M,2) of the points ``wanted`` (M,), scanner by scanner and sweep
    by sweep.

    points: (M,3), rigidly registered. lidar: (M,) which scanner. sweep: (M,) which of ``origins``,
    (S,3) each.
    """
    normal = np.zeros((len(points), 3), np.float32)
    spacing_m = np.zeros((len(points), 2), np.float32)
    if not len(points):
        return normal, spacing_m
    num_scanners = len(origins[0])
    place = (sweep * num_scanners + lidar).astype(np.int32)
    seen = np.empty((3, len(points)), np.float32)
    kernels.look.over_rows(len(points), points, np.concatenate(origins), place, seen)
    size = np.bincount(place, minlength=num_scanners * len(origins))
    members = np.split(np.argsort(place, kind="stable"), np.cumsum(size)[:-1])
    for number, model in sensors.models.items():
        grid = model.grid
        cells = np.empty((grid.num_rows, grid.num_columns), np.int32)
        find = kernels.tangents_anywhere if model.unordered else kernels.tangents_on_rings
        for mine in members[number::num_scanners]:
            kernels.nearest_in_cells(seen, mine, grid, cells)
            mine = mine[wanted[mine]]
            find.over_rows(len(mine), mine, seen, model.table, grid, cells, normal, spacing_m)
    return normal, spacing_m
