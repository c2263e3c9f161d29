# SPDX-License-Identifier: MIT
"""Estimate scene flow between any two clouds, of moving groups or by the published objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.flow.objective import checked_cloud, flow_between
from densify.flow.pair_groups import PairCloud, find_movers
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.nearest import nearest, tree_of
from densify.geometry.types import Float, FlowField, Int, Motion, Stretch

_MAX_EXTENT_M = 400.0  # of the points that are searched, from the middle
_MIN_LOW_M = 0.04  # least height of points below a moving group
_SCANNERS_APART_M = 1000.0  # lifts each scanner's points out of reach of the others'
_BELOW_M = 0.3  # horizontal distance of points below a moving group


def estimate_flow(
    source: ArrayLike,
    target: ArrayLike,
    config: Config | str | Path | Mapping[str, Any] | None = None,
    initial: ArrayLike | None = None,
    source_offset_ns: ArrayLike | None = None,
    target_offset_ns: ArrayLike | None = None,
    source_lidar: ArrayLike | None = None,
    target_lidar: ArrayLike | None = None,
) -> FlowField:
    """Estimate the scene flow between two clouds in one coordinate frame.

    The flow excludes ego-motion, provided that the common frame does not move with the vehicle.
    Groups of points move only if their motion explains, in both clouds, differences that a static
    group leaves unexplained. The flow of all other points is exactly 0, also farther than 400 m
    from the middle. Without ``objective.static_prior`` every point takes the flow of the published
    objective. With ``flow.engine=paper`` the moving groups take it.

    Args:
        source: (N,3) metres, z up, with or without the ground.
        target: (M,3) metres, as ``source``.
        config: Settings; the sections ``flow`` and ``objective`` are used.
        initial: (N,3) flow to start from. It is needed only for objects faster than the search
            covers: 38 m/s over the time between the clouds, at most 0.4 s; 3.8 m without times.
        source_offset_ns: (N,) times of the points. Both clouds use one clock, or each counts from
            its own sweep's reference time; in the second case the target is taken for the next
            revolution. Without times, the flow is too slow or too fast for an object that the
            scanner meets earlier or later in the second sweep.
        target_offset_ns: (M,) times of the points, both or none.
        source_lidar: (N,) numbers of the points' scanners. Without times, points are compared
            within a scanner only.
        target_lidar: (M,) numbers of the points' scanners, both or none.

    Returns:
        Flow from the middle of the source's times to the target's middle, in the common frame. With
            times, ``to_reference`` is the motion from a point's own time to the source's middle.
    """
    settings = resolve(config)
    if settings.flow.engine not in ("groups", "paper"):
        raise InputError(
            f"flow.engine: got {settings.flow.engine!r}, expected groups or paper: two clouds "
            "alone are no recording"
        )
    clouds = checked_cloud(source, "source"), checked_cloud(target, "target")
    times = _shares(_columns(source_offset_ns, target_offset_ns, clouds, "offset_ns"))
    lidars = _columns(source_lidar, target_lidar, clouds, "lidar")
    if not settings.objective.static_prior or settings.flow.engine == "paper":
        return flow_between(*clouds, settings.objective, initial)
    start = None if initial is None else checked_cloud(initial, "initial")
    if start is not None and start.shape != clouds[0].shape:
        raise InputError(
            f"initial: got shape {start.shape}, expected the source's {clouds[0].shape}"
        )
    return _flow_of_groups(clouds, start, times, lidars)


def _flow_of_groups(
    clouds: tuple[Float, Float],
    initial: Float | None,
    times: tuple[list[Float], float] | None,
    lidars: tuple[Int, Int] | None,
) -> FlowField:
    middle = np.median(clouds[0], axis=0)  # map coordinates lose nothing
    points = [cloud - middle for cloud in clouds]
    inside = [np.flatnonzero((np.abs(p[:, :2]) < _MAX_EXTENT_M).all(1)) for p in points]
    points_inside = [p[rows] for p, rows in zip(points, inside, strict=True)]
    ground = HeightMap.of(points_inside)
    heights_m = [ground.above(p) for p in points_inside]
    above = [rows[h >= ABOVE_GROUND_M] for rows, h in zip(inside, heights_m, strict=True)]
    field = FlowField.zero(len(clouds[0]))
    if not (len(above[0]) and len(above[1])):
        return field
    share, apart_s = times or ([np.full(len(c), float(i)) for i, c in enumerate(clouds)], None)
    if lidars is not None and times is None:  # each measures an object at another time
        _, number = np.unique(np.concatenate(lidars), return_inverse=True)
        for cloud, lidar in zip(points, np.split(number, [len(clouds[0])]), strict=True):
            cloud[:, 2] += _SCANNERS_APART_M * lidar
    source, target = (PairCloud(points[i][rows], share[i][rows]) for i, rows in enumerate(above))
    start = None if initial is None else initial[above[0]]
    height_m = heights_m[0][heights_m[0] >= ABOVE_GROUND_M]
    motions, field.instance[above[0]] = find_movers(
        source, target, height_m, ground, apart_s, start
    )
    low = (heights_m[0] < ABOVE_GROUND_M) & (heights_m[0] > _MIN_LOW_M)
    _attach_below(points[0], field, inside[0][low])
    to_reference = np.zeros_like(clouds[0])
    for k, motion in enumerate(motions):
        rows = np.flatnonzero(field.instance == k)
        measured = points[0][rows]
        at_reference = motion.undo(measured, share[0][rows])
        field.displacement[rows] = motion.place(at_reference, 1.0) - at_reference
        to_reference[rows] = at_reference - measured
    field.moving[:] = field.instance >= 0
    return field if times is None else replace(field, to_reference=to_reference)


def _attach_below(points: Float, field: FlowField, low: Int) -> None:
    """Assign points ``low`` (indices) just below a moving group to the group, in place."""
    members = np.flatnonzero(field.instance >= 0)
    if len(members) and len(low):
        _, row = nearest(tree_of(points[members, :2]), points[low, :2], _BELOW_M)
        field.instance[low[row >= 0]] = field.instance[members[row[row >= 0]]]


def _columns(
    source: ArrayLike | None, target: ArrayLike | None, clouds: tuple[Float, Float], name: str
) -> tuple[Int, Int] | None:
    """Return two clouds' values as int64 (N,) and (M,), None if none; InputError if wrong."""
    if source is None and target is None:
        return None
    columns = []
    for values, cloud, side in zip((source, target), clouds, ("source", "target"), strict=True):
        if values is None:
            raise InputError(
                f"{side}_{name}: not given, but the other cloud's is; give both or neither"
            )
        column = np.asarray(values)
        if column.shape != (len(cloud),) or column.dtype.kind not in "iu":
            raise InputError(
                f"{side}_{name}: got shape {column.shape} and type {column.dtype}, expected "
                f"({len(cloud)},) whole numbers, one for each point"
            )
        columns.append(column.astype(np.int64))
    return columns[0], columns[1]


def _shares(times_ns: tuple[Int, Int] | None) -> tuple[list[Float], float] | None:
    """Return firing times as shares of the time between the clouds, and this time (s)."""
    if times_ns is None:
        return None
    low, high = (np.array([int(limit(times)) for times in times_ns]) for limit in (np.min, np.max))
    middle = low + (high - low) // 2
    span_ns, gap_ns = int((high - low).max()), int(middle[1] - middle[0])
    if 2 * abs(gap_ns) < span_ns:
        gap_ns = span_ns  # each from its own reference time: the next revolution
    if gap_ns == 0:
        return None
    # 0 at the middle of the source's times, 1 at the middle of the target's
    shares = [
        i + (times - m) / gap_ns for i, (times, m) in enumerate(zip(times_ns, middle, strict=True))
    ]
    return shares, abs(gap_ns) * 1e-9


# --- The engine ``pairs``


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Chain the flow of neighbouring sweeps: the engine ``pairs``, for recordings of two sweeps."""
    of_groups = replace(settings, flow=replace(settings.flow, engine="groups"))

    def step(i: int, j: int) -> FlowField:
        return _step(scene.stretch, i, j, of_groups)

    return ChainedMotion(scene.stretch, step)


def _step(stretch: Stretch, i: int, j: int, settings: Config) -> FlowField:
    """Return the flow of sweep ``i`` to the reference time of ``j``, lidar frame."""
    pair = [stretch.sweeps[k] for k in (i, j)]
    sweeps = [s.sweep for s in pair]
    if min(map(len, sweeps)) == 0:
        return FlowField.zero(len(sweeps[0]))
    source, target = (poses.transform(s.T_world_lidar, s.sweep.points) for s in pair)
    times_ns = [s.offset_ns for s in sweeps]
    apart_ns = sweeps[1].stamp_ns - sweeps[0].stamp_ns
    if times_ns[0] is None or times_ns[1] is None:
        times_ns = [None, None]
    else:
        times_ns[1] = times_ns[1] + apart_ns
    lidars = [s.lidar for s in sweeps] if any(s.lidar.any() for s in sweeps) else [None, None]
    field = estimate_flow(source, target, settings, None, *times_ns, *lidars)
    R_lidar_world = pair[0].T_world_lidar[:3, :3].T
    displacement = field.displacement @ R_lidar_world.T
    to_reference = None
    if field.to_reference is not None and times_ns[0] is not None:
        # It leads to the middle of the firing times, which need not be the stamp of a sweep.
        middle_ns = int(times_ns[0].min()) + np.ptp(times_ns[0]) / 2
        to_reference = field.to_reference @ R_lidar_world.T - displacement * (middle_ns / apart_ns)
    return replace(field, displacement=displacement, to_reference=to_reference)
