# SPDX-License-Identifier: MIT
"""Build the scenes: town street (with traffic or static), crossroads and highway."""

from __future__ import annotations

from functools import cache

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import car, cyclist, truck
from densify.street.materials import Material
from densify.street.mesh import Mesh, box, frustum
from densify.street.motion import Driving
from densify.street.scenery import (
    Scenery,
    Side,
    furnish,
    hedge,
    lamp_post,
    line_with_plots,
    mark_lanes,
    park_cars,
    sign_post,
    tree,
)
from densify.street.terrain import Curve, Ground, Lane, Road, Speed, Terrain, polyline, strip
from densify.street.traffic import MEETING_S, Scene, Traffic, assemble, jitter

# Offsets from the middle line of a road driven on the right: one lane against the ego vehicle's
# direction, two with it, cycle lanes and parked cars on both sides.
_ONCOMING_M, _FAST_M, _SLOW_M = 1.65, -1.65, -4.85
_CYCLES_M, _CYCLES_BACK_M = -7.15, 3.95
_ROAD_LEFT_M, _ROAD_RIGHT_M = 7.2, 10.3
_EGO_START_M = 170.0


def static_street(rng: np.random.Generator) -> Scene:
    """Return the town street in which only the ego vehicle moves."""
    return street(rng, with_traffic=False)


def street(rng: np.random.Generator, with_traffic: bool = True) -> Scene:
    """Return the town street, with or without moving traffic."""
    bend = 1 / (36.0 * jitter(rng, 0.08))
    mild = jitter(rng, 0.3) / 190.0
    wiggle, phase = jitter(rng, 0.5) / 260.0, rng.uniform(0, 2 * np.pi)

    def curvature(station: Float) -> Float:
        s = station - _EGO_START_M
        turn = bend * np.clip(np.minimum((s - 36) / 8, (72 - s) / 8), 0, 1)
        calm = mild * np.clip(np.minimum((s - 84) / 8, (128 - s) / 8), 0, 1)
        far = np.clip(np.maximum(-s / 30, (s - 160) / 30), 0, 1)
        return turn - calm + far * wiggle * np.sin(station / 45 + phase)

    main = Curve.bending(620.0, curvature, _EGO_START_M)
    mouth_m = _EGO_START_M + 130.0
    corner = np.array([mouth_m])
    start, away = main(corner)[0], main.normal(corner)[0]
    side_xy = start + away * np.arange(0.0, 130.5, 0.5)[:, None]
    roads = Road(main, _ROAD_LEFT_M, _ROAD_RIGHT_M), Road(Curve(side_xy), 4.6, 4.6)
    ground = Ground(Terrain.hilly(rng, 0.05), roads, 0.12, 3.3)
    scenery = Scenery(ground, rng)
    key_m = _EGO_START_M + 97.0
    parts = _dress_street(scenery, roads, mouth_m, key_m)
    slow = Lane(main, _SLOW_M)
    ego_speed = Speed(
        (-1, 8.4), (3, 8.4), (4.5, 7.2), (7.5, 7.2), (9.5, 8.6), (12.5, 8.2), (15, 6.5)
    )
    ego = Driving(slow.curve, ego_speed, slow.at(_EGO_START_M), 0.0, ground.terrain, 2.7)
    traffic = Traffic(ego, scenery, rng)
    if with_traffic:
        _people_street(traffic, roads, mouth_m, slow, rng)
    return assemble(scenery, parts, traffic)


def _dress_street(
    scenery: Scenery, roads: tuple[Road, ...], mouth_m: float, key_m: float
) -> list[Mesh]:
    main, side = roads
    end = main.curve.length_m - 20
    spans = (1, 20.0, mouth_m - 14), (1, mouth_m + 14, end), (-1, 20.0, end)
    stretches = [Side(main, *span) for span in spans]
    stretches += [Side(side, which, 24.0, 120.0) for which in (1, -1)]
    for stretch in stretches:
        line_with_plots(scenery, stretch)
    for stretch in stretches:
        furnish(scenery, stretch, 27.0, trees=stretch.road is main)
    for stretch in stretches[:3]:
        # Gaps near the key show the pedestrians behind the parked cars.
        free = [(key_m + 4, key_m + 16)] if stretch.side > 0 else [(key_m + 8, key_m + 15)]
        free.append((mouth_m - 24, mouth_m + 24) if stretch.side > 0 else (0.0, 0.0))
        park_cars(scenery, stretch, 0.62, free)
    ground = scenery.ground
    left_open = [(0.0, mouth_m - 10), (mouth_m + 10, end)]
    return [
        ground.mesh(18.0, 1.0),
        mark_lanes(ground, main, (-3.25,), (-6.5, 0.08, -0.08, -7.85), [(0.0, end)]),
        mark_lanes(ground, main, (), (3.3, 4.65), left_open),
        mark_lanes(ground, side, (0.0,), (), [(18.0, 120.0)]),
    ]


def _people_street(
    traffic: Traffic, roads: tuple[Road, ...], mouth_m: float, slow: Lane, rng: np.random.Generator
) -> None:
    drive = traffic.drive
    main, side = (road.curve for road in roads)
    here = float(
        np.interp(traffic.ego.station(np.array([MEETING_S]))[0], slow.curve.knots_m, main.knots_m)
    )
    fast, oncoming = Lane(main, _FAST_M), Lane(main, _ONCOMING_M, forward=False)
    # a braking car in front, an overtaking car, oncoming cars, a turning truck
    brake = Speed((-1, 8.6), (4, 7.6), (8, 7.8), (10.2, 9.6), (11.0, 9.6), (13.0, 4.6), (14.5, 4.6),
                  (17, 5.5))  # fmt: skip
    drive(car, slow, here + 20.0, brake, 1.0)
    drive(car, fast, here + 9.0, Speed((0.0, 13.5 * jitter(rng, 0.06))), 1.5)
    drive(car, fast, here - 42.0, Speed((0.0, 12.0)), 6.0)
    turn, turn_m = _turning(main, side)
    brakes = Speed((0.0, 8.6), (8.0, 8.0), (10.5, 5.0), (15.0, 5.0), (17.0, 7.0))
    drive(truck, turn, turn_m + 7.0, brakes, 1.0)
    drive(car, oncoming, here + 12.0, Speed((0.0, 8.8), (9.0, 8.4), (16.0, 9.0)), 1.0)
    drive(car, oncoming, mouth_m + 30.0, Speed((0, 9.0), (8.5, 8.0), (12.0, 2.4), (17.0, 5.5)), 2.0)
    drive(car, oncoming, here - 22.0, Speed((0.0, 10.0)), 4.0)
    drive(car, oncoming, here - 75.0, Speed((0.0, 11.0)), 8.0)
    drive(car, slow, here - 30.0, Speed((-1, 8.2), (4, 7.2), (9, 7.6), (15, 6.2)), 4.0)
    there, back = Lane(main, _CYCLES_M), Lane(main, _CYCLES_BACK_M, forward=False)
    drive(cyclist, there, here + 11.5, 4.6, 1.0)
    drive(cyclist, back, here + 27.0, 5.2, 1.0)
    for side_of, forward, ahead in (
        (1, False, 10.0), (1, True, 6.0), (-1, True, 11.0), (-1, False, 19.0), (-1, False, -14.0),
        (1, True, -24.0),
    ):  # fmt: skip
        kerb = _ROAD_LEFT_M if side_of > 0 else _ROAD_RIGHT_M
        low, high = sorted((side_of * (kerb + 1.3), side_of * (kerb + 2.7)))
        traffic.walk(main, (low, high), forward, here + ahead)


def _turning(main: Curve, side: Curve) -> tuple[Lane, float]:
    """Return the path from the oncoming lane into the side road, and its turning point."""
    oncoming = Lane(main, _ONCOMING_M, forward=False).curve
    knots = np.arange(0.0, oncoming.length_m, 0.5)
    xy = oncoming(knots)
    origin, out = side(np.zeros(1))[0], side.tangent(np.zeros(1))[0]
    along = np.array([out[1], -out[0]])  # the ego vehicle's way
    ahead = (xy - origin) @ along
    far = np.abs(xy - origin).sum(axis=1) < 400
    straight = xy[far & (ahead > 14.6)]
    corner = origin + along + out * float((straight[-1] - origin) @ out)
    radius_m, rest_m = 13.0, 100.0
    turn = polyline([straight[-1], corner, corner + rest_m * out], radius_m)
    curve = Curve(np.concatenate([straight[:-1], turn]))
    begin_m = curve.length_m - (rest_m - radius_m) - radius_m * np.pi / 2
    return Lane(curve, 0.0), begin_m


_CROSS_X_M = 17.0


def crossing(rng: np.random.Generator) -> Scene:
    """Return the crossroads, with the ego vehicle at rest and others crossing in front of it."""
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
    """Return a pedestrian crossing, 3 m deep, over the whole road."""
    offsets = np.arange(-road.right_m + 0.5, road.left_m - 0.3, 1.0)
    span = [(station_m - 1.5, station_m + 1.5)]
    return Mesh.join([strip(ground, road.curve, float(o), 0.5, span) for o in offsets])


_LANE_M = 3.6
_MEDIAN_M = 1.6


def highway(rng: np.random.Generator) -> Scene:
    """Return three lanes each way. The ego vehicle drives 25 m/s, oncoming cars 30 m/s."""
    start_m = 240.0
    bend, phase = jitter(rng, 0.4) / 1100.0, rng.uniform(0, 2 * np.pi)

    def curvature(station: Float) -> Float:
        return bend * np.sin(station / 160.0 + phase)

    main = Curve.bending(1100.0, curvature, start_m)
    half = _MEDIAN_M + 3 * _LANE_M + 2.6  # with the hard shoulder
    road = Road(main, half, half)
    ground = Ground(Terrain.hilly(rng, 0.04, 2.5), (road,), 0.0, 0.0)
    scenery = Scenery(ground, rng)
    _dress_highway(scenery, road)
    lines = [_MEDIAN_M + _LANE_M * i for i in range(4)]
    dashed, solid = ([o * s for o in which for s in (1, -1)] for which in (lines[1:3], lines[::3]))
    parts = [ground.mesh(24.0, 2.0), mark_lanes(ground, road, dashed, solid, [(0.0, 1090.0)])]
    lanes = [Lane(main, -_MEDIAN_M - _LANE_M * (i + 0.5)) for i in range(3)]
    back = [Lane(main, _MEDIAN_M + _LANE_M * (i + 0.5), forward=False) for i in range(3)]
    fast, middle, slow = lanes
    ego = Driving(middle.curve, Speed((0.0, 25.0)), middle.at(start_m), 0.0, ground.terrain, 2.7)
    traffic = Traffic(ego, scenery, rng)
    drive = traffic.drive
    here = start_m + 25.0 * MEETING_S
    drive(truck, slow, here + 26.0, Speed((0.0, 22.0)), 1.0)
    drive(car, fast, here + 14.0, Speed((0.0, 31.0 * jitter(rng, 0.03))))
    drive(car, middle, here + 32.0, Speed((-1.0, 26.5), (10.5, 26.5), (14.0, 22.0)))
    drive(car, slow, here - 30.0, Speed((0.0, 23.0)))
    drive(car, fast, here - 55.0, Speed((0.0, 29.0)), 8.0)
    drive(car, slow, here + 62.0, Speed((0.0, 23.0)), 4.0)
    drive(car, fast, here + 75.0, Speed((0.0, 30.0)), 6.0)
    drive(truck, back[2], here + 28.0, Speed((0.0, 24.0)), 1.0)
    for lane, first, speed in ((0, 18.0, 33.0), (1, 34.0, 30.0), (2, 60.0, 27.0)):
        for k in range(-9, 7):
            gap = 62.0 * jitter(rng, 0.2)
            drive(car, back[lane], here + first + k * gap, Speed((0.0, speed)), 6.0)
    return assemble(scenery, parts, traffic)


@cache
def guard_rail(length_m: float) -> Mesh:
    """Return a guard rail of this length along x."""
    half = length_m / 2 + 0.02
    post = box((-0.05, -0.05, -0.3), (0.05, 0.05, 0.72), Material.METAL)
    beams = [frustum((-half, -0.08, z), (half, 0.0, z + 0.13), Material.METAL, (1.15, 1.15, 1.15),
                     (1.0, 0.6)) for z in (0.45, 0.60)]  # fmt: skip
    return Mesh.join([post, *beams])


@cache
def noise_barrier(length_m: float) -> Mesh:
    """Return a noise barrier of this length along x."""
    half = length_m / 2
    slab = box((-half, -0.08, -0.8), (half, 0.08, 3.2), Material.CONCRETE, (0.9, 0.95, 0.85))
    post = box((-half - 0.1, -0.16, -0.8), (-half + 0.1, 0.16, 3.4), Material.METAL)
    return Mesh.join([slab, post])


def _dress_highway(scenery: Scenery, road: Road) -> None:
    rng = scenery.rng
    end = road.curve.length_m - 20
    for station in np.arange(10.0, end, 4.0):
        median_m = -road.left_m + 0.5
        for side, beyond in ((1, 0.7), (-1, 0.7), (1, median_m), (-1, median_m)):
            at = Side(road, side, 0.0, end)
            scenery.put(guard_rail(4.0), at.at(station, beyond), at.heading(station))
    median = Side(road, 1, 0.0, end)
    for station in np.arange(20.0, end, 38.0):
        scenery.put(lamp_post(), median.at(station, -road.left_m), median.heading(station))
        for side in (1, -1):
            edge = Side(road, side, 0.0, end)
            spot = float(station * jitter(rng, 0.02))
            scenery.put(sign_post(rng), edge.at(spot, 1.6), edge.heading(spot))
    quiet = rng.uniform(150, 260), rng.uniform(560, 640)
    for side in (1, -1):
        edge = Side(road, side, 0.0, end)
        for station in np.arange(10.0, end, 4.0):
            if side > 0 and quiet[0] < station < quiet[1]:
                scenery.put(noise_barrier(4.0), edge.at(station, 5.0), edge.heading(station))
            elif rng.random() < 0.3:
                shoot, foot = tree(rng)
                scenery.put(shoot, edge.at(station, rng.uniform(5.5, 22.0)), solid=foot)
            elif rng.random() < 0.5:
                bush = hedge(rng, float(rng.uniform(0.8, 1.8)))(rng.uniform(2.0, 4.0))
                scenery.put(bush, edge.at(station, rng.uniform(2.5, 9.0)), edge.heading(station))
