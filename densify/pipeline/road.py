# SPDX-License-Identifier: MIT
"""Find static surfaces along the road, measured by sweeps beyond the window."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, cast

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.depth import far
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.compiled import num_threads
from densify.geometry.types import (
    Camera,
    Float,
    RegisteredSweep,
    StandingWorld,
    Stretch,
    Trajectory,
)
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline
from densify.registration.alignment import Surface
from densify.registration.deskew import deskew_sweep, twists
from densify.registration.road_poses import follow_road, num_in_submap, relax_poses

_STEP_M = 2.0  # usual distance along the road between the sweeps that are used
_MIN_STEP_M = 0.5 * _STEP_M  # least distance between them
_MAX_S = 15.0  # greatest time on each side; a parked vehicle observes nothing new
_SAME_VIEW_M = 3.0  # keys closer than this share a view
_UNSEEN_SHARE = 0.5  # of far_m where no camera looks: those sweeps are farther from what is seen
_SLACK_M = 4.0  # motion of a lidar within a sweep, and of a camera until its exposure


class _RoadSweep(NamedTuple):
    """A sweep along the road."""

    # Returns in view of a camera, with the pose; deskewed if ``in_window``, else raw
    registered: RegisteredSweep
    # Surface of all returns, deskewed, in the lidar frame; None with recorded poses
    surface: Surface | None
    travel_m: float  # distance along the road from the window's first sweep, negative before it
    in_window: bool  # true if the sweep is in the window, where poses are known

    def deskewed(self) -> RegisteredSweep:
        """Return the returns in view of a camera, deskewed."""
        if self.in_window:
            return self.registered
        return deskew_sweep(
            self.registered.sweep,
            self.registered.T_world_lidar,
            self.registered.twist_before,
            self.registered.twist_after,
        )


class _RelaxedRoad(NamedTuple):
    """The sweeps along the road with corrected poses."""

    sweeps: list[_RoadSweep]
    unreliable: frozenset[int]  # frames of the sweeps whose poses stay unreliable


@dataclass(frozen=True)
class Road:
    """The road before and after a window."""

    timeline: Timeline  # times of the recording's sweeps
    sweeps: Sweeps  # reader of the raw sweeps
    settings: RegisterSettings  # settings of registration
    # Distance along the road on each side of the window where a camera looks. Half of it is covered
    # where no camera looks.
    far_m: float
    window: Stretch  # deskewed sweeps of the window
    views: Sequence[tuple[Camera, Float]]  # cameras with their poses ``T_cam_world`` (4,4)

    def find_static_surfaces(self, with_window: bool) -> StandingWorld:
        """Return the static surfaces along the road, in the world of the window.

        Only points that one of the views may see are kept.

        Args:
            with_window: Include the points of the window's own sweeps.
        """
        window_sweeps = self._thin_window()
        sweeps_before, sweeps_after = sides = list[_RoadSweep](), list[_RoadSweep]()
        with ThreadPoolExecutor(num_threads()) as pool:
            list(pool.map(partial(self._collect_side, sides), (-1, 1)))
        road = _RelaxedRoad([*sweeps_before[::-1], *window_sweeps, *sweeps_after], frozenset())
        # Odometry drifts along the road, recorded poses do not.
        has_odometry = bool(self._surfaces)
        if has_odometry and len(road.sweeps) > 1:
            road = self._relax(road.sweeps)

        used = [
            road_sweep
            for road_sweep in road.sweeps
            if (with_window or not road_sweep.in_window)
            and road_sweep.registered.frame not in road.unreliable
        ]
        travel_m = np.array([road_sweep.travel_m for road_sweep in used])
        static_points = partial(far.static_points, Sensors.of(self.window.sweeps))
        with ThreadPoolExecutor(num_threads()) as pool:
            deskewed = list(pool.map(_RoadSweep.deskewed, used))
            seen_through = far.find_seen_through(deskewed, travel_m)
            static_surfaces = list(pool.map(static_points, deskewed, seen_through))
        left_out = tuple(sorted(road.unreliable))
        return replace(far.join_worlds(static_surfaces), left_out=left_out)

    @cached_property
    def _surfaces(self) -> dict[int, Surface]:
        """The surfaces of the window's sweeps by frame, {} with recorded poses."""
        if self.settings.source == "dataset":
            return {}
        sweeps = [registered.sweep for registered in self.window.sweeps]
        with ThreadPoolExecutor(num_threads()) as pool:
            surfaces = pool.map(Surface.of_sweep, sweeps)
            return dict(zip(self.window.frames, surfaces, strict=True))

    @cached_property
    def _travel_m(self) -> Float:
        """The (n,) distances along the road, from the first sweep of the window to each."""
        positions = np.stack([registered.T_world_lidar[:3, 3] for registered in self.window.sweeps])
        return np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())

    def _thin_window(self) -> list[_RoadSweep]:
        """Return the window's sweeps, thinned to at least 1 m between sweeps."""
        road_sweeps = list[_RoadSweep]()
        last_used_m = -np.inf
        for registered, travel_m in zip(self.window.sweeps, self._travel_m.tolist(), strict=True):
            if travel_m - last_used_m >= _MIN_STEP_M:
                last_used_m = travel_m
                surface = self._surfaces.get(registered.frame)
                in_view = self._select_in_view(registered)
                road_sweeps.append(_RoadSweep(in_view, surface, travel_m, in_window=True))
        return road_sweeps

    def _collect_side(self, sides: Sequence[list[_RoadSweep]], side: int) -> None:
        """Collect the sweeps before (side -1) or after (side 1) the window, nearest first."""
        end_of_window = self.window.sweeps[0 if side < 0 else -1]
        begin_m = 0.0 if side < 0 else self._travel_m[-1]
        reach_m = self.far_m if self._is_seen(side) else _UNSEEN_SHARE * self.far_m
        most_sweeps = round(2 * self.far_m / _STEP_M)  # of both sides
        position = end_of_window.T_world_lidar[:3, 3]
        last_used_m = travel_m = 0.0  # both from the end of the window
        for registered, surface in self._register_side(side, reach_m):
            travel_m += float(np.linalg.norm(registered.T_world_lidar[:3, 3] - position))
            position = registered.T_world_lidar[:3, 3]
            if travel_m - last_used_m < _MIN_STEP_M:
                continue
            last_used_m = travel_m
            in_view = self._select_in_view(registered)
            road_m = begin_m + side * travel_m
            sides[side > 0].append(_RoadSweep(in_view, surface, road_m, in_window=False))
            num_sweeps = sum(map(len, sides))
            self.sweeps.watch.report("far", num_sweeps, max(num_sweeps, most_sweeps))

    def _is_seen(self, side: int) -> bool:
        """Return True if a camera may see the road's end before (side -1) or after the window."""
        first, last = (self.window.sweeps[row].T_world_lidar[:3, 3] for row in (0, -1))
        length_m = float(np.linalg.norm(last - first))
        if length_m < _MIN_STEP_M:  # at rest the direction of the road is unknown
            return True
        to_end = side * self.far_m * (last - first) / length_m
        road_end = ((last if side > 0 else first) + to_end)[None].astype(np.float32)
        return any(far.may_see(*view, road_end, _SLACK_M).any() for view in self.views)

    def _register_side(
        self, side: int, reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, Surface | None]]:
        """Yield each raw sweep before or after the window, with its surface, nearest first."""
        window_sweeps = self.window.sweeps[::side]  # the last one is at the end of the window
        end_of_window = window_sweeps[-1]
        frames_beside = self.timeline.before if side < 0 else self.timeline.after
        frames = frames_beside(end_of_window.frame, self._max_sweeps(reach_m))[::side]
        if not self._surfaces:
            return self._follow_recorded(end_of_window, frames, reach_m)
        stamp_ns = np.array([self.timeline.stamp_of(frame) for frame in frames], np.int64)
        surfaces = [self._surfaces[registered.frame] for registered in window_sweeps]
        return follow_road(
            window_sweeps, surfaces, frames, stamp_ns, self.sweeps.read, reach_m, _STEP_M
        )

    def _max_sweeps(self, reach_m: float) -> int:
        """Return the number of sweeps that cover a distance at half the speed of the window."""
        first, last = self.window.sweeps[0], self.window.sweeps[-1]
        max_s = _MAX_S
        duration_ns = last.sweep.stamp_ns - first.sweep.stamp_ns
        if duration_ns > 0:
            travel = last.T_world_lidar[:3, 3] - first.T_world_lidar[:3, 3]
            speed_m_s = float(np.linalg.norm(travel)) / (1e-9 * duration_ns)
            max_s = min(max_s, 2 * reach_m / max(speed_m_s, 1e-3))
        return int(max_s * 1e9 / self.timeline.period_ns)

    def _follow_recorded(
        self, end_of_window: RegisteredSweep, frames: Sequence[int], reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, None]]:
        """Yield the sweeps of `_register_side` at the recording's own poses."""
        travel_m = last_used_m = 0.0
        T_last = end_of_window.T_world_lidar
        last_ns = end_of_window.sweep.stamp_ns
        try:
            recorded_pose = self._recorded_pose(end_of_window.frame)
            T_world_recorded = T_last @ poses.inverse(recorded_pose)
            for frame in frames:
                T = T_world_recorded @ self._recorded_pose(frame)
                stamp_ns = self.timeline.stamp_of(frame)
                twist = poses.twist_between(T_last, T, (stamp_ns - last_ns) * 1e-9)
                travel_m += float(np.linalg.norm(T[:3, 3] - T_last[:3, 3]))
                T_last = T
                last_ns = stamp_ns
                if travel_m > reach_m:
                    return
                if travel_m - last_used_m >= _MIN_STEP_M:
                    last_used_m = travel_m
                    yield RegisteredSweep(self.sweeps.read(frame), T, twist, twist), None
        except InputError:  # the road ends without a pose or a sweep
            return

    def _recorded_pose(self, frame: int) -> Float:
        """Return the recorded ``T_world_lidar`` (4,4) of a sweep; raise InputError without one."""
        return cast(Float, self.sweeps.recorded_pose(frame))

    def _relax(self, road_sweeps: Sequence[_RoadSweep]) -> _RelaxedRoad:
        """Return the sweeps with poses corrected by `relax_poses`."""
        frames = tuple(road_sweep.registered.frame for road_sweep in road_sweeps)
        num_points = float(np.median([len(registered.sweep) for registered in self.window.sweeps]))
        relaxed = relax_poses(
            [cast(Surface, road_sweep.surface) for road_sweep in road_sweeps],
            np.stack([road_sweep.registered.T_world_lidar for road_sweep in road_sweeps]),
            np.array([road_sweep.in_window for road_sweep in road_sweeps]),
            num_in_submap(num_points),
        )
        stamps_ns = [road_sweep.registered.sweep.stamp_ns for road_sweep in road_sweeps]
        stamp_ns = np.array(stamps_ns, np.int64)
        trajectory = Trajectory(frames, stamp_ns, relaxed.T_world_lidar)

        corrected = list[_RoadSweep]()
        for i, road_sweep in enumerate(road_sweeps):
            if not road_sweep.in_window:  # poses of the window stay
                T = relaxed.T_world_lidar[i]
                sweep = road_sweep.registered.sweep
                registered = RegisteredSweep(sweep, T, *twists(trajectory, i))
                road_sweep = road_sweep._replace(registered=registered)
            corrected.append(road_sweep)
        unreliable = (
            frame for frame, holds in zip(frames, relaxed.is_reliable, strict=True) if not holds
        )
        return _RelaxedRoad(corrected, frozenset(unreliable))

    def _select_in_view(self, registered: RegisteredSweep) -> RegisteredSweep:
        """Return a sweep with only those returns that one of the views may see."""
        sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
        in_view = np.zeros(len(sweep), bool)
        # Each view tests only the returns that no view before it may see.
        rows = np.flatnonzero(far.in_reach(sweep))
        points = sweep.points[rows].astype(np.float32)
        for camera, T_cam_world in self.views:
            may_see = far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
            in_view[rows[may_see]] = True
            rows = rows[~may_see]
            points = points[~may_see]
        return replace(registered, sweep=sweep.select(in_view))


def choose_views(
    cameras: Collection[Camera], window: Stretch, keys: Sequence[int]
) -> list[tuple[Camera, Float]]:
    """Return cameras with their ``T_cam_world`` (4,4); keys less than 3 m apart share a view."""
    chosen: list[Float] = []
    for T_world_lidar in (window[key].T_world_lidar for key in keys):
        last = chosen[-1] if chosen else None
        if last is None or np.linalg.norm(last[:3, 3] - T_world_lidar[:3, 3]) > _SAME_VIEW_M:
            chosen.append(T_world_lidar)
    return [(camera, camera.T_cam_lidar @ poses.inverse(T)) for camera in cameras for T in chosen]
