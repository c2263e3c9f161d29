# SPDX-License-Identifier: MIT
"""Sweeps of the street's sensors without its street: every pulse as it is fired, from a lidar that
drives and turns, through a tiny world."""

from __future__ import annotations

import numpy as np

from densify.geometry import poses
from densify.geometry.twists import move_with_twists
from densify.geometry.types import RegisteredSweep, Sweep
from densify.street.lidar import SENSORS, firings
from tests.scenes import World

PERIOD_NS = 100_000_000
STANDING = np.zeros(6)


def fired(
    name: str,
    world: World | None = None,
    twist=STANDING,
    frame: int = 0,
    period_ns: int = PERIOD_NS,
    share_heard: float = 0.9,
) -> RegisteredSweep:
    """A deskewed sweep whose reference pose is the world's at the frame's time.

    world: what is met, in the lidar frame at time 0, 1.7 m above the ground; None for something
    about 20 m away in every direction. twist: (6,) of the lidar, rad/s and m/s, constant.
    """
    sensor, rng = SENSORS[name], np.random.default_rng([7, frame])
    time_s = frame * period_ns * 1e-9
    pulses = firings(sensor, time_s, period_ns)
    since_s = time_s + pulses.offset_ns * 1e-9
    origin = sensor.origins_m[pulses.lidar]
    T_world_lidar = poses.exp(np.asarray(twist) * time_s)
    offset_s = pulses.offset_ns * 1e-9
    start, ahead = (
        poses.transform(T_world_lidar, move_with_twists(points, offset_s, twist, twist))
        for points in (origin, origin + pulses.direction)
    )
    ray = ahead - start
    range_m = 20 + 2 * np.sin(3 * np.arctan2(ray[:, 1], ray[:, 0]))
    if world is not None:
        met, _ = world.cast(start + [0, 0, 1.7], ray[:, None], since_s, rng)
        range_m = met[:, 0]
    heard = (range_m < 100) & (rng.random(len(range_m)) < share_heard)
    hit = start[heard] + ray[heard] * range_m[heard, None]
    sweep = Sweep(
        frame=frame,
        stamp_ns=frame * period_ns,
        points=poses.transform(poses.inverse(T_world_lidar), hit),
        intensity=np.zeros(len(hit), np.float32),
        offset_ns=pulses.offset_ns[heard],
        lidar=pulses.lidar[heard],
        row=np.arange(len(hit)),
        scanner_origins=sensor.origins_m,
    )
    return RegisteredSweep(sweep, T_world_lidar, np.asarray(twist), np.asarray(twist))
