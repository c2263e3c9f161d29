# SPDX-License-Identifier: MIT
"""Analytic poses of bodies at any time, and the rectangles they cover on the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from densify.geometry.types import Bool, Float, Int
from densify.street.mesh import Mesh, across, lengths
from densify.street.terrain import Curve, Speed, Terrain, left_of


class Poses(NamedTuple):
    """N poses ``T_world_body``. rotation: (N,3,3). position: (N,3) metres."""

    rotation: Float
    position: Float

    def apply(self, points: Float) -> Float:
        """(N,3) body -> (N,3) world, row by row."""
        return self.turn(points) + self.position

    def undo(self, points: Float) -> Float:
        """(N,3) world -> (N,3) body, row by row."""
        return self.unturn(points - self.position)

    def turn(self, directions: Float) -> Float:
        """(N,3) body -> (N,3) world axes."""
        return np.einsum("nij,nj->ni", self.rotation, directions)

    def unturn(self, directions: Float) -> Float:
        """(N,3) world -> (N,3) body axes."""
        return np.einsum("nji,nj->ni", self.rotation, directions)

    def rows(self, rows: Int) -> Poses:
        """Some of them, in that order, as often as asked for."""
        return Poses(self.rotation[rows], self.position[rows])

    def matrix(self, row: int = 0) -> Float:
        """(4,4) ``T_world_body`` of one row."""
        T_world_body = np.eye(4)
        T_world_body[:3, :3], T_world_body[:3, 3] = self.rotation[row], self.position[row]
        return T_world_body


def upright(xyz: Sequence[float], heading: float) -> Poses:
    """One pose: at a place (3,), x turned from the world's by ``heading`` (rad)."""
    turn = Rotation.from_euler("z", heading).as_matrix()
    return Poses(turn[None], np.asarray(xyz, float)[None])


class Trajectory(Protocol):
    def poses(self, times_s: Float) -> Poses:
        """(N,) seconds since the sequence's time zero -> N poses."""
        ...


def poses_at(trajectory: Trajectory, times_s: Float) -> Poses:
    """(N,) seconds -> N poses, worked out once for equal times in a row."""
    new = np.diff(times_s, prepend=np.nan) != 0
    if new.all():
        return trajectory.poses(times_s)
    return trajectory.poses(times_s[new]).rows(np.cumsum(new) - 1)


class Still:
    """The world itself."""

    def poses(self, times_s: Float) -> Poses:
        n = len(times_s)
        return Poses(np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)))


@dataclass(frozen=True)
class Driving:
    """Follows a curve on the ground with both axles, as a car does.

    curve, speed: the way, and how fast along it. station_m: arc length at time ``at_s``.
    wheelbase_m: of the two points that touch the curve; the origin is midway, x forward, z up.
    lift_m: stations (N,) -> heights (N,) above the ground. upright: vertical whatever the slope.
    """

    curve: Curve
    speed: Speed
    station_m: float
    at_s: float
    terrain: Terrain
    wheelbase_m: float
    lift_m: Callable[[Float], Float] | None = None
    upright: bool = False

    def station(self, times_s: Float) -> Float:
        """(N,) seconds -> (N,) arc length."""
        travelled = self.speed.distance(times_s) - self.speed.distance(np.array([self.at_s]))
        return self.station_m + travelled

    def poses(self, times_s: Float) -> Poses:
        station = self.station(times_s)
        half = self.wheelbase_m / 2
        rear, front = self.curve(station - half), self.curve(station + half)
        lift = np.zeros(len(station)) if self.lift_m is None else self.lift_m(station)
        return on_ground(self.terrain, rear, front, lift, self.upright)


def on_ground(
    terrain: Terrain, rear: Float, front: Float, lift_m: Float, upright: bool = False
) -> Poses:
    """Poses of bodies that touch the ground at two points, (N,2) each."""
    a = np.column_stack([rear, terrain.height(rear) + lift_m])
    b = np.column_stack([front, terrain.height(front) + lift_m])
    middle = (a + b) / 2
    slope = terrain.slope(middle[:, :2]) * (not upright)
    forward = (b - a) * (1.0, 1.0, not upright)
    x = forward / lengths(forward)
    y = across(np.column_stack([-slope, np.ones(len(slope))]), x)
    y /= lengths(y)
    return Poses(np.stack([x, y, across(x, y)], axis=2), middle)


class Towed:
    """A trailer: its axle follows the kingpin of what pulls it (a tractrix)."""

    def __init__(
        self, tractor: Driving, kingpin_m: float, wheelbase_m: float, first_s: float, last_s: float
    ) -> None:
        """kingpin_m: along the tractor's x. wheelbase_m: from the kingpin back to the axle."""
        self._tractor, self._kingpin_m = tractor, kingpin_m
        times = np.arange(first_s, last_s, 0.01)
        pin = self._pin(times)
        axle = np.empty_like(pin)
        axle[0] = pin[0] - wheelbase_m * (pin[1] - pin[0]) / np.linalg.norm(pin[1] - pin[0])
        for i in range(1, len(times)):
            away = axle[i - 1] - pin[i]
            axle[i] = pin[i] + wheelbase_m * away / np.linalg.norm(away)
        self._axle = CubicSpline(times, axle)

    def _pin(self, times_s: Float) -> Float:
        tractor = self._tractor.poses(times_s)
        return (tractor.position + tractor.rotation[:, :, 0] * self._kingpin_m)[:, :2]

    def poses(self, times_s: Float) -> Poses:
        """Origin: the ground below the middle between axle and kingpin."""
        lift = np.zeros(len(times_s))
        return on_ground(self._tractor.terrain, self._axle(times_s), self._pin(times_s), lift)


@dataclass(frozen=True)
class Limb:
    """Swings about a horizontal hinge of the body it hangs on, in step with the way walked.

    hinge_m: (3,) in the parent's frame; the limb's origin. swing: rad. stride_m: way of one full
    swing. phase: rad.
    """

    parent: Driving
    hinge_m: tuple[float, float, float]
    swing: float
    stride_m: float
    phase: float

    def poses(self, times_s: Float) -> Poses:
        parent = self.parent.poses(times_s)
        walked = self.parent.station(times_s)
        angle = self.swing * np.sin(2 * np.pi * walked / self.stride_m + self.phase)
        turn = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
        hinge = np.broadcast_to(self.hinge_m, (len(times_s), 3))
        return Poses(parent.rotation @ turn, parent.apply(hinge))


class Rectangles(NamedTuple):
    """Any number of rectangles. centre: (...,2). forward: (...,2) of length 1. half_m: (...,2)
    half length and half width."""

    centre: Float
    forward: Float
    half_m: Float

    @staticmethod
    def of(mesh: Mesh, poses: Poses, slack_m: float = 0.0) -> Rectangles:
        """(N,) rectangles, that of a mesh at N poses."""
        low, high = mesh.bounds
        n = len(poses.position)
        middle = np.append((low + high)[:2] / 2, 0.0)
        forward = poses.rotation[:, :2, 0]
        forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        half = np.broadcast_to((high - low)[:2] / 2 + slack_m, (n, 2))
        return Rectangles(poses.apply(np.tile(middle, (n, 1)))[:, :2], forward, half)

    @staticmethod
    def joined(parts: Sequence[Rectangles]) -> Rectangles:
        """All of them, along the first axis."""
        return Rectangles(*(np.concatenate(c) for c in zip(*parts, strict=True)))

    def rows(self, rows: Int | slice) -> Rectangles:
        return Rectangles(*(column[rows] for column in self))


def overlap(a: Rectangles, b: Rectangles) -> Bool:
    """Which of them touch, shapes broadcast against each other (separating axes)."""
    away = b.centre - a.centre
    apart = np.zeros(away.shape[:-1], bool)
    for p, q in ((a, b), (b, a)):
        for side, axis in enumerate((p.forward, left_of(p.forward))):
            reach = p.half_m[..., side] + q.half_m[..., 0] * np.abs(_dot(axis, q.forward))
            reach = reach + q.half_m[..., 1] * np.abs(_dot(axis, left_of(q.forward)))
            apart |= np.abs(_dot(axis, away)) > reach
    return ~apart


def _dot(a: Float, b: Float) -> Float:
    """Inner product of (...,2) vectors; quicker than a sum over two."""
    product: Float = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return product
