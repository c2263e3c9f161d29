# SPDX-License-Identifier: MIT
"""Boundary pixels by the image: panels before a wall, known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.depth import boundary_pixels as stage
from densify.depth.boundary_pixels import Voters, accept_boundary_pixels, lab, vote
from densify.depth.neighbours import DIRECTIONS, first_known
from tests.depth_layers import layers_of

HEIGHT, WIDTH = 200, 320
WALL_M, FAT_PX = 20.0, 3


def scene(seed=0):
    """Layers and image of a dozen panels before a wall. Of each pixel a third is measured; panels
    reach 3 px beyond their outline, as wide beams make them, and are rims from there to 3 px
    inside. Returns them and the true depth."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    truth = np.full((HEIGHT, WIDTH), WALL_M, np.float32)
    depth, rim = truth.copy(), np.zeros_like(truth)
    image = np.full((HEIGHT, WIDTH, 3), [90, 110, 150.0])
    for place in range(12):
        left, top = 20 + 75 * (place % 4), 15 + 62 * (place // 4)
        width, height, z = rng.integers(20, 45), rng.integers(25, 40), rng.uniform(6, 12)
        beyond = np.maximum(
            np.maximum(left - u, u - left - width + 1), np.maximum(top - v, v - top - height + 1)
        )
        truth[beyond <= 0] = z
        image[beyond <= 0] = rng.uniform(20, 250, 3)
        fat = (beyond > -FAT_PX) & (beyond <= FAT_PX)
        depth[fat], rim[fat] = 0, z
        depth[beyond <= -FAT_PX] = z
    known = rng.uniform(size=truth.shape) < 0.33
    depth, rim = (np.where(known, part, 0).astype(np.float32) for part in (depth, rim))
    layers = layers_of(depth, rim_m=rim, spacing_px=(2, 5))
    image += rng.normal(0, 3, image.shape)
    return layers, image.clip(0, 255).astype(np.uint8), truth


def decided(layers, image, rims="image"):
    pictured = replace(layers, lab=None if image is None else lab(image))
    return accept_boundary_pixels(pictured, rims)


def test_rims_are_kept_on_the_side_where_the_image_has_them():
    layers, image, truth = scene()
    made = decided(layers, image)
    rims, kept = layers.rim_m > 0, made.depth_m > 0
    right = np.isclose(layers.rim_m, truth)
    assert (kept & rims & right).sum() > 0.15 * (rims & right).sum()
    assert (kept & rims & ~right).sum() < 0.04 * (rims & ~right).sum()
    assert np.array_equal(made.depth_m[layers.depth_m > 0], layers.depth_m[layers.depth_m > 0])
    assert np.array_equal(made.filled_m, made.depth_m)
    np.testing.assert_array_equal(made.rejected_m > 0, rims & ~kept)
    assert made.votes[kept & rims].min() > made.votes[rims & ~kept].max()


def test_without_an_image_rims_are_left_out():
    layers, image, _ = scene()
    for made in (decided(layers, None), decided(layers, image, "strict")):
        assert np.array_equal(made.depth_m, layers.depth_m)


@pytest.mark.parametrize("axis", [0, 1])
def test_an_image_that_lies_a_little_aside_adds_hardly_any_wrong_pixel(axis):
    layers, image, truth = scene()
    made = decided(layers, np.roll(image, 2, axis))
    wrong = (made.depth_m > 0) & ~np.isclose(made.depth_m, truth)
    assert wrong.sum() < 0.005 * (made.depth_m > 0).sum()
    assert wrong.sum() < 0.1 * ((layers.rim_m > 0) & ~np.isclose(layers.rim_m, truth)).sum()


def vote_twin(pixel, depth_m, known_m, tilt, colours, gap_px, surely):
    """One pixel, one direction, one step at a time."""
    height, width = gap_px.shape
    v, u = divmod(pixel, width)
    gap, least, doubt = gap_px[v, u], 1.0, stage._DOUBT if surely else 0.0
    aside = round(stage._ASIDE * gap) if surely else 0

    def colour(row, column):
        return colours[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(float)

    for right, down in ((0, 0), (aside, 0), (-aside, 0), (0, aside), (0, -aside)):
        votes_for, votes = doubt / 2, doubt
        for (u1, v1), (u2, v2) in DIRECTIONS.tolist():
            change, step = 0.0, 0
            while True:
                step += 1
                du, dv = step // 2 * u2 + step % 2 * u1, step // 2 * v2 + step % 2 * v1
                if not (0 <= u + du < width and 0 <= v + dv < height):
                    break
                if max(abs(du), abs(dv)) > stage.VOTERS_REACH * gap:
                    break
                off = colour(v + down + dv, u + right + du) - colour(v + down, u + right)
                change = max(change, off @ off)
                if known_m[v + dv, u + du]:
                    there = 1 / known_m[v + dv, u + du]
                    here = there - tilt[v + dv, u + du] @ (du, dv)
                    here = min(max(here, 0.7 * there), 1.4 * there)
                    one = 1 / (1 + step / (stage._DECAY * gap))
                    one *= np.exp(-change / (2 * stage._COLOURS**2)) + stage._THROUGH
                    votes += one
                    same_m = stage.HIDDEN_M + stage.HIDDEN_FRACTION * depth_m
                    votes_for += one * (abs(1 / here - depth_m) <= same_m)
                    break
        least = min(least, votes_for / votes if votes else 0.0)
    return least


@pytest.mark.parametrize("surely", [True, False])
def test_votes_equal_those_of_a_slow_twin(surely):
    rng = np.random.default_rng(3)
    shape = (24, 30)
    known = rng.uniform(size=shape) < 0.2
    known_m = np.where(known, 1 / rng.choice([0.05, 0.052, 0.1], shape), 0).astype(np.float32)
    tilt = rng.normal(0, 0.001, (*shape, 2)).astype(np.float32)
    gap_px = rng.uniform(1, 3, shape).astype(np.float32)
    colours = (50 + np.cumsum(rng.normal(0, 1, (*shape, 3)), axis=1)).astype(np.float32)
    layers = layers_of(known_m, tilt=tilt, spacing_px=np.repeat(gap_px[..., None], 2, axis=2))
    layers = replace(layers, lab=colours)
    pixel = np.concatenate([np.flatnonzero(known), np.flatnonzero(~known)[::5]])
    depth_m = np.where(known.flat[pixel], known_m.flat[pixel], np.float32(20)).astype(np.float32)
    inverse = np.divide(1, known_m, out=np.zeros_like(known_m), where=known)
    voters = Voters(first_known(known), inverse, tilt)
    share = vote(layers, voters, pixel, depth_m, surely)
    rest = (known_m, tilt, colours, gap_px, surely)
    expected = [vote_twin(p, z, *rest) for p, z in zip(pixel, depth_m, strict=True)]
    np.testing.assert_allclose(share, expected, rtol=1e-4)
    assert np.ptp(share) > 0.5
