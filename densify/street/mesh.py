# SPDX-License-Identifier: MIT
"""Triangle meshes with a material on each triangle, and the solids they are built from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from densify.street.materials import Material
from densify.types import Float

Tint = tuple[float, float, float]
WHITE: Tint = (1.0, 1.0, 1.0)
_BOX_FACES = (
    ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
    ((1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)),
    ((0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)),
    ((0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0)),
    ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
)


@dataclass(frozen=True)
class Mesh:
    """vertices: (V,3) metres. triangles: (T,3). uv: (V,2) metres on the surface. material: (T,).
    tint: (T,3) factors on the material's colour. instance: (T,) int32, -1 none."""

    vertices: Float
    triangles: NDArray[np.int64]
    uv: Float
    material: NDArray[np.int16]
    tint: Float
    instance: NDArray[np.int32]

    @staticmethod
    def join(meshes: Sequence[Mesh]) -> Mesh:
        meshes = [m for m in meshes if len(m.triangles)]
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        return Mesh(
            np.concatenate([m.vertices for m in meshes]),
            np.concatenate([m.triangles + s for m, s in zip(meshes, starts, strict=False)]),
            np.concatenate([m.uv for m in meshes]),
            np.concatenate([m.material for m in meshes]),
            np.concatenate([m.tint for m in meshes]),
            np.concatenate([m.instance for m in meshes]),
        )

    @staticmethod
    def quads(corners: Float, material: Material, tint: Tint | Float = WHITE) -> Mesh:
        """(K,4,3) corners in order round each quad; uv are metres along its first side and away
        from it."""
        k = len(corners)
        first = np.arange(k)[:, None] * 4
        triangles = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3)
        side = corners[:, 1] - corners[:, 0]
        along = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        away = corners[:, 3] - corners[:, 0]
        up = away - np.einsum("ki,ki->k", away, along)[:, None] * along
        up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
        uv = np.einsum("kci,kai->kca", corners, np.stack([along, up], axis=1))
        tints = np.broadcast_to(np.asarray(tint, float), (k, 3))
        return Mesh(
            corners.reshape(-1, 3),
            triangles,
            uv.reshape(-1, 2),
            np.full(2 * k, material, np.int16),
            np.repeat(tints, 2, axis=0),
            np.full(2 * k, -1, np.int32),
        )

    def moved(
        self, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, heading: float = 0.0
    ) -> Mesh:
        """Turned about the vertical by ``heading`` (rad), then shifted."""
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        return replace(self, vertices=self.vertices @ turn.T + [x_m, y_m, z_m])

    def posed(self, T_a_mesh: Float) -> Mesh:
        """(4,4) rigid motion of all vertices."""
        return replace(self, vertices=self.vertices @ T_a_mesh[:3, :3].T + T_a_mesh[:3, 3])

    def of_instance(self, instance: int) -> Mesh:
        return replace(self, instance=np.full(len(self.triangles), instance, np.int32))

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest corner, (3,) each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def box(
    low: Sequence[float], high: Sequence[float], material: Material, tint: Tint = WHITE
) -> Mesh:
    """An upright box between two corners."""
    return boxes([(low, high)], material, tint)


def boxes(
    spans: Sequence[tuple[Sequence[float], Sequence[float]]], material: Material, tint: Tint = WHITE
) -> Mesh:
    """Upright boxes, each between its lowest and its highest corner."""
    span = np.array(spans, float).reshape(-1, 2, 3)
    which = np.array(_BOX_FACES)  # (6,4,3) of 0 low, 1 high
    faces = np.where(which[None] == 1, span[:, None, None, 1], span[:, None, None, 0])
    return Mesh.quads(faces.reshape(-1, 4, 3), material, tint)


def frustum(
    low: Sequence[float],
    high: Sequence[float],
    material: Material,
    tint: Tint = WHITE,
    taper: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """A box whose top is scaled by ``taper`` in x and y about its own middle."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    middle, half = (
        np.array([(x0 + x1) / 2, (y0 + y1) / 2]),
        np.array([(x1 - x0) / 2, (y1 - y0) / 2]),
    )
    ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    bottom = np.column_stack([middle + ring * half, np.full(4, z0)])
    top = np.column_stack([middle + ring * half * taper, np.full(4, z1)])
    after = [1, 2, 3, 0]
    sides = np.stack([bottom, bottom[after], top[after], top], axis=1)
    caps = np.stack([bottom[[3, 2, 1, 0]], top])
    return Mesh.quads(np.concatenate([sides, caps]), material, tint)


def tube(
    start: Sequence[float],
    end: Sequence[float],
    radius_m: float | tuple[float, float],
    material: Material,
    tint: Tint = WHITE,
    num_sides: int = 8,
) -> Mesh:
    """A closed cylinder or cone (radius at start and end) between two points."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    radii = radius_m if isinstance(radius_m, tuple) else (radius_m, radius_m)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = 2 * np.pi * np.arange(num_sides) / num_sides
    ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    low, high = a + radii[0] * ring, b + radii[1] * ring
    after = np.roll(np.arange(num_sides), -1)
    sides = np.stack([low, low[after], high[after], high], axis=1)
    centre_a, centre_b = (np.broadcast_to(c, low.shape) for c in (a, b))
    caps = [
        np.stack([centre_a, low[after], low, centre_a], axis=1),
        np.stack([centre_b, high, high[after], centre_b], axis=1),
    ]
    return Mesh.quads(np.concatenate([sides, *caps]), material, tint)


def ball(
    centre: Sequence[float], radius_m: Sequence[float], material: Material, tint: Tint = WHITE
) -> Mesh:
    """An ellipsoid with radii along x, y, z."""
    lat = np.linspace(-np.pi / 2, np.pi / 2, 7)
    lon = np.linspace(0, 2 * np.pi, 11)
    la, lo = np.meshgrid(lat, lon, indexing="ij")
    p = np.stack([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)], axis=2)
    p = p * np.asarray(radius_m) + np.asarray(centre)
    corners = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], axis=2)
    return Mesh.quads(corners.reshape(-1, 4, 3), material, tint)


def leaves(centres: Float, size_m: float, rng: np.random.Generator, tint: Tint = WHITE) -> Mesh:
    """(K,3) -> a square leaf (a bunch of them) at each centre, turned at random."""
    k = len(centres)
    u = rng.normal(size=(k, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.normal(size=(k, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    half = (size_m * rng.uniform(0.35, 0.65, k))[:, None]
    corners = [centres + half * (i * u + j * v) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    tints = np.asarray(tint) * rng.uniform(0.65, 1.35, (k, 1))
    return Mesh.quads(np.stack(corners, axis=1), Material.LEAF, tints)
