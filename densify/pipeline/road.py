# SPDX-License-Identifier: MIT
"""Find static surfaces along the road, measured by sweeps beyond the window."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import count
from typing import NamedTuple, cast

import numpy as np

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.depth import far
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.compiled import num_threads
from densify.geometry.types import Camera, Float, RegisteredSweep, StaticWorld, Stretch, Trajectory
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline
from densify.registration.deskew import deskew_sweep, twists
from densify.registration.odometry import Surface
from densify.registration.road_poses import follow_road, num_in_submap, relax_poses

_STEP_M = 2.0  # usual distance along the road between the sweeps that are used
_MIN_STEP_M = 0.5 * _STEP_M  # least distance between them: sweeps do not lie at exact steps
_MAX_S = 15.0  # greatest time on each side; a parked vehicle observes nothing new
_SAME_VIEW_M = 3.0  # distance between keys up to which they share a view
# Share of ``far_m`` that is used where no camera looks: farther sweeps measure little in view
_UNSEEN_SHARE = 0.5
# Greatest distance of a camera from its pose in the test of the view: the motion of a fast vehicle
# within a sweep and until the exposure
_SLACK_M = 4.0


class _RoadSweep(NamedTuple):
    """A sweep along the road."""

    # Returns in view of a camera, with the pose; deskewed if ``in_window``, else raw
    registered: RegisteredSweep
    # Surface of all returns, deskewed, in the lidar frame; None with recorded poses
    surface: Surface | None
    travel_m: float  # distance along the road from the window's first sweep, negative before it
    in_window: bool  # true if the sweep is in the window, whose poses are fixed

    def deskewed(self) -> RegisteredSweep:
        """Return the returns in view of a camera, deskewed."""
        if self.in_window:
            return self.registered
        raw = self.registered
        return deskew_sweep(raw.sweep, raw.T_world_lidar, raw.twist_before, raw.twist_after)


@dataclass(frozen=True)
class Road:
    """The road before (side -1) and after (side 1) a window."""

    timeline: Timeline  # times of the recording's sweeps
    sweeps: Sweeps  # reader of the raw sweeps
    settings: RegisterSettings  # settings of registration
    # Length of road that is used on each side of the window where a camera looks, and half of it
    # where none looks
    far_m: float
    window: Stretch  # deskewed sweeps of the window
    views: Sequence[tuple[Camera, Float]]  # cameras with their poses ``T_cam_world`` (4,4)

    def find_static_surfaces(self, with_window: bool) -> StaticWorld:
        """Return the static surfaces along the road, in the world of the window.

        The result has the points that one of the views may see and that no other sweep along the
        road saw through. ``left_out`` names the sweeps whose poses are unreliable.

        Args:
            with_window: Include the points of the window's own sweeps.
        """
        # Collect and register the sweeps, in the order of the road.
        window_sweeps = self._thin_window()
        numbers = count(1)  # running number of the sweeps of both sides, for the progress
        with ThreadPoolExecutor(num_threads()) as pool:
            sweeps_before, sweeps_after = pool.map(partial(self._collect_side, numbers), (-1, 1))
        road_sweeps = [*sweeps_before[::-1], *window_sweeps, *sweeps_after]
        # Odometry drifts along the road, recorded poses do not.
        left_out: tuple[int, ...] = ()
        if self._surfaces and len(road_sweeps) > 1:
            road_sweeps, left_out = self._relax(road_sweeps)

        # Keep the points of each sweep that no other sweep saw through.
        used = [
            road_sweep
            for road_sweep in road_sweeps
            if (with_window or not road_sweep.in_window)
            and road_sweep.registered.frame not in left_out
        ]
        travel_m = np.array([road_sweep.travel_m for road_sweep in used])
        static_points = partial(far.static_points, Sensors.of(self.window.sweeps))
        with ThreadPoolExecutor(num_threads()) as pool:
            deskewed = list(pool.map(_RoadSweep.deskewed, used))
            is_seen_through = far.find_seen_through(deskewed, travel_m)
            static_surfaces = list(pool.map(static_points, deskewed, is_seen_through))
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
        """The (W,) metres travelled from the window's first sweep to each of its W sweeps."""
        positions = np.stack([registered.T_world_lidar[:3, 3] for registered in self.window.sweeps])
        step_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        return np.append(0.0, step_m.cumsum())

    def _thin_window(self) -> list[_RoadSweep]:
        """Return the window's sweeps, thinned to at least 1 m of travel between two of them."""
        road_sweeps = list[_RoadSweep]()
        last_used_m = -np.inf  # the first sweep is used
        for registered, travel_m in zip(self.window.sweeps, self._travel_m.tolist(), strict=True):
            if travel_m - last_used_m >= _MIN_STEP_M:
                last_used_m = travel_m
                surface = self._surfaces.get(registered.frame)
                in_view = self._select_in_view(registered)
                road_sweeps.append(_RoadSweep(in_view, surface, travel_m, in_window=True))
        return road_sweeps

    def _collect_side(self, numbers: Iterator[int], side: int) -> list[_RoadSweep]:
        """Return the sweeps of one side of the window, nearest first, at least 1 m apart."""
        end_of_window = self.window.sweeps[0 if side < 0 else -1]
        end_travel_m = 0.0 if side < 0 else self._travel_m[-1]
        reach_m = self.far_m if self._may_see_end(side) else _UNSEEN_SHARE * self.far_m
        num_expected = round(2 * self.far_m / _STEP_M)  # sweeps of both sides
        road_sweeps = list[_RoadSweep]()
        last_position = end_of_window.T_world_lidar[:3, 3]
        from_window_m = 0.0  # travel from the end of the window to the sweep
        last_used_m = 0.0  # travel from the end of the window to the last sweep that is used
        for registered, surface in self._register_side(side, reach_m):
            position = registered.T_world_lidar[:3, 3]
            from_window_m += float(np.linalg.norm(position - last_position))
            last_position = position
            if from_window_m - last_used_m < _MIN_STEP_M:
                continue
            last_used_m = from_window_m
            in_view = self._select_in_view(registered)
            travel_m = end_travel_m + side * from_window_m
            road_sweeps.append(_RoadSweep(in_view, surface, travel_m, in_window=False))
            number = next(numbers)
            self.sweeps.watch.report("far", number, max(number, num_expected))
        return road_sweeps

    def _may_see_end(self, side: int) -> bool:
        """Return True if a camera may see the road's end on one side, taken as straight."""
        first, last = (self.window.sweeps[index].T_world_lidar[:3, 3] for index in (0, -1))
        length_m = float(np.linalg.norm(last - first))
        if length_m < _MIN_STEP_M:  # at rest the direction of the road is unknown
            return True
        to_end = side * self.far_m * (last - first) / length_m
        road_end = ((last if side > 0 else first) + to_end)[None].astype(np.float32)
        return any(far.may_see(*view, road_end, _SLACK_M).any() for view in self.views)

    def _register_side(
        self, side: int, reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, Surface | None]]:
        """Yield the raw sweeps of one side up to ``reach_m`` of travel, with their surfaces."""
        # Side -1 reverses time: the last window sweep is at the end of the window from which the
        # road is followed, and the frames come nearest first.
        window_sweeps = self.window.sweeps[::side]
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
        """Return the greatest number of sweeps of one side, whatever travel they cover."""
        first, last = self.window.sweeps[0], self.window.sweeps[-1]
        max_s = _MAX_S
        duration_ns = last.sweep.stamp_ns - first.sweep.stamp_ns
        if duration_ns > 0:
            travel = last.T_world_lidar[:3, 3] - first.T_world_lidar[:3, 3]
            speed_m_s = float(np.linalg.norm(travel)) / (1e-9 * duration_ns)
            # Outside the window the vehicle may be half as fast. At rest, _MAX_S is the limit.
            max_s = min(max_s, 2 * reach_m / max(speed_m_s, 1e-3))
        return int(max_s * 1e9 / self.timeline.period_ns)

    def _follow_recorded(
        self, end_of_window: RegisteredSweep, frames: Sequence[int], reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, None]]:
        """Yield the raw sweeps of one side up to ``reach_m`` of travel, at their recorded poses."""
        from_window_m = last_used_m = 0.0  # travel from the window to this and the last used sweep
        T_world_last = end_of_window.T_world_lidar
        last_ns = end_of_window.sweep.stamp_ns
        recorded_pose = cast(Callable[[int], Float], self.sweeps.recorded_pose)
        try:
            # The recording has a world of its own.
            T_world_recorded = T_world_last @ poses.inverse(recorded_pose(end_of_window.frame))
            for frame in frames:
                T_world_lidar = T_world_recorded @ recorded_pose(frame)
                stamp_ns = self.timeline.stamp_of(frame)
                # Back in time both motion and seconds are reversed: the velocity is the same.
                seconds = (stamp_ns - last_ns) * 1e-9
                twist = poses.twist_between(T_world_last, T_world_lidar, seconds)
                step = T_world_lidar[:3, 3] - T_world_last[:3, 3]
                from_window_m += float(np.linalg.norm(step))
                T_world_last = T_world_lidar
                last_ns = stamp_ns
                if from_window_m > reach_m:
                    return
                if from_window_m - last_used_m >= _MIN_STEP_M:
                    last_used_m = from_window_m
                    sweep = self.sweeps.read(frame)
                    yield RegisteredSweep(sweep, T_world_lidar, twist, twist), None
        except InputError:  # the road ends without a pose or a sweep
            return

    def _relax(self, road_sweeps: Sequence[_RoadSweep]) -> tuple[list[_RoadSweep], tuple[int, ...]]:
        """Return the sweeps with poses corrected by `relax_poses`, and the unreliable frames.

        The poses of the window stay.
        """
        frames = tuple(road_sweep.registered.frame for road_sweep in road_sweeps)
        num_points = float(np.median([len(registered.sweep) for registered in self.window.sweeps]))
        relaxed = relax_poses(
            [cast(Surface, road_sweep.surface) for road_sweep in road_sweeps],
            np.stack([road_sweep.registered.T_world_lidar for road_sweep in road_sweeps]),
            np.array([road_sweep.in_window for road_sweep in road_sweeps]),
            num_in_submap(num_points),
        )
        stamps_ns = [road_sweep.registered.sweep.stamp_ns for road_sweep in road_sweeps]
        trajectory = Trajectory(frames, np.array(stamps_ns, np.int64), relaxed.T_world_lidar)

        # The twists that deskew a sweep follow from the corrected poses around it.
        corrected = list(road_sweeps)
        for i, road_sweep in enumerate(road_sweeps):
            if not road_sweep.in_window:
                sweep, T_world_lidar = road_sweep.registered.sweep, relaxed.T_world_lidar[i]
                registered = RegisteredSweep(sweep, T_world_lidar, *twists(trajectory, i))
                corrected[i] = road_sweep._replace(registered=registered)
        unreliable = np.array(frames)[~relaxed.is_reliable].tolist()
        return corrected, tuple(sorted(unreliable))

    def _select_in_view(self, registered: RegisteredSweep) -> RegisteredSweep:
        """Return a sweep with only those returns that one of the views may see."""
        sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
        in_view = np.zeros(len(sweep), bool)
        # Each view tests only the returns that no view before it may see.
        untested_rows = np.flatnonzero(far.in_reach(sweep))
        points = sweep.points[untested_rows].astype(np.float32)
        for camera, T_cam_world in self.views:
            may_see = far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
            in_view[untested_rows[may_see]] = True
            untested_rows = untested_rows[~may_see]
            points = points[~may_see]
        return replace(registered, sweep=sweep.select(in_view))


def choose_views(
    cameras: Collection[Camera], window: Stretch, keys: Sequence[int]
) -> list[tuple[Camera, Float]]:
    """Return the views of some keys: each camera with its pose ``T_cam_world`` (4,4).

    ``keys`` ascend. A key at most 3 m from the last key with a view of its own shares that view.
    """
    key_poses: list[Float] = []
    for T_world_lidar in (window[key].T_world_lidar for key in keys):
        last = key_poses[-1] if key_poses else None
        if last is None or np.linalg.norm(last[:3, 3] - T_world_lidar[:3, 3]) > _SAME_VIEW_M:
            key_poses.append(T_world_lidar)
    return [
        (camera, camera.T_cam_lidar @ poses.inverse(T_world_lidar))
        for camera in cameras
        for T_world_lidar in key_poses
    ]
