# SPDX-License-Identifier: MIT
"""Range images of every sensor: cells that follow its beams, and several scanners in one cloud."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.free_space import range_image
from densify.free_space.range_image import RangeImage
from densify.free_space.rings import Aimed, find_rings
from densify.geometry.types import RegisteredSweep, Sweep
from densify.street.sensors import SENSORS
from tests.scenes import LIDAR_HEIGHT_M, ROOM, Arc, Box, Scanner, Scene, World, on_sphere

MARGIN = (0.4, 0.015)


@pytest.mark.parametrize("num_beams", [16, 32, 64])
@pytest.mark.parametrize("num_azimuths", [450, 900, 1800])
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


def test_far_away_dense_rings_tell_of_a_slit_between_them():
    """What is seen over a wall close by, by few rings: far away each ring is a row, nearby two."""
    wall = Box((0.4, 8.0, LIDAR_HEIGHT_M), Arc(5.0, 0.0))  # as high as the scanner: up to 0 degrees
    low = Box((0.4, 4.0, LIDAR_HEIGHT_M + 0.6), Arc(18.0, 0.0))  # up to 1.93 degrees
    scanner = Scanner(128, 900, elevation_deg=(-15.0, 15.0))  # 0.236 degrees apart
    sweep = Scene(World((*ROOM, wall, low)), Arc(0, 0), scanner).stretch(2, 0).sweeps[0]
    usual, finer = RangeImage.of(sweep), RangeImage.of(sweep, by_ring=True)
    near, far = finer.scanners
    assert len(usual.scanners) == 1
    assert len(near.row_edges_rad) == len(usual.scanners[0].row_edges_rad) < len(far.row_edges_rad)
    assert near.to_m == far.from_m == pytest.approx(0.1 / (1.5 * np.deg2rad(30 / 127)), rel=0.02)

    def share(image: RangeImage, elevation_deg: float, range_m: float, azimuth_deg: float) -> float:
        azimuths_deg = np.linspace(-azimuth_deg, azimuth_deg, 50)
        hung = on_sphere(azimuths_deg, elevation_deg, range_m)
        return float(image.sees_through(hung, *MARGIN).mean())

    assert share(finer, 0.4, 17.0, 4) == 1 and share(usual, 0.4, 17.0, 4) == 0
    assert share(finer, 0.4, 10.0, 4) == 0  # a slight error of registration is more than two rings
    assert share(finer, 3.0, 10.0, 4) == share(usual, 3.0, 10.0, 4) == 1
    highest_deg = 7.5 * 30 / 127  # of the rings that meet what stands there
    for off_m in (-0.05, 0.0, 0.05):  # badly registered
        assert share(finer, highest_deg + np.rad2deg(off_m / 17.8), 17.8, 4) == 0


def test_a_ring_far_from_all_others_tells_of_what_is_on_its_rays():
    """The next one below meets the road before it."""
    scanner = Scanner(16, 900, elevation_deg=(-15.0, 15.0))  # 2 degrees apart
    sweep = Scene(World(ROOM), Arc(0, 0), scanner).stretch(2, 0).sweeps[0]
    usual, by_ring = RangeImage.of(sweep), RangeImage.of(sweep, by_ring=True)
    road_m = LIDAR_HEIGHT_M / np.sin(np.deg2rad(5.0))

    def share(image: RangeImage, elevation_deg: float, range_m: float) -> float:
        hung = on_sphere(np.linspace(-10, 10, 50), elevation_deg, range_m)
        return float(image.sees_through(hung, *MARGIN).mean())

    assert share(by_ring, -5.0, road_m - 1.5) == 1 and share(usual, -5.0, road_m - 1.5) == 0
    assert share(by_ring, -5.0, road_m - 0.1) == share(by_ring, -5.0, road_m + 1.0) == 0
    assert share(by_ring, -4.5, road_m - 1.5) == share(usual, -4.5, road_m - 1.5) == 0
    assert share(by_ring, 4.0, 8.0) == share(usual, 4.0, 8.0) == 1


# --- rings ----------------------------------------------------------------------------------------

TABLES = {
    name: np.sort(SENSORS[name].scanners[0].pattern.elevation_deg)
    for name in ("hdl64", "hdl32", "vlp16", "dual32")
}
TABLES["128 beams"] = np.concatenate([np.arange(-25, -6, 0.5), np.arange(-6, 5.25, 0.125)])


def on_rings(elevation_deg, noise_deg=0.01, num_columns=600, seed=0):
    """(3,N) azimuth and elevation (rad) of returns, each ring with a share of its own missing."""
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.arange(num_columns) * 360 / num_columns - 180, len(elevation_deg))
    elevation = np.repeat(elevation_deg, num_columns) + rng.normal(0, noise_deg, len(azimuth))
    heard = rng.random(len(azimuth)) < np.repeat(
        rng.uniform(0.2, 1, len(elevation_deg)), num_columns
    )
    return np.deg2rad(azimuth[heard], dtype=np.float32), np.deg2rad(
        elevation[heard], dtype=np.float32
    )


def cells(azimuth, elevation):
    """Edges of the rows and number of columns of the finest image."""
    nothing = np.zeros(len(azimuth), np.float32)
    found, *_ = range_image._cells(Aimed(azimuth, elevation, nothing, nothing), 1, by_ring=False)
    return found.row_edges_rad, found.num_columns


@pytest.mark.parametrize("name", TABLES)
def test_rings_are_found_wherever_the_beams_point(name):
    azimuth, elevation = on_rings(TABLES[name])
    found = find_rings(elevation)
    np.testing.assert_allclose(np.rad2deg(found), TABLES[name], atol=0.03)
    edges, num_columns = cells(azimuth, elevation)
    assert 600 / 1.5 < num_columns <= 600
    rows = np.diff(np.rad2deg(edges))
    assert rows.min() > 0.44
    lone = np.flatnonzero(np.gradient(TABLES[name]) > 1.0)  # a row each, half the way to the next
    for ring in TABLES[name][lone]:
        assert (np.abs(TABLES[name] - ring) < 0.01).sum() == 1
        row = np.searchsorted(np.rad2deg(edges), ring) - 1
        inside = (TABLES[name] > np.rad2deg(edges[row])) & (
            TABLES[name] < np.rad2deg(edges[row + 1])
        )
        assert inside.sum() == 1


def test_where_there_are_no_rings_rows_are_uniform():
    rng = np.random.default_rng(0)
    smeared = on_rings(TABLES["vlp16"], noise_deg=0.6)
    anywhere = rng.uniform(-3, 3, 30000), rng.uniform(-0.4, 0.1, 30000)
    sparse = rng.uniform(-3, 3, 600), rng.uniform(-0.4, 0.1, 600)
    for azimuth, elevation in (smeared, anywhere, sparse):
        azimuth, elevation = azimuth.astype(np.float32), elevation.astype(np.float32)
        assert find_rings(elevation) is None
        edges, _ = cells(azimuth, elevation)
        np.testing.assert_allclose(np.diff(edges), np.diff(edges)[0], rtol=1e-3)
        assert edges[0] <= elevation.min() and edges[-1] > elevation.max()


# --- two scanners ---------------------------------------------------------------------------------


def two_scanners(origins, pillar) -> RegisteredSweep:
    """In a round room of 20 m about the origin, with a round pillar (x, y, radius)."""
    parts = []
    for origin in origins:
        a, e = np.meshgrid(np.deg2rad(np.arange(-180, 180, 0.4)), np.deg2rad(np.arange(-15, 16, 2)))
        ray = on_sphere(np.rad2deg(a.ravel()), np.rad2deg(e.ravel()), 1.0)
        flat = ray[:, :2] / np.linalg.norm(ray[:, :2], axis=1, keepdims=True)

        def meets(x, y, radius, far, flat=flat, origin=origin):
            to = origin[:2] - (x, y)
            b, c = flat @ to, to @ to - radius**2
            root = np.sqrt(np.where(b * b > c, b * b - c, np.nan))
            return -b + (root if far else -root)

        near = meets(*pillar, far=False)
        wall = meets(0.0, 0.0, 20.0, far=True)
        range_m = np.where(near > 0, near, wall) / np.linalg.norm(ray[:, :2], axis=1)
        parts.append(origin + ray * range_m[:, None])
    points = np.concatenate(parts)
    n = len(points)
    lidar = np.repeat(np.arange(len(parts)), len(parts[0])).astype(np.uint8)
    sweep = Sweep(0, 0, points, np.zeros(n, np.float32), None, lidar, np.arange(n), origins)
    return RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))


def test_free_space_is_what_either_of_two_scanners_saw():
    origins, pillar = np.array([[0.0, 0, 0], [0.0, 2.5, 0.8]]), (6.0, 0.0, 0.8)
    both = two_scanners(origins, pillar)
    image = RangeImage.of(both)
    assert [len(s.nearest_m) for s in image.scanners] == [16, 16]
    behind = np.array([[12.0, 0.0, 0.5], [10.0, 0.3, 0.3]])  # of the pillar, for the first one
    assert image.sees_through(behind, *MARGIN).all()
    only_first = replace(both, sweep=both.sweep.select(both.sweep.lidar == 0))
    assert not RangeImage.of(only_first).sees_through(behind, *MARGIN).any()
    on_surfaces = both.sweep.points
    assert not image.sees_through(on_surfaces, *MARGIN).any()
    around = np.arange(-180, 180, 3.0)
    inside = on_sphere(around[np.abs(around + 6) > 3], 1.0, 14.0)  # not hidden from both
    assert image.sees_through(inside, *MARGIN).all()
