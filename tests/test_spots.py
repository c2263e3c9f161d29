# SPDX-License-Identifier: MIT
"""Pixels that a laser's spot covers: by a slow twin, and what they must not become."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth.image_points import PointsInImage
from densify.depth.spots import measure_spots
from tests.depth_layers import layers_of

HEIGHT, WIDTH = 24, 32
ROW, COLUMN = np.mgrid[:HEIGHT, :WIDTH].astype(float)
TILT = (2e-4, -3e-4)
PLANE = (1 / (0.1 + TILT[0] * COLUMN + TILT[1] * ROW)).astype(np.float32)


def measured_at(uv, spacing_px):
    """A filled plane, measured where the points ``uv`` (K,2) fall; and the points."""
    uv = np.asarray(uv, float)
    num = len(uv)
    spacing = np.broadcast_to(np.asarray(spacing_px, float), num)
    column, row = np.rint(uv).astype(int).T
    depth_m, point = np.zeros_like(PLANE), np.full(PLANE.shape, -1, np.int32)
    index = 3 * np.arange(num) + 1  # rows of a cloud of which others are outside the image
    depth_m[row, column], point[row, column] = PLANE[row, column], index
    nothing = np.zeros(num, np.int64)
    points = PointsInImage(
        *(index, uv, PLANE[row, column], np.ones((num, 2)), np.tile(TILT, (num, 1))),
        np.stack([spacing, 9 * spacing], 1),
        *(nothing, nothing, nothing > 0),
    )
    layers = layers_of(PLANE, depth_m > 0, tilt=TILT)
    layers = replace(layers, point=point)
    return layers, points


def test_pixels_whose_middle_the_spot_covers_are_measured():
    rng = np.random.default_rng(5)
    cells = np.stack(np.meshgrid(np.arange(2, WIDTH - 2, 4), np.arange(2, HEIGHT - 2, 5)), -1)
    uv = cells.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (cells.size // 2, 2))
    layers, points = measured_at(uv, rng.uniform(1, 8, len(uv)))
    made = measure_spots(layers, points)
    radius_px = 0.35 * points.spacing_px[:, 0]
    for v in range(HEIGHT):
        for u in range(WIDTH):
            away_px = np.hypot(*(points.uv - [u, v]).T)
            covers = away_px <= radius_px
            assert (made.depth_m[v, u] > 0) == (layers.depth_m[v, u] > 0 or covers.any())
            if layers.depth_m[v, u] > 0:
                assert made.point[v, u] == layers.point[v, u]
            elif covers.any():
                nearest = np.flatnonzero(covers)[np.argmin(away_px[covers])]
                assert made.point[v, u] == points.index[nearest]
    known = made.depth_m > 0
    assert known.sum() > 2 * len(uv)
    np.testing.assert_array_equal(made.depth_m[known], PLANE[known])


def test_what_is_open_or_of_another_surface_stays_so():
    layers, points = measured_at([[16, 12]], 6.0)
    filled_m = PLANE.copy()
    filled_m[:, 17:] = 0  # an edge, which nothing was filled across
    filled_m[:, :16] += np.float32(0.5)  # and another surface
    filled_m[12, 16] = PLANE[12, 16]
    made = measure_spots(replace(layers, filled_m=filled_m), points)
    expected = (np.abs(ROW - 12) <= 2) & (COLUMN == 16)
    np.testing.assert_array_equal(made.depth_m > 0, expected)


@pytest.mark.parametrize("spacing_px", [50.0, 1e6])
def test_right_before_the_lens_a_spot_does_not_fill_the_image(spacing_px):
    layers, points = measured_at([[16, 12]], spacing_px)
    assert (measure_spots(layers, points).depth_m > 0).sum() == 49  # radius 4
