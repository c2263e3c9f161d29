# SPDX-License-Identifier: MIT
"""Free space: what a sweep saw through, what it did not, and what it cannot know."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.free_space.range_image import RangeImage, ScannerImage
from densify.geometry import poses
from densify.geometry.types import RegisteredSweep
from tests.scenes import ROOM, Arc, Box, Scanner, Scene, World, on_sphere

MARGIN = (0.4, 0.015)
STANDING = Arc(0.0, 0.0)
LEVEL = Scanner(elevation_deg=(-15.0, 15.0))


def standing_sweep(boxes=ROOM, scanner=LEVEL) -> RegisteredSweep:
    return Scene(World(boxes), STANDING, scanner).stretch(2, 0).sweeps[0]


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


def test_one_scanner_cannot_veto_what_the_other_saw():
    registered = standing_sweep()
    front = registered.sweep.points[:, 0] > 0
    both = replace(registered, sweep=replace(registered.sweep, lidar=front.astype(np.uint8)))
    image = RangeImage.of(both)
    assert len(image.scanners) == 2
    ahead_and_behind = on_sphere([0, 20, 160, 180, 200, 340], 0.0, 8.0)
    assert image.sees_through(ahead_and_behind, *MARGIN).all()
    assert not image.sees_through(on_sphere([0, 180], 0.0, 25.0), *MARGIN).any()


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


@pytest.mark.parametrize("turn_rad_s", [0.5, -0.5])
@pytest.mark.parametrize(("first", "other"), [(2, 3), (2, 5)])
def test_the_sector_that_a_turning_scanner_skips_is_not_free(turn_rad_s, first, other):
    """A clockwise scanner that turns left covers less than a full circle: where one sweep ends and
    began, behind, is a sector that no ray has crossed."""
    turning = blocks(Arc(0, 0, 0, 8.0, turn_rad_s))
    free = seen_through_elsewhere(turning, first, other)
    azimuth_deg = np.rad2deg(np.arctan2(free[:, 1], free[:, 0]))
    assert len(free) == 0, f"{len(free)} points at azimuths {np.unique(azimuth_deg.round(1))} deg"


# --- a slow twin ----------------------------------------------------------------------------------


def look(scanner: ScannerImage, point, velocity, margin_m, margin_fraction, min_filled):
    """The scanner's answer for one point, step by step in double precision; None where a step falls
    so close to an edge that rounding decides."""
    num_rows, num_columns = scanner.nearest_m.shape

    def column_of(seen):
        at = (math.atan2(seen[1], seen[0]) + math.pi) / (2 * math.pi) * num_columns
        close = abs(at - round(at)) < 0.02
        return (None if close else int(at) % num_columns), close

    seen, time_s = point - scanner.origin_m, 0.0
    for _ in range(2):
        column, close = column_of(seen)
        if close:
            return None
        time_s = float(scanner.offset_s[0, column])
        twist = time_s * scanner.twists[0 if time_s < 0 else 1].astype(float)
        back = Rotation.from_rotvec(twist[:3]).inv()
        seen = back.apply(point + time_s * velocity - twist[3:]) - scanner.origin_m
    column, close = column_of(seen)
    elevation = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
    edges = [float(e) for e in scanner.row_edges_rad]
    if close or min(abs(elevation - e) for e in edges) < 1e-4:
        return None
    row = sum(elevation >= e for e in edges) - 1
    if not 0 <= row < num_rows or abs(scanner.offset_s[0, column] - time_s) >= 0.01:
        return False
    range_m = float(np.linalg.norm(seen))
    gap_m = scanner.nearest_m[row, column] - range_m - max(margin_m, margin_fraction * range_m)
    if abs(gap_m) < 1e-3:
        return None
    return bool(scanner.num_filled[row, column] >= min_filled and gap_m > 0)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("turn_rad_s", [0.5])
def test_lookup_against_a_slow_twin(turn_rad_s, moving):
    """Rolling shutter, velocity, the seam behind and an origin of its own."""
    registered = blocks(Arc(0, 0, 0, 20.0, turn_rad_s)).stretch(2, 0).sweeps[0]
    origins = np.array([[0.3, -0.2, 0.1]])
    sweep = replace(registered.sweep, scanner_origins=origins)
    image = RangeImage.of(replace(registered, sweep=sweep))
    rng = np.random.default_rng(1)
    points = on_sphere(rng.uniform(-180, 180, 1500), rng.uniform(-26, 5, 1500), 1.0)
    points[:300] = on_sphere(rng.uniform(178, 182, 300), rng.uniform(-8, 2, 300), 1.0)
    points *= rng.uniform(2, 40, (1500, 1))
    velocity = rng.normal(0, 8, (1500, 3)) * moving
    fast = image.sees_through(points, *MARGIN, velocity_m_s=velocity if moving else None)
    slow = [
        look(image.scanners[0], p, v, *MARGIN, 6) for p, v in zip(points, velocity, strict=True)
    ]
    sure = np.array([s is not None for s in slow])
    assert sure.mean() > 0.8
    assert fast[sure].tolist() == [s for s in slow if s is not None]
    assert 0.1 < fast[sure].mean() < 0.9 and 0.1 < fast[:300].mean() < 0.9


# --- odd input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_points", [1, 199, 201])
def test_tiny_sweeps_know_little_and_never_fail(num_points):
    registered = standing_sweep()
    few = np.arange(len(registered.sweep)) < num_points
    image = RangeImage.of(replace(registered, sweep=registered.sweep.select(few)))
    hung = on_sphere(np.arange(-180, 180, 5.0), -14.0, 2.0)
    assert image.sees_through(hung, *MARGIN).mean() < 0.2
