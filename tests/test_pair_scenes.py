# SPDX-License-Identifier: MIT
"""Scene flow of two sweeps as a user has them: two clouds in one frame, with the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from densify import open_sequence
from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.flow.pairs.estimate import estimate_flow
from densify.flow.pairs.trials import _ambiguous
from densify.geometry import poses
from densify.readers.street import Street
from densify.readers.timeline import read_sweep
from densify.registration.deskew import deskew
from densify.registration.trajectory import find_trajectory
from densify.street.lidar import T_ego_lidar, at_offsets
from densify.street.simulator import seconds
from tests.scenes import Arc, Box, Scanner, Scene, World, car, street

FRAME = 2
PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class Pair:
    """Two sweeps in the frame of the first, and what really moved by how much."""

    source: np.ndarray
    target: np.ndarray
    truth: np.ndarray
    instance: np.ndarray
    source_offset_ns: np.ndarray
    target_offset_ns: np.ndarray
    source_height_m: np.ndarray
    target_height_m: np.ndarray

    @property
    def moved(self) -> np.ndarray:
        return self.instance >= 0


def pair_of(*boxes: Box, ego: Arc | None = None, slope: float = 0.0, later: int = 1) -> Pair:
    """later: revolutions between the two."""
    world = World((*boxes, *street()), slope)
    scene = Scene(world, ego or Arc(-0.4, -1.5, 0.0, 8.0, 0.1), Scanner(sigma_m=0.01))
    stretch = scene.stretch(FRAME, later)
    here, there = stretch[FRAME], stretch[FRAME + later]
    return Pair(
        here.sweep.points,
        poses.transform(stretch.T_target_source(FRAME, FRAME + later), there.sweep.points),
        scene.displacement(FRAME, FRAME + later),
        scene.scan(FRAME).instance,
        here.sweep.offset_ns,
        there.sweep.offset_ns + (later * PERIOD_NS if later > 1 else 0),
        scene.height_m(FRAME),
        scene.height_m(FRAME + later),
    )


def estimated(pair: Pair, **options):
    return estimate_flow(
        pair.source,
        pair.target,
        source_offset_ns=pair.source_offset_ns,
        target_offset_ns=pair.target_offset_ns,
        **options,
    )


def check(pair: Pair, field, max_error_m: float = 0.08) -> None:
    """Movers found and right, everything else exactly where it was."""
    still = ~pair.moved
    assert field.moving[still].mean() <= 1e-3
    assert not field.displacement[~field.moving].any()
    for k in np.unique(pair.instance[pair.moved]):
        mine = pair.instance == k
        assert field.moving[mine].mean() >= 0.8, k
        error = np.linalg.norm(field.displacement - pair.truth, axis=1)[mine & field.moving]
        assert error.mean() <= max_error_m, k


@pytest.mark.parametrize(("speed_m_s", "slope"), [(5, 0.0), (15, 0.04), (30, 0.0)])
def test_a_car_is_found_at_any_speed(speed_m_s, slope):
    x = -1.0 - speed_m_s * 0.25 + 12
    pair = pair_of(car(x, 1.5, speed_m_s, 1), slope=slope)
    check(pair, estimated(pair))


def test_where_nothing_moves_everything_stays_exactly():
    pair = pair_of(ego=Arc(0.0, -1.5))
    for field in (estimated(pair), estimate_flow(pair.source, pair.target)):
        assert not field.moving.any() and not field.displacement.any()
        assert (field.instance == -1).all()


def test_similar_cars_in_a_row_keep_their_places():
    """The second comes as near to where the first was as the first to where it was itself."""
    lane = [car(1.0 + 7.0 * i, 2.6, 35.0, i, size_m=(3.2, 1.8, 1.2)) for i in range(2)]
    pair = pair_of(*lane)
    check(pair, estimated(pair))


def test_without_the_ground():
    pair = pair_of(car(14.0, 1.5, 12.0, 1))
    a, b = pair.source_height_m > 0.2, pair.target_height_m > 0.2
    field = estimate_flow(pair.source[a], pair.target[b])
    moved = pair.moved[a]
    assert field.moving[moved].mean() > 0.75 and field.moving[~moved].mean() <= 5e-3
    error = np.linalg.norm(field.displacement - pair.truth[a], axis=1)
    assert error[moved & field.moving].mean() < 0.08


def test_crowns_above_the_road_do_not_move():
    """A box at 5 m height that the wind has moved, and the same box on the ground."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-15, 15, (2, 4000))
    ground = np.column_stack([x, y, 0.01 * rng.standard_normal(4000)])
    u, v = rng.uniform(0, 1, (2, 900))
    side = np.arange(900) % 2 == 0
    box = np.column_stack([np.where(side, 0.0, 1.6 * u), np.where(side, u, 0.0), v])
    box += [5.0, 2.0, 0.3] + 0.01 * rng.standard_normal((900, 3))
    low, high = (
        estimate_flow(
            np.vstack([ground, box + [0, 0, up]]), np.vstack([ground, box + [0.7, 0, up]])
        )
        for up in (0.0, 5.0)
    )
    assert low.moving[4000:].mean() > 0.9 and not high.moving.any()


@pytest.mark.parametrize(
    ("num", "length_m", "direction", "ambiguous"),
    [
        (30, 1.7, np.pi / 2, False),  # the back of a car far away, driving away
        (30, 1.7, 0.0, True),  # a rail along itself
        (30, 4.0, np.pi / 2, True),  # wider than a car
        (150, 1.7, np.pi / 2, True),  # lower than a car, nearby
    ],
)
def test_a_level_bar_moves_only_as_the_back_of_a_far_car_does(num, length_m, direction, ambiguous):
    bar = np.random.default_rng(0).uniform(-0.5, 0.5, (num, 3)) * [length_m, 0.05, 0.3]
    way = np.array([np.cos(direction), np.sin(direction), 0.0])
    assert _ambiguous(bar, way) == ambiguous


def test_the_frame_does_not_matter():
    pair = pair_of(car(14.0, 1.5, 12.0, 1), car(22.0, -1.0, 6.0, 2))
    R = poses.exp(np.array([0, 0, 2.1, 0, 0, 0]))[:3, :3]
    there = np.array([4.5e5, 5.4e6, 300.0])
    here = estimated(pair)
    field = estimate_flow(pair.source @ R.T + there, pair.target @ R.T + there)
    assert (field.moving == here.moving).mean() > 0.998
    both = field.moving & here.moving
    assert both.sum() > 300
    turned_back = field.displacement[both] @ R
    assert np.linalg.norm(turned_back - here.displacement[both], axis=1).mean() < 0.05


def test_times_make_fast_cars_right():
    """One that is passed turns away under the scanner: it is met again sooner or later than after
    a revolution."""
    pair = pair_of(car(4.0, 3.0, 25.0, 1, np.pi))
    plain, timed = estimate_flow(pair.source, pair.target), estimated(pair)
    mine = pair.moved & plain.moving & timed.moving
    assert mine.mean() > 0.8 * pair.moved.mean()
    errors = [
        np.linalg.norm(f.displacement - pair.truth, axis=1)[mine].mean() for f in (plain, timed)
    ]
    assert errors[1] < 0.7 * errors[0] and errors[1] < 0.02, errors
    assert plain.to_reference is None
    velocity_m_s = timed.displacement / 0.1
    late_s = pair.source_offset_ns[:, None] * 1e-9
    off = timed.to_reference + velocity_m_s * late_s
    assert np.abs(off[mine]).max() < 0.02 and not timed.to_reference[~timed.moving].any()


@pytest.mark.parametrize("timed", [False, True])
def test_two_scanners_see_a_car_twice(timed):
    """A street with two scanners half a turn apart."""
    rig = Street("highway", 2, "dual32", cameras=())
    frames = (20, 21)
    returns = [rig.returns(frame) for frame in frames]
    clouds = []
    for frame, found in zip(frames, returns, strict=True):
        times = at_offsets(seconds(rig.simulator.stamp_ns(frame)), found.offset_ns)
        points = poses.transform(T_ego_lidar(rig.simulator.tilt_deg), found.points.astype(float))
        world = rig.simulator.scene.ego.poses(times).apply(points)
        clouds.append(poses.transform(poses.inverse(rig.T_world_lidar(frames[0])), world))
    sides = list(zip(("source", "target"), returns, strict=True))
    columns = {f"{side}_lidar": found.lidar.astype(int) for side, found in sides}
    if timed:
        columns |= {f"{side}_offset_ns": found.offset_ns for side, found in sides}
    field = estimate_flow(*clouds, **columns)
    moving = rig.truth.sweep(frames[0]).moving
    near = moving & (np.linalg.norm(clouds[0][:, :2], axis=1) < 35)
    error_m = np.linalg.norm(field.displacement - rig.truth.displacement(*frames), axis=1)
    assert near.sum() > 1000 and field.moving[near].mean() > 0.9
    assert error_m[near & field.moving].mean() < 0.06
    assert field.moving[~moving].mean() < 1e-5


CLOUD = np.random.default_rng(0).normal(size=(60, 3))
INTS = np.arange(60)


@pytest.mark.parametrize("name", ["offset_ns", "lidar"])
@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (INTS, None, "target_{}: not given"),
        (INTS[:-1], INTS, r"source_{}: got shape \(59,\)"),
        (INTS, INTS * 1e-3, "target_{}: .*float64"),
    ],
)
def test_bad_columns_are_refused(name, source, target, message):
    columns = {f"source_{name}": source, f"target_{name}": target}
    with pytest.raises(InputError, match=message.format(name)) as caught:
        estimate_flow(CLOUD, CLOUD, **columns)
    assert "\n" not in str(caught.value)


def test_real_traffic(test_data):
    """A street in Karlsruhe: the cars ahead and behind move, houses and hedges do not."""
    drive = test_data / "kitti/2011_09_26/2011_09_26_drive_0013_sync"
    sequence, settings = open_sequence(str(drive)), RegisterSettings()
    sweeps = [read_sweep(sequence, frame, settings) for frame in range(118, 123)]
    stretch = deskew(sweeps, find_trajectory(sweeps, settings))
    here, there = stretch[120], stretch[121]
    target = poses.transform(stretch.T_target_source(120, 121), there.sweep.points)
    field = estimate_flow(
        here.sweep.points,
        target,
        source_offset_ns=here.sweep.offset_ns,
        target_offset_ns=there.sweep.offset_ns,
    )
    # Found by tracking them through eleven sweeps: place, and motion in one.
    cars = {(-12, 3): 1.35, (-18, 0): 1.19, (31, 0): 1.6, (-29, 4): 1.28, (-60, 20): -1.48}
    at = here.sweep.points[:, :2]
    near_one = np.zeros(len(at), bool)
    for place, step_m in cars.items():
        near = np.linalg.norm(at - place, axis=1) < 3.5
        found = near & field.moving
        assert found.sum() >= 30, place
        assert abs(np.median(field.displacement[found], axis=0)[0] - step_m) < 0.1, place
        near_one |= near
    assert (field.moving & ~near_one).mean() < 5e-3
    assert field.moving.sum() < 2500


def test_a_real_car_beside_two_scanners(test_data):
    """A log of Argoverse 2: the car's profile is one line at 0.8 to 0.86 m a sweep."""
    log = test_data / "argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    sequence = open_sequence(f"argoverse2:{log}")
    T = poses.inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1)
    feather = pytest.importorskip("pyarrow.feather")
    sweeps = [
        feather.read_table(path).to_pydict() for path in sorted(log.glob("sensors/lidar/*.feather"))
    ]
    source, target = (np.column_stack([s[a] for a in "xyz"]).astype(float) for s in sweeps)
    sides = list(zip(("source", "target"), sweeps, strict=True))
    columns = {f"{side}_lidar": np.array(s["laser_number"]) // 32 for side, s in sides}
    columns |= {f"{side}_offset_ns": np.array(s["offset_ns"]) for side, s in sides}
    field = estimate_flow(source, poses.transform(T, target), **columns)
    car = field.moving & (np.linalg.norm(source[:, :2] - [-4.6, -2.2], axis=1) < 2.5)
    assert car.sum() > 900 and np.ptp(field.instance[car]) == 0
    way_m = np.median(field.displacement[car], axis=0)
    assert abs(way_m[0] - 0.83) < 0.25  # nearest points hold it back: rings fit any ring
    assert np.abs(way_m[1:]).max() < 0.1
    assert 1200 < field.moving.sum() < 2000  # three more cars, and nothing else
