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

_STEP_M = 2e-3  # distance from a surface that a ray passes to its next origin
_MAX_LAYERS = 8  # most layers of glass and leaves that one ray passes
_STEP_S = 0.05  # time between the sampled positions of a body
_SLACK_M = 0.1  # addition to the radius of the ball around these positions
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
        """Return the (R,3) points, metres, frame of the body, where some rays (R,) meet it."""
        return self.origin[rows] + self.distance_m[rows, None] * self.direction[rows]


STOPS, PASSES, ABSORBED = range(3)
Optics = Callable[[Meeting], Int]
"""Function that returns (K,) STOPS, PASSES or ABSORBED for the rays of a meeting."""


class Triangles:
    """The triangles of all bodies in order, except those of no area. Arrays are by triangle."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        """Join the meshes of the bodies and build an Embree scene for each."""
        meshes = [
            body.mesh.of_instance(body.instance) if body.instance >= 0 else body.mesh
            for body in bodies
        ]
        mesh = Mesh.join(meshes)
        # Embree computes in single precision; the planes are those of its rounded corners.
        single = mesh.vertices.astype(np.float32).take(mesh.triangles, axis=0)
        corners = single.astype(np.float64)
        normal = across(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = lengths(normal)
        keep = np.flatnonzero(length[:, 0] > _FLAT_M2)
        counts = [len(body_mesh.triangles) for body_mesh in meshes]
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
        corners_by_body = np.split(single.take(keep, axis=0), self.first[1:-1])
        # Embree scene of each body, in single precision
        self.scenes = [_raycasting_scene(body_corners) for body_corners in corners_by_body]

    def first_hit(
        self, spans: Iterable[tuple[int, int]], origin: Float, direction: Float
    ) -> tuple[Int, Int, Float]:
        """Return rays (K,) with a hit on their body, their first triangles (K,), and u and v (K,2).

        Args:
            spans: Index of each body, and the end of its rays in the arrays below, ascending.
            origin: (N,3) origins in metres, in the frame of the body.
            direction: (N,3) unit vectors in that frame.
        """
        start = origin.astype(np.float32)
        ray = direction.astype(np.float32)
        met, triangle, barycentric = [], [], []
        begin = 0
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

        Args:
            rays: N rays in the world.
            optics: Function that decides where a ray passes, stops or is absorbed.
            num_together: Number of consecutive rays that share origin and time.
            spread: Greatest angle (rad) between the first of them and another.
        """
        # The static world first; then the moving bodies in front of its surfaces
        every = np.arange(len(rays.time_s))
        best = self._cast_bodies([(0, len(every))], rays.origin, rays.direction, every, optics)
        groups = Rays(*(column[::num_together] for column in rays))
        farthest_m = np.maximum.reduce([*best.range_m.reshape(-1, num_together).T])
        candidates = [
            _Candidate(index, rows, poses_at(self.bodies[index].trajectory, groups.time_s[rows]))
            for index, rows in self._find_near_rays(groups, farthest_m, spread)
        ]
        if candidates:
            self._add_moving(best, rays, candidates, optics, num_together)
        best.range_m[best.absorbed] = np.inf
        return best

    def _add_moving(
        self,
        best: Hits,
        rays: Rays,
        candidates: Sequence[_Candidate],
        optics: Optics,
        num: int,
    ) -> None:
        """Enter the hits of moving bodies that are nearer than those in ``best``."""
        # All rays that may hit a body, body by body, in the frame of their body
        groups = np.concatenate([candidate.groups for candidate in candidates])
        ends = num * np.cumsum([len(candidate.groups) for candidate in candidates])
        bodies = [candidate.body for candidate in candidates]
        spans = list(zip(bodies, ends.tolist(), strict=True))
        all_poses = [candidate.poses for candidate in candidates]
        poses = Poses(*(np.concatenate(columns) for columns in zip(*all_poses, strict=True)))
        rows = (groups[:, None] * num + np.arange(num)).ravel()
        origin = poses.undo(rays.origin.take(groups * num, axis=0)).repeat(num, axis=0)
        direction = rays.direction.take(rows, axis=0).reshape(-1, num, 3) @ poses.rotation
        hits = self._cast_bodies(spans, origin, direction.reshape(-1, 3), rows, optics)

        # The bodies in turn: a ray may hit several of them.
        begin = 0
        for body_poses, (_, end) in zip(all_poses, spans, strict=True):
            nearer = np.flatnonzero(hits.range_m[begin:end] < best.range_m[rows[begin:end]])
            normal = hits.normal[begin + nearer]
            hits.normal[begin + nearer] = body_poses.rows(nearer // num).turn(normal)
            nearer += begin
            for name in Hits._fields:
                getattr(best, name)[rows[nearer]] = getattr(hits, name)[nearer]
            begin = end

    def _find_near_rays(
        self, rays: Rays, farthest_m: Float, spread: float
    ) -> Iterator[tuple[int, Int]]:
        """Yield the index of each body but the first, and indices of rays that may hit it."""
        # These rays intersect a ball around the positions of the body at all of their times, before
        # their static surface. Blocks of consecutive rays are tested before each ray.
        if len(self.bodies) < 2 or not len(rays.time_s):
            return
        first = np.arange(0, len(rays.time_s), _BLOCK)
        count = np.diff(np.append(first, len(rays.time_s)))
        origin, direction = (
            np.add.reduceat(column, first) / count[:, None]
            for column in (rays.origin, rays.direction)
        )
        direction /= np.maximum(lengths(direction), _TINY)
        # Greatest differences within each block from its mean origin and direction
        block_radius_m, block_spread = (
            np.maximum.reduceat(lengths(column - np.repeat(mean, count, axis=0))[:, 0], first)
            for column, mean in ((rays.origin, origin), (rays.direction, direction))
        )
        blocks = _Segments(origin, direction, np.maximum.reduceat(farthest_m, first))
        for index, (centre, radius_m) in enumerate(self._balls(rays.time_s), start=1):
            is_near = _meets_ball(blocks, centre, radius_m + block_radius_m, spread + block_spread)
            rows = (np.flatnonzero(is_near)[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()
            rows = rows[: np.searchsorted(rows, len(rays.time_s))]  # the last block may be smaller
            segments = _Segments(rays.origin[rows], rays.direction[rows], farthest_m[rows])
            rows = rows[_meets_ball(segments, centre, radius_m, spread)]
            if len(rows):
                yield index, rows

    def _balls(self, times_s: Float) -> Iterator[tuple[Float, float]]:
        """Yield centre (3,) and radius of a ball around each moving body at all of these times."""
        begin_s, end_s = times_s.min(), times_s.max()
        # Both ends are sampled, and steps are shorter than _STEP_S.
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
        surfaces = self.triangles
        n = len(origin)
        hits = Hits(
            np.full(n, np.inf), np.full(n, -1), np.zeros((n, 2), np.float32), np.zeros(n, bool),
            np.zeros((n, 3)),
        )  # fmt: skip
        # The rays that still travel: indices, origins behind the last surface, directions, and the
        # object of that surface
        rows = np.arange(n)
        start, ray = origin, direction
        passed = np.full(n, -1, np.int32)
        for layer in range(_MAX_LAYERS):
            ends = np.searchsorted(rows, [end for _, end in spans]).tolist()
            spans_left = zip((index for index, _ in spans), ends, strict=True)
            met, triangle, barycentric = surfaces.first_hit(spans_left, start, ray)
            if not len(met):
                break
            rows, passed, ray = rows[met], passed[met], ray.take(met, axis=0)
            ray_origin = origin.take(rows, axis=0)
            normal = surfaces.normal.take(triangle, axis=0)
            corner = surfaces.corner.take(triangle, axis=0)
            facing = np.einsum("ni,ni->n", ray, normal)
            distance_m = np.einsum("ni,ni->n", corner - ray_origin, normal) / facing
            meeting = Meeting(
                number[rows], triangle, layer, ray_origin, ray, distance_m, facing, passed
            )
            outcome = optics(meeting)
            hits.range_m[rows] = distance_m
            hits.triangle[rows] = triangle
            hits.barycentric[rows] = barycentric
            hits.absorbed[rows] = outcome == ABSORBED
            hits.normal[rows] = normal

            # Rays that pass go on behind the surface, without a hit so far.
            passing = np.flatnonzero(outcome == PASSES)
            rows, ray = rows[passing], ray[passing]
            passed = surfaces.instance[triangle[passing]]
            hits.range_m[rows] = np.inf
            hits.triangle[rows] = -1
            start = ray_origin[passing] + (distance_m[passing] + _STEP_M)[:, None] * ray
        return hits


class _Candidate(NamedTuple):
    """A moving body with the groups of rays that may hit it."""

    body: int  # index of the body
    groups: Int  # (G,) indices of the groups
    poses: Poses  # G poses of the body at the times of the groups


class _Segments(NamedTuple):
    """N rays up to a distance."""

    origin: Float  # (N,3)
    direction: Float  # (N,3) unit vectors
    length_m: Float  # (N,)


def _meets_ball(
    rays: _Segments, centre: Float, radius_m: Float | float, spread: Float | float
) -> Bool:
    """Return (N,) True for rays that meet a ball, by the greatest angle from their direction."""
    to_centre = centre - rays.origin
    along_m = np.einsum("ni,ni->n", to_centre, rays.direction)
    squared_m2 = np.einsum("ni,ni->n", to_centre, to_centre)
    # Up to the far side of the ball, the true ray deviates by at most the spread times the range.
    reach_m = radius_m + spread * (np.sqrt(squared_m2) + radius_m)
    meets: Bool = squared_m2 - along_m * along_m < reach_m * reach_m
    return meets & (along_m > -reach_m) & (along_m - reach_m < rays.length_m)


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
