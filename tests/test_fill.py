# SPDX-License-Identifier: MIT
"""Pixels added between measured ones: votes, boundary pixels, windows, stars, spots of lasers.

Planes and panels known exactly, slow twins, and what must stay empty.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from densify.depth import fill as stage
from densify.depth.exposure import PointsInImage
from densify.depth.fill import (
    DIRECTIONS,
    accept_boundary_pixels,
    fill,
    fill_stars,
    measure_spots,
    votes_for,
)
from densify.depth.patches import HIDDEN_FRACTION, HIDDEN_M
from tests.depth_scenes import record_of

SHAPE = (60, 80)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
TILT = (5e-4, 8e-4)
TILTED = 1 / (0.1 + TILT[0] * (COLUMN - 40) + TILT[1] * (ROW - 30))  # m, a plane
SMALL = (24, 30)  # shape of images for slow twins


def vote_twin(record, pixel, depth_m, surely):
    """One pixel, one direction, one step at a time."""
    height, width = SMALL
    v, u = divmod(pixel, width)
    gap, least, doubt = record.gap_px[v, u], 1.0, stage._DOUBT if surely else 0.0
    aside = round(stage._SHIFT * gap) if surely else 0

    def colour(row, column):
        row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
        return record.lab[row, column].astype(float)

    for right, down in ((0, 0), (aside, 0), (-aside, 0), (0, aside), (0, -aside)):
        votes_for, all_votes = doubt / 2, doubt
        for (u1, v1), (u2, v2) in DIRECTIONS.tolist():
            change = 0.0
            for step in range(1, 200):
                du, dv = step // 2 * u2 + step % 2 * u1, step // 2 * v2 + step % 2 * v1
                if not (0 <= u + du < width and 0 <= v + dv < height):
                    break
                if max(abs(du), abs(dv)) > stage.VOTERS_REACH * gap:
                    break
                off = colour(v + down + dv, u + right + du) - colour(v + down, u + right)
                change = max(change, off @ off)
                if record.depth_m[v + dv, u + du]:
                    known = 1 / record.depth_m[v + dv, u + du]
                    predicted = known - record.tilt[v + dv, u + du] @ (du, dv)
                    predicted = min(max(predicted, known / 1.4), 1.4 * known)
                    weight = np.exp(-change / (2 * stage._COLOURS**2)) + stage._ACROSS_EDGE
                    weight /= 1 + step / (stage._DECAY * gap)
                    same_m = HIDDEN_M + HIDDEN_FRACTION * depth_m
                    all_votes += weight
                    votes_for += weight * (abs(1 / predicted - depth_m) <= same_m)
                    break
        least = min(least, votes_for / all_votes if all_votes else 0.0)
    return least


@pytest.mark.parametrize("surely", [True, False])
def test_votes_equal_those_of_a_slow_twin(surely):
    rng = np.random.default_rng(3)
    known = rng.uniform(size=SMALL) < 0.2
    known_m = np.where(known, 1 / rng.choice([0.05, 0.052, 0.1], SMALL), 0).astype(np.float32)
    gap_px = rng.uniform(1, 3, SMALL)
    tilt = rng.normal(0, 0.001, (*SMALL, 2))
    record = record_of(known_m, tilt=tilt, spacing_px=np.repeat(gap_px[..., None], 2, axis=2))
    record.lab = (50 + np.cumsum(rng.normal(0, 1, (*SMALL, 3)), axis=1)).astype(np.float32)
    pixel = np.concatenate([np.flatnonzero(known), np.flatnonzero(~known)[::5]])
    depth_m = np.where(known.flat[pixel], known_m.flat[pixel], np.float32(20)).astype(np.float32)
    share = votes_for(record, [record.depth_m], pixel, depth_m, surely)
    expected = [vote_twin(record, p, z, surely) for p, z in zip(pixel, depth_m, strict=True)]
    np.testing.assert_allclose(share, expected, rtol=1e-4)
    assert np.ptp(share) > 0.5


def panels():
    """A record of a dozen panels before a wall, and the true depth.

    A third of the pixels is measured. Panels reach 3 px beyond their outline, as wide beams make
    them, and are boundary pixels from there to 3 px inside.
    """
    rng, shape, fat_px = np.random.default_rng(0), (200, 320), 3
    v, u = np.mgrid[: shape[0], : shape[1]]
    truth = np.full(shape, 20, np.float32)
    depth, boundary, image = truth.copy(), np.zeros_like(truth), np.full((*shape, 3), 110.0)
    for left, top in ((20 + 75 * i, 15 + 62 * j) for j in range(3) for i in range(4)):
        width, height, z = rng.integers(20, 45), rng.integers(25, 40), rng.uniform(6, 12)
        beyond = np.maximum(
            np.maximum(left - u, u - left - width + 1), np.maximum(top - v, v - top - height + 1)
        )
        truth[beyond <= 0], image[beyond <= 0] = z, rng.uniform(20, 250, 3)
        fat = (beyond > -fat_px) & (beyond <= fat_px)
        depth[fat], boundary[fat] = 0, z
        depth[beyond <= -fat_px] = z
    known = rng.uniform(size=shape) < 0.33
    image = (image + rng.normal(0, 3, image.shape)).clip(0, 255).astype(np.uint8)
    return record_of(known * depth, None, known * boundary, (2, 5), image=image), truth


def test_boundary_pixels_are_kept_on_the_side_where_the_image_has_them():
    record, truth = panels()
    measured = record.depth_m.copy()
    accept_boundary_pixels(record, "image")
    boundary, kept = record.boundary_m > 0, record.depth_m > 0
    right = np.isclose(record.boundary_m, truth)
    assert (kept & boundary & right).sum() > 0.15 * (boundary & right).sum()
    assert (kept & boundary & ~right).sum() < 0.04 * (boundary & ~right).sum()
    assert np.array_equal(record.depth_m[measured > 0], measured[measured > 0])
    assert np.array_equal(record.filled_m, record.depth_m)
    np.testing.assert_array_equal(record.rejected_m > 0, boundary & ~kept)
    assert record.votes[kept & boundary].min() > record.votes[boundary & ~kept].max()


@pytest.mark.parametrize(("rims", "with_image"), [("image", False), ("strict", True)])
def test_without_an_image_boundary_pixels_are_left_out(rims, with_image):
    record, _ = panels()
    measured = record.depth_m.copy()
    record.lab = record.lab if with_image else record.lab[:0, :0]
    accept_boundary_pixels(record, rims)
    assert np.array_equal(record.depth_m, measured)


def made(stage, record, *arguments):
    """The record after a stage."""
    stage(record, *arguments)
    return record


def filled_between(depth_m, reach_px):
    """The map filled by windows of one largest size, without votes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "_reject_unconfirmed", lambda *_: None)
        return made(fill, record_of(depth_m, spacing_px=reach_px), 1.0)


def test_fill_of_a_plane_is_exact_and_keeps_what_was_measured():
    measured = np.random.default_rng(4).uniform(size=SHAPE) < 0.4
    record = filled_between(np.where(measured, TILTED, 0), (2, 3))
    assert np.array_equal(record.filled_m[measured], record.depth_m[measured])
    added = (record.filled_m > 0) & ~measured
    assert added.sum() > 0.9 * (~measured[4:-4, 4:-4]).sum()
    off = np.abs(record.filled_m[added] / TILTED[added] - 1)
    assert np.median(off) < 1e-3 and off.max() < 0.1
    np.testing.assert_allclose(np.median(record.tilt[added], axis=0), TILT, rtol=0.05)


def two_sided_twin(measured, reach_u, reach_v):
    result = np.zeros(measured.shape, bool)
    for v, u in zip(*np.nonzero(~measured), strict=True):
        around = [
            (q - u, p - v)
            for p in range(max(0, v - reach_v), min(len(measured), v + reach_v + 1))
            for q in range(max(0, u - reach_u), min(measured.shape[1], u + reach_u + 1))
            if measured[p, q]
        ]
        du, dv = {d for d, _ in around}, {d for _, d in around}
        result[v, u] = min(du, default=0) < 0 < max(du, default=0) and (
            min(dv, default=0) < 0 < max(dv, default=0)
        )
    return result


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.6), st.sampled_from([(2, 3), (1, 1), (3, 1)]))
@settings(max_examples=15, deadline=None)
def test_two_sided_rule_equals_a_slow_twin(seed, share, reach):
    measured = np.random.default_rng(seed).uniform(size=(20, 25)) < share
    depth = measured.astype(np.float32) * 7
    filled = filled_between(depth, reach).filled_m
    assert np.array_equal((filled > 0) & ~measured, two_sided_twin(measured, *reach))
    assert np.allclose(filled[filled > 0], 7)


@pytest.mark.parametrize("step", [1.3, 2.0, 5.0])
def test_no_depth_is_invented_between_two_surfaces(step):
    rng = np.random.default_rng(5)
    depth = np.where(np.arange(40) < 20, 10.0, 10.0 * step) * np.ones((30, 1))
    sparse = np.where(rng.uniform(size=depth.shape) < 0.5, depth, 0).astype(np.float32)
    filled = filled_between(sparse, (2, 3)).filled_m
    assert set(np.unique(np.round(filled, 3))) <= {0.0, 10.0, np.float32(10 * step)}
    assert (filled[5:25, 5:15] > 0).mean() > 0.95


def test_windows_reach_as_far_as_rays_lie_apart_there():
    """Rings 3 px apart on the left and 12 px on the right: both are closed, neither beyond."""
    left = COLUMN < 40
    rings = np.where(left, ROW % 3 == 0, ROW % 12 == 0) & (ROW < 49)
    spacing = np.where(left[..., None], [1, 3], [1, 12])
    filled = made(fill, record_of(rings * 10.0, spacing_px=spacing), 1.0).filled_m
    assert (filled[1:48, 2:38] > 0).all() and (filled[1:48, 42:-2] > 0).all()
    assert not filled[49:].any()
    narrow = made(fill, record_of(rings * 10.0, spacing_px=(1, 3)), 1.0).filled_m
    assert (narrow[1:48, 42:-2] > 0).mean() < 0.6


def test_a_pillar_with_few_measured_pixels_is_not_filled_over():
    """Before a wall at 20 m: a few returns at 5 m, too near to its edges to be accepted."""
    wall = np.where(np.arange(SHAPE[1]) % 3 == 0, 20.0, 0.0) * np.ones(SHAPE)
    wall[:, 40:45] = 0
    boundary_m = np.zeros(SHAPE)
    boundary_m[::4, 42] = 5
    inside, pillar = np.s_[10:50, 41:44], np.s_[10:50, 42]
    assert (made(fill, record_of(wall), 1.5).filled_m[inside] > 0).all()
    record = made(fill, record_of(wall, boundary_m=boundary_m), 1.5)
    assert not record.filled_m[pillar].any() and (record.rejected_m[pillar] == 20).any()


def test_a_fence_is_no_wall():
    """Wires 6 m away, and between them something 11 m away."""
    wire = (COLUMN % 8 < 2) | (ROW % 10 < 2)
    behind = (COLUMN % 8 == 5) & (ROW % 10 == 6)
    hole = ~wire & ~behind & (ROW > 5) & (ROW < 55) & (COLUMN > 5) & (COLUMN < 75)

    def filled(depth_m):
        return made(fill_stars, record_of(depth_m, spacing_px=(8, 16))).filled_m[hole] > 0

    assert filled(np.where(wire, 6.0, np.where(behind, 11.0, 0))).mean() < 0.25
    assert filled(np.where(wire, 6.0, 0)).all()


def star_twin(record, row, column):
    """Depth of one pixel, 0 where the known pixels around do not agree."""
    met, predictions = [], []
    for single, double in DIRECTIONS:
        met.append(False)
        for k in range(1, 255):
            du, dv = (k // 2) * double + (k % 2) * single
            if not (0 <= row + dv < SMALL[0] and 0 <= column + du < SMALL[1]):
                break
            if record.depth_m[row + dv, column + du]:
                if np.hypot(du, dv) <= 7:
                    met[-1] = True
                    known = 1 / record.depth_m[row + dv, column + du]
                    w = known - record.tilt[row + dv, column + du] @ (du, dv)
                    predictions.append((np.clip(w, 0.7 * known, 1.4 * known), 1 / k))
                break
    if not predictions:
        return 0.0
    w, weight = np.array(predictions).T
    mean = np.average(w, weights=weight)
    gap = "0" * 8 in "".join("01"[m] for m in met) * 2
    return 0.0 if len(w) < 8 or gap or np.ptp(w) > 0.1 * mean else 1 / mean


def test_stars_equal_those_of_a_slow_twin(monkeypatch):
    rng = np.random.default_rng(7)
    plane_m = TILTED[: SMALL[0], : SMALL[1]] * rng.uniform(0.99, 1.01, SMALL)
    row, column = np.mgrid[: SMALL[0], : SMALL[1]]
    depth_m = np.where((column > 20) & (row > 10), 6.0, plane_m)
    hole = (row - 12) ** 2 + (column - 10) ** 2 <= 25
    depth_m[(rng.random(SMALL) < 0.5) | hole] = 0
    tilt = rng.normal(0, 2e-4, (*SMALL, 2))
    record = record_of(depth_m, spacing_px=(3, 7), tilt=tilt)
    monkeypatch.setattr(stage, "_reject_unconfirmed", lambda *_: None)
    fill_stars(record)
    for row, column in zip(*np.nonzero(depth_m == 0), strict=True):
        expected = star_twin(record, row, column)
        np.testing.assert_allclose(record.filled_m[row, column], expected, rtol=1e-4)
    assert 0.2 < (record.filled_m > 0)[depth_m == 0].mean() < 0.95


PLANE = (1 / (0.1 + 2e-4 * COLUMN - 3e-4 * ROW)).astype(np.float32)[:24, :32]


def measured_at(uv, spacing_px):
    """A filled plane, measured where the points ``uv`` (K,2) fall."""
    uv = np.asarray(uv, float)
    num, tilt = len(uv), (2e-4, -3e-4)
    spacing = np.broadcast_to(np.asarray(spacing_px, float), num)
    column, row = np.rint(uv).astype(int).T
    measured, index = np.zeros(PLANE.shape, bool), 3 * np.arange(num) + 1  # others are outside
    measured[row, column], nothing = True, np.zeros(num, np.int64)
    points = PointsInImage(
        *(index, uv, PLANE[row, column], 1 / PLANE[row, column].astype(float)),
        *(np.ones((num, 2)), np.tile(tilt, (num, 1))),
        *(np.stack([spacing, 9 * spacing], 1), nothing, nothing, nothing > 0),
    )
    record = record_of(PLANE, measured, tilt=tilt, points=points)
    record.point[row, column] = index
    return record


def test_pixels_whose_middle_the_spot_covers_are_measured():
    rng = np.random.default_rng(5)
    cells = np.stack(np.meshgrid(np.arange(2, 30, 4), np.arange(2, 22, 5)), -1).reshape(-1, 2)
    uv = cells + rng.uniform(-0.5, 0.5, cells.shape)
    before, record = (measured_at(uv, np.linspace(1, 8, len(uv))) for _ in range(2))
    measure_spots(record)
    radius_px = 0.35 * record.points.spacing_px[:, 0]
    for v, u in np.ndindex(PLANE.shape):
        away_px = np.hypot(*(uv - [u, v]).T)
        covers = away_px <= radius_px
        assert (record.depth_m[v, u] > 0) == (before.depth_m[v, u] > 0 or covers.any())
        if before.depth_m[v, u] > 0:
            assert record.point[v, u] == before.point[v, u]
        elif covers.any():
            nearest = np.flatnonzero(covers)[np.argmin(away_px[covers])]
            assert record.point[v, u] == record.points.rows[nearest]
    known = record.depth_m > 0
    assert known.sum() > 2 * len(uv)
    np.testing.assert_array_equal(record.depth_m[known], PLANE[known])


def test_spots_do_not_cover_holes_or_other_surfaces():
    record = measured_at([[16, 12]], 6.0)
    record.filled_m[:, 17:] = 0  # an edge, which nothing was filled across
    record.filled_m[:, :16] += np.float32(0.5)  # and another surface
    measure_spots(record)
    row, column = np.mgrid[:24, :32]
    np.testing.assert_array_equal(record.depth_m > 0, (np.abs(row - 12) <= 2) & (column == 16))


def test_right_before_the_lens_a_spot_does_not_fill_the_image():
    record = measured_at([[16, 12]], 1e6)
    measure_spots(record)
    assert (record.depth_m > 0).sum() == 49  # radius 4
