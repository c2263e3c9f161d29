# SPDX-License-Identifier: MIT
"""Rigid bodies that move, and rays cast among them, each at its own time.

Rays are taken into each body's frame by the body's pose at the ray's own time, so that a body that
moves while a sweep is taken is distorted exactly as in reality. This module is the only one that
imports Embree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.kernels import casting
from densify.street.materials import GLASS_PASSES
from densify.street.mesh import Mesh
from densify.street.motion import Poses, Still, Trajectory, poses_at
from densify.types import Bool, Float, Float32

_MAX_LAYERS = 8  # of glass and leaves that one ray passes


@dataclass(frozen=True)
class Body:
    """A rigid thing. mesh: in the body's frame. instance: the object it is part of, -1 none
    (then the triangles' own instance holds)."""

    mesh: Mesh
    trajectory: Trajectory
    instance: int = -1


class Rays(NamedTuple):
    """N rays. origin, direction: (N,3) world, direction of length 1. time_s: (N,)."""

    origin: Float
    direction: Float
    time_s: Float


class Hits(NamedTuple):
    """What N rays met. range_m: (N,), inf where nothing. triangle: (N,) index over all bodies'
    triangles, -1 nothing. barycentric: (N,2) as in ``(1-u-v) a + u b + v c``. normal: (N,3) of
    that triangle, world axes, either side."""

    range_m: Float
    triangle: NDArray[np.int64]
    barycentric: Float
    normal: Float

    @staticmethod
    def none(num_rays: int) -> Hits:
        return Hits(
            np.full(num_rays, np.inf),
            np.full(num_rays, -1, np.int64),
            np.zeros((num_rays, 2)),
            np.zeros((num_rays, 3)),
        )


class World:
    """All bodies; body 0 stands still.

    Concretely, ``body[k]``, ``material[k]``, ``instance[k]``, ``normal[k]``, ``uv[k]`` and
    ``tint[k]`` belong to triangle k of all bodies' triangles in a row.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self.bodies = tuple(bodies)
        meshes, corners, normals = zip(*(_solid(b.mesh) for b in self.bodies), strict=True)
        self.material = np.concatenate([m.material for m in meshes]).astype(np.int64)
        self.tint: Float = np.concatenate([m.tint for m in meshes])
        self.uv: Float = np.concatenate([m.uv[m.triangles] for m in meshes])
        self.instance = np.concatenate(
            [
                np.full(len(m.triangles), b.instance, np.int32) if b.instance >= 0 else m.instance
                for b, m in zip(self.bodies, meshes, strict=True)
            ]
        )
        counts = [len(m.triangles) for m in meshes]
        self.body = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)
        self._first = np.cumsum([0, *counts])
        self._corner: Float = np.concatenate([c[:, 0] for c in corners])
        self.normal: Float = np.concatenate(normals)
        self._scenes = [_raycasting_scene(c) for c in corners]
        low, high = zip(*(m.bounds for m in meshes), strict=True)
        self._centre = (np.array(low) + np.array(high)) / 2
        self._radius_m = np.linalg.norm(np.array(high) - np.array(low), axis=1) / 2

    def cast(self, rays: Rays, passes: Float, luck: Float) -> Hits:
        """The first surface that stops each ray.

        passes: (num materials,) probability that a surface lets the ray through. luck: (N,) in
        [0, 1), the ray's own random number.
        """
        return self.cast_bundle(rays, [rays.direction], passes, [luck])[0]

    def cast_bundle(
        self,
        rays: Rays,
        directions: Sequence[Float],
        passes: Float,
        lucks: Sequence[Float],
        spread: float = 0.0,
    ) -> list[Hits]:
        """`cast` for each of several sets of directions (N,3), which share origins and times and
        differ from the rays' own by at most ``spread`` rad."""
        surfaces = casting.Surfaces(self._corner, self.normal, passes[self.material])
        best = [
            self._cast_body(0, rays.origin, ray, surfaces, luck)
            for ray, luck in zip(directions, lucks, strict=True)
        ]
        lines = _Lines.of(rays, spread)
        for index, body in enumerate(self.bodies[1:], start=1):
            rows = lines.near(*self._ball(index, rays.time_s))
            if not len(rows):
                continue
            still = isinstance(body.trajectory, Still)
            poses = poses_at(body.trajectory, rays.time_s[rows])
            origin = rays.origin[rows] if still else poses.undo(rays.origin[rows])
            for hits, ray, luck in zip(best, directions, lucks, strict=True):
                direction = ray[rows] if still else poses.unturn(ray[rows])
                found = self._cast_body(index, origin, direction, surfaces, luck[rows])
                if not still:
                    found = found._replace(normal=poses.turn(found.normal))
                nearer = np.flatnonzero(found.range_m < hits.range_m[rows])
                for column, new in zip(hits, found, strict=True):
                    column[rows[nearer]] = new[nearer]
        return best

    def is_lit(self, rays: Rays) -> Bool:
        """(N,) True where nothing but vehicle glass lies on the ray."""
        hits = self.cast(rays, GLASS_PASSES, np.zeros(len(rays.time_s)))
        return ~np.isfinite(hits.range_m)

    def poses(self, body: int, times_s: Float) -> Poses:
        return self.bodies[body].trajectory.poses(times_s)

    def _ball(self, index: int, times_s: Float) -> tuple[Float, float]:
        """Centre (3,) and radius of a sphere that holds the body at all times between these."""
        ends_s = np.array([times_s.min(), times_s.max()])
        ends = self.poses(index, ends_s).apply(np.broadcast_to(self._centre[index], (2, 3)))
        moved_m = float(np.linalg.norm(ends[1] - ends[0]))
        return ends.mean(axis=0), float(self._radius_m[index]) + 0.75 * moved_m + 0.1

    def _cast_body(
        self, index: int, origin: Float, direction: Float, surfaces: casting.Surfaces, luck: Float
    ) -> Hits:
        n = len(origin)
        hits, rows = Hits.none(n), np.arange(n)
        start, towards, begin, luck = origin, direction, np.zeros(n), luck.copy()
        for _ in range(_MAX_LAYERS):
            if not len(rows):
                break
            met = _first_hit(self._scenes[index], start, towards)
            goes_on = np.empty(len(rows), bool)
            casting.meet(
                rows,
                *met,
                self._first[index],
                surfaces,
                origin,
                direction,
                luck,
                begin,
                casting.Stops(*hits),
                goes_on,
            )
            rows = rows[goes_on]
            towards = direction[rows]
            start = origin[rows] + begin[rows, None] * towards
        return hits


class _Lines(NamedTuple):
    """Rays, asked about many balls. origin, direction: (3,N). along: (N,) their product. squared:
    (N,) of the origin. spread: rad to either side that count as the same ray."""

    origin: Float
    direction: Float
    along: Float
    squared: Float
    spread: float

    @staticmethod
    def of(rays: Rays, spread: float) -> _Lines:
        origin, direction = rays.origin.T.copy(), rays.direction.T.copy()
        along, squared = (np.einsum("in,in->n", origin, a) for a in (direction, origin))
        return _Lines(origin, direction, along, squared, spread)

    def near(self, centre: Float, radius_m: float) -> NDArray[np.int64]:
        """Rows of the rays that pass a ball, or begin in it."""
        along = np.einsum("in,i->n", self.direction, centre)
        along -= self.along
        squared = np.einsum("in,i->n", self.origin, -2 * centre)
        squared += self.squared + centre @ centre - along**2
        reach_m = radius_m + self.spread * np.abs(along)
        return np.flatnonzero((squared < reach_m**2) & (along > -reach_m))


def _solid(mesh: Mesh) -> tuple[Mesh, Float, Float]:
    """The mesh without triangles of no area, its vertices as the ray caster rounds them; the
    triangles' corners (T,3,3) and normals (T,3)."""
    vertices = mesh.vertices.astype(np.float32).astype(np.float64)
    corners = vertices[mesh.triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Column by column, which is quicker than np.cross and np.linalg.norm.
    normal = np.empty_like(u)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        normal[:, i] = u[:, j] * v[:, k] - u[:, k] * v[:, j]
    length = np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2 + normal[:, 2] ** 2)
    keep = length > 1e-7
    solid = replace(
        mesh,
        vertices=vertices,
        triangles=mesh.triangles[keep],
        material=mesh.material[keep],
        tint=mesh.tint[keep],
        instance=mesh.instance[keep],
    )
    return solid, corners[keep], normal[keep] / length[keep, None]


@cache
def _device() -> Any:
    """One for all scenes: each of them would open its own, and Embree fails after a thousand."""
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


def _raycasting_scene(corners: Float) -> Any:
    """corners: (T,3,3) of triangles."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(_device())
    TriangleMesh(scene, corners.astype(np.float32))
    return scene


def _first_hit(
    scene: Any, origin: Float, direction: Float
) -> tuple[NDArray[np.int32], Float32, Float32]:
    """(N,3), (N,3) -> index of the first triangle met (N,), -1 none, and where on it, (N,) and
    (N,)."""
    found = scene.run(
        origin.astype(np.float32), direction.astype(np.float32), query="INTERSECT", output=True
    )
    return found["primID"], found["u"], found["v"]
