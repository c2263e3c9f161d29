# SPDX-License-Identifier: MIT
"""``street:highway``: three lanes each way; the ego vehicle drives 25 m/s, others come with 30."""

from __future__ import annotations

from functools import cache

import numpy as np

from densify.geometry.types import Float
from densify.street.actors import car, truck
from densify.street.materials import Material
from densify.street.mesh import Mesh, box, frustum
from densify.street.motion import Driving
from densify.street.scenery import Scenery, Side, hedge, lamp_post, mark_lanes, sign_post, tree
from densify.street.terrain import Curve, Ground, Lane, Road, Speed, Terrain
from densify.street.traffic import MEETING_S, Scene, Traffic, assemble, jitter

_LANE_M = 3.6
_MEDIAN_M = 1.6


def highway(rng: np.random.Generator) -> Scene:
    """Three lanes each way; the ego vehicle drives 25 m/s, others come with 30 m/s."""
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
    half = length_m / 2 + 0.02
    post = box((-0.05, -0.05, -0.3), (0.05, 0.05, 0.72), Material.METAL)
    beams = [frustum((-half, -0.08, z), (half, 0.0, z + 0.13), Material.METAL, (1.15, 1.15, 1.15),
                     (1.0, 0.6)) for z in (0.45, 0.60)]  # fmt: skip
    return Mesh.join([post, *beams])


@cache
def noise_barrier(length_m: float) -> Mesh:
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
