# SPDX-License-Identifier: MIT
"""How fast a group of points moves, by the votes of other sweeps."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.tracking.following import DistanceField, Group, vote
from densify.geometry.clock import Clock
from densify.geometry.types import Float


def _nearness(field: DistanceField, group: Group, velocities: Float) -> Float:
    found = np.zeros((len(velocities), len(group.points)), np.uint8)
    field.raise_nearness(found, group, velocities)
    return found / 255


def test_the_field_is_the_distance_between_voxels() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 4, (300, 3)) + [100, -50, 0]
    field = DistanceField.of(points, np.ones(300))
    asked = rng.uniform(-2, 6, (3000, 3)) + [100, -50, 0]
    voxel, occupied = (np.floor((p - field.low) / 0.2) for p in (asked, points))
    distance_m = 0.2 * np.linalg.norm(voxel[:, None] - occupied[None], axis=2).min(1)
    share = np.round(255 * np.minimum(distance_m / 0.6, 1)) / 255
    assert (share < 1).mean() > 0.1
    # A second before the points of the field, from the origin.
    found = _nearness(field, Group.of(np.zeros((1, 3)), np.zeros(1)), asked)
    np.testing.assert_allclose(1 - found[:, 0], share, atol=1e-12)
    together = Group.of(asked[:7] - asked[0], np.zeros(7))
    np.testing.assert_allclose(1 - _nearness(field, together, asked[:1])[0], share[:7], atol=1e-12)


@pytest.mark.parametrize("num_together", [1, 2])
@pytest.mark.parametrize("early_s", [0.0, 0.008])
def test_what_passes_is_measured_earlier_or_later_in_each_sweep(
    num_together: int, early_s: float
) -> None:
    """A car passes at 27 m/s, and each sweep measures it a little earlier in its turn than the one
    before: by the sweeps' own times it would be 2.2 m/s slower. Points of one sweep, and sweeps of
    one look, have times of their own too."""
    body = np.random.default_rng(3).uniform([-2.2, -0.9, 0], [2.2, 0.9, 1.4], (240, 3))
    body[:, 1] = np.where(np.abs(body[:, 0]) < 2.1, 0.9, body[:, 1])  # a side and both ends
    period_s, velocity = 0.1 / num_together, np.array([27.0, 0.4, 0.0])
    time_s = [
        period_s * i - early_s / num_together * (i - 5 * num_together) + 0.002 * body[:, 0]
        for i in range(11 * num_together)
    ]
    seen = [body + t[:, None] * velocity for t in time_s]
    of_sweeps = [DistanceField.of(p, t) for p, t in zip(seen, time_s, strict=True)]
    looks = [range(n * num_together, (n + 1) * num_together) for n in range(11)]
    middle_ns = [round(np.mean([period_s * j for j in look]) * 1e9) for look in looks]
    group = Group.of(*(np.concatenate([part[j] for j in looks[5]]) for part in (seen, time_s)))
    found = vote(
        group, 5, [[of_sweeps[j] for j in look] for look in looks], Clock(np.array(middle_ns))
    )
    np.testing.assert_allclose(found, velocity, atol=0.25)
