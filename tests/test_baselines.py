# SPDX-License-Identifier: MIT
"""The fill of IP-Basic, which maps are compared with."""

from __future__ import annotations

import numpy as np

from densify.bench.baselines import ip_basic


def sampled(depth_m: np.ndarray) -> np.ndarray:
    """One pixel in sixteen."""
    sparse_m = np.zeros_like(depth_m)
    sparse_m[2::4, 2::4] = depth_m[2::4, 2::4]
    return sparse_m


def test_a_wall_is_filled_and_a_large_hole_is_not() -> None:
    wall_m = np.full((80, 200), 20.0, np.float32)
    wall_m[:, 80:] = 0
    filled_m = ip_basic(sampled(wall_m))
    np.testing.assert_allclose(filled_m[8:-8, 8:76], 20.0, atol=1e-4)
    assert not filled_m[:, 110:].any()


def test_a_silhouette_is_smeared_by_a_few_pixels_only() -> None:
    scene_m = np.full((80, 200), 40.0, np.float32)
    scene_m[:, 100:] = 10.0
    filled_m = ip_basic(sampled(scene_m))
    assert filled_m.min() > 9.9 and (filled_m[8:-8, 8:90] > 39.9).all()
    assert (filled_m[8:-8, 103:190] < 10.1).all()
