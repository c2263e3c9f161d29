# SPDX-License-Identifier: MIT
"""Lines the roads of a scene: plots with houses and gardens, street furniture, parked cars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from densify.geometry.types import Float
from densify.street.materials import Material
from densify.street.mesh import Mesh
from densify.street.scenery import (
    Scenery,
    hedge,
    house,
    lamp_post,
    litter_bin,
    picket_fence,
    sign_post,
    tree,
    wall,
)
from densify.street.terrain import Ground, Road, strip

Span = tuple[float, float]


@dataclass(frozen=True)
class Side:
    """One side of a road between two stations: +1 its left, -1 its right."""

    road: Road
    side: int
    begin_m: float
    end_m: float

    def at(self, station_m: float, beyond_kerb_m: float) -> Float:
        """(2,) point so far outside the kerb abreast of the station."""
        s = np.array([station_m])
        edge = self.road.left_m if self.side > 0 else self.road.right_m
        normal = self.road.curve.normal(s)[0] * self.side
        point: Float = self.road.curve(s)[0] + normal * (edge + beyond_kerb_m)
        return point

    def heading(self, station_m: float) -> float:
        """Such that a mesh's +y points away from the road."""
        tangent = self.road.curve.tangent(np.array([station_m]))[0] * self.side
        return float(np.arctan2(tangent[1], tangent[0]))

    def forward(self, station_m: float) -> Float:
        """(2,) direction of the traffic on this side, which keeps to the right."""
        tangent: Float = self.road.curve.tangent(np.array([station_m]))[0] * -self.side
        return tangent


def line_with_plots(scenery: Scenery, side: Side, pavement_m: float) -> None:
    """Houses behind front gardens, each closed off by a hedge, a wall or a fence."""
    rng = scenery.rng
    station = side.begin_m
    while station < side.end_m - 8:
        width = rng.uniform(11.0, 17.0)
        middle = station + width / 2
        heading = side.heading(middle)
        garden = rng.uniform(3.0, 6.5)
        depth = rng.uniform(8.0, 10.5)
        boundary = pavement_m + 0.4
        home = house(rng, width - rng.uniform(2.5, 4.5), depth)
        place = side.at(middle, boundary + garden + depth / 2)
        built = scenery.is_free(home, place, heading, pavement_m + 1.5)
        if built:
            scenery.put(home, place, heading)
        if rng.random() < (0.45 if built else 1.0):
            shoot, foot = tree(rng)
            at = side.at(station + rng.uniform(2.0, width - 2.0), boundary + rng.uniform(1.2, 2.6))
            if scenery.is_free(foot, at, 0.0, pavement_m):
                scenery.put(shoot, at, solid=foot)
        _close_off(scenery, side, station, station + width, boundary, gate=built)
        station += width


def _close_off(
    scenery: Scenery, side: Side, begin: float, end: float, beyond_m: float, gate: bool
) -> None:
    rng = scenery.rng
    kind = int(rng.integers(5))
    light = float(rng.uniform(0.8, 1.9))
    panel: Callable[[float], Mesh] = [
        hedge(rng, float(rng.uniform(0.9, 1.7))),
        hedge(rng, float(rng.uniform(0.9, 1.3))),
        wall(float(rng.uniform(0.6, 1.6)), Material.BRICK),
        picket_fence(float(rng.uniform(0.9, 1.3)), (light, light, light)),
        wall(float(rng.uniform(0.5, 1.1)), Material.CONCRETE),
    ][kind]
    middle = (begin + end) / 2
    spans = [(begin, middle - 1.0), (middle + 1.0, end)] if gate else [(begin, end)]
    for a, b in spans:
        scenery.row(panel, side.at(a, beyond_m), side.at(b, beyond_m), beyond_m - 0.6)


def furnish(scenery: Scenery, side: Side, spacing_m: float, trees: bool) -> None:
    """Lamp posts, trees, signs and bins along the kerb."""
    rng = scenery.rng
    for station in np.arange(side.begin_m + rng.uniform(2, 8), side.end_m, spacing_m):
        heading = side.heading(station)
        scenery.put_if_free(lamp_post(), side.at(station, 0.55), heading, 0.2)
        if trees:
            for ahead in (0.33, 0.66):
                if rng.random() < 0.5:
                    shoot, foot = tree(rng)
                    at = side.at(station + ahead * spacing_m, 0.75)
                    if scenery.is_free(foot, at, 0.0, 0.2):
                        scenery.put(shoot, at, solid=foot)
        if rng.random() < 0.35:
            turned = heading + (np.pi if side.side > 0 else 0.0)
            scenery.put_if_free(sign_post(rng), side.at(station + 4.0, 0.5), turned, 0.1)
        if rng.random() < 0.25:
            scenery.put_if_free(litter_bin(), side.at(station + 1.5, 0.5), heading, 0.2)


def park_cars(
    scenery: Scenery, side: Side, share: float, first_instance: int, keep_free: Sequence[Span]
) -> int:
    """Cars along the kerb. share: of the places taken. Returns the next instance."""
    rng, instance = scenery.rng, first_instance
    station = side.begin_m + 4.0
    while station < side.end_m - 4.0:
        taken = rng.random() < share
        at = side.at(station, -1.15 + rng.uniform(-0.08, 0.08))
        free = not any(a - 3.0 < station < b + 3.0 for a, b in keep_free)
        on_edge = float(scenery.ground.distance(at[None])[0])
        if taken and free and on_edge > -1.6:  # not in the mouth of a side road
            scenery.park(at, side.forward(station), instance)
            instance += 1
        station += rng.uniform(5.4, 6.6)
    return instance


def mark_lanes(
    ground: Ground,
    road: Road,
    dashed: Sequence[float],
    solid: Sequence[float],
    spans: Sequence[Span],
) -> Mesh:
    """Lines at the given offsets to the left of the centreline, only within the spans."""
    dashes = [(s, s + 3.0) for a, b in spans for s in np.arange(a, b - 3.0, 9.0)]
    parts = [strip(ground, road.curve, offset, 0.12, dashes) for offset in dashed]
    parts += [strip(ground, road.curve, offset, 0.12, spans) for offset in solid]
    return Mesh.join(parts)


def zebra(ground: Ground, road: Road, station_m: float) -> Mesh:
    """A crossing for walkers, 3 m deep, over the whole road."""
    offsets = np.arange(-road.right_m + 0.5, road.left_m - 0.3, 1.0)
    span = [(station_m - 1.5, station_m + 1.5)]
    return Mesh.join([strip(ground, road.curve, float(o), 0.5, span) for o in offsets])
