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

_STEP_M = 2.0  # along the road, between the sweeps that are used; half of it at least
_MAX_S = 15.0  # on each side; a standing vehicle observes nothing new
_SAME_VIEW_M = 3.0
_UNSEEN_SHARE = 0.5  # of far_m where no camera looks: those sweeps are farther from what is seen
_SLACK_M = 4.0  # motion of a lidar within a sweep, and of a camera until its exposure


class _Passed(NamedTuple):
    """A sweep along the road."""

    # Returns in view of a camera, with the pose; deskewed if ``known``, else raw
    registered: RegisteredSweep
    # Surface of all returns, deskewed, in the lidar frame; None with recorded poses
    surface: Surface | None
    travel_m: float  # distance along the road from the window's first sweep, negative before it
    known: bool  # true if the sweep is in the window, where poses are known

    def deskewed(self) -> RegisteredSweep:
        """Return the returns in view of a camera, deskewed."""
        r = self.registered
        if self.known:
            return r
        return deskew_sweep(r.sweep, r.T_world_lidar, r.twist_before, r.twist_after)


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

    def find_standing(self, with_window: bool) -> StandingWorld:
        """Return the static surfaces along the road, in the world of the window.

        Only points that one of the views may see are kept. ``with_window`` includes the points of
        the window's own sweeps.
        """
        within = self._within()
        with ThreadPoolExecutor(num_threads()) as pool:
            behind, ahead = pool.map(self._beyond, (-1, 1))
        passed, unreliable = [*behind[::-1], *within, *ahead], frozenset[int]()
        if self._surfaces and len(passed) > 1:
            passed, unreliable = self._relaxed(passed)
        used = [
            p
            for p in passed
            if (with_window or not p.known) and p.registered.frame not in unreliable
        ]
        travel_m = np.array([p.travel_m for p in used])
        standing = partial(far.standing, Sensors.of(self.window.sweeps))
        with ThreadPoolExecutor(num_threads()) as pool:
            deskewed = list(pool.map(_Passed.deskewed, used))
            gone = far.departed(deskewed, travel_m)
            worlds = list(pool.map(standing, deskewed, gone))
        return replace(far.joined(worlds), left_out=tuple(sorted(unreliable)))

    @cached_property
    def _surfaces(self) -> dict[int, Surface]:
        """The surfaces of the window's sweeps by frame, {} with recorded poses."""
        if self.settings.source == "dataset":
            return {}
        with ThreadPoolExecutor(num_threads()) as pool:
            surfaces = pool.map(Surface.of_sweep, (s.sweep for s in self.window.sweeps))
            return dict(zip(self.window.frames, surfaces, strict=True))

    @cached_property
    def _travel_m(self) -> Float:
        """The (n,) distances along the road, from the first sweep of the window to each."""
        positions = np.stack([s.T_world_lidar[:3, 3] for s in self.window.sweeps])
        return np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())

    def _within(self) -> list[_Passed]:
        """Return the window's sweeps, thinned to at least 1 m between sweeps."""
        passed, last_m = list[_Passed](), -np.inf
        for s, at_m in zip(self.window.sweeps, self._travel_m.tolist(), strict=True):
            if at_m - last_m >= 0.5 * _STEP_M:
                last_m = at_m
                surface = self._surfaces.get(s.frame)
                passed.append(_Passed(self._in_view(s), surface, at_m, known=True))
        return passed

    def _beyond(self, side: int) -> list[_Passed]:
        """Return the sweeps before (side -1) or after (side 1) the window, nearest first."""
        last = self.window.sweeps[0 if side < 0 else -1].T_world_lidar[:3, 3]
        begin_m = 0.0 if side < 0 else self._travel_m[-1]
        passed, last_m, travel_m = list[_Passed](), 0.0, 0.0
        reach_m = self.far_m if self._is_seen(side) else _UNSEEN_SHARE * self.far_m
        for registered, surface in self._sweeps_beyond(side, reach_m):
            travel_m += float(np.linalg.norm(registered.T_world_lidar[:3, 3] - last))
            last = registered.T_world_lidar[:3, 3]
            if travel_m - last_m < 0.5 * _STEP_M:
                continue
            last_m = travel_m
            at_m = begin_m + side * travel_m
            passed.append(_Passed(self._in_view(registered), surface, at_m, known=False))
        return passed

    def _is_seen(self, side: int) -> bool:
        """Return True if a camera may see the road's end before (side -1) or after the window."""
        first, last = (self.window.sweeps[row].T_world_lidar[:3, 3] for row in (0, -1))
        length_m = float(np.linalg.norm(last - first))
        if length_m < 0.5 * _STEP_M:  # the vehicle stands
            return True
        to_end = side * self.far_m * (last - first) / length_m
        end = ((last if side > 0 else first) + to_end)[None].astype(np.float32)
        return any(far.may_see(*view, end, _SLACK_M).any() for view in self.views)

    def _sweeps_beyond(
        self, side: int, reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, Surface | None]]:
        """Yield each raw sweep with its pose, and its surface, nearest first."""
        known = self.window.sweeps[::side]
        beside = self.timeline.before if side < 0 else self.timeline.after
        frames = beside(known[-1].frame, self._max_sweeps(reach_m))[::side]
        if not self._surfaces:
            return self._recorded(known[-1], frames, reach_m)
        stamp_ns = np.array([self.timeline.stamp_of(f) for f in frames], np.int64)
        of_known, read = [self._surfaces[s.frame] for s in known], self.sweeps.read
        return follow_road(known, of_known, frames, stamp_ns, read, reach_m, _STEP_M)

    def _max_sweeps(self, reach_m: float) -> int:
        """Return the number of sweeps that cover a distance at half the speed of the window."""
        first, last = self.window.sweeps[0], self.window.sweeps[-1]
        max_s, step_ns = _MAX_S, last.sweep.stamp_ns - first.sweep.stamp_ns
        if step_ns > 0:
            step = last.T_world_lidar[:3, 3] - first.T_world_lidar[:3, 3]
            speed_m_s = float(np.linalg.norm(step)) / (1e-9 * step_ns)
            max_s = min(max_s, 2 * reach_m / max(speed_m_s, 1e-3))
        return int(max_s * 1e9 / self.timeline.period_ns)

    def _recorded(
        self, known: RegisteredSweep, frames: Sequence[int], reach_m: float
    ) -> Iterator[tuple[RegisteredSweep, None]]:
        """Yield the values of `_sweeps_beyond` from the recording's own poses."""
        travel_m, last_m, last, last_ns = 0.0, 0.0, known.T_world_lidar, known.sweep.stamp_ns
        try:
            T_world_recorded = last @ poses.inverse(self._recorded_pose(known.frame))
            for frame in frames:
                T = T_world_recorded @ self._recorded_pose(frame)
                stamp_ns = self.timeline.stamp_of(frame)
                twist = poses.twist_between(last, T, (stamp_ns - last_ns) * 1e-9)
                travel_m += float(np.linalg.norm(T[:3, 3] - last[:3, 3]))
                last, last_ns = T, stamp_ns
                if travel_m > reach_m:
                    return
                if travel_m - last_m >= 0.5 * _STEP_M:
                    last_m = travel_m
                    yield RegisteredSweep(self.sweeps.read(frame), T, twist, twist), None
        except InputError:  # the road ends without a pose or a sweep
            return

    def _recorded_pose(self, frame: int) -> Float:
        """Return the recorded ``T_world_lidar`` (4,4) of a sweep."""
        return cast(Float, self.sweeps.recorded_pose(frame))

    def _relaxed(self, passed: Sequence[_Passed]) -> tuple[list[_Passed], frozenset[int]]:
        """Correct the poses by `relax_poses`; return also the frames that stay unreliable."""
        frames = tuple(p.registered.frame for p in passed)
        relaxed = relax_poses(
            [cast(Surface, p.surface) for p in passed],
            np.stack([p.registered.T_world_lidar for p in passed]),
            np.array([p.known for p in passed]),
            num_in_submap(float(np.median([len(s.sweep) for s in self.window.sweeps]))),
        )
        stamp_ns = np.array([p.registered.sweep.stamp_ns for p in passed], np.int64)
        trajectory, moved = Trajectory(frames, stamp_ns, relaxed.T_world_lidar), []
        for i, p in enumerate(passed):
            if not p.known:  # poses of the window stay
                T, sweep = relaxed.T_world_lidar[i], p.registered.sweep
                p = p._replace(registered=RegisteredSweep(sweep, T, *twists(trajectory, i)))
            moved.append(p)
        unreliable = (f for f, holds in zip(frames, relaxed.holds, strict=True) if not holds)
        return moved, frozenset(unreliable)

    def _in_view(self, registered: RegisteredSweep) -> RegisteredSweep:
        """Return a sweep with only those returns that one of the views may see."""
        sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
        keep = np.zeros(len(sweep), bool)
        rows = np.flatnonzero(far.in_reach(sweep))
        points = sweep.points[rows].astype(np.float32)
        for camera, T_cam_world in self.views:
            inside = far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
            keep[rows[inside]] = True
            rows, points = rows[~inside], points[~inside]
        return replace(registered, sweep=sweep.select(keep))


def views_of(
    cameras: Collection[Camera], window: Stretch, keys: Sequence[int]
) -> list[tuple[Camera, Float]]:
    """Return cameras with their ``T_cam_world`` (4,4); keys less than 3 m apart share a view."""
    chosen: list[Float] = []
    for T_world_lidar in (window[key].T_world_lidar for key in keys):
        last = chosen[-1] if chosen else None
        if last is None or np.linalg.norm(last[:3, 3] - T_world_lidar[:3, 3]) > _SAME_VIEW_M:
            chosen.append(T_world_lidar)
    return [(camera, camera.T_cam_lidar @ poses.inverse(T)) for camera in cameras for T in chosen]
