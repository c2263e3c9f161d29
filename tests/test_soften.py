# SPDX-License-Identifier: MIT
"""Objects that bend: a walker's limbs follow their truth, and what is rigid stays so to the bit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from densify.flow.tracking import soften as module
from densify.flow.tracking.soften import Snapshot, Softened, soften

SWEEP_S, STRIDE_S, SWING = 0.1, 1.2, 0.5
SENSOR = np.array([2.0, -8.0, 1.7])
BEAM, AZIMUTH = np.deg2rad(0.4), np.deg2rad(0.17)
TRUNK, LEFT, RIGHT = 0, 1, 2
HIPS = np.array([[0.0, 0.0, 0.9], [0.0, 0.12, 0.9], [0.0, -0.12, 0.9]])


@dataclass
class Body:
    """Dense samples of a surface. limb: (n,) TRUNK, LEFT or RIGHT. points: (n,3) at rest."""

    points: np.ndarray
    limb: np.ndarray

    @staticmethod
    def walker() -> Body:
        rng = np.random.default_rng(5)
        trunk = tube(rng, 15000, (0.0, 0.0), 0.9, 1.7, 0.17)
        left = tube(rng, 10000, (0.0, 0.12), 0.0, 0.9, 0.08)
        right = tube(rng, 10000, (0.0, -0.12), 0.0, 0.9, 0.08)
        limb = np.repeat([TRUNK, LEFT, RIGHT], [len(trunk), len(left), len(right)])
        return Body(np.concatenate([trunk, left, right]), limb)

    @staticmethod
    def column(length_m: float = 0.0) -> Body:
        """Two upright tubes that do not move, as far apart as is said."""
        rng = np.random.default_rng(6)
        near = tube(rng, 20000, (0.0, 0.0), 0.0, 1.7, 0.25)
        points = np.concatenate([near, near + [length_m, 0.0, 0.0]]) if length_m else near
        return Body(points, np.zeros(len(points), int))

    def at(self, rows: np.ndarray, time_s: float) -> np.ndarray:
        """The rows' places: the legs swing about the hips."""
        limb = self.limb[rows]
        sign = np.array([0.0, 1.0, -1.0])[limb]
        angle = SWING * np.sin(2 * np.pi * time_s / STRIDE_S + 0.3) * sign
        x, y, z = (self.points[rows] - HIPS[limb]).T
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * x + s * z, y, c * z - s * x], axis=1) + HIPS[limb]

    def scan(self, time_s: float, rng: np.random.Generator, sigma_m: float) -> Seen:
        """The nearest sample in each of the sensor's cells, whose grid is another in each sweep."""
        place = self.at(np.arange(len(self.points)), time_s)
        ray = place - SENSOR
        range_m = np.linalg.norm(ray, axis=1)
        up = np.arcsin(ray[:, 2] / range_m) / BEAM + rng.random()
        around = np.arctan2(ray[:, 0], ray[:, 1]) / AZIMUTH + rng.random()
        on_beam = np.abs(up - np.rint(up)) < 0.12
        cell = (np.rint(up) * 100000 + np.rint(around)).astype(int)
        order = np.lexsort((range_m, cell))
        order = order[on_beam[order]]
        rows = order[np.unique(cell[order], return_index=True)[1]]
        noise = rng.normal(scale=sigma_m, size=(len(rows), 1)) * ray[rows] / range_m[rows, None]
        return Seen(rows, Snapshot(place[rows] + noise, time_s))


@dataclass
class Seen:
    rows: np.ndarray
    part: Snapshot


def tube(rng, count, centre, low_m, high_m, radius_m) -> np.ndarray:
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(low_m, high_m, count)
    x, y = centre
    ring = [x + radius_m * np.cos(angle), y + radius_m * np.sin(angle), height]
    return np.stack(ring, axis=1)


def scans(body: Body, num=11, seed=0, sigma_m=0.01) -> list[Seen]:
    rng = np.random.default_rng(seed)
    return [body.scan(k * SWEEP_S, rng, sigma_m) for k in range(num)]


def parts_of(seen: list[Seen]) -> list[Snapshot]:
    return [s.part for s in seen]


def rigid(parts: list[Snapshot]) -> Softened:
    return Softened(tuple(parts), {}, np.inf, {})


def forced(parts: list[Snapshot]) -> Softened:
    """At the softest, whatever held-out parts say."""
    bending = module._FlowSolver(tuple(parts))
    for level in range(len(module._ALPHAS)):
        bending.fill_targets()
        bending.refine(level)
    return Softened(tuple(parts), bending.at_points(), module._ALPHAS[-1], {})


# --- a walker -------------------------------------------------------------------------------------


@dataclass
class Walker:
    body: Body
    seen: list[Seen]
    soft: Softened

    def errors_m(self, result: Softened, hops: int) -> tuple[float, float]:
        """Mean over trunk and over legs: off the true displacement over so many sweeps."""
        trunk, legs = [], []
        for i in range(len(self.seen) - hops):
            for a, b in ((i, i + hops), (i + hops, i)):
                rows, part = self.seen[a].rows, self.seen[a].part
                true = self.body.at(rows, b * SWEEP_S) - self.body.at(rows, a * SWEEP_S)
                error = np.linalg.norm(result.carry(a, b) - part.points - true, axis=1)
                on_trunk = self.body.limb[rows] == TRUNK
                trunk.append(error[on_trunk])
                legs.append(error[~on_trunk])
        return float(np.concatenate(trunk).mean()), float(np.concatenate(legs).mean())


@pytest.fixture(scope="module")
def walker() -> Walker:
    body = Body.walker()
    seen = scans(body)
    return Walker(body, seen, soften(parts_of(seen)))


def test_held_out_sweeps_confirm_that_a_walker_bends(walker):
    assert np.isfinite(walker.soft.alpha)
    errors_m = walker.soft.held_out_m
    assert errors_m[walker.soft.alpha] ** 2 < 0.9 * errors_m[np.inf] ** 2


@pytest.mark.parametrize(("hops", "of_rigid", "most_m"), [(1, 0.35, 0.006), (5, 0.2, 0.011)])
def test_the_legs_follow_their_truth_and_the_trunk_stays(walker, hops, of_rigid, most_m):
    trunk_m, legs_m = walker.errors_m(walker.soft, hops)
    _, rigid_legs_m = walker.errors_m(rigid(parts_of(walker.seen)), hops)
    assert legs_m < of_rigid * rigid_legs_m
    assert trunk_m < most_m


# --- what is rigid --------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma_m", [0.0, 0.02])
def test_a_rigid_object_stays_rigid_to_the_bit(sigma_m):
    parts = parts_of(scans(Body.column(), sigma_m=sigma_m))
    result = soften(parts)
    assert result.alpha == np.inf
    assert result.held_out_m  # it was tried
    assert not result.hops and not result.velocity_m_s(3).any()
    assert result.carry(0, 10) is result.snapshots[0].points


@pytest.mark.parametrize(
    ("body", "num", "every"),
    [(Body.column(4.0), 7, 1), (Body.walker(), 4, 1), (Body.walker(), 7, 40)],
    ids=["long", "few sweeps", "few points"],
)
def test_what_cannot_be_told_is_not_tried(body, num, every):
    parts = [Snapshot(p.points[::every], p.time_s) for p in parts_of(scans(body, num))]
    result = soften(parts)
    assert result.alpha == np.inf and not result.held_out_m and not result.hops


def test_edges_and_gaps_do_not_pull():
    points = scans(Body.column())[0].part.points
    points = points[np.abs(points[:, 2] - 1.0) > 0.15]
    result = forced([Snapshot(points, 0.0), Snapshot(points, 0.1)])
    assert np.abs(result.hops[0, 1]).max() < 1e-9


# --- carrying -------------------------------------------------------------------------------------


def test_carrying_adds_up_the_steps_both_ways():
    rng = np.random.default_rng(1)
    points = rng.random((30, 3))
    step = np.array([0.1, -0.2, 0.05])
    parts = tuple(Snapshot(points + k * step, float(k)) for k in range(4))
    hops = {(a, b): np.tile(step * (b - a), (30, 1)) for a in range(4) for b in (a - 1, a + 1)}
    result = Softened(parts, hops, 1.0, {})
    for i in range(4):
        for j in range(4):
            np.testing.assert_allclose(result.carry(i, j), points + j * step, atol=1e-12)


def test_limbs_that_cross_keep_their_way():
    forth = np.array([0.1, 0.0, 0.0])
    high, low = np.array([0.0, 0.0, 0.002]), np.zeros(3)
    steps = np.repeat([forth, -forth], 5, axis=0)
    start = np.repeat([high, low], 5, axis=0)  # one leg over the other, meeting at part 1
    parts = tuple(Snapshot(start + (k - 1) * steps, float(k)) for k in range(3))
    hops = {(a, b): steps * (b - a) for a in range(3) for b in (a - 1, a + 1)}
    result = Softened(parts, hops, 1.0, {})
    np.testing.assert_allclose(result.carry(0, 2), start + steps, atol=1e-6)


# --- slow twins -----------------------------------------------------------------------------------


def test_a_solve_minimises_what_the_docstring_says(monkeypatch):
    monkeypatch.setattr(module, "_RESIDUAL_DROP", 1e-12)
    monkeypatch.setattr(module, "_MAX_PRODUCTS", 2000)
    rng = np.random.default_rng(3)
    parts = tuple(Snapshot(rng.random((12, 3)), t) for t in (0.0, 0.1, 0.3))
    bending = module._FlowSolver(parts)
    n = len(bending._source)
    pull = rng.normal(size=(n, 3))
    monkeypatch.setattr(module, "_ANCHOR", 0.0)
    monkeypatch.setattr(module, "_blur", lambda p, _, at, m: (pull * (p is at), np.zeros(n)))
    bending.refine(3)

    # |f_next / dt_next + f_previous / dt_previous|² of the middle part, point by point
    dense = np.eye(n) + module._ALPHAS[3] * bending._laplacian.toarray()
    rows = {hop: slice(*bending._begins[k : k + 2]) for k, hop in enumerate(bending._hops)}
    velocity = np.array([1 / 0.2, 1 / 0.1])
    velocity *= np.sqrt(2 / (velocity**2).sum())
    for pair in zip(np.arange(n)[rows[1, 2]], np.arange(n)[rows[1, 0]], strict=True):
        dense[np.ix_(pair, pair)] += np.outer(velocity, velocity)
    np.testing.assert_allclose(bending._flow, np.linalg.solve(dense, -pull), atol=1e-8)
