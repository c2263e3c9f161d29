# SPDX-License-Identifier: MIT
"""Build the ground: roads on the terrain, their kerbs and markings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from densify.geometry.types import Float
from densify.street.mesh import Material, Mesh
from densify.street.motion import Curve, Terrain

Spans = Sequence[Sequence[float]]
_CORNER_RADIUS_M = 9.0  # of the kerb where two roads meet
_SAMPLE_M, _NUM_STEPS = 2.0, 3  # between points of a road, and steps from there to the foot
_COARSE_M, _FAR_M = 8.0, 200.0  # cells of the ground far from roads, and their distance beyond it
_BORDER_M = 4.0  # of the grid beyond the margin of the roads
_OVERLAP_M = 1.5 * _COARSE_M  # of the fine and the coarse ground
_SUNK_M = -1.0  # height of the coarse ground below the fine one
_BELOW_KERB_M = -0.05  # height of the coarse ground beside the fine one over the raised ground
_LINE_M, _DASH_M, _DASH_EVERY_M = 0.12, 3.0, 9.0  # width of lane markings, dashes, their distance
_PAINT_M = 0.006  # height of paint over the road


@dataclass(frozen=True)
class Road:
    """A road: a strip that extends ``left_m`` and ``right_m`` metres from its centreline."""

    curve: Curve
    left_m: float
    right_m: float

    @cached_property
    def _samples(self) -> tuple[Float, cKDTree]:
        stations = np.arange(0.0, self.curve.length_m, _SAMPLE_M)
        return stations, cKDTree(self.curve(stations))

    def distance(self, xy: Float) -> Float:
        """Return (N,) signed metres to the edge of the strip, negative on the road."""
        stations, tree = self._samples
        station = stations[tree.query(xy)[1]]
        for _ in range(_NUM_STEPS):  # from the nearest sample to the foot of the perpendicular
            foot, tangent = self.curve.with_tangent(station)
            away = xy - foot
            station = station + np.einsum("ni,ni->n", away, tangent)
        offset = away[:, 1] * tangent[:, 0] - away[:, 0] * tangent[:, 1]  # to the left
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
            crossed, r = road.distance(xy), _CORNER_RADIUS_M
            distance = np.maximum(r, np.minimum(distance, crossed)) - np.hypot(
                np.maximum(r - distance, 0), np.maximum(r - crossed, 0)
            )
        return distance

    def height(self, xy: Float) -> Float:
        """Return (N,) heights in metres of the surface, kerbs included."""
        return self.terrain.height(xy) + self.kerb_m * (self.distance(xy) > 0)

    def mesh(self, margin_m: float, cell_m: float) -> Mesh:
        """Return triangles fine up to ``margin_m`` from roads, coarse beyond."""
        centre = np.concatenate([r.curve(r.curve.knots_m) for r in self.roads])
        low = centre.min(axis=0) - margin_m - _BORDER_M
        high = centre.max(axis=0) + margin_m + _BORDER_M
        corners, quads = _grid(low, high, cell_m)
        distance = self.distance(corners)
        quads = quads[(distance[quads] < margin_m).any(axis=1)]
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        fine = self._fine(corners, distance, triangles)
        return Mesh.join([fine, self._coarse(low, high, margin_m)])

    def _fine(self, xy: Float, distance: Float, triangles: Float) -> Mesh:
        """Return triangles cut at the edge of the carriageway, and the upright kerb."""
        # Triangles are cut along the zero line of the signed distance to the kerb.
        on_road = distance[triangles] < 0
        num_on_road = on_road.sum(axis=1)
        is_road, is_beside = (xy[triangles[num_on_road == num]] for num in (3, 0))
        meshes = [self._flat(is_road, False), self._flat(is_beside, True)]
        edges: list[Float] = []  # (K,2,2), the road on the left
        for lone_is_road in (True, False):
            mixed = num_on_road == (1 if lone_is_road else 2)
            corner = triangles[mixed]
            lone = np.argmax(on_road[mixed] == lone_is_road, axis=1)
            corner = np.take_along_axis(corner, (lone[:, None] + np.arange(3)) % 3, axis=1)
            a, b, c = (xy[corner[:, i]] for i in range(3))
            da, db, dc = (distance[corner[:, i]][:, None] for i in range(3))
            ab, ac = a + (b - a) * da / (da - db), a + (c - a) * da / (da - dc)
            pair = [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
            meshes.append(self._flat(np.stack([a, ab, ac], axis=1), not lone_is_road))
            meshes.append(self._flat(np.concatenate(pair), lone_is_road))
            edges.append(np.stack([ab, ac] if lone_is_road else [ac, ab], axis=1))
        if self.kerb_m > 0:
            meshes.append(self._upright(np.concatenate(edges)))
        return Mesh.join(meshes)

    def _flat(self, corners: Float, is_beside: bool) -> Mesh:
        """Return the mesh of (K,3,2) triangles of the road or beside it."""
        flat = corners.reshape(-1, 2)
        k = len(corners)
        material = np.full(k, Material.ASPHALT, np.int16)
        if is_beside:
            is_paved = self.distance(corners.mean(axis=1)) < self.pavement_m
            material[:] = np.where(is_paved, Material.PAVING, Material.GRASS)
        return Mesh(
            vertices=np.column_stack([flat, self.terrain.height(flat) + self.kerb_m * is_beside]),
            triangles=np.arange(3 * k).reshape(k, 3),
            uv=flat,
            material=material,
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

    def _coarse(self, low: Float, high: Float, margin_m: float) -> Mesh:
        """Return large quads, sunk where fine triangles cover them."""
        corners, quads = _grid(low - _FAR_M, high + _FAR_M, _COARSE_M)
        covered = self.distance(corners) < margin_m - _OVERLAP_M
        beside_m = self.kerb_m + _BELOW_KERB_M
        z = self.terrain.height(corners) + np.where(covered, _SUNK_M, beside_m)
        return Mesh.quads(np.column_stack([corners, z])[quads], Material.GRASS)


def _grid(low: Float, high: Float, cell_m: float) -> tuple[Float, Float]:
    """Return the corners (N,2) of a regular grid and its cells (M,4), anticlockwise."""
    nx, ny = (int(np.ceil(v)) + 1 for v in (high - low) / cell_m)
    x, y = np.meshgrid(low[0] + cell_m * np.arange(nx), low[1] + cell_m * np.arange(ny))
    i = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    return np.column_stack([x.ravel(), y.ravel()]), np.stack([i, i + 1, i + nx + 1, i + nx], axis=1)


@dataclass(frozen=True)
class Side:
    """One side (+1 left, -1 right) of a road between two stations (arc lengths)."""

    road: Road
    side: int
    begin_m: float
    end_m: float

    def at(self, station_m: float, beyond_kerb_m: float) -> Float:
        """Return the (2,) point ``beyond_kerb_m`` outside the kerb, abreast of the station."""
        station = np.array([station_m])
        edge_m = self.road.left_m if self.side > 0 else self.road.right_m
        normal = self.road.curve.normal(station)[0] * self.side
        point: Float = self.road.curve(station)[0] + normal * (edge_m + beyond_kerb_m)
        return point

    def heading(self, station_m: float) -> float:
        """Return the heading with which the +y axis of a mesh points away from the road."""
        return float(np.arctan2(*-self.forward(station_m)[::-1]))

    def forward(self, station_m: float) -> Float:
        """Return the (2,) direction of the traffic on this side. Traffic keeps to the right."""
        tangent: Float = self.road.curve.tangent(np.array([station_m]))[0] * -self.side
        return tangent


def mark_road(ground: Ground, road: Road, row: Any, spans: Spans) -> Mesh:
    """Paint the lines of a row of ``markings`` in scenes.yaml, only within the spans."""
    dashes = [
        (station, station + _DASH_M)
        for begin, end in spans
        for station in np.arange(begin, end - _DASH_M, _DASH_EVERY_M)
    ]
    lines: list[tuple[float, Spans]] = [(offset_m, dashes) for offset_m in row.dashed]
    lines += [(offset_m, spans) for offset_m in row.solid]
    width_m = getattr(row, "width_m", _LINE_M)
    return Mesh.join([_strip(ground, road.curve, m, width_m, where) for m, where in lines])


def _strip(ground: Ground, curve: Curve, offset_m: float, width_m: float, spans: Spans) -> Mesh:
    """Return paint on the road: a band along the curve over spans of arc length."""
    meshes = []
    for begin, end in spans:
        stations = np.linspace(begin, end, max(2, int(end - begin) + 1))  # a metre apart
        middle, normal = curve(stations), curve.normal(stations)
        sides = (middle + normal * (offset_m + shift) for shift in (-width_m / 2, width_m / 2))
        right, left = (np.column_stack([s, ground.terrain.height(s) + _PAINT_M]) for s in sides)
        corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
        meshes.append(Mesh.quads(corners, Material.PAINT))
    return Mesh.join(meshes)
