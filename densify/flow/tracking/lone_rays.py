# SPDX-License-Identifier: MIT
"""Rings and columns of rays on one object that are too far apart to be linked: on a roof or a side
that falls away from the scanner they are more than a metre apart. Followed alone, a ring or a
column would stay where the rays are, whatever the object does; here is told which belong to one
that is followed already.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.flow.tracking.candidates import LINK_M, Obstacles
from densify.flow.tracking.shapes import Shape
from densify.free_space.sensor import Sensors
from densify.geometry.linking import link
from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, Int

_GAP_IN_LINE_M, _LONGEST_GAP_M = 1.5, 4.0
_COLUMNS_IN_GAP = 2.0
_SIDE_M = 0.1
_ONE_RING = 0.5  # steps of rings between its lowest and highest return
_ONE_COLUMN = 2.5  # steps of columns between its rightmost and leftmost return


def few_rays(c: Obstacles, rows: np.ndarray, T_lidar_world: Float, sensors: Sensors) -> Bool:
    """(N,) whether the clusters of these rows of candidates, not far from each other, are each seen
    by one ring, or by one column of rays, only.

    T_lidar_world: (4,4) of the sweep. sensors: how far apart the rays are.
    """
    if not len(rows):
        return np.zeros(0, bool)
    members = np.flatnonzero(np.isin(c.cluster, c.cluster[rows]))
    in_lidar = transform(T_lidar_world, c.points[members])
    cluster, num = c.cluster[members], c.num_clusters
    elevation_rad = np.arctan2(in_lidar[:, 2], np.linalg.norm(in_lidar[:, :2], axis=1))
    ring_rad = np.full(num, np.inf)
    gap_rad = sensors.finest_gap_m(in_lidar) / np.linalg.norm(in_lidar, axis=1)
    np.minimum.at(ring_rad, cluster, gap_rad)
    x, y = in_lidar[:, :2].mean(axis=0)
    azimuth_rad = np.arctan2(in_lidar[:, :2] @ [-y, x], in_lidar[:, :2] @ [x, y])
    single: Bool = _spread(elevation_rad, cluster, num) < _ONE_RING * ring_rad
    single |= _spread(azimuth_rad, cluster, num) < _ONE_COLUMN * _column_rad(sensors)
    return single[c.cluster[rows]]


def gap_in_line_m(place: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """How far apart along its way parts of one object may be seen that no ring links. Arguments as
    `columns_apart_m`."""
    columns_m = _COLUMNS_IN_GAP * columns_apart_m(place, ahead, T_lidar_world, sensors)
    return float(np.clip(columns_m, _GAP_IN_LINE_M, _LONGEST_GAP_M))


def columns_apart_m(place: Float, ahead: Float, T_lidar_world: Float, sensors: Sensors) -> float:
    """How far apart columns of rays meet a side: the farther the more it falls away from the
    scanner.

    place: (3,) of the side, world. ahead: (2,) along it. T_lidar_world: (4,4) of the sweep.
    """
    in_lidar = transform(T_lidar_world, place[None])[0, :2]
    x, y = _unit(T_lidar_world[:2, :2] @ ahead)
    aside_m = max(abs(float(in_lidar @ [-y, x])), 1e-3)
    return _column_rad(sensors) * float(in_lidar @ in_lidar) / aside_m


def in_line(shape: Shape, points: Float, ahead: Float) -> Bool:
    """(N,3) points in the object's frame -> (N,) whether they are no farther aside and no higher
    than it is wide and high. ahead: (2,) where it moves to in that frame, of any length."""
    x, y = _unit(ahead)
    side, own = points[:, :2] @ [-y, x], shape.rim[:, :2] @ [-y, x]
    inside: Bool = (side > own.min() - _SIDE_M) & (side < own.max() + _SIDE_M)
    return inside & (points[:, 2] < shape.rim[:, 2].max() + _SIDE_M)


def linked_in_line(shape: Shape, bodies: Sequence[Float], ahead: Float, gap_m: float) -> list[Bool]:
    """Which points of the sweeps, (N,3) each in the object's frame, hang together with it, over
    wider gaps ``gap_m`` along its way than aside."""
    way = _unit(ahead)
    points = np.concatenate([shape.points, *bodies])
    points[:, :2] -= (1 - LINK_M / gap_m) * (points[:, :2] @ way)[:, None] * way
    _, group = link(points, LINK_M)
    linked = np.isin(group, group[: len(shape.points)])
    ends = np.cumsum([len(shape.points), *map(len, bodies)])
    return np.split(linked, ends[:-1])[1:]


def _spread(values: Float, cluster: Int, num: int) -> Float:
    """(num,) from the least to the greatest value of each cluster; below 0 of those without."""
    low, high = np.full((2, num), np.inf) * [[1], [-1]]
    np.minimum.at(low, cluster, values)
    np.maximum.at(high, cluster, values)
    return high - low


def _column_rad(sensors: Sensors) -> float:
    """Between columns of rays, of the scanner with the closest."""
    return min(model.azimuth_step_rad for model in sensors.models.values())


def _unit(ahead: Float) -> Float:
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-6))
