# SPDX-License-Identifier: MIT
"""Filling as far as rays lie apart, and what the image says of it; the window's rules are tested in
test_project.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import ProjectSettings
from densify.depth.fill import fill, fill_between, without_shreds
from densify.depth.layers import Layers
from densify.depth.picture import lab

SHAPE = (90, 120)


def layers_of(depth, spacing_px, image=None):
    depth = depth.astype(np.float32)
    return Layers(
        depth_m=depth,
        rim_m=np.zeros_like(depth),
        veiled=np.zeros(SHAPE, bool),
        refused=np.zeros(SHAPE, bool),
        filled_m=depth,
        confidence=(depth > 0) * np.float32(0.8),
        point=np.where(depth > 0, 0, -1).astype(np.int32),
        tilt=np.zeros((*depth.shape, 2), np.float32),
        spacing_px=np.ascontiguousarray(np.broadcast_to(np.float32(spacing_px), (*SHAPE, 2))),
        lab=None if image is None else lab(image),
    )


def test_windows_reach_as_far_as_rays_lie_apart_there():
    """Rings 3 px apart on the left and 12 px on the right: both are closed, neither beyond."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    left = u < 60
    rings = np.where(left, v % 3 == 0, v % 12 == 0) & (v < 61)
    spacing = np.where(left[..., None], [1, 3], [1, 12])
    filled = fill(layers_of(rings * 10.0, spacing), ProjectSettings(fill_reach=1.0)).filled_m
    assert (filled[1:60, 2:58] > 0).all() and (filled[1:60, 62:-2] > 0).all()
    assert not filled[61:].any()
    narrow = fill(layers_of(rings * 10.0, (1, 3)), ProjectSettings(fill_reach=1.0)).filled_m
    assert (narrow[1:60, 62:-2] > 0).mean() < 0.6


def test_filling_does_not_know_how_large_pixels_are():
    """Twice the resolution, twice the spacing: the same is filled."""
    rng = np.random.default_rng(2)
    depth = np.where(rng.uniform(size=(40, 50)) < 0.15, 10.0, 0).astype(np.float32)
    wide = np.zeros((80, 100), np.float32)
    wide[::2, ::2] = depth

    def share(of, spacing):
        spacing_px = np.full((*of.shape, 2), spacing, np.float32)
        filled, _ = fill_between(of, of / 10, spacing_px, 1.5, 0.2, 0.05, 0.5)
        return (filled > 0).mean()

    assert abs(share(depth, (2, 4)) - share(wide, (4, 8))) < 0.06


def test_the_image_lets_the_fill_come_closer_to_an_edge():
    """A post before a wall: without an image the other surface's votes keep the edge empty."""
    depth = np.full(SHAPE, 20.0)
    depth[:, 50:70] = 10.0
    known = np.random.default_rng(0).uniform(size=SHAPE) < 0.3
    sparse = np.where(known, depth, 0)
    image = np.full((*SHAPE, 3), 200, np.uint8)
    image[:, 50:70] = (40, 60, 90)
    settings = ProjectSettings(edge_m=10.0)  # planes through both surfaces are tried

    def closed(image):
        """Shares of the empty pixels at the edges that are filled, and of those the wrong ones."""
        filled = fill(layers_of(sparse, (4, 4), image), settings).filled_m
        assert np.array_equal(filled[known], sparse[known].astype(np.float32))
        edges = np.zeros(SHAPE, bool)
        edges[4:-4, [47, 48, 49, 50, 51, 52, 67, 68, 69, 70, 71, 72]] = True
        here = edges & ~known
        wrong = np.abs(filled - depth) > 1.5
        return (filled[here] > 0).mean(), wrong[here & (filled > 0)].mean()

    (share, wrong), (share_without, wrong_without) = closed(image), closed(None)
    assert share > 1.5 * share_without
    assert wrong < 0.01 and wrong_without < 0.05


def test_confidence_covers_what_is_filled():
    rng = np.random.default_rng(1)
    layers = layers_of(np.where(rng.uniform(size=SHAPE) < 0.1, 12.0, 0), (3, 6))
    made = fill(replace(layers, confidence=layers.confidence), ProjectSettings())
    assert np.array_equal(made.confidence > 0, made.filled_m > 0)
    assert np.array_equal(made.depth_m, layers.depth_m)


def test_streaks_go_and_surfaces_stay():
    """Rays 12 px apart: of what is around lines 6 px apart less than a fifth is known."""
    layers = layers_of(np.zeros(SHAPE), (12, 12))
    layers.depth_m[40, 10] = layers.depth_m[60, 100] = 10
    filled = np.where(layers.depth_m > 0, layers.depth_m, 0)
    filled[5:35:6, 10:100] = 10
    filled[50:80, 20:60] = 10
    kept = without_shreds(replace(layers, filled_m=filled))
    assert not kept.filled_m[:38].any()
    assert (kept.filled_m[50:80, 20:60] > 0).all()
    assert kept.depth_m[40, 10] and kept.filled_m[60, 100]  # what is measured may stand alone


def test_a_pillar_of_which_little_was_measured_is_not_filled_over():
    """Before a wall at 20 m: a few returns at 5 m, too near to its edges to be accepted."""
    wall = np.where(np.arange(SHAPE[1]) % 3 == 0, 20.0, 0.0) * np.ones(SHAPE)
    wall[:, 58:63] = 0
    plain = layers_of(wall, (3, 3))
    rims = np.zeros(SHAPE, np.float32)
    rims[::4, 60] = 5
    knobs = ProjectSettings()
    assert (fill(plain, knobs).filled_m[10:80, 59:62] > 0).all()
    assert not fill(replace(plain, rim_m=rims), knobs).filled_m[10:80, 60].any()
    veiled = replace(plain, rim_m=rims, veiled=rims > 0)  # nobody knows which of the two it is
    assert (fill(veiled, knobs).filled_m[10:80, 59:62] > 0).all()
