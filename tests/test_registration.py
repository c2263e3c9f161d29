# SPDX-License-Identifier: MIT
"""Registration and deskewing on an analytic drive, and KISS-ICP's traps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import RegisterSettings
from densify.config.errors import ComputationError, InputError, SweepError
from densify.geometry import poses
from densify.geometry.types import Trajectory
from densify.readers.street import Street
from densify.readers.timeline import read_sweep
from densify.registration.deskew import deskew
from densify.registration.odometry import register_on_surfaces, subsample
from densify.registration.trajectory import check_plausible, find_trajectory
from tests.scenes import SWEEP_S, Arc, Box, Scanner, Scene, World, street

SETTINGS = RegisterSettings()
KEY = 5
FRAMES = range(11)


@pytest.fixture(scope="module")
def drive() -> Scene:
    """12 m/s in a left bend."""
    return Scene(World(street()), Arc(0, -1.5, 0, 12.0, 0.25), Scanner(num_azimuths=900))


@pytest.fixture(scope="module")
def raw(drive):
    return [drive.scan(f).sweep for f in FRAMES]


@pytest.mark.parametrize("late_ms", [0, 20])
def test_stamps_have_to_ascend(raw, late_ms):
    stamp_ns = raw[5].stamp_ns - late_ms * 1_000_000
    wrong = [*raw[:6], replace(raw[6], stamp_ns=stamp_ns), *raw[7:]]
    with pytest.raises(SweepError, match="stamp of frame 6 is not after that of frame 5") as error:
        find_trajectory(wrong, SETTINGS)
    assert error.value.frame == 6


def errors(found: Trajectory, true: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """(n,) metres and degrees of the poses relative to the key's."""
    i = found.frames.index(KEY)
    from_key = [poses.inverse(t.T_world_lidar[i]) @ t.T_world_lidar for t in (true, found)]
    off = poses.log(poses.inverse(from_key[0]) @ from_key[1])
    return np.linalg.norm(off[:, 3:], axis=1), np.rad2deg(np.linalg.norm(off[:, :3], axis=1))


@pytest.mark.parametrize("rate", [1, 2])
def test_the_drive_is_recovered(drive, raw, rate):
    """At twice the rate too, 24 m/s at 20 Hz."""
    sweeps = [replace(s, stamp_ns=s.stamp_ns // rate, offset_ns=s.offset_ns // rate) for s in raw]
    found, again = (find_trajectory(sweeps, SETTINGS) for _ in range(2))
    assert found.T_world_lidar.tobytes() == again.T_world_lidar.tobytes()
    assert (found.frames, found.T_world_lidar[0].tolist()) == (tuple(FRAMES), np.eye(4).tolist())
    off_m, off_deg = errors(found, drive.trajectory(FRAMES))
    assert off_m.mean() < 0.02 and off_deg.max() < 0.1


@pytest.mark.parametrize(("seed", "hz", "first"), [(5, 10, 64), (5, 20, 128), (23, 20, 205)])
def test_a_drive_on_a_highway_does_not_look_like_standing_still(seed, hz, first):
    """Most points are rings on flat ground, which move with the vehicle. The same rays meet guard
    rails in every sweep, more so at a high rate."""
    road = Street("highway", seed, "hdl64", hz=hz)
    sweeps = [read_sweep(road, frame, SETTINGS) for frame in range(first, first + 5)]
    T = find_trajectory(sweeps, SETTINGS).T_world_lidar
    assert np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]) * hz / 4 == pytest.approx(25, abs=1)


@pytest.fixture(scope="module")
def fast_drive() -> Scene:
    """36 m/s, nearly straight."""
    return Scene(World(street()), Arc(-20, -1.5, 0, 36.0, 0.05), Scanner(num_azimuths=900))


@pytest.mark.parametrize(
    "frames",
    [(0, 2, 4, 6, 8), (0, 3, 6, 9), (0, 1, 2, 5, 6, 8, 9)],
    ids=["every second", "every third", "holes"],
)
def test_sweeps_may_be_missing(fast_drive, frames):
    """A hole of three periods at 36 m/s is 7 m longer than the step before it."""
    found = find_trajectory([fast_drive.scan(f).sweep for f in frames], SETTINGS)
    true = fast_drive.trajectory(frames).T_world_lidar
    steps = [poses.inverse(T[:-1]) @ T[1:] for T in (true, found.T_world_lidar)]
    off = poses.log(poses.inverse(steps[0]) @ steps[1])
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.2
    assert np.rad2deg(np.linalg.norm(off[:, :3], axis=1)).max() < 0.2


def test_what_odometry_leaves_is_mended(drive, raw):
    true, rng = drive.trajectory(FRAMES), np.random.default_rng(1)
    twists = [poses.twist_to(true.T_world_lidar, true.stamp_ns, max(i, 1)) for i in FRAMES]
    noise = np.deg2rad([1, 1, 1, 0, 0, 0]) + np.array([0, 0, 0, 0.3, 0.3, 0.3])
    found, _ = register_on_surfaces(raw, twists + noise * rng.normal(size=(11, 6)))
    off_m, off_deg = errors(replace(true, T_world_lidar=found), true)
    assert off_m.mean() < 0.02 and off_deg.max() < 0.1


def test_static_points_come_to_where_they_are_at_the_reference_time():
    walls = (Box((120, 2, 6), Arc(0, 12)), Box((120, 2, 6), Arc(0, -14)), *street())
    walled = Scene(World(walls), Arc(0, 0, 0, 12.0, 0.4))
    registered, scan = walled.stretch(KEY, 0)[KEY], walled.scan(KEY)
    true = poses.transform(poses.inverse(walled.T_world_lidar(KEY * SWEEP_S)), scan.world)
    raw_error = np.linalg.norm(registered.sweep.points - scan.sweep.points, axis=1)
    error = np.linalg.norm(registered.sweep.points - true, axis=1)
    assert raw_error.max() > 0.6  # half a sweep at 12 m/s
    assert error.max() < 0.01  # the arc within a sweep is taken for a straight line


def test_each_half_moves_with_its_own_twist():
    """Braking: before the reference time faster than after it."""
    scene = Scene(World(()), Arc(0, 0))
    sweep = scene.scan(0).sweep
    x = np.array([0.0, 1.5, 2.0])  # 15 m/s, then 5 m/s
    T = np.stack([poses.exp(np.array([0, 0, 0, at, 0, 0])) for at in x])
    stamps = sweep.stamp_ns + np.array([-100_000_000, 0, 100_000_000])
    registered = deskew([sweep], Trajectory((-1, 0, 1), stamps, T))[0]
    np.testing.assert_allclose(registered.twist_before, [0, 0, 0, 15, 0, 0], atol=1e-9)
    np.testing.assert_allclose(registered.twist_after, [0, 0, 0, 5, 0, 0], atol=1e-9)
    t = sweep.offset_ns * 1e-9
    moved = registered.sweep.points - sweep.points
    np.testing.assert_allclose(moved[:, 0], t * np.where(t < 0, 15, 5), atol=1e-9)
    assert np.abs(moved[:, 1:]).max() < 1e-9


def test_few_points_are_laid_on_the_surfaces_of_the_last_second(drive, raw):
    few, true = [subsample(s, 12_000) for s in raw], drive.trajectory(FRAMES)
    found, points = register_on_surfaces(few)
    assert [len(p) for p in points] == [len(s) for s in few]
    off_m, off_deg = errors(replace(true, T_world_lidar=found), true)
    assert off_m.max() < 0.04 and off_deg.max() < 0.1


def test_the_road_ahead_does_not_tip_a_scanner_of_few_rings() -> None:
    """Ahead only nearer rings were seen before: normals of few neighbours, all of one ring, tip the
    poses by .4 degrees either way."""
    road, frames = Street("street", 59, "vlp16"), range(75, 86)
    raw = [read_sweep(road, f, SETTINGS) for f in frames]
    T_true = [poses.inverse(road.T_world_lidar(80)) @ road.T_world_lidar(f) for f in (75, 85)]
    found = dict(zip(frames, register_on_surfaces(raw)[0], strict=True))
    for T, f in zip(T_true, (75, 85), strict=True):
        off = poses.log(poses.inverse(T) @ poses.inverse(found[80]) @ found[f])
        assert np.rad2deg(np.linalg.norm(off[:3])) < 0.2 and np.linalg.norm(off[3:]) < 0.03


def test_a_pattern_that_turns_from_sweep_to_sweep_does_not_take_the_poses_with_it() -> None:
    """Point to point, a rosette at a crossing where the vehicle stands turns by 2 to 7 degrees a
    sweep."""
    crossing, frames = Street("crossing", 302, "rosette"), range(85, 93)
    raw = [read_sweep(crossing, f, SETTINGS) for f in frames]
    found = find_trajectory(raw, SETTINGS)
    off = np.array([poses.log(T) for T in found.T_world_lidar])
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.08
    assert np.rad2deg(np.linalg.norm(off[:, :3], axis=1)).max() < 1


@pytest.mark.parametrize("num_points", [0, 999])
def test_too_few_points_names_the_frame(raw, num_points):
    sparse = raw[2].select(np.arange(len(raw[2])) < num_points)
    with pytest.raises(InputError, match=rf"sweep 2 has {num_points} points.*at least 1000"):
        find_trajectory([raw[0], raw[1], sparse], SETTINGS)


def test_one_sweep_of_another_place_is_a_jump(drive, raw):
    x, y, yaw = (float(value) for value in drive.ego.at(5 * SWEEP_S))
    elsewhere = Scene(drive.world, Arc(x + 20, y, yaw)).scan(0).sweep
    swapped = [
        replace(elsewhere, frame=5, stamp_ns=s.stamp_ns) if s.frame == 5 else s for s in raw[:9]
    ]
    with pytest.raises(ComputationError, match=r"frame [456]\b"):
        find_trajectory(swapped, SETTINGS)


def moved(trajectory: Trajectory, index: int, twist) -> Trajectory:
    T = trajectory.T_world_lidar.copy()
    T[index:] = T[index] @ poses.exp(np.array(twist, float)) @ poses.inverse(T[index]) @ T[index:]
    return replace(trajectory, T_world_lidar=T)


@pytest.mark.parametrize(
    ("twist", "what"),
    [
        ([0, 0, 0, 8, 0, 0], "from frame 5 to 6: 9[0-9] m/s"),
        ([0, 0, 0, 0, -9, 0], "from frame 5 to 6"),
        ([0, 0, 0.5, 0, 0, 0], "from frame 5 to 6: .* deg/s"),
        ([0, 0, 0, 2, 0, 0], "from frame 5 to 6: the speed changes by 2[0-9]"),
        ([0, 0, 0, -1.5, 0, 0], "from frame 5 to 6: the speed changes"),
    ],
)
def test_jumps_name_their_frames(drive, twist, what):
    check_plausible(drive.trajectory(FRAMES), SETTINGS)
    check_plausible(moved(drive.trajectory(FRAMES), 6, [0, 0, 0.02, 0.2, -0.1, 0.1]), SETTINGS)
    with pytest.raises(ComputationError, match=what) as caught:
        check_plausible(moved(drive.trajectory(FRAMES), 6, twist), SETTINGS)
    assert "\n" not in str(caught.value)
