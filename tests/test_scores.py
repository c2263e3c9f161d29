# SPDX-License-Identifier: MIT
"""Ghosts that were planted, and their rates worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from densify.free_space.range_image import RangeImage
from densify.geometry.types import Cloud
from densify.scores.metrics import ghost_rate, ghost_scores
from tests.depth_scenes import KEY, make_cloud, registered


def image_of(points: np.ndarray) -> RangeImage:
    """The range image of the key sweep."""
    return RangeImage.of(registered(KEY, points, np.eye(4), np.zeros(6)))


def room(range_m: float = 20.0) -> np.ndarray:
    """A sphere around the key sweep, in steps of 0.5 x 1 degree."""
    azimuth, elevation = np.radians(np.mgrid[-180:180:0.5, -15:16]).reshape(2, -1)
    forward = np.cos(elevation)
    axes = forward * np.cos(azimuth), forward * np.sin(azimuth), np.sin(elevation)
    return range_m * np.column_stack(axes)


def panel(distance_m: float) -> np.ndarray:
    y, z = np.mgrid[-1:1:10j, -1:1:10j].reshape(2, -1)
    return np.column_stack([np.full(100, distance_m), y, z])


def cloud_of(*parts: tuple[np.ndarray, int, bool]) -> Cloud:
    """parts: (points, frame, moving)."""
    points, frames, moving = zip(*parts, strict=True)
    sizes = [len(part) for part in points]
    cloud = make_cloud(np.concatenate(points), np.repeat(frames, sizes))
    return replace(cloud, moving=np.repeat(moving, sizes))


def test_ghosts_need_the_margin():
    for range_m, distance_m, rate in (
        (20, 19.2, 1),
        (20, 20.5, 0),
        (20, 40, 0),
        (100, 98.5, 0),  # 2 % of 100 m counts beyond half a metre
        (100, 97.0, 1),
    ):
        image = image_of(room(range_m))
        assert ghost_rate(cloud_of((panel(distance_m), KEY + 1, False)), image, KEY) == rate


def test_the_key_sweep_itself_and_an_unseen_direction_hold_no_ghosts():
    image = image_of(room())
    assert ghost_rate(cloud_of((room(), KEY + 1, False)), image, KEY) == 0
    above = panel(1.0)[:, [1, 2, 0]] * [0.1, 0.1, 5.0]
    scores = ghost_scores(cloud_of((above, KEY + 1, False)), image, KEY)
    assert scores["all"] == 0 and scores["unjudged"]["static"] == 1
    assert ghost_rate(cloud_of((panel(10.0), KEY, False)), image, KEY) is None


def test_ghost_scores_by_kind_and_distance_without_what_lies_beyond_the_window():
    image, n = image_of(room()), len(room())
    cloud = cloud_of(
        (panel(10.0), KEY - 2, True),
        (panel(20.5), KEY + 2, True),
        (room(), KEY + 1, False),
        (panel(10.0), KEY, False),
        (panel(10.0), KEY + 3, False),
    )
    cloud = replace(cloud, far=cloud.frame == KEY + 3)
    scores = ghost_scores(cloud, image, KEY)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    assert scores == {
        "num_points": n + 200,
        "all": pytest.approx(100 / (n + 200)),
        "moving": 0.5,
        "static": 0.0,
        "unjudged": {"all": 0.0, "moving": 0.0, "static": 0.0},
        "by_distance": {"1": 0.0, "2": 0.5},
        "by_seconds": {"0.10": 0.0, "0.20": 0.5},
    }
    assert ghost_rate(cloud, image, KEY) == scores["all"]
