# SPDX-License-Identifier: MIT
"""Free space of scanners whose firing time does not go with the azimuth: raster and rosette."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from densify.free_space.range_image import RangeImage, ScannerImage
from densify.geometry import poses
from densify.geometry.types import RegisteredSweep
from tests.fired import fired
from tests.scenes import Arc, Box, World

MARGIN = (0.4, 0.015)
FAST = np.array([0.0, 0.0, 0.2, 15.0, 0.0, 0.0])
WALL = World((Box((1.0, 200.0, 40.0), Arc(40.0, 0.0), base_m=-20.0),))
POSTS = World(
    (
        *(Box((0.5, 0.5, 6.0), Arc(x, y)) for x in (9, 14, 20, 27) for y in (-6, -3, -1, 2, 4, 7)),
        Box((1.0, 300.0, 60.0), Arc(60.0, 0.0), base_m=-20.0),
    )
)


def only(registered: RegisteredSweep, lidar: int) -> RegisteredSweep:
    return replace(registered, sweep=registered.sweep.select(registered.sweep.lidar == lidar))


@cache
def sweep_of(name: str, moving: bool, frame: int = 0, world: World = POSTS) -> RegisteredSweep:
    registered = fired(name, world, FAST if moving else np.zeros(6), frame, share_heard=1.0)
    return only(registered, int(registered.sweep.lidar.max()))


UNORDERED = ["panda", "rosette"]


@pytest.mark.parametrize("name", UNORDERED)
def test_each_cell_has_a_time_of_its_own(name):
    registered = sweep_of(name, moving=False)
    images = RangeImage.of(registered).scanners
    assert 1 < len(images) <= 5
    sizes = [image.nearest_m.shape for image in images]
    for (rows, columns), (half_rows, half_columns) in pairwise(sizes):
        assert half_rows == pytest.approx(rows / 2, abs=1)
        assert half_columns == pytest.approx(columns / 2, abs=1) or columns < 200
    for image in images:
        assert image.offset_s.shape == image.spread_s.shape == image.nearest_m.shape
        asked = registered.sweep.points[::7]
        first, last = when_around(image, asked)
        offset_s = registered.sweep.offset_ns[::7] * 1e-9
        # a return on the edge of a cell may fall on either side
        assert np.mean((first - 1e-6 <= offset_s) & (offset_s <= last + 1e-6)) > 0.99


def when_around(image: ScannerImage, points) -> tuple[np.ndarray, np.ndarray]:
    """First and last time at which the cells around each point's were looked at."""
    x, y, z = (points - image.origin_m).T
    rows, columns = image.nearest_m.shape
    row = np.searchsorted(image.row_edges_rad, np.arctan2(z, np.hypot(x, y))) - 1
    column = ((np.arctan2(y, x) + np.pi) / (2 * np.pi) * columns).astype(int) % columns
    middle, spread = (
        t[np.clip(row, 0, rows - 1), column] for t in (image.offset_s, image.spread_s)
    )
    return middle - spread, middle + spread


@pytest.mark.parametrize("name", UNORDERED)
def test_what_stands_is_not_free_however_fast_the_scanner_drives(name):
    """And where no cell knew its time, it would be."""
    one, other = sweep_of(name, moving=True), sweep_of(name, moving=True, frame=2)
    T_other_one = poses.inverse(other.T_world_lidar) @ one.T_world_lidar
    on_post = np.linalg.norm(one.sweep.points, axis=1) < 40
    points = poses.transform(T_other_one, one.sweep.points[on_post])
    assert len(points) > 1000
    image = RangeImage.of(other)
    assert image.sees_through(points, *MARGIN).mean() < 0.002
    timeless = [
        s._replace(offset_s=np.zeros_like(s.offset_s), spread_s=np.zeros_like(s.spread_s))
        for s in image.scanners
    ]
    assert RangeImage(tuple(timeless)).sees_through(points, *MARGIN).mean() > 0.004


@pytest.mark.parametrize("name", UNORDERED)
def test_what_moves_with_its_velocity_is_not_free(name):
    """A van that comes closer is met somewhere else by each ray; with its velocity known its own
    points are not taken for free, and standing still some of them are."""
    van = Box((4.0, 2.0, 2.2), Arc(18.0, -3.0, 1.5, 12.0))
    world = World((van, *WALL.boxes))
    sweep = sweep_of(name, moving=False, world=world).sweep
    image = RangeImage.of(sweep_of(name, moving=False, world=world))
    on_van = (sweep.points[:, 0] < 30) & (sweep.points[:, 2] > -1.5)
    velocity = np.tile([12 * np.cos(1.5), 12 * np.sin(1.5), 0.0], (on_van.sum(), 1))
    at_reference = sweep.points[on_van] - velocity * sweep.offset_ns[on_van][:, None] * 1e-9
    assert len(velocity) > 50
    assert image.sees_through(at_reference, *MARGIN, velocity_m_s=velocity).mean() < 0.02
    gone = at_reference + [0, 0, 0] + 3.0 * velocity / 12  # where it never was within the sweep
    assert image.sees_through(gone, *MARGIN).mean() > 0.1


# --- a slow twin ----------------------------------------------------------------------------------
