# SPDX-License-Identifier: MIT
"""Holes filled from the known pixels all round: exact on planes, never across a step, by a slow
twin, and what it must leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import ProjectSettings
from densify.depth import stars
from densify.depth.layers import Layers
from densify.depth.marching import DIRECTIONS, first_known
from densify.depth.star import fill_stars
from densify.geometry import threads

SHAPE = (60, 80)
SETTINGS = ProjectSettings(star_reach=4)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
TILTED = 1 / (0.1 + 5e-4 * (COLUMN - 40) + 8e-4 * (ROW - 30))  # m, a plane


TILT = (5e-4, 8e-4)  # its slope


def layers_of(filled_m, confidence=0.6, spacing_px=(2.0, 4.0), tilt=(0.0, 0.0)):
    """All known pixels measured."""
    filled_m = np.ascontiguousarray(filled_m, np.float32)
    known = filled_m > 0
    return Layers(
        depth_m=filled_m,
        rim_m=np.zeros(SHAPE, np.float32),
        veiled=np.zeros(SHAPE, bool),
        refused=np.zeros(SHAPE, bool),
        filled_m=filled_m,
        confidence=np.where(known, confidence, 0).astype(np.float32),
        point=np.where(known, 0, -1).astype(np.int32),
        tilt=np.broadcast_to(np.float32(tilt), (*SHAPE, 2)).copy(),
        spacing_px=np.broadcast_to(np.float32(spacing_px), (*SHAPE, 2)).copy(),
    )


def disc(radius_px, row=30, column=40):
    return (ROW - row) ** 2 + (COLUMN - column) ** 2 <= radius_px**2


def test_a_hole_in_a_plane_gets_the_planes_depth():
    hole = disc(9) | ((ROW == 44) & (COLUMN > 10))  # such as between a scanner's two blocks
    layers = layers_of(np.where(hole, 0, TILTED), tilt=TILT)
    filled = fill_stars(layers, SETTINGS)
    assert (filled.filled_m > 0).all()
    np.testing.assert_allclose(filled.filled_m, TILTED, rtol=2e-3)
    np.testing.assert_array_equal(filled.filled_m[~hole], layers.filled_m[~hole])
    np.testing.assert_array_equal(filled.depth_m, layers.depth_m)
    np.testing.assert_allclose(filled.confidence[hole], 0.6 * SETTINGS.fill_confidence)


def test_slopes_of_filled_pixels_come_from_those_around():
    hole = disc(7)
    layers = layers_of(np.where(hole, 0, TILTED), tilt=TILT)
    sparse = np.random.default_rng(8).random(SHAPE) < 0.2
    layers = replace(
        layers,
        depth_m=np.where(sparse, layers.depth_m, np.float32(0)),
        tilt=np.where(sparse[..., None], layers.tilt, np.float32(0)),
    )
    filled = fill_stars(layers, SETTINGS).filled_m
    assert (filled[hole] > 0).all()
    np.testing.assert_allclose(filled[hole], TILTED[hole], rtol=2e-3)


def test_the_comb_at_the_lower_border_is_closed_and_nothing_below_it():
    teeth = np.where(COLUMN % 6 == 0, 50, 42)
    filled = fill_stars(layers_of(np.where(teeth > ROW, TILTED, 0), tilt=TILT), SETTINGS)
    between = (ROW < 48) & (COLUMN > 0) & (COLUMN < 78)
    np.testing.assert_allclose(filled.filled_m[between], TILTED[between], rtol=5e-3)
    assert not filled.filled_m[ROW >= 50].any()


@pytest.mark.parametrize("height_px", [1, 3, 6])
def test_a_strip_along_the_lower_border_is_closed_and_none_along_the_others(height_px):
    around = np.minimum(np.minimum(ROW, COLUMN), COLUMN[:, ::-1]) < height_px
    strip = (ROW[::-1] < height_px) & (COLUMN > 20) & (COLUMN < 60)
    layers = layers_of(np.where((ROW[::-1] < height_px) | around, 0, TILTED), tilt=TILT)
    filled = fill_stars(layers, SETTINGS).filled_m
    np.testing.assert_allclose(filled[strip], TILTED[strip], rtol=2e-3)
    assert not filled[around & (ROW < 50)].any()


def test_a_higher_strip_stays_empty():
    layers = layers_of(np.where(ROW < 53, TILTED, 0), tilt=TILT)
    np.testing.assert_array_equal(fill_stars(layers, SETTINGS).filled_m, layers.filled_m)


@pytest.mark.parametrize("edge", ["column", "row", "diagonal"])
@pytest.mark.parametrize("width_px", [1, 3, 8])
def test_no_depth_edge_is_crossed(edge, width_px):
    along = {"column": COLUMN - 40, "row": ROW - 30, "diagonal": (COLUMN - 40 + ROW - 30) / 1.4}
    side = along[edge]
    depth_m = np.where(side < 0, 8.0, 9.0)
    strip = np.abs(side + 0.1) < width_px / 2 + 0.5
    filled = fill_stars(layers_of(np.where(strip, 0, depth_m)), SETTINGS)
    new = strip & (filled.filled_m > 0)
    inner = (ROW > 12) & (ROW < 48) & (COLUMN > 12) & (COLUMN < 68)
    assert not (new & inner).any()
    wrong = np.abs(filled.filled_m / depth_m - 1) > 0.05
    assert not (new & wrong).any()


def test_what_known_pixels_do_not_surround_is_left():
    layers = layers_of(np.where(ROW < 30, TILTED, 0), tilt=TILT)
    np.testing.assert_array_equal(fill_stars(layers, SETTINGS).filled_m, layers.filled_m)
    corner = layers_of(np.where((ROW < 30) | (COLUMN < 20), 10.0, 0))
    filled = fill_stars(corner, SETTINGS).filled_m
    assert not filled[((ROW > 46) & (COLUMN > 20)) | ((ROW > 30) & (COLUMN > 36))].any()


def test_holes_wider_than_the_reach_are_left():
    layers = layers_of(np.where(disc(20), 0, TILTED), tilt=TILT)
    filled = fill_stars(layers, replace(SETTINGS, star_reach=3))
    assert not filled.filled_m[disc(6)].any()


def test_a_fence_is_no_wall():
    """Wires 6 m away, and between them what lies 11 m away."""
    wire = (COLUMN % 8 < 2) | (ROW % 10 < 2)
    behind = (COLUMN % 8 == 5) & (ROW % 10 == 6)
    layers = layers_of(np.where(wire, 6.0, np.where(behind, 11.0, 0)))
    hole = ~wire & ~behind & (ROW > 5) & (ROW < 55) & (COLUMN > 5) & (COLUMN < 75)
    filled = fill_stars(layers, SETTINGS).filled_m > 0
    assert filled[hole].mean() < 0.25
    assert (fill_stars(layers_of(np.where(wire, 6.0, 0)), SETTINGS).filled_m > 0)[hole].all()


def test_an_empty_map_stays_empty():
    assert not fill_stars(layers_of(np.zeros(SHAPE)), SETTINGS).filled_m.any()


def ragged(rng):
    """A plane, a nearer block, and holes of all sizes."""
    depth_m = np.where((COLUMN > 50) & (ROW > 20), 6.0, TILTED * rng.uniform(0.99, 1.01, SHAPE))
    return np.where((rng.random(SHAPE) < 0.5) | disc(8), 0, depth_m)


def test_threads_change_no_byte(monkeypatch):
    layers, results = layers_of(ragged(np.random.default_rng(6))), []
    for cores in (1, 3):
        monkeypatch.setattr(threads, "num_threads", lambda cores=cores: cores)
        monkeypatch.setattr(threads, "_LEAST_ROWS", 64)
        filled = fill_stars(layers, SETTINGS)
        results.append(filled.filled_m.tobytes() + filled.confidence.tobytes())
    assert results[0] == results[1]


def twin(row, column, inverse, slope, known, rules, spacing_px):
    """Depth and confidence of one pixel, zeros where the known ones around do not agree."""
    met, given = [], []
    for single, double in DIRECTIONS:
        met.append(False)
        for k in range(1, 255):
            du, dv = (k // 2) * double + (k % 2) * single
            if not (0 <= row + dv < SHAPE[0] and 0 <= column + du < SHAPE[1]):
                break
            there = inverse[row + dv, column + du]
            if there > 0:
                if np.hypot(du, dv) <= rules.reach * max(spacing_px):
                    met[-1] = True
                    w = there - slope[row + dv, column + du] @ (du, dv)
                    w = np.clip(w, 0.7 * there, 1.4 * there)
                    given.append((w, 1 / k, known[row + dv, column + du]))
                break
    if not given:
        return 0.0, 0.0
    w, weight, confidence = np.array(given).T
    above = inverse[row::-1, column] > 0
    along = 2 * (above.any() and SHAPE[0] - 1 - row + above.argmax() <= rules.strip_px)
    runs = "".join("01"[m] for m in met) * 2
    if len(given) < rules.met - along or "0" * (rules.gap + along + 1) in runs:
        return 0.0, 0.0
    mean = np.average(w, weights=weight)
    if np.ptp(w) > rules.fraction * mean:
        return 0.0, 0.0
    return 1 / mean, confidence.min()


def test_stars_equal_those_of_a_slow_twin():
    rng = np.random.default_rng(7)
    depth_m = ragged(rng)
    known = np.where(depth_m > 0, rng.random(SHAPE), 0).astype(np.float32)
    inverse = np.divide(1, depth_m, out=np.zeros(SHAPE), where=depth_m > 0).astype(np.float32)
    slope = rng.normal(0, 2e-4, (*SHAPE, 2)).astype(np.float32)
    spacing_px = np.broadcast_to(np.float32([2, 3]), (*SHAPE, 2)).copy()
    pixel = np.flatnonzero(depth_m == 0)
    found = np.zeros((2, len(pixel)), np.float32)
    rules = stars.Rules(reach=3.0, met=9, gap=5, fraction=0.04, strip_px=4)
    stars.between(
        0, len(pixel), pixel, first_known(depth_m > 0), DIRECTIONS, inverse,
        slope.reshape(-1, 2), known, spacing_px, rules, found,
    )  # fmt: skip
    for p, got in zip(pixel, found.T, strict=True):
        expected = twin(*divmod(p, SHAPE[1]), inverse, slope, known, rules, (2, 3))
        np.testing.assert_allclose(got, expected, rtol=1e-4, err_msg=str(p))
    assert 0.2 < (found[0] > 0).mean() < 0.8


@pytest.mark.parametrize("beyond_m", [30.0, 0.02, 5e3])
def test_slopes_are_those_of_the_surface_alone(beyond_m):
    """A plane beside a step: what lies beyond does not tilt it, nor it what lies beyond."""
    depth_m = np.where(COLUMN < 40, TILTED, beyond_m)
    inverse = (1 / depth_m).astype(np.float32)
    slope, spacing_px = np.zeros((inverse.size, 2), np.float32), np.ones((*SHAPE, 2), np.float32)
    for column, true in ((39, (5e-4, 8e-4)), (40, (0.0, 0.0))):
        pixel = np.flatnonzero((column == COLUMN) & (ROW > 5) & (ROW < 55))
        stars.slopes(0, len(pixel), pixel, inverse, spacing_px, 0.05, slope)
        np.testing.assert_allclose(slope[pixel], [true] * len(pixel), rtol=0.05)
