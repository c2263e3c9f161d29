# SPDX-License-Identifier: MIT
"""Run the scene flow engine that the settings name, and chain flow between neighbouring sweeps.

`densify.config.plugins` lists all engines. Flow is chained from k to k±1 and on to the target.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, cast

import numpy as np

from densify.config import Config
from densify.config.plugins import engine
from densify.flow.tracking.candidates import Obstacles, find_candidates
from densify.free_space.ground import HeightMap
from densify.free_space.range_image import FreeSpace
from densify.geometry import poses
from densify.geometry.nearest import nearest_k, tree_of
from densify.geometry.types import Float, FlowField, Int, Motion, Stretch


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of a scene flow engine: registered sweeps in one world, with ground and free space."""

    stretch: Stretch  # consecutive registered sweeps
    ground: HeightMap  # height map of the ground under all sweeps
    # Frame numbers whose flow is needed, None for all. The other sweeps only help to find motion.
    asked: Collection[int] | None = None

    @cached_property
    def space(self) -> FreeSpace:
        """The free space that each sweep observed."""
        return FreeSpace.of(self.stretch)

    @cached_property
    def obstacles(self) -> tuple[Obstacles, ...]:
        """The points above the ground of each sweep, with a mark at points that may move."""
        return find_candidates(self.stretch, self.space, self.ground)

    def is_asked(self, i: int) -> bool:
        """Return True if the flow of the sweep with index i is needed."""
        return self.asked is None or self.stretch.sweeps[i].frame in self.asked


class SharedMotion(Motion, Protocol):
    """Motion of a long stretch that serves every key frame in it."""

    # A dataclass, which the disk cache stores without the points of its sweeps

    def with_stretch(self, stretch: Stretch) -> SharedMotion:
        """Return the same motion on another copy of its stretch; a cached copy has no points."""
        ...


class EngineModule(Protocol):
    """The functions of an engine's module.

    A module may also have ``check_argument(argument: str) -> None``. It is called before anything
    is computed, and raises InputError for a bad argument.
    """

    def estimate_motion(self, scene: Scene, settings: Config, argument: str) -> Motion:
        """Return the motion of all points in the scene; the same input gives the same bytes.

        ``argument`` is the text after the colon in ``flow.engine``, "" without a colon. Work may
        wait until the motion's ``flow`` is called. An engine that is registered as ``shared``
        returns a `SharedMotion`.
        """
        ...


def estimate_motion(scene: Scene, settings: Config, spec: str | None = None) -> Motion:
    """Return the motion of all points in a scene, by one scene flow engine.

    The engine ``spec`` is ``NAME`` or ``NAME:ARGUMENT``; None takes that of the settings.

    Raises:
        InputError: No engine has this name, or the engine rejects the argument.
    """
    plugin, argument = engine(spec or settings.flow.engine)
    module = cast(EngineModule, plugin.load_module())
    return module.estimate_motion(scene, settings, argument)


def check_engine(spec: str) -> None:
    """Import an engine ``NAME[:ARGUMENT]``, and raise InputError for a bad name or argument."""
    plugin, argument = engine(spec)
    check = getattr(plugin.load_module(), "check_argument", None)
    if check is not None:
        check(argument)


# Singular value (m, the root of the sum of squares) of the scatter across a line, below which
# points count as on the line: they do not determine a rotation about it.
_LINE_M = 0.05
_MAX_GAP_M = 0.5  # greatest distance to a moving point that continues a flow


@dataclass(frozen=True)
class ChainedMotion:
    """Motion of a stretch, chained from flow between neighbouring sweeps: a `Motion`."""

    stretch: Stretch  # consecutive registered sweeps
    # Function that returns the flow of sweep index i to index j = i ± 1, in the lidar frame of
    # sweep i. It is called on demand, once for each (i, j).
    step: Callable[[int, int], FlowField]
    _flows: dict[tuple[int, int], FlowField] = field(default_factory=dict, repr=False)

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of all points of sweep ``frame`` to the reference time of ``target``.

        The flow excludes ego-motion, and is in the lidar frame of ``frame``. At each sweep on the
        way, points of an object continue with its rigid motion, plus the mean non-rigid
        displacement of the nearest three points of the object. Other moving points continue with
        the mean flow of the nearest three of their kind. A point is lost if its object has no
        points in the next sweep, or, without an object, if none of its kind is within 0.5 m.

        The flow to ``frame`` itself is 0, with the labels of the step to a neighbouring sweep.
        """
        i, j = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        if i != j:
            return self._flow(i, j)
        num_sweeps = len(self.stretch.sweeps)
        if num_sweeps == 1:
            return FlowField.zero(len(self.stretch.sweeps[i].sweep))
        step = self._flow(i, i + 1 if i + 1 < num_sweeps else i - 1)
        return replace(step, displacement=np.zeros_like(step.displacement))

    def _flow(self, i: int, j: int) -> FlowField:
        """Return the flow of the sweep with index i to that with index j; each pair is cached."""
        if (i, j) not in self._flows:
            neighbour = i + (1 if j > i else -1)  # next to sweep i, towards j
            if neighbour == j:
                step, sweeps = self.step(i, j), self.stretch.sweeps
                duration_s = (sweeps[j].sweep.stamp_ns - sweeps[i].sweep.stamp_ns) * 1e-9
                flow = replace(step, velocity_m_s=step.displacement / duration_s)
            else:
                flow = self._follow(i, neighbour, self._flow(neighbour, j))
            self._flows[i, j] = flow
        return self._flows[i, j]

    def _follow(self, i: int, neighbour: int, onward: FlowField) -> FlowField:
        """Chain the flow of sweep i to its neighbour with ``onward``, the neighbour's flow."""
        step = self._flow(i, neighbour)
        sweep, next_sweep = self.stretch.sweeps[i], self.stretch.sweeps[neighbour]
        T_next_lidar = self.stretch.T_target_source(next_sweep.frame, sweep.frame)
        R_next_lidar = T_next_lidar[:3, :3]
        displacement, lost = step.displacement.copy(), step.lost.copy()
        velocity_m_s = np.zeros_like(displacement)
        # (M,3) points of the neighbour at its reference time. The total flow is the motion from the
        # firing time to the reference time, plus the displacement from this time to the target.
        next_points = next_sweep.sweep.points + onward.total - onward.displacement
        for instance in np.unique(step.instance[step.moving]):
            rows = np.flatnonzero(step.moving & (step.instance == instance))
            next_rows = np.flatnonzero(onward.moving & ~onward.lost & (onward.instance == instance))
            if not len(next_rows):
                lost[rows] = True
                continue
            # Positions to which the step brings the points, and members of their instance there
            arrived = poses.transform(T_next_lidar, sweep.sweep.points[rows] + step.total[rows])
            members = next_points[next_rows]
            gap_m, nearest = nearest_k(tree_of(members), arrived, 3)
            weight = 1 / (gap_m + 1e-3)  # 1 mm avoids a division by 0
            weight /= weight.sum(axis=1, keepdims=True)
            member_flow = onward.displacement[next_rows]
            if instance >= 0:
                onward_flow = _flow_with_object(arrived, members, member_flow, nearest, weight)
            else:
                # Instance -1 holds moving points without an object. They need not move alike.
                onward_flow = _mean(member_flow, nearest, weight)
                lost[rows[gap_m[:, 0] > _MAX_GAP_M]] = True
            # From the axes of the neighbour to those of sweep i: row vectors times R turn back.
            displacement[rows] += onward_flow @ R_next_lidar
            if onward.velocity_m_s is not None:
                next_velocity_m_s = onward.velocity_m_s[next_rows]
                velocity_m_s[rows] = _mean(next_velocity_m_s, nearest, weight) @ R_next_lidar
        return replace(step, displacement=displacement, lost=lost, velocity_m_s=velocity_m_s)


def _flow_with_object(
    positions: Float, members: Float, member_flow: Float, nearest: Int, weight: Float
) -> Float:
    """Return the (N,3) flow at positions (N,3) on an object with flow at its members (M,3).

    ``nearest`` (N,k) are the rows of the members around each position, with ``weight`` (N,k).
    """
    member_targets = members + member_flow
    T = _object_motion(members, member_targets)
    non_rigid = member_targets - poses.transform(T, members)
    return poses.transform(T, positions) - positions + _mean(non_rigid, nearest, weight)


def _object_motion(source: Float, target: Float) -> Float:
    """Return the (4,4) rigid motion that best moves points (N,3) to target positions (N,3)."""
    if np.linalg.matrix_rank(source - source.mean(axis=0), tol=_LINE_M) < 2:
        # Fewer than three points, or points on a line, do not determine a rotation.
        T = np.eye(4)
        T[:3, 3] = (target - source).mean(axis=0)
        return T
    return poses.fit_rigid(source, target)


def _mean(values: Float, rows: Int, weight: Float) -> Float:
    """Return the (N,3) means of values (M,3) at rows (N,k), with weights (N,k) that sum to 1."""
    return np.asarray(np.einsum("nk,nkj->nj", weight, values[rows]))
