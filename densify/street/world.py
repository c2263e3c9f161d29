# SPDX-License-Identifier: MIT
"""Rigid bodies that move, and rays cast among them, each at its own time.

Rays are taken into each body's frame by the body's pose at the ray's own time, so that a body that
moves while a sweep is taken is distorted exactly as in reality. This module is the only one that
imports Embree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Bool, Float, Float32
from densify.street.materials import GLASS_PASSES
from densify.street.mesh import Mesh
from densify.street.motion import Poses, Still, Trajectory, poses_at

_STEP_M = 2e-3  # from a surface passed to where the ray goes on
_GOLDEN = 0.6180339887498949


class Surfaces(NamedTuple):
    """Triangles. corner, normal: (T,3). passes: (T,) probability that one lets a ray through."""

    corner: Float
    normal: Float
    passes: Float


class Stops(NamedTuple):
    """Where each of N rays stops, as `densify.street.world.Hits`."""

    range_m: Float
    triangle: NDArray[np.int64]
    barycentric: Float
    normal: Float


@Kernel
def _pass_by(origin, direction, spread, centre, radius_m, passes):  # type: ignore[no-untyped-def]
    """passes: (B,N), filled: whether rays pass each of B balls, or begin in it.

    origin, direction: (3,N) of the rays. spread: rad to either side that count as the same ray.
    centre: (B,3). radius_m: (B,).
    """
    for b in range(len(centre)):
        for n in range(origin.shape[1]):
            x, y, z = (
                centre[b, 0] - origin[0, n],
                centre[b, 1] - origin[1, n],
                centre[b, 2] - origin[2, n],
            )
            along = x * direction[0, n] + y * direction[1, n] + z * direction[2, n]
            reach_m = radius_m[b] + spread * abs(along)
            is_near = x * x + y * y + z * z - along * along < reach_m * reach_m
            passes[b, n] = is_near & (along > -reach_m)


@inlined
def _dot(x, y, z, a, i):  # type: ignore[no-untyped-def]
    # In the order in which numpy's einsum adds three with AVX-512: streets keep their bytes.
    return (x * a[i, 0] + z * a[i, 2]) + y * a[i, 1]


@Kernel
def _meet(rows, which, u, v, first, surfaces, origin, direction, luck, begin, stops, goes_on):  # type: ignore[no-untyped-def]
    """Let rays stop at the triangles they meet, or go on behind them.

    rows: (R,) of the rays. which: (R,) the triangle of their body, -1 none; first: the body's
    first. u, v: (R,) where on it. surfaces: `Surfaces`. origin, direction: (N,3).
    Filled: the `Stops` of rays that end here; luck and begin (N,) of those that pass, and goes_on
    (R,), whether they do. Distances are to the triangle's plane, in double precision.
    """
    for k in range(len(rows)):
        goes_on[k] = False
        if which[k] < 0:
            continue
        i, t = rows[k], first + np.int64(which[k])
        corner, normal = surfaces.corner, surfaces.normal
        x, y, z = (
            corner[t, 0] - origin[i, 0],
            corner[t, 1] - origin[i, 1],
            corner[t, 2] - origin[i, 2],
        )
        to_plane = _dot(x, y, z, normal, t)
        facing = _dot(direction[i, 0], direction[i, 1], direction[i, 2], normal, t)
        distance = to_plane / facing
        if luck[i] >= surfaces.passes[t]:
            stops.range_m[i], stops.triangle[i] = distance, t
            stops.barycentric[i, 0], stops.barycentric[i, 1] = u[k], v[k]
            for axis in range(3):
                stops.normal[i, axis] = normal[t, axis]
        else:
            begin[i], luck[i] = distance + _STEP_M, (luck[i] + _GOLDEN) % 1.0
            goes_on[k] = True


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
    """The hits of N rays. range_m: (N,), inf where nothing. triangle: (N,) index over all bodies'
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


class Triangles:
    """Those of all bodies in a row: ``body[k]``, ``material[k]``, ``instance[k]``, ``corner[k]``,
    ``normal[k]``, ``uv[k]`` and ``tint[k]`` belong to triangle k.

    first: of each body. scenes: each body's as the ray caster has them. centre, radius_m: of a ball
    around each.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        meshes, corners, normals = zip(*(_solid(b.mesh) for b in bodies), strict=True)
        self.material = np.concatenate([m.material for m in meshes]).astype(np.int64)
        self.tint: Float = np.concatenate([m.tint for m in meshes])
        self.uv: Float = np.concatenate([m.uv[m.triangles] for m in meshes])
        self.instance = np.concatenate(
            [
                np.full(len(m.triangles), b.instance, np.int32) if b.instance >= 0 else m.instance
                for b, m in zip(bodies, meshes, strict=True)
            ]
        )
        counts = [len(m.triangles) for m in meshes]
        self.body = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)
        self.first = np.cumsum([0, *counts])
        self.corner: Float = np.concatenate([c[:, 0] for c in corners])
        self.normal: Float = np.concatenate(normals)
        self.scenes = [_raycasting_scene(c) for c in corners]
        low, high = zip(*(m.bounds for m in meshes), strict=True)
        self.centre = (np.array(low) + np.array(high)) / 2
        self.radius_m = np.linalg.norm(np.array(high) - np.array(low), axis=1) / 2


class World:
    """All bodies; body 0 stands still."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        self.bodies = tuple(bodies)

    @cached_property
    def triangles(self) -> Triangles:
        """Made when first asked for: poses need none, and they take a third of the time that a
        scene takes."""
        return Triangles(self.bodies)

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
        surfaces = Surfaces(
            self.triangles.corner, self.triangles.normal, passes[self.triangles.material]
        )
        best = [
            self._cast_body(0, rays.origin, ray, surfaces, luck)
            for ray, luck in zip(directions, lucks, strict=True)
        ]
        for index, rows in enumerate(self._near(rays, spread), start=1):
            body = self.bodies[index]
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

    def _near(self, rays: Rays, spread: float) -> Iterator[NDArray[np.int64]]:
        """The rays that may meet each body but the first: those that pass, or begin in, a ball that
        holds it at all of their times."""
        if len(self.bodies) == 1:
            return
        ends_s = np.array([rays.time_s.min(), rays.time_s.max()])
        around = [np.broadcast_to(centre, (2, 3)) for centre in self.triangles.centre[1:]]
        ends = np.stack([self.poses(i, ends_s).apply(a) for i, a in enumerate(around, start=1)])
        moved_m = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        radius_m = self.triangles.radius_m[1:] + 0.75 * moved_m + 0.1
        passes = np.empty((len(ends), len(rays.time_s)), bool)
        origin, direction = rays.origin.T.copy(), rays.direction.T.copy()
        _pass_by(origin, direction, spread, ends.mean(axis=1), radius_m, passes)
        yield from map(np.flatnonzero, passes)

    def _cast_body(
        self, index: int, origin: Float, direction: Float, surfaces: Surfaces, luck: Float
    ) -> Hits:
        n = len(origin)
        hits, rows = Hits.none(n), np.arange(n)
        start, towards, begin, luck = origin, direction, np.zeros(n), luck.copy()
        for _ in range(_MAX_LAYERS):
            if not len(rows):
                break
            met = _first_hit(self.triangles.scenes[index], start, towards)
            goes_on = np.empty(len(rows), bool)
            _meet(
                rows,
                *met,
                self.triangles.first[index],
                surfaces,
                origin,
                direction,
                luck,
                begin,
                Stops(*hits),
                goes_on,
            )
            rows = rows[goes_on]
            towards = direction[rows]
            start = origin[rows] + begin[rows, None] * towards
        return hits


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
