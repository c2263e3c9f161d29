# SPDX-License-Identifier: MIT
"""Two clouds alone against exact truth: what the scores are made of."""

from __future__ import annotations

import numpy as np
import pytest

from densify.bench.two_clouds import bench_two_clouds
from densify.config.errors import InputError
from densify.flow.pairs.estimate import estimate_flow
from tests.scenes import Arc, Scanner, Scene, TinySequence, World, car, street
from tests.small_street import one_car

FAR_AND_NEAR = (car(12, -1.6, 10, 1), car(60, 1.6, 10, 2))


@pytest.fixture(scope="module")
def sequence() -> TinySequence:
    scene = Scene(World((*street(), *FAR_AND_NEAR)), Arc(0, -1.5), Scanner(sigma_m=0.01))
    return TinySequence(scene)


def test_scores_of_one_pair_are_those_of_its_points_within_35_m_and_above_the_ground(sequence):
    scores = bench_two_clouds(sequence, [4])
    assert list(scores) == ["points alone", "and firing times", "and scanner numbers"]
    here, there = sequence.scene.scan(4), sequence.scene.scan(5)
    found = estimate_flow(here.world, there.world)  # the vehicle stands: nothing to deskew
    true = sequence.scene.displacement(4, 5) @ sequence.T_world_lidar(4)[:3, :3].T
    error_m = np.linalg.norm(found.displacement - true, axis=1)
    range_m = np.linalg.norm(here.sweep.points, axis=1)
    asked = (range_m <= 35) & (sequence.scene.height_m(4) >= 0.3)
    assert (here.instance[asked] != 2).all() and (here.instance[asked] == 1).sum() > 50
    movers_m = error_m[asked & (here.instance == 1)]
    alone = scores["points alone"]
    assert alone.movers_m == pytest.approx(movers_m.mean(), abs=0.02)
    assert alone.within_10cm == pytest.approx((movers_m <= 0.1).mean(), abs=0.05)
    assert alone.standing_m < 1e-3 and alone.falsely_moving < 1e-3


def test_what_is_missed_counts_as_standing_still():
    """A walker too slow for two clouds to tell."""
    slow = car(12, 3.4, 0.8, 1, size_m=(0.5, 0.5, 1.7))
    score = bench_two_clouds(one_car([slow]), [4])["points alone"]
    assert score.movers_m == pytest.approx(0.08, abs=0.02)


def test_recordings_without_truth_or_without_a_next_sweep_are_refused():
    scene = Scene(World(street()), Arc(0, -1.5), Scanner(16, 200))
    with pytest.raises(InputError, match="exact truth"):
        bench_two_clouds(TinySequence(scene, with_truth=False), [4])
    with pytest.raises(InputError, match="frame 10: it is the last one"):
        bench_two_clouds(TinySequence(scene), [10])
