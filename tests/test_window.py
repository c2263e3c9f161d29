# SPDX-License-Identifier: MIT
"""Which frames, cameras and returns of a recording are used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import RegisterSettings
from densify.config.errors import InputError
from densify.readers.timeline import Timeline, choose_cameras, read_sweep
from tests.scenes import CAMERA, TinySequence
from tests.tiny_street import tiny


def timeline(frames) -> Timeline:
    return Timeline("rec", tuple(frames), np.array(frames, np.int64) * 100_000_000, {})


@pytest.mark.parametrize(
    ("key", "frames", "cut"),
    [
        (1, (0, 1, 2, 3, 4), "the recording begins at frame 0"),
        (19, (16, 17, 18, 19), "the recording ends at frame 19"),
        (15, (13, 14, 15, 16, 17, 18), "12.bin: truncated"),
    ],
)
def test_a_window_is_cut_where_the_recording_ends_or_a_sweep_is_left_out(key, frames, cut):
    assert timeline(range(20)).window(key, 3, {12: "12.bin: truncated"}) == (frames, (cut,))


def test_a_hole_in_time_ends_a_window_and_is_named():
    there = timeline([f for f in range(20) if f not in (7, 8, 9)])
    cuts = ("0.4 s lie between frames 6 and 10",)
    assert there.window(10, 3) == ((10, 11, 12, 13), cuts)
    assert there.window(6, 3) == ((3, 4, 5, 6), cuts)
    assert there.before(12, 5) == [10, 11] and there.after(4, 5) == [5, 6]
    assert there.split_at_holes([4, 5, 6, 10, 11, 13]) == [[4, 5, 6], [10, 11], [13]]


@pytest.mark.parametrize("key", [-1, 20])
def test_a_key_out_of_range_is_named_with_what_there_is(key):
    with pytest.raises(InputError, match=rf"key {key}: no such frame in rec; it has 0-19"):
        timeline(range(20)).window(key, 2)
    with pytest.raises(InputError, match="window -1"):
        timeline(range(20)).window(10, -1)
    assert timeline(range(20)).window(10, 2_000_000_000).frames == tuple(range(20))


@pytest.mark.parametrize(
    ("stamps", "wrong"),
    [([0, 1, 2, 3, 4], []), ([0, 1, 99, 3, 4], [2]), ([0, 1, 1, 3, 4], [2]), ([7, 1, 2, 3, 4], [0]),
     ([9, 1, 2, None, 0, 4, 5], [0, 3, 4]), ([4, 3, 2, 1, 0], [])],
)  # fmt: skip
def test_stamps_past_which_most_others_ascend_are_unknown(stamps, wrong):
    """Where all are out of order, all may be wrong."""

    class Stamped(TinySequence):
        def stamp_ns(self, frame):
            if stamps[frame] is None:
                raise InputError("timestamps.txt: no stamp")
            return stamps[frame] * 100_000_000

    found = Timeline.of(Stamped(tiny().scene, range(len(stamps))))
    assert sorted(found.unknown) == wrong
    if wrong:
        assert np.all(np.diff(found.stamp_ns[1:-1]) > 0)
        assert f"frame {wrong[0]} ({stamps[wrong[0]] * 100_000_000} ns)" in found.unknown[wrong[0]]


def test_cameras_by_name():
    sequence = tiny(cameras=(CAMERA, replace(CAMERA, name="rear")))
    assert [c.name for c in choose_cameras(sequence, None)] == ["front", "rear"]
    assert [c.name for c in choose_cameras(sequence, ["rear"])] == ["rear"]
    assert choose_cameras(sequence, []) == []
    with pytest.raises(InputError, match=r"camera left: no such camera in tiny; .* front, rear"):
        choose_cameras(sequence, ["front", "left"])


def test_ranges_count_from_the_scanner():
    """Not from the origin of a vehicle's frame, in which the points may be."""
    forward_m = np.array([4.0, 0, 0])

    class Moved:
        def __getitem__(self, frame):
            sweep = tiny()[frame]
            return replace(sweep, points=sweep.points + forward_m, scanner_origins=forward_m[None])

    settings = RegisterSettings(min_range_m=5, max_range_m=30)
    moved, here = (read_sweep(sequence, 3, settings) for sequence in (Moved(), tiny()))
    assert np.array_equal(moved.row, here.row)
    range_m = np.linalg.norm(here.points, axis=1)
    assert 5 <= range_m.min() < range_m.max() <= 30 and len(here) < len(tiny()[3])
