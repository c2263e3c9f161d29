# SPDX-License-Identifier: MIT
"""Smooth paths: as stiff as can be, as soft as they must, and honest about their noise."""

from __future__ import annotations

import numpy as np
import pytest

from densify.flow.tracking.objects import Path

STEP_S = 0.1
NOISE_M = 0.03
SEEDS = range(10)


def times_of(num: int, begin_s: float = 0.37) -> np.ndarray:
    """Not quite even: an object is seen a little earlier or later as the scanner comes by."""
    return begin_s + STEP_S * np.arange(num) + np.random.default_rng(num).uniform(0, 0.01, num)


def polynomial(times_s: np.ndarray, degree: int) -> np.ndarray:
    """(m,4) x y z yaw."""
    rng = np.random.default_rng(degree)
    return np.vander(np.asarray(times_s), degree + 1) @ rng.uniform(-8, 8, (degree + 1, 4))


def fitted(times_s: np.ndarray, states: np.ndarray) -> Path:
    return Path.fit(times_s, states, np.ones(len(times_s)))


def rms(off: np.ndarray) -> float:
    """In the plane."""
    return float(np.sqrt((off[:, :2] ** 2).sum(1).mean()))


@pytest.mark.parametrize(("degree", "num"), [(1, 4), (2, 5), (2, 40)])
def test_constant_acceleration_is_recovered_exactly_and_of_few_sweeps_constant_velocity(
    degree, num
):
    t = times_of(num)
    path = fitted(t, polynomial(t, degree))
    within = np.linspace(t[0], t[-1], 50)
    np.testing.assert_allclose(path(within), polynomial(within, degree), atol=1e-5)
    assert path.residual_m < 1e-5


def from_rest(times_s: np.ndarray) -> np.ndarray:
    """Stands for half a second, then sets off at 5 m/s²."""
    x = 2.5 * np.maximum(times_s - times_s[0] - 0.5, 0) ** 2
    return np.stack([x, 0.5 * x, 0 * x, 0.02 * x], 1)


def to_a_stop(times_s: np.ndarray) -> np.ndarray:
    """6 m/s, brakes at 8 m/s², stands."""
    after_s = np.clip(times_s - times_s[0] - 0.2, 0, 0.75)
    x = 6 * (np.minimum(times_s - times_s[0], 0.2) + after_s) - 4 * after_s**2
    return np.stack([x, -0.3 * x, 0 * x, 0 * x], 1)


def noisy(states: np.ndarray, seed: int) -> np.ndarray:
    return states + np.random.default_rng(seed).normal(0, NOISE_M, states.shape)


@pytest.mark.parametrize("motion", [from_rest, to_a_stop])
def test_starts_and_stops_are_followed_better_than_by_a_quadratic(motion):
    t = times_of(15)
    path_m, quadratic_m = [], []
    for seed in SEEDS:
        measured = noisy(motion(t), seed)
        path_m.append(rms(fitted(t, measured)(t) - motion(t)))
        quadratic = np.vander(t - t[0], 3)
        coefficients = np.linalg.lstsq(quadratic, measured, rcond=None)[0]
        quadratic_m.append(rms(quadratic @ coefficients - motion(t)))
    assert np.mean(path_m) < 0.75 * np.mean(quadratic_m)
    assert np.mean(path_m) < NOISE_M * np.sqrt(2)  # better than the single sweep


def test_a_quadratic_with_noise_stays_one():
    """What softness could explain is only noise: the third derivative remains nothing."""
    t = times_of(11)
    num_stiff = 0
    for seed in SEEDS:
        rate = fitted(t, noisy(polynomial(t, 2), seed)).rate(np.linspace(t[0], t[-1], 9))
        num_stiff += np.abs(np.diff(rate, 2, axis=0)).max() < 1e-3
    assert num_stiff >= 0.75 * len(SEEDS)


@pytest.mark.parametrize("num", [3, 4])
def test_four_sweeps_do_not_tell_an_acceleration(num):
    t = times_of(num)
    rate = fitted(t, polynomial(t, 2)).rate(np.linspace(t[0], t[-1], 9))
    assert np.ptp(rate, axis=0).max() < 1e-3
    t = times_of(5)
    rate = fitted(t, polynomial(t, 2)).rate(np.linspace(t[0], t[-1], 9))
    assert np.ptp(rate, axis=0).max() > 1


@pytest.mark.parametrize("num", [5, 11])
def test_the_residual_of_noise_is_about_the_noise(num):
    """Though the fit swallows some of it."""
    t = times_of(num)
    found_m = [fitted(t, noisy(polynomial(t, 2), seed)).residual_m for seed in range(60)]
    expected_m = NOISE_M * np.sqrt(2)  # of two coordinates
    assert 0.75 * expected_m < np.sqrt(np.mean(np.square(found_m))) < 1.3 * expected_m


def test_beyond_the_ends_it_goes_on_at_constant_velocity():
    t = times_of(15)
    soft = fitted(t, from_rest(t))
    for end_s, sign in ((soft.begin_s, -1), (soft.end_s, 1)):
        velocity = soft.rate(end_s)
        for beyond_s in (0.01, 0.2, 3.0):
            there = soft(end_s + sign * beyond_s)
            np.testing.assert_allclose(there, soft(end_s) + sign * beyond_s * velocity, atol=1e-9)
            np.testing.assert_allclose(soft.rate(end_s + sign * beyond_s), velocity)
    assert soft.rate(soft.end_s + 1)[0] > 3 and abs(soft.rate(soft.begin_s - 1)[0]) < 1


def test_rounding_of_the_last_knot_leaves_the_last_state_on_the_path():
    """0.1 s times the number of spans may end a rounding error before the last time."""
    for times_s in np.sort(np.random.default_rng(0).uniform(-1, 1, (300, 2)), axis=1):
        assert np.isfinite(fitted(times_s, np.ones((2, 4))).residual_m)
