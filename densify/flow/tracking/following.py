# SPDX-License-Identifier: MIT
"""One group of candidates followed from look to look as a rigid object, both ways in time.

Each look's candidates are aligned with everything seen of the object so far, from where constant
speed and turn rate lead it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from densify.flow.surface_matching import GATES_M, apply, undo
from densify.flow.tracking.align import MIN_FIT, Model
from densify.flow.tracking.candidates import Batch, Obstacles
from densify.flow.tracking.sightings import Track
from densify.free_space.ground import HeightMap
from densify.geometry.clock import Clock
from densify.geometry.types import Bool, Float

_FIT_M = 0.3
_SHARE_UNSEEN = 0.5  # of the points a look usually shows
# m, m, rad: of what is foretold by up to so long, and in proportion by longer.
_PREDICTION_STD, _PREDICTION_S = np.array([0.3, 0.3, 0.06]), 0.25
_RECENT_S = 0.4  # the states in so long tell a rate
# What a track starts with tells it as states do of that sum of squared times, but no turning.
_GIVEN_S2 = np.array([0.02, 0.02, 0.02, 0.0])
_STEADY = np.array([1.0, 1.0, 1.0, 0.9])  # of what it was then: turns level out
_MISSES_ALLOWED, _MISSED_S = 1, 0.2  # either: a track ends when both are exceeded


def follow(
    members: np.ndarray,
    start: int,
    velocity: Float,
    looks: Sequence[Batch],
    free: Sequence[Bool],
    ground: HeightMap,
    clock: Clock,
    weight: float,
) -> Track:
    """Forwards, then backwards, with everything seen so far as the model. clock: of the looks.
    weight: of heights."""
    here = looks[start].obstacles
    rate = np.append(velocity, 0.0)
    seen_s = float(here.time_s[members].mean())
    points = _at_once(here, members, rate, seen_s)
    track = Track(points.mean(0))
    track.add(start, looks[start], np.zeros(4), seen_s, members)
    model = Model(points, weight)
    recent = clock.num_in(_RECENT_S)
    for direction in (1, -1):
        last, n = start, start + direction
        while 0 <= n < len(looks) and (
            abs(n - last) <= 1 + _MISSES_ALLOWED or clock.near(n, last, _MISSED_S)
        ):
            found = _find(model, track, rate, recent, looks[n], free, ground)
            if found is not None:
                last = n
                state, seen_s, rows, points = found
                track.add(n, looks[n], state, seen_s, rows)
                model.add(undo(state, points, track.centre))
            n += direction
    return track


def _at_once(c: Obstacles, rows: np.ndarray, rate: Float, time_s: float) -> Float:
    """(N,3) candidates of one look, seen one after the other, where they all were at one time."""
    return c.points[rows] + (time_s - c.time_s[rows])[:, None] * rate[:3]


def _predict(track: Track, rate: Float, num: int, time_s: float) -> tuple[Float, Float, Float]:
    """State, its rate, and how far off (3,) the state may be in x y and yaw, by the constant speed
    and turn rate of the ``num`` states nearest in time. rate: given at the start.

    The velocity turns as the object does (Schubert, Richter, Wanielik, "Comparison and Evaluation
    of Advanced Motion Models for Vehicle Tracking", FUSION 2008): a flat front slides along itself
    as it is foretold to.
    """
    nearest_first = sorted(track.sightings.items(), key=lambda s: (abs(s[1].seen_s - time_s), s[0]))
    known = dict(nearest_first[:num])
    states = np.stack([sighting.state for sighting in known.values()])
    t = np.array([sighting.seen_s for sighting in known.values()])
    ahead_s, middle_s = time_s - t[0], t.mean()
    if len(t) > 1:
        t -= middle_s
        given_s2 = _GIVEN_S2 * (next(iter(track.sightings)) in known)
        rate = (t @ states + given_s2 * rate) / (t @ t + given_s2) * _STEADY
    std = _PREDICTION_STD * max(1.0, abs(ahead_s) / _PREDICTION_S)
    on_the_way = _turned(rate, time_s - 0.5 * ahead_s - middle_s)
    return states[0] + on_the_way * ahead_s, _turned(rate, time_s - middle_s), std


def _turned(rate: Float, later_s: float) -> Float:
    """The rate (4,) of a state so much later, of what keeps its speed and turn rate."""
    cos, sin = np.cos(rate[3] * later_s), np.sin(rate[3] * later_s)
    x, y = rate[:2]
    return np.array([cos * x - sin * y, sin * x + cos * y, *rate[2:]])


def _find(
    model: Model,
    track: Track,
    rate: Float,
    num_recent: int,
    look: Batch,
    free: Sequence[Bool],
    ground: HeightMap,
) -> tuple[Float, float, np.ndarray, Float] | None:
    """Align one look's candidates with the model.

    Returns the state, when it held, the rows that fit and where those points were at that time;
    None where too few fit.
    """
    c, centre = look.obstacles, track.centre
    about, about_rate, _ = _predict(track, rate, num_recent, track.seen_at(look.time_ns))
    expected = apply(about, model.points, centre)
    slack_m = GATES_M[0] + look.half_s * np.abs(about_rate[:3])
    low, high = expected.min(0) - slack_m, expected.max(0) + slack_m
    inside = c.strips.rows_inside(low, high)
    inside = inside[look.gather(free)[inside]]
    rows, enough = inside[c.cluster[inside] >= 0], float(MIN_FIT)
    if len(rows) < MIN_FIT:  # seen by nobody else, it may be there all the same
        rows, enough = inside, max(MIN_FIT, _SHARE_UNSEEN * track.typical_size())
    if len(rows) < enough:
        return None
    seen_s = float(c.time_s[rows].mean())
    predicted, rate, std = _predict(track, rate, num_recent, seen_s)
    predicted[2] = track.rise_m(ground, predicted)
    target = _at_once(c, rows, rate, seen_s)
    state = model.align(target, centre, predicted, std)
    if state is None:
        return None
    state[2] = track.rise_m(ground, state)
    fit = model.covers(undo(state, target, centre), _FIT_M)
    if fit.sum() < enough:
        return None
    return state, seen_s, rows[fit], target[fit]
