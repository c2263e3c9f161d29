# SPDX-License-Identifier: MIT
"""Free space: what a sweep saw through, what it did not, and what it cannot know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify import poses
from densify.range_image import RangeImage, ScannerImage
from densify.types import RegisteredSweep, Sweep
from tests.scenes import Arc, Box, Scanner, Scene, World

MARGIN = (0.4, 0.015)
ROOM = tuple(
    Box((size_x, size_y, 40.0), Arc(x, y))
    for x, y, size_x, size_y in ((21, 0, 2, 44), (-21, 0, 2, 44), (0, 21, 44, 2), (0, -21, 44, 2))
)  # four walls 20 m away
STANDING = Arc(0.0, 0.0)
LEVEL = Scanner(elevation_deg=(-15.0, 15.0))


def standing_sweep(boxes=ROOM, scanner=LEVEL) -> RegisteredSweep:
    return Scene(World(boxes), STANDING, scanner).stretch(2, 0).sweeps[0]


def on_sphere(azimuth_deg, elevation_deg, range_m) -> np.ndarray:
    a, e, r = np.broadcast_arrays(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg), range_m)
    return np.stack([r * np.cos(a) * np.cos(e), r * np.sin(a) * np.cos(e), r * np.sin(e)], -1)


@pytest.fixture(scope="module")
def room() -> RangeImage:
    return RangeImage.of(standing_sweep())


# --- a wall ---------------------------------------------------------------------------------------


def test_free_in_front_of_a_wall_not_on_it_nor_behind(room):
    y = np.linspace(-8, 8, 50)
    for x, expected in ((5, True), (15, True), (19, True), (20, False), (20.5, False), (30, False)):
        points = np.stack([np.full(50, float(x)), y, np.zeros(50)], 1)
        assert (room.sees_through(points, *MARGIN) == expected).all(), x


def test_the_sweeps_own_returns_are_never_seen_through():
    registered = standing_sweep()
    image = RangeImage.of(registered)
    assert not image.sees_through(registered.sweep.points, 0.0, 1e-4).any()


@pytest.mark.parametrize(
    ("x", "margin_m", "margin_fraction", "expected"),
    [
        (19.5, 0.4, 0.0, True),
        (19.7, 0.4, 0.0, False),
        (19.7, 0.2, 0.0, True),
        (18.9, 0.0, 0.05, True),  # 1.10 m before the wall, 0.95 asked for
        (19.2, 0.0, 0.05, False),  # 0.80, 0.96
        (19.2, 0.4, 0.05, False),  # the larger of the two counts
    ],
)
def test_margins(room, x, margin_m, margin_fraction, expected):
    points = np.array([[x, 0.1, 0.3]])
    assert room.sees_through(points, margin_m, margin_fraction)[0] == expected


def test_wraps_behind_the_scanner(room):
    azimuth = 180 + np.linspace(-3, 3, 601)
    assert room.sees_through(on_sphere(azimuth, 1.0, 8.0), *MARGIN, min_filled=8).all()
    # a mast behind the scanner blocks across the seam
    mast = Box((0.8, 0.8, 5), Arc(-6.0, 0.0))
    image = RangeImage.of(standing_sweep((*ROOM, mast)))
    free = image.sees_through(on_sphere(180 + np.linspace(-3, 3, 61), 1.0, 8.0), *MARGIN)
    assert not free.any()
    assert image.sees_through(on_sphere([170, 190], 1.0, 8.0), *MARGIN).all()


# --- ignorance ------------------------------------------------------------------------------------


def test_empty_directions_say_nothing():
    registered = standing_sweep()
    p = registered.sweep.points
    azimuth = np.rad2deg(np.arctan2(p[:, 1], p[:, 0]))
    gap = replace(registered, sweep=registered.sweep.select((azimuth < 30) | (azimuth > 60)))
    image = RangeImage.of(gap)
    around = np.arange(-180, 180, 0.7)
    free = image.sees_through(on_sphere(around, 0.0, 8.0), *MARGIN)
    assert not free[(around > 30.5) & (around < 59.5)].any()
    assert free[(around < 29) | (around > 61)].all()


def test_nothing_is_known_above_and_below_the_beams(room):
    for elevation_deg in (-40.0, -17.0, 17.0, 40.0, 90.0):
        assert not room.sees_through(
            on_sphere(np.arange(0, 360, 5.0), elevation_deg, 1.2), 0, 0
        ).any()


def test_a_sweep_without_returns_knows_nothing():
    registered = standing_sweep()
    none = replace(registered, sweep=registered.sweep.select(np.zeros(len(registered.sweep), bool)))
    assert not RangeImage.of(none).sees_through(np.ones((4, 3)), *MARGIN).any()


def test_no_points_no_answers(room):
    assert room.sees_through(np.empty((0, 3)), *MARGIN).shape == (0,)


def test_one_scanner_cannot_veto_what_the_other_saw():
    registered = standing_sweep()
    front = registered.sweep.points[:, 0] > 0
    both = replace(registered, sweep=replace(registered.sweep, lidar=front.astype(np.uint8)))
    image = RangeImage.of(both)
    assert len(image.scanners) == 2
    ahead_and_behind = on_sphere([0, 20, 160, 180, 200, 340], 0.0, 8.0)
    assert image.sees_through(ahead_and_behind, *MARGIN).all()
    assert not image.sees_through(on_sphere([0, 180], 0.0, 25.0), *MARGIN).any()


# --- the sensor's resolution ----------------------------------------------------------------------


@pytest.mark.parametrize("num_beams", [16, 32, 64])
@pytest.mark.parametrize("num_azimuths", [450, 900, 1800])
def test_cells_follow_the_sensor(num_beams, num_azimuths):
    scanner = Scanner(num_beams, num_azimuths, elevation_deg=(-15.0, 15.0))
    image = RangeImage.of(standing_sweep(scanner=scanner))
    (only,) = image.scanners
    # no finer than the rays, or cells stay empty; no coarser than twice, or movers hide in them
    spacing = 30 / (num_beams - 1)
    assert 1 <= np.rad2deg(only.elevation_step_rad) / spacing < 1.5
    assert 1 <= num_azimuths / only.nearest_m.shape[1] < 1.5
    rng = np.random.default_rng(0)
    # clear of the ground and of the upper edge, where the 3 x 3 cells leave the image
    hung = on_sphere(rng.uniform(-180, 180, 2000), rng.uniform(-5, 15 - 1.5 * spacing, 2000), 9.0)
    assert image.sees_through(hung, *MARGIN).mean() > 0.995
    wall = on_sphere(rng.uniform(-40, 40, 500), rng.uniform(-3, 3, 500), 1.0)
    assert not image.sees_through(wall * (20 / wall[:, :1]), *MARGIN).any()


# --- rolling shutter ------------------------------------------------------------------------------


def blocks(ego: Arc) -> Scene:
    """Deep blocks with gaps on both sides, before a far wall: depth jumps everywhere."""
    boxes = [Box((200.0, 2.0, 9.0), Arc(0, side * 30)) for side in (-1, 1)]
    boxes += [Box((2.2, 6, 6), Arc(x, side * 7)) for x in range(-60, 120, 7) for side in (-1, 1)]
    return Scene(World(tuple(boxes)), ego, Scanner(num_azimuths=1200))


def seen_through_elsewhere(scene: Scene, first: int, other: int, twists=1.0) -> np.ndarray:
    """(K,3) points of the blocks within 40 m, as the first sweep measured them, that the other
    sweep sees through; in its lidar frame."""
    stretch = scene.stretch((first + other) // 2, abs(other - first))
    image = RangeImage.of(
        replace(
            stretch[other],
            twist_before=twists * stretch[other].twist_before,
            twist_after=twists * stretch[other].twist_after,
        )
    )
    scan = scene.scan(first)
    on_block = (scan.box >= 0) & (np.linalg.norm(scan.sweep.points, axis=1) < 40)
    assert on_block.sum() > 5000
    T_other_first = stretch.T_target_source(other, first)
    points = poses.transform(T_other_first, stretch[first].sweep.points[on_block])
    return points[image.sees_through(points, *MARGIN)]


@pytest.fixture(scope="module")
def fast() -> Scene:
    return blocks(Arc(0, 0, 0, 25.0, -0.3))


@pytest.mark.parametrize(("first", "other"), [(2, 3), (2, 5), (5, 2)])
def test_a_static_wall_is_never_free_however_fast_the_scanner_drives(fast, first, other):
    assert len(seen_through_elsewhere(fast, first, other)) == 0


def test_with_the_wrong_sense_of_motion_the_same_walls_would_be_free(fast):
    assert len(seen_through_elsewhere(fast, 2, 5, twists=-1.0)) > 20


@pytest.mark.parametrize("turn_rad_s", [0.5, -0.5])
@pytest.mark.parametrize(("first", "other"), [(2, 3), (2, 5)])
def test_the_sector_that_a_turning_scanner_skips_is_not_free(turn_rad_s, first, other):
    """A clockwise scanner that turns left covers less than a full circle: where one sweep ends and
    began, behind, is a sector that no ray has crossed."""
    turning = blocks(Arc(0, 0, 0, 8.0, turn_rad_s))
    free = seen_through_elsewhere(turning, first, other)
    azimuth_deg = np.rad2deg(np.arctan2(free[:, 1], free[:, 0]))
    assert len(free) == 0, f"{len(free)} points at azimuths {np.unique(azimuth_deg.round(1))} deg"


def test_returns_are_put_back_into_a_regular_grid(fast):
    """At its own firing time every ray of a beam has the same elevation: rows of the image."""
    registered = fast.stretch(2, 0).sweeps[0]
    image = RangeImage.of(registered).scanners[0]
    still = replace(registered, twist_before=np.zeros(6), twist_after=np.zeros(6))
    bent = RangeImage.of(still).scanners[0]
    assert (image.num_filled == 9).mean() > (bent.num_filled == 9).mean()
    assert np.rad2deg(image.elevation_step_rad) == pytest.approx(1.15 * 26.8 / 63, rel=0.15)


# --- a slow twin ----------------------------------------------------------------------------------


def slow_sees_through(cells, rows, columns, point, margin_m, margin_fraction, min_filled):
    """The 3 x 3 rule as its sentence reads. cells: {(row, column): [ranges]}."""
    row, column, range_m = point
    if not 0 <= row < rows:
        return False
    around = [
        cells[row + i, (column + j) % columns]
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if (row + i, (column + j) % columns) in cells
    ]
    farther = range_m + max(margin_m, margin_fraction * range_m)
    return len(around) >= min_filled and all(r > farther for cell in around for r in cell)


@pytest.mark.parametrize("min_filled", [1, 4, 6, 9])
def test_three_by_three_rule_against_a_slow_twin(min_filled):
    rng = np.random.default_rng(min_filled)
    columns, first, low = 360, 350, -6.0  # below 200 returns a cell is 1 x 2 degrees
    where = [(r, c % columns) for r in range(7) for c in range(first, first + 24)]
    cells: dict[tuple[int, int], list[float]] = {}
    for cell in [where[0], where[-1], *(where[k] for k in rng.integers(0, len(where), 190))]:
        cells.setdefault(cell, []).append(float(rng.choice([5.0, 10.0, 10.2, 20.0])))
    assert any(len(ranges) > 1 for ranges in cells.values())

    def direction(row, column, range_m):
        return on_sphere(column + 0.5 - 180 + 0.0, low + 2 * row, range_m)

    points = np.array([direction(*cell, r) for cell, ranges in cells.items() for r in ranges])
    n = len(points)
    sweep = Sweep(0, 0, points, np.zeros(n, np.float32), None, np.zeros(n, np.uint8), np.arange(n))
    image = RangeImage.of(RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6)))
    assert image.scanners[0].nearest_m.shape == (7, columns)
    asked = [
        (r, c % columns, range_m)
        for r in range(-1, 8)
        for c in range(first - 2, first + 26)
        for range_m in (3.0, 4.55, 4.65, 9.5, 9.7, 18.0, 19.5, 25.0)
    ]
    fast = image.sees_through(np.array([direction(*a) for a in asked]), 0.4, 0.03, min_filled)
    slow = [slow_sees_through(cells, 7, columns, a, 0.4, 0.03, min_filled) for a in asked]
    assert fast.tolist() == slow
    assert min_filled == 9 or 0 < np.mean(slow) < 1


def test_one_scanners_image_is_the_nearest_return_of_each_neighbourhood():
    sweep = standing_sweep()
    image = ScannerImage.of(sweep, 0)
    assert image.nearest_m.shape == image.num_filled.shape
    assert image.offset_s.shape == image.nearest_m.shape[1:]
    assert image.num_filled.max() == 9
    assert np.array_equal(np.isinf(image.nearest_m), image.num_filled == 0)
    # clockwise: columns start behind, at azimuth -pi, where a sweep ends
    assert image.offset_s[0] == pytest.approx(0.05, abs=1e-3)
    assert image.offset_s[-1] == pytest.approx(-0.05, abs=1e-3)
