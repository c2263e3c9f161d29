# SPDX-License-Identifier: MIT
"""The road before and after a window: what stands along it, as sweeps beyond the window saw it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
from densify.geometry.threads import num_threads
from densify.geometry.types import (
    Bool,
    Camera,
    Float,
    Int,
    Links,
    RegisteredSweep,
    StandingWorld,
    Stretch,
    Sweep,
    Trajectory,
)
from densify.pipeline.costs import Watch
from densify.pipeline.sweeps import Sweeps
from densify.readers.timeline import Timeline
from densify.registration.alignment import subsample
from densify.registration.chain import follow
from densify.registration.deskew import placed, twists
from densify.registration.submaps import num_in_submap, relax

_STEP_M = 2.0
_MOST_S = 15.0  # on each side: who stands, or crawls, sees nothing new
_LEAST_STEP_M = 0.5 * _STEP_M
_SAME_VIEW_M = 3.0
_SLACK_M = 4.0  # that a lidar moves within a sweep, and a camera until its exposure


class _Passed(NamedTuple):
    """A sweep along the road. registered: what a camera may see of it; raw, unless it was known.
    sample: (N,3) deskewed, some of all its points. travel_m: since the first sweep of the window.
    known: of the window."""

    registered: RegisteredSweep
    sample: Float
    travel_m: float
    known: bool


@dataclass(frozen=True)
class Road:
    """far_m: how far back and ahead. cameras: what none of them can see is left out."""

    timeline: Timeline
    sweeps: Sweeps
    cameras: Sequence[Camera]
    settings: RegisterSettings
    far_m: float
    watch: Watch

    def frames(self, piece: Trajectory, frames: Sequence[int]) -> list[int]:
        """Which sweeps may be read for a piece with these neighbouring frames."""
        at = np.searchsorted(piece.frames, [frames[0], frames[-1]])
        num = self._most_sweeps(piece.T_world_lidar[at], piece.stamp_ns[at])
        before, after = self.timeline.before(frames[0], num), self.timeline.after(frames[-1], num)
        return [*before, *frames, *after]

    def standing(self, near: Stretch, keys: Sequence[int], with_near: bool) -> StandingWorld:
        """What stands along the road, in the world of ``near``; nothing where no other sweep can
        be used.

        near: registered, deskewed sweeps, those of the keys among them. with_near: what they saw
        too.
        """
        sensors, views = Sensors.of(near.sweeps), self._views(near, keys)
        with ThreadPoolExecutor(2) as pool:
            behind, ahead = pool.map(partial(self._beyond, near, views), (-1, 1))
        passed = [*behind[::-1], *_within(near, views), *ahead]
        links, left_out = Links.none(), frozenset[int]()
        if self.settings.source != "dataset" and len(passed) > 1:
            passed, links, left_out = _relaxed(passed, near)
        shown = [
            p for p in passed if (with_near or not p.known) and p.registered.frame not in left_out
        ]

        def straight(p: _Passed) -> RegisteredSweep:
            sweep = p.registered
            if p.known:
                return sweep
            return placed(sweep.sweep, sweep.T_world_lidar, sweep.twist_before, sweep.twist_after)

        travel_m = np.array([p.travel_m for p in shown])
        with ThreadPoolExecutor(num_threads()) as pool:
            seen = list(pool.map(straight, shown))
            gone = far.departed(seen, travel_m)
            parts = list(pool.map(partial(far.standing, sensors), seen, travel_m.tolist(), gone))
        return replace(far.joined(parts), links=links, left_out=tuple(sorted(left_out)))

    def _beyond(
        self, near: Stretch, views: Sequence[tuple[Camera, Float]], side: int
    ) -> list[_Passed]:
        """Sweeps before (-1) or behind (1) those near, the nearest first."""
        last = near.sweeps[0 if side < 0 else -1].T_world_lidar[:3, 3]
        begin_m = 0.0 if side < 0 else _along_m(near)[-1]
        found, last_m, travel_m = list[_Passed](), 0.0, 0.0
        for sweep, T_world_lidar, before, after in self._sweeps(near, side):
            travel_m += float(np.linalg.norm(T_world_lidar[:3, 3] - last))
            last = T_world_lidar[:3, 3]
            if travel_m - last_m < _LEAST_STEP_M:
                continue
            last_m = travel_m
            seen = sweep.select(_in_view(sweep, T_world_lidar, views))
            sample = placed(subsample(sweep), T_world_lidar, before, after).sweep.points
            registered = RegisteredSweep(seen, T_world_lidar, before, after)
            found.append(_Passed(registered, sample, begin_m + side * travel_m, known=False))
        return found

    def _views(self, near: Stretch, keys: Sequence[int]) -> list[tuple[Camera, Float]]:
        """Cameras and ``T_cam_world`` of the keys; of keys close to each other of one."""
        chosen: list[Float] = []
        for key in keys:
            T_world_lidar = near[key].T_world_lidar
            apart = [np.linalg.norm(T[:3, 3] - T_world_lidar[:3, 3]) for T in chosen[-1:]]
            if not apart or apart[0] > _SAME_VIEW_M:
                chosen.append(T_world_lidar)
        return [
            (camera, camera.T_cam_lidar @ poses.inverse(T))
            for camera in self.cameras
            for T in chosen
        ]

    def _most_sweeps(self, T_world_lidar: Float, stamp_ns: Int) -> int:
        """How many on each side, at half the speed between two poses (2,4,4); stamp_ns: (2,)."""
        most_s = _MOST_S
        if stamp_ns[1] > stamp_ns[0]:
            travel_m = float(np.linalg.norm(T_world_lidar[1, :3, 3] - T_world_lidar[0, :3, 3]))
            speed_m_s = travel_m / (1e-9 * float(stamp_ns[1] - stamp_ns[0]))
            most_s = min(most_s, 2 * self.far_m / max(speed_m_s, 1e-3))
        return int(most_s * 1e9 / self.timeline.period_ns)

    def _sweeps(self, near: Stretch, side: int) -> Iterator[tuple[Sweep, Float, Float, Float]]:
        """Raw sweeps before (-1) or behind (1) the known ones, the nearest first, their poses, and
        their twists before and after their reference times."""
        ends = near.sweeps[0], near.sweeps[-1]
        num = self._most_sweeps(
            np.stack([s.T_world_lidar for s in ends]), np.array([s.sweep.stamp_ns for s in ends])
        )
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


def _along_m(near: Stretch) -> Float:
    """(n,) metres of travel since the first of these sweeps."""
    places = np.stack([s.T_world_lidar[:3, 3] for s in near.sweeps])
    return np.append(0.0, np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum())


def _within(near: Stretch, views: Sequence[tuple[Camera, Float]]) -> list[_Passed]:
    """Sweeps of a stretch that is registered already."""
    found, last_m = list[_Passed](), -np.inf
    for s, at_m in zip(near.sweeps, _along_m(near).tolist(), strict=True):
        if at_m - last_m >= _LEAST_STEP_M:
            last_m = at_m
            seen = replace(s, sweep=s.sweep.select(_in_view(s.sweep, s.T_world_lidar, views)))
            found.append(_Passed(seen, subsample(s.sweep).points, at_m, known=True))
    return found


def _relaxed(
    passed: Sequence[_Passed], near: Stretch
) -> tuple[list[_Passed], Links, frozenset[int]]:
    """The same with poses that agree, the pairs that say so, and the frames not to be used."""
    frames = tuple(p.registered.frame for p in passed)
    found = relax(
        frames,
        [p.sample for p in passed],
        np.stack([p.registered.T_world_lidar for p in passed]),
        np.array([p.known for p in passed]),
        num_in_submap(float(np.median([len(s.sweep) for s in near.sweeps]))),
    )
    stamp_ns = np.array([p.registered.sweep.stamp_ns for p in passed], np.int64)
    trajectory = Trajectory(frames, stamp_ns, found.T_world_lidar)

    def moved(i: int, p: _Passed) -> _Passed:
        if p.known:
            return p
        sweep = RegisteredSweep(
            p.registered.sweep, trajectory.T_world_lidar[i], *twists(trajectory, i)
        )
        return p._replace(registered=sweep)

    left_out = frozenset(f for f, holds in zip(frames, found.holds, strict=True) if not holds)
    return [moved(i, p) for i, p in enumerate(passed)], found.links, left_out


def _in_view(sweep: Sweep, T_world_lidar: Float, views: Sequence[tuple[Camera, Float]]) -> Bool:
    """(N,) the returns of a raw sweep that one of the views may show."""
    keep = np.zeros(len(sweep), bool)
    rows = np.flatnonzero(far.in_reach(sweep))
    points = sweep.points[rows].astype(np.float32)
    for camera, T_cam_world in views:
        inside = far.may_see(camera, T_cam_world @ T_world_lidar, points, _SLACK_M)
        keep[rows[inside]] = True
        rows, points = rows[~inside], points[~inside]
    return keep
