# SPDX-License-Identifier: MIT
"""Ghosts that were planted, and their rates worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from densify.free_space.range_image import RangeImage
from densify.geometry.types import Cloud, RegisteredSweep, Sweep
from densify.scores.cloud_scores import ghost_rate, ghost_scores

KEY = 7


def sweep_of(points: np.ndarray, frame: int = KEY) -> RegisteredSweep:
    n, stamp_ns = len(points), (frame - KEY) * 100_000_000
    lidar, row, intensity = np.zeros(n, np.uint8), np.arange(n), np.zeros(n, np.float32)
    sweep = Sweep(frame, stamp_ns, points, intensity, None, lidar, row)
    return RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))


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
    points = np.concatenate([points for points, _, _ in parts])
    frame, moving = (
        np.concatenate([np.full(len(part[0]), part[column]) for part in parts]) for column in (1, 2)
    )
    n, since_key_ns = len(points), (frame - KEY) * 100_000_000
    row, lidar, none = np.arange(n), np.zeros(n, np.uint8), np.full(n, -1, np.int32)
    ones, zeros = np.ones(n, np.float32), np.zeros((n, 3), np.float32)
    colour, far = np.zeros((n, 3), np.uint8), np.zeros(n, bool)
    key_time = (frame.astype(np.int32), since_key_ns, row, lidar, moving, none, zeros)
    return Cloud(points, points, *key_time, ones, ones, colour, far)


def test_ghosts_need_the_margin():
    for range_m, distance_m, rate in (
        (20, 19.2, 1),
        (20, 20.5, 0),
        (20, 40, 0),
        (100, 98.5, 0),  # 2 % of 100 m counts beyond half a metre
        (100, 97.0, 1),
    ):
        image = RangeImage.of(sweep_of(room(range_m)))
        assert ghost_rate(cloud_of((panel(distance_m), KEY + 1, False)), image, KEY) == rate


def test_the_key_sweep_itself_and_an_unseen_direction_hold_no_ghosts():
    image = RangeImage.of(sweep_of(room()))
    assert ghost_rate(cloud_of((room(), KEY + 1, False)), image, KEY) == 0
    above = panel(1.0)[:, [1, 2, 0]] * [0.1, 0.1, 5.0]
    scores = ghost_scores(cloud_of((above, KEY + 1, False)), image, KEY)
    assert scores["all"] == 0 and scores["unjudged"]["static"] == 1
    assert ghost_rate(cloud_of((panel(10.0), KEY, False)), image, KEY) is None


def test_ghost_scores_by_kind_and_distance_without_what_lies_beyond_the_window():
    image, n = RangeImage.of(sweep_of(room())), len(room())
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
