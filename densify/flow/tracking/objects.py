# SPDX-License-Identifier: MIT
"""Tracks of moving objects: observations, smooth motion, and accumulated shape.

Paths are penalised B-splines (Eilers, Marx, "Flexible Smoothing with B-splines and Penalties",
Statistical Science 1996). The third difference is penalised: the stiffest path has constant
acceleration, and softer paths can start and stop.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from densify.flow.surface_matching import apply, undo
from densify.flow.tracking.candidates import Batch, Obstacles
from densify.free_space.ground import HeightMap
from densify.free_space.range_image import FreeSpace
from densify.geometry.nearest import is_near, tree_of
from densify.geometry.types import Bool, Float, Int

_KNOT_S = 0.1
# Weights of the penalty: (noise of a state / (jerk · knot³))², noise 3 cm, jerk 0.03 and 10 m/s³
_STIFFNESSES = (1e6, 10.0)
# Fewer states, or a shorter time, determine no acceleration, or no jerk.
MIN_STATES, _JERK_STATES = 5, 8
MIN_SPAN_S, _JERK_S = (_KNOT_S * (states - 1.5) for states in (MIN_STATES, _JERK_STATES))
# Powers 3 to 0 of the time since a span began, by the coefficients of the four B-splines on it.
_CUBIC = np.array([[-1, 3, -3, 1], [3, -6, 3, 0], [-3, 0, 3, 0], [1, 4, 1, 0]]) / 6


@dataclass(frozen=True)
class Path:
    """A smooth motion: a cubic spline over time with d coordinates, first x and y in metres."""

    # (n,d) of n B-splines on n - 3 equal spans of time; a `Track` has d = 4: x, y, z (m), yaw (rad)
    coefficients: Float
    begin_s: float  # first time of the fit. The path continues at constant velocity before it.
    end_s: float  # last time of the fit. The path continues at constant velocity after it.
    # Root mean square distance of the states in x and y from the path, corrected for the degrees of
    # freedom
    residual_m: float

    @staticmethod
    def fit(times_s: Float, states: Float, weights: Float) -> Path:
        """Fit a path to states (m,d) at ascending times (m,), as stiff as the states allow.

        A softer path is taken only if its leave-one-out error, in closed form, is at least 20 %
        lower. A softer path needs at least 8 states and 0.65 s. Fewer than 5 states, or less than
        0.35 s, give a path of almost constant velocity. The weights (m,) are of any scale.
        """
        num_states = len(times_s)
        begin_s, end_s = float(times_s[0]), float(times_s[-1])
        duration_s = end_s - begin_s
        num_spans = max(1, round(duration_s / _KNOT_S))
        basis = _basis((times_s - begin_s) * (num_spans / duration_s), num_spans)
        # The fit minimises Σ weight |state - basis · coefficients|² + stiffness |difference ·
        # coefficients|². Third differences of the coefficients are 0 at constant acceleration,
        # second differences at constant velocity.
        may_accelerate = num_states >= MIN_STATES and duration_s >= MIN_SPAN_S
        difference = np.diff(np.eye(basis.shape[1]), 3 if may_accelerate else 2, axis=0)
        penalty = difference.T @ difference
        state_weight = weights / weights.mean()
        may_jerk = num_states >= _JERK_STATES and duration_s >= _JERK_S
        stiffnesses = _STIFFNESSES if may_jerk else _STIFFNESSES[:1]

        least_error_m = residual_m = np.inf
        coefficients = np.zeros(0)
        for stiffness in stiffnesses:
            # Linear map from the states to the coefficients of the penalised least-squares fit
            weighted_basis = state_weight[:, None] * basis
            fit_matrix = np.linalg.solve(
                basis.T @ weighted_basis + stiffness * penalty, basis.T * state_weight
            )
            trial = fit_matrix @ states
            # The diagonal of the map from the states to the fitted states
            leverage = np.einsum("ij,ji->i", basis, fit_matrix)
            distance_m = np.linalg.norm((states - basis @ trial)[:, :2], axis=1)
            # Distance of each state from the fit to the other states, without further fits: the
            # distance from the fit to all states, divided by 1 - leverage. Without the limit, a
            # state that alone determines a parameter would give 0 / 0.
            left_out_m = distance_m / np.maximum(1 - leverage, 1e-3)
            error_m = float(np.sqrt(np.average(left_out_m**2, weights=state_weight)))
            if error_m < 0.8 * least_error_m:
                # The leverages sum to the number of fitted parameters. Half a degree of freedom
                # remains at least.
                freedom = max(num_states - leverage.sum() - 0.5, 0.5)
                mean_square_m2 = float(np.average(distance_m**2, weights=state_weight))
                residual_m = float(np.sqrt(mean_square_m2 * num_states / freedom))
                least_error_m = error_m
                coefficients = trial
        return Path(coefficients, begin_s, end_s, residual_m)

    @cached_property
    def _pieces(self) -> tuple[Float, Float]:
        """The P pieces of the path: begins (P,) in seconds, and cubic polynomials (4,P,d)."""
        num_spans = len(self.coefficients) - 3
        span_s = (self.end_s - self.begin_s) / num_spans
        # Span k is a cubic polynomial of the coefficients k to k + 3. Its rows are the powers 3 to
        # 0 of the time since the span began, in units of a span.
        controls = np.stack([self.coefficients[k : k + num_spans] for k in range(4)])
        spans = np.einsum("pk,knd->pnd", _CUBIC, controls)
        # Outside the spans the path continues as a straight line, a piece at either end.
        linear, constant = 2, 3  # rows of the powers 1 and 0
        before, after = np.zeros((2, 4, 1, spans.shape[2]))
        # The piece before the spans begins one span earlier, where its value is one slope lower.
        before[linear] = spans[linear, :1]
        before[constant] = spans[constant, :1] - before[linear]
        # The piece after the spans begins with value and slope of the last span at time 1. At this
        # time all powers are 1, and their derivatives are 3, 2, 1 and 0.
        after[constant] = spans[:, -1:].sum(axis=0)
        after[linear] = np.arange(3.0, -1.0, -1) @ spans[:, -1]
        # From units of a span to seconds
        per_second = span_s ** -np.arange(3, -1.0, -1)
        pieces = np.concatenate([before, spans, after], axis=1) * per_second[:, None, None]
        return self.begin_s + span_s * np.arange(-1.0, num_spans + 1), pieces

    def _piece_at(self, time_s: float | Float) -> tuple[Float, Float]:
        """Return polynomials (4,...,d) at times (...), and seconds (...,1) since they begin."""
        begins_s, pieces = self._pieces
        piece = begins_s[1:].searchsorted(time_s, side="right")
        return pieces.take(piece, axis=1), np.asarray(time_s - begins_s[piece])[..., None]

    def __call__(self, time_s: float | Float) -> Float:
        """Return the states (...,d) at times (...) in seconds, in metres and radians."""
        (cubic, square, linear, constant), since_s = self._piece_at(time_s)
        return ((cubic * since_s + square) * since_s + linear) * since_s + constant

    def rate(self, time_s: float | Float) -> Float:
        """Return the rates (...,d) at times (...) in s: of a track m/s in x, y, z, rad/s in yaw."""
        (cubic, square, linear, _), since_s = self._piece_at(time_s)
        return (3 * cubic * since_s + 2 * square) * since_s + linear


def _basis(at_span: Float, num_spans: int) -> Float:
    """Return the values (m,n) of n = num_spans + 3 B-splines at times (m,), in units of a span."""
    span = np.minimum(at_span.astype(np.int64), num_spans - 1)  # the end is in the last span
    powers = (at_span - span)[:, None] ** np.arange(3, -1, -1)
    basis = np.zeros((len(at_span), num_spans + 3))
    # The four B-splines that are above 0 on a span have the numbers of the span and the next three.
    np.put_along_axis(basis, span[:, None] + np.arange(4), powers @ _CUBIC, axis=1)
    return basis


BESIDE_M = 1.0  # from a towing vehicle to its trailer, and from an object to the road
_OUTLINE_M = 0.05  # distance outside an outline that still counts as inside
LONG_M = 3.0  # objects shorter than this may bend, and need not move where they point
LANE_M = 15.0  # distance ahead of and behind an object within which its parts are searched
_SIDE_M = 0.1  # margin of a lane
_BIN_M = 0.05  # width of the bins of the histograms from which the sides are found


def near_m(gap_m: Float | float) -> Any:
    """Return the neighbour distance (m) for ring gaps (m): half the gap, but at least 0.2 m."""
    return np.maximum(0.2, 0.5 * gap_m)  # 0.2 m covers noise and errors of registration


@dataclass(frozen=True)
class Observation:
    """The pose of an object in one `Batch` (some consecutive sweeps within 0.1 s)."""

    # (4,) displacement x, y, z (m) and yaw (rad) since the first observation, world axes; z follows
    # the ground
    state: Float
    seen_s: float  # mean firing time of the object's points, since the first sweep of the stretch
    time_ns: int  # middle time of the batch, ns since the first sweep of the stretch
    sweeps: tuple[int, ...]  # indices of the sweeps of the batch in which the object has points


@dataclass
class Track:
    """One rigid object, its pose in each `Batch` of sweeps, and its points.

    The object's frame is the world at the first observation. From there it moves by a state:
    displacement x, y, z (m) and yaw (rad) about ``centre``.
    """

    centre: Float  # (3,) position about which the object rotates, in the object's frame
    # Batch index -> pose of the object, in the order of tracking
    observations: dict[int, Observation] = field(default_factory=dict)
    # Sweep index -> indices, in this sweep's `Obstacles`, of the object's points
    claimed: dict[int, Int] = field(default_factory=dict)
    # Smooth motion through the states over time; exists after `smooth`
    path: Path = field(init=False)

    def add(self, n: int, batch: Batch, state: Float, seen_s: float, rows: Int) -> None:
        """Add the observation in batch n: a state (4,), with points at ascending obstacle rows."""
        rows_by_sweep = batch.split(rows)
        self.observations[n] = Observation(state, seen_s, batch.time_ns, tuple(rows_by_sweep))
        self.claimed |= rows_by_sweep

    def smooth(self) -> None:
        """Fit ``path`` to the states, in place; observations with more points weigh more."""
        batches = sorted(self.observations)
        times_s = np.array([self.observations[n].seen_s for n in batches])
        states = np.stack([self.observations[n].state for n in batches])
        # More than 100 points do not locate an object better.
        weights = np.array([min(self.num_points(n), 100) for n in batches], float)
        self.path = Path.fit(times_s, states, weights)

    def place(self, points: Float, time_s: float | Float) -> Float:
        """Return points (N,3) of the object's frame in the world, at one time (s) or (N,) times."""
        return apply(self.path(time_s), points, self.centre)

    def undo(self, points: Float, time_s: float | Float) -> Float:
        """Return world points (N,3) of one time (s), or of (N,) times, in the object's frame."""
        return undo(self.path(time_s), points, self.centre)

    def carry(self, points: Float, from_s: float | Float, to_s: float | Float) -> Float:
        """Return world points (N,3) that moved with the object from one time (s) to another."""
        return self.place(self.undo(points, from_s), to_s)

    def velocity_m_s(self, points: Float, time_s: float) -> Float:
        """Return the velocities (N,3), world, of the object's points (N,3, world) at a time (s)."""
        state, rate = self.path(time_s), self.path.rate(time_s)
        # Velocity of the centre, plus (-y, x) times the turn rate, with x and y from the centre
        velocity_m_s = np.tile(rate[:3], (len(points), 1))
        velocity_m_s[:, 0] -= rate[3] * (points[:, 1] - self.centre[1] - state[1])
        velocity_m_s[:, 1] += rate[3] * (points[:, 0] - self.centre[0] - state[0])
        return velocity_m_s

    def seen_through(self, points: Float, j: int, space: FreeSpace) -> Bool:
        """Return the mask of points (N,3, object's frame) that, moved, sweep j sees through."""
        at_s = space.clock.time_s[j]
        carried = self.place(points, at_s)
        return space.seen_through(carried, j, self.velocity_m_s(carried, at_s))

    def in_object(self, obstacles: Obstacles, rows: Int) -> Float:
        """Return the obstacles ``rows`` (N,) of a sweep as points (N,3) in the object's frame."""
        return self.undo(obstacles.points[rows], obstacles.time_s[rows])

    def points_in(self, obstacles: Sequence[Obstacles], sweeps: Iterable[int]) -> Float:
        """Return the object's points (N,3) in some sweeps (by index), in the object's frame."""
        clouds = (self.in_object(obstacles[j], self.claimed[j]) for j in sweeps)
        return np.concatenate([np.zeros((0, 3)), *clouds])

    def num_points(self, n: int) -> int:
        """Return the number of the object's points in batch index n."""
        return sum(len(self.claimed[j]) for j in self.observations[n].sweeps)

    def total_points(self) -> int:
        """Return the number of the object's points in all sweeps."""
        return sum(map(len, self.claimed.values()))

    def rise_m(self, ground: HeightMap, state: Float) -> float:
        """Return the rise (m) of the ground from the first position to that of a state (4,)."""
        # The median over three lines along the motion, in the middle and 1 m to both sides: the
        # road below an object may never be observed.
        ahead = state[:2] / max(float(np.linalg.norm(state[:2])), 1e-9)
        starts = self.centre[:2] + np.outer([-BESIDE_M, 0.0, BESIDE_M], [-ahead[1], ahead[0]])
        ends = starts + state[:2]
        start_height_m, end_height_m = ground.under(np.concatenate([starts, ends])).reshape(2, -1)
        return float(np.sort(end_height_m - start_height_m)[len(starts) // 2])

    def seen_at(self, time_ns: int) -> float:
        """Estimate when (s) a sweep measures the object, by the reference time of the sweep."""
        # Both times count from the first sweep. The delay from the reference time to the firing
        # time is that of the observation nearest in time, of two equally near the earlier one.
        _, observation = min(
            self.observations.items(), key=lambda item: (abs(item[1].time_ns - time_ns), item[0])
        )
        return time_ns * 1e-9 + observation.seen_s - observation.time_ns * 1e-9


@dataclass(frozen=True)
class Shape:
    """The accumulated points of one object, in the object's frame with z up."""

    points: Float  # (M,3) metres
    tree: cKDTree  # search tree of the points
    # (K,3) points that bound the others: corners of the convex outline, lowest and highest point
    rim: Float
    # (E,3) lines of the convex outline seen from above: outward normal x, y and offset, so that
    # ``normal · xy + offset`` is below 0 inside; (0,3) if the points span no area
    edges: Float

    @staticmethod
    def of(points: Float) -> Shape:
        """Build the shape of an object from accumulated points (M,3), object's frame, M >= 1."""
        try:
            hull = ConvexHull(points[:, :2])
        except (QhullError, ValueError):  # too few points, or all on a line
            return Shape(points, tree_of(points), points, np.zeros((0, 3)))
        z = points[:, 2]
        rim = points[[*hull.vertices, z.argmin(), z.argmax()]]
        return Shape(points, tree_of(points), rim, hull.equations)

    def within_outline(self, points: Float) -> Bool:
        """Return the (N,) mask of points (N,3, object's frame) in the outline seen from above."""
        if not len(self.edges):
            return np.zeros(len(points), bool)
        return (points[:, :2] @ self.edges[:, :2].T + self.edges[:, 2] < _OUTLINE_M).all(1)

    def near(self, points: Float, within_m: float) -> Bool:
        """Return the mask (N,) of points (N,3, object's frame) near the shape or in its outline."""
        return is_near(self.tree, points, within_m) | self.within_outline(points)

    @cached_property
    def side_rad(self) -> float:
        """The direction of one side seen from above, rad in [0, pi / 2), object's frame."""
        # The sides of a vehicle are parallel or perpendicular. Along the axes of the sides,
        # histograms of the points are most peaked (greatest sum of squares).
        points = self.points[:: len(self.points) // 1000 + 1, :2]
        points = points - points.mean(axis=0)
        reach_m = float(np.linalg.norm(points, axis=1).max())
        num_bins = int(2 * reach_m / _BIN_M) + 2  # rounded up, and one bin for the end itself
        angles_rad = np.deg2rad(np.arange(0.0, 90.0, 0.5))
        score = np.zeros(len(angles_rad))
        for axis_rad in (angles_rad, angles_rad + np.pi / 2):
            # Coordinates along the axis, a row for each angle, a column for each point
            along_m = np.outer(np.cos(axis_rad), points[:, 0])
            along_m += np.outer(np.sin(axis_rad), points[:, 1])
            bin_number = ((along_m + reach_m) / _BIN_M).astype(np.int64)
            # Each angle has bins of its own. One count gives the histograms of all angles.
            bin_number += num_bins * np.arange(len(angles_rad))[:, None]
            counts = np.bincount(bin_number.ravel(), minlength=num_bins * len(angles_rad))
            score += (counts.reshape(-1, num_bins) ** 2).sum(axis=1)
        return float(angles_rad[np.argmax(score)])


class MovingObject(NamedTuple):
    """A confirmed track with its shape."""

    track: Track  # motion of the object
    shape: Shape  # points of the object in its own frame

    def may_be_near(self, points: Float, time_s: float | Float, within_m: float) -> bool:
        """Return False if the boxes around the object and points (N,3, world) are apart.

        Then no point, measured at one time or (N,) times ``time_s``, is within ``within_m``.
        """
        # The object is placed at the mean time. The motion until the other times widens the box.
        at_s = float(np.mean(time_s))
        travel_m = float(np.ptp(time_s) * np.linalg.norm(self.track.path.rate(at_s)[:2]))
        rim = self.track.place(self.shape.rim, at_s)
        apart_m = np.maximum(points.min(0) - rim.max(0), rim.min(0) - points.max(0))
        return bool((apart_m <= within_m + travel_m).all())

    def heading(self, at_s: float) -> Float:
        """Return the horizontal unit vector (2,) along the object at a time (s), world.

        The heading of an object longer than 3 m is the direction of the side closest to the
        velocity, because a turning trailer does not move where it points. That of a shorter object
        is the direction of the velocity.
        """
        velocity_m_s = self.track.path.rate(at_s)[:2]
        direction = velocity_m_s / max(float(np.linalg.norm(velocity_m_s)), 1e-6)
        rim = self.track.place(self.shape.rim, at_s)[:, :2]
        if np.linalg.norm(np.ptp(rim, axis=0)) < LONG_M:
            return direction
        yaw_rad = float(self.track.path(at_s)[3])
        sides_rad = self.shape.side_rad + yaw_rad + np.arange(4) * np.pi / 2
        sides = np.stack([np.cos(sides_rad), np.sin(sides_rad)], axis=1)
        side: Float = sides[np.argmax(sides @ direction)]
        return side if np.ptp(rim @ side) >= LONG_M else direction

    def lane(self, at_s: float) -> Lane:
        """Return the space ahead of and behind the object at a time (s)."""
        ahead = self.heading(at_s)
        rim = self.track.place(self.shape.rim, at_s)
        aside_m = rim[:, :2] @ [-ahead[1], ahead[0]]
        right_m, left_m = aside_m.min() - _SIDE_M, aside_m.max() + _SIDE_M
        return Lane(ahead, right_m, left_m, top_m=rim[:, 2].max() + _SIDE_M)


class Lane(NamedTuple):
    """The space ahead of and behind an object, as wide and as high as the object."""

    ahead: Float  # (2,) unit vector of the heading, world
    # Right border: coordinate along the left normal of ``ahead``, m from the world's origin
    right_m: float
    left_m: float  # left border, as ``right_m``
    top_m: float  # upper border: height in the world, m

    def holds(self, points: Float, slack_m: float = 0.0) -> Bool:
        """Return the (N,) mask of points (N,3, world) in the lane or within ``slack_m`` of it."""
        aside_m = points[:, :2] @ [-self.ahead[1], self.ahead[0]]
        inside: Bool = (aside_m > self.right_m - slack_m) & (aside_m < self.left_m + slack_m)
        return inside & (points[:, 2] < self.top_m + slack_m)
