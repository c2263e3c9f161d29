# SPDX-License-Identifier: MIT
"""``street:crossing``: the ego vehicle stands at a crossroads, others cross before it."""

from __future__ import annotations

import numpy as np

from densify.street.actors import car, cyclist, truck
from densify.street.mesh import Mesh
from densify.street.motion import Driving
from densify.street.scenery import Scenery, Side, furnish, line_with_plots, mark_lanes, park_cars
from densify.street.terrain import Curve, Ground, Lane, Road, Speed, Terrain, polyline, strip
from densify.street.traffic import Scene, Traffic, assemble, jitter

_CROSS_X_M = 17.0


def crossing(rng: np.random.Generator) -> Scene:
    """The ego vehicle stands at a crossroads; others cross before it."""
    main = Curve(np.column_stack([np.arange(-150.0, 200.5, 0.5), np.zeros(701)]))
    across = Curve(np.column_stack([np.full(801, _CROSS_X_M), np.arange(-200.0, 200.5, 0.5)]))
    roads = (Road(main, 5.6, 5.6), Road(across, 6.0, 6.0))
    ground = Ground(Terrain.hilly(rng, 0.04), roads, 0.12, 3.3)
    scenery = Scenery(ground, rng)
    here, there = 150.0, 200.0  # stations of the ego vehicle and of the crossroads
    cross_at = here + _CROSS_X_M
    stretches = [
        Side(roads[0], s, a, b)
        for s in (1, -1)
        for a, b in ((20.0, cross_at - 22), (cross_at + 22, 340.0))
    ] + [Side(roads[1], s, a, b) for s in (1, -1) for a, b in ((20.0, 178.0), (222.0, 380.0))]
    for stretch in stretches:
        line_with_plots(scenery, stretch)
    for stretch in stretches:
        furnish(scenery, stretch, 25.0, trees=True)
    for stretch in stretches[:4]:  # the crossing road has cycle lanes instead
        park_cars(scenery, stretch, 0.4, [(cross_at - 30, cross_at + 30)])
    spans = [(0.0, cross_at - 13), (cross_at + 13, 350.0)]
    parts = [
        ground.mesh(18.0, 1.0),
        mark_lanes(ground, roads[0], (0.0,), (), spans),
        mark_lanes(ground, roads[1], (0.0,), (), [(0.0, there - 12), (there + 12, 400.0)]),
        zebra(ground, roads[0], here + 7.6),
    ]
    lane = Lane(main, -1.7)
    ego = Driving(lane.curve, Speed((0.0, 0.0)), here, 0.0, ground.terrain, 2.7)
    traffic = Traffic(ego, scenery, rng)
    _people_crossing(traffic, main, across, here, rng)
    return assemble(scenery, parts, traffic)


def _people_crossing(
    traffic: Traffic, main: Curve, across: Curve, here: float, rng: np.random.Generator
) -> None:
    drive = traffic.drive
    # stations of the crossing road: 200 is straight ahead of the ego vehicle, 400 far to its left
    leftward, rightward = Lane(across, -1.8), Lane(across, 1.8, forward=False)
    corner = [(200.0, 1.8), (_CROSS_X_M + 1.9, 1.8), (_CROSS_X_M + 1.9, 200.0)]
    turn = Curve(polyline(corner, 11.0))
    begin_m = 200.0 - _CROSS_X_M - 1.9 - 11.0
    brakes = Speed((0.0, 9.0), (8.0, 8.0), (10.5, 4.6), (14.5, 4.6), (17.0, 7.0))
    drive(truck, Lane(turn, 0.0), begin_m + 6.0, brakes, 1.0)
    for station, speed in ((191.0, 10.5), (226.0, 12.0), (262.0, 12.5), (150.0, 9.0)):
        drive(car, rightward, station, Speed((0.0, speed * jitter(rng, 0.05))), 3.0)
    for station, speed in ((262.0, 13.5), (300.0, 14.0), (345.0, 13.0)):
        drive(car, leftward, station, Speed((0.0, speed * jitter(rng, 0.04))), 4.0)
    drive(car, leftward, 160.0, Speed((-1, 11.0), (9.0, 9.0), (13.5, 3.0), (17.0, 4.0)), 3.0)
    back = Lane(across, 4.4, forward=False)
    drive(cyclist, back, 205.0, 5.0, 1.0)
    drive(cyclist, Lane(across, -4.4), 186.0, 4.6, 1.0)
    # on the zebra, then on the pavements
    for x, forward, y in ((7.0, True, 0.6), (8.3, False, 1.8), (7.7, True, -4.2)):
        line = Curve(np.column_stack([np.full(121, x), np.arange(-30.0, 30.5, 0.5)]))
        traffic.walk(line, (-0.3, 0.3), forward, 30.0 + y, 0.8)
    for forward, station in ((True, 186.0), (False, 216.0), (True, 221.0)):
        traffic.walk(across, (-8.7, -7.3), forward, station)
    traffic.walk(main, (-8.2, -7.0), True, here + 4.0)


def zebra(ground: Ground, road: Road, station_m: float) -> Mesh:
    """A crossing for walkers, 3 m deep, over the whole road."""
    offsets = np.arange(-road.right_m + 0.5, road.left_m - 0.3, 1.0)
    span = [(station_m - 1.5, station_m + 1.5)]
    return Mesh.join([strip(ground, road.curve, float(o), 0.5, span) for o in offsets])
