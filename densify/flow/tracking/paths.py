# SPDX-License-Identifier: MIT
"""Smooth motion through what single sweeps say of an object's place.

Penalised B-splines: Eilers, Marx, "Flexible Smoothing with B-splines and Penalties", Statistical
Science 1996. The third difference is punished, so the stiffest path is a quadratic: constant
acceleration, which most objects keep for a second. Softer ones start and stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline

from densify.flow.tracking.path_kernels import Spline, evaluate
from densify.geometry.types import Float

_KNOT_S = 0.1
# (Noise of a sweep's place / jerk · knot³)²: of 3 cm, a jerk of 0.03, 2 and 10 m/s³.
_STIFFNESSES = (1e6, 200.0, 10.0)
_WORTH_SOFTENING = 0.8  # a softer path must foretell left-out sweeps so much better
# Fewer sweeps, or sweeps in a shorter time, do not tell an acceleration, or how it changes.
_TELL_ACCELERATION = 5, 0.35
_TELL_CHANGE = 8, 0.65
_DEGREE = 3


@dataclass(frozen=True)
class Path:
    """A function of time with several coordinates: a cubic spline.

    knots_s, coefficients: of its B-splines, (n + 4,) and (n,d). begin_s, end_s: between them
    it was fitted; outside it goes on at constant velocity. residual_m: (root mean square over the
    sweeps, first two coordinates) of what it was fitted to, corrected for the freedom it had.
    """

    knots_s: Float
    coefficients: Float
    begin_s: float
    end_s: float
    residual_m: float

    @staticmethod
    def fit(times_s: Float, states: Float, weights: Float) -> Path:
        """Through (m,d) states at ascending (m,) times, weighted.

        The path is as stiff as can be unless a softer one foretells each sweep from the others
        clearly better (leave-one-out, in closed form).
        """
        begin_s, end_s = float(times_s[0]), float(times_s[-1])
        num_spans = max(1, round((end_s - begin_s) / _KNOT_S))
        width_s = (end_s - begin_s) / num_spans
        numbers = np.arange(-_DEGREE, num_spans + _DEGREE + 1, dtype=np.float64)
        knots: Float = begin_s + width_s * numbers
        inside = np.clip(times_s, begin_s, np.nextafter(end_s, begin_s))
        B = BSpline.design_matrix(inside, knots, _DEGREE).toarray()
        order = 3 if _told(times_s, *_TELL_ACCELERATION) else 2
        D = np.diff(np.eye(B.shape[1]), order, axis=0)
        W = weights / weights.mean()
        least, coefficients, residual = np.inf, np.zeros(0), np.inf
        for stiffness in _STIFFNESSES if _told(times_s, *_TELL_CHANGE) else _STIFFNESSES[:1]:
            solve = np.linalg.solve(B.T @ (W[:, None] * B) + stiffness * D.T @ D, B.T * W)
            leverage = np.einsum("ij,ji->i", B, solve)
            found = solve @ states
            missed = np.linalg.norm((states - B @ found)[:, :2], axis=1)
            foretold = missed / np.maximum(1 - leverage, 1e-3)
            error = float(np.sqrt(np.average(foretold**2, weights=W)))
            if error < _WORTH_SOFTENING * least:
                freedom = max(len(times_s) - leverage.sum() - 0.5, 0.5)
                mean_square = float(np.average(missed**2, weights=W))
                residual = float(np.sqrt(mean_square * len(times_s) / freedom))
                least, coefficients = error, found
        return Path(knots, coefficients, begin_s, end_s, residual)

    @cached_property
    def spline(self) -> Spline:
        """Between its begin and its end."""
        return Spline(self.knots_s, np.ascontiguousarray(self.coefficients))

    @cached_property
    def derivative(self) -> Spline:
        """The spline's, per second."""
        t = self.knots_s
        rise = self.coefficients[1:] - self.coefficients[:-1]
        return Spline(
            t[1:-1], rise * _DEGREE / (t[_DEGREE + 1 : -1] - t[1 : -_DEGREE - 1])[:, None]
        )

    def __call__(self, time_s: float | Float) -> Float:
        """(..., d) at these times."""
        inside = np.clip(time_s, self.begin_s, self.end_s)
        beyond = np.asarray(time_s - inside)[..., None]
        return _evaluated(self.spline, inside) + beyond * _evaluated(self.derivative, inside)

    def rate(self, time_s: float | Float) -> Float:
        """(..., d) per second."""
        return _evaluated(self.derivative, np.clip(time_s, self.begin_s, self.end_s))


def _evaluated(spline: Spline, time_s: float | Float) -> Float:
    times_s = np.asarray(time_s, np.float64)
    values = np.empty((times_s.size, spline.coefficients.shape[1]))
    evaluate(times_s.ravel(), spline, values)
    return values.reshape(*times_s.shape, -1)


def _told(times_s: Float, least_number: int, least_s: float) -> bool:
    return len(times_s) >= least_number and bool(times_s[-1] - times_s[0] >= least_s)
