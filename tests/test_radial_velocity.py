# SPDX-License-Identifier: MIT
"""Radial velocities of FMCW scanners: simulated, read, the own motion removed, used and scored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from writers import write_street

from densify.flow.tracking.candidates import find_candidates
from densify.flow.tracking.radial import Radial
from densify.free_space.ground import ground
from densify.free_space.seen_through import FreeSpace
from densify.geometry import poses
from densify.geometry.types import Stretch, Sweep, Trajectory
from densify.readers import open_sequence
from densify.readers.point_fields import find_fields, radial_velocities
from densify.readers.street import Street
from densify.registration.deskew import deskew_sweep, twists
from densify.scores.cloud_scores import radial_velocity_scores
from tests.scenes import Arc, Scanner, Scene, World, by_flow, car, street
from tests.small_street import one_car

KEY = 60


@pytest.fixture(scope="module")
def fmcw() -> Street:
    return Street("street", 3, "fmcw", cameras=())


def test_a_street_has_those_of_its_bodies(fmcw):
    """Own motion removed, what stands has none, and what moves that of the truth along its ray."""
    frames = (KEY - 1, KEY, KEY + 1)
    stamps_ns = np.array([fmcw.stamp_ns(f) for f in frames])
    track = Trajectory(frames, stamps_ns, np.stack([fmcw.T_world_lidar(f) for f in frames]))
    registered = deskew_sweep(fmcw[KEY], fmcw.T_world_lidar(KEY), *twists(track, 1))
    sweep, (ray, _) = registered.sweep, registered.rays()
    moving = fmcw.truth.sweep(KEY).moving
    assert moving.sum() > 500
    assert abs(sweep.radial_velocity_m_s[~moving].mean()) < 0.01
    assert sweep.radial_velocity_m_s[~moving].std() == pytest.approx(0.05, abs=0.005)
    true_m_s = fmcw.truth.displacement(KEY, KEY + 1)[moving] / 0.1
    along = np.einsum("ni,ni->n", ray[moving], true_m_s)
    off_m_s = np.abs(sweep.radial_velocity_m_s[moving] - along)
    assert np.median(off_m_s) < 0.1 and np.abs(along).max() > 3


def test_own_motion_is_removed_wherever_scanners_stand():
    """A twin in small steps of time: how fast the distance of standing points changes."""
    rng = np.random.default_rng(0)
    twist, n, h = np.array([0.05, -0.1, 0.6, 12.0, -1.0, 0.3]), 50, 1e-5
    origins = np.array([[0.0, 0, 0], [1.5, -0.7, 0.4]])
    offset_ns = rng.integers(-50_000_000, 50_000_000, n)
    points, lidar = rng.uniform(-30, 30, (n, 3)), rng.integers(0, 2, n).astype(np.uint8)
    measured = np.zeros(n, np.float32)
    for i in range(n):
        fired_s, start = offset_ns[i] * 1e-9, origins[lidar[i]][None]
        place = poses.transform(poses.exp(twist * fired_s), points[i : i + 1])
        away_m = [
            np.linalg.norm(place - poses.transform(poses.exp(twist * (fired_s + s)), start))
            for s in (-h, h)
        ]
        measured[i] = (away_m[1] - away_m[0]) / (2 * h)
    sweep = Sweep(
        0, 0, points, np.zeros(n, np.float32), offset_ns, lidar, np.arange(n), origins,
        radial_velocity_m_s=measured,
    )  # fmt: skip
    assert np.abs(measured).max() > 5
    left = deskew_sweep(sweep, np.eye(4), twist, twist).sweep.radial_velocity_m_s
    np.testing.assert_allclose(left, 0, atol=1e-3)


def test_they_are_evidence_without_any_other_sweep():
    scene = Scene(World((*street(), car(14, -1.6, 10, 1))), Arc(0, -1.5, 0, 6.0), Scanner())
    stretch, instance = scene.stretch(5, 0), scene.scan(5).instance
    sweep = stretch.sweeps[0].sweep
    m_s = np.where(instance == 1, stretch.sweeps[0].rays()[0] @ [10.0, 0, 0], 0.0).astype(
        np.float32
    )
    m_s[::7] = np.nan

    def candidates(radial):
        seen = replace(stretch.sweeps[0], sweep=replace(sweep, radial_velocity_m_s=radial))
        alone = Stretch((seen,))
        heights = ground(alone)
        return find_candidates(alone, FreeSpace.of(alone), heights)[0]

    assert candidates(None).num_clusters == 0
    found = candidates(m_s)
    assert found.num_clusters == 1
    of_car = np.flatnonzero((instance == 1) & np.isfinite(m_s))
    assert set(found.row[found.cluster == 0]) <= set(of_car)
    assert np.isin(found.row[instance[found.row] == 1], of_car).mean() > 0.8


def test_they_start_and_check_motion():
    rng = np.random.default_rng(1)
    true = np.array([8.0, 3.0, 0.0])
    ray = np.array([1.0, 0.2, -0.05]) + rng.normal(0, 0.05, (200, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    m_s = (ray @ true + rng.normal(0, 0.05, 200)).astype(np.float32)
    m_s[:20] = np.nan
    radial = Radial(ray, m_s, 0.05)
    corrected = radial.corrected(true + [2.0, 0.4, 0])  # wrong along the mean ray
    np.testing.assert_allclose(corrected, true, atol=0.1)
    assert radial.agrees(np.tile(true, (200, 1)))
    assert not radial.agrees(np.tile(true - [1.0, 0, 0], (200, 1)))
    beside = np.tile(true, (200, 1))
    beside[50:60] += [4.0, 0, 0]
    np.testing.assert_array_equal(np.flatnonzero(radial.contradicts(beside)), np.arange(50, 60))
    unknown = Radial(ray, np.full(200, np.nan, np.float32), 0.05)
    assert unknown.agrees(np.zeros((200, 3))) and not unknown.moving().any()
    np.testing.assert_array_equal(unknown.corrected(true), true)


def test_columns_are_found_and_read(fmcw, tmp_path):
    assert find_fields(["x", "y", "z", "Doppler"]).radial_velocity == "Doppler"
    columns = {"v": np.array([1.0, np.nan, np.inf, 1e9, -2.0])}
    fields = replace(find_fields("xyz"), radial_velocity="v")
    np.testing.assert_array_equal(
        radial_velocities(columns, fields), np.array([1, np.nan, np.nan, np.nan, -2], np.float32)
    )
    place = write_street("folder", fmcw, tmp_path, [KEY - 1, KEY], [])
    read = open_sequence(str(place))[1]
    np.testing.assert_array_equal(read.radial_velocity_m_s, fmcw[KEY].radial_velocity_m_s)
    part = read.select(slice(5, 9))
    np.testing.assert_array_equal(part.radial_velocity_m_s, read.radial_velocity_m_s[5:9])


def test_what_flow_leaves_of_them_is_a_score():
    result = by_flow(one_car(), 3, 1, config={"register": {"source": "dataset"}})
    assert "radial_velocity" not in result.metrics
    registered, cloud = one_car().scene.stretch(3, 0).sweeps[0], result.cloud
    sweep, (ray, _) = registered.sweep, registered.rays()
    own = cloud.frame == 3
    v_m_s = np.zeros((len(sweep), 3))
    v_m_s[np.searchsorted(sweep.row, cloud.row[own])] = cloud.velocity_m_s[own]
    m_s = np.einsum("ni,ni->n", ray, v_m_s).astype(np.float32)
    told = replace(registered, sweep=replace(sweep, radial_velocity_m_s=m_s))
    exact = radial_velocity_scores(cloud, told)
    assert exact["num_moving"] > 100 and exact["num_points"] == len(sweep)
    assert exact["rms_m_s"] < 1e-3 < 3 < exact["rms_standing_m_s"] and exact["unexplained"] == 0
    still = replace(cloud, velocity_m_s=0 * cloud.velocity_m_s)
    missed = radial_velocity_scores(still, told)
    assert missed["rms_m_s"] == missed["rms_standing_m_s"] and missed["unexplained"] > 0.9
