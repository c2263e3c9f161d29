# SPDX-License-Identifier: MIT
"""Decide by a log-likelihood ratio whether a track moves or is static.

A static object that looks different from sweep to sweep, such as a fence or a treetop, can seem to
move. The log odds are ``w · terms - price``, each term the logarithm of a measured quantity;
``examples/fit_tracks.py`` fitted ``likelihood.json`` to tracks of simulated streets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.file_content import read_json
from densify.flow.tracking.candidates import LINK_M, Obstacles
from densify.flow.tracking.objects import MovingObject, Track, near_m
from densify.free_space.range_image import REACH_S, FreeSpace
from densify.geometry.nearest import is_near, nearest, tree_of
from densify.geometry.types import Float

NUM_ASKED = 60  # greatest number of points of a batch whose positions are tested
_PRIOR_COUNT = 5.0  # added to both counts of a ratio, because few observations are weak evidence
_CLEARLY = 1.0  # difference of the log odds of two motions that exceeds noise
_MIN_ROUGHNESS = 0.1  # accuracy of a state, as a share of the neighbour distance

RecordEvidence = Callable[[Track, "Evidence"], None]


class Places(NamedTuple):
    """Counts of what other sweeps observed at positions where the object is at another time."""

    num_occupied: int  # number of positions with a return of something else
    num_free: int  # number of positions in observed free space

    def log_occupied(self) -> float:
        """Return the log odds that a position is occupied; few observations give almost 0."""
        return float(np.log((self.num_occupied + _PRIOR_COUNT) / (self.num_free + _PRIOR_COUNT)))


class Violations(NamedTuple):
    """How often another sweep saw through the points of a track."""

    static: int  # number of tests in which the measured position of a point is seen through
    moved: int  # number of tests in which the position predicted by the motion is seen through
    tests: int  # number of tests, each of both positions


class Evidence(NamedTuple):
    """Evidence that tells a moving track from a static one; lengths are divided by `near_m`."""

    violations: Violations  # violations by the track's points, as static and as moved
    before: Places  # observations at positions of the object before it arrives there
    after: Places  # observations at positions of the object after it leaves
    distance: float  # distance between begin and end of the path, in neighbour distances
    roughness: float  # residual of the states about the path, in neighbour distances
    slenderness: float  # ratio of extent along the motion to height, at least 1

    def terms(self) -> dict[str, float]:
        """Return the value of each term of the log odds, by its name in ``likelihood.json``.

        ``removed`` and ``left`` compare violations of the moved and the static track.
        ``travelled``, ``rough`` and ``slender`` describe path and shape. ``taken`` and ``taken
        too`` tell if positions that a moving object vacates hold something else.
        """
        num_static, num_moved, num_tests = self.violations
        num_removed = max(num_static - num_moved, 0)  # violations that the motion explains
        # Log odds that a position of the object holds something else before it arrives there, and
        # after it leaves. The greater has less weight: the rest of a long object may be there.
        occupied = self.before.log_occupied(), self.after.log_occupied()
        return {
            # Violations that the motion removes, as a share of the tests; 1 avoids log(0)
            "removed": float(np.log((num_removed + 1) / (num_tests + 1))),
            # Violations that remain with the motion, as a share of those of the static track
            "left": float(np.log((num_moved + _PRIOR_COUNT) / (num_static + _PRIOR_COUNT))),
            # Distance that the object travels; the constant keeps the logarithm finite
            "travelled": float(np.log(self.distance + _MIN_ROUGHNESS)),
            # Scatter of the states about the smooth path
            "rough": float(np.log(self.roughness + _MIN_ROUGHNESS)),
            "taken": min(occupied),
            "taken too": max(occupied),
            # Length relative to height. The square leaves objects about as long as high almost
            # untouched, and counts against long guard rails.
            "slender": float(np.log(self.slenderness) ** 2),
        }

    def log_odds(self, weights: Mapping[str, float]) -> float:
        """Return the log odds to move; ``weights`` has a weight for each term, and ``price``."""
        terms = self.terms().items()
        return sum(weights[name] * value for name, value in terms) - weights["price"]


class Verdict(NamedTuple):
    """A track that was tried, and the log odds that it moves."""

    track: Track
    log_odds: float = -np.inf  # log odds that the track moves; above 0 it is confirmed
    # Log odds that the track would have if its motion left no violations
    best_log_odds: float = -np.inf

    @property
    def moves(self) -> bool:
        """Return True if the track moves more likely than not."""
        return self.log_odds > 0

    @property
    def leaves_much_unexplained(self) -> bool:
        """Return True if a motion without violations would be clearly more likely."""
        return self._is_clearly_below(self.best_log_odds)

    def or_better(self, other: Verdict) -> Verdict:
        """Return the other verdict if its track is clearly more likely, else this one."""
        return other if self._is_clearly_below(other.log_odds) else self

    def _is_clearly_below(self, log_odds: float) -> bool:
        """Return True if other log odds exceed this track's, and 0, by more than noise."""
        return log_odds > max(self.log_odds, 0.0) + _CLEARLY


def judge(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
    record: RecordEvidence | None = None,
) -> Verdict:
    """Judge a smoothed track by the log odds that it moves, minus infinity below 3 observations.

    Args:
        obstacles: Points above the ground of each sweep of the stretch.
        objects: Objects confirmed so far. Their returns do not count against the track.
        record: Called with the track and its evidence, unless it has fewer than 3 observations.
    """
    if len(track.observations) < 3:  # fewer states always lie on a line
        return Verdict(track)
    path = track.path
    travel = (path(path.end_s) - path(path.begin_s))[:2]
    violations = count_violations(track, obstacles, space)
    neighbour_m = near_m(space.gap_m(track.centre, next(iter(track.claimed))))
    # Observations at vacated positions cost most time. At first all positions are assumed to be
    # free, which favours motion. The real observations are counted only if the other terms do not
    # reject the track even under this assumption.
    all_free = Places(num_occupied=0, num_free=violations.tests)
    evidence = Evidence(
        violations=violations,
        before=all_free,
        after=all_free,
        distance=float(np.linalg.norm(travel)) / neighbour_m,
        roughness=path.residual_m / neighbour_m,
        slenderness=_slenderness(track.points_in(obstacles, track.claimed), travel, neighbour_m),
    )
    weights = fitted_weights()
    if record is not None or evidence.log_odds(weights) > 0:
        before, after = count_vacated_places(track, obstacles, space, objects, neighbour_m)
        evidence = evidence._replace(before=before, after=after)
    if record is not None:
        record(track, evidence)
    without_violations = evidence._replace(violations=violations._replace(moved=0))
    return Verdict(track, evidence.log_odds(weights), without_violations.log_odds(weights))


def count_violations(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Violations:
    """Count how often other sweeps see through points of a track, as static and as moved.

    At most 60 points of each batch are tested, by the first sweep of each other batch in reach.
    """
    # Sample at most 60 points of each batch, by sweep index.
    tested_rows = {}
    for batch in space.batches:
        num_per_sweep = NUM_ASKED // len(batch)
        for i in batch:
            if i in track.claimed:
                rows = track.claimed[i]
                tested_rows[i] = rows[:: len(rows) // num_per_sweep + 1]
    observers = {i: frozenset(space.others(i)) for i in tested_rows}
    points = {i: obstacles[i].points[rows] for i, rows in tested_rows.items()}
    in_object = {i: track.in_object(obstacles[i], rows) for i, rows in tested_rows.items()}

    num_static = num_moved = num_tests = 0  # violations as static and as moved, and all tests
    for batch in space.batches:
        observer = batch[0]  # the first sweep stands for its batch
        # Only sweeps within reach of the observer have points that it can test.
        sources = [i for i in tested_rows if observer in observers[i]]
        if not sources:
            continue
        at_s = space.clock.time_s[observer]
        carried = track.place(np.concatenate([in_object[i] for i in sources]), at_s)
        measured = np.concatenate([points[i] for i in sources])
        # One call tests both positions of each point: moved with the track, and as measured.
        positions = np.concatenate([carried, measured])
        carried_m_s = track.velocity_m_s(carried, at_s)
        velocity_m_s = np.concatenate([carried_m_s, np.zeros_like(carried)])
        is_violated = space.seen_through(positions, observer, velocity_m_s)
        num_moved += int(is_violated[: len(carried)].sum())
        num_static += int(is_violated[len(carried) :].sum())
        num_tests += len(carried)
    return Violations(num_static, num_moved, num_tests)


def _slenderness(points: Float, travel: Float, neighbour_m: float) -> float:
    """Return the extent of points (N,3) along ``travel`` (2,) divided by their height, or 1."""
    # A long, low guard rail shows no motion along itself, and is seen through between two rings.
    length_m = float(np.ptp(points[:, :2] @ travel)) / max(float(np.hypot(*travel)), 1e-9)
    height_m = float(np.ptp(points[:, 2]))
    # The height is known to the neighbour distance only, which also avoids a division by 0.
    return max(1.0, length_m / (height_m + neighbour_m))


def count_vacated_places(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
    within_m: float,
) -> tuple[Places, Places]:
    """Count what other sweeps observed where an object was, before it came and after it left.

    Vacated positions are free if the object moved. A static wire fence, which is seen through from
    some directions only, can imitate a moving object. Its vacated positions then hold returns of
    the fence. A return within ``within_m`` occupies a position, unless it is of another object.

    Returns:
        The counts before the object came, and the counts after it left.
    """
    sweeps = list(track.claimed)
    samples = [
        obstacles[i].points[rows[:: len(rows) // NUM_ASKED + 1]]
        for i, rows in track.claimed.items()
    ]
    positions = np.concatenate(samples)
    # (P,) index of the sweep that measured each position
    sweep_of_position = np.repeat(sweeps, [len(sample) for sample in samples])
    tree = tree_of(track.points_in(obstacles, sweeps))
    rate = track.path.rate((track.path.begin_s + track.path.end_s) / 2)
    # Positions that the object left longer than `REACH_S` ago do not count.
    reach_m = LINK_M + REACH_S * float(np.linalg.norm(rate[:2]))
    counts = np.zeros((2, 2), int)  # rows: before and after; columns: occupied and free
    for batch in space.batches:
        first_sweep, last_sweep = batch[0], batch[-1]
        in_object = track.undo(positions, space.clock.time_s[first_sweep])
        distance_m, _ = nearest(tree, in_object, reach_m)
        # A position is vacated if the object is away from it in this batch. The distance is
        # infinite beyond ``reach_m``. Positions measured in this batch itself are not vacated.
        is_vacated = (distance_m > LINK_M) & np.isfinite(distance_m)
        is_vacated &= (sweep_of_position < first_sweep) | (sweep_of_position > last_sweep)
        if not is_vacated.any():
            continue
        vacated = positions[is_vacated]
        is_after = sweep_of_position[is_vacated] < first_sweep  # the object has left already
        returns = [_returns_near(vacated, within_m, obstacles[j], objects) for j in batch]
        is_occupied = is_near(tree_of(np.concatenate(returns)), vacated, within_m)
        is_free = space.seen_through(vacated, first_sweep) & ~is_occupied
        for row, at_row in enumerate((~is_after, is_after)):
            counts[row] += is_occupied[at_row].sum(), is_free[at_row].sum()
    before, after = counts.tolist()
    return Places(*before), Places(*after)


def _returns_near(
    positions: Float, reach_m: float, obstacles: Obstacles, objects: Sequence[MovingObject]
) -> Float:
    """Return the (N,3) obstacles of no object within ``reach_m`` of positions (M,3), world."""
    rows = obstacles.strips.rows_inside(positions.min(0) - reach_m, positions.max(0) + reach_m)
    rows = rows[is_near(tree_of(positions), obstacles.points[rows], reach_m)]
    points, time_s = obstacles.points[rows], obstacles.time_s[rows]
    for moving_object in objects:
        if len(points) and moving_object.may_be_near(points, time_s, LINK_M):
            in_object = moving_object.track.undo(points, time_s)
            is_other = ~moving_object.shape.near(in_object, LINK_M)
            points, time_s = points[is_other], time_s[is_other]
    return points


@cache
def fitted_weights() -> Mapping[str, float]:
    """Return the fitted weight of each term of the log odds by its name, and the ``price``."""
    return read_json(Path(__file__).with_name("likelihood.json"))["weights"]
