# SPDX-License-Identifier: MIT
"""Build the ground: a smooth hilly surface, the roads on it, and a mesh with kerbs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from densify.geometry.types import Float
from densify.street.materials import Material
from densify.street.mesh import Mesh

_STEP_M = 0.5
Spans = Sequence[tuple[float, float]]


class Curve:
    """A smooth planar curve, from arc length 0 to ``length_m`` and straight beyond its ends."""

    def __init__(self, xy: Float) -> None:
        """Build the curve through (N,2) points in metres, neighbours about half a metre apart."""
        chord_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        self.length_m = float(chord_m[-1])
        self.knots_m: Float = chord_m
        self._spline = CubicSpline(chord_m, xy)
        self._slope = self._spline.derivative()

    def __call__(self, station_m: Float) -> Float:
        """Return (N,2) points at (N,) arc lengths."""
        inside = np.clip(station_m, 0.0, self.length_m)
        if np.array_equal(inside, station_m):  # the tangent is not needed
            return self._spline(inside)
        return self.with_tangent(station_m)[0]

    def with_tangent(self, station_m: Float) -> tuple[Float, Float]:
        """Return the points (N,2) of the curve at (N,) arc lengths, and its `tangent` there."""
        inside = np.clip(station_m, 0.0, self.length_m)
        tangent = self.tangent(inside)
        return self._spline(inside) + (station_m - inside)[..., None] * tangent, tangent

    def tangent(self, station_m: Float) -> Float:
        """Return (N,2) unit directions of travel at (N,) arc lengths."""
        slope = self._slope(np.clip(station_m, 0.0, self.length_m))
        squared = slope * slope  # faster than np.linalg.norm
        unit: Float = slope / np.sqrt(squared[..., :1] + squared[..., 1:])
        return unit

    def normal(self, station_m: Float) -> Float:
        """Return (N,2) unit vectors to the left of the direction of travel at (N,) arc lengths."""
        return left_of(self.tangent(station_m))

    @staticmethod
    def bending(
        length_m: float, curvature: Callable[[Float], Float], origin_m: float = 0.0
    ) -> Curve:
        """Return a curve by curvature (1/m, left positive), through the origin along +x."""
        step = 0.05
        station = np.arange(0.0, length_m + step, step)
        heading = np.concatenate([[0.0], np.cumsum(curvature(station[:-1] + step / 2) * step)])
        middle = (heading[1:] + heading[:-1]) / 2
        steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        xy = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
        start = round(origin_m / step)  # at this arc length it passes the origin
        c, s = np.cos(heading[start]), np.sin(heading[start])
        xy = (xy - xy[start]) @ np.array([[c, -s], [s, c]])
        return Curve(xy[:: round(_STEP_M / step)])


def left_of(forward: Float) -> Float:
    """Return (...,2) vectors turned to the left by a right angle."""
    return np.stack([-forward[..., 1], forward[..., 0]], axis=-1)


class Lane:
    """A path along a road: its centreline shifted sideways, possibly driven backwards."""

    def __init__(
        self, road: Curve, offset_m: float | Callable[[Float], Float], forward: bool = True
    ) -> None:
        """Build the lane, ``offset_m`` (a number, or a function of station) to the left."""
        stations = road.knots_m
        offset = offset_m(stations) if callable(offset_m) else np.full(len(stations), offset_m)
        xy = road(stations) + road.normal(stations) * offset[:, None]
        self.curve = Curve(xy if forward else xy[::-1])
        self._abreast_m = self.curve.knots_m[:: 1 if forward else -1]
        self._stations = stations

    def at(self, station_m: float) -> float:
        """Return the arc length on this lane beside a station (arc length) of the road."""
        return float(np.interp(station_m, self._stations, self._abreast_m))


def polyline(corners: Sequence[Float | tuple[float, float]], radius_m: float) -> Float:
    """Return (N,2) points, half a metre apart, along straight lines with rounded corners."""
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
        """Return (N,) metres travelled since the first knot, negative before it."""
        i = np.clip(np.searchsorted(self._t, times_s, side="right") - 1, 0, len(self._t) - 1)
        after = np.minimum(i + 1, len(self._t) - 1)
        span = np.where(after > i, self._t[after] - self._t[i], 1.0)
        slope = np.where(times_s < self._t[0], 0.0, (self._v[after] - self._v[i]) / span)
        dt = times_s - self._t[i]
        travelled: Float = self._travelled[i] + self._v[i] * dt + slope * dt**2 / 2
        return travelled


_CORNER_RADIUS_M = 9.0
_COARSE_M = 8.0  # cells of the ground far from roads


@dataclass(frozen=True)
class Terrain:
    """Height of the bare ground as a sum of W waves, ``sum a sin(k·xy + phase)``."""

    wave: Float  # (W,2) wave vectors k in rad/m
    amplitude_m: Float  # (W,) amplitudes a
    phase: Float  # (W,) phases in rad

    @staticmethod
    def hilly(rng: np.random.Generator, max_slope: float, scale_m: float = 1.0) -> Terrain:
        """Return three waves in random directions, nowhere steeper than ``max_slope``."""
        length_m = np.array([95.0, 150.0, 240.0]) * scale_m
        angle = rng.uniform(0, 2 * np.pi, 3)
        wave = (2 * np.pi / length_m)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        share = max_slope * np.array([0.25, 0.35, 0.4])
        return Terrain(wave, share / np.linalg.norm(wave, axis=1), rng.uniform(0, 2 * np.pi, 3))

    def height(self, xy: Float) -> Float:
        """Return (N,) heights in metres at (N,2) positions."""
        z: Float = np.sin(xy @ self.wave.T + self.phase) @ self.amplitude_m
        return z

    def slope(self, xy: Float) -> Float:
        """Return (N,2) gradients of the height at (N,2) positions."""
        gradient: Float = (np.cos(xy @ self.wave.T + self.phase) * self.amplitude_m) @ self.wave
        return gradient


@dataclass(frozen=True)
class Road:
    """A road: a strip that extends ``left_m`` and ``right_m`` metres from its centreline."""

    curve: Curve
    left_m: float
    right_m: float

    @cached_property
    def _samples(self) -> tuple[Float, cKDTree]:
        stations = np.arange(0.0, self.curve.length_m, 2.0)
        return stations, cKDTree(self.curve(stations))

    def coordinates(self, xy: Float) -> tuple[Float, Float]:
        """Return the (N,) arc length along the road, and the (N,) offset to its left, in metres."""
        stations, tree = self._samples
        station = stations[tree.query(xy)[1]]
        for _ in range(3):  # from the nearest sample to the foot of the perpendicular
            foot, tangent = self.curve.with_tangent(station)
            away = xy - foot
            station = station + np.einsum("ni,ni->n", away, tangent)
        return station, away[:, 1] * tangent[:, 0] - away[:, 0] * tangent[:, 1]

    def distance(self, xy: Float) -> Float:
        """Return (N,) signed metres to the edge of the strip, negative on the road."""
        station, offset = self.coordinates(xy)
        across = np.maximum(offset - self.left_m, -self.right_m - offset)
        return np.maximum(across, np.maximum(-station, station - self.curve.length_m))


@dataclass(frozen=True)
class Ground:
    """Terrain with roads on it."""

    terrain: Terrain
    roads: tuple[Road, ...]
    kerb_m: float  # height of the kerb, by which everything outside the roads is raised
    pavement_m: float  # width of the pavement beside the roads

    def distance(self, xy: Float) -> Float:
        """Return (N,) signed metres to the kerb, negative on the carriageway."""
        distance = self.roads[0].distance(xy)
        for road in self.roads[1:]:
            other = road.distance(xy)
            r = _CORNER_RADIUS_M
            distance = np.maximum(r, np.minimum(distance, other)) - np.hypot(
                np.maximum(r - distance, 0), np.maximum(r - other, 0)
            )
        return distance

    def height(self, xy: Float) -> Float:
        """Return (N,) heights in metres of the surface, kerbs included."""
        return self.terrain.height(xy) + self.kerb_m * (self.distance(xy) > 0)

    def mesh(self, margin_m: float, cell_m: float, far_m: float = 200.0) -> Mesh:
        """Return triangles fine up to ``margin_m`` from roads, coarse up to ``far_m``."""
        centre = np.concatenate([r.curve(r.curve.knots_m) for r in self.roads])
        low, high = centre.min(axis=0) - margin_m - 4, centre.max(axis=0) + margin_m + 4
        corners, quads = _grid(low, high, cell_m)
        distance = self.distance(corners)
        quads = quads[(distance[quads] < margin_m).any(axis=1)]
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        return Mesh.join(
            [self._near(corners, distance, triangles), self._far(low, high, far_m, margin_m)]
        )

    def _near(self, xy: Float, distance: Float, triangles: Float) -> Mesh:
        """Return triangles cut at the edge of the carriageway, and the upright kerb."""
        pieces: list[tuple[Float, int]] = []  # (K,3,2) corners, side
        edges: list[Float] = []  # (K,2,2), the road on the left
        # Triangles are cut along the zero line of the signed distance to the kerb.
        negative = distance[triangles] < 0
        count = negative.sum(axis=1)
        pieces += [(xy[triangles[count == 3]], 0), (xy[triangles[count == 0]], 1)]
        for lone_is_road in (True, False):
            mixed = count == (1 if lone_is_road else 2)
            corner = triangles[mixed]
            lone = np.argmax(negative[mixed] == lone_is_road, axis=1)
            corner = np.take_along_axis(corner, (lone[:, None] + np.arange(3)) % 3, axis=1)
            a, b, c = (xy[corner[:, i]] for i in range(3))
            da, db, dc = (distance[corner[:, i]][:, None] for i in range(3))
            ab, ac = a + (b - a) * da / (da - db), a + (c - a) * da / (da - dc)
            pieces.append((np.stack([a, ab, ac], axis=1), 0 if lone_is_road else 1))
            rest = [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
            pieces.append((np.concatenate(rest), 1 if lone_is_road else 0))
            edges.append(np.stack([ab, ac] if lone_is_road else [ac, ab], axis=1))
        meshes = [self._flat(corners, side) for corners, side in pieces]
        if self.kerb_m > 0:
            meshes.append(self._upright(np.concatenate(edges)))
        return Mesh.join(meshes)

    def _flat(self, corners: Float, side: int) -> Mesh:
        """Return the mesh of (K,3,2) triangles of the road (side 0) or beside it (side 1)."""
        flat = corners.reshape(-1, 2)
        k = len(corners)
        beside = self.distance(corners.mean(axis=1)) < self.pavement_m if side else np.zeros(k)
        kinds = Material.ASPHALT, Material.GRASS, Material.PAVING
        return Mesh(
            vertices=np.column_stack([flat, self.terrain.height(flat) + self.kerb_m * side]),
            triangles=np.arange(3 * k).reshape(k, 3),
            uv=flat,
            material=np.array(kinds, np.int16)[(side + beside).astype(int)],
            tint=np.ones((k, 3)),
            instance=np.full(k, -1, np.int32),
        )

    def _upright(self, edges: Float) -> Mesh:
        """Return the faces of the kerb above (K,2,2) lines on the ground."""
        z = self.terrain.height(edges.reshape(-1, 2)).reshape(-1, 2, 1)
        low = np.concatenate([edges, z], axis=2)
        high = low + [0.0, 0.0, self.kerb_m]
        corners = np.stack([low[:, 1], low[:, 0], high[:, 0], high[:, 1]], axis=1)
        return Mesh.quads(corners, Material.KERB)

    def _far(self, low: Float, high: Float, far_m: float, margin_m: float) -> Mesh:
        corners, quads = _grid(low - far_m, high + far_m, _COARSE_M)
        covered = self.distance(corners) < margin_m - 1.5 * _COARSE_M
        # Coarse triangles are sunk where fine ones cover them.
        z = self.terrain.height(corners) + np.where(covered, -1.0, self.kerb_m - 0.05)
        return Mesh.quads(np.column_stack([corners, z])[quads], Material.GRASS)


def _grid(low: Float, high: Float, cell_m: float) -> tuple[Float, Float]:
    """Return the corners (N,2) of a regular grid and its cells (M,4), anticlockwise."""
    nx, ny = (int(np.ceil(v)) + 1 for v in (high - low) / cell_m)
    x, y = np.meshgrid(low[0] + cell_m * np.arange(nx), low[1] + cell_m * np.arange(ny))
    i = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    return np.column_stack([x.ravel(), y.ravel()]), np.stack([i, i + 1, i + nx + 1, i + nx], axis=1)


def strip(ground: Ground, curve: Curve, offset_m: float, width_m: float, spans: Spans) -> Mesh:
    """Return paint on the road: a band along the curve over spans of arc length (from, to)."""
    meshes = []
    for begin, end in spans:
        stations = np.linspace(begin, end, max(2, int((end - begin) / 1.0) + 1))
        middle, normal = curve(stations), curve.normal(stations)
        sides = (middle + normal * (offset_m + shift) for shift in (-width_m / 2, width_m / 2))
        right, left = (np.column_stack([s, ground.terrain.height(s) + 0.006]) for s in sides)
        corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
        meshes.append(Mesh.quads(corners, Material.PAINT))
    return Mesh.join(meshes)
