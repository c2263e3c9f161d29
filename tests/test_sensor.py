# SPDX-License-Identifier: MIT
"""Models of scanners, measured from sweeps whose every pulse is known; cells that follow them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.free_space.range_image import RangeImage
from densify.free_space.sensor import SensorModel, Sensors, aim_rays, find_rings, fires_by_azimuth
from densify.geometry.types import RegisteredSweep, Sweep
from densify.readers import checks
from densify.street.lidar import SENSORS, Spinning
from tests.fired import fired
from tests.scenes import ROOM, Arc, Scanner, Scene, World, on_sphere

MARGIN = (0.4, 0.015)
DRIVING = np.array([0.0, 0.02, 0.3, 12.0, 0.0, 0.1])
SPINNING = [
    (name, number)
    for name, sensor in SENSORS.items()
    for number, scanner in enumerate(sensor.scanners)
    if isinstance(scanner.pattern, Spinning)
]


@cache
def sweeps_of(name: str) -> tuple[RegisteredSweep, ...]:
    return tuple(fired(name, twist=DRIVING, frame=frame) for frame in (3, 4))


@cache
def sensors_of(name: str) -> Sensors:
    return Sensors.of(sweeps_of(name))


def pattern_of(name: str, number: int = 0):
    return SENSORS[name].scanners[number].pattern


def in_another_frame(registered: RegisteredSweep, R: np.ndarray) -> RegisteredSweep:
    """The same sweep in a lidar frame whose axes are turned; the scanners keep theirs."""
    sweep = registered.sweep
    turned = replace(
        sweep,
        points=sweep.points @ R.T,
        scanner_origins=sweep.scanner_origins @ R.T,
        R_scanner_lidar=np.stack([R.T] * len(sweep.scanner_origins)),
    )
    twists = [
        (t.reshape(2, 3) @ R.T).ravel() for t in (registered.twist_before, registered.twist_after)
    ]
    T_world_lidar = registered.T_world_lidar.copy()
    T_world_lidar[:3, :3] = T_world_lidar[:3, :3] @ R.T
    return RegisteredSweep(turned, T_world_lidar, *twists)


def test_the_axes_of_the_frame_do_not_matter():
    """Taken for the scanner's, they would tear its rings apart."""
    R = Rotation.from_euler("xyz", [4.0, -3.0, 20.0], degrees=True).as_matrix()
    here = sweeps_of("dual32")[0]
    there = in_another_frame(here, R)
    model, turned = (SensorModel.of([s], 0) for s in (here, there))
    np.testing.assert_allclose(turned.rings_rad, model.rings_rad, atol=2e-4)
    np.testing.assert_allclose(turned.axes @ turned.origin_m, model.origin_m, atol=1e-9)
    leaning = replace(there, sweep=replace(there.sweep, R_scanner_lidar=None))
    assert SensorModel.of([leaning], 0).rings_rad is None
    points = here.sweep.points * np.random.default_rng(0).uniform(0.5, 1.3, (len(here.sweep), 1))
    free = [
        RangeImage.of(s).sees_through(p, 0.3, 0.02)
        for s, p in ((here, points), (there, points @ R.T))
    ]
    assert free[0].mean() > 0.2 and (free[0] == free[1]).mean() > 0.995


def test_a_scanner_that_hangs_upside_down_has_axes_with_z_upwards():
    T = np.tile(np.eye(4), (2, 1, 1))
    tilt = Rotation.from_euler("y", 3.0, degrees=True).as_matrix()
    T[0, :3, :3] = tilt
    T[1, :3, :3] = tilt @ np.diag([1.0, -1.0, -1.0])
    axes = checks.scanner_axes(T)
    np.testing.assert_allclose(axes[0] @ tilt, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[1], axes[0], atol=1e-12)


@pytest.mark.parametrize(("name", "number"), SPINNING)
def test_a_spinning_scanner_is_found_as_it_is(name, number):
    """Its spacing is at every ring the mean of the gaps above and below, however close."""
    model, pattern = sensors_of(name).models[number], pattern_of(name, number)
    true_deg, step_deg = np.sort(pattern.elevation_deg), 3600 / pattern.columns_per_s
    assert not model.unordered and fires_by_azimuth(aim_rays(sweeps_of(name)[0], number))
    np.testing.assert_allclose(np.rad2deg(model.rings_rad), true_deg, atol=0.02)
    assert np.rad2deg(model.azimuth_step_rad) == pytest.approx(step_deg, rel=0.02)
    assert model.azimuth_rad == (-np.pi, np.pi)
    np.testing.assert_allclose(np.rad2deg(model.elevation_rad), true_deg[[0, -1]], atol=0.05)
    np.testing.assert_array_equal(model.origin_m, SENSORS[name].scanners[number].origin_m)
    found = np.rad2deg(model.table.at(np.zeros(len(true_deg)), np.deg2rad(true_deg)))
    np.testing.assert_allclose(found[:, 1], np.gradient(true_deg), rtol=0.12, atol=0.01)
    across = step_deg * np.cos(np.deg2rad(true_deg))
    np.testing.assert_allclose(found[:, 0], across, rtol=0.03)


def test_lasers_that_share_no_origin_make_lines():
    """As KITTI's HDL-64E: the returns of a ring smear over those of others where they are near."""
    registered = fired("hdl64")
    rays = aim_rays(registered, 0)
    ring = np.searchsorted(np.sort(pattern_of("hdl64").elevation_deg), np.rad2deg(rays.elevation))
    range_m = 22 + 18 * np.sin(7 * rays.azimuth + ring)
    aside = np.where(ring % 2, 0.04, -0.04) + 0.002 * (ring - 32)
    ray = on_sphere(np.rad2deg(rays.azimuth), np.rad2deg(rays.elevation), 1.0)
    points = ray * range_m[:, None] + aside[:, None] * [0, 0, 1]
    smeared = replace(registered, sweep=replace(registered.sweep, points=points))
    model = SensorModel.of([smeared], 0)
    assert model.rings_rad is None and not model.unordered
    assert np.rad2deg(model.azimuth_step_rad) == pytest.approx(360 / 2083, rel=0.1)
    for elevation_deg, spacing_deg in ((-3.0, 1 / 3), (-18.0, 0.5)):
        around = np.deg2rad(elevation_deg + np.arange(-3, 3, 0.1))
        found = np.rad2deg(model.table.at(np.zeros(len(around)), around)[:, 1])
        assert np.median(found) == pytest.approx(spacing_deg, rel=0.35)


def spacing_by_neighbours(rays, at: int, num: int) -> float:
    """The side of a square as large as each of the nearest rays has to itself."""
    direction = on_sphere(np.rad2deg(rays.azimuth), np.rad2deg(rays.elevation), 1.0)
    away = sorted(np.linalg.norm(direction - direction[at], axis=1))
    return float(np.sqrt(np.pi * away[num] ** 2 / num))


@pytest.mark.parametrize(("name", "number", "num"), [("panda", 1, 24), ("rosette", 0, 60)])
def test_without_rings_the_spacing_is_that_of_the_neighbours(name, number, num):
    model, rays = sensors_of(name).models[number], aim_rays(sweeps_of(name)[0], number)
    assert model.unordered and model.rings_rad is None
    assert not fires_by_azimuth(rays)
    inside = np.hypot(rays.azimuth, rays.elevation) < np.deg2rad(25)
    inside &= np.abs(rays.elevation) < np.deg2rad(8)
    asked = np.flatnonzero(inside)[:: inside.sum() // 40]
    slow = np.array([spacing_by_neighbours(rays, i, num) for i in asked])
    fast = model.table.at(rays.azimuth[asked], rays.elevation[asked])
    ratio = fast[:, 1] / slow
    assert 0.85 < np.median(ratio) < 1.15
    assert np.percentile(ratio, 5) > 0.5 and np.percentile(ratio, 95) < 2
    np.testing.assert_array_equal(fast[:, 0], fast[:, 1])


def test_a_scanner_that_looks_ahead_sees_nothing_else():
    model = sensors_of("panda").models[1]
    azimuth = np.deg2rad([0.0, 29.0, -29.0, 32.0, -32.0, 180.0, 0.0, 0.0])
    elevation = np.deg2rad([0.0, 5.0, -5.0, 0.0, 0.0, 0.0, 12.0, -12.0])
    assert model.sees(azimuth, elevation).tolist() == [True] * 3 + [False] * 5


def test_where_there_are_no_rings_rows_are_uniform():
    rng = np.random.default_rng(0)
    for num in (600, 30000):
        azimuth, elevation = rng.uniform(-3, 3, num), rng.uniform(-0.4, 0.1, num)
        assert find_rings(elevation.astype(np.float32)) is None
        ray = on_sphere(np.rad2deg(azimuth), np.rad2deg(elevation), 8.0)
        nothing = np.zeros(num, np.float32)
        lidar, row = np.zeros(num, np.uint8), np.arange(num)
        sweep = Sweep(0, 0, ray, nothing, None, lidar, row)
        still = RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))
        edges = RangeImage.of(still).scanners[0].row_edges_rad
        np.testing.assert_allclose(np.diff(edges), np.diff(edges)[0], rtol=1e-3)
        assert edges[0] <= elevation.min() and edges[-1] > elevation.max()


@pytest.mark.parametrize(("num_beams", "num_azimuths"), [(16, 1800), (64, 900)])
def test_cells_follow_the_sensor(num_beams, num_azimuths):
    scanner = Scanner(num_beams, num_azimuths, elevation_deg=(-15.0, 15.0))
    image = RangeImage.of(Scene(World(ROOM), Arc(0, 0), scanner).stretch(2, 0).sweeps[0])
    (only,) = image.scanners
    # no finer than the rays, or cells stay empty; no coarser than twice, or movers hide in them
    spacing = 30 / (num_beams - 1)
    rows = np.diff(np.rad2deg(only.row_edges_rad)) / spacing
    np.testing.assert_allclose(rows, 1, atol=0.08)
    assert 1 <= num_azimuths / only.nearest_m.shape[1] < 1.5
    rng = np.random.default_rng(0)
    # clear of the ground and of the upper edge, where the 3 x 3 cells leave the image
    hung = on_sphere(rng.uniform(-180, 180, 2000), rng.uniform(-5, 15 - 1.5 * spacing, 2000), 9.0)
    assert image.sees_through(hung, *MARGIN).mean() > 0.995
    wall = on_sphere(rng.uniform(-40, 40, 500), rng.uniform(-3, 3, 500), 1.0)
    assert not image.sees_through(wall * (20 / wall[:, :1]), *MARGIN).any()
