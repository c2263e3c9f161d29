# SPDX-License-Identifier: MIT
"""Compute the poses of bodies at any time, and the rectangles that they cover on the ground."""

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
    """N poses ``T_world_body``."""

    rotation: Float  # (N,3,3) rotation matrices
    position: Float  # (N,3) metres

    def apply(self, points: Float) -> Float:
        """Return (N,3) body-frame points in the world, row by row."""
        return self.turn(points) + self.position

    def undo(self, points: Float) -> Float:
        """Return (N,3) world points in the body frames, row by row."""
        return self.unturn(points - self.position)

    def turn(self, directions: Float) -> Float:
        """Return (N,3) body-frame directions in world axes."""
        return np.einsum("nij,nj->ni", self.rotation, directions)

    def unturn(self, directions: Float) -> Float:
        """Return (N,3) world directions in body axes."""
        return np.einsum("nji,nj->ni", self.rotation, directions)

    def rows(self, rows: Int) -> Poses:
        """Return the poses at these indices."""
        return Poses(self.rotation[rows], self.position[rows])

    def matrix(self, row: int = 0) -> Float:
        """Return the (4,4) matrix ``T_world_body`` of one pose."""
        T_world_body = np.eye(4)
        T_world_body[:3, :3], T_world_body[:3, 3] = self.rotation[row], self.position[row]
        return T_world_body


def upright(xyz: Sequence[float], heading: float) -> Poses:
    """Return one pose at a (3,) position, rotated about z by ``heading`` in rad."""
    turn = Rotation.from_euler("z", heading).as_matrix()
    return Poses(turn[None], np.asarray(xyz, float)[None])


class Trajectory(Protocol):
    """The pose of a body at any time."""

    def poses(self, times_s: Float) -> Poses:
        """Return N poses at (N,) seconds since frame 0."""
        ...


def poses_at(trajectory: Trajectory, times_s: Float) -> Poses:
    """Return N poses at (N,) seconds. Poses for equal times in a row are computed once."""
    new = np.diff(times_s, prepend=np.nan) != 0
    if new.all():
        return trajectory.poses(times_s)
    poses = trajectory.poses(times_s[new])
    if len(poses.position) == 1:
        return Poses(*(np.broadcast_to(c, (len(new), *c.shape[1:])) for c in poses))
    return poses.rows(np.cumsum(new) - 1)


class Still:
    """The trajectory of the static world: identity poses."""

    def poses(self, times_s: Float) -> Poses:
        """Return N identity poses."""
        n = len(times_s)
        return Poses(np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)))


@dataclass(frozen=True)
class Driving:
    """A vehicle with both axles on a curve. Its origin is midway between them, x forward, z up."""

    curve: Curve  # path of both axles
    speed: Speed  # speed along the path
    station_m: float  # arc length along the path at time ``at_s``
    at_s: float  # time of ``station_m``, seconds since frame 0
    terrain: Terrain
    wheelbase_m: float  # distance of the two axles
    # Function from (N,) arc lengths to (N,) heights above the ground
    lift_m: Callable[[Float], Float] | None = None
    upright: bool = False  # stay vertical on slopes, as a pedestrian does

    def station(self, times_s: Float) -> Float:
        """Return (N,) arc lengths along the curve at (N,) seconds."""
        travelled = self.speed.distance(times_s) - self.speed.distance(np.array([self.at_s]))
        return self.station_m + travelled

    def poses(self, times_s: Float) -> Poses:
        """Return N poses at (N,) seconds."""
        station = self.station(times_s)
        half = self.wheelbase_m / 2
        rear, front = self.curve(station - half), self.curve(station + half)
        lift = np.zeros(len(station)) if self.lift_m is None else self.lift_m(station)
        return on_ground(self.terrain, rear, front, lift, self.upright)


def on_ground(
    terrain: Terrain, rear: Float, front: Float, lift_m: Float, upright: bool = False
) -> Poses:
    """Return the N poses of bodies that touch the ground at (N,2) rear and front points."""
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
    """The trajectory of a trailer, whose axle follows the tractor's kingpin (a tractrix)."""

    def __init__(
        self, tractor: Driving, kingpin_m: float, wheelbase_m: float, first_s: float, last_s: float
    ) -> None:
        """Build the trailer; the kingpin is ``kingpin_m`` along the x axis of the tractor."""
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
        """Return N poses at (N,) seconds. The origin is below the middle of the wheelbase."""
        lift = np.zeros(len(times_s))
        return on_ground(self._tractor.terrain, self._axle(times_s), self._pin(times_s), lift)


@dataclass(frozen=True)
class Limb:
    """A limb that swings about a horizontal hinge of its parent, in step with its walk."""

    parent: Driving  # trajectory of the body that carries the limb
    # (3,) position of the hinge in the parent's frame; origin of the limb
    hinge_m: tuple[float, float, float]
    swing: float  # amplitude in rad
    stride_m: float  # distance walked in one full swing
    phase: float  # phase of the swing in rad

    def poses(self, times_s: Float) -> Poses:
        """Return N poses at (N,) seconds."""
        parent = self.parent.poses(times_s)
        walked = self.parent.station(times_s)
        angle = self.swing * np.sin(2 * np.pi * walked / self.stride_m + self.phase)
        turn = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
        hinge = np.broadcast_to(self.hinge_m, (len(times_s), 3))
        return Poses(parent.rotation @ turn, parent.apply(hinge))


class Rectangles(NamedTuple):
    """Footprints in the x-y plane of the world. The arrays may have any leading shape, "..."."""

    centre: Float  # (...,2) x, y of the centre, metres, world
    forward: Float  # (...,2) unit vector along the length, world
    half_m: Float  # (...,2) half length and half width, metres

    @staticmethod
    def of(mesh: Mesh, poses: Poses, slack_m: float = 0.0) -> Rectangles:
        """Return the N footprints of a mesh at N poses: its bounds from above, plus ``slack_m``."""
        low, high = mesh.bounds
        n = len(poses.position)
        middle = np.append((low + high)[:2] / 2, 0.0)
        forward = poses.rotation[:, :2, 0]
        forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        half = np.broadcast_to((high - low)[:2] / 2 + slack_m, (n, 2))
        return Rectangles(poses.apply(np.tile(middle, (n, 1)))[:, :2], forward, half)

    @staticmethod
    def joined(parts: Sequence[Rectangles]) -> Rectangles:
        """Return all rectangles, concatenated along the first axis."""
        return Rectangles(*(np.concatenate(c) for c in zip(*parts, strict=True)))

    def rows(self, rows: Int | slice) -> Rectangles:
        """Return the rectangles with these indices along the first axis."""
        return Rectangles(*(column[rows] for column in self))


def overlap(a: Rectangles, b: Rectangles) -> Bool:
    """Return (...) True for pairs of rectangles that touch; leading shapes are broadcast."""
    # Two rectangles are apart if a side of either of them separates the two (separating axes).
    away = b.centre - a.centre
    apart = np.zeros(away.shape[:-1], bool)
    for p, q in ((a, b), (b, a)):
        for side, axis in enumerate((p.forward, left_of(p.forward))):
            reach = p.half_m[..., side] + q.half_m[..., 0] * np.abs(_dot(axis, q.forward))
            reach = reach + q.half_m[..., 1] * np.abs(_dot(axis, left_of(q.forward)))
            apart |= np.abs(_dot(axis, away)) > reach
    return ~apart


def _dot(a: Float, b: Float) -> Float:
    """Return inner products of (...,2) vectors; faster than a sum over two."""
    product: Float = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return product
