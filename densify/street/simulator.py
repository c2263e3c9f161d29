# SPDX-License-Identifier: MIT
"""Make the frames of a scene: sweeps, pictures and the exact motion of every body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, SweepTruth
from densify.street.cameras import CAMERAS, EXPOSURES, Picture, expose
from densify.street.lidar import Mount, Returns, Sensor, T_ego_lidar, at_offsets, scan
from densify.street.motion import DURATION_S, Poses
from densify.street.scenes import Scene, build
from densify.street.world import Body


@lru_cache(maxsize=2)
def build_scene(preset: str, seed: int) -> Scene:
    """Return the scene of a preset and seed, the same for the same arguments, in 1 to 2 s."""
    return build(preset, np.random.default_rng([seed, 0]))


@dataclass(frozen=True)
class Bodies:
    """Poses of B bodies at the reference times of F frames."""

    T_world_lidar: Float  # (F,4,4) poses of the lidar
    T_world_body: Float  # (F,B,4,4) poses of the bodies. Body 0 is the static world.
    moving: Bool  # (F,B) bool, True if the body's object moves around that time

    def place(self, frame: int, body: NDArray[np.int32], points: Float) -> Float:
        """Return the (N,3) world positions of points at a frame's reference time.

        Args:
            body: (N,) index of the body of each point.
            points: (N,3) metres, each in the frame of its body.
        """
        T_world_body = self.T_world_body[frame][body]
        return Poses(T_world_body[:, :3, :3], T_world_body[:, :3, 3]).apply(points)

    def sweep(
        self, frame: int, body: NDArray[np.int32], instance: NDArray[np.int32], points: Float
    ) -> SweepTruth:
        """Return the ground truth of a sweep's N points.

        Each point has its body (N,), the object ``instance`` (N,), -1 for none, and a position
        (N,3) in the frame of its body.
        """
        T_world_lidar = self.T_world_lidar[frame]
        from_lidar = self.place(frame, body, points) - T_world_lidar[:3, 3]
        points_lidar = from_lidar @ T_world_lidar[:3, :3]
        return SweepTruth(T_world_lidar, points_lidar, instance, self.moving[frame][body])

    def displacement(
        self, frame: int, target: int, body: NDArray[np.int32], points: Float
    ) -> Float:
        """Return the true flow (N,3) in metres from a frame to the frame ``target``.

        ``body`` (N,) is the body of each point, ``points`` (N,3) are in its frame. The flow is in
        the lidar frame of ``frame``, ego-motion removed. An unknown target raises InputError.
        """
        self.check(target)
        after = self.place(target, body, points)
        before = self.place(frame, body, points)
        return (after - before) @ self.T_world_lidar[frame][:3, :3]

    def check(self, frame: int) -> None:
        """Raise InputError for a frame without poses."""
        if not 0 <= frame < len(self.moving):
            raise InputError(
                f"truth of frame {frame}: not there; poses are known of frames 0 to "
                f"{len(self.moving) - 1}"
            )


VERSION = 6  # must grow with every change of the simulated data
_NS_PER_S = 1_000_000_000
EPOCH_NS = 1_781_258_400_000_000_000  # 2026-06-12 10:00:00 UTC, frame 0
_MOVING_M, _MOVING_S = 0.05, 0.5  # an object moves if it goes this far in this time


@dataclass(frozen=True)
class Simulator:
    """A scene with a sensor. Its fields and the frame number determine all random values."""

    preset: str  # key of `densify.street.scenes.PRESETS`
    seed: int
    sensor: Sensor
    # Sweeps per second, such as 5, 10 or 20. The period is a whole number of nanoseconds. The scene
    # at a given time does not depend on it.
    hz: int = 10
    tilt_deg: float = 0.0  # pitch of the mount, as in `densify.street.lidar.T_ego_lidar`

    @property
    def period_ns(self) -> int:
        """The time from sweep to sweep in nanoseconds."""
        return _NS_PER_S // self.hz

    @property
    def num_frames(self) -> int:
        """The number of frames in the scene's 16 s."""
        return DURATION_S * self.hz

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a frame's sweep, in nanoseconds since 1970."""
        return EPOCH_NS + frame * self.period_ns

    @cached_property
    def scene(self) -> Scene:
        """The scene of the preset and seed, built at first use."""
        return build_scene(self.preset, self.seed)

    def returns(self, frame: int) -> Returns:
        """Simulate the sweep of ``frame``, points in metres, lidar frame at firing time."""
        rng = np.random.default_rng([self.seed, 1, frame])
        time_s = seconds(self.stamp_ns(frame))
        mount = Mount(self.scene.ego, self.sensor, self.period_ns, self.tilt_deg)
        return scan(self.scene.world, mount, time_s, rng)

    def image_stamps_ns(self, camera: str) -> dict[int, int]:
        """Return the exposure time (ns) of the middle row of each image of a camera, by number."""
        exposure = EXPOSURES[camera]
        period_ns = getattr(exposure, "period_ns", self.period_ns)
        first_ns = EPOCH_NS + exposure.delay_ns
        num_images = DURATION_S * _NS_PER_S // period_ns
        return {number: first_ns + number * period_ns for number in range(num_images)}

    def picture(self, camera: str, number: int) -> Picture:
        """Render the image of a camera with this image number."""
        time_s = seconds(self.image_stamps_ns(camera)[number])
        return expose(self.scene.world, self.scene.ego, CAMERAS[camera], time_s)

    def T_world_lidar_at(self, time_ns: int) -> Float:
        """Return the (4,4) pose of the lidar frame in the world at a time in ns since 1970."""
        T_world_ego = self.scene.ego.poses(np.array([seconds(time_ns)])).matrices()[0]
        return T_world_ego @ T_ego_lidar(self.tilt_deg)

    @cached_property
    def bodies(self) -> Bodies:
        """The poses of all bodies at every frame's reference time."""
        return self.bodies_at([self.stamp_ns(frame) for frame in range(self.num_frames)])

    def bodies_at(self, stamps_ns: Sequence[int], indices: Sequence[int] | None = None) -> Bodies:
        """Return the poses of bodies at F times, in nanoseconds since 1970.

        ``indices`` selects bodies, None for all. Bodies of one object must be selected together.
        """
        times = np.array([seconds(stamp) for stamp in stamps_ns])
        bodies = self.scene.world.bodies
        if indices is not None:
            bodies = tuple(bodies[index] for index in indices)
        T_world_lidar = np.stack([self.T_world_lidar_at(stamp) for stamp in stamps_ns])
        T_by_body = [body.trajectory.poses(times).matrices() for body in bodies]
        return Bodies(T_world_lidar, np.stack(T_by_body, axis=1), _moving(bodies, times))

    def in_bodies(self, frame: int, returns: Returns) -> Float:
        """Return the (N,3) measured points, each in the frame of the body that the ray hit."""
        # Poses at the firing time of each point take it to the world, and from there to its body.
        times = at_offsets(seconds(self.stamp_ns(frame)), returns.offset_ns)
        points = transform(T_ego_lidar(self.tilt_deg), returns.points.astype(np.float64))
        points = self.scene.ego.poses(times).apply(points)
        for index in np.unique(returns.body[returns.body > 0]):
            rows = np.flatnonzero(returns.body == index)
            trajectory = self.scene.world.bodies[index].trajectory
            points[rows] = trajectory.poses(times[rows]).undo(points[rows])
        return points


def seconds(time_ns: int) -> float:
    """Return an absolute time (ns) as seconds since frame 0, the unit inside `densify.street`."""
    return (time_ns - EPOCH_NS) * 1e-9


def _moving(bodies: Sequence[Body], times_s: Float) -> Bool:
    """Return the mask (F,B) of bodies that are parts of objects that move around F times."""
    # Positions at each time, and up to 0.5 s before and after
    times = times_s[:, None] + _MOVING_S * np.array([0, -1, -0.5, 0.5, 1])
    columns = [body.trajectory.poses(times.ravel()).position for body in bodies]
    position = np.stack(columns, axis=1).reshape(*times.shape, len(bodies), 3)
    moved_m = np.linalg.norm(position[:, 1:] - position[:, :1], axis=3).max(axis=1)
    moving: Bool = moved_m >= _MOVING_M
    # An object moves if one of its bodies moves.
    instance = np.array([body.instance for body in bodies])
    for number in np.unique(instance[instance >= 0]):
        is_part = instance == number
        moving[:, is_part] = moving[:, is_part].any(axis=1, keepdims=True)
    return moving
