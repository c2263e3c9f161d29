# SPDX-License-Identifier: MIT
"""The traffic of every scene: a cast put on lanes so that it meets around the ego vehicle
after 12 seconds and touches nothing at any time.

Time zero is frame 0's, whatever the rate of the sweeps. Traffic that would touch anything is drawn
again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import (
    BICYCLE_WHEELBASE_M,
    CAR_WHEELBASE_M,
    TRACTOR_WHEELBASE_M,
    WALKER_BASE_M,
    Actor,
    car,
    cyclist,
    truck,
    walker,
)
from densify.street.materials import Material
from densify.street.mesh import Mesh, box
from densify.street.motion import Driving, Rectangles, Still, overlap
from densify.street.scenery import Scenery
from densify.street.terrain import Curve, Ground, Lane, Speed
from densify.street.world import Body, World

DURATION_S = 16
MEETING_S = 12.0  # when the cast is around the ego vehicle
SPAN_S = (-1.0, DURATION_S + 1.0)  # in which poses are asked for
FIRST_PARKED = 1000  # instances of parked cars count from here
PAVEMENT_M = 3.3
_TRIES = 40
_NEAR_M = 25.0  # no two centres of things that touch are farther apart
EGO_BOX = box((-2.1, -0.95, 0.2), (2.4, 0.95, 1.5), Material.BODYWORK)

Recipe = Callable[[np.random.Generator], Actor]


@dataclass(frozen=True)
class Scene:
    """A world and who moves in it. footprints: of the scenery that stands in the way."""

    world: World
    ground: Ground
    ego: Driving
    actors: tuple[Actor, ...]
    footprints: Rectangles


def tracks(actor: Actor, times_s: Float) -> list[Rectangles]:
    """(T,) rectangles of each solid body of an actor; swinging limbs get room."""
    slack_m = 0.3 if len(actor.bodies) > actor.num_solid else 0.1
    ways = (
        b.trajectory.from_above() if isinstance(b.trajectory, Driving) else b.trajectory
        for b in actor.bodies
    )
    return [
        Rectangles.moving(b.mesh, way, times_s, slack_m)
        for b, way in zip(actor.bodies[: actor.num_solid], ways, strict=False)
    ]


class Traffic:
    """Adds actors that touch nothing and nobody at any time."""

    def __init__(self, ego: Driving, scenery: Scenery, rng: np.random.Generator) -> None:
        self.actors: list[Actor] = []
        self._rng = rng
        self._times = np.arange(SPAN_S[0], SPAN_S[1], 0.1)
        self._standing = Rectangles.stack(scenery.footprints)
        self._moving = Rectangles.moving(EGO_BOX, ego, self._times, 0.2)[None]

    def add(self, recipe: Recipe) -> None:
        """recipe: draws an actor; drawn again until one fits, and left out if none does."""
        for _ in range(_TRIES):
            actor = recipe(self._rng)
            new = tracks(actor, self._times)
            if not any(self._meets(track) for track in new):
                self.actors.append(actor)
                self._moving = Rectangles.joined([self._moving, *(track[None] for track in new)])
                return

    def _meets(self, track: Rectangles) -> bool:
        if overlap(track, self._moving).any():
            return True
        x, y = (self._standing.centre[:, i] - track.centre[:, i, None] for i in (0, 1))
        time, which = np.nonzero(x * x + y * y < _NEAR_M**2)
        return bool(overlap(track[time], self._standing[which]).any())

    @property
    def next_instance(self) -> int:
        return len(self.actors)


@dataclass(frozen=True)
class Ways:
    """Puts actors on lanes, abreast of a station of the road at the meeting time."""

    ground: Ground
    traffic: Traffic

    def _driving(self, lane: Lane, station_m: float, speed: Speed, wheelbase_m: float) -> Driving:
        at = lane.at(station_m)
        return Driving(lane.curve, speed, at, MEETING_S, self.ground.terrain, wheelbase_m)

    def car(self, lane: Lane, station_m: float, speed: Speed, slack_m: float = 2.0) -> None:
        def recipe(rng: np.random.Generator) -> Actor:
            at = station_m + rng.uniform(-slack_m, slack_m)
            way = self._driving(lane, at, speed, CAR_WHEELBASE_M)
            return car(way, self.traffic.next_instance, rng)

        self.traffic.add(recipe)

    def truck(self, lane: Lane, station_m: float, speed: Speed) -> None:
        def recipe(rng: np.random.Generator) -> Actor:
            at = station_m + rng.uniform(-1.0, 1.0)
            way = self._driving(lane, at, speed, TRACTOR_WHEELBASE_M)
            return truck(way, SPAN_S, self.traffic.next_instance, rng)

        self.traffic.add(recipe)

    def cyclist(self, lane: Lane, station_m: float, speed_m_s: float) -> None:
        def recipe(rng: np.random.Generator) -> Actor:
            at, v = station_m + rng.uniform(-1.0, 1.0), speed_m_s + rng.uniform(-0.3, 0.3)
            way = self._driving(lane, at, Speed((0.0, v)), BICYCLE_WHEELBASE_M)
            return cyclist(way, self.traffic.next_instance, rng)

        self.traffic.add(recipe)

    def walker(
        self, road: Curve, offset_m: tuple[float, float], forward: bool, station_m: float,
        slack_m: float = 4.0,
    ) -> None:  # fmt: skip
        """Along a road or another line, somewhere between two offsets to its left; on and off the
        kerb where the way leads over it."""

        def recipe(rng: np.random.Generator) -> Actor:
            lane = Lane(road, rng.uniform(*offset_m), forward)
            at = lane.at(station_m + rng.uniform(-slack_m, slack_m))
            speed = Speed((0.0, rng.uniform(1.1, 1.6)))
            way = Driving(lane.curve, speed, at, MEETING_S, self.ground.terrain, WALKER_BASE_M,
                          _Kerbs(self.ground, lane.curve), upright=True)  # fmt: skip
            return walker(way, self.traffic.next_instance, rng)

        self.traffic.add(recipe)


@dataclass(frozen=True)
class _Kerbs:
    """How much higher than the road one walks along a curve; worked out for whoever stays."""

    ground: Ground
    curve: Curve

    @cached_property
    def _height_m(self) -> Float:
        """Heights at the curve's knots."""
        from_kerb = self.ground.distance(self.curve(self.curve.knots_m))
        return self.ground.kerb_m * np.clip(from_kerb / 0.25, 0, 1)

    def __call__(self, station_m: Float) -> Float:
        return np.interp(station_m, self.curve.knots_m, self._height_m)


def assemble(scenery: Scenery, parts: Sequence[Mesh], ego: Driving, traffic: Traffic) -> Scene:
    """All that stands in one body, and the bodies of all that moves."""
    static = Body(Mesh.join([*parts, *scenery.meshes]), Still())
    bodies = [static, *(body for actor in traffic.actors for body in actor.bodies)]
    return Scene(
        World(bodies),
        scenery.ground,
        ego,
        tuple(traffic.actors),
        Rectangles.stack(scenery.footprints),
    )


def jitter(rng: np.random.Generator, share: float = 0.15) -> float:
    """A factor about 1."""
    return float(rng.uniform(1 - share, 1 + share))
