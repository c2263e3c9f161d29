# SPDX-License-Identifier: MIT
"""The engine ``groups``: rigid objects with confirmed tracks move; all other points are static."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from densify.config import Config
from densify.flow.engines import Scene
from densify.flow.tracking.candidates import Candidates, Obstacles, firing_times_s
from densify.flow.tracking.extent import Instance, assign_points, find_shape, is_known_at
from densify.flow.tracking.objects import MovingObject, Shape, Track, near_m
from densify.flow.tracking.soften import Snapshot, Softened, soften
from densify.flow.tracking.tracks import find_tracks
from densify.free_space.seen_through import FreeSpace
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import num_threads
from densify.geometry.nearest import nearest
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


_MOSTLY = 0.7  # least share of the common sweeps, or of the points of a piece
_BUMPERS_M = 1.5  # traffic that moves keeps a greater distance
# Pieces that move alike part by less, or by less than their neighbour distance, within this time of
# the middle of the common sweeps, beyond the noise of their paths. A side that slides along itself
# is not followed better.
_DRIFT_M, _BESIDE_S, _SIGMAS = 0.5, 0.5, 3.0
_AS_LONG = 0.75  # share of an object's observations; the error of a velocity falls with time^1.5
_SAME_M_S = 0.4  # twice the error of a velocity that is well known


class Joined(NamedTuple):
    """The objects of K tracks."""

    number: Int  # (K,) number of the object that each track belongs to
    carrier: Int  # (K,) index of the track with which the points of each track move


class _Piece(NamedTuple):
    """The points of one track, by sweep index."""

    track: Track  # the track
    points: dict[int, Float]  # sweep index -> (N,3) measured positions, world
    seen_s: dict[int, Float]  # sweep index -> (N,) firing times
    near_m: dict[int, Float]  # sweep index -> (N,) neighbour distances

    @property
    def num_points(self) -> int:
        """The number of points in all sweeps."""
        return sum(map(len, self.points.values()))

    def within(self, track: Track, sweeps: Sequence[int]) -> Float:
        """Return the (N,3) points of some sweeps in the object's frame of a track."""
        clouds = [track.undo(self.points[i], self.seen_s[i]) for i in sweeps]
        return np.concatenate([np.zeros((0, 3)), *clouds])


def join_pieces(
    stretch: Stretch, tracks: Sequence[Track], instance: Sequence[Instance], space: FreeSpace
) -> Joined:
    """Find the object that each of the K tracks belongs to, and the motion of its points.

    An object has the number of its piece with most points. Tracks without points are on their own.
    ``instance`` is, for each sweep, (N,) int32, each point's index in ``tracks``, -1 for static.
    """
    pieces = _pieces(stretch, tracks, instance, space)
    number, carrier = np.arange(len(tracks)), np.arange(len(tracks))
    unjoined = sorted(pieces, key=lambda k: (-pieces[k].num_points, k))
    while unjoined:
        k = unjoined.pop(0)
        joined, grows = [pieces[k]], True
        while grows:
            points = np.concatenate([p.within(tracks[k], list(p.points)) for p in joined])
            whole = MovingObject(tracks[k], Shape.of(points))
            sweeps = set().union(*(p.points for p in joined))
            added = [m for m in unjoined if _is_part(pieces[m], whole, sweeps, space)]
            number[added] = k
            for m in added:
                if not _moves_by_itself(pieces[m], tracks[k], space):
                    carrier[m] = k
            joined += [pieces[m] for m in added]
            unjoined = [m for m in unjoined if m not in added]
            grows = bool(added)
    return Joined(number, carrier)


def _moves_by_itself(piece: _Piece, track: Track, space: FreeSpace) -> bool:
    """Return True if the motion of a piece is known as well as that of its object's ``track``."""
    if len(piece.track.observations) < _AS_LONG * len(track.observations):
        return False  # a shorter path is known less well
    middle = sorted(piece.points)[len(piece.points) // 2]
    at_s = space.clock.time_s[middle]
    positions = piece.track.place(piece.within(piece.track, [middle]), at_s)
    difference_m_s = piece.track.velocity_m_s(positions, at_s) - track.velocity_m_s(positions, at_s)
    # The motion of a side that slides along itself is wrong, that of half a turning truck is not.
    return bool(np.linalg.norm(difference_m_s[:, :2], axis=1).max() <= _SAME_M_S)


def _pieces(
    stretch: Stretch, tracks: Sequence[Track], instance: Sequence[Instance], space: FreeSpace
) -> dict[int, _Piece]:
    """Return the pieces by index in ``tracks``; arguments as in `join_pieces`."""
    pieces: dict[int, _Piece] = {}
    for i, (registered, of_point) in enumerate(zip(stretch.sweeps, instance, strict=True)):
        for k in np.unique(of_point[of_point >= 0]).tolist():
            rows = np.flatnonzero(of_point == k)
            sweep = registered.sweep
            piece = pieces.setdefault(k, _Piece(tracks[k], {}, {}, {}))
            piece.points[i] = poses.transform(registered.T_world_lidar, sweep.points[rows])
            piece.seen_s[i] = firing_times_s(stretch, i, rows)
            piece.near_m[i] = near_m(space.sensors.gap_m(sweep.points[rows], sweep.lidar[rows]))
    return pieces


def _is_part(piece: _Piece, whole: MovingObject, sweeps: set[int], space: FreeSpace) -> bool:
    """Return True if a piece belongs to an object that is seen in ``sweeps``."""
    # It touches the object in most common sweeps, and moves alike or lies in the object's box; or
    # it moves alike in the object's lane, at most 0.5 m from the box, or 1.5 m if nothing was seen
    # through between.
    common = sorted(sweeps & piece.points.keys())
    if not common or _is_away(piece, whole, common[len(common) // 2]):
        return False
    middle = common[len(common) // 2]
    middle_s, track = space.clock.time_s[middle], whole.track
    lane = whole.lane(middle_s)
    # coordinates of points along the heading
    whole_m = track.place(whole.shape.points, middle_s)[:, :2] @ lane.ahead
    touches, is_inside = [], []
    for i in common:
        in_object = piece.within(track, [i])
        at_middle = track.place(in_object, middle_s)
        piece_m = at_middle[:, :2] @ lane.ahead
        is_beside = (piece_m >= whole_m.min()) & (piece_m <= whole_m.max())
        is_inside.append(lane.holds(at_middle) & is_beside)
        is_close = nearest(whole.shape.tree, in_object)[0] < piece.near_m[i]
        touches.append((is_close | whole.shape.within_outline(in_object)).any())
    is_touching = bool(np.mean(touches) >= _MOSTLY)
    if is_touching and np.concatenate(is_inside).mean() >= _MOSTLY:
        return True
    near_m = float(np.median(np.concatenate([piece.near_m[i] for i in common])))
    tolerance_m = max(_DRIFT_M, near_m)
    at_middle = piece.track.place(piece.within(piece.track, common), middle_s)
    around_s = space.clock.time_s[[i for i in common if space.clock.near(i, middle, _BESIDE_S)]]
    if not _move_alike(piece.track, track, at_middle, middle_s, around_s, tolerance_m):
        return False
    if is_touching:
        return True
    piece_m = at_middle[:, :2] @ lane.ahead
    gap_m = max(piece_m.min() - whole_m.max(), whole_m.min() - piece_m.max())
    if gap_m > _BUMPERS_M or lane.holds(at_middle).mean() < _MOSTLY:
        return False
    if gap_m <= tolerance_m:
        return True
    return not _is_seen_between(track.undo(at_middle, middle_s), whole, common, space)


def _move_alike(
    track: Track,
    other_track: Track,
    points: Float,
    at_s: float,
    around_s: Float,
    tolerance_m: float,
) -> bool:
    """Return True if two tracks carry (N,3) points from ``at_s`` to nearly the same positions."""
    apart = [
        other_track.carry(points, at_s, end_s) - track.carry(points, at_s, end_s)
        for end_s in around_s[[0, -1]]
    ]
    noise_m = _SIGMAS * np.hypot(other_track.path.residual_m, track.path.residual_m)
    drift_m = np.linalg.norm(np.concatenate(apart)[:, :2], axis=1).max()
    return bool(drift_m <= tolerance_m + noise_m)


def _is_away(piece: _Piece, whole: MovingObject, i: int) -> bool:
    """Return True if a piece is more than 1.5 m away from the box around an object in sweep i."""
    in_object, rim = piece.within(whole.track, [i]), whole.shape.rim
    return bool(
        (in_object.min(axis=0) > rim.max(axis=0) + _BUMPERS_M).any()
        or (in_object.max(axis=0) < rim.min(axis=0) - _BUMPERS_M).any()
    )


def _is_seen_between(
    points: Float, whole: MovingObject, sweeps: Sequence[int], space: FreeSpace
) -> bool:
    """Return True if a sweep saw through the middle between an object and a piece's points."""
    away_m, beside = nearest(whole.shape.tree, points)
    closest = points[away_m.argmin()], whole.shape.points[beside[away_m.argmin()]]
    between = np.mean(closest, axis=0, keepdims=True)
    return any(whole.track.seen_through(between, i, space).any() for i in sweeps)
