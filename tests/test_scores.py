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


def room(range_m=20.0):
    """A key sweep standing in a sphere of ``range_m``: 0.5 x 1 degree steps."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-180, 180, 0.5)), np.radians(range(-15, 16))
    )
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    points = range_m * np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    n = len(points)
    sweep = Sweep(
        frame=KEY,
        stamp_ns=0,
        points=points,
        intensity=np.zeros(n, np.float32),
        offset_ns=None,
        lidar=np.zeros(n, np.uint8),
        row=np.arange(n),
    )
    return RegisteredSweep(sweep, np.eye(4), np.zeros(6), np.zeros(6))


def cloud_of(*parts):
    """parts: (points, frame, moving)."""
    points = np.vstack([p for p, _, _ in parts])
    n = len(points)
    frame = np.concatenate([np.full(len(p), f, np.int32) for p, f, _ in parts])
    return Cloud(
        points=points,
        rigid_points=points,
        frame=frame,
        since_key_ns=(frame.astype(np.int64) - KEY) * 100_000_000,
        row=np.arange(n),
        lidar=np.zeros(n, np.uint8),
        moving=np.concatenate([np.full(len(p), m) for p, _, m in parts]),
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.ones(n, np.float32),
        intensity=np.zeros(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
        far=np.zeros(n, bool),
    )


def panel(distance_m, num=10):
    y, z = np.meshgrid(np.linspace(-1, 1, num), np.linspace(-1, 1, num))
    return np.column_stack([np.full(num * num, distance_m), y.ravel(), z.ravel()])


def test_ghosts_need_the_margin():
    seen = RangeImage.of(room())
    rates = [ghost_rate(cloud_of((panel(d), KEY + 1, False)), seen, KEY) for d in (19.2, 20.5, 40)]
    assert rates == [1, 0, 0]
    # 2 % of 100 m counts beyond half a metre
    far = RangeImage.of(room(100.0))
    near_wall = cloud_of((panel(98.5), KEY + 1, False))
    before = cloud_of((panel(97.0), KEY + 1, False))
    assert ghost_rate(near_wall, far, KEY) == 0
    assert ghost_rate(before, far, KEY) == 1


def test_the_key_sweep_itself_and_an_unseen_direction_hold_no_ghosts():
    key = room()
    seen = RangeImage.of(key)
    assert ghost_rate(cloud_of((key.sweep.points, KEY + 1, False)), seen, KEY) == 0
    above = panel(1.0)[:, [1, 2, 0]] * [0.1, 0.1, 5.0]
    unseen = cloud_of((above, KEY + 1, False))
    assert ghost_rate(unseen, seen, KEY) == 0
    assert ghost_scores(unseen, seen, KEY)["unjudged"]["static"] == 1
    assert ghost_rate(cloud_of((panel(10.0), KEY, False)), seen, KEY) is None


def test_ghost_scores_by_kind_and_distance():
    key = room()
    seen = RangeImage.of(key)
    cloud = cloud_of(
        (panel(10.0), KEY - 2, True),
        (panel(20.5), KEY + 2, True),
        (key.sweep.points, KEY + 1, False),
        (panel(10.0), KEY, False),
    )
    scores = ghost_scores(cloud, seen, KEY)
    n = len(key.sweep)
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


def test_what_sweeps_beyond_the_window_saw_is_no_ghost_of_it():
    key = room()
    seen = RangeImage.of(key)
    near = (panel(10.0), KEY - 2, True), (key.sweep.points, KEY + 1, False)
    alone, beside = cloud_of(*near), cloud_of(*near, (panel(10.0), KEY + 2, False))
    beside = replace(beside, far=beside.frame == KEY + 2)
    assert ghost_scores(beside, seen, KEY) == ghost_scores(alone, seen, KEY)
    assert ghost_rate(beside, seen, KEY) == ghost_rate(alone, seen, KEY)
