# SPDX-License-Identifier: MIT
"""Put the traffic of every scene on its lanes, without collisions. Time 0 is frame 0."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import SPAN_S, WHEELBASE_M, Actor, walker
from densify.street.materials import Material
from densify.street.mesh import Mesh, box
from densify.street.motion import Driving, Rectangles, Still, overlap
from densify.street.scenery import Scenery
from densify.street.terrain import Curve, Ground, Lane, Speed
from densify.street.world import Body, World

MEETING_S = 12.0  # time at which the actors are around the ego vehicle
_TRIES = 40
_NEAR_M = 25.0  # greatest distance of the centres of two objects that touch
EGO_BOX = box((-2.1, -0.95, 0.2), (2.4, 0.95, 1.5), Material.BODYWORK)

Maker = Callable[[Driving, int, np.random.Generator], Actor]
Recipe = Callable[[np.random.Generator], Actor]


@dataclass(frozen=True)
class Scene:
    """A world and its moving actors."""

    world: World
    ground: Ground
    ego: Driving
    actors: tuple[Actor, ...]
    footprints: Rectangles  # rectangles of the static objects that traffic must not touch


def tracks(actor: Actor, times_s: Float) -> list[Rectangles]:
    """Return, per solid body of an actor, its T footprints (rectangles on the ground) over time."""
    slack_m = 0.3 if len(actor.bodies) > actor.num_solid else 0.1
    solid = actor.bodies[: actor.num_solid]
    return [Rectangles.of(b.mesh, b.trajectory.poses(times_s), slack_m) for b in solid]


class Traffic:
    """Collector of actors that never collide with each other or with static objects."""

    def __init__(self, ego: Driving, scenery: Scenery, rng: np.random.Generator) -> None:
        self.ground, self.ego = scenery.ground, ego
        self.actors: list[Actor] = []
        self._rng = rng
        self._times = np.arange(SPAN_S[0], SPAN_S[1], 0.1)
        self._standing = Rectangles.joined(scenery.footprints)
        self._moving = _one(Rectangles.of(EGO_BOX, ego.poses(self._times), 0.2))

    def add(self, recipe: Recipe) -> None:
        """Add an actor, drawn again until it fits, or none if every random draw collides."""
        for _ in range(_TRIES):
            actor = recipe(self._rng)
            new = tracks(actor, self._times)
            if not any(self._meets(track) for track in new):
                self.actors.append(actor)
                self._moving = Rectangles.joined([self._moving, *map(_one, new)])
                return

    def _meets(self, track: Rectangles) -> bool:
        if overlap(track, self._moving).any():
            return True
        x, y = (self._standing.centre[:, i] - track.centre[:, i, None] for i in (0, 1))
        time, which = np.nonzero(x * x + y * y < _NEAR_M**2)
        return bool(overlap(track.rows(time), self._standing.rows(which)).any())

    def drive(
        self, make: Maker, lane: Lane, station_m: float, speed: Speed | float, slack_m: float = 2.0
    ) -> None:
        """Put a vehicle beside a station of the road at the meeting time, varied by ``slack_m``."""

        def recipe(rng: np.random.Generator) -> Actor:
            at = lane.at(station_m + rng.uniform(-slack_m, slack_m))
            moves = speed
            if not isinstance(moves, Speed):
                moves = Speed((0.0, moves + rng.uniform(-0.3, 0.3)))
            wheelbase_m = WHEELBASE_M[make.__name__]
            way = Driving(lane.curve, moves, at, MEETING_S, self.ground.terrain, wheelbase_m)
            return make(way, len(self.actors), rng)

        self.add(recipe)

    def walk(
        self, road: Curve, offset_m: tuple[float, float], forward: bool, station_m: float,
        slack_m: float = 4.0,
    ) -> None:  # fmt: skip
        """Put a pedestrian along a line, between two offsets to its left, on and off the kerb."""
        ground = self.ground

        def recipe(rng: np.random.Generator) -> Actor:
            lane = Lane(road, rng.uniform(*offset_m), forward)
            at = lane.at(station_m + rng.uniform(-slack_m, slack_m))

            def lift(station: Float) -> Float:
                return ground.kerb_m * np.clip(ground.distance(lane.curve(station)) / 0.25, 0, 1)

            speed = Speed((0.0, rng.uniform(1.1, 1.6)))
            way = Driving(lane.curve, speed, at, MEETING_S, ground.terrain, WHEELBASE_M["walker"],
                          lift, upright=True)  # fmt: skip
            return walker(way, len(self.actors), rng)

        self.add(recipe)


def _one(track: Rectangles) -> Rectangles:
    return Rectangles(*(column[None] for column in track))


def assemble(scenery: Scenery, parts: Sequence[Mesh], traffic: Traffic) -> Scene:
    """Return the scene: all static objects in one body, and the bodies of all actors."""
    static = Body(Mesh.join([*parts, *scenery.meshes]), Still())
    bodies = [static, *(body for actor in traffic.actors for body in actor.bodies)]
    footprints = Rectangles.joined(scenery.footprints)
    world = World(bodies, int(scenery.rng.integers(2**31)))
    return Scene(world, scenery.ground, traffic.ego, tuple(traffic.actors), footprints)


def jitter(rng: np.random.Generator, share: float = 0.15) -> float:
    """Return a random factor of 1 ± ``share``."""
    return float(rng.uniform(1 - share, 1 + share))
