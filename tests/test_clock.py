# SPDX-License-Identifier: MIT
"""Which sweeps are near each other in time, at any rate and with holes."""

from __future__ import annotations

import numpy as np
import pytest

from densify.geometry.clock import Clock

MS = 1_000_000


def test_holes_and_jitter():
    """At 0, 100, 201, 298, then none for three periods, 598, 700 ms."""
    clock = Clock(np.array([0, 100, 201, 298, 598, 700]) * MS)
    assert clock.period_ns == 101 * MS
    assert clock.near(2, 3, 0.1) and not clock.near(3, 4, 0.2) and clock.near(3, 4, 0.3)
    assert [clock.at(3, s) for s in (-0.2, -0.1, 0.1, 0.2, 0.4)] == [1, 2, 4, 4, 5]
    assert clock.at(5, 0.1) is None and clock.at(0, -0.1) is None
    assert clock.nearest(3, [0, 4, 5]) == 0 and clock.nearest(4, [2, 3, 5]) == 5
    assert clock.from_end_s(3) == pytest.approx(0.298) and clock.from_end_s(4) == 0.102
    assert clock.time_s[4] == pytest.approx(0.598)
