# SPDX-License-Identifier: MIT
"""The street's sensors, rates and tilted mounts: patterns against slow twins, truth in a room, and
what comes back from cars against what KITTI's scanner gets back from them."""

from __future__ import annotations

from collections import namedtuple

import numpy as np
import pytest

from densify.geometry.poses import inverse, transform
from densify.geometry.types import Float, Int
from densify.readers import describe
from densify.readers.street import Street
from densify.street.cameras import CAMERAS, expose
from densify.street.ground import Ground
from densify.street.lidar import (
    LIDAR_HEIGHT_M,
    SENSORS,
    Mount,
    Raster,
    Rosette,
    Scanner,
    Sensor,
    Spinning,
    firings,
    scan,
)
from densify.street.mesh import Material, Mesh, box
from densify.street.models import car_mesh
from densify.street.motion import Curve, Driving, Rectangles, Speed, Still, Terrain, upright
from densify.street.scenes import Scene
from densify.street.simulator import Simulator
from densify.street.world import STOPS, Body, Rays, World

FLAT = Terrain(np.ones((1, 2)), np.zeros(1), np.zeros(1))
ROOM_M = 15.0
SETUPS = [("dual32", 20, 10.0), ("panda", 20, 10.0), ("rosette", 5, -10.0)]


@pytest.fixture(scope="module")
def level() -> Street:
    return Street("street", 0, "vlp16")


def same_scene(level: Street, hz: int = 10, tilt_deg: float = 0.0) -> Street:
    other = Street("street", 0, "vlp16", hz, tilt_deg)
    other.simulator.__dict__["scene"] = level.simulator.scene
    return other


# patterns


@pytest.mark.parametrize("name", SENSORS)
def test_pulses_fill_the_period_evenly_at_a_constant_rate(name):
    num_pulses = []
    for hz in (5, 10, 20):
        period_ns = 10**9 // hz
        fired = firings(SENSORS[name], 12.0, period_ns)
        num_pulses.append(len(fired.offset_ns) * hz)
        assert fired.offset_ns[0] == -period_ns // 2 and fired.offset_ns[-1] < period_ns / 2
        np.testing.assert_allclose(np.linalg.norm(fired.direction, axis=1), 1)
        for lidar, scanner in enumerate(SENSORS[name].scanners):
            own = fired.lidar == lidar
            steps = np.diff(fired.offset_ns[own])
            assert steps.min() > 0 and np.ptp(steps) <= 1
            if isinstance(scanner.pattern, Spinning):
                beams = len(scanner.pattern.elevation_deg)
                assert own.sum() == scanner.pattern.columns_per_s // hz * beams
    assert np.ptp(num_pulses) < 1e-3 * num_pulses[0]


def test_a_raster_covers_its_field_of_view_line_by_line():
    raster = Raster(4000, 60.0, 20.0, 100)
    number = np.arange(400)
    x, y, z = raster.directions(number, number / 400 - 0.5, number / 4000).T
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z))
    np.testing.assert_allclose(elevation, 10 - 0.05 * number, atol=1e-9)
    lines = azimuth.reshape(10, 40)
    np.testing.assert_allclose(np.diff(lines[::2]), -1.5)
    np.testing.assert_allclose(np.diff(lines[1::2]), 1.5)
    assert azimuth.max() == pytest.approx(30) and azimuth.min() == pytest.approx(-30)


def test_a_rosette_is_two_prisms_and_goes_on_from_sweep_to_sweep():
    rates, num = (121.6, -77.7), 20_000
    share = np.arange(num) / num - 0.5
    sweeps = []
    for time_s in (3.0, 3.1):
        times = time_s + 0.1 * share
        rosette = Rosette(200_000, 70.0, rates)
        x, y, z = rosette.directions(np.arange(num), share, times).T
        prisms = sum(np.exp(2j * np.pi * rate * times) for rate in rates) / 2
        off_axis = np.degrees(np.arccos(x))
        np.testing.assert_allclose(off_axis, 35 * np.abs(prisms), atol=1e-5)
        turned = (y + 1j * z) * prisms.conj()
        np.testing.assert_allclose(np.angle(turned[off_axis > 0.1]), 0, atol=1e-6)
        assert off_axis.max() > 34.99
        sweeps.append(np.stack([x, y, z], axis=1))
    step = np.linalg.norm(np.diff(np.concatenate(sweeps), axis=0), axis=1)
    assert step[num - 1] < 1.1 * step.max()  # no jump between the sweeps
    assert np.median(np.linalg.norm(sweeps[1] - sweeps[0], axis=1)) > 0.1  # nor a repetition


# sweeps and truth, in a room that the vehicle drives through in a bend


def in_a_room(name: str, hz: int, tilt_deg: float) -> Simulator:
    bend = Curve.bending(120.0, lambda s: np.full(len(s), 1 / 20), origin_m=50.0)
    ego = Driving(bend, Speed((1.0, 8.0), (2.0, 0.0)), 50.0, 0.3, FLAT, 2.7)
    room = World([Body(box((-ROOM_M,) * 3, (ROOM_M,) * 3, Material.PLASTER), Still())])
    simulator = Simulator("street", 0, SENSORS[name], hz, tilt_deg)
    nothing = Rectangles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)))
    simulator.__dict__["scene"] = Scene(room, Ground(FLAT, (), 0.0, 0.0), ego, (), nothing)
    return simulator


@pytest.mark.parametrize(("name", "hz", "tilt_deg"), SETUPS)
def test_rays_start_at_their_scanner_and_truth_lies_on_the_walls(name, hz, tilt_deg):
    simulator = in_a_room(name, hz, tilt_deg)
    frame = 3 * hz // 10
    time_s = frame / hz
    returns, sensor = simulator.returns(frame), simulator.sensor
    points = simulator.in_bodies(frame, returns)
    truth = simulator.bodies.sweep(frame, returns.body, returns.instance, points)
    assert not truth.moving.any()
    assert np.all(simulator.bodies.displacement(frame, frame + 1, returns.body, points) == 0)
    world = transform(truth.T_world_lidar, truth.points)
    T_world_lidar = simulator.T_world_lidar_at(simulator.stamp_ns(frame))
    np.testing.assert_array_equal(truth.T_world_lidar, T_world_lidar)
    offset_ns = returns.offset_ns
    assert np.abs(offset_ns).max() <= simulator.period_ns / 2
    assert set(returns.lidar) == set(range(len(sensor.scanners)))
    for lidar, scanner in enumerate(sensor.scanners):
        own = returns.lidar == lidar
        ray = returns.points[own] - sensor.origins_m[lidar]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        fired = firings(sensor, time_s, simulator.period_ns)
        pulses = np.flatnonzero(fired.lidar == lidar)
        row = pulses[np.searchsorted(fired.offset_ns[pulses], offset_ns[own])]
        np.testing.assert_allclose(ray, fired.direction[row], atol=1e-6)
        on_wall = np.sort(np.abs(world[own]), axis=1)
        clear = on_wall[:, 1] < ROOM_M - 1  # of the room's edges
        off_wall = on_wall[clear, 2] - ROOM_M
        assert clear.sum() > 500
        assert 0.9 * len(pulses) < own.sum() < len(pulses)  # some pulses are lost
        assert np.abs(off_wall).max() < 5 * scanner.range_sigma_m
        assert abs(off_wall.mean()) < 0.1 * scanner.range_sigma_m
        away = (world[own] - T_world_lidar[:3, 3])[clear]
        noise_m = off_wall / np.abs(away).max(axis=1) * np.linalg.norm(away, axis=1)
        assert noise_m.std() == pytest.approx(scanner.range_sigma_m, rel=0.2)


# rates


def test_a_rate_changes_when_sweeps_are_taken_and_not_what_is_there(level):
    fast, slow = same_scene(level, 20), same_scene(level, 5)
    assert [len(s.frames) for s in (level, fast, slow)] == [160, 320, 80]
    assert fast.stamp_ns(121) - fast.stamp_ns(120) == 50_000_000
    sizes = [len(level[120])]
    for other, frame in ((fast, 240), (slow, 60)):
        assert other.stamp_ns(frame) == other[frame].stamp_ns == level.stamp_ns(120)
        for camera in other.cameras:
            exposed_ns = other.image_stamps_ns(camera)[frame]
            assert exposed_ns == level.image_stamps_ns(camera)[120]
        ours, theirs = level.simulator.bodies, other.simulator.bodies
        for field in ("T_world_lidar", "T_world_body", "moving"):
            np.testing.assert_array_equal(getattr(theirs, field)[frame], getattr(ours, field)[120])
        sizes.append(len(other[frame]))
    assert sizes[1] == pytest.approx(sizes[0] / 2, rel=0.02)
    assert sizes[2] == pytest.approx(sizes[0] * 2, rel=0.02)
    assert "20.00 Hz" in describe(fast)


def test_names_and_cached_frames_tell_rates_and_tilts_apart():
    assert Street("street", 3, "vlp16", 10, 0.0).name == "street:street?seed=3&sensor=vlp16"
    other = Street.from_spec("street?tilt=-7.5&hz=20")
    assert other.name == "street:street?seed=0&sensor=hdl64&hz=20&tilt=-7.5"
    assert Street.from_spec(other.name).name == other.name
    options = ("", "?hz=20", "?tilt=10", "?hz=20&tilt=10", "?sensor=os128", "?hz=10&tilt=0")
    swept = [Street.from_spec(f"street{option}")._swept for option in options]
    assert len(set(swept)) == 5 and swept[0] == swept[-1]


# mounts


def test_a_tilted_mount_turns_the_lidar_and_leaves_the_cameras(level):
    tilted = same_scene(level, tilt_deg=10.0)
    T_level_tilted = inverse(level.T_world_lidar(120)) @ tilted.T_world_lidar(120)
    c, s = np.cos(np.radians(10)), np.sin(np.radians(10))
    expected = [[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]]  # x looks down
    np.testing.assert_allclose(T_level_tilted, expected, atol=1e-12)
    for name, camera in tilted.cameras.items():
        T_level_cam = inverse(level.cameras[name].T_cam_lidar)
        T_tilted_cam = inverse(camera.T_cam_lidar)
        np.testing.assert_allclose(T_level_tilted @ T_tilted_cam, T_level_cam, atol=1e-12)


# what comes back from cars

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
    return Driving(line, Speed((0.0, 0.0)), 50.0, 0.0, FLAT, 2.7)


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
