# SPDX-License-Identifier: MIT
"""Rings of one object that are too far apart to be linked: on a roof that falls away from the
scanner they are more than a metre apart. Followed alone, a ring would stay where the rays are,
whatever the roof does; here is told which belong to an object that is followed already.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.flow.tracking.evidence import LINK_M, Standing
from densify.flow.tracking.shapes import Shape
from densify.geometry.poses import transform
from densify.geometry.sensor import Sensors
from densify.kernels.linking import link
from densify.types import Bool, Float

_GAP_IN_LINE_M = 1.5
_SIDE_M = 0.1
_ONE_RING = 0.5  # steps of rings between its lowest and highest return


def single_rings(c: Standing, rows: np.ndarray, T_lidar_world: Float, sensors: Sensors) -> Bool:
    """(N,) whether the clusters of these rows of candidates are each seen by one ring only.

    T_lidar_world: (4,4) of the sweep. sensors: how far apart the rings are.
    """
    members = np.flatnonzero(np.isin(c.cluster, c.cluster[rows]))
    in_lidar = transform(T_lidar_world, c.points[members])
    elevation_rad = np.arctan2(in_lidar[:, 2], np.linalg.norm(in_lidar[:, :2], axis=1))
    step_rad = sensors.finest_gap_m(in_lidar) / np.linalg.norm(in_lidar, axis=1)
    low, high, step = np.full((3, c.num_clusters), np.inf) * [[1], [-1], [1]]
    np.minimum.at(low, c.cluster[members], elevation_rad)
    np.maximum.at(high, c.cluster[members], elevation_rad)
    np.minimum.at(step, c.cluster[members], step_rad)
    single: Bool = (high - low < _ONE_RING * step)[c.cluster[rows]]
    return single


def in_line(shape: Shape, points: Float, ahead: Float) -> Bool:
    """(N,3) points in the object's frame -> (N,) whether they are no farther aside and no higher
    than it is wide and high. ahead: (2,) where it moves to in that frame, of any length."""
    x, y = _unit(ahead)
    side, own = points[:, :2] @ [-y, x], shape.rim[:, :2] @ [-y, x]
    inside: Bool = (side > own.min() - _SIDE_M) & (side < own.max() + _SIDE_M)
    return inside & (points[:, 2] < shape.rim[:, 2].max() + _SIDE_M)


def linked_in_line(shape: Shape, bodies: Sequence[Float], ahead: Float) -> list[Bool]:
    """Which points of the sweeps, (N,3) each in the object's frame, hang together with it, over
    wider gaps along its way than aside."""
    way = _unit(ahead)
    points = np.concatenate([shape.points, *bodies])
    points[:, :2] -= (1 - LINK_M / _GAP_IN_LINE_M) * (points[:, :2] @ way)[:, None] * way
    _, group = link(points, LINK_M)
    linked = np.isin(group, group[: len(shape.points)])
    ends = np.cumsum([len(shape.points), *map(len, bodies)])
    return np.split(linked, ends[:-1])[1:]


def _unit(ahead: Float) -> Float:
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-6))
