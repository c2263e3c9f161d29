# SPDX-License-Identifier: MIT
"""Decide by a log-likelihood ratio whether a track moves or is static.

A static object that looks different from sweep to sweep, such as a fence or a tree's crown, can
seem to move. The log odds are ``w · terms - price``. Each term is the logarithm of a measured
quantity. The weights w and the prior cost of a track, ``price``, were fitted to tracks of simulated
streets: ``examples/fit_tracks.py`` makes the table, ``likelihood.json`` beside this file.
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
from densify.free_space.seen_through import REACH_S, FreeSpace
from densify.geometry.nearest import is_near, nearest, tree_of
from densify.geometry.types import Float

_NUM_STATES = 3  # fewer states always lie on a line
NUM_ASKED = 60
"""Number of tested points of a batch."""
_GIVEN = 5.0  # observations added to both counts, because few observations are weak evidence
_CLEARLY = 1.0  # difference of the log odds of two motions that exceeds noise
_ROUGH = 0.1  # accuracy of a state, as a share of the neighbour distance

_FILE = Path(__file__).with_name("likelihood.json")

Judge = Callable[[Track, "Evidence"], None]


class Places(NamedTuple):
    """Counts of what other sweeps observed at positions where the object is at another time."""

    num_occupied: int  # number of positions with a return of something else
    num_free: int  # number of positions in observed free space

    def log_occupied(self) -> float:
        """Return the log odds that a position is occupied, near 0 for few observations."""
        return float(np.log((self.num_occupied + _GIVEN) / (self.num_free + _GIVEN)))


class Violations(NamedTuple):
    """How often another sweep saw through the points of a track."""

    static: int  # number of tests in which the measured position of a point is seen through
    moved: int  # number of tests in which the position predicted by the motion is seen through
    tests: int  # number of tests, each of both positions


class Evidence(NamedTuple):
    """Evidence that tells a moving track from a static one.

    Lengths are divided by the distance up to which points count as neighbours there (`near_m`).
    """

    violations: Violations  # seen-through counts of the track's points, as static and as moved
    before: Places  # observations at positions of the object before it arrives there
    after: Places  # observations at positions of the object after it leaves
    travelled: float  # distance between begin and end of the path, in neighbour distances
    rough: float  # residual of the states about the path, in neighbour distances
    slender: float  # ratio of extent along the motion to height, at least 1

    def terms(self) -> dict[str, float]:
        """Return the value of each term of the log odds, by its name in ``likelihood.json``."""
        static, moved, tests = self.violations
        less, more = sorted([self.before.log_occupied(), self.after.log_occupied()])
        return {
            "removed": float(np.log((max(static - moved, 0) + 1) / (tests + 1))),
            "left": float(np.log((moved + _GIVEN) / (static + _GIVEN))),
            "travelled": float(np.log(self.travelled + _ROUGH)),
            "rough": float(np.log(self.rough + _ROUGH)),
            "taken": less,
            "taken too": more,  # has less weight: the rest of a long object may be there
            "slender": float(np.log(self.slender) ** 2),
        }

    def log_odds(self, table: Mapping[str, float]) -> float:
        """Return the log odds that the track moves; ``table``: weights of terms, and ``price``."""
        return sum(table[name] * value for name, value in self.terms().items()) - table["price"]


class Verdict(NamedTuple):
    """The log odds that a track moves."""

    log_odds: float  # log odds that the track moves; above 0 it is confirmed
    at_most: float  # log odds that the track would have if its motion left no violations

    @property
    def moves(self) -> bool:
        """Return True if the track more likely moves than not."""
        return self.log_odds > 0

    def is_clearly_below(self, log_odds: float) -> bool:
        """Return True if another motion, with these log odds, is clearly more likely."""
        return log_odds > max(self.log_odds, 0.0) + _CLEARLY


def judge(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
    judged: Judge | None = None,
) -> Verdict:
    """Return the log odds that a smoothed track moves, minus infinity below 3 observations.

    Returns of the ``objects`` confirmed so far do not count against the track. ``judged`` is called
    with the track and its evidence.
    """
    if len(track.observations) < _NUM_STATES:
        return Verdict(-np.inf, -np.inf)
    violations = count_violations(track, obstacles, space)
    within_m = near_m(space.gap_m(track.centre, next(iter(track.claimed))))
    best_case = Places(0, violations.tests)
    evidence = Evidence(
        violations,
        best_case,
        best_case,
        track.path.travelled_m() / within_m,
        track.path.residual_m / within_m,
        _slenderness(track, obstacles, within_m),
    )
    # Vacated positions cost most time. They are skipped if the other terms already reject.
    if judged is not None or evidence.log_odds(own_table()) > 0:
        before, after = find_places_left(track, obstacles, space, objects, within_m)
        evidence = evidence._replace(before=before, after=after)
    if judged is not None:
        judged(track, evidence)
    without_violations = evidence._replace(violations=violations._replace(moved=0))
    return Verdict(evidence.log_odds(own_table()), without_violations.log_odds(own_table()))


def count_violations(track: Track, obstacles: Sequence[Obstacles], space: FreeSpace) -> Violations:
    """Count how often other sweeps see through sampled track points, as static and as moved."""
    tested = {}
    for batch in space.batches:
        num = NUM_ASKED // len(batch)
        for i in batch:
            if i in track.claimed:
                rows = track.claimed[i]
                tested[i] = rows[:: len(rows) // num + 1]
    observers = {i: frozenset(space.others(i)) for i in tested}
    points = {i: obstacles[i].points[rows] for i, rows in tested.items()}
    in_object = {i: track.undo(points[i], obstacles[i].time_s[rows]) for i, rows in tested.items()}
    static = moved = num_tests = 0
    for j, *_ in space.batches:
        sources = [i for i in tested if j in observers[i]]
        if sources:
            carried = track.place(
                np.concatenate([in_object[i] for i in sources]), space.clock.time_s[j]
            )
            velocity_m_s = track.velocity_m_s(carried, space.clock.time_s[j])
            positions = np.concatenate([carried, *(points[i] for i in sources)])
            velocity_m_s = np.concatenate([velocity_m_s, np.zeros_like(carried)])
            violated = space.seen_through(positions, j, velocity_m_s)
            moved += int(violated[: len(carried)].sum())
            static += int(violated[len(carried) :].sum())
            num_tests += len(carried)
    return Violations(static, moved, num_tests)


def _slenderness(track: Track, obstacles: Sequence[Obstacles], within_m: float) -> float:
    """Return the extent of the points along their motion divided by their height, at least 1."""
    # A long, low guard rail shows no motion along itself, and is seen through between two rings.
    # within_m: accuracy of the height
    points = track.points_in(obstacles, track.claimed)
    motion = (track.path(track.path.end_s) - track.path(track.path.begin_s))[:2]
    along_m = float(np.ptp(points[:, :2] @ motion)) / max(float(np.hypot(*motion)), 1e-9)
    return max(1.0, along_m / (float(np.ptp(points[:, 2])) + within_m))


def find_places_left(
    track: Track,
    obstacles: Sequence[Obstacles],
    space: FreeSpace,
    objects: Sequence[MovingObject],
    within_m: float,
) -> tuple[Places, Places]:
    """Count what sweeps before an object's arrival, and after it left, observed at its positions.

    Vacated positions are free if the object moved. A static wire fence can imitate this: it is seen
    through from some directions only. Its vacated positions then hold returns of the fence, up to
    ``within_m`` away. Returns of ``objects``, the other confirmed ones, do not count.
    """
    sweeps = list(track.claimed)
    sampled = [
        obstacles[i].points[rows[:: len(rows) // NUM_ASKED + 1]]
        for i, rows in track.claimed.items()
    ]
    # sweep: (P,) index of the sweep that measured each position
    positions, sweep = np.concatenate(sampled), np.repeat(sweeps, [len(p) for p in sampled])
    tree = tree_of(track.points_in(obstacles, sweeps))
    rate = track.path.rate((track.path.begin_s + track.path.end_s) / 2)
    room_m = LINK_M + REACH_S * float(np.linalg.norm(rate[:2]))
    counts = np.zeros((2, 2), np.int64)
    for batch in space.batches:
        away_m, _ = nearest(tree, track.undo(positions, space.clock.time_s[batch[0]]), room_m)
        is_vacated = (away_m > LINK_M) & np.isfinite(away_m)
        is_vacated &= (sweep < batch[0]) | (sweep > batch[-1])
        if not is_vacated.any():
            continue
        vacated, is_after = positions[is_vacated], sweep[is_vacated] < batch[0]
        returns = [_returns_near(vacated, within_m, obstacles[j], objects) for j in batch]
        is_occupied = is_near(tree_of(np.concatenate(returns)), vacated, within_m)
        is_free = space.seen_through(vacated, batch[0]) & ~is_occupied
        for count, side in zip(counts, (~is_after, is_after), strict=True):
            count += [np.count_nonzero(is_occupied & side), np.count_nonzero(is_free & side)]
    before, after = counts.tolist()
    return Places(*before), Places(*after)


def _returns_near(
    positions: Float, reach_m: float, obstacles: Obstacles, objects: Sequence[MovingObject]
) -> Float:
    """Return the (N,3) points within ``reach_m`` of positions (M,3), world, on no given object."""
    rows = obstacles.strips.rows_inside(positions.min(0) - reach_m, positions.max(0) + reach_m)
    rows = rows[is_near(tree_of(positions), obstacles.points[rows], reach_m)]
    for track, shape in objects:
        points, time_s = obstacles.points[rows], obstacles.time_s[rows]
        if len(rows) and MovingObject(track, shape).may_be_near(points, time_s, LINK_M):
            rows = rows[~shape.near(track.undo(points, time_s), LINK_M)]
    return obstacles.points[rows]


@cache
def own_table() -> Mapping[str, float]:
    """Return the package's weights by term, and ``price``, from examples/fit_tracks.py."""
    weights: Mapping[str, float] = read_json(_FILE)["weights"]
    return weights
