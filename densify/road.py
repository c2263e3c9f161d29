# SPDX-License-Identifier: MIT
"""The road before and after a window: what stands along it, as sweeps beyond the window saw it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from densify.config import RegisterSettings
from densify.costs import Watch
from densify.depth import far
from densify.errors import InputError
from densify.geometry import poses
from densify.geometry.sensor import Sensors
from densify.readers.timeline import Timeline
from densify.registration.chain import follow
from densify.registration.deskew import placed, twists
from densify.sweeps import Sweeps
from densify.types import (
    Bool,
    Camera,
    Float,
    RegisteredSweep,
    Standing,
    Stretch,
    Sweep,
    Trajectory,
)

_STEP_M = 2.0
_MOST_S = 30.0  # on each side: who stands, or crawls, sees nothing new
_LEAST_STEP_M = 0.5 * _STEP_M
_SLACK_M = 3.0  # that a lidar moves within a sweep, and a camera until its exposure


@dataclass(frozen=True)
class Road:
    """far_m: how far back and ahead. cameras: what none of them can see is left out."""

    timeline: Timeline
    sweeps: Sweeps
    cameras: Sequence[Camera]
    settings: RegisterSettings
    far_m: float
    watch: Watch

    def beyond(self, near: Stretch, keys: Sequence[int]) -> Standing | None:
        """What stands along the road, in the world of ``near``; None where no sweep beyond it can
        be used.

        near: registered, deskewed sweeps, those of the keys among them. Of several keys; the window
        of a single one is all of them, and nothing beyond.
        """
        sensors = Sensors.of(near.sweeps)
        views = [
            (camera, camera.T_cam_lidar @ poses.inverse(near[key].T_world_lidar))
            for camera in self.cameras
            for key in keys
        ]

        def parts(side: int) -> list[Standing]:
            found: list[Standing] = []
            last_m, travel_m, T_last = 0.0, 0.0, near.sweeps[-1 if side > 0 else 0].T_world_lidar
            for sweep, T_world_lidar, before, after in self._sweeps(near, side):
                travel_m += float(np.linalg.norm(T_world_lidar[:3, 3] - T_last[:3, 3]))
                T_last = T_world_lidar
                if travel_m - last_m >= _LEAST_STEP_M:
                    last_m = travel_m
                    seen = sweep.select(_in_view(sweep, T_world_lidar, views))
                    registered = placed(seen, T_world_lidar, before, after)
                    found.append(far.standing(registered, sensors, side * travel_m))
            return found

        def own() -> list[Standing]:
            if len(keys) < 2:
                return []
            seen = [
                replace(s, sweep=s.sweep.select(_in_view(s.sweep, s.T_world_lidar, views)))
                for s in near.sweeps
            ]
            return [far.standing(s, sensors, 0.0) for s in seen]

        with self.watch.stage("far"), ThreadPoolExecutor(2) as pool:
            behind, ahead = pool.map(parts, (-1, 1))
            found = behind + own() + ahead
            return far.together(found) if found else None

    def _sweeps(self, near: Stretch, side: int) -> Iterator[tuple[Sweep, Float, Float, Float]]:
        """Raw sweeps before (-1) or behind (1) the known ones, the nearest first, their poses, and
        their twists before and after their reference times."""
        num = int(_MOST_S * 1e9 / self.timeline.period_ns)
        if side < 0:
            known = near.sweeps[::-1]
            frames = self.timeline.before(known[-1].frame, num)[::-1]
        else:
            known = near.sweeps
            frames = self.timeline.after(known[-1].frame, num)
        if self.settings.source == "dataset":
            return self._recorded(known[-1], frames)
        stamp_ns = np.array([self.timeline.stamp_of(f) for f in frames], np.int64)
        read, prepare = self.sweeps.read, self.sweeps.prepare
        return follow(known, frames, stamp_ns, read, prepare, self.far_m, _STEP_M, self.settings)

    def _recorded(
        self, known: RegisteredSweep, frames: Sequence[int]
    ) -> Iterator[tuple[Sweep, Float, Float, Float]]:
        """The same by the recording's own poses."""
        chosen, T_recorded = [], []
        for frame in (known.frame, *frames):
            try:
                T_recorded.append(cast(Float, self.sweeps.recorded_pose(frame)))
            except InputError:
                break
            chosen.append(frame)
        T = known.T_world_lidar @ poses.inverse(T_recorded[0]) @ np.stack(T_recorded)
        order = np.argsort(chosen)
        stamp_ns = np.array([self.timeline.stamp_of(f) for f in chosen], np.int64)
        trajectory = Trajectory(tuple(sorted(chosen)), stamp_ns[order], T[order])
        travel_m = np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))
        last_m = 0.0
        for i, at_m in enumerate(travel_m.tolist(), start=1):
            if at_m > self.far_m:
                return
            if at_m - last_m < _LEAST_STEP_M:
                continue
            last_m = at_m
            try:
                sweep = self.sweeps.read(chosen[i])
            except InputError:
                return
            yield sweep, T[i], *twists(trajectory, trajectory.frames.index(chosen[i]))


def _in_view(sweep: Sweep, T_world_lidar: Float, views: Sequence[tuple[Camera, Float]]) -> Bool:
    """(N,) the returns of a raw sweep that one of the views may show."""
    keep = np.zeros(len(sweep), bool)
    rows = np.flatnonzero(far.in_reach(sweep))
    points = sweep.points[rows].astype(np.float32)
    for camera, T_cam_world in views:
        keep[rows] |= far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
    return keep
