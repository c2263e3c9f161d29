# SPDX-License-Identifier: MIT
"""Makes the frames of one scene: sweeps, pictures and the exact motion of every body.

Time runs in seconds from frame 0's reference time here, in absolute nanoseconds outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, SweepTruth
from densify.street.actors import DURATION_S
from densify.street.cameras import CAMERAS, SHUTTERS, Picture, expose
from densify.street.lidar import Returns, T_ego_lidar, at_offsets, scan
from densify.street.presets import crossing, highway, static_street, street
from densify.street.sensors import Sensor
from densify.street.traffic import Scene
from densify.street.world import Body

PRESETS = {"street": street, "static": static_street, "crossing": crossing, "highway": highway}
"""The function that builds the scene from a random generator."""


@lru_cache(maxsize=2)
def build_scene(preset: str, seed: int) -> Scene:
    """Return the scene of a preset and seed, always the same one.

    Building takes 1 to 2 s; the last two scenes are shared by all sensors and rates.
    """
    return PRESETS[preset](np.random.default_rng([seed, 0]))


@dataclass(frozen=True)
class Bodies:
    """Poses at the reference times of F frames. T_world_lidar: (F,4,4). T_world_body: (F,B,4,4),
    body 0 the static world. moving: (F,B)."""

    T_world_lidar: Float
    T_world_body: Float
    moving: Bool

    def place(self, frame: int, body: NDArray[np.int32], points: Float) -> Float:
        """(N,) bodies, (N,3) points in their frames -> (N,3) world, at that frame."""
        T_world_body = self.T_world_body[frame][body]
        placed: Float = np.einsum("nij,nj->ni", T_world_body[:, :3, :3], points)
        return placed + T_world_body[:, :3, 3]

    def sweep(
        self, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], points: Float
    ) -> SweepTruth:
        """Truth of a sweep whose points belong to those bodies."""
        T_world_lidar = self.T_world_lidar[frame]
        away = self.place(frame, body, points) - T_world_lidar[:3, 3]
        return SweepTruth(
            T_world_lidar, away @ T_world_lidar[:3, :3], instance, self.moving[frame][body]
        )

    def displacement(
        self, frame: int, target: int, body: NDArray[np.int32], points: Float
    ) -> Float:
        """(N,3) as `densify.geometry.types.Truth.displacement`; exactly 0 in the static world."""
        self.check(target)
        there, here = (self.place(f, body, points) for f in (target, frame))
        return (there - here) @ self.T_world_lidar[frame][:3, :3]

    def check(self, frame: int) -> None:
        """Raises InputError for a frame without poses."""
        if not 0 <= frame < len(self.moving):
            raise InputError(
                f"truth of frame {frame}: not there; poses are known of frames 0 to "
                f"{len(self.moving) - 1}"
            )


VERSION = 6  # raise it whenever the same frame would come out differently
EPOCH_NS = 1_781_258_400_000_000_000  # 2026-06-12 10:00:00 UTC, frame 0
_MOVING_M, _MOVING_S = 0.05, 0.5


@dataclass(frozen=True)
class Simulator:
    """Everything that is random follows from these and the frame's number.

    hz: sweeps per second, such as 5, 10 or 20, whose period is a whole number of nanoseconds. What
    the scene is like at a time does not depend on it. tilt_deg: as in
    `densify.street.lidar.T_ego_lidar`.
    """

    preset: str
    seed: int
    sensor: Sensor
    hz: int = 10
    tilt_deg: float = 0.0

    @property
    def period_ns(self) -> int:
        """The time from sweep to sweep."""
        return 1_000_000_000 // self.hz

    @property
    def num_frames(self) -> int:
        return DURATION_S * self.hz

    def stamp_ns(self, frame: int) -> int:
        """Reference time of a frame's sweep."""
        return EPOCH_NS + frame * self.period_ns

    @cached_property
    def scene(self) -> Scene:
        return build_scene(self.preset, self.seed)

    def returns(self, frame: int) -> Returns:
        rng = np.random.default_rng([self.seed, 1, frame])
        time_s = seconds(self.stamp_ns(frame))
        ego, world = self.scene.ego, self.scene.world
        return scan(world, ego, self.sensor, time_s, rng, self.period_ns, self.tilt_deg)

    def image_stamps_ns(self, camera: str) -> dict[int, int]:
        """When a camera exposes (its middle row), by the image's number."""
        delay_ns, own_period_ns = SHUTTERS[camera]
        period_ns = own_period_ns or self.period_ns
        first_ns = EPOCH_NS + delay_ns
        return {n: first_ns + n * period_ns for n in range(DURATION_S * 10**9 // period_ns)}

    def picture(self, camera: str, number: int) -> Picture:
        time_s = seconds(self.image_stamps_ns(camera)[number])
        return expose(self.scene.world, self.scene.ego, CAMERAS[camera], time_s)

    def T_world_lidar_at(self, time_ns: int) -> Float:
        """(4,4) pose of the lidar frame at any time."""
        T_world_ego = self.scene.ego.poses(np.array([seconds(time_ns)])).matrix()
        return T_world_ego @ T_ego_lidar(self.tilt_deg)

    @cached_property
    def bodies(self) -> Bodies:
        """Where every body is at every frame's reference time."""
        return self.bodies_at([self.stamp_ns(frame) for frame in range(self.num_frames)])

    def bodies_at(self, stamps_ns: Sequence[int], which: Sequence[int] | None = None) -> Bodies:
        """Where every body, or each of ``which``, is at these times. which: all of an object's."""
        times = np.array([seconds(stamp) for stamp in stamps_ns])
        bodies = self.scene.world.bodies
        if which is not None:
            bodies = tuple(bodies[index] for index in which)
        T_world_body = np.tile(np.eye(4), (len(times), len(bodies), 1, 1))
        for index, body in enumerate(bodies):
            poses = body.trajectory.poses(times)
            T_world_body[:, index, :3, :3] = poses.rotation
            T_world_body[:, index, :3, 3] = poses.position
        return Bodies(
            np.stack([self.T_world_lidar_at(stamp) for stamp in stamps_ns]),
            T_world_body,
            _moving(bodies, times),
        )

    def in_bodies(self, frame: int, returns: Returns) -> Float:
        """(N,3) the measured points in the frame of the body each belongs to.

        A raw point is taken to the world by the scanner's pose at its own firing time and to its
        body by the body's pose at that time.
        """
        times = at_offsets(seconds(self.stamp_ns(frame)), returns.offset_ns)
        points = transform(T_ego_lidar(self.tilt_deg), returns.points.astype(np.float64))
        points = self.scene.ego.poses(times).apply(points)
        for index in np.unique(returns.body[returns.body > 0]):
            rows = np.flatnonzero(returns.body == index)
            way = self.scene.world.bodies[index].trajectory
            points[rows] = way.poses(times[rows]).undo(points[rows])
        return points


def seconds(time_ns: int) -> float:
    return (time_ns - EPOCH_NS) * 1e-9


def _moving(bodies: Sequence[Body], times_s: Float) -> Bool:
    """(F,B) whether the body is part of an object that moves around that time."""

    def places(shift_s: float) -> Float:
        return np.stack([b.trajectory.poses(times_s + shift_s).position for b in bodies], axis=1)

    here, shifts_s = places(0.0), _MOVING_S * np.array([-1, -0.5, 0.5, 1])
    gone_m = [np.linalg.norm(places(shift_s) - here, axis=2) for shift_s in shifts_s]
    moving: Bool = np.max(gone_m, axis=0) >= _MOVING_M
    instance = np.array([body.instance for body in bodies])
    for one in np.unique(instance[instance >= 0]):
        moving[:, instance == one] = moving[:, instance == one].any(axis=1, keepdims=True)
    return moving
