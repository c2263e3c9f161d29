# SPDX-License-Identifier: MIT
"""Chaining and accumulation on motions whose composition is known."""

from __future__ import annotations

import numpy as np
import pytest

from densify import poses
from densify.config import ChainSettings
from densify.stages.accumulate import accumulate
from densify.stages.chain import chain
from densify.types import FlowField, RegisteredSweep, Sweep, Window

KEY = 103
FRAMES = range(100, 107)
SETTINGS = ChainSettings()


def T_key_lidar(frame: int) -> np.ndarray:
    """An ego vehicle that drives, turns, pitches; the identity at the key."""
    t = frame - KEY
    return poses.exp(np.array([0.01, -0.02, 0.15, 1.3, -0.2, 0.05]) * t)


def registered(frame: int, points_key: np.ndarray) -> RegisteredSweep:
    n = len(points_key)
    sweep = Sweep(
        frame=frame,
        stamp_ns=frame * 100_000_000,
        points=poses.transform(poses.inverse(T_key_lidar(frame)), points_key),
        intensity=np.linspace(0, 1, n).astype(np.float32),
        offset_ns=None,
        lidar=np.zeros(n, np.uint8),
        row=np.arange(n) * 3,
    )
    return RegisteredSweep(sweep, T_key_lidar(frame), np.zeros(6), np.zeros(6))


def toward_key(frame: int) -> int:
    return frame + int(np.sign(KEY - frame))


def flow_field(frame: int, moved_key: np.ndarray, instance: np.ndarray, moving=None) -> FlowField:
    """moved_key: (N,3) displacement in the key frame."""
    return FlowField(
        displacement=moved_key @ T_key_lidar(frame)[:3, :3],
        moving=instance >= 0 if moving is None else moving,
        instance=instance.astype(np.int32),
        lost=np.zeros(len(instance), bool),
    )


def in_key(frame: int, flow: FlowField) -> np.ndarray:
    return flow.displacement @ T_key_lidar(frame)[:3, :3].T


NUM_STATIC, NUM_MOVING = 20, 15


def body_to_key(frame: int) -> np.ndarray:
    """A rigid object: drives a bend and turns by 0.3 rad from sweep to sweep."""
    t = frame - KEY
    return poses.exp(np.array([0, 0, 0.3 * t, 8 + 1.1 * t, 2 - 0.1 * t * t, 0.02 * t]))


def scene(body=body_to_key, sizes=None, seed=0) -> tuple[Window, tuple[FlowField, ...]]:
    """Static points and one object, sampled anew in every sweep; the exact flow of every step."""
    rng = np.random.default_rng(seed)
    sweeps, steps = [], []
    for frame in FRAMES:
        n = NUM_MOVING if sizes is None else sizes[frame]
        still = rng.uniform(-20, 20, (NUM_STATIC, 3))
        shape = rng.uniform(-2, 2, (n, 3))
        here = poses.transform(body(frame), shape)
        there = poses.transform(body(toward_key(frame)), shape)
        instance = np.repeat([-1, 4], [NUM_STATIC, n])
        sweeps.append(registered(frame, np.vstack([still, here])))
        steps.append(flow_field(frame, np.vstack([0 * still, there - here]), instance))
    return Window(KEY, tuple(sweeps)), tuple(steps)


def true_to_key(window: Window, frame: int, body=body_to_key) -> np.ndarray:
    """(NUM_MOVING,3) displacement of the object's points from ``frame`` to the key, key frame."""
    here = poses.transform(T_key_lidar(frame), window[frame].sweep.points)[NUM_STATIC:]
    T = body(KEY) @ poses.inverse(body(frame))
    return poses.transform(T, here) - here


# --- chain ----------------------------------------------------------------------------------------


def drifting(frame: int) -> np.ndarray:
    return poses.exp(np.array([0, 0, 0, 1.5, -0.5, 0.1]) * (frame - KEY))


@pytest.mark.parametrize("body", [drifting, body_to_key], ids=["constant", "turning"])
def test_steps_compose_exactly_though_every_sweep_has_other_points(body):
    window, steps = scene(body)
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        found = in_key(frame, flow)[NUM_STATIC:]
        np.testing.assert_allclose(found, true_to_key(window, frame, body), atol=1e-9)
        assert not flow.lost.any()


def test_constant_steps_add_up_to_their_number():
    window, steps = scene(drifting)
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        expected = np.tile(np.array([1.5, -0.5, 0.1]) * (KEY - frame), (NUM_MOVING, 1))
        np.testing.assert_allclose(in_key(frame, flow)[NUM_STATIC:], expected, atol=1e-9)


def test_points_that_do_not_move_have_exactly_no_flow():
    window, steps = scene()
    for step, flow in zip(steps, chain(window, steps, SETTINGS), strict=True):
        assert not flow.displacement[:NUM_STATIC].any()
        assert np.array_equal(flow.moving, step.moving)
        assert np.array_equal(flow.instance, step.instance)


def test_the_key_and_its_neighbours_need_no_chaining():
    window, steps = scene()
    chained = chain(window, steps, SETTINGS)
    for frame in (KEY - 1, KEY, KEY + 1):
        i = window.frames.index(frame)
        assert chained[i].displacement.tobytes() == steps[i].displacement.tobytes()


def test_steps_are_not_written_to():
    window, steps = scene()
    before = [s.displacement.copy() for s in steps]
    chain(window, steps, SETTINGS)
    assert all(np.array_equal(a, s.displacement) for a, s in zip(before, steps, strict=True))


@pytest.mark.parametrize("missing", [KEY - 1, KEY - 2, KEY + 2])
def test_lost_where_the_next_sweep_has_nothing_of_the_object(missing):
    window, steps = scene(sizes={f: 0 if f == missing else NUM_MOVING for f in FRAMES})
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        behind = (missing - KEY) * (frame - missing) > 0
        assert flow.lost[NUM_STATIC:].all() == (behind or frame == missing)  # vacuous: no points
        assert not flow.lost[:NUM_STATIC].any()
        if not behind and frame != missing:
            found = in_key(frame, flow)[NUM_STATIC:]
            np.testing.assert_allclose(found, true_to_key(window, frame), atol=1e-9)


def test_one_lost_object_does_not_take_another_along():
    rng = np.random.default_rng(0)
    sweeps, steps = [], []
    for frame in FRAMES:
        numbers = [7] if frame == KEY - 1 else [7, 8]
        places = [poses.transform(drifting(frame), rng.uniform(-1, 1, (6, 3))) for _ in numbers]
        here = np.vstack(places)
        step = (
            0 * here
            if frame == KEY
            else np.tile(drifting(toward_key(frame))[:3, 3], (len(here), 1))
        )
        if frame != KEY:
            step -= drifting(frame)[:3, 3]
        sweeps.append(registered(frame, here))
        steps.append(flow_field(frame, step, np.repeat(numbers, 6)))
    chained = chain(Window(KEY, tuple(sweeps)), steps, SETTINGS)
    first = chained[0]
    assert first.lost[first.instance == 8].all() and not first.lost[first.instance == 7].any()
    assert not chained[-1].lost.any()


def test_what_was_lost_before_stays_lost():
    window, steps = scene()
    steps[0].lost[NUM_STATIC] = True
    assert chain(window, steps, SETTINGS)[0].lost[NUM_STATIC]


@pytest.mark.parametrize("num_points", [1, 2])
def test_objects_of_one_or_two_points_move_without_turning(num_points):
    window, steps = scene(drifting, sizes={f: num_points for f in FRAMES})
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        np.testing.assert_allclose(
            in_key(frame, flow)[NUM_STATIC:], true_to_key(window, frame, drifting), atol=1e-9
        )


def test_points_on_a_line_do_not_spin_about_it():
    rng = np.random.default_rng(1)
    sweeps, steps = [], []
    for frame in FRAMES:
        line = np.outer(rng.uniform(-2, 2, 8), [1.0, 0.2, 0.0])
        here = poses.transform(drifting(frame), line)
        there = poses.transform(drifting(toward_key(frame)), line)
        sweeps.append(registered(frame, here))
        steps.append(flow_field(frame, there - here, np.zeros(8)))
    window = Window(KEY, tuple(sweeps))
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        expected = np.tile([1.5, -0.5, 0.1], (8, 1)) * (KEY - frame)
        np.testing.assert_allclose(in_key(frame, flow), expected, atol=1e-9)


def test_what_is_not_rigid_follows_its_nearest():
    """Two arms of one object that swing against each other."""
    rng = np.random.default_rng(2)
    sweeps, steps = [], []
    for frame in FRAMES:
        arm = np.repeat([-1.0, 1.0], 20)
        here = np.stack([arm, rng.uniform(-0.2, 0.2, 40), rng.uniform(0, 1, 40)], 1)
        step = np.stack([np.ones(40) * (frame != KEY), 0.1 * arm * (frame != KEY), 0 * arm], 1)
        here[:, :2] += (KEY - frame) * np.array([-1.0, 0])
        sweeps.append(registered(frame, here))
        sign = np.sign(KEY - frame)
        steps.append(flow_field(frame, sign * step, np.zeros(40)))
    chained = chain(Window(KEY, tuple(sweeps)), steps, SETTINGS)
    for frame in (KEY - 2, KEY + 2):
        i = frame - FRAMES[0]
        arm = np.repeat([-1.0, 1.0], 20)
        expected = np.stack([2 + 0 * arm, 0.2 * arm, 0 * arm], 1) * np.sign(KEY - frame)
        np.testing.assert_allclose(in_key(frame, chained[i]), expected, atol=0.03)


def everything_moves(gap_m: float) -> tuple[Window, tuple[FlowField, ...]]:
    """As the published method has it: no objects, every point with its own flow, 0.4 m ahead per
    sweep. In the sweep before the key the points beyond y = 0 stand ``gap_m`` further aside."""
    rng = np.random.default_rng(4)
    sweeps, steps = [], []
    base = rng.uniform(-3, 3, (200, 3))
    for frame in FRAMES:
        here = base + np.array([0.4, 0, 0]) * (frame - KEY)
        if frame == KEY - 1:
            here = here + np.where(base[:, 1:2] > 0, [0, gap_m, 0], 0)
        step = np.tile([0.4 * np.sign(KEY - frame), 0, 0], (200, 1))
        sweeps.append(registered(frame, here))
        steps.append(flow_field(frame, step, np.full(200, -1), np.ones(200, bool)))
    return Window(KEY, tuple(sweeps)), tuple(steps)


def test_points_without_an_object_follow_the_nearest():
    window, steps = everything_moves(gap_m=0.0)
    for frame, flow in zip(FRAMES, chain(window, steps, SETTINGS), strict=True):
        assert not flow.lost.any()
        expected = np.tile([0.4 * (KEY - frame), 0, 0], (200, 1))
        np.testing.assert_allclose(in_key(frame, flow), expected, atol=1e-9)


def test_points_without_an_object_are_lost_over_a_gap():
    window, steps = everything_moves(gap_m=20.0)
    aside = window[KEY].sweep.points[:, 1] > 0.6
    chained = chain(window, steps, SETTINGS)
    i = KEY - 2 - FRAMES[0]
    assert chained[i].lost[aside].all()
    assert chained[i - 1].lost[aside].all()  # and stays lost farther out
    inner = window[KEY].sweep.points[:, 1] < 0
    assert not chained[i].lost[inner].any()
    assert not chained[KEY + 2 - FRAMES[0]].lost.any()
    wide = chain(window, steps, ChainSettings(max_gap_m=10.0))
    assert not wide[i].lost.any()


@pytest.mark.parametrize("frames", [[KEY], [KEY, KEY + 1], [KEY - 2, KEY - 1, KEY]])
def test_cut_windows(frames):
    window, steps = scene()
    kept = [i for i, f in enumerate(FRAMES) if f in frames]
    cut = Window(KEY, tuple(window.sweeps[i] for i in kept))
    for frame, flow in zip(frames, chain(cut, [steps[i] for i in kept], SETTINGS), strict=True):
        found = in_key(frame, flow)[NUM_STATIC:]
        np.testing.assert_allclose(found, true_to_key(window, frame), atol=1e-9)


# --- accumulate -----------------------------------------------------------------------------------


def test_a_moved_object_comes_together_at_the_key():
    window, steps = scene()
    cloud = accumulate(window, chain(window, steps, SETTINGS), drop_lost=True)
    on = cloud.instance == 4
    body = poses.transform(poses.inverse(body_to_key(KEY)), cloud.points[on])
    assert np.abs(body).max() <= 2 + 1e-9  # within the object's size
    assert np.abs(cloud.rigid_points[on] - cloud.points[on]).max() > 2


def test_nothing_moves_rigid_to_the_last_bit():
    window, steps = scene()
    zero = [FlowField.zero(len(s.sweep)) for s in window.sweeps]
    rigid = accumulate(window, zero, drop_lost=True)
    placed = [poses.transform(s.T_key_lidar, s.sweep.points) for s in window.sweeps]
    assert rigid.points.tobytes() == np.concatenate(placed).tobytes()
    assert rigid.points.tobytes() == rigid.rigid_points.tobytes()
    assert not rigid.displaced.any() and not rigid.moving.any()
    flow = accumulate(window, chain(window, steps, SETTINGS), drop_lost=True)
    still = ~flow.moving
    assert still.sum() == NUM_STATIC * len(FRAMES)
    assert flow.points[still].tobytes() == rigid.points[still].tobytes()
    assert flow.rigid_points.tobytes() == rigid.points.tobytes()


def test_the_key_sweep_stays_where_it_is():
    window, steps = scene()
    cloud = accumulate(window, chain(window, steps, SETTINGS), drop_lost=True)
    own = cloud.frame == KEY
    assert cloud.points[own].tobytes() == window[KEY].sweep.points.tobytes()
    assert cloud.moving[own].sum() == NUM_MOVING and not cloud.displaced[own].any()


def test_displaced_is_the_length_of_the_flow():
    window, steps = scene()
    fields = chain(window, steps, SETTINGS)
    cloud = accumulate(window, fields, drop_lost=True)
    lengths = np.concatenate([np.linalg.norm(f.displacement, axis=1) for f in fields])
    np.testing.assert_allclose(cloud.displaced, lengths, atol=1e-5)
    assert cloud.displaced.dtype == np.float32


def test_columns_say_where_points_come_from():
    window, steps = scene()
    cloud = accumulate(window, steps, drop_lost=True)
    assert len(cloud) == sum(len(s.sweep) for s in window.sweeps)
    for registered_ in window.sweeps:
        mine = cloud.frame == registered_.frame
        sweep = registered_.sweep
        assert np.array_equal(cloud.row[mine], sweep.row)
        assert np.array_equal(cloud.intensity[mine], sweep.intensity)
        placed = poses.transform(registered_.T_key_lidar, sweep.points)
        np.testing.assert_allclose(cloud.rigid_points[mine], placed)
    kinds = {
        "points": np.float64,
        "rigid_points": np.float64,
        "frame": np.int32,
        "row": np.int64,
        "moving": np.bool_,
        "instance": np.int32,
        "confidence": np.float32,
        "intensity": np.float32,
        "rgb": np.uint8,
    }
    for name, kind in kinds.items():
        column = getattr(cloud, name)
        assert column.dtype == kind and len(column) == len(cloud), name
    assert cloud.rgb.shape == (len(cloud), 3)


def test_lost_points_are_dropped_or_kept_rigid():
    window, steps = scene(sizes={f: 0 if f == KEY - 1 else NUM_MOVING for f in FRAMES})
    fields = chain(window, steps, SETTINGS)
    num_lost = sum(int(f.lost.sum()) for f in fields)
    assert num_lost == 2 * NUM_MOVING
    dropped = accumulate(window, fields, drop_lost=True)
    kept = accumulate(window, fields, drop_lost=False)
    assert len(kept) - len(dropped) == num_lost
    lost = kept.moving & (kept.frame < KEY - 1)
    assert lost.sum() == num_lost
    assert kept.points[lost].tobytes() == kept.rigid_points[lost].tobytes()
    rest = ~lost
    for name in ("points", "frame", "row", "instance", "confidence", "intensity"):
        assert np.array_equal(getattr(kept, name)[rest], getattr(dropped, name)), name
    # rows still name the return in its file, not its place in the cloud
    for frame in FRAMES:
        mine = dropped.frame == frame
        sweep = window[frame].sweep
        kept_here = np.isin(sweep.row, dropped.row[mine])
        assert kept_here.sum() == mine.sum()
        assert np.array_equal(dropped.intensity[mine], sweep.intensity[kept_here])


def test_confidence_falls_away_from_the_key_and_for_what_was_moved():
    window, steps = scene()
    cloud = accumulate(window, chain(window, steps, SETTINGS), drop_lost=True)
    assert (cloud.confidence > 0).all() and (cloud.confidence <= 1).all()
    away = np.abs(cloud.frame - KEY)
    of_still = [cloud.confidence[(away == d) & ~cloud.moving] for d in range(4)]
    of_moved = [cloud.confidence[(away == d) & cloud.moving] for d in range(4)]
    assert all(np.ptp(c) == 0 for c in of_still)
    assert (np.diff([c[0] for c in of_still]) < 0).all()
    assert (np.diff([c[0] for c in of_moved]) < 0).all()
    assert all(m[0] < s[0] for m, s in zip(of_moved[1:], of_still[1:], strict=True))


def test_movers_know_their_velocity_at_the_key():
    window, steps = scene(drifting)
    cloud = accumulate(window, chain(window, steps, SETTINGS), drop_lost=True)
    assert cloud.velocity_m_s.shape == (len(cloud), 3) and cloud.velocity_m_s.dtype == np.float32
    assert not cloud.velocity_m_s[~cloud.moving].any()
    expected = np.tile([15.0, -5.0, 1.0], (int(cloud.moving.sum()), 1))  # steps of 0.1 s
    np.testing.assert_allclose(cloud.velocity_m_s[cloud.moving], expected, atol=1e-4)
    later = cloud.after(0.05)
    assert later.points[~cloud.moving].tobytes() == cloud.points[~cloud.moving].tobytes()
    on = cloud.moving
    np.testing.assert_allclose(later.points[on] - cloud.points[on], 0.05 * expected, atol=1e-5)
