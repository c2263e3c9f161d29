# SPDX-License-Identifier: MIT
"""Planar curves by arc length, and speed profiles: what every motion in the street is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from densify.geometry.types import Float

_STEP_M = 0.5


class Curve:
    """A smooth planar curve through points, parametrised by arc length from 0 to ``length_m``.

    Beyond its ends it goes on straight.
    """

    def __init__(self, xy: Float) -> None:
        """xy: (N,2) metres, neighbours about half a metre apart."""
        chord_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        self.length_m = float(chord_m[-1])
        self.knots_m: Float = chord_m
        self._spline = CubicSpline(chord_m, xy)
        self._slope = self._spline.derivative()

    def __call__(self, station_m: Float) -> Float:
        """(N,) arc length -> (N,2)."""
        inside = np.clip(station_m, 0.0, self.length_m)
        beyond = (station_m - inside)[..., None]
        xy: Float = self._spline(inside)
        return xy + beyond * self.tangent(inside) if np.any(beyond) else xy

    def with_tangent(self, station_m: Float) -> tuple[Float, Float]:
        """The curve and its `tangent` there; quicker than one by one."""
        inside = np.clip(station_m, 0.0, self.length_m)
        tangent = self.tangent(inside)
        return self._spline(inside) + (station_m - inside)[..., None] * tangent, tangent

    def tangent(self, station_m: Float) -> Float:
        """(N,) -> (N,2) unit direction of travel."""
        slope = self._slope(np.clip(station_m, 0.0, self.length_m))
        squared = slope * slope  # quicker than np.linalg.norm
        unit: Float = slope / np.sqrt(squared[..., :1] + squared[..., 1:])
        return unit

    def normal(self, station_m: Float) -> Float:
        """(N,) -> (N,2) unit vector to the left of the direction of travel."""
        tangent = self.tangent(station_m)
        return np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)

    @staticmethod
    def bending(
        length_m: float, curvature: Callable[[Float], Float], origin_m: float = 0.0
    ) -> Curve:
        """The curve of that length whose curvature (1/m, positive to the left) is given as a
        function of the arc length; it passes the origin with heading +x at ``origin_m``."""
        step = 0.05
        station = np.arange(0.0, length_m + step, step)
        heading = np.concatenate([[0.0], np.cumsum(curvature(station[:-1] + step / 2) * step)])
        middle = (heading[1:] + heading[:-1]) / 2
        steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        xy = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
        start = round(origin_m / step)
        c, s = np.cos(heading[start]), np.sin(heading[start])
        xy = (xy - xy[start]) @ np.array([[c, -s], [s, c]])
        return Curve(xy[:: round(_STEP_M / step)])


class Lane:
    """A path along a road: the road's centreline shifted sideways, possibly driven backwards."""

    def __init__(
        self, road: Curve, offset_m: float | Callable[[Float], Float], forward: bool = True
    ) -> None:
        """offset_m: metres to the left of the road's own direction, constant or by station."""
        stations = road.knots_m
        offset = offset_m(stations) if callable(offset_m) else np.full(len(stations), offset_m)
        xy = road(stations) + road.normal(stations) * offset[:, None]
        self.curve = Curve(xy if forward else xy[::-1])
        self._stations = stations if forward else stations[::-1]
        self._sign = 1.0 if forward else -1.0

    def at(self, station_m: float) -> float:
        """Arc length on this lane abreast of the road's station."""
        return float(
            np.interp(self._sign * station_m, self._sign * self._stations, self.curve.knots_m)
        )


def polyline(corners: Sequence[tuple[float, float]], radius_m: float) -> Float:
    """(N,2) points every half metre along straight lines whose corners are rounded with arcs."""
    pieces = [np.asarray(corners[0], float)[None]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        a, b, c = (np.asarray(p, float) for p in (before, corner, after))
        u, v = (a - b) / np.linalg.norm(a - b), (c - b) / np.linalg.norm(c - b)
        half = np.arccos(np.clip(u @ v, -1, 1)) / 2
        centre = b + (u + v) / np.linalg.norm(u + v) * radius_m / np.sin(half)
        begin, end = b + u * radius_m / np.tan(half), b + v * radius_m / np.tan(half)
        start, stop = (np.arctan2(*(p - centre)[::-1]) for p in (begin, end))
        sweep = (stop - start + np.pi) % (2 * np.pi) - np.pi
        angle = start + np.linspace(0, sweep, max(2, int(abs(sweep) * radius_m / _STEP_M)))
        pieces.append(centre + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    pieces.append(np.asarray(corners[-1], float)[None])
    rough = np.concatenate(pieces)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rough, axis=0), axis=1))])
    even = np.linspace(0, length[-1], int(length[-1] / _STEP_M) + 1)
    return np.stack([np.interp(even, length, rough[:, i]) for i in range(2)], axis=1)


class Speed:
    """A speed profile: linear between knots (t_s, v_m_s), constant before and after."""

    def __init__(self, *knots: tuple[float, float]) -> None:
        self._t, self._v = (np.array(column, float) for column in zip(*knots, strict=True))
        steps = np.diff(self._t) * (self._v[1:] + self._v[:-1]) / 2
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])

    def distance(self, times_s: Float) -> Float:
        """(N,) -> (N,) metres travelled since the first knot (negative before it)."""
        i = np.clip(np.searchsorted(self._t, times_s, side="right") - 1, 0, len(self._t) - 1)
        after = np.minimum(i + 1, len(self._t) - 1)
        span = np.where(after > i, self._t[after] - self._t[i], 1.0)
        slope = np.where(times_s < self._t[0], 0.0, (self._v[after] - self._v[i]) / span)
        dt = times_s - self._t[i]
        travelled: Float = self._travelled[i] + self._v[i] * dt + slope * dt**2 / 2
        return travelled
