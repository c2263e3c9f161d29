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
from densify.flow.tracking.candidates import Obstacles, firing_times_s
from densify.flow.tracking.extent import Instance, assign_points, find_shape, is_tracked_at
from densify.flow.tracking.objects import Lane, MovingObject, Shape, Track, near_m
from densify.flow.tracking.soften import Snapshot, Softened, soften
from densify.flow.tracking.tracks import find_tracks
from densify.free_space.range_image import FreeSpace
from densify.geometry import poses
from densify.geometry.clock import Clock
from densify.geometry.compiled import num_threads
from densify.geometry.nearest import nearest
from densify.geometry.types import Float, FlowField, Int, Stretch

_MAX_BENDING_GAP_M = 0.3  # ring gap up to which a limb has returns of several rings: it can bend


@dataclass(frozen=True)
class GroupMotion:
    """The motion of all objects in a stretch (consecutive registered sweeps): a `Motion`."""

    stretch: Stretch  # the sweeps, in one world
    tracks: tuple[Track, ...]  # tracks of the confirmed moving objects
    # For each sweep (N,) int32, the index of the track with which each point moves, -1 for static
    track_of_point: tuple[Instance, ...]
    # Non-rigid motion of the tracks that have one, by index in ``tracks``
    bendings: Mapping[int, Bending]
    object_of_track: Int  # (K,) number of the object that each track belongs to

    def with_stretch(self, stretch: Stretch) -> GroupMotion:
        """Return the same motion on another copy of its stretch, such as one with points."""
        return replace(self, stretch=stretch)

    def flow(self, frame: int, target: int) -> FlowField:
        """Return the flow of all points of sweep ``frame`` to the reference time of ``target``.

        The flow excludes ego-motion, and is in the lidar frame of ``frame``. Instances are numbers
        of objects, not of tracks. Points are lost if the target is over 0.2 s before or after all
        observations of their track.
        """
        i = self.stretch.frames.index(frame)
        j = self.stretch.frames.index(target)
        registered = self.stretch.sweeps[i]
        track_of_point = self.track_of_point[i]
        R_lidar_world = registered.T_world_lidar[:3, :3].T
        clock = Clock.of(self.stretch)
        source_s, target_s = clock.time_s[i], clock.time_s[j]
        to_reference, displacement, velocity_m_s = np.zeros((3, len(track_of_point), 3))
        lost = np.zeros(len(track_of_point), bool)
        for k, rows in _rows_by_track(track_of_point):
            track = self.tracks[k]
            seen_s = firing_times_s(self.stretch, i, rows)
            measured = poses.transform(registered.T_world_lidar, registered.sweep.points[rows])
            # In the object's frame the points of a rigid object stay where they are.
            if k in self.bendings:
                source_in_object, target_in_object = self.bendings[k].carry(i, j, clock, seen_s)
            else:
                source_in_object = target_in_object = track.undo(measured, seen_s)
            at_reference = track.place(source_in_object, source_s)
            arrived = track.place(target_in_object, target_s)
            to_reference[rows] = (at_reference - measured) @ R_lidar_world.T
            displacement[rows] = (arrived - at_reference) @ R_lidar_world.T
            velocity_m_s[rows] = track.velocity_m_s(arrived, target_s) @ R_lidar_world.T
            lost[rows] = not is_tracked_at(track, j, clock)
        # The last entry, at index -1, is for static points.
        instance = np.append(self.object_of_track, -1)[track_of_point].astype(np.int32)
        moving = track_of_point >= 0
        return FlowField(displacement, moving, instance, lost, to_reference, velocity_m_s)


@dataclass(frozen=True)
class Bending:
    """The non-rigid motion of one object."""

    sweeps: tuple[int, ...]  # sweep index of each snapshot in ``softened``, ascending
    softened: Softened  # points of the object in each of these sweeps, and how the points bend

    def carry(self, i: int, j: int, clock: Clock, seen_s: Float) -> tuple[Float, Float]:
        """Return N points of sweep i at the reference times of sweeps i and j: two (N,3) arrays.

        Both are in the object's frame, in metres. ``seen_s`` (N,) are the points' firing times. An
        object without points in sweep j bends as in the nearest sweep with points.
        """
        source = self.sweeps.index(i)
        target = self.sweeps.index(clock.nearest(j, self.sweeps))
        points = self.softened.snapshots[source].points
        until_reference_s = clock.time_s[i] - seen_s
        at_source = points + self.softened.velocity_m_s(source) * until_reference_s[:, None]
        at_target = at_source + self.softened.carry(source, target) - points
        return at_source, at_target


def estimate_motion(scene: Scene, settings: Config, argument: str) -> GroupMotion:
    """Return the motion of all objects in the scene, at any sweep rate; ``argument`` is not used.

    Below 10 Hz, objects that turn, bend or are occluded between sweeps are tracked worse or lost.
    """
    return find_group_motion(scene, scene.obstacles)


def find_group_motion(
    scene: Scene,
    obstacles: Sequence[Obstacles],
    velocities_m_s: Sequence[Float] | None = None,
) -> GroupMotion:
    """Return the motion of the objects found among the points of each sweep that may move.

    Args:
        scene: Registered sweeps. Points of batches without a sweep that is asked for stay static.
        obstacles: For each sweep, its C points above the ground, with the candidates.
        velocities_m_s: For each sweep, (C,3) approximate velocities of these points, world frame.
            None estimates them by a vote of neighbouring sweeps.
    """
    stretch, space = scene.stretch, scene.space
    tracks = find_tracks(obstacles, space, scene.ground, velocities_m_s)
    objects = [MovingObject(track, find_shape(track, obstacles, space)) for track in tracks]

    def assign_batch(batch: Sequence[int]) -> list[Instance]:
        if any(map(scene.is_asked, batch)):
            return assign_points(batch, stretch, scene.ground, objects, obstacles, space)
        return [np.full(len(stretch.sweeps[i].sweep), -1, np.int32) for i in batch]

    with ThreadPoolExecutor(num_threads()) as pool:
        own_track = tuple(chain.from_iterable(pool.map(assign_batch, space.batches)))
        object_of_track, carrier_of_track = join_pieces(stretch, tracks, own_track, space)
        # Points move with the carrier of their track. The last entry, at index -1, is static.
        carrier: Instance = np.append(carrier_of_track, -1).astype(np.int32)
        track_of_point = tuple(carrier[sweep_track] for sweep_track in own_track)
        near_tracks = [
            k
            for k, track in enumerate(tracks)
            if space.gap_m(track.centre, min(track.claimed)) <= _MAX_BENDING_GAP_M
        ]
        found = pool.map(
            lambda k: _find_bending(k, tracks[k], stretch, track_of_point), near_tracks
        )
        # Objects of infinite stiffness are rigid.
        bendings = {
            k: bending
            for k, bending in zip(near_tracks, found, strict=True)
            if np.isfinite(bending.softened.alpha)
        }
    return GroupMotion(stretch, tuple(tracks), track_of_point, bendings, object_of_track)


def _find_bending(
    k: int, track: Track, stretch: Stretch, track_of_point: Sequence[Instance]
) -> Bending:
    """Return the bending of the track with index k, from its points in all sweeps."""
    snapshots, sweeps = [], []
    for i, registered in enumerate(stretch.sweeps):
        rows = np.flatnonzero(track_of_point[i] == k)
        if len(rows):
            points = poses.transform(registered.T_world_lidar, registered.sweep.points[rows])
            seen_s = firing_times_s(stretch, i, rows)
            snapshots.append(Snapshot(track.undo(points, seen_s), float(seen_s.mean())))
            sweeps.append(i)
    return Bending(tuple(sweeps), soften(snapshots))


def _rows_by_track(track_of_point: Instance) -> list[tuple[int, Int]]:
    """Return the index of each track with points, and the ascending rows of these points."""
    rows = np.flatnonzero(track_of_point >= 0)
    rows = rows[np.argsort(track_of_point[rows], kind="stable")]
    tracks, begins = np.unique(track_of_point[rows], return_index=True)
    # The first begin is 0, hence the first part is empty.
    return list(zip(tracks.tolist(), np.split(rows, begins)[1:], strict=True))


_MIN_SHARE = 0.7  # least share of the common sweeps, or of a piece's points, that meet a condition
_BUMPERS_M = 1.5  # moving traffic keeps a greater distance
# Two pieces move alike if they drift apart by at most this distance (or their neighbour distance)
# plus this multiple of the noise of their paths, within this time of the middle of the common
# sweeps. The motion of a flat side along itself is not known more accurately.
_DRIFT_M, _NUM_SIGMAS, _COMPARED_S = 0.5, 3.0, 0.5
# A piece with its own motion needs this share of its object's observations: the error of a velocity
# falls with time^1.5.
_MIN_LENGTH_RATIO = 0.75
_MAX_DIFFERENCE_M_S = 0.4  # twice the error of the velocity of a long track


class _Piece(NamedTuple):
    """The points of one track, by sweep index."""

    track: Track  # the track
    points: dict[int, Float]  # sweep index -> (N,3) measured positions, world
    seen_s: dict[int, Float]  # sweep index -> (N,) firing times
    near_m: dict[int, Float]  # sweep index -> (N,) neighbour distances

    def in_object(self, track: Track, sweeps: Sequence[int]) -> Float:
        """Return the piece's points (N,3) in some sweeps (by index), object's frame of a track."""
        clouds = [track.undo(self.points[i], self.seen_s[i]) for i in sweeps]
        return np.concatenate([np.zeros((0, 3)), *clouds])


def join_pieces(
    stretch: Stretch, tracks: Sequence[Track], track_of_point: Sequence[Instance], space: FreeSpace
) -> tuple[Int, Int]:
    """Join the tracks that are pieces of one object.

    An object has the number of its track with most points. A track without points is an object of
    its own. ``track_of_point`` holds, for each sweep, (N,) int32: the index of each point's track,
    -1 for static points.

    Returns:
        For each of the K tracks (K,) the number of its object, and (K,) the index of the track with
        which its points move.
    """
    pieces = _make_pieces(stretch, tracks, track_of_point, space)
    object_of_track, carrier_of_track = np.arange(len(tracks)), np.arange(len(tracks))
    num_points = {k: sum(map(len, piece.points.values())) for k, piece in pieces.items()}
    # The piece with most points starts an object. The object takes in pieces until none fits,
    # because the larger object may touch further pieces.
    queue = sorted(pieces, key=lambda k: (-num_points[k], k))
    while queue:
        k = queue.pop(0)
        parts = [pieces[k]]
        has_grown = True
        while has_grown:
            clouds = [part.in_object(tracks[k], list(part.points)) for part in parts]
            moving_object = MovingObject(tracks[k], Shape.of(np.concatenate(clouds)))
            sweeps = set().union(*(part.points for part in parts))
            new_parts = [m for m in queue if _is_part(pieces[m], moving_object, sweeps, space)]
            object_of_track[new_parts] = k
            for m in new_parts:
                if not _has_own_motion(pieces[m], tracks[k], space):
                    carrier_of_track[m] = k
            parts += [pieces[m] for m in new_parts]
            queue = [m for m in queue if m not in new_parts]
            has_grown = bool(new_parts)
    return object_of_track, carrier_of_track


def _has_own_motion(piece: _Piece, track: Track, space: FreeSpace) -> bool:
    """Return True if a piece's motion is as accurate as that of its object's ``track``."""
    if len(piece.track.observations) < _MIN_LENGTH_RATIO * len(track.observations):
        return False  # a shorter path is less accurate
    middle = sorted(piece.points)[len(piece.points) // 2]
    at_s = space.clock.time_s[middle]
    positions = piece.track.place(piece.in_object(piece.track, [middle]), at_s)
    difference_m_s = piece.track.velocity_m_s(positions, at_s) - track.velocity_m_s(positions, at_s)
    # Along a flat side the velocity may be wrong by more than 0.4 m/s. Then the piece moves better
    # with the object. The two halves of a turning truck differ by less.
    return bool(np.linalg.norm(difference_m_s[:, :2], axis=1).max() <= _MAX_DIFFERENCE_M_S)


def _make_pieces(
    stretch: Stretch, tracks: Sequence[Track], track_of_point: Sequence[Instance], space: FreeSpace
) -> dict[int, _Piece]:
    """Return the points of each track that has points, by index in ``tracks``."""
    pieces: dict[int, _Piece] = {}
    for i, registered in enumerate(stretch.sweeps):
        sweep = registered.sweep
        for k, rows in _rows_by_track(track_of_point[i]):
            ring_gap_m = space.sensors.gap_m(sweep.points[rows], sweep.lidar[rows])
            piece = pieces.setdefault(k, _Piece(tracks[k], {}, {}, {}))
            piece.points[i] = poses.transform(registered.T_world_lidar, sweep.points[rows])
            piece.seen_s[i] = firing_times_s(stretch, i, rows)
            piece.near_m[i] = near_m(ring_gap_m)
    return pieces


def _is_part(
    piece: _Piece, moving_object: MovingObject, sweeps: set[int], space: FreeSpace
) -> bool:
    """Return True if a piece belongs to an object that has points in ``sweeps`` (by index)."""
    common = sorted(sweeps & piece.points.keys())
    if not common:
        return False
    middle = common[len(common) // 2]
    middle_s = space.clock.time_s[middle]
    if _is_away(piece, moving_object, middle):
        return False
    # Rule 1: the piece touches the object in most common sweeps, and lies in the object's box.
    is_touching = _touches(piece, moving_object, common)
    track = moving_object.track
    if is_touching:
        moved_with_object = track.place(piece.in_object(track, common), middle_s)
        if _lies_in_box(moved_with_object, moving_object, middle_s):
            return True

    # The other rules require that the piece moves like the object.
    neighbour_m = float(np.median(np.concatenate([piece.near_m[i] for i in common])))
    tolerance_m = max(_DRIFT_M, neighbour_m)
    positions = piece.track.place(piece.in_object(piece.track, common), middle_s)
    compared = [i for i in common if space.clock.near(i, middle, _COMPARED_S)]
    ends_s = space.clock.time_s[[compared[0], compared[-1]]]
    noise_m = _NUM_SIGMAS * np.hypot(track.path.residual_m, piece.track.path.residual_m)
    if _drift_m(track, piece.track, positions, middle_s, ends_s) > tolerance_m + noise_m:
        return False
    # Rule 2: the piece also touches the object in most common sweeps.
    if is_touching:
        return True
    # Rule 3: the piece is in the object's lane, ahead or behind, without a gap that shows two
    # vehicles. A gap of up to 1.5 m may be a part without returns. Between two vehicles, such a gap
    # is seen through.
    gap_m = _gap_in_lane_m(positions, moving_object, middle_s)
    if tolerance_m < gap_m <= _BUMPERS_M:
        in_object = track.undo(positions, middle_s)
        return not _is_seen_between(in_object, moving_object, common, space)
    return gap_m <= min(tolerance_m, _BUMPERS_M)


def _drift_m(
    track: Track, other_track: Track, positions: Float, from_s: float, ends_s: Float
) -> float:
    """Return the greatest horizontal distance (m) between points as two tracks carry them."""
    offsets = [
        track.carry(positions, from_s, end_s) - other_track.carry(positions, from_s, end_s)
        for end_s in ends_s
    ]
    return float(np.linalg.norm(np.concatenate(offsets)[:, :2], axis=1).max())


def _is_away(piece: _Piece, moving_object: MovingObject, i: int) -> bool:
    """Return True if the boxes around a piece and an object are over 1.5 m apart in sweep i."""
    in_object = piece.in_object(moving_object.track, [i])
    rim = moving_object.shape.rim
    return bool(
        (in_object.min(axis=0) > rim.max(axis=0) + _BUMPERS_M).any()
        or (in_object.max(axis=0) < rim.min(axis=0) - _BUMPERS_M).any()
    )


def _touches(piece: _Piece, moving_object: MovingObject, sweeps: Sequence[int]) -> bool:
    """Return True if a piece has points near an object, or in its outline, in most sweeps."""
    shape = moving_object.shape
    is_touching = []
    for i in sweeps:
        in_object = piece.in_object(moving_object.track, [i])
        is_close = nearest(shape.tree, in_object)[0] < piece.near_m[i]
        is_touching.append((is_close | shape.within_outline(in_object)).any())
    return bool(np.mean(is_touching) >= _MIN_SHARE)


def _lies_in_box(positions: Float, moving_object: MovingObject, at_s: float) -> bool:
    """Return True if most positions (N,3, world) at a time (s) are in the box of an object."""
    lane, along_m, object_along_m = _along_lane(positions, moving_object, at_s)
    is_beside = (along_m >= object_along_m.min()) & (along_m <= object_along_m.max())
    return bool((lane.holds(positions) & is_beside).mean() >= _MIN_SHARE)


def _gap_in_lane_m(positions: Float, moving_object: MovingObject, at_s: float) -> float:
    """Return the gap (m) along the lane from an object to positions, infinite outside the lane."""
    lane, along_m, object_along_m = _along_lane(positions, moving_object, at_s)
    if lane.holds(positions).mean() < _MIN_SHARE:
        return np.inf
    return float(max(along_m.min() - object_along_m.max(), object_along_m.min() - along_m.max()))


def _along_lane(
    positions: Float, moving_object: MovingObject, at_s: float
) -> tuple[Lane, Float, Float]:
    """Return an object's lane, and coordinates along it of positions and of the object's points."""
    lane = moving_object.lane(at_s)
    object_points = moving_object.track.place(moving_object.shape.points, at_s)
    return lane, positions[:, :2] @ lane.ahead, object_points[:, :2] @ lane.ahead


def _is_seen_between(
    points: Float, moving_object: MovingObject, sweeps: Sequence[int], space: FreeSpace
) -> bool:
    """Return True if a sweep saw through the middle between an object and points of a piece."""
    # The middle of the gap lies between the closest points of the piece and of the object.
    distance_m, neighbour = nearest(moving_object.shape.tree, points)
    closest = distance_m.argmin()
    ends = points[closest], moving_object.shape.points[neighbour[closest]]
    between = np.mean(ends, axis=0, keepdims=True)
    return any(moving_object.track.seen_through(between, i, space).any() for i in sweeps)
