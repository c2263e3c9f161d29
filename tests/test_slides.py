# SPDX-License-Identifier: MIT
"""A flat front that slid along itself while it was followed: looks far apart in time tell."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from densify.flow.surface_matching import apply
from densify.flow.tracking import slides
from densify.flow.tracking.sightings import Sighting, Track
from densify.geometry.types import Float

SPEED_M_S = 10.0


def take_back(track: Track, standing: list, contradicted: tuple[int, int] = (5, 5)) -> None:
    """contradicted: how many looks do, before and after."""
    counts = iter(contradicted)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slides, "contradictions", lambda *_: (100, next(counts), 200))
        slides.take_back_slides(track, standing, SimpleNamespace())


def followed(
    width_m: float, slide_m_s: float, num_looks: int = 11, turn_rad_s: float = 0.0
) -> tuple[Track, list]:
    """A front of that width comes along x, and turns; its track says that it drifts along itself
    too. Rays meet it every 0.13 m, elsewhere at every look, and show what lies within 3 m of its
    middle."""
    rng, track, standing = np.random.default_rng(0), Track(np.zeros(3)), []
    for n in range(num_looks):
        at_s = 0.1 * n
        y = np.arange(-width_m / 2 + 0.13 * rng.random(), width_m / 2, 0.13)
        y = np.tile(y[np.abs(y) < 3.0], 2)
        front = np.stack([0 * y, y, np.repeat([0.0, 0.8], len(y) // 2)], 1)
        true = np.array([SPEED_M_S * at_s, 0.0, 0.0, turn_rad_s * at_s])
        seen = apply(true, front, np.zeros(3))
        standing.append(SimpleNamespace(points=seen, time_s=np.full(len(y), at_s)))
        aside = slide_m_s * at_s * np.array([-np.sin(true[3]), np.cos(true[3]), 0.0, 0.0])
        track.sightings[n] = Sighting(true + aside, at_s, 100_000_000 * n, (n,))
        track.claimed[n] = np.arange(len(y))
    track.smooth()
    return track, standing


@pytest.mark.parametrize("turn_rad_s", [0.0, 0.9])
@pytest.mark.parametrize("slide_m_s", [-1.9, 0.7, -0.8])
def test_a_front_that_slid_aside_is_put_back(slide_m_s: float, turn_rad_s: float) -> None:
    track, standing = followed(2.5, slide_m_s, turn_rad_s=turn_rad_s)
    take_back(track, standing)
    ends = np.array([[0.0, -1.25, 0.0], [0.0, 1.25, 0.0]])

    def true(at_s: float) -> Float:
        state = np.array([SPEED_M_S * at_s, 0.0, 0.0, turn_rad_s * at_s])
        return apply(state, ends, np.zeros(3))

    for at_s in (0.0, 1.0):
        np.testing.assert_allclose(track.carry(true(0.5), 0.5, at_s), true(at_s), atol=0.08)


def test_what_more_looks_would_contradict_is_not_put_back() -> None:
    track, standing = followed(2.5, 0.7)
    before = dict(track.sightings)
    take_back(track, standing, (5, 6))
    assert track.sightings == before
    assert track.path.rate(0.5)[1] == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("width_m", "slide_m_s", "num_looks"), [(2.5, 0.0, 11), (20.0, 0.7, 11), (2.5, 0.7, 3)]
)
def test_what_looks_cannot_tell_stays_to_the_last_bit(
    width_m: float, slide_m_s: float, num_looks: int
) -> None:
    """It did not slide; no end is in view; or there are few looks."""
    track, standing = followed(width_m, slide_m_s, num_looks)
    before = dict(track.sightings)
    take_back(track, standing)
    assert track.sightings == before
