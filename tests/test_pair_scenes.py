# SPDX-License-Identifier: MIT
"""Scene flow of two sweeps as a user has them: two clouds in one frame, ground and all."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from densify import open_sequence
from densify.config import RegisterSettings
from densify.flow.two_clouds import estimate_flow
from densify.geometry import poses
from densify.readers.street import Street
from densify.readers.timeline import read_sweep
from densify.registration.deskew import deskew
from densify.registration.trajectory import find_trajectory
from densify.street.lidar import T_ego_lidar, at_offsets
from densify.street.simulator import seconds
from tests.scenes import Arc, Box, Scanner, Scene, World, car, street

FRAME = 2


@dataclass(frozen=True)
class Pair:
    """Two sweeps in the frame of the first, and what really moved by how much."""

    source: np.ndarray
    target: np.ndarray
    truth: np.ndarray
    instance: np.ndarray
    source_offset_ns: np.ndarray
    target_offset_ns: np.ndarray
    heights_m: tuple[np.ndarray, np.ndarray]

    @property
    def moved(self) -> np.ndarray:
        return self.instance >= 0


def pair_of(*boxes: Box, ego: Arc | None = None, slope: float = 0.0, num_beams: int = 64) -> Pair:
    world = World((*boxes, *street()), slope)
    scanner = Scanner(num_beams, sigma_m=0.01)
    scene = Scene(world, ego or Arc(-0.4, -1.5, 0.0, 8.0, 0.1), scanner)
    stretch = scene.stretch(FRAME, 1)
    here, there = stretch[FRAME].sweep, stretch[FRAME + 1].sweep
    return Pair(
        here.points,
        poses.transform(stretch.T_target_source(FRAME, FRAME + 1), there.points),
        scene.displacement(FRAME, FRAME + 1),
        scene.scan(FRAME).instance,
        here.offset_ns,
        there.offset_ns,
        (scene.height_m(FRAME), scene.height_m(FRAME + 1)),
    )


def estimated(pair: Pair):
    return estimate_flow(
        pair.source,
        pair.target,
        source_offset_ns=pair.source_offset_ns,
        target_offset_ns=pair.target_offset_ns,
    )


def check(pair: Pair, field) -> None:
    """Movers found and right, everything else exactly where it was."""
    still = ~pair.moved
    assert field.moving[still].mean() <= 1e-3
    assert not field.displacement[~field.moving].any()
    for k in np.unique(pair.instance[pair.moved]):
        mine = pair.instance == k
        assert field.moving[mine].mean() >= 0.8, k
        error = np.linalg.norm(field.displacement - pair.truth, axis=1)[mine & field.moving]
        assert error.mean() <= 0.08, k


@pytest.mark.parametrize("speed_m_s", [5, 15, 30])
@pytest.mark.parametrize("slope", [0.0, 0.04])
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


@pytest.mark.parametrize("timed", [False, True])
def test_rings_that_lie_elsewhere_on_a_near_car_are_no_misfit(timed):
    """Sixteen rings: hardly a point of the car has a neighbour where it went."""
    pair = pair_of(car(5.0, 3.0, 14.0, 1), num_beams=16)
    field = estimated(pair) if timed else estimate_flow(pair.source, pair.target)
    assert pair.moved.sum() > 300 and field.moving[pair.moved].mean() > 0.9
    error_m = np.linalg.norm(field.displacement - pair.truth, axis=1)
    assert error_m[pair.moved & field.moving].mean() < 0.03


def test_without_the_ground():
    pair = pair_of(car(14.0, 1.5, 12.0, 1))
    a, b = (height_m > 0.2 for height_m in pair.heights_m)
    field = estimate_flow(pair.source[a], pair.target[b])
    moved = pair.moved[a]
    assert field.moving[moved].mean() > 0.75 and field.moving[~moved].mean() <= 5e-3
    error = np.linalg.norm(field.displacement - pair.truth[a], axis=1)
    assert error[moved & field.moving].mean() < 0.08


def test_the_frame_does_not_matter():
    pair = pair_of(car(14.0, 1.5, 12.0, 1), car(22.0, -1.0, 6.0, 2))
    R = poses.exp(np.array([0, 0, 2.1, 0, 0, 0]))[:3, :3]
    there = np.array([4.5e5, 5.4e6, 300.0])
    here = estimated(pair)
    turned = replace(pair, source=pair.source @ R.T + there, target=pair.target @ R.T + there)
    field = estimated(turned)
    assert (field.moving == here.moving).mean() > 0.998
    both = field.moving & here.moving
    assert both.sum() > 300
    turned_back = field.displacement[both] @ R
    assert np.linalg.norm(turned_back - here.displacement[both], axis=1).mean() < 0.05


def test_times_make_fast_cars_right():
    """One that is passed turns away under the scanner: it is met again sooner or later than after
    a revolution."""
    without_times_m, with_times_m = [], []
    for x, speed_m_s in itertools.product((4.0, 5.5, 7.0), (15.0, 25.0)):
        pair = pair_of(car(x, 3.0, speed_m_s, 1, np.pi))
        plain, timed = estimate_flow(pair.source, pair.target), estimated(pair)
        mine = pair.moved & plain.moving & timed.moving
        assert mine.mean() > 0.8 * pair.moved.mean()
        for field, errors in ((plain, without_times_m), (timed, with_times_m)):
            errors.append(np.linalg.norm(field.displacement - pair.truth, axis=1)[mine].mean())
        assert plain.to_reference is None
        velocity_m_s = timed.displacement / 0.1
        late_s = pair.source_offset_ns[:, None] * 1e-9
        off = timed.to_reference + velocity_m_s * late_s
        assert np.abs(off[mine]).max() < 0.02 and not timed.to_reference[~timed.moving].any()
    assert np.mean(with_times_m) < 0.5 * np.mean(without_times_m)
    assert np.mean(with_times_m) < 0.06


def seen_twice(rng: np.random.Generator, time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Cloud and scanner numbers: a wall, and a box at 20 m/s that two scanners see half a
    revolution apart."""
    wall = np.column_stack(
        [rng.uniform(-10, 10, 1500), np.full(1500, 6.0), rng.uniform(0, 3, 1500)]
    )
    y, z, x = rng.uniform(0, 1, (3, 600))
    rear = np.column_stack([np.zeros(300), 1.8 * y[:300], 1.4 * z[:300]])
    side = np.column_stack([4.0 * x[300:], np.zeros(300), 1.4 * z[300:]])
    box = np.vstack([rear, side]) + 0.01 * rng.standard_normal((600, 3))
    lidar = np.arange(600) % 2
    box[:, 0] += 20.0 * (time_s + 0.05 * lidar)
    return np.vstack([wall, box]), np.concatenate([np.arange(1500) % 2, lidar])


def test_two_scanners_see_a_car_twice():
    rng = np.random.default_rng(0)
    (source, a), (target, b) = seen_twice(rng, 0.0), seen_twice(rng, 0.1)
    field = estimate_flow(source, target, source_lidar=a, target_lidar=b)
    box = np.arange(len(source)) >= 1500
    assert field.moving[box].mean() > 0.85 and not field.moving[~box].any()
    error = np.linalg.norm(field.displacement - [2.0, 0, 0], axis=1)
    assert error[box & field.moving].mean() < 0.03


# --- two scanners half a turn apart, which see everything twice in a sweep ------------------------

DUAL_FRAME = 20


def as_user(street: Street, frame: int) -> np.ndarray:
    """A sweep in the first one's lidar frame, the vehicle's own motion undone, nothing else's."""
    simulator, returns = street.simulator, street.returns(frame)
    times = at_offsets(seconds(simulator.stamp_ns(frame)), returns.offset_ns)
    points = poses.transform(T_ego_lidar(simulator.tilt_deg), returns.points.astype(float))
    world = simulator.scene.ego.poses(times).apply(points)
    return poses.transform(poses.inverse(street.T_world_lidar(DUAL_FRAME)), world)


@pytest.mark.parametrize("known", [False, True])
def test_movers_come_out_right_with_whatever_is_known(known):
    street, columns = Street("highway", 2, "dual32"), {}
    frames = {"source": DUAL_FRAME, "target": DUAL_FRAME + 1}
    source, target = (as_user(street, frame) for frame in frames.values())
    for side, frame in frames.items() if known else ():
        columns[f"{side}_offset_ns"] = street.returns(frame).offset_ns
        columns[f"{side}_lidar"] = street.returns(frame).lidar.astype(int)
    field = estimate_flow(source, target, **columns)
    truth = street.truth.displacement(DUAL_FRAME, DUAL_FRAME + 1)
    moving = street.truth.sweep(DUAL_FRAME).moving
    near = moving & (np.linalg.norm(source[:, :2], axis=1) < 35)
    error_m = np.linalg.norm(field.displacement - truth, axis=1)
    assert near.sum() > 1000 and field.moving[near].mean() > 0.9
    assert error_m[near & field.moving].mean() < (0.05 if known else 0.06)
    assert field.moving[~moving].mean() < 1e-4


# --- real recordings ------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [False, True])
def test_a_real_car_beside_two_scanners(known):
    """A log of Argoverse 2: the car's profile is one line at 0.8 to 0.86 m a sweep."""
    folder = os.environ.get("DENSIFY_TEST_DATA")
    if not folder:
        pytest.skip("DENSIFY_TEST_DATA is not set: no real Argoverse 2 log")
    log = Path(folder) / "argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    sequence = open_sequence(f"argoverse2:{log}")
    feather = pytest.importorskip("pyarrow.feather")
    paths = sorted(log.glob("sensors/lidar/*.feather"))
    sweeps = {
        side: feather.read_table(path).to_pydict()
        for side, path in zip(("source", "target"), paths, strict=True)
    }
    source, target = (np.column_stack([s[axis] for axis in "xyz"]) for s in sweeps.values())
    columns = {}
    for side, sweep in sweeps.items() if known else ():
        columns[f"{side}_offset_ns"] = np.array(sweep["offset_ns"])
        columns[f"{side}_lidar"] = np.array(sweep["laser_number"]) // 32
    T = poses.inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1)
    field = estimate_flow(source.astype(float), poses.transform(T, target.astype(float)), **columns)
    car = field.moving & (np.linalg.norm(source[:, :2] - [-4.6, -2.2], axis=1) < 2.5)
    assert car.sum() > 900 and np.ptp(field.instance[car]) == 0
    way_m = np.median(field.displacement[car], axis=0)
    assert abs(way_m[0] - 0.83) < (0.06 if known else 0.15)
    assert np.abs(way_m[1:]).max() < 0.1
    assert 1200 < field.moving.sum() < 2000  # three more cars, and nothing else


def test_real_traffic(test_data):
    """A street in Karlsruhe: the cars ahead and behind move, houses and hedges do not."""
    drive = test_data / "kitti/2011_09_26/2011_09_26_drive_0013_sync"
    sequence, settings = open_sequence(str(drive)), RegisterSettings()
    sweeps = [read_sweep(sequence, frame, settings) for frame in range(118, 123)]
    stretch = deskew(sweeps, find_trajectory(sweeps, settings))
    here, there = stretch[120], stretch[121]
    target = poses.transform(stretch.T_target_source(120, 121), there.sweep.points)
    times = {"source_offset_ns": here.sweep.offset_ns, "target_offset_ns": there.sweep.offset_ns}
    field = estimate_flow(here.sweep.points, target, **times)
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
