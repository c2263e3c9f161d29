# SPDX-License-Identifier: MIT
"""Compute paths over the hilly ground, and the poses of bodies on them at any time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from densify.geometry.types import Bool, Float, Int
from densify.street.mesh import Mesh, lengths

DURATION_S = 16  # duration of every scene
SPAN_S = (-1.0, DURATION_S + 1.0)  # times with poses
STEP_M = 0.5  # distance between the points of a curve
_FINE_M = 0.05  # step of the integration of a curve
_TOW_S = 0.01  # time between the computed positions of a trailer
# Lengths of the waves of the terrain, and their shares of the greatest slope
_WAVE_M, _WAVE_SHARE = np.array([95.0, 150.0, 240.0]), np.array([0.25, 0.35, 0.4])


class Curve:
    """A smooth planar curve, from arc length 0 to ``length_m`` and straight beyond its ends."""

    def __init__(self, xy: Float) -> None:
        """Build the curve through (N,2) points in metres, neighbours about half a metre apart."""
        self.knots_m = _lengths_along(xy)
        self.length_m = float(self.knots_m[-1])
        self._spline = CubicSpline(self.knots_m, xy)
        self._slope = self._spline.derivative()

    def __call__(self, station_m: Float) -> Float:
        """Return the (N,2) points of the curve in metres at (N,) arc lengths in metres."""
        return self.with_tangent(station_m)[0]

    def with_tangent(self, station_m: Float) -> tuple[Float, Float]:
        """Return the points (N,2) of the curve and its directions (N,2) at (N,) arc lengths."""
        inside = np.clip(station_m, 0.0, self.length_m)
        tangent = self.tangent(inside)
        return self._spline(inside) + (station_m - inside)[..., None] * tangent, tangent

    def tangent(self, station_m: Float) -> Float:
        """Return the unit directions of travel (N,2) at (N,) arc lengths."""
        slope: Float = self._slope(np.clip(station_m, 0.0, self.length_m))
        return slope / np.linalg.norm(slope, axis=-1, keepdims=True)

    def normal(self, station_m: Float) -> Float:
        """Return the unit vectors (N,2) to the left of the curve at (N,) arc lengths."""
        return left_of(self.tangent(station_m))

    @staticmethod
    def bending(
        length_m: float, curvature: Callable[[Float], Float], origin_m: float = 0.0
    ) -> Curve:
        """Return a curve of ``length_m`` through the origin along +x, at arc length ``origin_m``.

        ``curvature`` maps (N,) arc lengths to (N,) curvatures in 1/m, positive to the left.
        """
        step = _FINE_M
        station = np.arange(0.0, length_m + step, step)
        # heading = ∫ curvature ds, position = ∫ (cos heading, sin heading) ds
        heading = np.concatenate([[0.0], np.cumsum(curvature(station[:-1] + step / 2) * step)])
        middle = (heading[1:] + heading[:-1]) / 2
        steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        xy = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
        # Move and turn the curve until its point at ``origin_m`` is the origin.
        start = round(origin_m / step)
        cosine, sine = np.cos(heading[start]), np.sin(heading[start])
        xy = (xy - xy[start]) @ np.array([[cosine, -sine], [sine, cosine]])
        return Curve(xy[:: round(STEP_M / step)])


def left_of(forward: Float) -> Float:
    """Return the vectors (...,2) turned to the left by a right angle."""
    return np.stack([-forward[..., 1], forward[..., 0]], axis=-1)


class Lane:
    """A path along a road: its centreline shifted sideways, possibly driven backwards."""

    def __init__(self, road: Curve, offset_m: float, forward: bool = True) -> None:
        """Build the lane, ``offset_m`` to the left of the road's centreline.

        ``forward`` False drives against the road's direction.
        """
        stations = road.knots_m
        xy = road(stations) + road.normal(stations) * offset_m
        self.curve = Curve(xy if forward else xy[::-1])
        self._abreast_m = self.curve.knots_m[:: 1 if forward else -1]
        self._stations = stations

    def at(self, station_m: float) -> float:
        """Return the arc length (m) on this lane beside a station (arc length in m) of the road."""
        return float(np.interp(station_m, self._stations, self._abreast_m))


def polyline(corners: Sequence[Sequence[float] | Float], radius_m: float) -> Float:
    """Return (N,2) points, half a metre apart, along lines with corners rounded to ``radius_m``."""
    points = np.asarray(corners, float)
    corner_lines = zip(points[:-2], points[1:-1], points[2:], strict=True)
    arcs = [_rounded_corner(a, b, c, radius_m) for a, b, c in corner_lines]
    xy = np.concatenate([points[:1], *arcs, points[-1:]])
    # Resample the points at equal steps.
    length_m = _lengths_along(xy)
    even_m = np.linspace(0, length_m[-1], int(length_m[-1] / STEP_M) + 1)
    return np.stack([np.interp(even_m, length_m, xy[:, axis]) for axis in range(2)], axis=1)


def _lengths_along(xy: Float) -> Float:
    """Return the (N,) sums of the chords from the first of (N,2) points to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])


def _rounded_corner(a: Float, b: Float, c: Float, radius_m: float) -> Float:
    """Return points (N,2) of the arc that touches the lines a-b and b-c."""
    u = (a - b) / np.linalg.norm(a - b)
    v = (c - b) / np.linalg.norm(c - b)
    # The centre is on the bisector, r / sin(half angle) from b. The arc touches both lines
    # r / tan(half angle) from b.
    half = np.arccos(np.clip(u @ v, -1, 1)) / 2  # half the angle between the lines
    centre = b + (u + v) / np.linalg.norm(u + v) * radius_m / np.sin(half)
    begin = b + u * radius_m / np.tan(half)
    end = b + v * radius_m / np.tan(half)
    begin_angle, end_angle = (np.arctan2(*(point - centre)[::-1]) for point in (begin, end))
    turn = (end_angle - begin_angle + np.pi) % (2 * np.pi) - np.pi
    angle = begin_angle + np.linspace(0, turn, max(2, int(abs(turn) * radius_m / STEP_M)))
    return centre + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


class Speed:
    """A speed profile: linear between knots (t_s, v_m_s), constant before and after."""

    def __init__(self, *knots: tuple[float, float]) -> None:
        self._t, self._v = np.array(knots, float).T
        steps = np.diff(self._t) * (self._v[1:] + self._v[:-1]) / 2
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])
        # Constant acceleration between two knots, 0 after the last
        self._acceleration = np.append(np.diff(self._v) / np.diff(self._t), 0.0)

    def distance(self, times_s: Float) -> Float:
        """Return the metres (N,) travelled at ``times_s`` (N,), relative to the first knot.

        Times before the first knot give negative metres.
        """
        knot = np.maximum(np.searchsorted(self._t, times_s, side="right") - 1, 0)
        acceleration = np.where(times_s < self._t[0], 0.0, self._acceleration[knot])
        since_s = times_s - self._t[knot]
        # s = s_knot + v t + a t² / 2
        travelled_m: Float = self._travelled[knot] + self._v[knot] * since_s
        return travelled_m + acceleration * since_s**2 / 2


@dataclass(frozen=True)
class Terrain:
    """Height of the bare ground as a sum of W waves, ``sum a sin(k·xy + phase)``."""

    wave: Float  # (W,2) wave vectors k in rad/m
    amplitude_m: Float  # (W,) amplitudes a
    phase: Float  # (W,) phases in rad

    @staticmethod
    def hilly(rng: np.random.Generator, max_slope: float, scale: float = 1.0) -> Terrain:
        """Return a terrain of three random waves.

        Args:
            rng: Draws the directions and phases of the waves.
            max_slope: Greatest slope of the terrain, rise over run.
            scale: Factor of the usual wavelengths, 95 to 240 m.
        """
        length_m = _WAVE_M * scale
        angle = rng.uniform(0, 2 * np.pi, 3)
        wave = (2 * np.pi / length_m)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        share = max_slope * _WAVE_SHARE
        return Terrain(wave, share / np.linalg.norm(wave, axis=1), rng.uniform(0, 2 * np.pi, 3))

    def height(self, xy: Float) -> Float:
        """Return the heights (N,) in metres at world positions (N,2)."""
        z: Float = np.sin(xy @ self.wave.T + self.phase) @ self.amplitude_m
        return z

    def slope(self, xy: Float) -> Float:
        """Return the gradients (N,2) of the height at world positions (N,2)."""
        gradient: Float = (np.cos(xy @ self.wave.T + self.phase) * self.amplitude_m) @ self.wave
        return gradient


class Poses(NamedTuple):
    """N poses ``T_world_body`` of bodies in the world."""

    rotation: Float  # (N,3,3) rotation matrices
    position: Float  # (N,3) metres

    def apply(self, points: Float) -> Float:
        """Return the points (N,3) of the body frames in world coordinates, each by its own pose."""
        return self.turn(points) + self.position

    def undo(self, points: Float) -> Float:
        """Return the world points (N,3) in coordinates of the bodies, each by its own pose."""
        return np.einsum("nji,nj->ni", self.rotation, points - self.position)

    def turn(self, directions: Float) -> Float:
        """Return the directions (N,3) of the body frames in world axes, each by its own pose."""
        return np.einsum("nij,nj->ni", self.rotation, directions)

    def rows(self, rows: Int) -> Poses:
        """Return the poses with the indices ``rows``."""
        return Poses(self.rotation[rows], self.position[rows])

    def matrices(self) -> Float:
        """Return the (N,4,4) matrices ``T_world_body``."""
        T_world_body = np.tile(np.eye(4), (len(self.position), 1, 1))
        T_world_body[:, :3, :3] = self.rotation
        T_world_body[:, :3, 3] = self.position
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
    """Return N poses at (N,) seconds since frame 0, faster where consecutive times are equal."""
    is_new = np.diff(times_s, prepend=np.nan) != 0
    if is_new.all():
        return trajectory.poses(times_s)
    return trajectory.poses(times_s[is_new]).rows(np.cumsum(is_new) - 1)


class Still:
    """The trajectory of the static world: identity poses."""

    def poses(self, times_s: Float) -> Poses:
        """Return N identity poses."""
        n = len(times_s)
        return Poses(np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)))


@dataclass(frozen=True)
class Driving:
    """A vehicle with both axles on a curve. The origin is midway between them, x forward, z up."""

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
        """Return the (N,) arc lengths along the curve, in metres, at (N,) seconds since frame 0."""
        travelled = self.speed.distance(times_s) - self.speed.distance(np.array([self.at_s]))
        return self.station_m + travelled

    def poses(self, times_s: Float) -> Poses:
        """Return the N poses of the vehicle at (N,) seconds since frame 0."""
        station = self.station(times_s)
        half = self.wheelbase_m / 2
        rear, front = self.curve(station - half), self.curve(station + half)
        lift = np.zeros(len(station)) if self.lift_m is None else self.lift_m(station)
        return on_ground(self.terrain, rear, front, lift, self.upright)


def on_ground(
    terrain: Terrain, rear: Float, front: Float, lift_m: Float, upright: bool = False
) -> Poses:
    """Return the N poses of bodies that stand on the ground, or above it.

    Args:
        rear: (N,2) rear points of contact, world.
        front: (N,2) front points of contact, world.
        lift_m: (N,) heights of both points above the ground.
        upright: True to stay vertical on slopes.
    """
    rear_xyz = np.column_stack([rear, terrain.height(rear) + lift_m])
    front_xyz = np.column_stack([front, terrain.height(front) + lift_m])
    middle = (rear_xyz + front_xyz) / 2
    slope = terrain.slope(middle[:, :2]) * (not upright)
    forward = (front_xyz - rear_xyz) * (1.0, 1.0, not upright)
    # The axis to the left is perpendicular to the direction of travel and to the ground's normal.
    x = forward / lengths(forward)
    y = np.cross(np.column_stack([-slope, np.ones(len(slope))]), x)
    y /= lengths(y)
    return Poses(np.stack([x, y, np.cross(x, y)], axis=2), middle)


class Towed:
    """The trajectory of a trailer whose axle follows the tractor's kingpin (a tractrix)."""

    def __init__(self, tractor: Driving, kingpin_m: float, wheelbase_m: float) -> None:
        """Compute the path of the trailer's axle, ``wheelbase_m`` behind the kingpin.

        ``kingpin_m`` is the position of the kingpin on the x axis of the tractor.
        """
        self._tractor, self._kingpin_m = tractor, kingpin_m
        times = np.arange(*SPAN_S, _TOW_S)
        pin = self._pin(times)
        axle = np.empty_like(pin)
        # The trailer starts straight behind the tractor. In each step the axle keeps its distance.
        axle[0] = pin[0] - wheelbase_m * (pin[1] - pin[0]) / np.linalg.norm(pin[1] - pin[0])
        for step in range(1, len(times)):
            pin_to_axle = axle[step - 1] - pin[step]
            axle[step] = pin[step] + wheelbase_m * pin_to_axle / np.linalg.norm(pin_to_axle)
        self._axle = CubicSpline(times, axle)

    def _pin(self, times_s: Float) -> Float:
        """Return the (N,2) positions of the kingpin in the world at (N,) seconds."""
        tractor = self._tractor.poses(times_s)
        return (tractor.position + tractor.rotation[:, :, 0] * self._kingpin_m)[:, :2]

    def poses(self, times_s: Float) -> Poses:
        """Return the N poses at (N,) seconds since frame 0, below the middle of the wheelbase."""
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
        """Return the N poses of the limb at (N,) seconds since frame 0."""
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
        """Return the footprints of a mesh at N poses, wider by ``slack_m`` on each side."""
        low, high = mesh.bounds
        n = len(poses.position)
        middle = np.append((low + high)[:2] / 2, 0.0)
        forward = poses.rotation[:, :2, 0]
        forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        half = np.broadcast_to((high - low)[:2] / 2 + slack_m, (n, 2))
        return Rectangles(poses.apply(np.tile(middle, (n, 1)))[:, :2], forward, half)

    @staticmethod
    def joined(groups: Sequence[Rectangles]) -> Rectangles:
        """Return all rectangles, concatenated along the first axis."""
        return Rectangles(*(np.concatenate(columns) for columns in zip(*groups, strict=True)))

    def rows(self, rows: Int | None) -> Rectangles:
        """Return the rectangles with the indices ``rows``; None adds a first axis of length 1."""
        return Rectangles(*(column[rows] for column in self))


def overlap(a: Rectangles, b: Rectangles) -> Bool:
    """Return a mask of the pairs of rectangles that touch. Leading shapes are broadcast."""
    # Two rectangles are apart if the direction of a side separates them (separating axes): along
    # it, their centres are farther apart than the sum of their half extents.
    between = b.centre - a.centre
    is_apart = np.zeros(between.shape[:-1], bool)
    for one, other in ((a, b), (b, a)):
        for side, axis in enumerate((one.forward, left_of(one.forward))):
            reach = one.half_m[..., side] + other.half_m[..., 0] * np.abs(_dot(axis, other.forward))
            reach = reach + other.half_m[..., 1] * np.abs(_dot(axis, left_of(other.forward)))
            is_apart |= np.abs(_dot(axis, between)) > reach
    return ~is_apart


def _dot(a: Float, b: Float) -> Float:
    """Return the inner products of (...,2) vectors, faster than a sum over two."""
    product: Float = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return product
