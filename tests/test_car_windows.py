# SPDX-License-Identifier: MIT
"""Car windows: closed on an analytic car, left open elsewhere, by a slow twin."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from densify.depth import car_windows as stage
from densify.depth.car_windows import close_windows
from densify.depth.neighbours import DIRECTIONS, first_known
from densify.geometry import threads
from tests.depth_layers import layers_of

FOCAL_PX, SHAPE = 720.0, (240, 320)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
RIGHT, DOWN = (COLUMN - 160) / FOCAL_PX, (ROW - 80) / FOCAL_PX  # of rays, per metre of depth


def street_behind():
    """Ground 1.7 m below the camera, a wall at 25 m."""
    with np.errstate(divide="ignore"):
        return np.where(DOWN > 1.7 / 25, 1.7 / DOWN, 25.0)


def side_m(yaw=0.3, lean=0.3):
    """Depth of a leaning plane 8 m ahead, seen at an angle."""
    return 8.0 / (1 - yaw * RIGHT - lean * DOWN)


def box(left_m, right_m, top_m, bottom_m):
    """Where a rectangle at 8 m is, from the middle of the image's column and horizon."""
    at = 8 * RIGHT, 8 * DOWN
    return (at[0] > left_m) & (at[0] < right_m) & (at[1] > top_m) & (at[1] < bottom_m)


BODY, WINDOW = box(-1.6, 1.6, -0.5, 1.0), box(-0.5, 0.45, -0.38, 0.05)


def car(rng, behind_m=0.6, seen=0.5):
    """A car's side with a window, through which seats are seen."""
    depth_m = np.where(BODY, side_m(), street_behind())
    seats = side_m() + behind_m + 0.1 * np.sin(COLUMN / 7)
    some = (rng.random(SHAPE) < seen) & (np.abs(8 * RIGHT) > 0.15)
    return np.where(WINDOW, np.where(some, seats, 0), depth_m)


def test_a_window_gets_the_plane_of_its_frame():
    layers = layers_of(car(np.random.default_rng(1)))
    closed = close_windows(layers, FOCAL_PX)
    right = np.abs(closed.filled_m / side_m() - 1) < 0.01
    assert right[WINDOW].mean() > 0.98  # a few corners of two pixels are left
    assert closed.glass is not None
    np.testing.assert_array_equal(closed.glass, (layers.depth_m > 0) & (closed.depth_m == 0))
    assert (closed.glass == (layers.depth_m > 0))[WINDOW].mean() > 0.98
    np.testing.assert_allclose(closed.confidence[right & WINDOW], 0.4)
    for before, after in ((layers.depth_m, closed.depth_m), (layers.filled_m, closed.filled_m)):
        np.testing.assert_array_equal(after[~WINDOW], before[~WINDOW])


def test_so_does_one_through_which_the_street_beyond_is_seen():
    rng = np.random.default_rng(6)
    depth_m = np.where(WINDOW, street_behind(), car(rng))
    layers = layers_of(np.where(rng.random(SHAPE) < 0.5, depth_m, 0))
    closed = close_windows(layers, FOCAL_PX)
    right = np.abs(closed.filled_m / side_m() - 1) < 0.01
    assert right[WINDOW].mean() > 0.98
    known = ~WINDOW & (layers.filled_m > 0)
    np.testing.assert_array_equal(closed.filled_m[known], layers.filled_m[known])


def test_a_window_without_a_measured_roof_is_closed_between_its_pillars():
    """Thin roofs are seldom measured over their whole length."""
    rng = np.random.default_rng(7)
    roof = box(-9, 9, -9, -0.38) & ~box(-0.62, -0.45, -9, 9) & ~box(0.4, 0.57, -9, 9)
    layers = layers_of(np.where(roof & BODY, 0, car(rng)))
    closed = close_windows(layers, FOCAL_PX)
    right = np.abs(closed.filled_m / side_m() - 1) < 0.01
    assert right[WINDOW].mean() > 0.7 > (layers.filled_m > 0)[WINDOW].mean()
    assert not closed.filled_m[box(-9, 9, -9, -0.53)][
        layers.filled_m[box(-9, 9, -9, -0.53)] == 0
    ].any()


def test_what_glass_itself_sent_back_stays_measured():
    rng = np.random.default_rng(2)
    depth_m = car(rng)
    pane = WINDOW & (rng.random(SHAPE) < 0.12)
    depth_m[pane] = side_m()[pane]
    closed = close_windows(layers_of(depth_m), FOCAL_PX)
    np.testing.assert_array_equal(closed.depth_m[pane], depth_m[pane].astype(np.float32))
    assert (closed.depth_m[WINDOW & ~pane] == 0).mean() > 0.98


def no_window(kind, rng):
    if kind == "a wall far behind":
        return np.where(BODY & ~WINDOW, side_m(), side_m() + 35)
    if kind == "a truck's open bed":
        return np.where(BODY & ~box(-1.3, 1.3, -9, 0.3), side_m(), side_m() + 1.5)
    if kind == "an open door":
        return np.where(box(-0.5, 0.45, -0.4, 9), side_m() + 0.8, side_m())
    if kind == "a gap between two cars":
        return np.where(box(-0.3, 0.3, -9, 9), side_m() + 1.2, np.where(BODY, side_m(), 25))
    if kind == "a tree's crown":
        return 8 + rng.uniform(-1.5, 1.5, SHAPE)
    if kind == "a shallow recess":
        return np.where(WINDOW, side_m() + 0.15, side_m())
    assert kind == "the plain street"
    return street_behind()


@pytest.mark.parametrize(
    "kind",
    ["a wall far behind", "a truck's open bed", "an open door", "a gap between two cars"]
    + ["a tree's crown", "a shallow recess", "the plain street"],
)
def test_what_is_no_window_is_left(kind):
    rng = np.random.default_rng(3)
    depth_m = np.where(rng.random(SHAPE) < 0.6, no_window(kind, rng), 0)
    layers = layers_of(depth_m)
    closed = close_windows(layers, FOCAL_PX)
    np.testing.assert_array_equal(closed.depth_m, layers.depth_m)
    np.testing.assert_array_equal(closed.filled_m, layers.filled_m)


def test_threads_change_no_byte(monkeypatch):
    layers = layers_of(car(np.random.default_rng(4)))
    results = []
    for cores in (1, 3):
        monkeypatch.setattr(threads, "num_threads", lambda cores=cores: cores)
        results.append(close_windows(layers, FOCAL_PX).filled_m.tobytes())
    assert results[0] == results[1]


CELL_FOCAL_PX = FOCAL_PX / 2
REACH_PX = round(0.16 * CELL_FOCAL_PX)


def on_ray(row, column, d, near, reach_px):
    """(k,3) offsets and inverse depths step by step."""
    steps = []
    for k in range(1, reach_px + 1):
        du, dv = (k // 2) * DIRECTIONS[d, 1] + (k % 2) * DIRECTIONS[d, 0]
        if not (0 <= row + dv < near.shape[0] and 0 <= column + du < near.shape[1]):
            break
        steps.append((du, dv, near[row + dv, column + du]))
    return np.array(steps).reshape(-1, 3)


def fitted(parts):
    design = np.column_stack([np.ones(len(parts)), parts[:, :2]])
    return np.linalg.lstsq(design, parts[:, 2], rcond=None)[0]


def in_plane(parts, off_m):
    """The parts, by direction, without those farthest off their plane, and that; None if too few
    are left."""
    parts = dict(parts)
    while (
        len(parts) >= stage._LEAST
        and len(parts.keys() & {2, 3, 4, 5, 6}) >= stage._BELOW
        and 4 in parts
        and parts.keys() & {8, 9}
        and parts.keys() & {15, 0}
    ):
        plane = fitted(np.array([*parts.values()]))
        off = {d: off_plane(plane, part) for d, part in parts.items()}
        worst = max(off, key=off.get)
        if off[worst] <= off_m:
            return parts, plane
        del parts[worst]
    return None


def off_plane(plane, part):
    at = plane[0] + part[:2] @ plane[1:]
    return abs(1 / at - 1 / part[2]) if at > 0 else np.inf


def twin(row, column, near, far):
    """The plane of the frame around a pixel, None if there is none."""
    if far[row, column] > 0:
        depth = 1 / float(far[row, column])
    else:
        first = [on_ray(row, column, d, near, REACH_PX) for d in range(16)]
        first = [ray[ray[:, 2] > 0][0, 2] for ray in first if (ray[:, 2] > 0).any()]
        if not first:
            return None
        depth = 1 / min(first) + stage._EMPTY_M
    whole = {d: on_ray(row, column, d, near, REACH_PX) for d in range(16)}
    close = {
        d: ray[np.arange(1, len(ray) + 1) <= stage._REACH_M * CELL_FOCAL_PX * ray[:, 2]]
        for d, ray in whole.items()
    }
    nearest = {d: ray[ray[:, 2].argmax()] for d, ray in close.items() if ray[:, 2].any()}
    if not upright_below(whole[4], depth):
        return None
    parts = {
        d: part
        for d, part in nearest.items()
        if depth - 1 / part[2] > stage._EACH_M and depth - 1 / part[2] <= stage._MOST_M
    }
    for off_m in (stage._ROUGH_M, stage._OFF_M):
        found = in_plane(parts, off_m)
        if found is None:
            return None
        _, plane = found
        before = depth - 1 / plane[0]
        if not (plane[0] > 0 and stage._BEHIND_M < before <= stage._MOST_M):
            return None
        if abs(plane[2]) * CELL_FOCAL_PX > stage._LEAN * plane[0]:
            return None
        parts = {}
        reach_px = int(min(stage._REACH_M * CELL_FOCAL_PX * plane[0], REACH_PX))
        rays = {d: ray[:reach_px] for d, ray in whole.items()}
        for d, ray in rays.items():
            for part in ray[ray[:, 2] > 0]:
                at_m = 1 / (plane[0] + part[:2] @ plane[1:])
                if 1 / part[2] < at_m + stage._TOUCH_M:
                    if at_m - stage._ROUGH_M < 1 / part[2] < depth - stage._EACH_M:
                        parts[d] = part
                    break
    plates = {d for d in range(2, 7) if has_plate(rays[d], plane)}
    return plane if 4 in plates and len(plates) >= stage._BELOW - 1 else None


def upright_below(ray, depth):
    """Whether somewhere on the ray straight down cells before the pixel keep together for as long
    as a plate is."""
    begin = None
    for k, inverse in enumerate(ray[:, 2], start=1):
        if inverse == 0:
            continue
        if inverse * (depth - stage._EACH_M) <= 1:
            begin = None
            continue
        gone_m = (k - begin[0]) / (CELL_FOCAL_PX * begin[1]) if begin else 0
        most_m = stage._LEAN * gone_m + 2 * stage._PLATE_OFF_M
        if begin is None or abs(1 / inverse - 1 / begin[1]) > most_m:
            begin = k, inverse
        elif gone_m >= stage._PLATE_M:
            return True
    return False


def has_plate(ray, plane):
    """Whether somewhere on a ray cells are in the plane for as long as a plate is: half of them
    known or more, the first of them, and none off it."""
    size = int(stage._PLATE_M * CELL_FOCAL_PX * plane[0]) + 1
    off = [off_plane(plane, part) if part[2] > 0 else np.nan for part in ray]
    ends = [-1, *np.flatnonzero(np.array(off) > stage._PLATE_OFF_M), len(off)]
    for before, after in pairwise(ends):
        known = [k for k in range(before + 1, after) if np.isfinite(off[k])]
        if known and after - known[0] >= size:
            return 2 * sum(k < known[0] + size for k in known) > size
    return False


def test_frames_equal_those_of_a_slow_twin():
    rng = np.random.default_rng(5)
    depth_m = car(rng)[22:130:2, 110:210:2]
    depth_m[rng.random(depth_m.shape) < 0.1] = 0
    near = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0).astype(np.float32)
    found = np.zeros((6, *near.shape), np.float32)
    known = np.where(near > 0, np.float32(0.5), np.float32(0))
    steps = first_known(near > 0)
    stage.find_frames.over_rows(near.size, near, near, known, steps, CELL_FOCAL_PX, REACH_PX, found)
    num = 0
    for row, column in np.ndindex(near.shape):
        plane = twin(row, column, near, near)
        assert (found[0, row, column] > 0) == (plane is not None), (row, column)
        if plane is not None:
            num += 1
            np.testing.assert_allclose(found[:3, row, column], plane, rtol=1e-3, atol=1e-6)
    assert num > 200
