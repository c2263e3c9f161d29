# SPDX-License-Identifier: MIT
"""The proof that what was followed moves: its smooth motion explains what was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.flow.tracking.evidence import FreeSpace, Standing
from densify.flow.tracking.radial import Radial
from densify.flow.tracking.sightings import Track

_ROUGH_M, _ROUGH_PER_GAP, _ROUGH_S = 0.04, 0.2, 0.003  # by gap of rings, by speed
_LEAST_WAY_M, _LEAST_WAY_PER_RESIDUAL, _LEAST_WAY_PER_ROUGH = 0.35, 8.0, 1.5
_NUM_ASKED = 60
_LEAST_STATES, _LEAST_S = 3, 0.15
_MAX_CONTRADICTIONS = 0.3  # of those that standing still leaves,
# which are so many, or of few looks this share, and of many at least that one.
_LEAST_CONTRADICTIONS, _SHARE_OF_FEW, _LEAST_SHARE = 20, 0.08, 0.01


def left_contradicted(track: Track, standing: Sequence[Standing], space: FreeSpace) -> float | None:
    """Fit the smooth motion of a track; None unless it certainly moves, or the share of looks that
    contradict even that motion, 0 at best: of two motions the one with less of them is the truth.

    The motion must be smooth, long enough to be told from noise, and must do away with the
    contradictions that brought the group here: where the sweeps see through its points at their
    rigid places, they must not see through them at the moved ones. A few looks through a piece of a
    side that slides along itself prove nothing. Where radial velocities were measured, it must have
    them.
    """
    seen_s = np.ptp([sighting.seen_s for sighting in track.sightings.values()])
    if len(track.sightings) < _LEAST_STATES or seen_s < _LEAST_S:
        return None
    track.smooth()
    residual_m = track.path.residual_m
    begin, end = track.path(track.path.begin_s), track.path(track.path.end_s)
    travelled = float(np.linalg.norm((end - begin)[:2]))
    gap_m = space.gap_m(track.centre, next(iter(track.claimed)))
    rough_m = _ROUGH_M + _ROUGH_PER_GAP * gap_m + _ROUGH_S * travelled / seen_s
    # Of few places far apart rings, which may be so rough, some lie on a line by chance.
    least_m = max(_LEAST_WAY_PER_RESIDUAL * residual_m, _LEAST_WAY_PER_ROUGH * rough_m)
    if residual_m > rough_m or travelled < max(_LEAST_WAY_M, least_m):
        return None
    if not _as_fast_as_measured(track, standing):
        return None
    still, moved, num_asked = _contradictions(track, standing, space)
    least = min(_LEAST_CONTRADICTIONS, _SHARE_OF_FEW * num_asked)
    if still < max(least, _LEAST_SHARE * num_asked) or moved > _MAX_CONTRADICTIONS * still:
        return None
    return moved / num_asked


def _as_fast_as_measured(track: Track, standing: Sequence[Standing]) -> bool:
    """Whether the motion has the radial velocities that were measured, where any were."""
    parts, velocities = [], []
    for j, rows in track.claimed.items():
        radial = standing[j].radial
        if radial is not None:
            at_s = float(standing[j].time_s[rows].mean())
            parts.append(radial.rows(rows))
            velocities.append(track.velocity_m_s(standing[j].points[rows], at_s))
    return not parts or Radial.together(parts).agrees(np.concatenate(velocities))


def _contradictions(
    track: Track, standing: Sequence[Standing], space: FreeSpace
) -> tuple[int, int, int]:
    """How many looks through the track's points the sweeps have, standing still and moved, and how
    many there may have been."""
    asked = {}
    for look in space.looks:
        num = _NUM_ASKED // len(look)
        for i in look:
            if i in track.claimed:
                rows = track.claimed[i]
                asked[i] = rows[:: len(rows) // num + 1]
    others = {i: frozenset(space.others(i)) for i in asked}
    points = {i: standing[i].points[rows] for i, rows in asked.items()}
    body = {i: track.undo(points[i], standing[i].time_s[rows]) for i, rows in asked.items()}
    still = moved = num_asked = 0
    for j, *_ in space.looks:
        from_others = [i for i in asked if j in others[i]]
        if not from_others:
            continue
        of_others = np.concatenate([body[i] for i in from_others])
        moved += int(track.seen_through(of_others, j, space).sum())
        standing_still = np.concatenate([points[i] for i in from_others])
        still += int(space.seen_through(standing_still, j).sum())
        num_asked += len(of_others)
    return still, moved, num_asked
