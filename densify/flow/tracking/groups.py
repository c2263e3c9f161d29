# SPDX-License-Identifier: MIT
"""The engine: rigid groups of points whose motion is proven; all else stays exactly where it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.flow.scene import Scene
from densify.flow.tracking.clock import Clock
from densify.flow.tracking.evidence import (
    Candidates,
    FreeSpace,
    Standing,
    firing_times_s,
)
from densify.flow.tracking.shapes import Shape
from densify.flow.tracking.sightings import Track
from densify.flow.tracking.soften import Part, Softened, soften
from densify.flow.tracking.tracks import follow_groups
from densify.geometry import poses
from densify.geometry.height_map import HeightMap
from densify.geometry.sensor import Sensors
from densify.kernels.clouds import rows_inside
from densify.types import Bool, Float, Float32, FlowField, Int, Stretch

_ATTACH_M = 0.3
_ATTACH_UNSEEN_M = 0.15
_MIN_HEIGHT_M = 0.08
_LENGTH_M = 15.0
_FINE_M = 0.3
_SIDE_M = 0.1
_LONGEST_HOLE_M = 0.6
_MAX_CONTRADICTED = 0.05
_FORETOLD_S = 0.2  # before an object was first seen and after it was last seen
_GAPS_REACHED = 0.8  # of the gap between neighbouring rings
_GAPS_REACHED_UNSEEN = 0.5


@dataclass(frozen=True)
class GroupMotion:
    """What moves in a stretch: a `densify.types.Motion`.

    instance: per sweep (N,) int32, index of the point's track, -1 none. bendings: of the tracks
    that are not rigid, by index.
    """

    stretch: Stretch
    tracks: tuple[Track, ...]
    instance: tuple[NDArray[np.int32], ...]
    bendings: Mapping[int, Bending]

    def with_stretch(self, stretch: Stretch) -> GroupMotion:
        """See `densify.flow.engines.SharedMotion`."""
        return replace(self, stretch=stretch)

    def flow(self, frame: int, target: int) -> FlowField:
        """Flow of every point of a sweep to another sweep's reference time; both by frame number.

        Points of an object that was last seen more than 0.2 s before the target, or first seen more
        than that after it, are lost.
        """
        here, there = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        registered, instance = self.stretch.sweeps[here], self.instance[here]
        R_lidar_world = registered.T_world_lidar[:3, :3].T
        clock = Clock.of(self.stretch)
        here_s, there_s = clock.time_s[here], clock.time_s[there]
        seen_s = firing_times_s(self.stretch, here)
        to_reference, displacement, velocity_m_s = np.zeros((3, len(instance), 3))
        lost = np.zeros(len(instance), bool)
        for k in np.unique(instance[instance >= 0]):
            track, mine = self.tracks[k], np.flatnonzero(instance == k)
            measured = poses.transform(registered.T_world_lidar, registered.sweep.points[mine])
            body = track.undo(measured, seen_s[mine])
            at_reference, arrived = body, body
            if k in self.bendings:
                at_reference, arrived = self.bendings[k].carry(here, there, clock, seen_s[mine])
            at_reference = track.place(at_reference, here_s)
            arrived = track.place(arrived, there_s)
            to_reference[mine] = (at_reference - measured) @ R_lidar_world.T
            displacement[mine] = (arrived - at_reference) @ R_lidar_world.T
            velocity_m_s[mine] = track.velocity_m_s(arrived, there_s) @ R_lidar_world.T
            lost[mine] = not _foretold(track, there, clock)
        return FlowField(displacement, instance >= 0, instance, lost, to_reference, velocity_m_s)


@dataclass(frozen=True)
class Bending:
    """How one object departs from its rigid motion. sweeps: the index of the sweep that each part
    of ``softened`` is from."""

    sweeps: tuple[int, ...]
    softened: Softened

    def carry(self, here: int, there: int, clock: Clock, seen_s: Float) -> tuple[Float, Float]:
        """The points of sweep number ``here`` in the object's own frame, at that sweep's reference
        time and at that of sweep number ``there``, or of the nearest that shows the object."""
        n, m = (self.sweeps.index(i) for i in (here, clock.nearest(there, self.sweeps)))
        points = self.softened.parts[n].points
        late_s = clock.time_s[here] - seen_s
        at_reference = points + self.softened.velocity_m_s(n) * late_s[:, None]
        return at_reference, at_reference + self.softened.carry(n, m) - points


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Find everything in the stretch that certainly moves; ``flow.soft``: objects may bend.

    As `densify.flow.engines.EngineModule`; takes no argument. At any rate: what is near in time is
    asked of the stamps. Below 10 Hz what turns, bends or is hidden between two sweeps is followed
    worse or lost; above, sweeps within 0.1 s are one look, see `densify.flow.tracking.looks`.
    """
    return motion_of(scene, scene.candidates, settings)


def motion_of(
    scene: Scene,
    candidates: Sequence[Candidates],
    settings: Config,
    velocities_m_s: Sequence[Float] | None = None,
) -> GroupMotion:
    """The same with what may move given, and how fast it may: (C,3) of each sweep's candidates,
    world; None has the sweeps vote."""
    stretch, space, ground = scene.stretch, scene.space, scene.ground
    standing = [Standing.of(stretch, i, found) for i, found in enumerate(candidates)]
    tracks = follow_groups(standing, space, ground, velocities_m_s)
    shapes = [Shape.of(t.seen_in(standing, sorted(t.claimed))) for t in tracks]

    def members(i: int) -> NDArray[np.int32]:
        seen = _Seen.of(stretch, i, ground, standing[i], space.sensors)
        attached = _attach(seen, i, tracks, shapes, space.clock, scene.min_height_m)
        _lengthen(attached, seen, i, tracks, shapes, space)
        instance = np.full(len(stretch.sweeps[i].sweep), -1, np.int32)
        instance[seen.row] = attached
        return instance

    with ThreadPoolExecutor() as pool:
        instance = tuple(pool.map(members, range(len(stretch.sweeps))))
    bendings = {}
    if settings.flow.soft:
        fine = [_is_fine(track, space) for track in tracks]
        bendings = _bendings(stretch, tracks, fine, instance)
    return GroupMotion(stretch, tuple(tracks), instance, bendings)


def _foretold(track: Track, i: int, clock: Clock) -> bool:
    """Whether sweep i is among those that saw the object, or little earlier or later."""
    first, last = min(track.claimed), max(track.claimed)
    return first <= i <= last or any(clock.near(i, end, _FORETOLD_S) for end in (first, last))


def _is_fine(track: Track, space: FreeSpace) -> bool:
    """Rings so close on the object that a limb shows in several: between rings far apart nothing
    tells bending from gliding along them."""
    return space.gap_m(track.centre, min(track.claimed)) <= _FINE_M


def _bendings(
    stretch: Stretch,
    tracks: Sequence[Track],
    fine: Sequence[bool],
    instance: Sequence[NDArray[np.int32]],
) -> dict[int, Bending]:
    """Find the bendings of objects that certainly bend, among those seen finely."""

    def of_track(k: int) -> Bending:
        parts, sweeps = [], []
        for i, registered in enumerate(stretch.sweeps):
            mine = np.flatnonzero(instance[i] == k)
            if len(mine):
                at = poses.transform(registered.T_world_lidar, registered.sweep.points[mine])
                seen_s = firing_times_s(stretch, i)[mine]
                parts.append(Part(tracks[k].undo(at, seen_s), float(seen_s.mean())))
                sweeps.append(i)
        return Bending(tuple(sweeps), soften(parts))

    with ThreadPoolExecutor() as pool:
        seen_finely = np.flatnonzero(fine).tolist()
        found = dict(zip(seen_finely, pool.map(of_track, seen_finely), strict=True))
    return {k: bending for k, bending in found.items() if np.isfinite(bending.softened.alpha)}


@dataclass(frozen=True)
class _Seen:
    """The points of a sweep that may belong to something.

    row: (N,) in the sweep. points: (N,3) world. time_s: (N,) when measured. height_m: (N,) above
    the ground. reach_m: (N,) how close a point must be to an object's shape to belong to it.
    """

    row: Int
    points: Float
    time_s: Float
    height_m: Float32
    reach_m: Float

    @staticmethod
    def of(
        stretch: Stretch, i: int, ground: HeightMap, standing: Standing, sensors: Sensors
    ) -> _Seen:
        registered = stretch.sweeps[i]
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        height_m = ground.above(points)
        row = np.flatnonzero(height_m > _MIN_HEIGHT_M)
        gap_m = sensors.gap_m(registered.sweep.points, registered.sweep.lidar)
        reach_m = np.maximum(_ATTACH_UNSEEN_M, _GAPS_REACHED_UNSEEN * gap_m)
        seeded = standing.row[standing.candidate]
        reach_m[seeded] = np.maximum(_ATTACH_M, _GAPS_REACHED * gap_m[seeded])
        return _Seen(row, points[row], firing_times_s(stretch, i)[row], height_m[row], reach_m[row])


def _attach(
    seen: _Seen,
    i: int,
    tracks: Sequence[Track],
    shapes: Sequence[Shape],
    clock: Clock,
    min_height_m: float,
) -> NDArray[np.int32]:
    """(N,): the track each of the points seen by sweep number i belongs to, -1 none.

    A point belongs to a track where it is close to the object's points of all sweeps, or stands
    within their outline: nothing else can be where a solid object is.
    """
    instance = np.full(len(seen.points), -1, np.int32)
    nearest = np.full(len(seen.points), np.inf)
    for k, track in enumerate(tracks):
        if not _foretold(track, i, clock):
            continue
        rim = track.place(shapes[k].rim, track.seen_at(clock.time_ns[i]))
        low, high = rim.min(0) - 2 * _ATTACH_M, rim.max(0) + 2 * _ATTACH_M
        low[2] -= 1.0  # down to the wheels
        rows = rows_inside(seen.points, low, high)
        if not len(rows):
            continue
        in_shape = track.undo(seen.points[rows], seen.time_s[rows])
        distance, _ = shapes[k].tree.nearest(in_shape)
        belongs = (distance < seen.reach_m[rows]) & (seen.height_m[rows] >= min_height_m)
        belongs |= shapes[k].within_outline(in_shape)
        closer = belongs & (distance < nearest[rows])
        instance[rows[closer]] = k
        nearest[rows[closer]] = distance[closer]
    return instance


def _lengthen(
    instance: NDArray[np.int32],
    seen: _Seen,
    i: int,
    tracks: Sequence[Track],
    shapes: Sequence[Shape],
    space: FreeSpace,
) -> None:
    """Give the tracks what goes on ahead of and behind their points without a hole, as wide and as
    high as they are: nobody sees through the middle of a long side that slides along itself. No
    other sweep may see through the points where they would be carried to."""
    for k, track in enumerate(tracks):
        mine = np.flatnonzero(instance == k)
        if not len(mine):
            continue
        at_s = track.seen_at(space.clock.time_ns[i])
        ahead = track.path.rate(at_s)[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
        axes = np.stack([ahead, [-ahead[1], ahead[0]]], axis=1)
        rim = track.place(shapes[k].rim, at_s)
        side = (rim[:, :2] @ axes)[:, 1]
        middle = track.place(shapes[k].points.mean(0, keepdims=True), at_s)[0]
        reach = np.array([1.5 * _LENGTH_M, 1.5 * _LENGTH_M, np.inf])
        rows = rows_inside(seen.points, middle - reach, middle + reach)
        rows = rows[instance[rows] < 0]
        at_once = track.carry(seen.points[rows], seen.time_s[rows], at_s)
        along = at_once[:, :2] @ axes
        fits = (along[:, 1] > side.min() - _SIDE_M) & (along[:, 1] < side.max() + _SIDE_M)
        fits &= at_once[:, 2] < rim[:, 2].max() + _SIDE_M
        own = track.carry(seen.points[mine], seen.time_s[mine], at_s)[:, :2] @ ahead
        rows, along = rows[fits], along[fits, 0]
        rows = rows[_without_hole(along, own)]
        if len(rows) and _contradicted(track, seen, rows, i, space) <= _MAX_CONTRADICTED:
            instance[rows] = k


def _without_hole(along: Float, own: Float) -> Bool:
    """(N,) those of ``along`` that reach (M,) ``own`` by steps below ``_LONGEST_HOLE_M``."""
    everything = np.concatenate([along, own])
    order = np.argsort(everything, kind="stable")
    run = np.zeros(len(everything), np.int64)
    run[order[1:]] = np.cumsum(np.diff(everything[order]) > _LONGEST_HOLE_M)
    return np.isin(run[: len(along)], run[len(along) :])


def _contradicted(
    track: Track, seen: _Seen, rows: NDArray[np.int64], i: int, space: FreeSpace
) -> float:
    """The largest share of the points, moved with the track, that another sweep sees through."""
    shares = [0.0]
    body = track.undo(seen.points[rows], seen.time_s[rows])
    for j in space.others(i):
        at_s = space.clock.time_s[j]
        carried = track.place(body, at_s)
        velocity_m_s = track.velocity_m_s(carried, at_s)
        shares.append(float(space.seen_through(carried, j, velocity_m_s).mean()))
    return max(shares)
