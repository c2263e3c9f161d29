# SPDX-License-Identifier: MIT
"""Free space: what a sweep saw through, what it did not, and what it cannot know."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.free_space.range_image import RangeImage, ScannerImage
from densify.geometry import poses
from densify.geometry.types import RegisteredSweep, Sweep
from tests.fired import fired
from tests.scenes import LIDAR_HEIGHT_M, ROOM, Arc, Box, Scanner, Scene, World, on_sphere

MARGIN = (0.4, 0.015)
STANDING = Arc(0.0, 0.0)
LEVEL = Scanner(elevation_deg=(-15.0, 15.0))


def standing_sweep(boxes=ROOM, scanner=LEVEL) -> RegisteredSweep:
    return Scene(World(boxes), STANDING, scanner).stretch(2, 0).sweeps[0]


@pytest.fixture(scope="module")
def room() -> RangeImage:
    return RangeImage.of(standing_sweep())


def test_free_in_front_of_a_wall_not_on_it_nor_behind_nor_beside_the_beams(room):
    y = np.linspace(-8, 8, 50)
    for x, expected in ((5, True), (15, True), (19, True), (20, False), (20.5, False), (30, False)):
        points = np.stack([np.full(50, float(x)), y, np.zeros(50)], 1)
        assert (room.sees_through(points, *MARGIN) == expected).all(), x
    assert not room.sees_through(standing_sweep().sweep.points, 0.0, 1e-4).any()
    for elevation_deg in (-40.0, -17.0, 17.0, 40.0, 90.0):
        outside = on_sphere(np.arange(0, 360, 5.0), elevation_deg, 1.2)
        assert not room.sees_through(outside, 0, 0).any()


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


def blocks(ego: Arc) -> Scene:
    """Deep blocks with gaps on both sides, before a far wall: depth jumps everywhere."""
    boxes = [Box((200.0, 2.0, 9.0), Arc(0, side * 30)) for side in (-1, 1)]
    boxes += [Box((2.2, 6, 6), Arc(x, side * 7)) for x in range(-60, 120, 7) for side in (-1, 1)]
    return Scene(World(tuple(boxes)), ego, Scanner(num_azimuths=1200))


def seen_through_elsewhere(scene: Scene, first: int, other: int) -> np.ndarray:
    """(K,3) points of the blocks within 40 m, as the first sweep measured them, that the other
    sweep sees through; in its lidar frame."""
    stretch = scene.stretch((first + other) // 2, abs(other - first))
    image, scan = RangeImage.of(stretch[other]), scene.scan(first)
    on_block = (scan.box >= 0) & (np.linalg.norm(scan.sweep.points, axis=1) < 40)
    assert on_block.sum() > 5000
    T_other_first = stretch.T_target_source(other, first)
    points = poses.transform(T_other_first, stretch[first].sweep.points[on_block])
    return points[image.sees_through(points, *MARGIN)]


@pytest.fixture(scope="module")
def fast() -> Scene:
    return blocks(Arc(0, 0, 0, 25.0, -0.3))


@pytest.mark.parametrize(("first", "other"), [(2, 3), (5, 2)])
def test_a_static_wall_is_never_free_however_fast_the_scanner_drives(fast, first, other):
    assert len(seen_through_elsewhere(fast, first, other)) == 0


@pytest.mark.parametrize(("turn_rad_s", "other"), [(0.5, 3), (0.5, 5), (-0.5, 5)])
def test_the_sector_that_a_turning_scanner_skips_is_not_free(turn_rad_s, other):
    """A clockwise scanner that turns left covers less than a full circle: where one sweep ends and
    began, behind, is a sector that no ray has crossed."""
    turning = blocks(Arc(0, 0, 0, 8.0, turn_rad_s))
    assert len(seen_through_elsewhere(turning, 2, other)) == 0


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
def test_lookup_against_a_slow_twin(moving):
    """Rolling shutter, velocity, the seam behind and an origin of its own."""
    registered = blocks(Arc(0, 0, 0, 20.0, 0.5)).stretch(2, 0).sweeps[0]
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


@pytest.mark.parametrize("num_points", [1, 201])
def test_tiny_sweeps_know_little_and_never_fail(num_points):
    registered = standing_sweep()
    few = np.arange(len(registered.sweep)) < num_points
    image = RangeImage.of(replace(registered, sweep=registered.sweep.select(few)))
    hung = on_sphere(np.arange(-180, 180, 5.0), -14.0, 2.0)
    assert image.sees_through(hung, *MARGIN).mean() < 0.2


def share(image: RangeImage, elevation_deg: float, range_m: float) -> float:
    """Share of points hung up ahead that are seen through."""
    hung = on_sphere(np.linspace(-4, 4, 50), elevation_deg, range_m)
    return float(image.sees_through(hung, *MARGIN).mean())


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

    assert share(finer, 0.4, 17.0) == 1 and share(usual, 0.4, 17.0) == 0
    assert share(finer, 0.4, 10.0) == 0  # a slight error of registration is more than two rings
    assert share(finer, 3.0, 10.0) == share(usual, 3.0, 10.0) == 1
    highest_deg = 7.5 * 30 / 127  # of the rings that meet what stands there
    for off_m in (-0.05, 0.0, 0.05):  # badly registered
        assert share(finer, highest_deg + np.rad2deg(off_m / 17.8), 17.8) == 0


def test_a_ring_far_from_all_others_tells_of_what_is_on_its_rays():
    """The next one below meets the road before it."""
    scanner = Scanner(16, 900, elevation_deg=(-15.0, 15.0))  # 2 degrees apart
    sweep = Scene(World(ROOM), Arc(0, 0), scanner).stretch(2, 0).sweeps[0]
    usual, by_ring = RangeImage.of(sweep), RangeImage.of(sweep, by_ring=True)
    road_m = LIDAR_HEIGHT_M / np.sin(np.deg2rad(5.0))
    assert share(by_ring, -5.0, road_m - 1.5) == 1 and share(usual, -5.0, road_m - 1.5) == 0
    assert share(by_ring, -5.0, road_m - 0.1) == share(by_ring, -5.0, road_m + 1.0) == 0
    assert share(by_ring, -4.5, road_m - 1.5) == share(usual, -4.5, road_m - 1.5) == 0
    assert share(by_ring, 4.0, 8.0) == share(usual, 4.0, 8.0) == 1


def test_free_space_is_what_either_of_two_scanners_saw():
    """A pillar ahead, seen from the middle of the room and from 2.5 m to the left of it."""
    origins = np.array([[0.0, 0.0, 0.0], [0.0, 2.5, 0.0]])
    boxes = *ROOM, Box((1.6, 1.6, 6.0), Arc(6.0, 0.0))
    scanner = Scanner(16, 900, (-15.0, 15.0))
    sweeps = [Scene(World(boxes), Arc(*origin[:2]), scanner).scan(0).sweep for origin in origins]
    points = np.concatenate([sweep.points + o for sweep, o in zip(sweeps, origins, strict=True)])
    lidar = np.repeat(np.arange(2, dtype=np.uint8), [len(sweep) for sweep in sweeps])
    nothing = np.zeros(len(points), np.float32)
    sweep = Sweep(0, 0, points, nothing, None, lidar, np.arange(len(points)), origins)
    both = RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))
    image = RangeImage.of(both)
    assert [len(s.nearest_m) for s in image.scanners] == [16, 16]
    behind = np.array([[12.0, 0.0, 0.5], [10.0, 0.3, 0.3]])  # of the pillar, for the first one
    assert image.sees_through(behind, *MARGIN).all()
    assert not RangeImage.of(only(both, 0)).sees_through(behind, *MARGIN).any()
    assert not image.sees_through(points[points[:, 2] > -1.7], *MARGIN).any()  # on the walls
    around = np.arange(-180, 180, 3.0)
    inside = on_sphere(around[np.abs(around + 6) > 3], 1.0, 14.0)  # not hidden from both
    assert image.sees_through(inside, *MARGIN).all()


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
