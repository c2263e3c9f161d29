# SPDX-License-Identifier: MIT
"""Find static surfaces along the road, measured by sweeps beyond the window."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
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

_STEP_M = 2.0
_MOST_S = 15.0  # on each side; a standing vehicle observes nothing new
_LEAST_STEP_M = 0.5 * _STEP_M
_SAME_VIEW_M = 3.0
_UNSEEN_SHARE = 0.5  # of far_m where no camera looks: those sweeps are farther from what is seen
_SLACK_M = 4.0  # motion of a lidar within a sweep, and of a camera until its exposure

_View = tuple[Camera, Float]
"""A camera and its pose ``T_cam_world`` (4,4)."""


class _Passed(NamedTuple):
    """A sweep along the road."""

    # Returns in view of a camera, with the pose; deskewed if ``known``, else raw
    registered: RegisteredSweep
    # Surface of all returns, deskewed, in the lidar frame; None with recorded poses
    surface: Surface | None
    travel_m: float  # distance along the road from the window's first sweep, negative before it
    known: bool  # true if the sweep is in the window, where poses are known


@dataclass(frozen=True)
class Road:
    """The road before and after a window."""

    timeline: Timeline  # times of the recording's sweeps
    sweeps: Sweeps  # reader of the raw sweeps
    cameras: Sequence[Camera]  # cameras that must see a point for it to be kept
    settings: RegisterSettings  # settings of registration
    # Distance along the road on each side of the window where a camera looks. Half of it is covered
    # where no camera looks.
    far_m: float

    def find_standing(
        self, window: Stretch, keys: Sequence[int], with_window: bool
    ) -> StandingWorld:
        """Return the static surfaces along the road, in the world of ``window``.

        ``window`` are deskewed sweeps of the window that include the keys. ``with_window`` includes
        their points in the result.
        """
        sensors, views = Sensors.of(window.sweeps), self._views(window, keys)
        is_recorded, surfaces = self.settings.source == "dataset", dict[int, Surface]()
        with ThreadPoolExecutor(num_threads()) as pool:
            if not is_recorded:
                sweep_surfaces = pool.map(Surface.of_sweep, (s.sweep for s in window.sweeps))
                surfaces = dict(zip(window.frames, sweep_surfaces, strict=True))
            behind, ahead = pool.map(partial(self._beyond, window, surfaces, views), (-1, 1))
        inside = _within(window, surfaces, views)
        passed, left_out = [*behind[::-1], *inside, *ahead], frozenset[int]()
        if not is_recorded and len(passed) > 1:
            passed, left_out = _relaxed(passed, window)
        used = [
            p for p in passed if (with_window or not p.known) and p.registered.frame not in left_out
        ]
        travel_m = np.array([p.travel_m for p in used])
        with ThreadPoolExecutor(num_threads()) as pool:
            deskewed = list(pool.map(_deskewed, used))
            gone = far.departed(deskewed, travel_m)
            standing = partial(far.standing, sensors)
            worlds = list(pool.map(standing, deskewed, gone))
        return replace(far.joined(worlds), left_out=tuple(sorted(left_out)))

    def _beyond(
        self,
        window: Stretch,
        surfaces: Mapping[int, Surface],
        views: Sequence[_View],
        side: int,
    ) -> list[_Passed]:
        """Return the sweeps before (side -1) or after (side 1) the window, nearest first."""
        last = window.sweeps[0 if side < 0 else -1].T_world_lidar[:3, 3]
        begin_m = 0.0 if side < 0 else _travel_m(window)[-1]
        passed, last_m, travel_m = list[_Passed](), 0.0, 0.0
        seen_m = self.far_m if self._is_seen(window, views, side) else _UNSEEN_SHARE * self.far_m
        road = replace(self, far_m=seen_m)
        for registered, surface in road._sweeps_beyond(window, surfaces, side):
            travel_m += float(np.linalg.norm(registered.T_world_lidar[:3, 3] - last))
            last = registered.T_world_lidar[:3, 3]
            if travel_m - last_m < _LEAST_STEP_M:
                continue
            last_m = travel_m
            at_m = begin_m + side * travel_m
            passed.append(_Passed(_in_view(registered, views), surface, at_m, known=False))
        return passed

    def _is_seen(self, window: Stretch, views: Sequence[_View], side: int) -> bool:
        """Return True if a camera may see the road's end before (side -1) or after the window."""
        first, last = (window.sweeps[row].T_world_lidar[:3, 3] for row in (0, -1))
        length_m = float(np.linalg.norm(last - first))
        if length_m < _LEAST_STEP_M:  # the vehicle stands
            return True
        to_end = side * self.far_m * (last - first) / length_m
        end = ((last if side > 0 else first) + to_end)[None].astype(np.float32)
        return any(far.may_see(*view, end, _SLACK_M).any() for view in views)

    def _views(self, window: Stretch, keys: Sequence[int]) -> list[_View]:
        """Return the views of all cameras at the keys. Keys less than 3 m apart share a view."""
        chosen: list[Float] = []
        for key in keys:
            T_world_lidar = window[key].T_world_lidar
            apart = [np.linalg.norm(T[:3, 3] - T_world_lidar[:3, 3]) for T in chosen[-1:]]
            if not apart or apart[0] > _SAME_VIEW_M:
                chosen.append(T_world_lidar)
        return [
            (camera, camera.T_cam_lidar @ poses.inverse(T))
            for camera in self.cameras
            for T in chosen
        ]

    def _sweeps_beyond(
        self, window: Stretch, surfaces: Mapping[int, Surface], side: int
    ) -> Iterator[tuple[RegisteredSweep, Surface | None]]:
        """Yield each raw sweep with its pose, and its surface, nearest first."""
        known = window.sweeps[::side]
        beside = self.timeline.before if side < 0 else self.timeline.after
        frames = beside(known[-1].frame, self._most_sweeps(window))[::side]
        if self.settings.source == "dataset":
            return self._recorded(known[-1], frames)
        stamp_ns = np.array([self.timeline.stamp_of(f) for f in frames], np.int64)
        of_known, read = [surfaces[s.frame] for s in known], self.sweeps.read
        return follow_road(known, of_known, frames, stamp_ns, read, self.far_m, _STEP_M)

    def _most_sweeps(self, window: Stretch) -> int:
        """Return the number of sweeps that cover ``far_m`` at half the speed of the window."""
        first, last = window.sweeps[0], window.sweeps[-1]
        most_s, step_ns = _MOST_S, last.sweep.stamp_ns - first.sweep.stamp_ns
        if step_ns > 0:
            step = last.T_world_lidar[:3, 3] - first.T_world_lidar[:3, 3]
            speed_m_s = float(np.linalg.norm(step)) / (1e-9 * step_ns)
            most_s = min(most_s, 2 * self.far_m / max(speed_m_s, 1e-3))
        return int(most_s * 1e9 / self.timeline.period_ns)

    def _recorded(
        self, known: RegisteredSweep, frames: Sequence[int]
    ) -> Iterator[tuple[RegisteredSweep, None]]:
        """Yield the values of `_sweeps_beyond` from the recording's own poses."""
        travel_m, last_m, last, last_ns = 0.0, 0.0, known.T_world_lidar, known.sweep.stamp_ns
        try:
            T_world_recorded = last @ poses.inverse(self._pose(known.frame))
            for frame in frames:
                T = T_world_recorded @ self._pose(frame)
                stamp_ns = self.timeline.stamp_of(frame)
                twist = poses.twist_between(last, T, (stamp_ns - last_ns) * 1e-9)
                travel_m += float(np.linalg.norm(T[:3, 3] - last[:3, 3]))
                last, last_ns = T, stamp_ns
                if travel_m > self.far_m:
                    return
                if travel_m - last_m >= _LEAST_STEP_M:
                    last_m = travel_m
                    yield RegisteredSweep(self.sweeps.read(frame), T, twist, twist), None
        except InputError:  # the road ends without a pose or a sweep
            return

    def _pose(self, frame: int) -> Float:
        """Return the recorded ``T_world_lidar`` (4,4) of a sweep."""
        return cast(Float, self.sweeps.recorded_pose(frame))


def _deskewed(p: _Passed) -> RegisteredSweep:
    """Return the sweep's returns in view of a camera, deskewed."""
    sweep = p.registered
    if p.known:
        return sweep
    return deskew_sweep(sweep.sweep, sweep.T_world_lidar, sweep.twist_before, sweep.twist_after)


def _travel_m(window: Stretch) -> Float:
    """Return the (n,) distance in metres from the first sweep to each of the window's n sweeps."""
    positions = np.stack([s.T_world_lidar[:3, 3] for s in window.sweeps])
    return np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())


def _within(
    window: Stretch, surfaces: Mapping[int, Surface], views: Sequence[_View]
) -> list[_Passed]:
    """Return the window's sweeps, thinned to at least 1 m between sweeps."""
    passed, last_m = list[_Passed](), -np.inf
    for s, at_m in zip(window.sweeps, _travel_m(window).tolist(), strict=True):
        if at_m - last_m >= _LEAST_STEP_M:
            last_m = at_m
            passed.append(_Passed(_in_view(s, views), surfaces.get(s.frame), at_m, known=True))
    return passed


def _relaxed(passed: Sequence[_Passed], window: Stretch) -> tuple[list[_Passed], frozenset[int]]:
    """Correct the poses by `relax_poses`; return also the frames of sweeps that stay unreliable."""
    frames = tuple(p.registered.frame for p in passed)
    relaxed = relax_poses(
        [p.surface for p in passed if p.surface is not None],
        np.stack([p.registered.T_world_lidar for p in passed]),
        np.array([p.known for p in passed]),
        num_in_submap(float(np.median([len(s.sweep) for s in window.sweeps]))),
    )
    stamp_ns = np.array([p.registered.sweep.stamp_ns for p in passed], np.int64)
    trajectory, moved = Trajectory(frames, stamp_ns, relaxed.T_world_lidar), []
    for i, p in enumerate(passed):
        if not p.known:  # poses of the window stay
            T_world_lidar, sweep = relaxed.T_world_lidar[i], p.registered.sweep
            p = p._replace(registered=RegisteredSweep(sweep, T_world_lidar, *twists(trajectory, i)))
        moved.append(p)
    return moved, frozenset(f for f, holds in zip(frames, relaxed.holds, strict=True) if not holds)


def _in_view(registered: RegisteredSweep, views: Sequence[_View]) -> RegisteredSweep:
    """Return a sweep with only those returns that one of the views, in its world, may see."""
    sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
    keep = np.zeros(len(sweep), bool)
    rows = np.flatnonzero(far.in_reach(sweep))
    points = sweep.points[rows].astype(np.float32)
    for camera, T_cam_world in views:
        inside = far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
        keep[rows[inside]] = True
        rows, points = rows[~inside], points[~inside]
    return replace(registered, sweep=sweep.select(keep))
