# SPDX-License-Identifier: MIT
"""Cast rays among moving rigid bodies, each ray at its own time.

Rays are transformed to the frame of each body by the body's pose at the ray's time. A body that
moves during a sweep is therefore distorted as in reality. This module is the only one that imports
Embree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from densify.geometry.types import Bool, Float, Int
from densify.street.mesh import Mesh, across, lengths
from densify.street.motion import Still, Trajectory, poses_at

_STEP_M = 2e-3  # from a surface that a ray passes to its next origin
_MAX_LAYERS = 8  # most layers of glass and leaves that one ray passes


@dataclass(frozen=True)
class Body:
    """A rigid body.

    Attributes:
        mesh: Mesh in the frame of the body.
        trajectory: Pose of the body over time.
        instance: Number of the object it is part of; -1 if its triangles have object numbers.
    """

    mesh: Mesh
    trajectory: Trajectory
    instance: int = -1


class Rays(NamedTuple):
    """N rays.

    Attributes:
        origin: (N,3) metres, world.
        direction: (N,3) unit vectors, world.
        time_s: (N,) seconds since frame 0.
    """

    origin: Float
    direction: Float
    time_s: Float


class Hits(NamedTuple):
    """The hits of N rays.

    Attributes:
        range_m: (N,) distances, inf without a hit.
        triangle: (N,) index over the triangles of all bodies, -1 without a hit.
        barycentric: (N,2) u and v, as in ``(1-u-v) a + u b + v c``.
        normal: (N,3) normal of the triangle, world axes, of either sign.
        absorbed: (N,) True if the ray ends at a surface without a return. Its range is inf.
    """

    range_m: Float
    triangle: Int
    barycentric: Float
    normal: Float
    absorbed: Bool


class Meeting(NamedTuple):
    """K rays that meet a surface of a body, for which `Optics` decides whether they end there.

    Attributes:
        ray: (K,) ray indices.
        triangle: (K,) triangle indices.
        place: (K,3) position in the frame of the body.
        cosine: (K,) cosine of the angle of incidence.
        inside: (K,) True if the previous surface that the ray passed was of the same object.
        layer: Number of surfaces that the rays have passed before.
    """

    ray: Int
    triangle: Int
    place: Float
    cosine: Float
    inside: Bool
    layer: int


STOPS, PASSES, ABSORBED = range(3)
Optics = Callable[[Meeting], Int]
"""Function that returns (K,) STOPS, PASSES or ABSORBED for the rays of a meeting."""


class Triangles:
    """The triangles of all bodies in a row, without triangles of no area.

    ``body[k]``, ``material[k]``, ``instance[k]``, ``corner[k]``, ``normal[k]``, ``uv[k]`` and
    ``tint[k]`` belong to triangle k.

    Attributes:
        first: Index of the first triangle of each body.
        scenes: Embree scene of each body, in single precision.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        meshes = [b.mesh.of_instance(b.instance) if b.instance >= 0 else b.mesh for b in bodies]
        mesh = Mesh.join(meshes)
        corners = mesh.vertices.astype(np.float32).astype(np.float64)[mesh.triangles]
        normal = across(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = lengths(normal)
        keep = length[:, 0] > 1e-7
        counts = [len(m.triangles) for m in meshes]
        self.body = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)[keep]
        self.first: Int = np.searchsorted(self.body, np.arange(len(meshes) + 1))
        self.material = mesh.material[keep].astype(np.int64)
        self.tint: Float = mesh.tint[keep]
        self.uv: Float = mesh.uv[mesh.triangles[keep]]
        self.instance = mesh.instance[keep]
        self.corner: Float = corners[keep, 0]
        self.normal: Float = normal[keep] / length[keep]
        self.scenes = [_raycasting_scene(c) for c in np.split(corners[keep], self.first[1:-1])]


class World:
    """All bodies. Body 0 is static.

    Attributes:
        seed: Seed of the random properties of surfaces.
    """

    def __init__(self, bodies: Sequence[Body], seed: int = 0) -> None:
        self.bodies, self.seed = tuple(bodies), seed

    @cached_property
    def triangles(self) -> Triangles:
        """The triangles of all bodies, built at first use.

        Poses do not need the triangles, whose construction takes a third of the time of a scene.
        """
        return Triangles(self.bodies)

    def cast(self, rays: Rays, optics: Optics, num_together: int = 1, spread: float = 0.0) -> Hits:
        """Return the first surface at which each ray ends.

        Args:
            optics: Decides for each surface that a ray meets.
            num_together: Number of consecutive rays with the same origin and time, whose
                directions are within ``spread`` rad of the first ray's.
        """
        every = np.arange(len(rays.time_s))
        best = self._cast_body(0, rays.origin, rays.direction, every, optics)
        for index, near in self._near(Rays(*(c[::num_together] for c in rays)), spread):
            rows = (near[:, None] * num_together + np.arange(num_together)).ravel()
            trajectory, time_s = self.bodies[index].trajectory, rays.time_s[rows]
            origin, direction = rays.origin[rows], rays.direction[rows]
            if isinstance(trajectory, Still):
                found = self._cast_body(index, origin, direction, rows, optics)
            else:
                poses = poses_at(trajectory, time_s)
                ray = poses.undo(origin), poses.unturn(direction)
                found = self._cast_body(index, *ray, rows, optics)
                found = found._replace(normal=poses.turn(found.normal))
            nearer = np.flatnonzero(found.range_m < best.range_m[rows])
            for column, new in zip(best, found, strict=True):
                column[rows[nearer]] = new[nearer]
        best.range_m[best.absorbed] = np.inf
        return best

    def _near(self, rays: Rays, spread: float) -> Iterator[tuple[int, Int]]:
        """Yield the index of each body but the first, and the indices of the rays that may hit it.

        These rays intersect a ball around the positions of the body at all of their times.
        """
        ends_s = np.array([rays.time_s.min(), rays.time_s.max()])
        origin, direction = rays.origin.T.copy(), rays.direction.T.copy()
        for index, body in enumerate(self.bodies[1:], start=1):
            low, high = body.mesh.bounds
            ends = body.trajectory.poses(ends_s).apply(np.tile((low + high) / 2, (2, 1)))
            moved_m, half_m = np.linalg.norm(ends[1] - ends[0]), np.linalg.norm(high - low) / 2
            away = ends.mean(axis=0)[:, None] - origin
            along = np.einsum("in,in->n", away, direction)
            reach_m = half_m + 0.75 * moved_m + 0.1 + spread * np.abs(along)
            is_near = np.einsum("in,in->n", away, away) - along * along < reach_m * reach_m
            rows = np.flatnonzero(is_near & (along > -reach_m))
            if len(rows):
                yield index, rows

    def _cast_body(
        self, index: int, origin: Float, direction: Float, number: Int, optics: Optics
    ) -> Hits:
        """Return the hits of rays with one body.

        Distances are to the plane of the triangle, in double precision, also for absorbed rays.

        Args:
            origin: (N,3) in the frame of the body.
            direction: (N,3) in the frame of the body.
            number: (N,) indices of the rays.
        """
        surfaces, first, n = self.triangles, self.triangles.first[index], len(origin)
        hits = Hits(
            np.full(n, np.inf), np.full(n, -1), np.zeros((n, 2)), np.zeros((n, 3)),
            np.zeros(n, bool),
        )  # fmt: skip
        rows, begin, passed = np.arange(n), np.zeros(n), np.full(n, -1, np.int32)
        for layer in range(_MAX_LAYERS):
            ray = direction[rows]
            start = origin[rows] + begin[rows, None] * ray
            triangle, barycentric = _first_hit(surfaces.scenes[index], start, ray)
            met = np.flatnonzero(triangle >= 0)
            rows, triangle, ray = rows[met], triangle[met] + first, ray[met]
            if not len(rows):
                break
            normal, instance = surfaces.normal[triangle], surfaces.instance[triangle]
            to_plane = np.einsum("ni,ni->n", surfaces.corner[triangle] - origin[rows], normal)
            facing = np.einsum("ni,ni->n", ray, normal)
            distance = to_plane / facing
            place = origin[rows] + distance[:, None] * ray
            inside = (instance >= 0) & (instance == passed[rows])
            meeting = Meeting(number[rows], triangle, place, np.abs(facing), inside, layer)
            outcome = optics(meeting)
            ends, goes_on = outcome != PASSES, outcome == PASSES
            ended = distance, triangle, barycentric[met], normal, outcome == ABSORBED
            for column, new in zip(hits, ended, strict=True):
                column[rows[ends]] = new[ends]
            rows = rows[goes_on]
            begin[rows], passed[rows] = distance[goes_on] + _STEP_M, instance[goes_on]
        return hits


@cache
def _device() -> Any:
    """Return the one Embree device of all scenes.

    With a device for each scene, Embree fails after a thousand.
    """
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


def _raycasting_scene(corners: Float) -> Any:
    """Return the Embree scene of (T,3,3) triangle corners."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(_device())
    TriangleMesh(scene, corners.astype(np.float32))
    return scene


def _first_hit(scene: Any, origin: Float, direction: Float) -> tuple[NDArray[np.int64], Float]:
    """Return the (N,) index of the first triangle hit, -1 for none, and (N,2) barycentric u, v."""
    found = scene.run(
        origin.astype(np.float32), direction.astype(np.float32), query="INTERSECT", output=True
    )
    return found["primID"].astype(np.int64), np.stack([found["u"], found["v"]], 1).astype(float)
