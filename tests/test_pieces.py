# SPDX-License-Identifier: MIT
"""Pieces of one object that touch and move alike are one object; two objects stay two."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cache

import numpy as np
import pytest

from densify.flow.tracking.groups import join_pieces
from densify.free_space.range_image import FreeSpace
from densify.geometry import poses
from tests.found_motion import Found
from tests.scenes import car

AHEAD = car(9, 1.8, 8, 1)


@cache
def found(*gaps_m: float) -> tuple[Found, FreeSpace]:
    """A car ahead at 8 m/s, and others as fast, so far ahead of it in its lane."""
    movers = [AHEAD, *(car(9 + 4.3 + gap, 1.8, 8, 2 + n) for n, gap in enumerate(gaps_m))]
    scene = Found.of(movers)
    return scene, FreeSpace.of(scene.stretch)


def numbers(part_of: Callable[[np.ndarray], np.ndarray], *speeds_m_s: float) -> np.ndarray:
    """The numbers of the pieces of the car ahead.

    part_of: function of (N,) metres ahead of the middle of its points that returns the piece of
    each point, -1 for none. speeds_m_s: by how much the pieces' own paths are too fast.
    """
    scene, space = found()
    motion, pieces = scene.motion, []
    k = scene.track_of(1)
    track = motion.tracks[k]
    every = []
    for registered, instance in zip(scene.stretch.sweeps, motion.track_of_point, strict=True):
        points = poses.transform(registered.T_world_lidar, registered.sweep.points)
        own = motion.object_of_track[instance] == motion.object_of_track[k]
        every.append((points, own & (instance >= 0)))
    times_s = space.clock.time_s
    along = [track.undo(points, s)[:, 0] for (points, _), s in zip(every, times_s, strict=True)]
    middle = np.median(np.concatenate([x[own] for x, (_, own) in zip(along, every, strict=True)]))
    for x, (_, own) in zip(along, every, strict=True):
        pieces.append(np.where(own, part_of(x - middle), -1).astype(np.int32))
    tracks = []
    for too_fast_m_s in speeds_m_s:
        path, wrong = track.path, copy(track)
        mid_s = (path.begin_s + path.end_s) / 2
        off = np.array([too_fast_m_s, 0, 0, 0])
        # The coefficients of a straight line are its values, from one span before the path on.
        num = len(path.coefficients)
        at_s = path.begin_s + (path.end_s - path.begin_s) / (num - 3) * np.arange(-1, num - 1)
        coefficients = path.coefficients + (at_s - mid_s)[:, None] * off
        wrong.path = type(path)(coefficients, path.begin_s, path.end_s, path.residual_m)
        tracks.append(wrong)
    object_of_track, _ = join_pieces(scene.stretch, tracks, pieces, space)
    return object_of_track


def halves(x: np.ndarray) -> np.ndarray:
    return (x > 0).astype(int)


def apart(hole_m: float) -> Callable[[np.ndarray], np.ndarray]:
    """Pieces behind and ahead of a hole without points."""
    return lambda x: np.where(x < 0.5 - hole_m / 2, 0, np.where(x > 0.5 + hole_m / 2, 1, -1))


def inside(x: np.ndarray) -> np.ndarray:
    return ((x > 1.0) & (x < 1.5)).astype(int)


@pytest.mark.parametrize(
    ("part_of", "too_fast_m_s", "num_objects"),
    [
        (halves, 0, 1),
        (apart(1.0), 0, 1),  # nothing was seen between
        (halves, 0.5, 1),  # followed badly
        (halves, 4.0, 2),  # another motion
        (inside, 4.0, 1),  # whatever its path
    ],
)
def test_pieces_that_touch_and_move_alike_are_one(part_of, too_fast_m_s, num_objects) -> None:
    assert len(set(numbers(part_of, 0, too_fast_m_s))) == num_objects


def test_the_number_is_that_of_the_largest_piece() -> None:
    assert numbers(lambda x: (x < 0.2).astype(int), 0, 0).tolist() == [1, 1]


def test_cars_in_a_queue_stay_apart() -> None:
    scene, _ = found(3.0)
    assert scene.track_of(1) != scene.track_of(2)
    assert scene.share_moving(1) > 0.9 and scene.share_moving(2) > 0.5


def test_flow_names_one_object_for_all_pieces() -> None:
    scene, _ = found()
    for _, scan, flow in scene.near_key():
        on = (scan.instance == 1) & flow.moving
        assert len(np.unique(flow.instance[on])) == 1
