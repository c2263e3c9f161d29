# SPDX-License-Identifier: MIT
"""The street's sensors, rates and tilted mounts: patterns against slow twins, truth in a room."""

from __future__ import annotations

import numpy as np
import pytest

from densify.geometry.poses import inverse, transform
from densify.readers import describe
from densify.readers.street import Street
from densify.street.ground import Ground
from densify.street.lidar import SENSORS, Raster, Rosette, Spinning, firings
from densify.street.mesh import Material, box
from densify.street.motion import Curve, Driving, Rectangles, Speed, Still, Terrain
from densify.street.scenes import Scene
from densify.street.simulator import Simulator
from densify.street.world import Body, World

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
    flat = Terrain(np.ones((1, 2)), np.zeros(1), np.zeros(1))
    bend = Curve.bending(120.0, lambda s: np.full(len(s), 1 / 20), origin_m=50.0)
    ego = Driving(bend, Speed((1.0, 8.0), (2.0, 0.0)), 50.0, 0.3, flat, 2.7)
    room = World([Body(box((-ROOM_M,) * 3, (ROOM_M,) * 3, Material.PLASTER), Still())])
    simulator = Simulator("street", 0, SENSORS[name], hz, tilt_deg)
    nothing = Rectangles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)))
    simulator.__dict__["scene"] = Scene(room, Ground(flat, (), 0.0, 0.0), ego, (), nothing)
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
