# SPDX-License-Identifier: MIT
"""Smooth paths through the states of an object, by penalised B-splines.

Eilers, Marx, "Flexible Smoothing with B-splines and Penalties", Statistical Science 1996. The third
difference is penalised: the stiffest path has constant acceleration, and softer paths can start and
stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, PPoly

from densify.geometry.types import Float

_KNOT_S = 0.1
# (Noise of a state / (jerk · knot³))² for a noise of 3 cm and a jerk of 0.03 and 10 m/s³.
_STIFFNESSES = (1e6, 10.0)
_WORTH_SOFTENING = 0.8  # a softer path must lower the leave-one-out error to this share
# Fewer states, or a shorter time, determine no acceleration, or no jerk.
MIN_STATES, MIN_SPAN_S = 5, 0.35
_JERK_STATES, _JERK_S = 8, 0.65
_DEGREE = 3
# Powers 3 to 0 of the time since a span began, by the coefficients of the four B-splines on it.
_CUBIC = np.array([[-1, 3, -3, 1], [3, -6, 3, 0], [-3, 0, 3, 0], [1, 4, 1, 0]]) / 6


@dataclass(frozen=True)
class Path:
    """A smooth motion: a cubic spline over time with d coordinates, first x and y in metres."""

    knots_s: Float  # (n + 4,) knots of the n B-splines, s
    coefficients: Float  # (n,d) of the B-splines; a `Track` has d = 4: x, y, z (m), yaw (rad)
    begin_s: float  # first time of the fit. The path continues at constant velocity before it.
    end_s: float  # last time of the fit. The path continues at constant velocity after it.
    # Root mean square distance of the states in x and y from the path, corrected for the degrees of
    # freedom
    residual_m: float

    @staticmethod
    def fit(times_s: Float, states: Float, weights: Float) -> Path:
        """Fit a path to states (m,d) at ascending times (m,), as stiff as the states allow.

        A softer path is taken only if its leave-one-out error, in closed form, is at least 20 %
        lower. ``weights`` (m,) may have any scale.
        """
        begin_s, end_s = float(times_s[0]), float(times_s[-1])
        num_spans = max(1, round((end_s - begin_s) / _KNOT_S))
        width_s = (end_s - begin_s) / num_spans
        knots: Float = begin_s + width_s * np.arange(-_DEGREE, num_spans + _DEGREE + 1.0)
        last_s = min(end_s, knots[-_DEGREE - 1])  # rounding may put the last knot before the end
        inside = np.clip(times_s, begin_s, np.nextafter(last_s, begin_s))
        B = BSpline.design_matrix(inside, knots, _DEGREE).toarray()
        num_states, duration_s = len(times_s), end_s - begin_s
        accelerates = num_states >= MIN_STATES and duration_s >= MIN_SPAN_S
        D = np.diff(np.eye(B.shape[1]), 3 if accelerates else 2, axis=0)
        W = weights / weights.mean()
        least_error_m, coefficients, residual_m = np.inf, np.zeros(0), np.inf
        jerks = num_states >= _JERK_STATES and duration_s >= _JERK_S
        for stiffness in _STIFFNESSES if jerks else _STIFFNESSES[:1]:
            solve = np.linalg.solve(B.T @ (W[:, None] * B) + stiffness * D.T @ D, B.T * W)
            leverage = np.einsum("ij,ji->i", B, solve)
            fitted = solve @ states
            missed_m = np.linalg.norm((states - B @ fitted)[:, :2], axis=1)
            left_out_m = missed_m / np.maximum(1 - leverage, 1e-3)
            error_m = float(np.sqrt(np.average(left_out_m**2, weights=W)))
            if error_m < _WORTH_SOFTENING * least_error_m:
                freedom = max(num_states - leverage.sum() - 0.5, 0.5)
                mean_square = float(np.average(missed_m**2, weights=W))
                residual_m = float(np.sqrt(mean_square * num_states / freedom))
                least_error_m, coefficients = error_m, fitted
        return Path(knots, coefficients, begin_s, end_s, residual_m)

    @cached_property
    def _pieces(self) -> PPoly:
        """The path as polynomials in time; the first and the last piece are its ends' tangents."""
        num_spans = len(self.coefficients) - _DEGREE
        width_s = (self.end_s - self.begin_s) / num_spans
        controls = np.stack([self.coefficients[k : k + num_spans] for k in range(_DEGREE + 1)])
        cubic = np.einsum("pk,knd->pnd", _CUBIC, controls)
        first, last = np.zeros((2, _DEGREE + 1, 1, cubic.shape[2]))
        first[2:] = cubic[2:, :1]
        first[3] -= first[2]
        last[3], last[2] = cubic[:, -1:].sum(axis=0), np.arange(3.0, -1.0, -1) @ cubic[:, -1]
        powers = width_s ** -np.arange(_DEGREE, -1.0, -1)
        pieces = np.concatenate([first, cubic, last], axis=1) * powers[:, None, None]
        return PPoly(pieces, self.begin_s + width_s * np.arange(-1.0, num_spans + 2))

    def __call__(self, time_s: float | Float) -> Float:
        """Return the states (..., d) at the given times (...) in seconds."""
        state: Float = self._pieces(time_s)
        return state

    def rate(self, time_s: float | Float) -> Float:
        """Return the derivatives (..., d) of the states per second at the given times (...)."""
        rate: Float = self._pieces(time_s, 1)
        return rate

    def travelled_m(self) -> float:
        """Return the horizontal distance between the first and the last position of the fit."""
        return float(np.linalg.norm((self(self.end_s) - self(self.begin_s))[:2]))
