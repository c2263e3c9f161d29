# SPDX-License-Identifier: MIT
"""Poses at any time, and undoing ego-motion compensation."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry.poses import exp, inverse, transform
from densify.readers.recorded_poses import PoseTrack

STAMPS_NS = 5_000_000_000 + np.arange(0, 400_000_001, 10_000_000)


def pose(time_ns: int) -> np.ndarray:
    """8 m/s along a curve of 0.3 rad/s that climbs."""
    s = (time_ns - 5_000_000_000) * 1e-9
    T = exp(np.array([0.02 * s, -0.01 * s, 0.3 * s, 0, 0, 0]))
    T[:3, 3] = [8 / 0.3 * np.sin(0.3 * s), 8 / 0.3 * (1 - np.cos(0.3 * s)), 0.4 * s]
    return T


@pytest.fixture
def track() -> PoseTrack:
    return PoseTrack("poses.csv", STAMPS_NS, np.stack([pose(int(t)) for t in STAMPS_NS]))


def test_points_at_their_own_times_follow_the_path(track):
    rng = np.random.default_rng(1)
    stamp_ns = 5_200_000_000
    offset_ns = rng.integers(-100_000_000, 100_000_000, 300)
    world = rng.uniform(-40, 40, (300, 3))
    fired = [
        transform(inverse(pose(stamp_ns + int(late_ns))), point[None])[0]
        for late_ns, point in zip(offset_ns, world, strict=True)
    ]
    at_stamp = transform(inverse(pose(stamp_ns)), world)
    undone = track.undo_compensation(at_stamp, stamp_ns, offset_ns)
    np.testing.assert_allclose(undone, fired, atol=2e-4)
    back = track.compensate(undone, stamp_ns, offset_ns)
    np.testing.assert_allclose(back, at_stamp, atol=1e-9)
    assert np.linalg.norm(at_stamp - fired, axis=1).max() > 0.7


def test_rows_that_formats_pad_with_stay_zeros(track):
    points = np.array([[0.0, 0, 0], [5, 0, 0]])
    fired = track.undo_compensation(points, 5_200_000_000, np.array([40_000_000, 40_000_000]))
    assert not fired[0].any() and fired[1, 0] != 5


def test_beyond_the_ends(track):
    np.testing.assert_allclose(track.at(5_450_000_000), pose(5_450_000_000), atol=5e-3)
    with pytest.raises(InputError, match=r"poses\.csv: no pose at 5700000000 ns.*0\.30 s away"):
        track.at(5_700_000_000)


@pytest.mark.parametrize("stamps_ns", [[5], [5, 5], [5, 4]])
def test_stamps_must_ascend(stamps_ns):
    with pytest.raises(InputError, match="expected two or more with stamps that ascend"):
        PoseTrack("poses.csv", np.array(stamps_ns), np.tile(np.eye(4), (len(stamps_ns), 1, 1)))
