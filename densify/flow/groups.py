# SPDX-License-Identifier: MIT
"""The engine: rigid groups of points whose motion is proven; all else stays exactly where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from densify import poses
from densify.flow.evidence import (
    Candidates,
    FreeSpace,
    find_candidates,
    firing_times_s,
    reference_times_s,
)
from densify.flow.tracks import Track, follow_groups
from densify.types import Bool, Float, Float32, FlowField, Stretch

_ATTACH_M = 0.3
_ATTACH_UNSEEN_M = 0.15
_OUTLINE_M = 0.05
_MIN_HEIGHT_M = 0.08
_FORETOLD = 2  # sweeps before an object was first seen and after it was last seen


@dataclass(frozen=True)
class GroupMotion:
    """What moves in a stretch: a `densify.types.Motion`.

    instance: per sweep (N,) int32, index of the point's track, -1 none.
    """

    stretch: Stretch
    tracks: tuple[Track, ...]
    instance: tuple[NDArray[np.int32], ...]

    def flow(self, frame: int, target: int) -> FlowField:
        """Of every point of a sweep to another sweep's reference time; both by frame number.

        Points of an object that no sweep within two of the target shows are lost.
        """
        here, there = self.stretch.frames.index(frame), self.stretch.frames.index(target)
        registered, instance = self.stretch.sweeps[here], self.instance[here]
        R_lidar_world = registered.T_world_lidar[:3, :3].T
        time_s = reference_times_s(self.stretch)
        seen_s = firing_times_s(self.stretch, here)
        to_reference, displacement, velocity_m_s = np.zeros((3, len(instance), 3))
        lost = np.zeros(len(instance), bool)
        for k in np.unique(instance[instance >= 0]):
            track, mine = self.tracks[k], np.flatnonzero(instance == k)
            at_firing = poses.transform(registered.T_world_lidar, registered.sweep.points[mine])
            at_reference = track.carry(at_firing, seen_s[mine], time_s[here])
            arrived = track.carry(at_reference, time_s[here], time_s[there])
            to_reference[mine] = (at_reference - at_firing) @ R_lidar_world.T
            displacement[mine] = (arrived - at_reference) @ R_lidar_world.T
            velocity_m_s[mine] = track.velocity_m_s(arrived, time_s[there]) @ R_lidar_world.T
            seen = sorted(track.claimed)
            lost[mine] = not seen[0] - _FORETOLD <= there <= seen[-1] + _FORETOLD
        return FlowField(displacement, instance >= 0, instance, lost, to_reference, velocity_m_s)


def follow(stretch: Stretch, heights_m: Sequence[Float32], min_height_m: float) -> GroupMotion:
    """Find everything in the stretch that certainly moves.

    heights_m: per sweep (N,) above the ground. min_height_m: lower points start no motion.
    """
    space = FreeSpace.of(stretch)
    candidates = find_candidates(stretch, space, heights_m, min_height_m)
    tracks = follow_groups(candidates, space, reference_times_s(stretch))
    return GroupMotion(
        stretch,
        tuple(tracks),
        tuple(
            _attach(stretch, i, heights_m[i], tracks, candidates, min_height_m)
            for i in range(len(stretch.sweeps))
        ),
    )


def _attach(
    stretch: Stretch,
    i: int,
    height_m: Float32,
    tracks: Sequence[Track],
    candidates: Sequence[Candidates],
    min_height_m: float,
) -> NDArray[np.int32]:
    """(N,): the track each point of sweep number i belongs to, -1 none.

    A point belongs to a track where it is close to the track's points of all sweeps, or stands
    within their outline: nothing else can be where a solid object is.
    """
    registered = stretch.sweeps[i]
    points = poses.transform(registered.T_world_lidar, registered.sweep.points)
    seen_s = firing_times_s(stretch, i)
    instance = np.full(len(points), -1, np.int32)
    nearest = np.full(len(points), np.inf)
    reach = np.full(len(points), _ATTACH_UNSEEN_M)
    reach[candidates[i].row] = _ATTACH_M
    for k, track in enumerate(tracks):
        if i not in track.claimed:
            continue
        model = np.concatenate(
            [
                track.carry(
                    candidates[j].points[rows], candidates[j].time_s[rows], track.times_s[i]
                )
                for j, rows in sorted(track.claimed.items())
            ]
        )
        low, high = model.min(0) - _ATTACH_M, model.max(0) + _ATTACH_M
        low[2] -= 1.0  # down to the wheels
        near = ((points > low) & (points < high)).all(1) & (height_m > _MIN_HEIGHT_M)
        rows = np.flatnonzero(near)
        if not len(rows):
            continue
        at_once = track.carry(points[rows], seen_s[rows], track.times_s[i])
        distance = np.asarray(cKDTree(model).query(at_once)[0])
        belongs = (distance < reach[rows]) & (height_m[rows] >= min_height_m)
        belongs |= _within_outline(at_once[:, :2], model[:, :2])
        closer = belongs & (distance < nearest[rows])
        instance[rows[closer]] = k
        nearest[rows[closer]] = distance[closer]
    return instance


def _within_outline(at: Float, outline: Float) -> Bool:
    """(N,2), (M,2) -> (N,) True inside the convex hull, where there is one."""
    try:
        hull = ConvexHull(outline)
    except (QhullError, ValueError):  # too few points, or all on a line
        return np.zeros(len(at), bool)
    return (at @ hull.equations[:, :2].T + hull.equations[:, 2] < _OUTLINE_M).all(1)
