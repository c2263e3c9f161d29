# SPDX-License-Identifier: MIT
"""How fast a track slides along the object's own surfaces, told by looks far apart in time.

Followed look by look, a flat front or side may be foretold to slide along itself: between two looks
its ends move by less than rays lie apart. Over half a second and more they do not come to lie on
each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from densify.flow.surface_matching import apply
from densify.flow.tracking.candidates import LINK_M, Obstacles
from densify.flow.tracking.proof import contradictions
from densify.flow.tracking.shapes import Body
from densify.flow.tracking.sightings import Track
from densify.flow.tracking.vote import DistanceField, grid
from densify.free_space.seen_through import FreeSpace
from densify.geometry.types import Float

_APART_S, _MOST_APART_S = 0.25, 1.0
_MANY_POINTS = 60  # of a look
_LEAST_LOOKS = 4
_STEPS = (0.25, 10), (0.08, 3)  # m/s, and how many of them each way
# What is so long may be a piece of something that it slides along so fast.
_LONG_M, _SLIDES_M_S, _ABOUT_AS_WELL = 1.5, (0.3, 2.5), 1.25
_CLEARLY = 0.95  # of the distance between looks


def take_back_slides(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> None:
    """Change the velocity of a track's states, and lay its path anew, where looks far apart in time
    then come to lie clearly nearer to each other, and no more looks contradict it: those that saw
    different parts of the object would come nearer, too."""
    looks = sorted(track.sightings)
    times_s = np.array([track.sightings[n].seen_s for n in looks])
    if len(looks) < _LEAST_LOOKS or np.ptp(times_s) < 2 * _APART_S:
        return
    times_s -= times_s.mean()
    bodies = [track.seen_in(obstacles, track.sightings[n].sweeps) for n in looks]
    slide_m_s = _slide_m_s(bodies, times_s)
    if not slide_m_s.any():
        return
    states = []
    for n, at_s in zip(looks, times_s, strict=True):
        state = track.sightings[n].state
        moved = apply(state, track.centre[None] - at_s * slide_m_s, track.centre)[0]
        states.append(np.append(moved - track.centre, state[3]))
    _lay_anew(track, states, obstacles, space)


def go_with_the_rest(
    track: Track, proven: Sequence[Body], obstacles: Sequence[Obstacles], space: FreeSpace
) -> None:
    """Give a long track the motion of the object that it touches and slides along, where that fits
    about as well and no more looks contradict it: what is solid does not, but a side seen in pieces
    may show no end that would tell how fast it goes.

    proven: other objects that certainly move.
    """
    looks = sorted(track.sightings)
    times_s = np.array([track.sightings[n].seen_s for n in looks])
    middle_s = float(times_s.mean())
    there = track.place(track.seen_in(obstacles, sorted(track.claimed)), middle_s)
    if np.linalg.norm(np.ptp(there[:, :2], axis=0)) < _LONG_M:
        return
    middle, own = (
        there.mean(axis=0, keepdims=True),
        track.velocity_m_s(there, middle_s).mean(axis=0),
    )
    for body, shape in proven:
        apart_m_s = np.linalg.norm(body.velocity_m_s(middle, middle_s)[0] - own)
        if not _SLIDES_M_S[0] <= apart_m_s <= _SLIDES_M_S[1]:
            continue
        if not np.isfinite(shape.tree.nearest(body.undo(there, middle_s), LINK_M)[0]).any():
            continue
        before, missed = (dict(track.sightings), track.path), _missed(track, looks, obstacles)
        centre, yaw = track.place(track.centre[None], middle_s), track.path(middle_s)[3]
        states = []
        for at_s in times_s:
            turned = body.path(at_s)[3] - body.path(middle_s)[3]
            moved = body.carry(centre, middle_s, at_s)[0] - track.centre
            states.append(np.append(moved, yaw + turned))
        _lay_anew(track, states, obstacles, space)
        if _missed(track, looks, obstacles) <= _ABOUT_AS_WELL * missed:
            return
        track.sightings, track.path = before


def _missed(track: Track, looks: Sequence[int], obstacles: Sequence[Obstacles]) -> float:
    """How far looks far apart in time lie from each other as the track moves, see `_distance`."""
    times_s = np.array([track.sightings[n].seen_s for n in looks])
    bodies = [track.seen_in(obstacles, track.sightings[n].sweeps) for n in looks]
    return float(_distance(bodies, times_s)(np.zeros((1, 3)))[0])


def _lay_anew(
    track: Track, states: Sequence[Float], obstacles: Sequence[Obstacles], space: FreeSpace
) -> None:
    """Give the track's looks, in order, other states, unless more looks contradict it then."""
    before = dict(track.sightings), track.path
    _, contradicted, _ = contradictions(track, obstacles, space)
    for n, state in zip(sorted(before[0]), states, strict=True):
        track.sightings[n] = replace(track.sightings[n], state=state)
    track.smooth()
    if contradictions(track, obstacles, space)[1] > contradicted:
        track.sightings, track.path = before


def _slide_m_s(bodies: Sequence[Float], times_s: Float) -> Float:
    """(3,) how much too fast the object is followed, in its own frame; 0 unless that is clear.

    bodies: (N,3) each, what the looks saw in the object's own frame, at times (L,).
    """
    missed, found = _distance(bodies, times_s), np.zeros(3)
    for step_m_s, num_steps in _STEPS:
        tried = found + grid(num_steps) * step_m_s
        found = tried[np.argmin(missed(tried))]
    as_followed, without = missed(np.stack([np.zeros(3), found]))
    return found * (without < _CLEARLY * as_followed)


def _distance(bodies: Sequence[Float], times_s: Float) -> Callable[[Float], Float]:
    """A function of slides that are taken back, (V,3), in m/s: how far looks far apart in time then
    lie from each other, (V,). As `_slide_m_s`."""
    fields = [DistanceField.of(body, np.zeros(len(body))) for body in bodies]
    some = [body[:: len(body) // _MANY_POINTS + 1] for body in bodies]
    pairs = [
        (a, b)
        for a, first_s in enumerate(times_s)
        for b, second_s in enumerate(times_s)
        if _APART_S <= abs(first_s - second_s) <= _MOST_APART_S
    ]

    def missed(slides_m_s: Float) -> Float:
        """(V,3) -> (V,) mean distance of the looks' points to each other, as a share of the
        field's reach."""
        cost, num = np.zeros(len(slides_m_s)), 0
        for a, b in pairs:
            nearness = np.zeros((len(slides_m_s), len(some[b])), np.uint8)
            since_s = np.full(len(slides_m_s), times_s[b] - times_s[a])
            fields[a].look_up(nearness, some[b], np.zeros(len(some[b])), slides_m_s, since_s)
            cost += (1 - nearness.mean(axis=1) / 255) * len(some[b])
            num += len(some[b])
        return cost / max(num, 1)

    return missed
