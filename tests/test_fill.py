# SPDX-License-Identifier: MIT
"""The fill between measured pixels: exact on planes, never across a step, by slow twins, and what
it must leave empty. The rules of its windows are tested in test_project.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth import fill as stage
from densify.depth.fill import fill, fill_stars
from densify.depth.neighbours import DIRECTIONS, first_known
from tests.depth_layers import layers_of

SHAPE = (60, 80)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
TILT = (5e-4, 8e-4)
TILTED = 1 / (0.1 + TILT[0] * (COLUMN - 40) + TILT[1] * (ROW - 30))  # m, a plane
WIDE = (8.0, 16.0)  # spacings of rays, px


def test_windows_reach_as_far_as_rays_lie_apart_there():
    """Rings 3 px apart on the left and 12 px on the right: both are closed, neither beyond."""
    left = COLUMN < 40
    rings = np.where(left, ROW % 3 == 0, ROW % 12 == 0) & (ROW < 49)
    spacing = np.where(left[..., None], [1, 3], [1, 12])
    filled = fill(layers_of(rings * 10.0, spacing_px=spacing), 1.0).filled_m
    assert (filled[1:48, 2:38] > 0).all() and (filled[1:48, 42:-2] > 0).all()
    assert not filled[49:].any()
    narrow = fill(layers_of(rings * 10.0, spacing_px=(1, 3)), 1.0).filled_m
    assert (narrow[1:48, 42:-2] > 0).mean() < 0.6


def test_the_image_lets_the_fill_come_closer_to_an_edge():
    """A post before a wall: without an image the other surface's votes keep the edge empty."""
    post = (COLUMN >= 30) & (COLUMN < 50)
    known = np.random.default_rng(0).uniform(size=SHAPE) < 0.3
    sparse = np.where(known, np.where(post, 10.0, 20.0), 0)
    image = np.where(post[..., None], (40, 60, 90), 200).astype(np.uint8)
    edges = np.isin(COLUMN, [28, 29, 30, 31, 48, 49, 50, 51]) & ~known & (ROW > 3) & (ROW < 56)

    def share(image):
        filled = fill(layers_of(sparse, spacing_px=(4, 4), image=image), 1.5).filled_m
        assert np.array_equal(filled[known], sparse[known].astype(np.float32))
        return (filled[edges] > 0).mean()

    assert share(image) > share(None)


def test_slopes_of_filled_pixels_are_the_planes():
    sparse = np.random.default_rng(8).random(SHAPE) < 0.3
    made = fill(layers_of(np.where(sparse, TILTED, 0), spacing_px=(12, 12)), 1.5)
    inside = (made.filled_m > 0) & ~sparse
    assert inside.mean() > 0.5
    np.testing.assert_allclose(np.median(made.tilt[inside], axis=0), TILT, rtol=1e-3)


def test_a_pillar_with_few_measured_pixels_is_not_filled_over():
    """Before a wall at 20 m: a few returns at 5 m, too near to its edges to be accepted."""
    wall = np.where(np.arange(SHAPE[1]) % 3 == 0, 20.0, 0.0) * np.ones(SHAPE)
    wall[:, 40:45] = 0
    rims = np.zeros(SHAPE, np.float32)
    rims[::4, 42] = 5
    plain = layers_of(wall)
    inside, pillar = np.s_[10:50, 41:44], np.s_[10:50, 42]
    assert (fill(plain, 1.5).filled_m[inside] > 0).all()
    made = fill(replace(plain, rim_m=rims), 1.5)
    assert not made.filled_m[pillar].any() and (made.rejected_m[pillar] == 20).any()


def star(depth_m, **more):
    return fill_stars(layers_of(depth_m, **{"tilt": TILT, "spacing_px": WIDE, **more}))


def disc(radius_px, row=30, column=40):
    return (ROW - row) ** 2 + (COLUMN - column) ** 2 <= radius_px**2


def test_a_hole_in_a_plane_gets_the_planes_depth():
    hole = disc(9) | ((ROW == 44) & (COLUMN > 10))  # such as between a scanner's two blocks
    filled = star(np.where(hole, 0, TILTED))
    assert (filled.filled_m > 0).all()
    np.testing.assert_allclose(filled.filled_m, TILTED, rtol=2e-3)
    assert not filled.depth_m[hole].any()


@pytest.mark.parametrize("edge", ["column", "row", "diagonal"])
@pytest.mark.parametrize("width_px", [1, 3, 8])
def test_no_depth_edge_is_crossed(edge, width_px):
    along = {"column": COLUMN - 40, "row": ROW - 30, "diagonal": (COLUMN - 40 + ROW - 30) / 1.4}
    side = along[edge]
    depth_m = np.where(side < 0, 8.0, 9.0)
    strip = np.abs(side + 0.1) < width_px / 2 + 0.5
    filled = star(np.where(strip, 0, depth_m), tilt=(0, 0)).filled_m
    new = strip & (filled > 0)
    inner = (ROW > 12) & (ROW < 48) & (COLUMN > 12) & (COLUMN < 68)
    assert not (new & inner).any()
    assert not (new & (np.abs(filled / depth_m - 1) > 0.05)).any()


@pytest.mark.parametrize("known", [ROW < 30, ROW < 53])
def test_what_known_pixels_do_not_surround_stays_empty(known):
    assert not star(np.where(known, TILTED, 0)).filled_m[~known].any()


def test_holes_wider_than_the_reach_stay_empty():
    assert not star(np.where(disc(20), 0, TILTED), spacing_px=(6, 12)).filled_m[disc(6)].any()


def test_a_fence_is_no_wall():
    """Wires 6 m away, and between them something 11 m away."""
    wire = (COLUMN % 8 < 2) | (ROW % 10 < 2)
    behind = (COLUMN % 8 == 5) & (ROW % 10 == 6)
    hole = ~wire & ~behind & (ROW > 5) & (ROW < 55) & (COLUMN > 5) & (COLUMN < 75)
    filled = star(np.where(wire, 6.0, np.where(behind, 11.0, 0)), tilt=(0, 0)).filled_m
    assert (filled[hole] > 0).mean() < 0.25
    assert (star(np.where(wire, 6.0, 0), tilt=(0, 0)).filled_m[hole] > 0).all()


def ragged(rng):
    """A plane, a nearer block, and holes of all sizes."""
    depth_m = np.where((COLUMN > 50) & (ROW > 20), 6.0, TILTED * rng.uniform(0.99, 1.01, SHAPE))
    return np.where((rng.random(SHAPE) < 0.5) | disc(8), 0, depth_m)


def star_twin(row, column, inverse, slope, spacing_px):
    """Depth of one pixel, 0 where the known ones around do not agree."""
    met, given = [], []
    for single, double in DIRECTIONS:
        met.append(False)
        for k in range(1, 255):
            du, dv = (k // 2) * double + (k % 2) * single
            if not (0 <= row + dv < SHAPE[0] and 0 <= column + du < SHAPE[1]):
                break
            there = inverse[row + dv, column + du]
            if there > 0:
                if np.hypot(du, dv) <= max(spacing_px):
                    met[-1] = True
                    w = there - slope[row + dv, column + du] @ (du, dv)
                    w = np.clip(w, 0.7 * there, 1.4 * there)
                    given.append((w, 1 / k))
                break
    if not given:
        return 0.0
    w, weight = np.array(given).T
    mean = np.average(w, weights=weight)
    if len(given) < 8 or "0" * 8 in "".join("01"[m] for m in met) * 2 or np.ptp(w) > 0.1 * mean:
        return 0.0
    return 1 / mean


def test_stars_equal_those_of_a_slow_twin():
    rng = np.random.default_rng(7)
    depth_m = ragged(rng)
    inverse = np.divide(1, depth_m, out=np.zeros(SHAPE), where=depth_m > 0).astype(np.float32)
    slope = rng.normal(0, 2e-4, (*SHAPE, 2)).astype(np.float32)
    spacing_px = np.broadcast_to(np.float32([3, 7]), (*SHAPE, 2)).copy()
    pixel = np.flatnonzero(depth_m == 0)
    found_m = np.zeros(len(pixel), np.float32)
    steps = first_known(depth_m > 0)
    stage._star(0, len(pixel), pixel, steps, inverse, slope, spacing_px, found_m)
    for p, got in zip(pixel, found_m, strict=True):
        expected = star_twin(*divmod(p, SHAPE[1]), inverse, slope, (3, 7))
        np.testing.assert_allclose(got, expected, rtol=1e-4, err_msg=str(p))
    assert 0.2 < (found_m > 0).mean() < 0.9
