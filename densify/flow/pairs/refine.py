# SPDX-License-Identifier: MIT
"""Refine motions until the surfaces of an object, accumulated at one time, are thin.

After an object has moved, the rings of a scanner hit other parts of it. Nearest points match ring
to ring and hold the motion back. If two scanners share a sweep, an object appears twice, half of
the motion apart. Planes through several rings let a surface slide along itself, and the other
surfaces fix the slide (as in Stückler, Behnke, "Multi-Resolution Surfel Maps", JVCI 2014). Here the
planes are fitted again in every step, from all other points of the object, each at its own time.
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
from densify.free_space.ground import HeightMap
from densify.geometry.compiled import Kernel, inlined
from densify.geometry.nearest import tree_of
from densify.geometry.types import Bool, Float, Int

_MIN_POINTS = 40  # fewer points have no surfaces
_MAX_POINTS = 600  # of each cloud; with 400 points the thickness depends on the axes
_SIDE_M = 0.06
_REACH_M, _MAX_REACH_M, _WIDER = 0.4, 1.0, 1.5
_MIN_PLANES = 0.6  # least share of points with a plane
_GATES_M, _LAST_GATES_M = np.array([0.3, 0.3, 0.3, 0.2, 0.2]), np.array([0.15, 0.15, 0.1, 0.1, 0.1])
_NO_GATES = np.zeros(0)
_STANDING = np.zeros(4)
_LIMIT_M = 0.15
_MAX_THICK_M = 0.09  # thicker surfaces are too sparse to be evidence
_MAX_WEIGHT = 60.0
_MIN_NEIGHBORS = 6
_MIN_WIDTH_M2 = 0.05**2  # neighbours on one ring alone span no plane
_SIGMA_M2 = 0.02**2  # noise of a surface point
_PRECISION = np.array([1e3, 1e3, 3e5, 1e4])  # of the start state as a prior: 1/m², 1/rad²
_SHIFTS_M = (0.3, -0.3)
_FACTORS = (2.0, 2 / 3)  # starts for two confused appearances of an object
_CLEARLY = 0.9  # relative thickness below which another start is taken,
_SURELY = 0.95  # and below which a refined motion without known times is taken
_NEAR_M = 0.5  # around the positions at which the object may arrive
_ARRIVED_POINTS = 300


class Refined(NamedTuple):
    """A motion, and how thin the object's surfaces become when its points are moved by it.

    Attributes:
        motion: Motion from the source to the target.
        thickness_m: Mean distance of points from their surface; None for too few surface points.
        of_standing: ``thickness_m`` divided by the thickness of the unmoved points; None likewise.
    """

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
    """Return the refined motion of a group, or the given motion if its surfaces are thinner.

    Args:
        motion: Motion to start from.
        members: Indices of the group's points in ``source``.
        candidates: Indices in ``target`` of points that may belong to the object.
        timed: True if firing times are known. Then points of all scanners are compared, each at its
            own time. Otherwise points are compared with the other cloud, scanner by scanner.
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
    """Return states (4,) to start from: the motion's own, and shorter and longer displacements."""
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
    """Return those ``candidates`` (target indices) that are close to the members after a motion."""
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
    """The n points of an object in both clouds.

    Attributes:
        points: (n,3) measured positions.
        share: (n,) share of the motion at the time of each measurement.
        sampling: (n,) index of the point's combination of cloud and scanner.
        judges: (samplings, samplings) bool, True if points of the second combination define the
            surfaces from which points of the first are measured.
        centre: (3,) centre of the rotation.
        reach_m: Radius of the neighbourhood that defines a plane.
    """

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
        """Return the motion that makes the surfaces thin, from a start.

        Args:
            start: (4,) state x, y, z (m) and yaw (rad).
            gates_m: Distances, one for each step; points farther from their plane have no weight.

        Returns:
            The state (4,), the mean thickness (m), and the share of points that have a plane.
        """
        state, told = start.copy(), np.empty(2)
        _settle(
            self.points,
            self.share,
            self.sampling,
            self.judges,
            self.centre,
            self.reach_m,
            gates_m,
            _PRECISION,
            state,
            told,
        )
        return state, float(told[0]), float(told[1])


def _evenly(cloud: PairCloud, rows: Int) -> Int:
    """Return the indices ``rows``, thinned to one point of each scanner per voxel, at most 600."""
    side_m = _SIDE_M
    while True:
        first = one_per_voxel(cloud.places(cloud.points[rows], rows), side_m)
        if len(first) <= _MAX_POINTS:
            return rows[first]
        side_m *= _WIDER


@Kernel
def _settle(
    points: Float,
    share: Float,
    sampling: Int,
    judges: Bool,
    centre: Float,
    reach_m: float,
    gates_m: Float,
    precision: Float,
    state: Float,
    told: Float,
) -> None:
    """Move ``state`` (4,), in place, by Gauss-Newton steps until the surfaces are thin.

    A step for each of ``gates_m`` gives no weight to points farther from their plane. The prior at
    the start has the weight ``precision`` (4,), 1/m² and 1/rad². ``told`` (2,) is filled with the
    mean distance, at most ``_LIMIT_M``, and the share of points with a plane.
    """
    H, g = np.empty((4, 4)), np.empty(4)
    start, at = state.copy(), np.empty_like(points)
    for gate_m in gates_m:
        _bring_back(points, share, centre, state, at)
        total = _add_up(at, share, sampling, judges, centre, reach_m, gate_m, H, g, told)
        if total <= 0:
            break
        scale = min(1.0, _MAX_WEIGHT / total) / _SIGMA_M2
        for m in range(4):
            g[m] = scale * g[m] + precision[m] * (state[m] - start[m])
            for n in range(4):
                H[m, n] = scale * H[m, n] + precision[m] * (m == n)
        state -= np.linalg.solve(H, g)
    _bring_back(points, share, centre, state, at)
    _add_up(at, share, sampling, judges, centre, reach_m, _LIMIT_M, H, g, told)


@inlined
def _bring_back(points, share, centre, state, at):  # type: ignore[no-untyped-def]
    """Fill ``at`` (n,3) with the positions of the points at the source's reference time."""
    for i in range(len(points)):
        yaw = share[i] * state[3]
        c, s = np.cos(yaw), np.sin(yaw)
        dx = points[i, 0] - centre[0] - share[i] * state[0]
        dy = points[i, 1] - centre[1] - share[i] * state[1]
        at[i, 0] = c * dx + s * dy + centre[0]
        at[i, 1] = c * dy - s * dx + centre[1]
        at[i, 2] = points[i, 2] - share[i] * state[2]


@inlined
def _add(H, g, J, weight, off_m):  # type: ignore[no-untyped-def]
    """Add one residual ``off_m`` with derivatives J (4,) to the normal equations H, g, in place."""
    for m in range(4):
        g[m] += weight * J[m] * off_m
        for n in range(4):
            H[m, n] += weight * J[m] * J[n]


@inlined
def _add_up(at, share, sampling, judges, centre, reach_m, gate_m, H, g, told):  # type: ignore[no-untyped-def]
    """Fill the normal equations H, g and ``told``; return the sum of Tukey weights."""
    H[:], g[:] = 0.0, 0.0
    total, distance_m, num_planes, first = 0.0, 0.0, 0, 0
    J, C = np.empty(4), np.zeros((3, 3))
    order = np.argsort(at[:, 0])
    px, py, pz = at[order, 0], at[order, 1], at[order, 2]
    when, kind = share[order], sampling[order]
    for k in range(len(px)):
        x, y, z = px[k], py[k], pz[k]
        while x - px[first] > reach_m:
            first += 1
        W, t, num = 0.0, 0.0, 0
        mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
        for j in range(first, len(px)):
            dx = px[j] - x
            if dx > reach_m:
                break
            dy, dz = py[j] - y, pz[j] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared >= reach_m * reach_m or not judges[kind[k], kind[j]]:
                continue
            w = 1 - squared / (reach_m * reach_m)
            w *= w
            num, W, t = num + 1, W + w, t + w * when[j]
            mx += w * dx
            my += w * dy
            mz += w * dz
            xx += w * dx * dx
            xy += w * dx * dy
            xz += w * dx * dz
            yy += w * dy * dy
            yz += w * dy * dz
            zz += w * dz * dz
        if num < _MIN_NEIGHBORS:
            distance_m += _LIMIT_M
            continue
        t, mx, my, mz = t / W, mx / W, my / W, mz / W
        C[0, 0], C[1, 1], C[2, 2] = xx / W - mx * mx, yy / W - my * my, zz / W - mz * mz
        # Of a symmetric matrix the lower half is read.
        C[1, 0], C[2, 0], C[2, 1] = xy / W - mx * my, xz / W - mx * mz, yz / W - my * mz
        variances, axes = np.linalg.eigh(C)
        thick, a, b, c = max(variances[0], 0.0), axes[0, 0], axes[1, 0], axes[2, 0]
        if variances[1] < _MIN_WIDTH_M2:
            distance_m += _LIMIT_M
            continue
        off_m = -(a * mx + b * my + c * mz)
        distance_m += min(abs(off_m), _LIMIT_M)
        num_planes += 1
        if abs(off_m) >= gate_m:
            continue
        weight = (1 - (off_m / gate_m) ** 2) ** 2 * _SIGMA_M2 / (_SIGMA_M2 + thick)
        # The later the plane was measured than the point, the farther back it is.
        later = t - when[k]
        J[0], J[1], J[2] = a * later, b * later, c * later
        J[3] = (b * (x - centre[0]) - a * (y - centre[1])) * later
        total += weight
        _add(H, g, J, weight, off_m)
    told[0], told[1] = distance_m / len(px), num_planes / len(px)
    return total
