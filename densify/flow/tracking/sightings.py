# SPDX-License-Identifier: MIT
"""One rigid object of a stretch: where looks saw it, and the smooth motion through these places."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from densify.flow.tracking import path_kernels as kernels
from densify.flow.tracking.candidates import Batch, Obstacles
from densify.flow.tracking.paths import Path
from densify.free_space.ground import HeightMap
from densify.free_space.seen_through import FreeSpace
from densify.geometry.types import Bool, Float

_MANY_POINTS = 100  # more do not place a look better
_BESIDE_M = 1.0


@dataclass(frozen=True)
class Sighting:
    """Where one look saw an object.

    state: (4,) x y z displacement (m) and yaw (rad) since the look it started in; z as the ground
    under it rises. seen_s: when that was. time_ns: the look's own time. sweeps: of the look, those
    that saw it.
    """

    state: Float
    seen_s: float
    time_ns: int
    sweeps: tuple[int, ...]


@dataclass
class Track:
    """One rigid object in the stretch.

    centre: (3,) about which it turns, world. sightings: by the look's index, in the order they were
    made. claimed: sweep index -> rows of `Obstacles` that are its. path: the smooth motion.
    """

    centre: Float
    sightings: dict[int, Sighting] = field(default_factory=dict)
    claimed: dict[int, np.ndarray] = field(default_factory=dict)
    path: Path = field(init=False)

    def carry(self, points: Float, from_s: float | Float, to_s: float | Float) -> Float:
        """(N,3) points of the object at one time -> at another, world; one time or one each."""
        return self.place(self.undo(points, from_s), to_s)

    def undo(self, points: Float, seen_s: float | Float) -> Float:
        """(N,3) points seen at a time -> in the object's own frame."""
        return self._moved(points, seen_s, forth=False)

    def place(self, points: Float, time_s: float | Float) -> Float:
        """Inverse of `undo`."""
        return self._moved(points, time_s, forth=True)

    def _moved(self, points: Float, time_s: float | Float, forth: bool) -> Float:
        path, times_s = self.path, np.array(time_s, np.float64, ndmin=1)
        along = kernels.Track(path.spline, path.derivative, path.begin_s, path.end_s, self.centre)
        moved = np.empty(points.shape)
        kernels.move.over_rows(len(points), points, times_s, along, forth, moved)
        return moved

    def velocity_m_s(self, points: Float, time_s: float) -> Float:
        """(N,3) of the object's points where they are at that time."""
        state, rate = self.path(time_s), self.path.rate(time_s)
        velocity_m_s = np.tile(rate[:3], (len(points), 1))
        velocity_m_s[:, 0] -= rate[3] * (points[:, 1] - self.centre[1] - state[1])
        velocity_m_s[:, 1] += rate[3] * (points[:, 0] - self.centre[0] - state[0])
        return velocity_m_s

    def seen_through(self, body: Float, j: int, space: FreeSpace) -> Bool:
        """(N,) which of the points in the object's own frame sweep number j sees through, where
        they are when it is taken."""
        at_s = space.clock.time_s[j]
        carried = self.place(body, at_s)
        return space.seen_through(carried, j, self.velocity_m_s(carried, at_s))

    def seen_in(self, obstacles: Sequence[Obstacles], sweeps: Iterable[int]) -> Float:
        """(N,3) what these sweeps saw of the object, in its own frame."""
        parts = [np.zeros((0, 3))]
        for j in sweeps:
            c, rows = obstacles[j], self.claimed[j]
            parts.append(self.undo(c.points[rows], c.time_s[rows]))
        return np.concatenate(parts)

    def add(self, n: int, look: Batch, state: Float, seen_s: float, rows: np.ndarray) -> None:
        """What look n saw of the object: ascending rows."""
        mine = look.split(rows)
        self.sightings[n] = Sighting(state, seen_s, look.time_ns, tuple(mine))
        self.claimed |= mine

    def num_points(self, n: int) -> int:
        """How many points look n shows of it."""
        return sum(len(self.claimed[j]) for j in self.sightings[n].sweeps)

    def total_points(self) -> int:
        """How many points it has in all sweeps."""
        return sum(map(len, self.claimed.values()))

    def rise_m(self, ground: HeightMap, state: Float) -> float:
        """How much higher the ground is in that state under the object and on both sides of it, in
        the median: nobody may ever have seen the road that it covers."""
        way = state[:2] / max(float(np.linalg.norm(state[:2])), 1e-9)
        start = self.centre[:2] + np.outer([-_BESIDE_M, 0.0, _BESIDE_M], [-way[1], way[0]])
        return float(np.median(ground.under(start + state[:2]) - ground.under(start)))

    def typical_size(self) -> float:
        """Points per look."""
        return float(np.median([self.num_points(n) for n in self.sightings]))

    def smooth(self) -> None:
        """Lay the path through the states; looks that saw many points count more."""
        looks = sorted(self.sightings)
        times_s = np.array([self.sightings[n].seen_s for n in looks])
        states = np.stack([self.sightings[n].state for n in looks])
        weights = np.array([min(self.num_points(n), _MANY_POINTS) for n in looks], float)
        self.path = Path.fit(times_s, states, weights)

    def seen_at(self, time_ns: int) -> float:
        """When a look or sweep of that reference time sees, or would see, the object."""
        _, nearest = min(
            self.sightings.items(), key=lambda item: (abs(item[1].time_ns - time_ns), item[0])
        )
        return time_ns * 1e-9 + nearest.seen_s - nearest.time_ns * 1e-9
