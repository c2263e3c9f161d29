# SPDX-License-Identifier: MIT
"""Estimate scene flow between any two clouds in one frame.

Either rigid groups that certainly move have flow, or all points have the flow of the published
objective.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from densify.config import Config, ObjectiveSettings, resolve
from densify.config.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.flow.objective.graph import checked_cloud
from densify.flow.objective.solvers import SolverSettings, solve
from densify.flow.pairs.hypotheses import PairCloud
from densify.flow.pairs.movers import find_movers
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.linking import link
from densify.geometry.nearest import nearest, tree_of
from densify.geometry.types import Float, FlowField, Int, Motion, Stretch, Sweep

_LEAST_MOTION_M = 0.15
_LINK_M = 0.6
_MIN_POINTS = 8
_REACH_M = 0.5
_MIN_GAIN_M = 0.07
_MAX_EXTENT_M = 400.0
_MIN_LOW_M = 0.04
_BELOW_M = 0.3
_MIDDLE_M = 3.0  # closer points have no direction from a scanner
_MIN_AGREEMENT, _MAX_SINGLE = 0.8, 0.3


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
        target: (M,3) metres, in the same frame.
        config: Settings; the sections ``flow`` and ``objective`` are used.
        initial: (N,3) flow to start from. It is needed only for objects faster than the search
            covers: 38 m/s over the time between the clouds, at most 0.4 s; 3.8 m without times.
        source_offset_ns: (N,) time of each point. Give the times of both clouds, or no times. Both
            clouds use one clock, or each counts from its own sweep's reference time; in the second
            case the target is taken for the next revolution. Without times, the flow is too slow or
            too fast for an object that the scanner meets earlier or later in the second sweep.
        target_offset_ns: (M,) time of each point.
        source_lidar: (N,) number of the scanner that measured each point. Give both clouds' numbers
            or none. Without times, points are compared within a scanner only.
        target_lidar: (M,) number of the scanner that measured each point.

    Returns:
        Flow from the middle of the source's times to the target's middle, in the common frame. With
            times, ``to_reference`` is the motion from a point's own time to the source's middle.

    Raises:
        InputError: No points, a wrong shape, NaN, or an engine that needs a recording.
    """
    settings = resolve(config)
    if settings.flow.engine not in ("groups", "paper"):
        raise InputError(
            f"flow.engine: got {settings.flow.engine!r}, expected groups or paper: two clouds "
            "alone are no recording"
        )
    clouds = checked_cloud(source, "source"), checked_cloud(target, "target")
    times = _times(_columns(source_offset_ns, target_offset_ns, clouds, "offset_ns"))
    lidars = _columns(source_lidar, target_lidar, clouds, "lidar")
    if lidars is None and times is not None:
        lidars = _tell_scanners(clouds, times.lag)
    if not settings.objective.static_prior or settings.flow.engine == "paper":
        return flow_between(*clouds, settings.objective, initial)
    start = None if initial is None else checked_cloud(initial, "initial")
    if start is not None and start.shape != clouds[0].shape:
        raise InputError(
            f"initial: got shape {start.shape}, expected the source's {clouds[0].shape}"
        )
    return _flow_of_groups(clouds, settings, start, times, lidars)


def flow_between(
    source: ArrayLike,
    target: ArrayLike,
    settings: ObjectiveSettings,
    initial: ArrayLike | None = None,
) -> FlowField:
    """Return the flow (N,3) of a source cloud to a target, by the published objective.

    Source: Pontes, Hays, Lucey, 3DV 2020. With ``static_prior`` only groups that certainly move
    have flow. The arguments are as in `estimate_flow`; ``settings`` is its section ``objective``.
    """
    objective = SolverSettings(
        solver=settings.solver,
        alpha=settings.alpha,
        num_neighbors=settings.num_neighbors,
    )
    flow = solve(source, target, objective, initial).flow
    if settings.static_prior:
        return _only_proven(np.asarray(source, float), np.asarray(target, float), flow)
    still = FlowField.zero(len(flow))
    return replace(still, displacement=flow, moving=np.ones(len(flow), bool))


def _flow_of_groups(
    clouds: tuple[Float, Float],
    settings: Config,
    initial: Float | None,
    times: _Times | None,
    lidars: tuple[Int, Int] | None,
) -> FlowField:
    middle = np.median(clouds[0], axis=0)  # map coordinates lose nothing
    points = [cloud - middle for cloud in clouds]
    inside = [np.flatnonzero((np.abs(p[:, :2]) < _MAX_EXTENT_M).all(1)) for p in points]
    near = [p[rows] for p, rows in zip(points, inside, strict=True)]
    ground = HeightMap.of(near)
    heights_m = [ground.above(p) for p in near]
    above = [rows[h >= ABOVE_GROUND_M] for rows, h in zip(inside, heights_m, strict=True)]
    field = FlowField.zero(len(clouds[0]))
    if not (len(above[0]) and len(above[1])):
        return field
    lag = times.lag if times else (np.zeros(len(clouds[0])), np.zeros(len(clouds[1])))
    source, target = (
        PairCloud(points[i][rows], lag[i][rows], None if lidars is None else lidars[i][rows])
        for i, rows in enumerate(above)
    )
    start = None if initial is None else initial[above[0]]
    apart_s = times.apart_s if times else None
    motions, field.instance[above[0]] = find_movers(source, target, ground, start, apart_s)
    low = (heights_m[0] < ABOVE_GROUND_M) & (heights_m[0] > _MIN_LOW_M)
    _attach_below(points[0], field, inside[0][low])
    to_reference = np.zeros_like(clouds[0])
    for k, motion in enumerate(motions):
        rows = np.flatnonzero(field.instance == k)
        measured = points[0][rows]
        at_reference = motion.carry(measured, -lag[0][rows])
        field.displacement[rows] = motion.carry(measured, 1 - lag[0][rows]) - at_reference
        to_reference[rows] = at_reference - measured
    field.moving[:] = field.instance >= 0
    return field if times is None else replace(field, to_reference=to_reference)


def _attach_below(points: Float, field: FlowField, low: Int) -> None:
    """Assign points ``low`` (indices) just below a moving group to the group, in place."""
    members = np.flatnonzero(field.instance >= 0)
    if len(members) and len(low):
        _, row = nearest(tree_of(points[members, :2]), points[low, :2], _BELOW_M)
        field.instance[low[row >= 0]] = field.instance[members[row[row >= 0]]]


def _tell_scanners(clouds: tuple[Float, Float], lag: tuple[Float, Float]) -> tuple[Int, Int] | None:
    """Return (N,) and (M,) scanner numbers 0 or 1 for two scanners half a turn apart, else None.

    A spinning scanner has a phase: time plus or minus azimuth is constant over its points. If the
    phases of two scanners are half a turn apart, only the doubled phases agree.

    Args:
        clouds: The (N,3) and (M,3) points.
        lag: (N,) and (M,) firing times as a share of the time between the clouds (whole turns).
    """
    both = np.concatenate(clouds)
    far = np.hypot(both[:, 0], both[:, 1]) > _MIDDLE_M
    share = max(float(np.ptp(late)) for late in lag)  # of a sweep in the time between the clouds
    if not far.any() or share <= 0:
        return None
    turned = np.concatenate(lag) * (2 * np.pi * max(1, round(1 / share)))
    azimuth = np.arctan2(both[:, 1], both[:, 0])
    for phase in (turned + azimuth, turned - azimuth):
        doubled = np.exp(2j * phase[far]).mean()
        if abs(doubled) < _MIN_AGREEMENT or abs(np.exp(1j * phase[far]).mean()) > _MAX_SINGLE:
            continue
        lidar = (np.cos(phase - np.angle(doubled) / 2) < 0).astype(np.int64)
        return lidar[: len(clouds[0])], lidar[len(clouds[0]) :]
    return None


def _columns(
    source: ArrayLike | None, target: ArrayLike | None, clouds: tuple[Float, Float], name: str
) -> tuple[Int, Int] | None:
    """Return (N,) and (M,) values of two clouds' points as int64, None if not given.

    Raises InputError if only one cloud has values, or their shape or type is wrong.
    """
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


class _Times(NamedTuple):
    """The firing times of two clouds.

    Attributes:
        lag: (N,) and (M,) times after the middle of the own cloud's times, in units of ``apart_s``.
        apart_s: Seconds from the middle of one cloud's times to the middle of the other's.
    """

    lag: tuple[Float, Float]
    apart_s: float


def _times(times_ns: tuple[Int, Int] | None) -> _Times | None:
    """Return the times of two clouds from (N,) and (M,) ns, None if unknown or equal."""
    if times_ns is None:
        return None
    low, high = (np.array([int(of(times)) for times in times_ns]) for of in (np.min, np.max))
    middle = low + (high - low) // 2
    span, gap = int((high - low).max()), int(middle[1] - middle[0])
    if 2 * abs(gap) < span:
        gap = span  # each from its own reference time: the next revolution
    if gap == 0:
        return None
    first, second = ((times - m) / gap for times, m in zip(times_ns, middle, strict=True))
    return _Times((first, second), abs(gap) * 1e-9)


def _only_proven(source: Float, target: Float, flow: Float) -> FlowField:
    """Keep the flow (N,3) of groups of source points that fit the target better if moved.

    The fit is tested from group to target and back. All other points get flow 0.
    """
    field = FlowField.zero(len(source))
    moved = np.flatnonzero(np.linalg.norm(flow, axis=1) > _LEAST_MOTION_M)
    num_groups, group = link(source[moved], _LINK_M)
    trees = cKDTree(source), cKDTree(target)
    instance = 0
    for k in range(num_groups):
        rows = moved[group == k]
        if len(rows) < _MIN_POINTS:
            continue
        if _beats_standing_still(source[rows], target, flow[rows], trees):
            field.displacement[rows] = flow[rows]
            field.moving[rows] = True
            field.instance[rows] = instance
            instance += 1
    return field


def _beats_standing_still(
    group: Float, target: Float, flow: Float, trees: tuple[cKDTree, cKDTree]
) -> bool:
    """Return True if the group's common translation fits the target better than no motion.

    The free flow of each point cannot decide this, because it always comes closer to the target.
    """
    source_tree, target_tree = trees
    arrived = group + np.median(flow, axis=0)

    def mean_distance(tree: cKDTree, points: Float) -> float:
        return float(np.minimum(tree.query(points)[0], _REACH_M).mean())

    reached = np.unique(np.concatenate(target_tree.query_ball_point(arrived, _REACH_M))).astype(int)
    if not len(reached):
        return False
    forward = mean_distance(target_tree, group) - mean_distance(target_tree, arrived)
    there = target[reached]
    backward = mean_distance(source_tree, there) - mean_distance(cKDTree(arrived), there)
    return min(forward, backward) >= _MIN_GAIN_M


# --- The engine ``pairs``


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Chain the flow of neighbouring sweeps: the engine ``pairs``, for recordings of two sweeps.

    As `densify.flow.engines.EngineModule`; takes no argument.
    """
    of_groups = replace(settings, flow=replace(settings.flow, engine="groups"))

    def step(here: int, there: int) -> FlowField:
        return _step(scene.stretch, here, there, of_groups)

    return ChainedMotion(scene.stretch, step)


def _step(stretch: Stretch, here: int, there: int, settings: Config) -> FlowField:
    """Return the flow of sweep ``here`` to the reference time of ``there``, lidar frame."""
    pair = [stretch.sweeps[i] for i in (here, there)]
    sweeps = [s.sweep for s in pair]
    if min(map(len, sweeps)) == 0:
        return FlowField.zero(len(sweeps[0]))
    source, target = (poses.transform(s.T_world_lidar, s.sweep.points) for s in pair)
    times_ns = _offsets_ns(*sweeps)
    lidars = [s.lidar for s in sweeps] if any(s.lidar.any() for s in sweeps) else [None, None]
    field = estimate_flow(source, target, settings, None, *times_ns, *lidars)
    R_lidar_world = pair[0].T_world_lidar[:3, :3].T
    displacement = field.displacement @ R_lidar_world.T
    to_reference = None
    if field.to_reference is not None and times_ns[0] is not None:
        # It leads to the middle of the firing times, which need not be the stamp of a sweep.
        late = int(times_ns[0].min()) + np.ptp(times_ns[0]) / 2
        apart_ns = sweeps[1].stamp_ns - sweeps[0].stamp_ns
        to_reference = field.to_reference @ R_lidar_world.T - displacement * (late / apart_ns)
    return replace(field, displacement=displacement, to_reference=to_reference)


def _offsets_ns(source: Sweep, target: Sweep) -> tuple[Int | None, Int | None]:
    """Return firing times (N,) and (M,) since the source's reference time, None if unknown."""
    if source.offset_ns is None or target.offset_ns is None:
        return None, None
    return source.offset_ns, target.offset_ns + (target.stamp_ns - source.stamp_ns)
