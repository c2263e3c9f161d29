# SPDX-License-Identifier: MIT
"""Maps completed with the user's depth images: against exact depth, and what must stay empty."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from densify.depth.prior import complete, fit_prior
from densify.geometry.types import DepthMap, Prior

H, W, FOCAL_PX, HEIGHT_M = 150, 240, 200.0, 1.6
AUTO = "auto"


def scene():
    """True depth and sky: a road, a house at 20 m with a slanting wall, a car at 8 m."""
    row, column = np.mgrid[:H, :W].astype(float)
    down = (row - 60) / FOCAL_PX
    depth = np.where(down > 0, HEIGHT_M / np.maximum(down, 1e-6), np.inf)
    wall = 20 + 0.1 * column
    depth = np.where(row > 15, np.minimum(depth, wall), depth)
    depth[70:110, 60:120] = 8.0
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32), ~np.isfinite(depth)


TRUE_M, SKY = scene()
BLIND = SKY.copy()
BLIND[:50] = True  # above the scanner's top ring
BLIND[85:95, 100:140] = True
BLIND[120:130] = True


def measured(true_m=TRUE_M, seen=~BLIND):
    """A map that has every second pixel measured and the others filled."""
    first = np.where(seen, true_m, 0).astype(np.float32)
    depth = first.copy()
    depth[::2] = 0
    confidence = np.where(first > 0, 0.7, 0).astype(np.float32)
    return DepthMap("front", depth, first, confidence, np.where(depth > 0, 3, -1).astype(np.int32))


def prior(value, sky=SKY):
    return Prior(np.where(sky, 0, value).astype(np.float32), sky, "test")


def off(full, where):
    return np.abs(np.log(full.depth_m[where] / TRUE_M[where]))


SAFE = np.where(SKY, 1.0, TRUE_M)
VALUES = {
    "scaled": (0.3 * SAFE, "depth", 1 / 0.3, 0.0),
    "shifted": (3 * SAFE + 20, "depth", 1 / 3, -20 / 3),
    "inverse": (7 / SAFE + 0.4, "inverse", 1 / 7, -0.4 / 7),
    "power": (2 * SAFE**0.5, "log", 2.0, -2 * np.log(2)),
}


@pytest.mark.parametrize("name", VALUES)
def test_any_scale_shift_and_kind_is_undone_and_known_pixels_stay(name):
    value, kind, scale, shift = VALUES[name]
    maps = measured()
    full = complete(maps, prior(value), AUTO)
    assert full.fit.used and full.fit.residual < 1e-4
    if name != "scaled":  # which two forms say alike
        assert full.fit.kind == kind
        np.testing.assert_allclose([full.fit.scale, full.fit.shift], [scale, shift], rtol=1e-3)
    assert full.from_prior.sum() > 0.9 * (BLIND & ~SKY).sum()
    assert not (full.from_prior & (SKY | (maps.filled_m > 0))).any()
    assert off(full, full.from_prior).max() < 2e-3
    known = maps.filled_m > 0
    assert np.array_equal(full.depth_m[known], maps.filled_m[known])
    certain = 0.2 + 0.8 * maps.confidence
    np.testing.assert_allclose(full.confidence[known], certain[known], rtol=1e-6)
    assert ((full.depth_m > 0) == (known | full.from_prior)).all()
    of_prior = full.confidence[full.from_prior]
    assert of_prior.min() > 0 and of_prior.max() <= 0.2
    assert not full.confidence[full.depth_m == 0].any()


def test_where_a_prior_deviates_it_is_less_certain():
    right = np.arange(W) >= 120
    ragged = np.exp(0.1 * np.random.default_rng(0).standard_normal((H, W)))
    full = complete(measured(), prior(SAFE * np.where(right, ragged, 1)), AUTO)
    away = full.from_prior & (np.abs(np.arange(W) - 120) > 30)
    sure, unsure = (full.confidence[away & side] for side in (~right, right))
    assert np.percentile(sure, 10) > np.percentile(unsure, 90)


def test_a_correction_does_not_cross_depth_edges():
    """The prior has the car a tenth too near and all else a twentieth too far."""
    car = TRUE_M == 8.0
    value = SAFE * np.where(car, 0.9, 1.05)
    full = complete(measured(), prior(value), AUTO)
    for side in (car, ~car):
        here = full.from_prior & side
        assert here.sum() > 100 and np.median(off(full, here)) < 0.01
        assert np.percentile(off(full, here), 95) < 0.03


CLIPPED = np.where(SKY, 60, np.minimum(TRUE_M, 60))  # at the far limit of the prior
FAR, NO_SKY = 5 / np.where(SKY, 1e6, TRUE_M), np.zeros_like(SKY)


@pytest.mark.parametrize(
    ("value", "sky"), [(FAR, SKY), (FAR, NO_SKY), (CLIPPED, NO_SKY), (1 / CLIPPED, NO_SKY)]
)
def test_sky_stays_empty_by_mask_by_distance_and_at_the_far_limit(value, sky):
    full = complete(measured(), Prior(value.astype(np.float32), sky, "test"), AUTO)
    assert full.fit.used and not full.depth_m[SKY].any() and full.from_prior.sum() > 3000


def test_pixels_between_two_surfaces_are_left_out():
    value = cv2.GaussianBlur(1 / np.where(SKY, 1e4, TRUE_M), (0, 0), 3)
    full = complete(measured(), Prior(value.astype(np.float32), SKY, "test"), AUTO)
    sharp = complete(measured(), prior(SAFE), AUTO)
    wrong = full.from_prior & (np.abs(full.depth_m / np.where(SKY, 1, TRUE_M) - 1) > 0.2)
    assert wrong.sum() < 0.02 * full.from_prior.sum()
    assert 0.8 * sharp.from_prior.sum() < full.from_prior.sum() < sharp.from_prior.sum()


@pytest.mark.parametrize(
    "value",
    [
        np.random.default_rng(0).uniform(1, 50, (H, W)),
        SAFE[:, ::-1] * np.where(TRUE_M == 8, 4, 1),
        np.repeat(np.linspace(80, 3, H)[:, None], W, 1),
        -SAFE + 100,  # near is far
    ],
    ids=["noise", "another scene", "rows", "turned over"],
)
def test_what_does_not_fit_is_not_used(value):
    maps = measured()
    full = complete(maps, prior(np.maximum(value, 0.01)), "depth")
    assert not full.fit.used and not full.from_prior.any()
    assert full.depth_m.tobytes() == maps.filled_m.tobytes()
    assert (full.confidence[maps.filled_m > 0] > 0.2).all()
    assert not full.confidence[maps.filled_m == 0].any()


def test_too_few_measured_pixels_fit_nothing():
    p = np.linspace(1, 2, 99).astype(np.float32)
    assert not fit_prior(p, 3 * p, AUTO).used
    p = np.linspace(1, 2, 100).astype(np.float32)
    assert fit_prior(p, 3 * p, AUTO).used
    nothing = measured(np.zeros_like(TRUE_M))
    assert not complete(nothing, prior(SAFE), AUTO).depth_m.any()


def test_a_tenth_of_wrong_pixels_does_not_bend_the_curve():
    rng = np.random.default_rng(0)
    z = rng.uniform(3, 60, 20_000)
    p = 5 / z + 0.1
    p[rng.random(len(p)) < 0.1] *= 3
    fit = fit_prior(p.astype(np.float32), z.astype(np.float32), AUTO)
    assert fit.kind == "inverse" and fit.used
    np.testing.assert_allclose([fit.scale, fit.shift], [1 / 5, -0.1 / 5], rtol=0.03)
