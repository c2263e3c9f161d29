# SPDX-License-Identifier: MIT
"""Rectangles on the ground: what stands or drives where, and whether they touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from densify.geometry.types import Bool, Float, Int
from densify.street.actors import Actor
from densify.street.mesh import Mesh
from densify.street.motion import Driving, Trajectory


@dataclass(frozen=True)
class Rectangles:
    """Any number of rectangles. centre: (...,2). forward: (...,2) of length 1. half_m: (...,2)
    half length and half width."""

    centre: Float
    forward: Float
    half_m: Float

    @staticmethod
    def standing(mesh: Mesh, xy: Float, heading: float, slack_m: float = 0.0) -> Rectangles:
        """One rectangle, that of a mesh put there."""
        low, high = mesh.bounds
        forward = np.array([np.cos(heading), np.sin(heading)])
        middle = (low + high)[:2] / 2
        centre = xy + middle[0] * forward + middle[1] * _left(forward)
        return Rectangles(centre, forward, (high - low)[:2] / 2 + slack_m)

    @staticmethod
    def moving(mesh: Mesh, way: Trajectory, times_s: Float, slack_m: float = 0.0) -> Rectangles:
        """(T,) rectangles, that of a mesh at T times."""
        low, high = mesh.bounds
        n = len(times_s)
        poses = way.poses(times_s)
        middle = np.append((low + high)[:2] / 2, 0.0)
        centre = poses.apply(np.broadcast_to(middle, (n, 3)))[:, :2]
        forward = poses.rotation[:, :2, 0]
        forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        half = np.broadcast_to((high - low)[:2] / 2 + slack_m, (n, 2))
        return Rectangles(centre, forward, half)

    @staticmethod
    def stack(single: Sequence[Rectangles]) -> Rectangles:
        """(S,) rectangles from S single ones."""
        columns = ((r.centre, r.forward, r.half_m) for r in single)
        return Rectangles(*(np.array(c).reshape(-1, 2) for c in zip(*columns, strict=True)))

    @staticmethod
    def joined(parts: Sequence[Rectangles]) -> Rectangles:
        """All of them, along the first axis."""
        columns = ((p.centre, p.forward, p.half_m) for p in parts)
        return Rectangles(*(np.concatenate(c) for c in zip(*columns, strict=True)))

    def __getitem__(self, rows: Int | None) -> Rectangles:
        return Rectangles(self.centre[rows], self.forward[rows], self.half_m[rows])


def overlap(a: Rectangles, b: Rectangles) -> Bool:
    """Which of them touch, shapes broadcast against each other (separating axes)."""
    away = b.centre - a.centre
    apart = np.zeros(away.shape[:-1], bool)
    for p, q in ((a, b), (b, a)):
        for side, axis in enumerate((p.forward, _left(p.forward))):
            reach = p.half_m[..., side] + q.half_m[..., 0] * np.abs(_dot(axis, q.forward))
            reach = reach + q.half_m[..., 1] * np.abs(_dot(axis, _left(q.forward)))
            apart |= np.abs(_dot(axis, away)) > reach
    return ~apart


def tracks(actor: Actor, times_s: Float) -> list[Rectangles]:
    """(T,) rectangles of each solid body of an actor; swinging limbs get room."""
    slack_m = 0.3 if len(actor.bodies) > actor.num_solid else 0.1
    ways = (
        b.trajectory.from_above() if isinstance(b.trajectory, Driving) else b.trajectory
        for b in actor.bodies
    )
    return [
        Rectangles.moving(b.mesh, way, times_s, slack_m)
        for b, way in zip(actor.bodies[: actor.num_solid], ways, strict=False)
    ]


def _dot(a: Float, b: Float) -> Float:
    """Inner product of (...,2) vectors; quicker than a sum over two."""
    product: Float = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return product


def _left(forward: Float) -> Float:
    left = np.empty(forward.shape)
    np.negative(forward[..., 1], out=left[..., 0])
    left[..., 1] = forward[..., 0]
    return left
