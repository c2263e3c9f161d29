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
_CORNER_RADIUS_M = 9.0  # radius of the kerb where two roads meet
_SAMPLE_M = 2.0  # distance between the sampled points of a road
_NUM_STEPS = 3  # Newton steps from the nearest sample to the foot of the perpendicular
_COARSE_M = 8.0  # size of the cells of the coarse ground
_FAR_M = 200.0  # width of the coarse ground outside the fine ground
_BORDER_M = 4.0  # width of the fine grid outside the margin of the roads
_OVERLAP_M = 1.5 * _COARSE_M  # width of the overlap of fine and coarse ground
_SUNK_M = -1.0  # height of the coarse ground under the fine ground, relative to the terrain
_BELOW_KERB_M = -0.05  # height of the coarse ground elsewhere, relative to the raised ground
_LINE_M, _DASH_M, _DASH_EVERY_M = 0.12, 3.0, 9.0  # width of lines, length and period of dashes
_PAINT_M = 0.006  # height of paint over the road


@dataclass(frozen=True)
class Road:
    """A road: a strip that extends ``left_m`` and ``right_m`` metres from its centreline."""

    curve: Curve  # centreline
    left_m: float
    right_m: float

    @cached_property
    def _samples(self) -> tuple[Float, cKDTree]:
        """The arc lengths of points of the centreline, and a tree of the points."""
        stations = np.arange(0.0, self.curve.length_m, _SAMPLE_M)
        return stations, cKDTree(self.curve(stations))

    def distance(self, xy: Float) -> Float:
        """Return the metres from world points (N,2) to the strip as (N,), negative inside."""
        stations, tree = self._samples
        station = stations[tree.query(xy)[1]]
        for _ in range(_NUM_STEPS):  # from the nearest sample to the foot of the perpendicular
            foot, tangent = self.curve.with_tangent(station)
            away = xy - foot
            station = station + np.einsum("ni,ni->n", away, tangent)
        left_of_centre_m = away[:, 1] * tangent[:, 0] - away[:, 0] * tangent[:, 1]
        to_side_m = np.maximum(left_of_centre_m - self.left_m, -self.right_m - left_of_centre_m)
        to_end_m = np.maximum(-station, station - self.curve.length_m)
        return np.maximum(to_side_m, to_end_m)


@dataclass(frozen=True)
class Ground:
    """Terrain with roads on it."""

    terrain: Terrain  # bare ground
    roads: tuple[Road, ...]  # roads, whose strips together are the carriageway
    kerb_m: float  # height of the kerb, by which everything outside the roads is raised
    pavement_m: float  # width of the pavement beside the roads

    def distance(self, xy: Float) -> Float:
        """Return the metres from world points (N,2) to the kerb as (N,), negative on roads."""
        # Union of signed distances a and b with inner corners of radius r:
        # max(r, min(a, b)) - hypot(max(r - a, 0), max(r - b, 0))
        distance_m = self.roads[0].distance(xy)
        radius_m = _CORNER_RADIUS_M
        for road in self.roads[1:]:
            to_road_m = road.distance(xy)
            distance_m = np.maximum(radius_m, np.minimum(distance_m, to_road_m)) - np.hypot(
                np.maximum(radius_m - distance_m, 0), np.maximum(radius_m - to_road_m, 0)
            )
        return distance_m

    def height(self, xy: Float) -> Float:
        """Return the heights (N,) of the surface in metres at world points (N,2), with kerbs."""
        return self.terrain.height(xy) + self.kerb_m * (self.distance(xy) > 0)

    def mesh(self, margin_m: float, cell_m: float) -> Mesh:
        """Return the mesh: cells of ``cell_m`` within ``margin_m`` of roads, of 8 m elsewhere."""
        centre = np.concatenate([road.curve(road.curve.knots_m) for road in self.roads])
        low = centre.min(axis=0) - margin_m - _BORDER_M
        high = centre.max(axis=0) + margin_m + _BORDER_M
        corners, quads = _grid(low, high, cell_m)
        distance = self.distance(corners)
        quads = quads[(distance[quads] < margin_m).any(axis=1)]
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        fine = self._fine(corners, distance, triangles)
        return Mesh.join([fine, self._coarse(low, high, margin_m)])

    def _fine(self, xy: Float, distance: Float, triangles: Float) -> Mesh:
        """Return the mesh of triangles, cut at the edge of the road, and of the upright kerb."""
        # Triangles are cut along the zero line of the signed distance to the kerb.
        is_on_road = distance[triangles] < 0
        num_on_road = is_on_road.sum(axis=1)
        road_corners, beside_corners = (xy[triangles[num_on_road == num]] for num in (3, 0))
        meshes = [self._flat(road_corners, False), self._flat(beside_corners, True)]
        edges: list[Float] = []  # (K,2,2), the road on the left
        # A triangle across the kerb has one lone corner a, on the road or beside it.
        for lone_is_road in (True, False):
            is_mixed = num_on_road == (1 if lone_is_road else 2)
            corner = triangles[is_mixed]
            lone = np.argmax(is_on_road[is_mixed] == lone_is_road, axis=1)
            # Corners in cyclic order, the lone corner first
            corner = np.take_along_axis(corner, (lone[:, None] + np.arange(3)) % 3, axis=1)
            a, b, c = xy[corner.T]
            to_kerb_a, to_kerb_b, to_kerb_c = distance[corner.T, None]
            # Points of the kerb on the sides a-b and a-c, where the linear distance is 0
            ab = a + (b - a) * to_kerb_a / (to_kerb_a - to_kerb_b)
            ac = a + (c - a) * to_kerb_a / (to_kerb_a - to_kerb_c)
            quad_halves = [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
            meshes.append(self._flat(np.stack([a, ab, ac], axis=1), not lone_is_road))
            meshes.append(self._flat(np.concatenate(quad_halves), lone_is_road))
            edges.append(np.stack([ab, ac] if lone_is_road else [ac, ab], axis=1))
        if self.kerb_m > 0:
            meshes.append(self._upright(np.concatenate(edges)))
        return Mesh.join(meshes)

    def _flat(self, corners: Float, is_beside: bool) -> Mesh:
        """Return the mesh of (K,3,2) triangles of the road or beside it."""
        xy = corners.reshape(-1, 2)
        num = len(corners)
        material = np.full(num, Material.ASPHALT, np.int16)
        if is_beside:
            is_paved = self.distance(corners.mean(axis=1)) < self.pavement_m
            material[:] = np.where(is_paved, Material.PAVING, Material.GRASS)
        return Mesh(
            vertices=np.column_stack([xy, self.terrain.height(xy) + self.kerb_m * is_beside]),
            triangles=np.arange(3 * num).reshape(num, 3),
            uv=xy,
            material=material,
            tint=np.ones((num, 3)),
            instance=np.full(num, -1, np.int32),
        )

    def _upright(self, edges: Float) -> Mesh:
        """Return the faces of the kerb above (K,2,2) lines on the ground."""
        height_m = self.terrain.height(edges.reshape(-1, 2)).reshape(-1, 2, 1)
        bottom = np.concatenate([edges, height_m], axis=2)
        top = bottom + [0.0, 0.0, self.kerb_m]
        corners = np.stack([bottom[:, 1], bottom[:, 0], top[:, 0], top[:, 1]], axis=1)
        return Mesh.quads(corners, Material.KERB)

    def _coarse(self, low: Float, high: Float, margin_m: float) -> Mesh:
        """Return large quads, sunk where fine triangles cover them."""
        corners, quads = _grid(low - _FAR_M, high + _FAR_M, _COARSE_M)
        is_covered = self.distance(corners) < margin_m - _OVERLAP_M
        uncovered_m = self.kerb_m + _BELOW_KERB_M
        z = self.terrain.height(corners) + np.where(is_covered, _SUNK_M, uncovered_m)
        return Mesh.quads(np.column_stack([corners, z])[quads], Material.GRASS)


def _grid(low: Float, high: Float, cell_m: float) -> tuple[Float, Float]:
    """Return the corners (N,2) of a regular grid, and the corner indices (M,4) of its quads."""
    num_x, num_y = (int(np.ceil(num_cells)) + 1 for num_cells in (high - low) / cell_m)
    x, y = np.meshgrid(low[0] + cell_m * np.arange(num_x), low[1] + cell_m * np.arange(num_y))
    corners = np.column_stack([x.ravel(), y.ravel()])
    lower_left = (np.arange(num_y - 1)[:, None] * num_x + np.arange(num_x - 1)).ravel()
    upper_left = lower_left + num_x  # corners are row by row, quads go round anticlockwise
    return corners, np.stack([lower_left, lower_left + 1, upper_left + 1, upper_left], axis=1)


@dataclass(frozen=True)
class Side:
    """One side (+1 left, -1 right) of a road between two stations (arc lengths)."""

    road: Road
    side: int  # 1 on the left of the centreline, -1 on the right
    begin_m: float  # first station
    end_m: float  # last station

    def at(self, station_m: float, beyond_kerb_m: float) -> Float:
        """Return the world point (2,), ``beyond_kerb_m`` metres outside the kerb at a station."""
        station = np.array([station_m])
        edge_m = self.road.left_m if self.side > 0 else self.road.right_m
        normal = self.road.curve.normal(station)[0] * self.side
        point: Float = self.road.curve(station)[0] + normal * (edge_m + beyond_kerb_m)
        return point

    def heading(self, station_m: float) -> float:
        """Return the heading (rad) of a mesh whose -y axis points to the road at a station."""
        forward = self.forward(station_m)
        return float(np.arctan2(-forward[1], -forward[0]))

    def forward(self, station_m: float) -> Float:
        """Return the world unit vector (2,) of this side's traffic, which keeps to the right."""
        tangent: Float = self.road.curve.tangent(np.array([station_m]))[0] * -self.side
        return tangent


def mark_road(ground: Ground, road: Road, row: Any, spans: Spans) -> Mesh:
    """Return the mesh of the painted lines on a road.

    ``row`` is a row of ``markings`` in scenes.yaml. ``spans`` has the [begin, end] of each painted
    part, as arc lengths in metres.
    """
    dashes = [
        (station, station + _DASH_M)
        for begin, end in spans
        for station in np.arange(begin, end - _DASH_M, _DASH_EVERY_M)
    ]
    bands = [(offset_m, *dash) for offset_m in row.dashed for dash in dashes]
    bands += [(offset_m, *span) for offset_m in row.solid for span in spans]
    half_m = getattr(row, "width_m", _LINE_M) / 2
    meshes = []
    for offset_m, begin, end in bands:
        stations = np.linspace(begin, end, max(2, int(end - begin) + 1))  # a metre apart
        middle, normal = road.curve(stations), road.curve.normal(stations)
        sides = (middle + normal * (offset_m + shift) for shift in (-half_m, half_m))
        right, left = (
            np.column_stack([side, ground.terrain.height(side) + _PAINT_M]) for side in sides
        )
        corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
        meshes.append(Mesh.quads(corners, Material.PAINT))
    return Mesh.join(meshes)
