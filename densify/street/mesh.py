# SPDX-License-Identifier: MIT
"""Build triangle meshes from simple solids, with a material for each triangle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Float, Int
from densify.street import read_table

Tint = Sequence[float]
Point = Sequence[float]
WHITE: Tint = (1.0, 1.0, 1.0)
_TINY = 1e-9
_UPRIGHT = 0.9  # least z of a unit vector that is too steep for a cross product with the z axis
# Ranges of the random factors on the half size and on the tint of a leaf
_LEAF_SIZES, _LEAF_TINTS = (0.35, 0.65), (0.65, 1.35)


class Material(IntEnum):
    """A material of materials.yaml."""

    ASPHALT = 0
    PAVING = 1
    KERB = 2
    GRASS = 3
    PAINT = 4
    BRICK = 5
    PLASTER = 6
    ROOF = 7
    PANE = 8  # window of a house: dark, no ray passes
    WOOD = 9
    METAL = 10
    BARK = 11
    LEAF = 12
    BODYWORK = 13
    GLASS = 14  # of a vehicle
    RUBBER = 15
    CLOTH = 16
    SKIN = 17
    LAMP = 18
    UPHOLSTERY = 19
    CONCRETE = 20
    FRAME = 21  # bodywork around and above car windows


_SURFACES = [getattr(read_table("materials"), material.name) for material in Material]
COLOUR, REFLECTIVITY, GLOSS = (
    np.array([getattr(surface, column) for surface in _SURFACES])
    for column in ("colour", "reflectivity", "gloss")
)


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
        """Return the union of meshes, of which at least one must have a triangle."""
        meshes = [mesh for mesh in meshes if len(mesh.triangles)]
        columns = {
            field.name: np.concatenate([getattr(mesh, field.name) for mesh in meshes])
            for field in fields(Mesh)
        }
        # Vertex indices count from the first vertex of their mesh in the union.
        first_vertex = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])[:-1]
        num_triangles = [len(mesh.triangles) for mesh in meshes]
        columns["triangles"] += np.repeat(first_vertex, num_triangles)[:, None]
        return Mesh(**columns)

    @staticmethod
    def quads(corners: Float, material: Material, tint: Tint | Float = WHITE) -> Mesh:
        """Return a mesh of quads (K,4,3), metres, corners in order around, without object numbers.

        Texture x is along the first side. ``tint`` is (3,) for all quads or (K,3).
        """
        corners, num_quads = np.asarray(corners, float), len(corners)
        first_side = corners[:, 1] - corners[:, 0]
        last_side = corners[:, 3] - corners[:, 0]
        # Two perpendicular axes in the plane of each quad are the axes of its texture.
        x_axis = first_side / np.maximum(lengths(first_side), _TINY)
        y_axis = last_side - np.einsum("ki,ki->k", last_side, x_axis)[:, None] * x_axis
        axes = np.stack([x_axis, y_axis / np.maximum(lengths(y_axis), _TINY)], axis=1)
        halves = np.array([0, 1, 2, 0, 2, 3])  # corners of the two triangles of a quad
        return Mesh(
            vertices=corners.reshape(-1, 3),
            triangles=(np.arange(0, 4 * num_quads, 4)[:, None] + halves).reshape(-1, 3),
            uv=np.einsum("kci,kai->kca", corners, axes).reshape(-1, 2),
            material=np.full(2 * num_quads, material, np.int16),
            tint=np.repeat(np.broadcast_to(tint, (num_quads, 3)), 2, axis=0),
            instance=np.full(2 * num_quads, -1, np.int32),
        )

    def posed(self, T_a_mesh: Float) -> Mesh:
        """Return the mesh in frame a, given the pose ``T_a_mesh`` (4,4) of its present frame."""
        return replace(self, vertices=self.vertices @ T_a_mesh[:3, :3].T + T_a_mesh[:3, 3])

    def of_instance(self, instance: int) -> Mesh:
        """Return the mesh with this object number for all of its triangles."""
        return replace(self, instance=np.full(len(self.triangles), instance, np.int32))

    @cached_property
    def bounds(self) -> tuple[Float, Float]:
        """The lowest and the highest coordinates of the vertices, (3,) each, in metres."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def box(low: Point | Float, high: Point | Float, material: Material, tint: Tint = WHITE) -> Mesh:
    """Return the mesh of upright boxes between two opposite corners, (3,) or (K,3), in metres."""
    # For each corner of each side: 1 where x, y, z are those of the highest corner of the box
    is_high = np.array(
        [
            [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
            [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
            [(1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)],
            [(0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)],
            [(0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0)],
            [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
        ],
        bool,
    )
    lowest, highest = (np.reshape(corner, (-1, 1, 1, 3)) for corner in (low, high))
    faces = np.where(is_high, highest, lowest).astype(float)
    return Mesh.quads(faces.reshape(-1, 4, 3), material, tint)


def frustum(
    low: Point, high: Point, material: Material, tint: Tint = WHITE, taper: Point = (1.0, 1.0)
) -> Mesh:
    """Return a box between two corners (3,), metres, whose top is scaled by ``taper`` in x, y."""
    lowest, highest = np.asarray(low, float), np.asarray(high, float)
    middle = (lowest + highest)[:2] / 2
    half = (highest - lowest)[:2] / 2
    ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    bottom = np.column_stack([middle + ring * half, np.full(4, lowest[2])])
    top = np.column_stack([middle + ring * half * taper, np.full(4, highest[2])])
    next_corner = [1, 2, 3, 0]
    sides = np.stack([bottom, bottom[next_corner], top[next_corner], top], axis=1)
    caps = np.stack([bottom[::-1], top])
    return Mesh.quads(np.concatenate([sides, caps]), material, tint)


def tube(
    start: Point,
    end: Point,
    radius_m: float | Point,
    material: Material,
    tint: Tint = WHITE,
    num_sides: int = 8,
) -> Mesh:
    """Return a closed cylinder or cone along the line from ``start`` (3,) to ``end`` (3,), metres.

    ``radius_m`` is one radius for both ends, or the radii at start and end.
    """
    a, b = np.asarray(start, float), np.asarray(end, float)
    start_radius_m, end_radius_m = np.broadcast_to(radius_m, 2)
    # Two unit vectors u and v span the plane of the rings.
    axis = (b - a) / np.linalg.norm(b - a)
    is_upright = abs(axis[2]) >= _UPRIGHT
    u = np.cross(np.array([1.0, 0.0, 0.0] if is_upright else [0.0, 0.0, 1.0]), axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = 2 * np.pi * np.arange(num_sides)[:, None] / num_sides
    ring = np.cos(angle) * u + np.sin(angle) * v
    start_ring, end_ring = a + start_radius_m * ring, b + end_radius_m * ring
    next_corner = np.roll(np.arange(num_sides), -1)
    next_start, next_end = start_ring[next_corner], end_ring[next_corner]
    side = (start_ring, next_start, next_end, end_ring)
    caps = ((a, next_start, start_ring, a), (b, end_ring, next_end, b))
    quads = [np.stack(np.broadcast_arrays(*quad), axis=1) for quad in (side, *caps)]
    return Mesh.quads(np.concatenate(quads), material, tint)


def ball(centre: Point, radius_m: Point, material: Material, tint: Tint = WHITE) -> Mesh:
    """Return an ellipsoid with the radii (3,) along x, y and z, of 6 rings and 10 sectors."""
    latitude, longitude = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, 6 + 1), np.linspace(0, 2 * np.pi, 10 + 1), indexing="ij"
    )
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    unit = np.stack([x, y, np.sin(latitude)], axis=2)
    points = unit * np.asarray(radius_m) + np.asarray(centre)  # (ring, sector, 3)
    below, above = points[:-1], points[1:]
    corners = np.stack([below[:, :-1], below[:, 1:], above[:, 1:], above[:, :-1]], axis=2)
    return Mesh.quads(corners.reshape(-1, 4, 3), material, tint)


def leaves(centres: Float, size_m: float, rng: np.random.Generator, tint: Tint = WHITE) -> Mesh:
    """Return squares at ``centres`` (K,3), metres, turned at random, each a bunch of leaves."""
    num_leaves = len(centres)
    # Unit vectors along the sides of each square
    u = rng.normal(size=(num_leaves, 3))
    u /= lengths(u)
    v = np.cross(u, rng.normal(size=(num_leaves, 3)))
    v /= lengths(v)
    half = (size_m * rng.uniform(*_LEAF_SIZES, num_leaves))[:, None]
    corners = [centres + half * (i * u + j * v) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    tints = np.asarray(tint) * rng.uniform(*_LEAF_TINTS, (num_leaves, 1))
    return Mesh.quads(np.stack(corners, axis=1), Material.LEAF, tints)


def lengths(vectors: Float) -> Float:
    """Return the lengths (N,1) of vectors (N,3), faster than np.linalg.norm."""
    squared = vectors * vectors
    return np.sqrt(squared[:, :1] + squared[:, 1:2] + squared[:, 2:])


# xxHash64's first two primes, then the factor of splitmix64
_PRIMES = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F], np.uint64)
_FACTOR = np.uint64(0xBF58476D1CE4E5B9)
_DOUBLE_BITS = 53


def noise(i: Int, j: Int) -> Float:
    """Return random numbers (N,) in [0, 1), always the same for the same two integers (N,)."""
    h = i.astype(np.uint64) * _PRIMES[0]
    h ^= j.astype(np.uint64) * _PRIMES[1]
    h ^= h >> np.uint64(29)
    h *= _FACTOR
    h ^= h >> np.uint64(32)
    return (h >> np.uint64(64 - _DOUBLE_BITS)) / 2.0**_DOUBLE_BITS
