# SPDX-License-Identifier: MIT
"""Scene flow of every sweep of a window to its neighbour on the way to the key."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from densify import poses
from densify.config import FlowSettings
from densify.flow.evidence import Candidates, FreeSpace, find_candidates, firing_times_s
from densify.flow.tracks import Track, follow_groups
from densify.types import Bool, Float, Float32, FlowField, Window

_ATTACH_M = 0.3
_ATTACH_UNSEEN_M = 0.15
_OUTLINE_M = 0.05
_MIN_HEIGHT_M = 0.08


def step_flow(
    window: Window, heights_m: Sequence[Float32], settings: FlowSettings
) -> tuple[FlowField, ...]:
    """Flow of each sweep to the next one towards the key; the key's own is 0, its movers marked.

    heights_m: per sweep (N,) above the ground.
    """
    if settings.engine == "paper":
        return _objective_steps(window, heights_m, settings)
    return _group_steps(window, heights_m, settings)


def _group_steps(
    window: Window, heights_m: Sequence[Float32], settings: FlowSettings
) -> tuple[FlowField, ...]:
    """Rigid groups whose motion is proven; everything else stays exactly where it is."""
    key = window.frames.index(window.key)
    stamp_ns = np.array([s.sweep.stamp_ns for s in window.sweeps])
    time_s = (stamp_ns - stamp_ns[key]) * 1e-9
    space = FreeSpace.of(window)
    candidates = find_candidates(space, heights_m, settings.min_height_m)
    tracks = follow_groups(candidates, space, time_s, key)

    fields = []
    for i, registered in enumerate(window.sweeps):
        points = poses.transform(registered.T_key_lidar, registered.sweep.points)
        seen_s = firing_times_s(window, i)
        instance = _attach(
            points, seen_s, heights_m[i], i, tracks, candidates, settings.min_height_m
        )
        target = i + int(np.sign(key - i))
        to_reference = np.zeros_like(points)
        displacement = np.zeros_like(points)
        for k, track in enumerate(tracks):
            mine = np.flatnonzero(instance == k)
            if len(mine):
                at_reference = track.carry(points[mine], seen_s[mine], time_s[i])
                into_lidar = registered.T_key_lidar[:3, :3]
                to_reference[mine] = (at_reference - points[mine]) @ into_lidar
                if target != i:
                    arrived = track.carry(at_reference, time_s[i], time_s[target])
                    displacement[mine] = (arrived - at_reference) @ into_lidar
        nothing_lost = np.zeros(len(points), bool)
        fields.append(FlowField(displacement, instance >= 0, instance, nothing_lost, to_reference))
    return tuple(fields)


def _attach(
    points: Float,
    seen_s: Float,
    height_m: Float32,
    i: int,
    tracks: Sequence[Track],
    candidates: Sequence[Candidates],
    min_height_m: float,
) -> np.ndarray:
    """(N,) int32: the track each point of sweep i belongs to, -1 none.

    A point belongs to a track where it is close to the track's points of all sweeps, or stands
    within their outline: nothing else can be where a solid object is.
    """
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


def _objective_steps(
    window: Window, heights_m: Sequence[Float32], settings: FlowSettings
) -> tuple[FlowField, ...]:
    """The published way: the points above the ground, pair by pair."""
    from densify.flow.pair import flow_between

    key = window.frames.index(window.key)
    above = [h >= settings.min_height_m for h in heights_m]
    clouds = [poses.transform(s.T_key_lidar, s.sweep.points) for s in window.sweeps]
    fields = []
    for i, registered in enumerate(window.sweeps):
        field = FlowField.zero(len(clouds[i]))
        target = i + int(np.sign(key - i))
        if target != i and above[i].any() and above[target].any():
            pair = flow_between(clouds[i][above[i]], clouds[target][above[target]], settings)
            field.displacement[above[i]] = pair.displacement @ registered.T_key_lidar[:3, :3]
            field.moving[above[i]] = pair.moving
        fields.append(field)
    return tuple(fields)
