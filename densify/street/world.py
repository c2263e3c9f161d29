# SPDX-License-Identifier: MIT
"""Cast rays among moving rigid bodies, each at its own time. Only this module imports Embree."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Float32, Int
from densify.street.mesh import Mesh, across, lengths
from densify.street.motion import Poses, Trajectory, poses_at

_STEP_M = 2e-3  # from a surface that a ray passes to its next origin
_MAX_LAYERS = 8  # most layers of glass and leaves that one ray passes
_STEP_S, _SLACK_M = 0.05, 0.1  # between positions that bound a body, and beyond them
_BLOCK = 16  # consecutive rays that are tested together
_TINY = 1e-9
_FLAT_M2 = 1e-7  # twice the area of a triangle that is left out


@dataclass(frozen=True)
class Body:
    """A rigid body."""

    mesh: Mesh  # mesh in the frame of the body
    trajectory: Trajectory  # pose of the body over time
    # Number of the object it is part of; -1 if its triangles have object numbers
    instance: int = -1


class Rays(NamedTuple):
    """N rays."""

    origin: Float  # (N,3) metres, world
    direction: Float  # (N,3) unit vectors, world
    time_s: Float  # (N,) seconds since frame 0


class Hits(NamedTuple):
    """The hits of N rays."""

    range_m: Float  # (N,) distances, inf without a hit
    triangle: Int  # (N,) index over the triangles of all bodies, -1 without a hit
    barycentric: Float32  # (N,2) u and v, as in ``(1-u-v) a + u b + v c``
    absorbed: Bool  # (N,) True if the ray ends at a surface without a return. Its range is inf.
    normal: Float  # (N,3) normal of the triangle, world axes, of either sign


class Meeting(NamedTuple):
    """K rays that meet a surface of a body, for which `Optics` decides whether they end there."""

    ray: Int  # (K,) ray indices
    triangle: Int  # (K,) triangle indices
    layer: int  # number of surfaces that the rays have passed before
    origin: Float  # (K,3) origins of the rays in the frame of the body
    direction: Float  # (K,3) unit vectors in the frame of the body
    distance_m: Float  # (K,) distances from the origins
    facing: Float  # (K,) inner products of directions and normals
    # (K,) object number of the previous surface that the ray passed, -1 for none
    passed: NDArray[np.int32]

    def positions(self, rows: Int) -> Float:
        """Return the positions of some of the rays, (R,3) in the frame of the body."""
        return self.origin[rows] + self.distance_m[rows, None] * self.direction[rows]


STOPS, PASSES, ABSORBED = range(3)
Optics = Callable[[Meeting], Int]
"""Function that returns (K,) STOPS, PASSES or ABSORBED for the rays of a meeting."""


class Triangles:
    """The triangles of all bodies in a row, except those of no area. Arrays are by triangle."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        meshes = [b.mesh.of_instance(b.instance) if b.instance >= 0 else b.mesh for b in bodies]
        mesh = Mesh.join(meshes)
        single = mesh.vertices.astype(np.float32).take(mesh.triangles, axis=0)
        corners = single.astype(np.float64)
        normal = across(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = lengths(normal)
        keep = np.flatnonzero(length[:, 0] > _FLAT_M2)
        counts = [len(m.triangles) for m in meshes]
        self.body = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)[keep]
        # Index of the first triangle of each body
        self.first: Int = np.searchsorted(self.body, np.arange(len(meshes) + 1))
        self.material = mesh.material[keep].astype(np.int64)
        self.tint: Float = mesh.tint.take(keep, axis=0)
        self.mean_tint: Float = self.tint.mean(axis=1)
        self.uv: Float = mesh.uv.take(mesh.triangles.take(keep, axis=0), axis=0)
        self.instance = mesh.instance[keep]
        self.corner: Float = corners[:, 0].take(keep, axis=0)
        self.normal: Float = normal.take(keep, axis=0) / length.take(keep, axis=0)
        each = np.split(single.take(keep, axis=0), self.first[1:-1])
        # Embree scene of each body, in single precision
        self.scenes = [_raycasting_scene(corners) for corners in each]

    def first_hit(
        self, spans: Iterable[tuple[int, int]], origin: Float, direction: Float
    ) -> tuple[Int, Int, Float]:
        """Return the rays that hit their body, the first triangle that each hits, and u, v there.

        ``spans`` has body and end of its rays, ascending. Rays (N,3) are in the frames of bodies.
        """
        start, ray = origin.astype(np.float32), direction.astype(np.float32)
        met, triangle, barycentric, begin = [], [], [], 0
        for index, end in spans:
            if end > begin:
                traced = self.scenes[index].run(
                    start[begin:end], ray[begin:end], query="INTERSECT", output=True
                )
                rows = np.flatnonzero(traced["primID"] >= 0)
                met.append(rows + begin)
                triangle.append(traced["primID"][rows] + self.first[index])
                barycentric.append(np.stack([traced["u"][rows], traced["v"][rows]], axis=1))
            begin = end
        if not met:
            return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
        return np.concatenate(met), np.concatenate(triangle), np.concatenate(barycentric)


class World:
    """All bodies. Body 0 is static. ``seed`` determines the random properties of surfaces."""

    def __init__(self, bodies: Sequence[Body], seed: int = 0) -> None:
        self.bodies, self.seed = tuple(bodies), seed

    @cached_property
    def triangles(self) -> Triangles:
        """The triangles of all bodies, built at first use."""
        return Triangles(self.bodies)  # a third of the time of a scene, and poses need none

    def cast(self, rays: Rays, optics: Optics, num_together: int = 1, spread: float = 0.0) -> Hits:
        """Return the first surface at which each ray ends, by the decisions of ``optics``.

        ``num_together`` consecutive rays share origin and time, within ``spread`` rad of the first.
        """
        every = np.arange(len(rays.time_s))
        best = self._cast_bodies([(0, len(every))], rays.origin, rays.direction, every, optics)
        groups = Rays(*(column[::num_together] for column in rays))
        farthest_m = np.maximum.reduce([*best.range_m.reshape(-1, num_together).T])
        candidates = [
            (index, rows, poses_at(self.bodies[index].trajectory, groups.time_s[rows]))
            for index, rows in self._near(groups, farthest_m, spread)
        ]
        if candidates:
            self._add_moving(best, rays, candidates, optics, num_together)
        best.range_m[best.absorbed] = np.inf
        return best

    def _add_moving(
        self,
        best: Hits,
        rays: Rays,
        candidates: Sequence[tuple[int, Int, Poses]],
        optics: Optics,
        num: int,
    ) -> None:
        """Enter the hits of moving bodies that are nearer than those in ``best``."""
        # candidates: index of each body, groups of num rays that may hit it, its poses then.
        poses = [pose for _, _, pose in candidates]
        groups = np.concatenate([rows for _, rows, _ in candidates])
        ends = num * np.cumsum([len(rows) for _, rows, _ in candidates])
        spans = [(index, end) for (index, _, _), end in zip(candidates, ends.tolist(), strict=True)]
        at = Poses(*(np.concatenate(column) for column in zip(*poses, strict=True)))
        rows = (groups[:, None] * num + np.arange(num)).ravel()
        origin = at.undo(rays.origin.take(groups * num, axis=0)).repeat(num, axis=0)
        direction = rays.direction.take(rows, axis=0).reshape(-1, num, 3) @ at.rotation
        hits = self._cast_bodies(spans, origin, direction.reshape(-1, 3), rows, optics)
        begin = 0
        for pose, (_, end) in zip(poses, spans, strict=True):
            new = np.flatnonzero(hits.range_m[begin:end] < best.range_m[rows[begin:end]])
            hits.normal[begin + new] = pose.rows(new // num).turn(hits.normal[begin + new])
            new += begin
            for name in Hits._fields:
                getattr(best, name)[rows[new]] = getattr(hits, name)[new]
            begin = end

    def _near(self, rays: Rays, farthest_m: Float, spread: float) -> Iterator[tuple[int, Int]]:
        """Yield the index of each body but the first, and indices of rays that may hit it."""
        # These rays intersect a ball around the positions of the body at all of their times, before
        # their static surface. Blocks of consecutive rays are tested before each ray.
        if len(self.bodies) < 2 or not len(rays.time_s):
            return
        first = np.arange(0, len(rays.time_s), _BLOCK)
        count = np.diff(np.append(first, len(rays.time_s)))
        origin, direction = (
            np.add.reduceat(c, first) / count[:, None] for c in (rays.origin, rays.direction)
        )
        direction /= np.maximum(lengths(direction), _TINY)
        around_m, around = (
            np.maximum.reduceat(lengths(c - np.repeat(middle, count, axis=0))[:, 0], first)
            for c, middle in ((rays.origin, origin), (rays.direction, direction))
        )
        blocks = origin, direction, np.maximum.reduceat(farthest_m, first)
        for index, (centre, radius_m) in enumerate(self._balls(rays.time_s), start=1):
            wide = _meets_ball(blocks, centre, radius_m + around_m, spread + around)
            rows = (np.flatnonzero(wide)[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()
            rows = rows[: np.searchsorted(rows, len(rays.time_s))]
            each = rays.origin[rows], rays.direction[rows], farthest_m[rows]
            rows = rows[_meets_ball(each, centre, radius_m, spread)]
            if len(rows):
                yield index, rows

    def _balls(self, times_s: Float) -> Iterator[tuple[Float, float]]:
        """Yield centre (3,) and radius of a ball around each moving body at all of these times."""
        begin_s, end_s = times_s.min(), times_s.max()
        sampled_s = np.linspace(begin_s, end_s, int((end_s - begin_s) / _STEP_S) + 2)
        for body in self.bodies[1:]:
            middles = np.tile(np.mean(body.mesh.bounds, axis=0), (len(sampled_s), 1))
            path = body.trajectory.poses(sampled_s).apply(middles)
            low, high = path.min(axis=0), path.max(axis=0)
            reach_m = np.linalg.norm(high - low) + np.linalg.norm(np.subtract(*body.mesh.bounds))
            yield (low + high) / 2, float(reach_m) / 2 + _SLACK_M

    def _cast_bodies(
        self,
        spans: Sequence[tuple[int, int]],
        origin: Float,
        direction: Float,
        number: Int,
        optics: Optics,
    ) -> Hits:
        """Return the hits of rays, each with one body and in the frame of that body."""
        # Distances are to the plane of the triangle, in double precision, also for absorbed rays.
        surfaces, n = self.triangles, len(origin)
        hits = Hits(
            np.full(n, np.inf), np.full(n, -1), np.zeros((n, 2), np.float32), np.zeros(n, bool),
            np.zeros((n, 3)),
        )  # fmt: skip
        rows, start, ray, passed = np.arange(n), origin, direction, np.full(n, -1, np.int32)
        for layer in range(_MAX_LAYERS):
            ends = np.searchsorted(rows, [end for _, end in spans]).tolist()
            left = zip((index for index, _ in spans), ends, strict=True)
            met, triangle, barycentric = surfaces.first_hit(left, start, ray)
            if not len(met):
                break
            rows, passed, ray = rows[met], passed[met], ray.take(met, axis=0)
            begin, normal = origin.take(rows, axis=0), surfaces.normal.take(triangle, axis=0)
            corner = surfaces.corner.take(triangle, axis=0)
            facing = np.einsum("ni,ni->n", ray, normal)
            distance_m = np.einsum("ni,ni->n", corner - begin, normal) / facing
            meeting = Meeting(number[rows], triangle, layer, begin, ray, distance_m, facing, passed)
            outcome = optics(meeting)
            hits.range_m[rows], hits.triangle[rows] = distance_m, triangle
            hits.barycentric[rows], hits.absorbed[rows] = barycentric, outcome == ABSORBED
            hits.normal[rows] = normal
            on = np.flatnonzero(outcome == PASSES)
            rows, ray, passed = rows[on], ray[on], surfaces.instance[triangle[on]]
            hits.range_m[rows], hits.triangle[rows] = np.inf, -1
            start = begin[on] + (distance_m[on] + _STEP_M)[:, None] * ray
        return hits


def _meets_ball(
    rays: tuple[Float, Float, Float], centre: Float, radius_m: Float | float, spread: Float | float
) -> Bool:
    """Return (N,) True for rays (origins, unit vectors, lengths) that meet a ball."""
    # spread is the greatest difference of a ray's true direction from its unit vector.
    origin, direction, farthest_m = rays
    away = centre - origin
    along = np.einsum("ni,ni->n", away, direction)
    square = np.einsum("ni,ni->n", away, away)
    reach_m = radius_m + spread * (np.sqrt(square) + radius_m)
    meets: Bool = square - along * along < reach_m * reach_m
    return meets & (along > -reach_m) & (along - reach_m < farthest_m)


@cache
def _device() -> Any:
    """Return the one Embree device of all scenes: after a thousand devices Embree fails."""
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


def _raycasting_scene(corners: Float32) -> Any:
    """Return the Embree scene of (T,3,3) triangle corners."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(_device())
    TriangleMesh(scene, corners)
    return scene
