# SPDX-License-Identifier: MIT
"""What comes back from cars, against what KITTI's scanner gets back from them."""

from __future__ import annotations

from collections import namedtuple

import numpy as np
import pytest

from densify.geometry.types import Float, Int
from densify.street.cameras import CAMERAS, expose
from densify.street.lidar import LIDAR_HEIGHT_M, Mount, Scanner, Sensor, Spinning, firings, scan
from densify.street.mesh import Material, Mesh, box
from densify.street.models import car_mesh
from densify.street.motion import Curve, Driving, Speed, Still, Terrain, upright
from densify.street.world import STOPS, Body, Rays, World

# Percent of the rays that should meet a moving car: no return, on its surface, from behind it.
# 207 cars of KITTI's stereo benchmark; by incidence (0 to 20, 40, 60, 75, 90 degrees). Where the
# three do not make up 100, the rest came back from in front of the car.
SOURCE = np.array([
    [  # lower half of the car: dark, middle, bright
        [(6, 80, 2), (14, 83, 2), (16, 76, 6), (23, 69, 7), (19, 69, 10)],
        [(5, 94, 1), (6, 93, 1), (8, 84, 8), (11, 83, 6), (11, 77, 9)],
        [(3, 94, 3), (5, 92, 3), (5, 88, 7), (3, 89, 7), (6, 82, 9)],
    ],
    [  # window band: the upper 10 to 45 %, pillars and roof included
        [(25, 65, 5), (48, 39, 12), (50, 31, 19), (60, 26, 14), (36, 34, 31)],
        [(18, 68, 14), (20, 66, 13), (33, 54, 13), (41, 47, 12), (26, 58, 15)],
        [(15, 75, 9), (21, 57, 22), (38, 43, 20), (35, 50, 15), (26, 61, 13)],
    ],
], float)  # fmt: skip
INCIDENCE_DEG = (20, 40, 60, 75)
PAINTS = (0.10, 0.06), (0.32, 0.27), (0.92, 0.64)
SENSOR = Sensor("small", (Scanner(Spinning(tuple(np.linspace(2, -14, 27)), 9000), 100.0, 0.018),))
LOST, SURFACE, BEHIND, FRONT = range(4)


def standing() -> Driving:
    line = Curve(np.column_stack([np.arange(-50, 50.5, 0.5), np.zeros(201)]))
    flat = Terrain(np.ones((1, 2)), np.zeros(1), np.zeros(1))
    return Driving(line, Speed((0.0, 0.0)), 50.0, 0.0, flat, 2.7)


def car_park(seed: int) -> tuple[World, Int]:
    """Cars that stand around a scanner, 8 to 27 m away, and how bright (C,) each is."""
    rng, meshes, brightness = np.random.default_rng(seed), [], []
    for radius_m, num in ((9.0, 8), (13.5, 13), (19.0, 18), (26.0, 24)):
        first = rng.uniform(0, 2 * np.pi)
        for k in range(num):
            angle = first + 2 * np.pi * k / num + rng.uniform(-0.1, 0.1)
            away_m = radius_m + rng.uniform(-1, 1)
            brightness.append(int(rng.integers(3)))
            paint = (PAINTS[brightness[-1]][int(rng.integers(2))],) * 3
            car = car_mesh(paint, rng).of_instance(len(meshes))
            place = away_m * np.cos(angle), away_m * np.sin(angle), 0.0
            meshes.append(car.posed(upright(place, rng.uniform(0, 2 * np.pi)).matrices()[0]))
    room = box((-45, -45, 0), (45, 45, 14), Material.BRICK)
    return World([Body(Mesh.join([room, *meshes]), Still())]), np.array(brightness)


# The N rays that should meet a car. pulse, car: (N,). part: (N,) 0 lower half, 1 window band,
# -1 neither. bin: (N,) of incidence. range_m: (N,) to the surface.
OnCars = namedtuple("OnCars", "pulse car part bin range_m")


def rays_on_cars(world: World) -> OnCars:
    direction = firings(SENSOR, 0.0, 100_000_000).direction
    origin = np.tile([0, 0, LIDAR_HEIGHT_M], (len(direction), 1))
    rays = Rays(origin, direction, np.zeros(len(origin)))
    hits = world.cast(rays, lambda met: np.full(len(met.ray), STOPS))
    car = np.where(hits.triangle >= 0, world.triangles.instance[hits.triangle], -1)
    pulse = np.flatnonzero(car >= 0)
    car, ray = car[pulse], direction[pulse]
    cosine = np.abs(np.einsum("ni,ni->n", hits.normal[pulse], ray))
    # where the ray lies between the car's lower and upper border in an image
    mesh = world.bodies[0].mesh
    corner = mesh.vertices[mesh.triangles]
    up = (corner[..., 2] - LIDAR_HEIGHT_M) / np.hypot(corner[..., 0], corner[..., 1])
    ends = [
        (up[mesh.instance == i].min(), up[mesh.instance == i].max()) for i in range(max(car) + 1)
    ]
    low, high = np.array(ends)[car].T
    below = (high - ray[:, 2] / np.hypot(ray[:, 0], ray[:, 1])) / (high - low)
    part = np.select([below > 0.5, (below >= 0.1) & (below <= 0.45)], [0, 1], -1)
    incidence_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    return OnCars(pulse, car, part, np.digitize(incidence_deg, INCIDENCE_DEG), hits.range_m[pulse])


def outcomes(world: World, on: OnCars, seed: int) -> Int:
    """(N,) what became of each ray, as the source has it: within 0.6 m and 5 % on the surface."""
    returns = scan(world, Mount(standing(), SENSOR), 0.0, np.random.default_rng(seed))
    fired = firings(SENSOR, 0.0, 100_000_000)
    range_m = np.full(len(fired.offset_ns), np.nan)
    rows = np.searchsorted(fired.offset_ns, returns.offset_ns)
    range_m[rows] = np.linalg.norm(returns.points.astype(float), axis=1)
    off_m = range_m[on.pulse] - on.range_m
    near = np.abs(off_m) <= np.minimum(0.6, 0.05 * on.range_m)
    return np.select([np.isnan(off_m), near, off_m > 0], [LOST, SURFACE, BEHIND], FRONT)


@pytest.fixture(scope="module")
def seen() -> tuple[Float, Float, Float]:
    """Shares (part, brightness, incidence, outcome); of each car without return; and how often the
    next pulse of the same beam is lost on the same car, after one that is lost, and after any."""
    counts, of_car, after = np.zeros((2, 3, 5, 4)), [], np.zeros(3)
    for number in range(10):
        park, brightness = car_park(number)
        on = rays_on_cars(park)
        row = {pulse: k for k, pulse in enumerate(on.pulse)}
        ahead = np.array([row.get(pulse + 27, -1) for pulse in on.pulse])
        follows = (ahead >= 0) & (on.car[ahead] == on.car)
        for seed in range(3):
            world = World(park.bodies, 1000 * (10 * number + seed))
            world.__dict__["triangles"] = park.triangles
            outcome = outcomes(world, on, seed)
            known = on.part >= 0
            index = on.part, brightness[on.car], on.bin, outcome
            np.add.at(counts, tuple(column[known] for column in index), 1)
            lost = outcome == LOST
            num = np.bincount(on.car)
            of_car.append((np.bincount(on.car, lost) / np.maximum(num, 1))[num > 40])
            both = lost[follows] & lost[ahead[follows]]
            after += [both.sum(), lost[follows].sum(), follows.sum()]
    shares = counts / counts.sum(axis=-1, keepdims=True)
    return shares, np.concatenate(of_car), np.array([after[0] / after[1], after[1] / after[2]])


def test_cars_return_the_shares_of_rays_that_real_ones_do(seen):
    shares = seen[0][..., :3]
    off = shares - SOURCE / SOURCE.sum(axis=-1, keepdims=True)
    assert np.abs(off[..., [LOST, SURFACE]]).max() < 0.05
    # in the lower half the source's returns from behind are errors of its calibration
    assert np.abs(off[1, ..., BEHIND]).max() < 0.05


def test_cars_differ_and_lost_rays_lie_together(seen):
    _, of_car, (after_lost, after_any) = seen
    low, middle, high = np.percentile(of_car, [10, 50, 90])
    assert low < 0.12 and 0.12 < middle < 0.28 and 0.35 < high < 0.6  # 0.09, 0.18, 0.47
    assert after_lost > 0.7 and after_any < 0.25


def test_panes_are_part_of_the_true_depth():
    sheet = np.array([[[4.0, -3, -1], [4, 3, -1], [4, 3, 4], [4, -3, 4]]])
    wall = box((9, -30, -30), (10, 30, 30), Material.CONCRETE)
    pane = Mesh.quads(sheet, Material.GLASS).of_instance(3)
    picture = expose(
        World([Body(Mesh.join([wall, pane]), Still())]), standing(), CAMERAS["fast"], 0.0
    )
    assert 3.4 < picture.depth_m[60, 200] < 4.0  # the camera stands a little ahead of the origin
    assert picture.image[60, 200].max() > 0
