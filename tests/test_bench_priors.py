# SPDX-License-Identifier: MIT
"""Priors with known faults: what the fit takes off, and what it cannot."""

from __future__ import annotations

import pytest

from densify.bench import priors
from densify.bench.priors import bench_priors
from densify.config.errors import InputError
from tests.small_street import KEY, one_car


@pytest.fixture(scope="module")
def completed():
    return bench_priors(one_car(), KEY, "front")


def test_a_shift_of_inverse_depth_is_found(completed):
    found = completed["7 / depth + 0.4"]
    assert found.share > 0.01
    assert found.scaled.outliers > 0.5 and found.scaled.abs_rel > 0.2
    assert found.fitted.outliers < 0.1 and found.fitted.abs_rel < 0.05


def test_what_wanders_is_taken_off_and_noise_stays(completed):
    wandering = completed["3 x depth, 10 % that wanders"]
    assert wandering.fitted.abs_rel < wandering.scaled.abs_rel
    noisy = completed["3 x depth, 5 % in every pixel"]
    mean_of_noise = 0.05 * (2 / 3.14159) ** 0.5
    assert min(noisy.scaled.abs_rel, noisy.fitted.abs_rel) > 0.7 * mean_of_noise


def test_both_are_scored_at_the_same_pixels(completed):
    assert list(completed) == list(priors.FAULTS)
    for found in completed.values():
        assert found.scaled.num_compared == found.fitted.num_compared > 0


def test_recordings_without_truth_are_refused():
    with pytest.raises(InputError, match="exact truth"):
        bench_priors(one_car(with_truth=False), KEY, "front")
