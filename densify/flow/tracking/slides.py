# SPDX-License-Identifier: MIT
"""How fast a track slides along the object's own surfaces, told by looks far apart in time.

Followed look by look, a flat front or side may be foretold to slide along itself: between two looks
its ends move by less than rays lie apart. Over half a second and more they do not come to lie on
each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.flow.surface_matching import apply
from densify.flow.tracking.evidence import FreeSpace, Standing
from densify.flow.tracking.proof import contradictions
from densify.flow.tracking.sightings import Track
from densify.flow.tracking.vote import DistanceField, grid
from densify.types import Float

_APART_S, _MOST_APART_S = 0.25, 1.0
_MANY_POINTS = 60  # of a look
_LEAST_LOOKS = 4
_STEPS = (0.25, 10), (0.08, 3)  # m/s, and how many of them each way
_CLEARLY = 0.95  # of the distance between looks


def take_back_slides(track: Track, standing: Sequence[Standing], space: FreeSpace) -> None:
    """Change the velocity of a track's states, and lay its path anew, where looks far apart in time
    then come to lie clearly nearer to each other, and no more looks contradict it: those that saw
    different parts of the object would come nearer, too."""
    looks = sorted(track.sightings)
    times_s = np.array([track.sightings[n].seen_s for n in looks])
    if len(looks) < _LEAST_LOOKS or np.ptp(times_s) < 2 * _APART_S:
        return
    times_s -= times_s.mean()
    bodies = [track.seen_in(standing, track.sightings[n].sweeps) for n in looks]
    slide_m_s = _slide_m_s(bodies, times_s)
    if not slide_m_s.any():
        return
    before = dict(track.sightings), track.path
    _, contradicted, _ = contradictions(track, standing, space)
    for n, at_s in zip(looks, times_s, strict=True):
        sighting = track.sightings[n]
        state = apply(sighting.state, track.centre[None] - at_s * slide_m_s, track.centre)[0]
        state = np.append(state - track.centre, sighting.state[3])
        track.sightings[n] = replace(sighting, state=state)
    track.smooth()
    if contradictions(track, standing, space)[1] > contradicted:
        track.sightings, track.path = before


def _slide_m_s(bodies: Sequence[Float], times_s: Float) -> Float:
    """(3,) how much too fast the object is followed, in its own frame; 0 unless that is clear.

    bodies: (N,3) each, what the looks saw in the object's own frame, at times (L,).
    """
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

    found = np.zeros(3)
    for step_m_s, num_steps in _STEPS:
        tried = found + grid(num_steps) * step_m_s
        found = tried[np.argmin(missed(tried))]
    as_followed, without = missed(np.stack([np.zeros(3), found]))
    return found * (without < _CLEARLY * as_followed)
