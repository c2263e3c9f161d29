# SPDX-License-Identifier: MIT
"""``street`` and ``street:static``: a street in town with a bend, a side road and its traffic."""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import car, cyclist, truck
from densify.street.mesh import Mesh
from densify.street.motion import Driving
from densify.street.scenery import Scenery, Side, furnish, line_with_plots, mark_lanes, park_cars
from densify.street.terrain import Curve, Ground, Lane, Road, Speed, Terrain, polyline
from densify.street.traffic import MEETING_S, Scene, Traffic, assemble, jitter

# Offsets from the middle line of a road driven on the right: one lane against the ego vehicle's
# direction, two with it, cycle lanes and parked cars on both sides.
_ONCOMING_M, _FAST_M, _SLOW_M = 1.65, -1.65, -4.85
_CYCLES_M, _CYCLES_BACK_M = -7.15, 3.95
_ROAD_LEFT_M, _ROAD_RIGHT_M = 7.2, 10.3
_EGO_START_M = 170.0


def static_street(rng: np.random.Generator) -> Scene:
    """Build the street in town in which only the ego vehicle moves."""
    return street(rng, with_traffic=False)


def street(rng: np.random.Generator, with_traffic: bool = True) -> Scene:
    """Build the street in town."""
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
        # some gaps near the key, so that one sees who walks behind
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
    # the car in front brakes; another overtakes; cars come the other way before a turning truck
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
    """The way from the oncoming lane into the side road on its right, and where it turns."""
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
