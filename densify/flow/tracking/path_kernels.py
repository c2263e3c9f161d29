# SPDX-License-Identifier: MIT
"""Rigid motion about the vertical along a path that is a cubic spline, compiled: see
`densify.flow.tracking.paths`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from densify.geometry.arrays import Float
from densify.geometry.compiled import Kernel, inlined

_MAX_DEGREE = 3


class Spline(NamedTuple):
    """B-splines: knots_s (n + degree + 1,) ascending, coefficients (n,d)."""

    knots_s: Float
    coefficients: Float


class Track(NamedTuple):
    """What `move` follows. rates: the derivative of ``states``, whose degree is one less. begin_s,
    end_s: beyond them it goes on at constant velocity. centre: (3,) about which it turns."""

    states: Spline
    rates: Spline
    begin_s: float
    end_s: float
    centre: Float


@inlined
def _evaluate(spline, time_s, weights, value):  # type: ignore[no-untyped-def]
    """value: (d,), filled; in de Boor's recursion, step by step as scipy has it. weights:
    (2, _MAX_DEGREE + 1) to work in."""
    knots, coefficients = spline
    num = len(coefficients)
    degree = len(knots) - num - 1
    at = degree
    while at < num - 1 and time_s >= knots[at + 1]:
        at += 1
    new, old = weights
    new[0] = 1.0
    for j in range(1, degree + 1):
        for n in range(j):
            old[n] = new[n]
        new[0] = 0.0
        for n in range(1, j + 1):
            right, left = knots[at + n], knots[at + n - j]
            weight = old[n - 1] / (right - left)
            new[n - 1] += weight * (right - time_s)
            new[n] = weight * (time_s - left)
    for axis in range(len(value)):
        value[axis] = 0.0
        for n in range(degree + 1):
            value[axis] += coefficients[at + n - degree, axis] * new[n]


@Kernel
def evaluate(times_s, spline, values):  # type: ignore[no-untyped-def]
    """values: (N,d), filled, at times (N,) between the first and the last inner knot."""
    weights = np.empty((2, _MAX_DEGREE + 1))
    for i in range(len(times_s)):
        _evaluate(spline, times_s[i], weights, values[i])


@inlined
def _state(track, time_s, weights, rate, state):  # type: ignore[no-untyped-def]
    """state: (4,), filled. rate: (4,) to work in."""
    inside = min(max(time_s, track.begin_s), track.end_s)
    _evaluate(track.states, inside, weights, state)
    if time_s != inside:
        _evaluate(track.rates, inside, weights, rate)
        for axis in range(4):
            state[axis] += (time_s - inside) * rate[axis]


@Kernel
def move(first, last, points, times_s, track, forth, moved):  # type: ignore[no-untyped-def]
    """moved: (N,3), filled with points of the object (N,3), from its own frame to where they are at
    times (N,) or at one time (1,) if ``forth``; else the way back."""
    centre, weights = track.centre, np.empty((2, _MAX_DEGREE + 1))
    rate, state = np.empty(4), np.empty(4)
    cos = sin = 0.0
    for i in range(first, last):
        if i == first or len(times_s) > 1:
            _state(track, times_s[i if len(times_s) > 1 else 0], weights, rate, state)
            cos, sin = np.cos(state[3]), np.sin(state[3])
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        if forth:
            moved[i, 0] = cos * x - sin * y + centre[0] + state[0]
            moved[i, 1] = sin * x + cos * y + centre[1] + state[1]
            moved[i, 2] = z + centre[2] + state[2]
        else:
            x, y, z = x - state[0], y - state[1], z - state[2]
            moved[i, 0] = cos * x + sin * y + centre[0]
            moved[i, 1] = cos * y - sin * x + centre[1]
            moved[i, 2] = z + centre[2]
