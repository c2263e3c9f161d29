# SPDX-License-Identifier: MIT
"""Car windows: closed on an analytic car, left open elsewhere, by a slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from densify.depth.car_windows import close_windows
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
