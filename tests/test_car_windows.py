# SPDX-License-Identifier: MIT
"""Car windows: closed on an analytic car whose window loses rays, left open elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_project import T_CAM_LIDAR, make_camera

from densify.depth.car_windows import close_windows, share_lost
from densify.depth.exposure import Exposure
from densify.free_space.range_image import RangeImage
from tests.depth_layers import layers_of
from tests.fired import fired

SHAPE = (240, 320)
CAMERA = make_camera(width=SHAPE[1], height=SHAPE[0], focal=720.0)
EXPOSURE = Exposure(CAMERA, T_CAM_LIDAR)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
RIGHT, DOWN = ((x - c) / 720 for x, c in ((COLUMN, CAMERA.K[0, 2]), (ROW, CAMERA.K[1, 2])))


def street_behind():
    """Ground 1.7 m below the camera, a wall at 25 m."""
    return np.where(DOWN > 1.7 / 25, 1.7 / np.maximum(DOWN, 1e-9), 25.0)


def side_m(yaw=0.3, lean=0.3):
    """Depth of a leaning plane 8 m ahead, seen at an angle."""
    return 8.0 / (1 - yaw * RIGHT - lean * DOWN)


def box(left_m, right_m, top_m, bottom_m):
    """Where a rectangle at 8 m is, from the middle of the image."""
    at = 8 * RIGHT, 8 * DOWN
    return (at[0] > left_m) & (at[0] < right_m) & (at[1] > top_m) & (at[1] < bottom_m)


BODY, WINDOW = box(-1.6, 1.6, -0.9, 1.0), box(-0.5, 0.45, -0.6, 0.05)


def car(behind_m=0.6, seen=0.5):
    """A car's side with a window, through which seats are seen in patches."""
    depth_m = np.where(BODY, side_m(), street_behind())
    seats = side_m() + behind_m + 0.1 * np.sin(COLUMN / 7)
    return np.where(WINDOW, np.where(np.sin(COLUMN / 9) > 1 - 2 * seen, seats, 0), depth_m)


def lost_at(where, share):
    """The function of the share of rays that are lost: ``share`` at the pixels ``where``."""

    def lost(points):
        column, row = np.rint(EXPOSURE.see(points, np.zeros_like(points)).uv).astype(int).T
        return np.where(where[row, column], share, 0.02)

    return lost


def test_a_window_that_loses_rays_gets_the_plane_of_its_rim():
    layers = layers_of(car())
    closed = close_windows(layers, EXPOSURE, lost_at(WINDOW, 0.5))
    right = np.abs(closed.filled_m / side_m() - 1) < 0.01
    assert right[WINDOW].all()
    assert closed.glass is not None and closed.solid is not None
    np.testing.assert_array_equal(closed.glass, (layers.depth_m > 0) & (closed.depth_m == 0))
    np.testing.assert_array_equal(closed.glass, (layers.depth_m > 0) & WINDOW)
    np.testing.assert_array_equal(closed.solid, WINDOW)
    np.testing.assert_allclose(closed.confidence[WINDOW], 0.4)
    for before, after in ((layers.depth_m, closed.depth_m), (layers.filled_m, closed.filled_m)):
        np.testing.assert_array_equal(after[~WINDOW], before[~WINDOW])


def test_so_does_one_through_which_the_street_beyond_is_seen():
    layers = layers_of(np.where(WINDOW, street_behind(), car()))
    closed = close_windows(layers, EXPOSURE, lost_at(WINDOW, 0.4))
    assert (np.abs(closed.filled_m / side_m() - 1) < 0.01)[WINDOW].all()


def test_what_glass_itself_sent_back_stays_measured():
    depth_m = car()
    pane = box(-0.4, 0.35, -0.5, -0.05) & (np.sin(ROW / 5) > 0.5) & (np.sin(COLUMN / 5) > 0.5)
    depth_m[pane] = side_m()[pane]
    closed = close_windows(layers_of(depth_m), EXPOSURE, lost_at(WINDOW, 0.5))
    np.testing.assert_array_equal(closed.depth_m[pane], depth_m[pane].astype(np.float32))
    assert not closed.depth_m[WINDOW & ~pane].any()


def no_window(kind):
    """A map, where rays are lost in it, and their share."""
    if kind == "a gap through which all rays go":
        return car(), WINDOW, 0.03
    if kind == "a hole in paint as dark":
        return car(), BODY, 0.5
    if kind == "a rim that lies in no plane":
        rough_m = side_m() + np.sin(COLUMN / 8) * np.sin(ROW / 8)
        return np.where(WINDOW, side_m() + 2, rough_m), WINDOW, 0.5
    if kind == "an open door":
        return np.where(box(-0.5, 0.45, -0.4, 9), side_m() + 0.8, side_m()), WINDOW, 0.5
    if kind == "a gap smaller than a ray":
        tiny = box(0, 0.024, 0, 0.024)
        return np.where(tiny, 0, side_m()), tiny, 1.0
    assert kind == "the plain street"
    return street_behind(), ROW > 0, 0.3


@pytest.mark.parametrize(
    "kind",
    ["a gap through which all rays go", "a hole in paint as dark", "a rim that lies in no plane"]
    + ["an open door", "a gap smaller than a ray", "the plain street"],
)
def test_what_is_no_window_is_left(kind):
    depth_m, where, share = no_window(kind)
    layers = layers_of(depth_m)
    closed = close_windows(layers, EXPOSURE, lost_at(where, share))
    np.testing.assert_array_equal(closed.depth_m, layers.depth_m)
    np.testing.assert_array_equal(closed.filled_m, layers.filled_m)


def test_it_is_known_where_a_turning_scanner_lost_its_rays():
    registered = fired("hdl64", share_heard=0.97)
    points = registered.sweep.points
    ahead = abs(np.arctan2(points[:, 1], points[:, 0])) < 0.06
    heard = replace(registered, sweep=registered.sweep.select(~ahead))
    lost = share_lost(RangeImage.of(heard))
    azimuth = np.array([0.0, 0.3])
    there = np.stack([9 * np.cos(azimuth), 9 * np.sin(azimuth), [-1.0, -1.0]], axis=1)
    in_gap, beside = lost(there)
    assert in_gap == 1 and beside < 0.3


def test_of_a_scanner_without_order_nobody_knows():
    assert share_lost(RangeImage.of(fired("rosette"))) is None
