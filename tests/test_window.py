# SPDX-License-Identifier: MIT
"""Which frames, cameras and returns of a recording are used."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from densify.config import RegisterSettings
from densify.errors import InputError
from densify.readers.window import choose_cameras, read_sweeps, recorded_trajectory, window_frames
from tests.scenes import CAMERA, stamp_ns
from tests.tiny_street import tiny


class Frames:
    """A sequence that only knows its frames."""

    name = "rec"

    def __init__(self, frames):
        self.frames = frames


def test_window_and_lead_in():
    assert window_frames(Frames(range(20)), 10, 2, 3) == ([8, 9, 10, 11, 12], [5, 6, 7])
    assert window_frames(Frames(range(100, 120)), 110, 0, 0) == ([110], [])


def test_lead_in_is_what_lies_directly_before(caplog):
    with caplog.at_level(logging.WARNING, "densify"):
        assert window_frames(Frames(range(20)), 4, 3, 5) == ([1, 2, 3, 4, 5, 6, 7], [0])
        broken = [0, 1, 2, 5, 6, 7, 8, 9]
        assert window_frames(Frames(broken), 8, 1, 5) == ([7, 8, 9], [5, 6])
    assert not caplog.records


@pytest.mark.parametrize(
    ("key", "frames", "words"), [(1, [0, 1, 2, 3, 4], "0-4"), (19, [16, 17, 18, 19], "16-19")]
)
def test_a_cut_window_warns_with_its_frames(caplog, key, frames, words):
    with caplog.at_level(logging.WARNING, "densify"):
        assert window_frames(Frames(range(20)), key, 3, 0)[0] == frames
    (record,) = caplog.records
    assert f"key {key}" in record.getMessage() and words in record.getMessage()


@pytest.mark.parametrize("key", [-1, 20, 999])
def test_a_key_out_of_range_is_named_with_what_there_is(key):
    with pytest.raises(InputError, match=rf"--key {key}: no such frame in rec; it has 0-19"):
        window_frames(Frames(range(20)), key, 2, 0)


def test_a_frame_missing_in_the_window_is_named():
    there = [f for f in range(20) if f not in (8, 9)]
    with pytest.raises(InputError, match=r"no sweep for frame 8-9; it has 0-7, 10-19"):
        window_frames(Frames(there), 10, 3, 0)
    with pytest.raises(InputError, match=r"--key 9: no such frame"):
        window_frames(Frames(there), 9, 3, 0)
    assert window_frames(Frames(there), 13, 3, 5)[0] == list(range(10, 17))


def test_a_negative_window_is_refused():
    with pytest.raises(InputError, match="--window -1"):
        window_frames(Frames(range(20)), 10, -1, 0)


def test_cameras_by_name():
    sequence = tiny(cameras=(CAMERA, replace(CAMERA, name="rear")))
    assert [c.name for c in choose_cameras(sequence, None)] == ["front", "rear"]
    assert [c.name for c in choose_cameras(sequence, ["rear"])] == ["rear"]
    assert choose_cameras(sequence, []) == []
    with pytest.raises(InputError, match=r"--camera left: no such camera in tiny; .* front, rear"):
        choose_cameras(sequence, ["front", "left"])


def test_near_and_far_returns_are_left_out():
    sequence = tiny()
    (sweep,) = read_sweeps(sequence, [3], RegisterSettings(min_range_m=5.0, max_range_m=30.0))
    range_m = np.linalg.norm(sweep.points, axis=1)
    whole = sequence[3]
    assert 5 <= range_m.min() < range_m.max() <= 30 and len(sweep) < len(whole)
    assert np.array_equal(whole.points[sweep.row], sweep.points)


def test_recorded_poses_are_handed_on():
    sequence = tiny()
    sweeps = [sequence[f] for f in (2, 3, 4)]
    trajectory = recorded_trajectory(sequence, sweeps)
    assert trajectory.frames == (2, 3, 4)
    assert trajectory.stamp_ns.tolist() == [stamp_ns(f) for f in (2, 3, 4)]
    assert np.array_equal(trajectory.T_world_lidar[1], sequence.T_world_lidar(3))
