# SPDX-License-Identifier: MIT
"""The proof that what was followed moves: its smooth motion explains what was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.flow.tracking.candidates import Obstacles
from densify.flow.tracking.left_places import LeftPlaces, left_places
from densify.flow.tracking.radial import Radial
from densify.flow.tracking.shapes import Body
from densify.flow.tracking.sightings import Track
from densify.free_space.seen_through import FreeSpace
from densify.geometry import poses

_ROUGH_M, _ROUGH_PER_GAP, _ROUGH_S = 0.04, 0.2, 0.003  # by gap of rings, by speed
# Without rings each sweep meets other places of an object: so much more, if those that it left or
# comes to are mostly bare.
_ROUGHER = 1.5
_LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL, _LEAST_WAY_PER_ROUGH = 0.35, 8.0, 1.5
_NUM_ASKED = 60
_LEAST_STATES, _LEAST_S = 3, 0.15
# Where no sweep meets the points of the one before, three crowns of trees may lie on a line.
_LEAST_STATES_SCATTERED = 4
_SHORT_S, _MAX_OF_SHORT = 0.35, 0.03  # three places of a tree's crown may lie on a line,
_SHORT_OF_FEW_S, _FEW = 0.6, 0.2  # and even more where few looks contradict its obstacles still,
_MAX_OF_FEW = 0.1  # of which its motion may leave so many, unless it left its places bare
# But a crown does not leave its places bare, least of all so many.
_MAX_OF_SHORT_BARE, _MAX_OF_SHORT_MANY_BARE = 0.06, 0.12
_STRAY = 0.005  # so few of all looks are echoes at an object's rim
# Of those that obstacles still leaves; of what leaves all its places bare more: limbs swing.
_MAX_CONTRADICTIONS, _MAX_OF_LIMBS, _FAR_M = 0.3, 0.5, 3.0
# They are so many, or of few looks this share, and of many at least that one.
_LEAST_CONTRADICTIONS, _SHARE_OF_FEW, _LEAST_SHARE = 20, 0.08, 0.01
_LEAST_OF_BARE = 8  # are enough if nothing was ever seen at its places before or after
_ALONG = np.cos(np.deg2rad(45))
_AS_FAST, _RAIL_M, _SLENDER, _SHARE_OF_RAIL = 0.1, 2.0, 8.0, 0.3


def left_contradicted(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace, proven: Sequence[Body]
) -> float | None:
    """Fit the smooth motion of a track; None unless it certainly moves, or how much contradicts
    that, see `share_contradicted`."""
    num_states = len(track.sightings)
    if num_states < _LEAST_STATES:
        return None
    if num_states < _LEAST_STATES_SCATTERED and space.sensors.scattered:
        return None
    track.smooth()
    return share_contradicted(track, obstacles, space, proven)


def share_contradicted(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace, proven: Sequence[Body]
) -> float | None:
    """None unless a track's smooth motion certainly is one, or the share of looks that contradict
    even that motion, 0 at best: of two motions the one with less of them is the truth.

    The motion must be smooth, long enough to be told from noise, and must do away with the
    contradictions that brought the group here: where the sweeps see through its points at their
    rigid places, they must not see through them at the moved ones, but for limbs, which swing about
    it. A few looks through a piece of a side that slides along itself prove nothing. What it has
    left must be empty. Where radial velocities were measured, it must have them.

    proven: other objects that certainly move.
    """
    seen_s = np.ptp([sighting.seen_s for sighting in track.sightings.values()])
    if seen_s < _LEAST_S:
        return None
    over_m = _over_noise_m(track, space, seen_s)
    if over_m is None or (over_m > 0 and not space.sensors.scattered):
        return None
    if not _as_fast_as_measured(track, obstacles):
        return None
    still, moved, num_asked = contradictions(track, obstacles, space)
    least = min(_LEAST_CONTRADICTIONS, _SHARE_OF_FEW * num_asked)
    least_of_bare = max(min(least, _LEAST_OF_BARE), _LEAST_SHARE * num_asked)
    if still < least_of_bare or moved > _MAX_OF_LIMBS * still:
        return None
    left = left_places(track, obstacles, space, proven)
    none_taken = seen_s >= _SHORT_S and left.none_taken()
    if still < max(least, _LEAST_SHARE * num_asked) and not none_taken:
        return None
    if left.still_there() or (over_m > 0 and not left.mostly_bare()):
        return None
    # What never left its place may be a ring that glides over a bonnet: only contradictions tell.
    if still < _SHARE_OF_FEW * num_asked and left.unknown():
        return None
    bare = left.bare(far=_travelled_m(track) >= _FAR_M)
    if moved > (_MAX_OF_LIMBS if bare else _MAX_CONTRADICTIONS) * still:
        return None
    few, mostly_bare = still < _FEW * num_asked, left.mostly_bare()
    # Where something is still there, few contradictions of which many are left prove nothing.
    if few and not (mostly_bare or none_taken) and moved > _MAX_OF_FEW * still:
        return None
    short_s = _SHORT_OF_FEW_S if few else _SHORT_S
    if moved > max(_most_of_short(left) * still, _STRAY * num_asked):
        # Nor may rings that glide over a parked car, which is still there behind them.
        glides = still < _SHARE_OF_FEW * num_asked and left.one_still_there()
        if glides or seen_s < min(short_s, np.ptp(space.clock.time_s) / 2):
            return None
    as_few_as_a_rail = still < _SHARE_OF_RAIL * num_asked
    if as_few_as_a_rail and not mostly_bare and _like_a_rail(track, obstacles, space):
        return None
    return moved / num_asked


def _over_noise_m(track: Track, space: FreeSpace, seen_s: float) -> float | None:
    """How much farther off the smooth motion its places lie than noise makes them; None where they
    lie too far off, or the way is too short, to tell of any motion. seen_s: how long it is."""
    residual_m = track.path.residual_m
    travelled = _travelled_m(track)
    gap_m = space.gap_m(track.centre, next(iter(track.claimed)))
    by_gap_m = _ROUGH_M + _ROUGH_PER_GAP * gap_m
    rough_m = by_gap_m + _ROUGH_S * travelled / seen_s
    # Of few places far apart rings, which may be so rough, some lie on a line by chance.
    least_m = max(_LEAST_WAY_PER_RESIDUAL * residual_m, _LEAST_WAY_PER_ROUGH * rough_m)
    if travelled < max(_LEAST_WAY_M, least_m) or residual_m > rough_m + _ROUGHER * by_gap_m:
        return None
    return max(0.0, residual_m - rough_m)


def _travelled_m(track: Track) -> float:
    begin, end = track.path(track.path.begin_s), track.path(track.path.end_s)
    return float(np.linalg.norm((end - begin)[:2]))


def may_be_a_rail(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace, proven: Sequence[Body]
) -> bool:
    """Whether few looks contradict that the track stands, which is shaped like a guard rail, and
    does not leave nearly all its places bare."""
    still, _, num_asked = contradictions(track, obstacles, space)
    if still >= _SHARE_OF_RAIL * num_asked or not _like_a_rail(track, obstacles, space):
        return False
    return not left_places(track, obstacles, space, proven).mostly_bare()


def _most_of_short(left: LeftPlaces) -> float:
    """The share of its contradictions that a motion seen for a short time may leave."""
    if not left.mostly_bare():
        return _MAX_OF_SHORT
    return _MAX_OF_SHORT_MANY_BARE if left.many_empty() else _MAX_OF_SHORT_BARE


def _goes_along(track: Track, space: FreeSpace) -> bool:
    """Whether the object moves about as the scanner does."""
    nearest = [
        int(np.abs(space.clock.time_s - at_s).argmin())
        for at_s in (track.path.begin_s, track.path.end_s)
    ]
    here, there = (poses.inverse(space.T_lidar_world[j])[:2, 3] for j in nearest)
    seconds = max(float(np.ptp(space.clock.time_s[nearest])), 1e-6)
    own_m_s = (there - here) / seconds
    path = track.path
    its_m_s = (path(path.end_s) - path(path.begin_s))[:2] / (path.end_s - path.begin_s)
    apart_m_s = float(np.linalg.norm(its_m_s - own_m_s))
    return apart_m_s < _AS_FAST * float(np.linalg.norm(own_m_s))


def _like_a_rail(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> bool:
    """Whether the object goes about where it points, and is much longer than high, and than wide or
    moving about as the scanner does. Nothing of a guard rail tells its motion along itself; where
    it lies between two rings, sweeps see through it; and rings go with the scanner, so that it
    seems to go with it too."""
    parts = [
        track.undo(obstacles[i].points[rows], obstacles[i].time_s[rows])
        for i, rows in track.claimed.items()
    ]
    body = np.concatenate(parts)
    body -= body.mean(axis=0)
    _, axes = np.linalg.eigh(body[:, :2].T @ body[:, :2])
    across_m, along_m = (body[:, :2] @ axes).T
    way = (track.path(track.path.end_s) - track.path(track.path.begin_s))[:2]
    if abs(way @ axes[:, 1]) < _ALONG * np.linalg.norm(way):
        return False
    slope = along_m @ body[:, 2] / max(float(along_m @ along_m), 1e-6)
    high_m, wide_m = (
        float(np.subtract(*np.percentile(spread, [90, 10])))
        for spread in (body[:, 2] - slope * along_m, across_m)
    )
    long_m = float(np.ptp(along_m))
    if long_m < _RAIL_M or long_m <= _SLENDER * high_m:
        return False
    return long_m > _SLENDER * wide_m or _goes_along(track, space)


def _as_fast_as_measured(track: Track, obstacles: Sequence[Obstacles]) -> bool:
    """Whether the motion has the radial velocities that were measured, where any were."""
    parts, velocities = [], []
    for j, rows in track.claimed.items():
        radial = obstacles[j].radial
        if radial is not None:
            at_s = float(obstacles[j].time_s[rows].mean())
            parts.append(radial.rows(rows))
            velocities.append(track.velocity_m_s(obstacles[j].points[rows], at_s))
    return not parts or Radial.together(parts).agrees(np.concatenate(velocities))


def contradictions(
    track: Track, obstacles: Sequence[Obstacles], space: FreeSpace
) -> tuple[int, int, int]:
    """How many looks through the track's points the sweeps have, obstacles still and moved, and how
    many there may have been."""
    asked = {}
    for look in space.batches:
        num = _NUM_ASKED // len(look)
        for i in look:
            if i in track.claimed:
                rows = track.claimed[i]
                asked[i] = rows[:: len(rows) // num + 1]
    others = {i: frozenset(space.others(i)) for i in asked}
    points = {i: obstacles[i].points[rows] for i, rows in asked.items()}
    body = {i: track.undo(points[i], obstacles[i].time_s[rows]) for i, rows in asked.items()}
    still = moved = num_asked = 0
    for j, *_ in space.batches:
        from_others = [i for i in asked if j in others[i]]
        if not from_others:
            continue
        of_others = np.concatenate([body[i] for i in from_others])
        moved += int(track.seen_through(of_others, j, space).sum())
        standing_still = np.concatenate([points[i] for i in from_others])
        still += int(space.seen_through(standing_still, j).sum())
        num_asked += len(of_others)
    return still, moved, num_asked
