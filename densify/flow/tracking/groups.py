# SPDX-License-Identifier: MIT
"""The engine: rigid groups of points whose motion is proven; all else stays exactly where it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Candidates, Obstacles, firing_times_s
from densify.flow.tracking.extent import (
    Seen,
    attach,
    detach,
    foretold,
    leave_out_alone,
    leave_out_slower,
    lengthen,
    shape_of,
)
from densify.flow.tracking.radial import Radial
from densify.flow.tracking.sightings import Track
from densify.flow.tracking.soften import Part, Softened, soften
from densify.flow.tracking.tracks import follow_groups
from densify.free_space.seen_through import FreeSpace
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.types import Float, FlowField, Stretch

_FINE_M = 0.3


@dataclass(frozen=True)
class GroupMotion:
    """What moves in a stretch: a `Motion`.

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
        to_reference, displacement, velocity_m_s = np.zeros((3, len(instance), 3))
        lost = np.zeros(len(instance), bool)
        for k, mine in _rows_of(instance):
            track, seen_s = self.tracks[k], firing_times_s(self.stretch, here, mine)
            measured = poses.transform(registered.T_world_lidar, registered.sweep.points[mine])
            body = track.undo(measured, seen_s)
            at_reference, arrived = body, body
            if k in self.bendings:
                at_reference, arrived = self.bendings[k].carry(here, there, clock, seen_s)
            at_reference = track.place(at_reference, here_s)
            arrived = track.place(arrived, there_s)
            to_reference[mine] = (at_reference - measured) @ R_lidar_world.T
            displacement[mine] = (arrived - at_reference) @ R_lidar_world.T
            velocity_m_s[mine] = track.velocity_m_s(arrived, there_s) @ R_lidar_world.T
            lost[mine] = not foretold(track, there, clock)
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
    """Find everything in the stretch that certainly moves.

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
    obstacles = [Obstacles.of(stretch, i, found) for i, found in enumerate(candidates)]
    tracks = follow_groups(obstacles, space, ground, velocities_m_s)
    shapes = [shape_of(track, obstacles, space) for track in tracks]

    def members(look: Sequence[int]) -> list[NDArray[np.int32]]:
        instances = [np.full(len(stretch.sweeps[i].sweep), -1, np.int32) for i in look]
        if not any(map(scene.is_asked, look)):
            return instances
        parts = [Seen.of(stretch, i, ground, obstacles[i], space.sensors) for i in look]
        attached = [
            attach(seen, i, tracks, shapes, space.clock)
            for i, seen in zip(look, parts, strict=True)
        ]
        for i, seen, mine in zip(look, parts, attached, strict=True):
            detach(mine, seen, i, tracks, shapes, obstacles, space.clock)
        together = np.concatenate(attached)
        lengthen(together, Seen.together(parts), look[0], tracks, shapes, obstacles, space)
        attached = np.split(together, np.cumsum([len(mine) for mine in attached])[:-1])
        for i, seen, mine, instance in zip(look, parts, attached, instances, strict=True):
            leave_out_alone(mine, seen, i, tracks, space.clock)
            radial = Radial.of(stretch.sweeps[i])
            if radial is not None:
                leave_out_slower(mine, seen, radial.rows(seen.row), tracks)
            instance[seen.row] = mine
        return instances

    with ThreadPoolExecutor() as pool:
        instance = tuple(chain.from_iterable(pool.map(members, space.batches)))
    fine = [_is_fine(track, space) for track in tracks]
    bendings = _bendings(stretch, tracks, fine, instance)
    return GroupMotion(stretch, tuple(tracks), instance, bendings)


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
                seen_s = firing_times_s(stretch, i, mine)
                parts.append(Part(tracks[k].undo(at, seen_s), float(seen_s.mean())))
                sweeps.append(i)
        return Bending(tuple(sweeps), soften(parts))

    with ThreadPoolExecutor() as pool:
        seen_finely = np.flatnonzero(fine).tolist()
        found = dict(zip(seen_finely, pool.map(of_track, seen_finely), strict=True))
    return {k: bending for k, bending in found.items() if np.isfinite(bending.softened.alpha)}


def _rows_of(instance: NDArray[np.int32]) -> list[tuple[int, NDArray[np.int64]]]:
    """Each track of (N,) that there is, -1 for none, and its rows, ascending."""
    rows = np.flatnonzero(instance >= 0)
    rows = rows[np.argsort(instance[rows], kind="stable")]
    tracks, begins = np.unique(instance[rows], return_index=True)
    return list(zip(tracks.tolist(), np.split(rows, begins)[1:], strict=True))
