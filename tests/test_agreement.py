# SPDX-License-Identifier: MIT
"""Pixels that what is measured around contradicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth.agreement import contradicted, without_contradicted
from densify.depth.layers import Layers

FOCAL_PX, GAP_PX, WALL_M = 700.0, 3.0, 12.0
SHAPE = (40, 60)
SPOT = (20, 30)


def layers_of(depth_m, rim_m=None):
    none = np.zeros(SHAPE, np.float32)
    return Layers(
        *(depth_m, none if rim_m is None else rim_m, none > 0, none > 0, depth_m, none + 1),
        point=np.full(SHAPE, -1, np.int32),
        tilt=np.zeros((*SHAPE, 2), np.float32),
        spacing_px=np.full((*SHAPE, 2), GAP_PX, np.float32),
    )


def wall():
    return np.full(SHAPE, WALL_M, np.float32)


@pytest.mark.parametrize(("there_m", "wrong"), [(WALL_M / 2, True), (0.96 * WALL_M, False)])
def test_a_pixel_is_contradicted_by_surfaces_that_would_make_it_wrong(there_m, wrong):
    depth_m = wall()
    depth_m[SPOT] = there_m
    share = contradicted(layers_of(depth_m), FOCAL_PX)
    assert share[SPOT] == (pytest.approx(48 / 50) if wrong else 0)
    assert share[SPOT[0], SPOT[1] + 3] == (pytest.approx(1 / 50) if wrong else 0)
    assert share[SPOT[0], SPOT[1] + 4] == 0


def test_what_is_measured_at_depth_edges_tells_too_and_fill_does_not():
    filled_m, none = wall(), np.zeros(SHAPE, np.float32)
    filled_m[SPOT] = WALL_M / 2
    layers = replace(layers_of(none, rim_m=wall()), filled_m=filled_m)
    assert contradicted(layers, FOCAL_PX)[SPOT] == pytest.approx(48 / 50)
    assert not contradicted(replace(layers, rim_m=none), FOCAL_PX).any()


def test_surfaces_go_on_with_their_slope():
    """A road that recedes contradicts nothing."""
    slope = 0.004
    inverse = 1 / WALL_M + slope * (np.arange(SHAPE[0]) - SPOT[0])[:, None]
    depth_m = np.broadcast_to(1 / np.clip(inverse, 0.02, None), SHAPE).astype(np.float32).copy()
    flat = layers_of(depth_m)
    tilt = np.zeros((*SHAPE, 2), np.float32)
    tilt[..., 1] = slope
    sloped = replace(flat, tilt=tilt)
    inside = (slice(SPOT[0] - 5, SPOT[0] + 5), slice(10, 50))
    assert contradicted(flat, FOCAL_PX)[inside].min() > 0.2
    assert not contradicted(sloped, FOCAL_PX)[inside].any()


def test_what_most_around_contradicts_is_left_out():
    depth_m = wall()
    depth_m[SPOT] = WALL_M / 2  # one pixel alone
    depth_m[:, 10:14] = WALL_M / 2  # a post
    before = layers_of(depth_m)
    made = without_contradicted(before, contradicted(before, FOCAL_PX))
    lost = made.filled_m == 0
    assert np.array_equal(np.argwhere(lost), [SPOT])
    assert made.depth_m[SPOT] == made.confidence[SPOT] == 0
    assert made.rim_m[SPOT] == depth_m[SPOT]


def test_what_is_behind_a_closed_window_does_not_contradict_it():
    depth_m = wall()
    filled_m, window = depth_m.copy(), np.zeros(SHAPE, bool)
    window[SPOT[0] - 4 : SPOT[0] + 5, 20:40] = True
    filled_m[window] = WALL_M / 2
    open_ = replace(layers_of(depth_m), filled_m=filled_m)
    share = contradicted(open_, FOCAL_PX)
    assert share[window].min() > 0.7
    closed = replace(open_, window=window)
    of_closed = contradicted(closed, FOCAL_PX)
    assert not of_closed[window].any()
    assert np.array_equal(of_closed[~window], share[~window])
    assert not without_contradicted(open_, share).filled_m[window].any()
    kept = without_contradicted(closed, of_closed)
    assert np.array_equal(kept.filled_m[window], filled_m[window])


def test_a_few_around_tell_nothing():
    """A single sweep measures one pixel in twenty."""
    for num, lost in ((4, False), (6, True)):
        depth_m = np.zeros(SHAPE, np.float32)
        depth_m[SPOT[0] - 2, SPOT[1] - 3 : SPOT[1] - 3 + num] = WALL_M
        filled_m = depth_m.copy()
        filled_m[SPOT] = WALL_M / 2
        layers = replace(layers_of(depth_m), filled_m=filled_m)
        made = without_contradicted(layers, contradicted(layers, FOCAL_PX))
        assert (made.filled_m[SPOT] == 0) == lost
