# SPDX-License-Identifier: MIT
"""Pairs of rigs with two scanners half a turn apart, which see everything twice in a sweep."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from densify import open_sequence
from densify.flow.pair_groups import MISSING, Surface
from densify.flow.two_clouds import estimate_flow
from densify.geometry import poses
from densify.readers.street import Street
from densify.street.lidar import T_ego_lidar, at_offsets
from densify.street.simulator import seconds

FRAME = 20


def as_user(street: Street, frame: int) -> np.ndarray:
    """A sweep in the first one's lidar frame, the vehicle's own motion undone, nothing else's."""
    simulator, returns = street.simulator, street.returns(frame)
    times = at_offsets(seconds(simulator.stamp_ns(frame)), returns.offset_ns)
    points = poses.transform(T_ego_lidar(simulator.tilt_deg), returns.points.astype(float))
    world = simulator.scene.ego.poses(times).apply(points)
    return poses.transform(poses.inverse(street.T_world_lidar(FRAME)), world)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street("highway", 2, "dual32")


@pytest.fixture(scope="module")
def clouds(street) -> tuple[np.ndarray, np.ndarray]:
    return as_user(street, FRAME), as_user(street, FRAME + 1)


def times_of(street: Street) -> dict[str, np.ndarray]:
    return {
        "source_offset_ns": street.returns(FRAME).offset_ns,
        "target_offset_ns": street.returns(FRAME + 1).offset_ns,
    }


def lidars_of(street: Street) -> dict[str, np.ndarray]:
    return {
        "source_lidar": street.returns(FRAME).lidar.astype(int),
        "target_lidar": street.returns(FRAME + 1).lidar.astype(int),
    }


@pytest.mark.parametrize("given", ["nothing", "both"])
def test_movers_come_out_right_with_whatever_is_known(street, clouds, given):
    columns = times_of(street) if given in ("times", "both") else {}
    columns |= lidars_of(street) if given in ("scanners", "both") else {}
    field = estimate_flow(*clouds, **columns)
    truth = street.truth.displacement(FRAME, FRAME + 1)
    moving = street.truth.sweep(FRAME).moving
    near = moving & (np.linalg.norm(clouds[0][:, :2], axis=1) < 35)
    error_m = np.linalg.norm(field.displacement - truth, axis=1)
    assert near.sum() > 1000 and field.moving[near].mean() > 0.9
    assert error_m[near & field.moving].mean() < (0.05 if columns else 0.06)
    assert field.moving[~moving].mean() < 1e-4


def corner(rng: np.random.Generator, num: int) -> np.ndarray:
    """Points on three faces of a box 1.6 m long, noise of 1 cm."""
    u, v = rng.uniform(0, 1, (2, num))
    face = np.arange(num) % 3
    x = np.where(face == 0, 0.0, 1.6 * u)
    y = np.where(face == 1, 0.0, np.where(face == 0, u, v))
    z = np.where(face == 2, 1.0, v)
    return np.column_stack([x, y, z]) + 0.01 * rng.standard_normal((num, 3))


def test_cost_is_that_of_a_normal_distribution():
    """The slow twin: the neighbours of one point after another."""
    rng = np.random.default_rng(2)
    cloud, points = corner(rng, 300), corner(rng, 60) + 0.05
    expected = []
    for point in points:
        far_m = np.linalg.norm(cloud - point, axis=1)
        near = cloud[np.argsort(far_m)[:12]]
        near = near[np.linalg.norm(near - point, axis=1) < 1.0]
        covariance = np.cov(near.T, ddof=0) + 0.1**2 * np.eye(3)
        off = point - near.mean(0)
        expected.append(min(off @ np.linalg.inv(covariance) @ off / 2, MISSING))
    np.testing.assert_allclose(Surface(cloud).cost(points), expected, rtol=1e-6)
    assert 0.1 < np.mean(expected) < 2


def test_what_hangs_above_the_road_does_not_drive():
    """A crown 5 m up that the wind has moved, and the same as a bush on the ground."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-15, 15, (2, 4000))
    ground = np.column_stack([x, y, 0.01 * rng.standard_normal(4000)])
    box = corner(rng, 900) + [5.0, 2.0, 0.3]
    low, high = (
        estimate_flow(
            np.vstack([ground, box + [0, 0, up]]), np.vstack([ground, box + [0.7, 0, up]])
        )
        for up in (0.0, 5.0)
    )
    assert low.moving[4000:].mean() > 0.9 and not high.moving.any()


@pytest.mark.parametrize("given", ["nothing", "both"])
def test_a_real_car_beside_two_scanners(given):
    """A log of Argoverse 2: the car's profile is one line at 0.8 to 0.86 m a sweep."""
    folder = os.environ.get("DENSIFY_TEST_DATA")
    if not folder:
        pytest.skip("DENSIFY_TEST_DATA is not set: no real Argoverse 2 log")
    log = Path(folder) / "argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    sequence = open_sequence(f"argoverse2:{log}")
    T = poses.inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1)
    feather = pytest.importorskip("pyarrow.feather")
    here, there = (
        feather.read_table(path).to_pydict() for path in sorted(log.glob("sensors/lidar/*.feather"))
    )
    source, target = (
        np.column_stack([s["x"], s["y"], s["z"]]).astype(float) for s in (here, there)
    )
    columns, sweeps = {}, {"source": here, "target": there}
    if given in ("times", "both"):
        columns |= {f"{k}_offset_ns": np.array(v["offset_ns"]) for k, v in sweeps.items()}
    if given in ("scanners", "both"):
        columns |= {f"{k}_lidar": np.array(v["laser_number"]) // 32 for k, v in sweeps.items()}
    field = estimate_flow(source, poses.transform(T, target), **columns)
    car = field.moving & (np.linalg.norm(source[:, :2] - [-4.6, -2.2], axis=1) < 2.5)
    assert car.sum() > 900 and np.ptp(field.instance[car]) == 0
    way_m = np.median(field.displacement[car], axis=0)
    assert abs(way_m[0] - 0.83) < (0.06 if "source_offset_ns" in columns else 0.15)
    assert np.abs(way_m[1:]).max() < 0.1
    assert 1200 < field.moving.sum() < 2000  # three more cars, and nothing else
