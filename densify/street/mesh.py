# SPDX-License-Identifier: MIT
"""Build triangle meshes from simple solids, with a material for each triangle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float
from densify.street.materials import Material

Tint = tuple[float, float, float]
WHITE: Tint = (1.0, 1.0, 1.0)
_IS_HIGH = np.array(  # (6,4,3) of a box's corners, side by side
    (
        ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
        ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
        ((1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)),
        ((0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)),
        ((0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0)),
        ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
    ),
    bool,
)
_HALVES = np.array([0, 1, 2, 0, 2, 3])  # the triangles of a quad


@dataclass(frozen=True)
class Mesh:
    """A mesh of V vertices and T triangles."""

    vertices: Float  # (V,3) metres
    triangles: NDArray[np.int64]  # (T,3) vertex indices
    uv: Float  # (V,2) texture coordinates, metres on the surface
    material: NDArray[np.int16]  # (T,) materials
    tint: Float  # (T,3) factors on the colour of the material
    instance: NDArray[np.int32]  # (T,) int32 object numbers, -1 for none

    @staticmethod
    def join(meshes: Sequence[Mesh]) -> Mesh:
        """Return the union of several meshes."""
        meshes = [m for m in meshes if len(m.triangles)]
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        columns = {
            f.name: np.concatenate([getattr(m, f.name) for m in meshes]) for f in fields(Mesh)
        }
        columns["triangles"] += np.repeat(starts[:-1], [len(m.triangles) for m in meshes])[:, None]
        return Mesh(**columns)

    @staticmethod
    def quads(corners: Float, material: Material, tint: Tint | Float = WHITE) -> Mesh:
        """Return a mesh of (K,4,3) quads in order around. Texture x runs along their first side."""
        k = len(corners)
        side, away = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
        along = side / np.maximum(lengths(side), 1e-9)
        up = away - np.einsum("ki,ki->k", away, along)[:, None] * along
        axes = np.stack([along, up / np.maximum(lengths(up), 1e-9)], axis=1)
        return Mesh(
            corners.reshape(-1, 3),
            (np.arange(0, 4 * k, 4)[:, None] + _HALVES).reshape(-1, 3),
            np.einsum("kci,kai->kca", corners, axes).reshape(-1, 2),
            np.full(2 * k, material, np.int16),
            np.repeat(np.broadcast_to(tint, (k, 3)), 2, axis=0),
            np.full(2 * k, -1, np.int32),
        )

    def posed(self, T_a_mesh: Float) -> Mesh:
        """Return the mesh moved by a (4,4) rigid motion."""
        return replace(self, vertices=self.vertices @ T_a_mesh[:3, :3].T + T_a_mesh[:3, 3])

    def of_instance(self, instance: int) -> Mesh:
        """Return the mesh with all triangles assigned to this object number."""
        return replace(self, instance=np.full(len(self.triangles), instance, np.int32))

    @cached_property
    def bounds(self) -> tuple[Float, Float]:
        """Return the lowest and the highest corner, (3,) each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def box(
    low: Sequence[float], high: Sequence[float], material: Material, tint: Tint = WHITE
) -> Mesh:
    """Return an upright box between two corners."""
    return boxes([(low, high)], material, tint)


def boxes(
    spans: Sequence[tuple[Sequence[float], Sequence[float]]], material: Material, tint: Tint = WHITE
) -> Mesh:
    """Return upright boxes, each between its lowest and its highest corner."""
    span = np.array(spans, float).reshape(-1, 2, 3)
    faces = np.where(_IS_HIGH, span[:, None, None, 1], span[:, None, None, 0])
    return Mesh.quads(faces.reshape(-1, 4, 3), material, tint)


def frustum(
    low: Sequence[float],
    high: Sequence[float],
    material: Material,
    tint: Tint = WHITE,
    taper: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """Return a box whose top is scaled by ``taper`` in x and y about its own centre."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    middle, half = (a + b)[:2] / 2, (b - a)[:2] / 2
    ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    bottom = np.column_stack([middle + ring * half, np.full(4, a[2])])
    top = np.column_stack([middle + ring * half * taper, np.full(4, b[2])])
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
    """Return a closed cylinder or cone between two points, with a radius at each end."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    radii = radius_m if isinstance(radius_m, tuple) else (radius_m, radius_m)
    axis = (b - a) / np.linalg.norm(b - a)
    helper = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    u = across(helper, axis)
    u /= np.linalg.norm(u)
    v = across(axis, u)
    angle = 2 * np.pi * np.arange(num_sides)[:, None] / num_sides
    ring, after = np.cos(angle) * u + np.sin(angle) * v, np.roll(np.arange(num_sides), -1)
    low, high = a + radii[0] * ring, b + radii[1] * ring
    around = (low, low[after], high[after], high)
    caps = ((a, low[after], low, a), (b, high, high[after], b))
    quads = [np.stack(np.broadcast_arrays(*quad), axis=1) for quad in (around, *caps)]
    return Mesh.quads(np.concatenate(quads), material, tint)


def across(a: Float, b: Float) -> Float:
    """Return (...,3) cross products of (...,3) vectors; faster than np.cross."""
    product = np.empty(a.shape)
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.subtract(a[..., i] * b[..., j], a[..., j] * b[..., i], out=product[..., axis])
    return product


def lengths(vectors: Float) -> Float:
    """Return (N,1) lengths of (N,3) vectors; faster than np.linalg.norm."""
    squared = vectors * vectors
    return np.sqrt(squared[:, :1] + squared[:, 1:2] + squared[:, 2:])


def ball(
    centre: Sequence[float], radius_m: Sequence[float], material: Material, tint: Tint = WHITE
) -> Mesh:
    """Return an ellipsoid with radii along x, y and z."""
    la, lo = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, 7), np.linspace(0, 2 * np.pi, 11), indexing="ij"
    )
    p = np.stack([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)], axis=2)
    p = p * np.asarray(radius_m) + np.asarray(centre)
    corners = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], axis=2)
    return Mesh.quads(corners.reshape(-1, 4, 3), material, tint)


def leaves(centres: Float, size_m: float, rng: np.random.Generator, tint: Tint = WHITE) -> Mesh:
    """Return a square leaf (a bunch of leaves) at each of (K,3) centres, turned at random."""
    k = len(centres)
    u = rng.normal(size=(k, 3))
    u /= lengths(u)
    v = across(u, rng.normal(size=(k, 3)))
    v /= lengths(v)
    half = (size_m * rng.uniform(0.35, 0.65, k))[:, None]
    corners = [centres + half * (i * u + j * v) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    tints = np.asarray(tint) * rng.uniform(0.65, 1.35, (k, 1))
    return Mesh.quads(np.stack(corners, axis=1), Material.LEAF, tints)
