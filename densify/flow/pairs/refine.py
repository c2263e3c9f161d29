# SPDX-License-Identifier: MIT
"""Motions refined until an object's surfaces, brought to one time, are thin.

The rings of a scanner lie elsewhere on an object that has moved, and nearest points, content with
any ring, hold it back; where two scanners share a sweep it is there twice, half of the motion
apart, and they are content between. A plane through the points around, several rings of them, is
not: it lets a surface slide along itself, and the other surfaces say how far (as surfel maps are
registered: Stückler and Behnke, "Multi-Resolution Surfel Maps", JVCI 2014; here the planes are made
anew in every step, from whatever else was measured of the object, each point at its own time).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from densify.flow.pairs.hypotheses import (
    PairCloud,
    RigidMotion,
    one_per_voxel,
    slope_of,
    thinned,
)
from densify.flow.pairs.thinness import settle
from densify.free_space.ground import HeightMap
from densify.geometry.nearest import tree_of
from densify.geometry.types import Bool, Float, Int

_MIN_POINTS = 40  # fewer show no surfaces
_MAX_POINTS = 600  # of each cloud; of 400 the thickness hangs on how the axes lie
_SIDE_M = 0.06
_REACH_M, _MAX_REACH_M, _WIDER = 0.4, 1.0, 1.5
_MIN_PLANES = 0.6  # share of points that must have one
_GATES_M, _LAST_GATES_M = np.array([0.3, 0.3, 0.3, 0.2, 0.2]), np.array([0.15, 0.15, 0.1, 0.1, 0.1])
_NO_GATES = np.zeros(0)
_STANDING = np.zeros(4)
_LIMIT_M = 0.15
_MAX_THICK_M = 0.09  # thicker ones are sparse or no surfaces: nothing is learnt from them
_MAX_WEIGHT = 60.0
_PRECISION = np.array([1e3, 1e3, 3e5, 1e4])  # 1/m² from where it starts; 1/rad²
_SHIFTS_M = (0.3, -0.3)
_FACTORS = (2.0, 2 / 3)  # where one appearance was taken for the other
_CLEARLY = 0.9  # how much thinner another start must come out,
_SURELY = 0.95  # and the refined motion where times are not known
_NEAR_M = 0.5  # of where the object may arrive
_ARRIVED_POINTS = 300


class Refined(NamedTuple):
    """A motion, and how thick it leaves the object's surfaces (m), as a share of how thick they are
    if it stands besides; None where too few points lie on surfaces."""

    motion: RigidMotion
    thickness_m: float | None = None
    of_standing: float | None = None


def refined(
    motion: RigidMotion,
    members: Int,
    source: PairCloud,
    target: PairCloud,
    candidates: Int,
    ground: HeightMap,
    timed: bool,
) -> Refined:
    """The motion of the source's ``members`` where that makes the object thinner, else as it is.

    candidates: rows of the target that may be the object's. timed: lags are known: every scanner's
    points are compared with those of all others, each at its own time; otherwise with the other
    cloud's, of the same scanner if that is known.
    """
    if len(members) < _MIN_POINTS:
        return Refined(motion)
    starts = _starts(motion, slope_of(ground, motion.centre), source, timed)
    places = [replace(motion, state=s) for s in (*starts, _STANDING)]
    near = _arrivals(places, members, source, target, candidates)
    if len(near) < _MIN_POINTS:
        return Refined(motion)
    surfaces = _Surfaces.of(motion.centre, members, near, source, target, timed)
    while surfaces.settled(starts[0], _NO_GATES)[2] <= _MIN_PLANES:
        if surfaces.reach_m * _WIDER > _MAX_REACH_M:
            return Refined(motion)
        surfaces = replace(surfaces, reach_m=surfaces.reach_m * _WIDER)
    best, thick_m = starts[0], np.inf
    for start in starts:
        state, found_m, _ = surfaces.settled(start, _GATES_M)
        if found_m < _CLEARLY * thick_m:
            best, thick_m = state, found_m
    best, thick_m, _ = surfaces.settled(best, _LAST_GATES_M)
    _, before_m, _ = surfaces.settled(motion.state, _NO_GATES)
    enough_m = before_m if timed else _SURELY * before_m
    _, standing_m, _ = surfaces.settled(_STANDING, _NO_GATES)
    if thick_m < min(enough_m, _MAX_THICK_M):
        motion, before_m = replace(motion, state=best), thick_m
    return Refined(motion, before_m, before_m / max(standing_m, _SIDE_M * 1e-3))


def _starts(motion: RigidMotion, slope: Float, source: PairCloud, timed: bool) -> list[Float]:
    """Where to begin, on the ground: at the motion, and where it may have been held back from."""
    way = motion.state[:2]
    length_m = np.linalg.norm(way)
    factors = (1.0, *(1 + shift / length_m for shift in _SHIFTS_M if length_m + shift > 0))
    if not timed and source.lidar is None:
        factors += _FACTORS
    ways = [way * factor for factor in factors]
    yaws = [motion.state[3]] + [0.0] * (len(ways) - 1)
    return [np.array([*w, w @ slope, yaw]) for w, yaw in zip(ways, yaws, strict=True)]


def _arrivals(
    motions: list[RigidMotion],
    members: Int,
    source: PairCloud,
    target: PairCloud,
    candidates: Int,
) -> Int:
    """Which of the target's candidates are near where one of the motions takes the members."""
    points = source.points[thinned(members, _ARRIVED_POINTS)]
    arrived = np.concatenate([motion.seen(points) for motion in motions])
    low, high = arrived.min(0) - _NEAR_M, arrived.max(0) + _NEAR_M
    at = target.points[candidates]
    box = candidates[((at > low) & (at < high)).all(1)]
    far, _ = tree_of(arrived).query(target.points[box], distance_upper_bound=_NEAR_M)
    near: Int = box[np.isfinite(far)]
    return near


@dataclass(frozen=True)
class _Surfaces:
    """An object's points in both clouds, see `densify.flow.pairs.thinness.settle`."""

    points: Float
    share: Float
    sampling: Int
    judges: Bool
    centre: Float
    reach_m: float

    @staticmethod
    def of(
        centre: Float, here: Int, there: Int, source: PairCloud, target: PairCloud, timed: bool
    ) -> _Surfaces:
        here, there = _evenly(source, here), _evenly(target, there)
        cloud = np.repeat([0, 1], [len(here), len(there)])
        lidar = np.zeros_like(cloud)
        if source.lidar is not None and target.lidar is not None:
            lidars = np.concatenate([source.lidar[here], target.lidar[there]])
            lidar = np.unique(lidars, return_inverse=True)[1].ravel()
        num_lidars = int(lidar.max()) + 1
        cloud_of, lidar_of = np.divmod(np.arange(2 * num_lidars), num_lidars)
        others = cloud_of[:, None] != cloud_of
        same = lidar_of[:, None] == lidar_of
        return _Surfaces(
            points=np.concatenate([source.points[here], target.points[there]]),
            share=np.concatenate([source.lag[here], 1 + target.lag[there]]),
            sampling=cloud * num_lidars + lidar,
            judges=others | ~same if timed else others & same,
            centre=centre,
            reach_m=_REACH_M,
        )

    def settled(self, start: Float, gates_m: Float) -> tuple[Float, float, float]:
        """The state after a step for each gate, how thick it leaves the surfaces (m), and the share
        of points that lie on one."""
        state, told = start.copy(), np.empty(2)
        settle(
            self.points,
            self.share,
            self.sampling,
            self.judges,
            self.centre,
            self.reach_m,
            gates_m,
            _LIMIT_M,
            _MAX_WEIGHT,
            _PRECISION,
            state,
            told,
        )
        return state, float(told[0]), float(told[1])


def _evenly(cloud: PairCloud, rows: Int) -> Int:
    """One of each scanner's points in a voxel, of the size that leaves few enough."""
    side_m = _SIDE_M
    while True:
        first = one_per_voxel(cloud.places(cloud.points[rows], rows), side_m)
        if len(first) <= _MAX_POINTS:
            return rows[first]
        side_m *= _WIDER
