# SPDX-License-Identifier: MIT
"""The engine ``groups``: rigid objects with confirmed tracks move; all other points are static."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Candidates, Obstacles, firing_times_s
from densify.flow.tracking.extent import Instance, assign_points, find_shape, is_known_at
from densify.flow.tracking.objects import MovingObject, Track
from densify.flow.tracking.pieces import join_pieces
from densify.flow.tracking.soften import Snapshot, Softened, soften
from densify.flow.tracking.tracks import find_tracks
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import num_threads
from densify.geometry.types import Float, FlowField, Int, Stretch

_FINE_M = 0.3  # ring gap up to which a limb has returns of several rings


@dataclass(frozen=True)
class GroupMotion:
    """The motion of all objects in a stretch (consecutive registered sweeps): a `Motion`."""

    stretch: Stretch  # the sweeps, in one world
    tracks: tuple[Track, ...]  # tracks of the confirmed moving objects
    # For each sweep (N,) int32, the index of the track with which each point moves, -1 for static
    instance: tuple[Instance, ...]
    # Non-rigid motion of the tracks that have one, by index in ``tracks``
    bendings: Mapping[int, Bending]
    number: Int  # (K,) number of the object that each track belongs to

    def with_stretch(self, stretch: Stretch) -> GroupMotion:
        """Return the same motion on another copy of its stretch, see `SharedMotion`."""
        return replace(self, stretch=stretch)

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of all points of sweep ``frame`` to the reference time of ``target``.

        The flow excludes ego-motion and is in the lidar frame of ``frame``. Points of an object are
        lost if the target is more than 0.2 s before its first or after its last observation.
        """
        i, j = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        registered, instance = self.stretch.sweeps[i], self.instance[i]
        R_lidar_world = registered.T_world_lidar[:3, :3].T
        clock = Clock.of(self.stretch)
        source_s, target_s = clock.time_s[i], clock.time_s[j]
        to_reference, displacement, velocity_m_s = np.zeros((3, len(instance), 3))
        lost = np.zeros(len(instance), bool)
        for k, rows in _rows_of(instance):
            track, seen_s = self.tracks[k], firing_times_s(self.stretch, i, rows)
            measured = poses.transform(registered.T_world_lidar, registered.sweep.points[rows])
            in_object = track.undo(measured, seen_s)
            at_reference, arrived = in_object, in_object
            if k in self.bendings:
                at_reference, arrived = self.bendings[k].carry(i, j, clock, seen_s)
            at_reference = track.place(at_reference, source_s)
            arrived = track.place(arrived, target_s)
            to_reference[rows] = (at_reference - measured) @ R_lidar_world.T
            displacement[rows] = (arrived - at_reference) @ R_lidar_world.T
            velocity_m_s[rows] = track.velocity_m_s(arrived, target_s) @ R_lidar_world.T
            lost[rows] = not is_known_at(track, j, clock)
        moving = instance >= 0
        number = np.append(self.number, -1)[instance].astype(np.int32)
        return FlowField(displacement, moving, number, lost, to_reference, velocity_m_s)


@dataclass(frozen=True)
class Bending:
    """The non-rigid motion of one object."""

    sweeps: tuple[int, ...]  # sweep index of each snapshot in ``softened``, ascending
    softened: Softened  # points of the object in each of these sweeps, and how the points bend

    def carry(self, i: int, j: int, clock: Clock, seen_s: Float) -> tuple[Float, Float]:
        """Return the (N,3) points of sweep ``i`` at two reference times, object's frame.

        The times are those of sweep ``i``, and of sweep ``j`` or the nearest sweep that
        observed the object. ``seen_s`` (N,) are the firing times.
        """
        n, m = (self.sweeps.index(sweep) for sweep in (i, clock.nearest(j, self.sweeps)))
        points = self.softened.snapshots[n].points
        late_s = clock.time_s[i] - seen_s
        at_reference = points + self.softened.velocity_m_s(n) * late_s[:, None]
        return at_reference, at_reference + self.softened.carry(n, m) - points


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Find all moving objects in the stretch, at any sweep rate: the engine ``groups``.

    Below 10 Hz, objects that turn, bend or are occluded between sweeps are tracked worse or lost.
    """
    return motion_of(scene, scene.candidates)


def motion_of(
    scene: Scene,
    candidates: Sequence[Candidates],
    velocities_m_s: Sequence[Float] | None = None,
) -> GroupMotion:
    """Find the moving objects among the points of each sweep that may move (``candidates``).

    ``velocities_m_s`` are, for each sweep, (C,3) of its C points above the ground, world frame.
    None estimates them by a vote of neighbouring sweeps.
    """
    stretch, space = scene.stretch, scene.space
    obstacles = [Obstacles.of(stretch, i, of_sweep) for i, of_sweep in enumerate(candidates)]
    tracks = find_tracks(obstacles, space, scene.ground, velocities_m_s)
    objects = [MovingObject(track, find_shape(track, obstacles, space)) for track in tracks]

    def members(batch: Sequence[int]) -> list[Instance]:
        if any(map(scene.is_asked, batch)):
            return assign_points(batch, stretch, scene.ground, objects, obstacles, space)
        return [np.full(len(stretch.sweeps[i].sweep), -1, np.int32) for i in batch]

    def bending(k: int) -> Bending:
        snapshots, sweeps = [], []
        for i, registered in enumerate(stretch.sweeps):
            rows = np.flatnonzero(instance[i] == k)
            if len(rows):
                points = poses.transform(registered.T_world_lidar, registered.sweep.points[rows])
                seen_s = firing_times_s(stretch, i, rows)
                snapshots.append(Snapshot(tracks[k].undo(points, seen_s), float(seen_s.mean())))
                sweeps.append(i)
        return Bending(tuple(sweeps), soften(snapshots))

    with ThreadPoolExecutor(num_threads()) as pool:
        instance = tuple(chain.from_iterable(pool.map(members, space.batches)))
        number, carrier = join_pieces(stretch, tracks, instance, space)
        moved_with: Instance = np.append(carrier, -1).astype(np.int32)
        instance = tuple(moved_with[of_point] for of_point in instance)
        fine = [
            k
            for k, track in enumerate(tracks)
            if space.gap_m(track.centre, min(track.claimed)) <= _FINE_M
        ]
        estimated = dict(zip(fine, pool.map(bending, fine), strict=True))
    bendings = {k: b for k, b in estimated.items() if np.isfinite(b.softened.alpha)}
    return GroupMotion(stretch, tuple(tracks), instance, bendings, number)


def _rows_of(instance: Instance) -> list[tuple[int, Int]]:
    """Return, for each track in ``instance`` (N,), its index and its points' ascending indices."""
    rows = np.flatnonzero(instance >= 0)
    rows = rows[np.argsort(instance[rows], kind="stable")]
    tracks, begins = np.unique(instance[rows], return_index=True)
    return list(zip(tracks.tolist(), np.split(rows, begins)[1:], strict=True))
