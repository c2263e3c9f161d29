# SPDX-License-Identifier: MIT
"""Cast rays among moving rigid bodies, each at its own time. Only this module imports Embree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Float32, Int
from densify.street.mesh import Mesh, lengths
from densify.street.motion import Trajectory, poses_at

_STEP_M = 2e-3  # distance from a surface that a ray passes to its next origin
_MAX_LAYERS = 8  # most layers of glass and leaves that one ray passes
_STEP_S = 0.05  # time between the sampled positions of a body
_SLACK_M = 0.1  # addition to the radius of the ball around these positions
_BLOCK = 16  # consecutive rays that are tested together
_FLAT_M2 = 1e-7  # twice the area of a triangle that is left out


@dataclass(frozen=True)
class Body:
    """A rigid body: a mesh that moves along a trajectory."""

    mesh: Mesh  # mesh in the frame of the body
    trajectory: Trajectory  # pose of the body over time
    # Number of the object it is part of; -1 if its triangles have object numbers
    instance: int = -1


class Rays(NamedTuple):
    """N rays in the world, each at its own time."""

    origin: Float  # (N,3) metres, world
    direction: Float  # (N,3) unit vectors, world
    time_s: Float  # (N,) seconds since frame 0

    def rows(self, rows: Int | slice) -> Rays:
        """Return the rays with the indices ``rows``."""
        return Rays(*(column[rows] for column in self))


class Hits(NamedTuple):
    """The first hits of N rays."""

    range_m: Float  # (N,) distances, inf without a hit
    triangle: Int  # (N,) index over the triangles of all bodies, -1 without a hit
    barycentric: Float32  # (N,2) u and v, as in ``(1-u-v) a + u b + v c``
    absorbed: Bool  # (N,) True if the ray ends at a surface without a return. Its range is inf.
    normal: Float  # (N,3) normal of the triangle, world axes, of either sign


class Meeting(NamedTuple):
    """K rays that meet a surface of a body. `Optics` decides whether the rays end there."""

    ray: Int  # (K,) ray indices
    triangle: Int  # (K,) triangle indices
    layer: int  # number of surfaces that the rays have passed before
    position: Float  # (K,3) points where the rays meet it, metres, frame of the body
    facing: Float  # (K,) inner products of ray directions and normals
    # (K,) object number of the previous surface that the ray passed, -1 for none
    passed: NDArray[np.int32]


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
        single = mesh.vertices.astype(np.float32)[mesh.triangles]
        corners = single.astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = lengths(normal)
        keep = np.flatnonzero(length[:, 0] > _FLAT_M2)
        counts = [len(body_mesh.triangles) for body_mesh in meshes]
        self.body = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)[keep]
        # Index of the first triangle of each body
        self.first: Int = np.searchsorted(self.body, np.arange(len(meshes) + 1))
        self.material = mesh.material[keep].astype(np.int64)
        self.tint: Float = mesh.tint[keep]
        self.mean_tint: Float = self.tint.mean(axis=1)
        self.uv: Float = mesh.uv[mesh.triangles[keep]]
        self.instance = mesh.instance[keep]
        self.corner: Float = corners[keep, 0]
        self.normal: Float = normal[keep] / length[keep]
        # Embree scene of each body, in single precision
        self.scenes = [*map(_embree_scene, np.split(single[keep], self.first[1:-1]))]


@cache
def _embree_device() -> Any:
    """Return the one Embree device of all scenes: after a thousand devices Embree fails."""
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


def _embree_scene(corners: Float32) -> Any:
    """Return the Embree scene of (T,3,3) triangle corners."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(_embree_device())
    TriangleMesh(scene, corners)
    return scene


class World:
    """The scene of all bodies, in which `cast` finds where rays hit.

    Body 0 is the static world. ``seed`` determines the random properties of surfaces.
    """

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
        best = self._cast_at_body(0, rays.origin, rays.direction, every, optics)
        groups = rays.rows(np.s_[::num_together])
        farthest_m = best.range_m.reshape(-1, num_together).max(axis=1)
        for index, near in self._find_near_rays(groups, farthest_m, spread):
            # Cast these rays in the frame of the body.
            body_poses = poses_at(self.bodies[index].trajectory, groups.time_s[near])
            rows = (near[:, None] * num_together + np.arange(num_together)).ravel()
            origin = body_poses.undo(groups.origin[near]).repeat(num_together, axis=0)
            direction = rays.direction[rows].reshape(-1, num_together, 3) @ body_poses.rotation
            hits = self._cast_at_body(index, origin, direction.reshape(-1, 3), rows, optics)
            nearer = np.flatnonzero(hits.range_m < best.range_m[rows])
            hit_poses = body_poses.rows(nearer // num_together)
            hits.normal[nearer] = hit_poses.turn(hits.normal[nearer])
            for name in Hits._fields:
                getattr(best, name)[rows[nearer]] = getattr(hits, name)[nearer]
        best.range_m[best.absorbed] = np.inf
        return best

    def _find_near_rays(
        self, rays: Rays, farthest_m: Float, spread: float
    ) -> Iterator[tuple[int, Int]]:
        """Yield each moving body's index with the indices of the rays that may hit the body."""
        # A ray may hit a body if the ray meets the ball of the body's positions before the static
        # world. Blocks of consecutive rays are tested first, because most blocks are far away.
        num_rays = len(rays.time_s)
        if not num_rays:
            return
        first = np.arange(0, num_rays, _BLOCK)
        first_of_ray = np.arange(num_rays) // _BLOCK * _BLOCK
        # Greatest differences within each block from the origin and direction of its first ray
        block_radius_m, block_spread = (
            np.maximum.reduceat(lengths(column - column[first_of_ray])[:, 0], first)
            for column in (rays.origin, rays.direction)
        )
        blocks, block_farthest_m = rays.rows(first), np.maximum.reduceat(farthest_m, first)
        for index, (centre, radius_m) in enumerate(self._balls(rays.time_s), start=1):
            block_ball = centre, radius_m + block_radius_m, spread + block_spread
            is_near = _meets_ball(blocks, block_farthest_m, *block_ball)
            rows = (first[is_near, None] + np.arange(_BLOCK)).ravel()
            rows = rows[rows < num_rays]  # the last block may be smaller
            meets = _meets_ball(rays.rows(rows), farthest_m[rows], centre, radius_m, spread)
            if meets.any():
                yield index, rows[meets]

    def _balls(self, times_s: Float) -> Iterator[tuple[Float, float]]:
        """Yield centre (3,) and radius of a ball that holds each moving body at times (N,)."""
        begin_s, end_s = times_s.min(), times_s.max()
        # Both ends are sampled, and steps are shorter than _STEP_S.
        sampled_s = np.linspace(begin_s, end_s, int((end_s - begin_s) / _STEP_S) + 2)
        for body in self.bodies[1:]:
            middles = np.tile(np.mean(body.mesh.bounds, axis=0), (len(sampled_s), 1))
            path = body.trajectory.poses(sampled_s).apply(middles)
            low, high = path.min(axis=0), path.max(axis=0)
            reach_m = np.linalg.norm(high - low) + np.linalg.norm(np.subtract(*body.mesh.bounds))
            yield (low + high) / 2, float(reach_m) / 2 + _SLACK_M

    def _cast_at_body(
        self, body: int, origin: Float, direction: Float, number: Int, optics: Optics
    ) -> Hits:
        """Return the hits of rays with one body, in its frame. ``number`` (N,) are ray indices."""
        # Embree finds the triangles in single precision. Distances to their planes are computed
        # in double precision, also for absorbed rays.
        surfaces = self.triangles
        n = len(origin)
        hits = Hits(
            np.full(n, np.inf), np.full(n, -1), np.zeros((n, 2), np.float32), np.zeros(n, bool),
            np.zeros((n, 3)),
        )  # fmt: skip
        # The rays that still travel: indices, origins behind the last surface, directions, and the
        # object of that surface
        rows, start, ray, passed = np.arange(n), origin, direction, np.full(n, -1, np.int32)
        for layer in range(_MAX_LAYERS):
            if not len(rows):
                break
            traced = surfaces.scenes[body].run(
                start.astype(np.float32), ray.astype(np.float32), query="INTERSECT", output=True
            )
            met = np.flatnonzero(traced["primID"] >= 0)
            triangle = traced["primID"][met] + surfaces.first[body]
            rows, passed, ray = rows[met], passed[met], ray[met]
            ray_origin, normal = origin[rows], surfaces.normal[triangle]
            facing = np.einsum("ni,ni->n", ray, normal)
            to_corner = surfaces.corner[triangle] - ray_origin
            distance_m = np.einsum("ni,ni->n", to_corner, normal) / facing
            position = ray_origin + distance_m[:, None] * ray
            outcome = optics(Meeting(number[rows], triangle, layer, position, facing, passed))
            hits.range_m[rows] = distance_m
            hits.triangle[rows] = triangle
            hits.barycentric[rows] = np.stack([traced["u"][met], traced["v"][met]], axis=1)
            hits.absorbed[rows] = outcome == ABSORBED
            hits.normal[rows] = normal

            # Rays that pass go on a little behind the surface, without a hit so far.
            passing = np.flatnonzero(outcome == PASSES)
            rows, ray = rows[passing], ray[passing]
            passed = surfaces.instance[triangle[passing]]
            hits.range_m[rows] = np.inf
            hits.triangle[rows] = -1
            start = ray_origin[passing] + (distance_m[passing] + _STEP_M)[:, None] * ray
        return hits


def _meets_ball(
    rays: Rays, length_m: Float, centre: Float, radius_m: Float | float, spread: Float | float
) -> Bool:
    """Return a mask (N,) of the rays that meet a ball within a length (N,) in metres.

    ``spread`` is the greatest angle (rad) by which the true ray deviates from each ray.
    """
    # The ray passes the centre at a distance d, with d² = |to_centre|² - along².
    to_centre = centre - rays.origin
    along_m = np.einsum("ni,ni->n", to_centre, rays.direction)
    squared_m2 = np.einsum("ni,ni->n", to_centre, to_centre)
    # Up to the far side of the ball, the true ray deviates by at most the spread times the range.
    reach_m = radius_m + spread * (np.sqrt(squared_m2) + radius_m)
    meets: Bool = squared_m2 - along_m * along_m < reach_m * reach_m
    return meets & (along_m > -reach_m) & (along_m - reach_m < length_m)
