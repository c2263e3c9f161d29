# SPDX-License-Identifier: MIT
"""The standing world beyond a key's window: where its sweeps are put, what of them is shown, and
what must not be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.nearest import thinned
from densify.readers.timeline import Timeline
from densify.registration import road_poses
from densify.registration.odometry import Surface
from densify.registration.road_poses import follow_road
from densify.scores.metrics import depth_scores
from tests.scenes import CAMERA, Arc, Scanner, Scene, TinySequence, World, by_flow, car, street

KEY, WINDOW, NUM_FRAMES = 15, 2, 36
EGO = Arc(0, -1.5, 0, 8.0, 0.02)
LEAVES = car(22, 3.0, 6.0, 1)  # ahead of the vehicle in the lane beside it
SETTINGS = {"register": {"source": "dataset"}}
FAR = {**SETTINGS, "accumulate": {"far_m": 20.0}}
OFF = {**SETTINGS, "accumulate": {"far_m": 0.0}}


def drive(movers=(), ego=EGO, **options) -> TinySequence:
    scene = Scene(World((*street(60.0), *movers)), ego, Scanner(48, 720, sigma_m=0.01))
    return TinySequence(scene, range(NUM_FRAMES), **options)


@cache
def results(movers: bool = False, ego: Arc = EGO):
    """With the far range and without it."""
    sequence = drive((LEAVES,) if movers else (), ego)
    return sequence, *(by_flow(sequence, KEY, WINDOW, config=settings) for settings in (FAR, OFF))


def scores(sequence, result, product="measured"):
    maps = result.depth["front"]
    truth_m, moving = (
        f("front", KEY) for f in (sequence.truth.depth_m, sequence.truth.moving_mask)
    )
    return depth_scores(maps, truth_m, moving, CAMERA)[product]


def test_more_of_what_stands_is_measured_and_pixels_of_the_window_stay():
    sequence, far, near = results()
    more, less = scores(sequence, far)["static"], scores(sequence, near)["static"]
    assert more["coverage"] > less["coverage"] + 0.06
    assert more["outliers"] < less["outliers"] + 0.002
    measured = near.depth["front"].depth_m > 0
    for name in ("depth_m", "frame"):
        one, other = (getattr(r.depth["front"], name) for r in (far, near))
        assert (one == other)[measured].mean() > 0.99, name  # all but what spots cover


def test_pixels_beyond_the_window_say_so():
    _, far, near = results()
    maps = far.depth["front"]
    beyond = (maps.depth_m > 0) & ~np.isin(maps.frame, far.frames)
    assert beyond.sum() > 500
    expected_s = 0.1 * np.abs(maps.frame[beyond] - KEY)
    assert expected_s.min() > 0.1 * WINDOW
    assert np.allclose(maps.age_s[beyond], expected_s, atol=1e-6)
    np.testing.assert_array_equal(far.cloud.far, ~np.isin(far.cloud.frame, far.frames))
    assert not near.cloud.far.any()


def test_the_road_is_read_in_steps_of_2_m_and_half_as_far_behind_a_forward_camera():
    _, far, _ = results()
    assert np.diff(np.unique(far.cloud.frame[far.cloud.far])).min() >= 2  # 0.8 m each
    beyond_m = 0.8 * (np.abs(np.array(far.far_frames) - KEY) - WINDOW)
    ahead = np.array(far.far_frames) > KEY
    assert 5.0 < beyond_m[~ahead].max() <= 10.0
    assert 11.0 < beyond_m[ahead].max() <= 20.0


def test_a_car_that_drives_through_leaves_no_trail():
    """It is wherever the far sweeps look, each time elsewhere."""
    sequence, far, near = results(movers=True)
    for part in ("all", "moving"):
        more, less = scores(sequence, far)[part], scores(sequence, near)[part]
        assert more["outliers"] < less["outliers"] + 0.003, part
    x, y, _ = LEAVES.path.at(np.arange(NUM_FRAMES) * 0.1)
    T_key_world = poses.inverse(sequence.T_world_lidar(KEY))
    path = poses.transform(T_key_world, np.stack([x, y, np.full(len(x), 0.8)], axis=1))
    cloud, kept = far.cloud, far.depth["front"].reason == 0
    shown = cloud.points[cloud.far & kept]
    apart_m = np.linalg.norm(shown[:, None, :2] - path[None, :, :2], axis=2).min(axis=1)
    in_the_way = (apart_m < 0.8) & (shown[:, 2] > -1.3) & (shown[:, 2] < -0.3)
    assert in_the_way.sum() <= 5


class _Torn(TinySequence):
    """A few sweeps on each side of the window cannot be read."""

    def __getitem__(self, frame):
        if frame in range(KEY - 9, KEY - 5) or frame in range(KEY + 7, KEY + 11):
            raise InputError(f"sweep {frame} is torn")
        return super().__getitem__(frame)


def test_the_far_range_ends_at_a_sweep_that_cannot_be_read():
    whole = drive()
    torn = _Torn(whole.scene, range(NUM_FRAMES))
    far = by_flow(torn, KEY, WINDOW, config=FAR)
    frames = np.unique(far.cloud.frame)
    assert frames.min() > KEY - 6 and frames.max() < KEY + 7
    assert far.cloud.far.any()


@pytest.mark.parametrize("side", [-1, 1])
def test_the_chain_finds_the_true_poses(side, monkeypatch):
    """Within 3 cm and a tenth of a degree after 12 m, raw sweeps, from a window that is known."""
    monkeypatch.setattr(road_poses, "MIN_NUM_POINTS", 100)
    sequence = drive()
    stretch, timeline = sequence.scene.stretch(KEY, WINDOW), Timeline.of(sequence)
    known = stretch.sweeps[::side]
    frames = range(known[-1].frame + side, NUM_FRAMES if side > 0 else -1, side)
    stamp_ns = np.array([timeline.stamp_of(f) for f in frames])

    read = sequence.__getitem__
    surfaces = [Surface.of_sweep(s.sweep) for s in known]
    found = follow_road(known, surfaces, list(frames), stamp_ns, read, 12.0, 2.0)
    first = [one for one, _ in found]
    steps = np.diff([one.frame for one in first])
    assert set(np.abs(steps[:-1])) <= {2, 3} and len(first) >= 4
    T_world_true = stretch[KEY].T_world_lidar @ poses.inverse(sequence.T_world_lidar(KEY))
    for one in first:
        T_true = T_world_true @ sequence.T_world_lidar(one.frame)
        error = poses.log(poses.inverse(T_true) @ one.T_world_lidar)
        assert np.linalg.norm(error[3:]) < 0.03, one.frame
        assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1, one.frame


def test_thinning_keeps_the_first_of_each_cell():
    rng = np.random.default_rng(3)
    points, order = rng.uniform(-2, 2, (4000, 3)), rng.permutation(4000)[:3000]
    cells: dict[tuple[int, ...], list[int]] = {}
    for i in order:
        cells.setdefault(tuple(((points[i] - points.min(0)) / 0.5).astype(int)), []).append(i)
    expected = sorted(i for members in cells.values() for i in members[:2])
    assert thinned(points, order, 0.5, 2).tolist() == expected
