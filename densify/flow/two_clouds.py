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
from densify.flow.engines import ChainedMotion, Scene
from densify.flow.graph import checked_cloud
from densify.flow.objective import flow_between
from densify.flow.pair_groups import PairCloud, find_movers
from densify.free_space.ground import ABOVE_GROUND_M, HeightMap
from densify.geometry import poses
from densify.geometry.nearest import nearest, tree_of
from densify.geometry.types import Float, FlowField, Int, Motion, RegisteredSweep

_MAX_EXTENT_M = 400.0  # greatest distance in x and y, from the middle, of searched points
_MIN_LOW_M = 0.04  # least height of points below a moving group: lower ones are of the road
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
    group leaves unexplained. The flow of all other points is exactly 0, as is that of points
    farther than 400 m from the middle. Without ``objective.static_prior`` every point takes the
    flow of the published objective. With ``flow.engine=paper`` the moving groups take that flow.
    The published objective uses neither times nor scanners.

    Args:
        source: (N,3) metres, z up, with or without the ground.
        target: (M,3) metres, in the frame of the source, z up, with or without the ground.
        config: Settings, None for the defaults; ``flow.engine`` and ``objective`` are used.
        initial: (N,3) flow to start from, metres, None for no guess. A guess is needed only for
            objects faster than the search covers: 38 m/s over the time between the clouds, at most
            0.4 s; 3.8 m without times.
        source_offset_ns: (N,) times of the points, None if unknown. Both clouds use one clock, or
            each counts from its own sweep's reference time. In the second case the target is taken
            for the next revolution. Without times, the flow is too slow or too fast for an object
            that the scanner meets earlier or later in the second sweep.
        target_offset_ns: (M,) times of the points, given if those of the source are.
        source_lidar: (N,) numbers of the points' scanners, None for one scanner. Without times,
            points are compared within a scanner only.
        target_lidar: (M,) numbers of the points' scanners, given if those of the source are.

    Returns:
        Flow from the middle of the source's times to the target's middle, metres, in the common
            frame. With times, ``to_reference`` is the motion from a point's own time to the
            source's middle.

    Raises:
        InputError: A setting, a shape or a type does not fit, or a cloud is empty or not finite.
    """
    settings = resolve(config)
    if settings.flow.engine not in ("groups", "paper"):
        raise InputError(
            f"flow.engine: got {settings.flow.engine!r}, expected groups or paper: two clouds "
            "alone are no recording"
        )
    clouds = checked_cloud(source, "source"), checked_cloud(target, "target")
    times_ns = _columns(source_offset_ns, target_offset_ns, clouds, "offset_ns")
    lidars = _columns(source_lidar, target_lidar, clouds, "lidar")
    # Without the static prior every point needs a flow of its own, as the objective gives it.
    if not settings.objective.static_prior or settings.flow.engine == "paper":
        return flow_between(*clouds, settings.objective, initial)
    initial_flow = None if initial is None else checked_cloud(initial, "initial")
    if initial_flow is not None and initial_flow.shape != clouds[0].shape:
        raise InputError(
            f"initial: got shape {initial_flow.shape}, expected the source's {clouds[0].shape}"
        )
    return _flow_of_groups(clouds, initial_flow, times_ns, lidars)


def _flow_of_groups(
    clouds: tuple[Float, Float],
    initial: Float | None,
    times_ns: tuple[Int, Int] | None,
    lidars: tuple[Int, Int] | None,
) -> FlowField:
    """Return the flow of the groups of the source that certainly move, 0 for other points."""
    # Coordinates of a map are large. Relative to the middle they lose no accuracy.
    middle = np.median(clouds[0], axis=0)
    points = [cloud - middle for cloud in clouds]

    # Phase 1: the obstacles of both clouds, which are points above their common ground
    near_rows = [np.flatnonzero((np.abs(cloud[:, :2]) < _MAX_EXTENT_M).all(1)) for cloud in points]
    near_points = [cloud[rows] for cloud, rows in zip(points, near_rows, strict=True)]
    ground = HeightMap.of(near_points)
    heights_m = [ground.above(cloud) for cloud in near_points]
    is_obstacle = [height_m >= ABOVE_GROUND_M for height_m in heights_m]
    source_rows, target_rows = (
        rows[mask] for rows, mask in zip(near_rows, is_obstacle, strict=True)
    )
    field = FlowField.zero(len(clouds[0]))
    if not (len(source_rows) and len(target_rows)):
        return field

    # Phase 2: the moving groups
    shares, apart_s = _times_as_shares(clouds, times_ns)
    source_share, target_share = shares
    if apart_s is None and lidars is not None:
        _separate_scanners(points, lidars)
    source_points, target_points = points
    motions, instance = find_movers(
        source=PairCloud(source_points[source_rows], source_share[source_rows]),
        target=PairCloud(target_points[target_rows], target_share[target_rows]),
        height_m=heights_m[0][is_obstacle[0]],
        ground=ground,
        apart_s=apart_s,
        initial=None if initial is None else initial[source_rows],
    )
    field.instance[source_rows] = instance
    is_low = ~is_obstacle[0] & (heights_m[0] > _MIN_LOW_M)
    _attach_below(source_points, field, near_rows[0][is_low])

    # Phase 3: the flow of the groups from the source's middle time to the target's
    to_reference = np.zeros_like(clouds[0])
    for k, motion in enumerate(motions):
        rows = np.flatnonzero(field.instance == k)
        measured = source_points[rows]
        at_reference = motion.undo(measured, source_share[rows])
        field.displacement[rows] = motion.place(at_reference, 1.0) - at_reference
        to_reference[rows] = at_reference - measured
    field.moving[:] = field.instance >= 0
    return field if apart_s is None else replace(field, to_reference=to_reference)


def _separate_scanners(clouds: list[Float], lidars: tuple[Int, Int]) -> None:
    """Lift the points of each scanner by another height, in place."""
    # Without times, the points of two scanners cannot be compared: each measures an object at
    # another time. Lifted by multiples of 1 km, the scanners are out of reach of each other.
    _, scanner = np.unique(np.concatenate(lidars), return_inverse=True)
    for cloud, number in zip(clouds, np.split(scanner, [len(clouds[0])]), strict=True):
        cloud[:, 2] += 1000.0 * number


def _attach_below(points: Float, field: FlowField, low_rows: Int) -> None:
    """Assign points ``low_rows`` (K,) that lie below a moving group to the group, in place."""
    members = np.flatnonzero(field.instance >= 0)
    if len(members) and len(low_rows):
        _, nearest_member = nearest(tree_of(points[members, :2]), points[low_rows, :2], _BELOW_M)
        is_below = nearest_member >= 0
        field.instance[low_rows[is_below]] = field.instance[members[nearest_member[is_below]]]


def _columns(
    source: ArrayLike | None, target: ArrayLike | None, clouds: tuple[Float, Float], name: str
) -> tuple[Int, Int] | None:
    """Return the values of two clouds' points as int64 (N,) and (M,); None if both are None."""
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


def _times_as_shares(
    clouds: tuple[Float, Float], times_ns: tuple[Int, Int] | None
) -> tuple[tuple[Float, Float], float | None]:
    """Convert firing times (N,) and (M,) to shares of the time between the clouds.

    Shares are 0 at the middle of the source's times, 1 at the target's. The second value is the
    time between the clouds in seconds; None without times, or if all are equal.
    """
    unknown = (np.zeros(len(clouds[0])), np.ones(len(clouds[1]))), None
    if times_ns is None:
        return unknown
    first_ns = np.array([int(np.min(cloud_ns)) for cloud_ns in times_ns])
    last_ns = np.array([int(np.max(cloud_ns)) for cloud_ns in times_ns])
    middle_ns = first_ns + (last_ns - first_ns) // 2
    revolution_ns = int((last_ns - first_ns).max())
    apart_ns = int(middle_ns[1] - middle_ns[0])
    if 2 * abs(apart_ns) < revolution_ns:
        # Middles closer than half a sweep: each cloud counts from its own reference time, and the
        # target is the next revolution.
        apart_ns = revolution_ns
    if apart_ns == 0:
        return unknown
    source_share = (times_ns[0] - middle_ns[0]) / apart_ns
    target_share = 1 + (times_ns[1] - middle_ns[1]) / apart_ns
    return (source_share, target_share), abs(apart_ns) * 1e-9


# --- The engine ``pairs``


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Return the motion of the engine ``pairs``: chained `estimate_flow` of neighbouring sweeps."""
    # The engine ``groups`` is the default of `estimate_flow`, which does not know ``pairs``.
    pair_settings = replace(settings, flow=replace(settings.flow, engine="groups"))

    def step(i: int, j: int) -> FlowField:
        sweeps = scene.stretch.sweeps
        return _flow_to_neighbour(sweeps[i], sweeps[j], pair_settings)

    return ChainedMotion(scene.stretch, step)


def _flow_to_neighbour(
    source: RegisteredSweep, target: RegisteredSweep, settings: Config
) -> FlowField:
    """Return the flow of a sweep to the reference time of another, in its own lidar frame."""
    if min(len(source.sweep), len(target.sweep)) == 0:
        return FlowField.zero(len(source.sweep))
    source_ns, target_ns = source.sweep.offset_ns, target.sweep.offset_ns
    apart_ns = target.sweep.stamp_ns - source.sweep.stamp_ns
    if source_ns is None or target_ns is None:
        source_ns = target_ns = None
    else:
        target_ns = target_ns + apart_ns  # now both count from the stamp of the source
    has_scanners = source.sweep.lidar.any() or target.sweep.lidar.any()
    field = estimate_flow(
        poses.transform(source.T_world_lidar, source.sweep.points),
        poses.transform(target.T_world_lidar, target.sweep.points),
        settings,
        source_offset_ns=source_ns,
        target_offset_ns=target_ns,
        source_lidar=source.sweep.lidar if has_scanners else None,
        target_lidar=target.sweep.lidar if has_scanners else None,
    )
    R_world_lidar = source.T_world_lidar[:3, :3]
    displacement = field.displacement @ R_world_lidar
    to_reference = None
    if field.to_reference is not None and source_ns is not None:
        # The flow's reference is the middle of the firing times. The stamp may be another time.
        middle_ns = int(source_ns.min()) + np.ptp(source_ns) / 2
        to_reference = field.to_reference @ R_world_lidar - displacement * (middle_ns / apart_ns)
    return replace(field, displacement=displacement, to_reference=to_reference)
