# SPDX-License-Identifier: MIT
"""Where tracks start: which groups of candidates, in which look, and how fast they may be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from densify.flow.tracking.candidates import Batch, Obstacles
from densify.flow.tracking.shapes import Body
from densify.flow.tracking.sightings import Track
from densify.geometry.clock import Clock
from densify.geometry.nearest import BoxTree
from densify.geometry.types import Float

MIN_POINTS = 8
_MIN_SEED_SHARE = 0.4
_AROUND_S = 0.5  # before and after a start is as good as any time
_NEARER_END, _NEARER_END_S = 0.7, 0.1  # each time a start is so much nearer it is worth less
_LEAST_WIDTH_M = 0.1
_SLIDES_M = 1.5  # what is seen to be so long may slide along itself
_HOLE_S = 0.25  # over longer ones, what starts at one end may miss the other
_DRIVES_M_S, _APART_M_S = 8.0, 1.5
_BESIDE_M = 1.0  # as far as what is towed is from what tows it
_MOSTLY = 0.5


def groups_to_start(obstacles: Sequence[Obstacles], clock: Clock) -> list[tuple[int, np.ndarray]]:
    """Batch and members of the clusters that are mostly seeds, the best start first: what is seen
    well makes a good model, and far from the ends of the stretch both sides tell how it moves."""
    groups = []

    def worth(start: tuple[int, np.ndarray]) -> float:
        i, members = start
        nearer_s = max(0.0, _AROUND_S - clock.from_end_s(i))
        return float(len(members) * _NEARER_END ** (nearer_s / _NEARER_END_S))

    for i, c in enumerate(obstacles):
        size = np.bincount(c.cluster[c.candidate], minlength=c.num_clusters)
        seeds = np.bincount(c.cluster[c.candidate & c.seed], minlength=c.num_clusters)
        good = np.flatnonzero((size >= MIN_POINTS) & (seeds >= _MIN_SEED_SHARE * size))
        groups += [(i, np.flatnonzero(c.cluster == k)) for k in good]
    return sorted(groups, key=worth, reverse=True)


def is_line_on(bodies: Sequence[Body], look: Batch, members: np.ndarray) -> bool:
    """Whether a group is an upright line close to a proven track: rays one above the other that
    meet a part of it. Followed by itself it would stay where the rays are."""
    line = look.obstacles.points[members]
    if np.linalg.norm(np.ptp(line[:, :2], axis=0)) >= _LEAST_WIDTH_M:
        return False
    tree = BoxTree(line)
    there = (track.place(shape.points, track.seen_at(look.time_ns)) for track, shape in bodies)
    return any(np.isfinite(tree.nearest(points, _BESIDE_M)[0]).any() for points in there)


def is_part(bodies: Sequence[Body], look: Batch, members: np.ndarray, reach_m: float) -> bool:
    """Whether most of a group lies within a proven track, or so close to it: it goes with that."""
    points, time_s = look.obstacles.points[members], look.obstacles.time_s[members]
    for track, shape in bodies:
        body = track.undo(points, time_s)
        near = np.isfinite(shape.tree.nearest(body, reach_m)[0]) | shape.within_outline(body)
        if near.mean() > _MOSTLY:
            return True
    return False


def velocities_beside(look: Batch, members: np.ndarray, bodies: Sequence[Body]) -> Iterator[Float]:
    """The velocities (3,) that proven tracks close to a group have there, where the group cannot be
    a part of them: of what tows it, say. Little else tells how fast a long side slides.

    bodies: the tracks with all that was seen of them.
    """
    c = look.obstacles
    tree, middle = BoxTree(c.points[members]), c.points[members].mean(0, keepdims=True)
    for track, shape in bodies:
        at_s = track.seen_at(look.time_ns)
        if not np.isfinite(tree.nearest(track.place(shape.points, at_s), _BESIDE_M)[0]).any():
            continue
        yield track.velocity_m_s(middle, at_s)[0]


def velocities_of_traffic(look: Batch, bodies: Sequence[Body]) -> Iterator[Float]:
    """The different velocities (3,) that proven tracks have on the road then: who comes towards the
    scanner and is seen well once only, seen through by few, drives about as others do."""
    told: list[Float] = []
    for track, _ in bodies:
        velocity = track.path.rate(track.seen_at(look.time_ns))[:3]
        apart_m_s = [np.linalg.norm(velocity - other) for other in told]
        if np.linalg.norm(velocity) > _DRIVES_M_S and min(apart_m_s, default=np.inf) > _APART_M_S:
            told.append(velocity)
            yield velocity


def ends(track: Track, looks: Sequence[Batch]) -> Iterator[tuple[np.ndarray, int]]:
    """What the first and the last look saw of a track, but where it was started: rows and look.
    From there more may be seen than a side that slides along itself; nothing short can. None of
    what was seen with a hole in time."""
    start, *_ = track.sightings
    side = looks[start].obstacles.points[_rows_in(track, looks[start])]
    seen_s = np.sort([sighting.seen_s for sighting in track.sightings.values()])
    holes_s = np.diff(seen_s)
    if np.linalg.norm(np.ptp(side[:, :2], axis=0)) < _SLIDES_M or (holes_s > _HOLE_S).any():
        return
    for n in sorted({min(track.sightings), max(track.sightings)} - {start}):
        if track.num_points(n) >= MIN_POINTS:
            yield _rows_in(track, looks[n]), n


def _rows_in(track: Track, look: Batch) -> np.ndarray:
    """Which rows of a look that shows the track are its."""
    sweeps = zip(look.sweeps, look.begins, strict=True)
    return np.concatenate([track.claimed[j] + begin for j, begin in sweeps if j in track.claimed])
