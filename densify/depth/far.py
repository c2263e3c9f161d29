# SPDX-License-Identifier: MIT
"""Select the static points of sweeps beyond a key's window, and the part that a key needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from typing import Any

import numpy as np

from densify.depth.exposure import Exposure
from densify.depth.patches import FREE, tangents
from densify.free_space.range_image import RangeImage
from densify.free_space.sensor import Sensors
from densify.geometry import poses
from densify.geometry.compiled import num_threads
from densify.geometry.nearest import thinned
from densify.geometry.types import (
    Bool,
    Camera,
    Cloud,
    Float,
    Float32,
    Int,
    Patches,
    RegisteredSweep,
    StandingWorld,
    Stretch,
    Sweep,
)

_MOST_RANGE_M = 60.0
_MOST_SPACING_M = 0.05  # many sweeps measure a surface, and larger patches hide edges
_GROUP_M = 2.5  # travel within which sweeps observe the same, with the same errors
_CONFIDENCE = 0.5
_SLACK_M = 0.5
_SAME_DEPTH = 0.05  # step of depth, as a share; a pixel needs one point in each
_PRIME = 2_654_435_761  # its multiples visit any smaller number of points in mixed order
_FEW_FILLED = 3  # of nine cells that must be filled, for a sweep beyond the window
# Travel between witnesses and from the tested sweep: most of a car, or its rear half.
_WITNESSES_M, _WITNESS_M, _LEAST_WITNESS_M = 5.0, 3.5, 2.0


def in_reach(sweep: Sweep) -> Bool:
    """Return (N,) True for returns near enough for a good registration."""
    x, y, z = sweep.points.T
    return x * x + y * y + z * z < _MOST_RANGE_M**2


def departed(sweeps: Sequence[RegisteredSweep], travel_m: Float) -> list[Bool]:
    """Return (N,) for each sweep, True where another sweep saw through the point.

    Points ahead of a sweep are compared with the next witness at least 3.5 m farther, points behind
    it with the previous one. By then even a vehicle that drives along has left most of the place.
    At the ends of the road the witness is the last sweep, 2 m away or more, or the one on the other
    side.

    Args:
        sweeps: Deskewed, in the order of the road.
        travel_m: (S,) their positions along the road, ascending.
    """
    asked = [0] if sweeps else list[int]()
    for i, at_m in enumerate(travel_m.tolist()):
        if at_m - travel_m[asked[-1]] >= _WITNESSES_M or i == len(sweeps) - 1 > 0:
            asked.append(i)
    with ThreadPoolExecutor(num_threads()) as pool:
        images = dict(zip(asked, pool.map(lambda i: RangeImage.of(sweeps[i]), asked), strict=True))

    def gone(i: int) -> Bool:
        one, witnesses = sweeps[i], _witnesses(i, asked, travel_m)
        points, free = one.sweep.points, np.zeros(len(one.sweep), bool)
        whose = np.zeros(len(points), np.int64)
        T = [poses.inverse(sweeps[w].T_world_lidar) @ one.T_world_lidar for w in witnesses]
        if len(witnesses) == 2:  # points ahead belong to the later witness
            whose[points @ poses.inverse(T[1])[:3, 3] > 0] = 1
        for number, witness in enumerate(witnesses):
            rows = np.flatnonzero(whose == number)
            there = poses.transform(T[number], points.take(rows, axis=0))
            free[rows] = images[witness].sees_through(there, *FREE, _FEW_FILLED)
        return free

    with ThreadPoolExecutor(num_threads()) as pool:
        return list(pool.map(gone, range(len(sweeps))))


def _witnesses(i: int, asked: Sequence[int], travel_m: Float) -> list[int]:
    """Return the witnesses before and after a sweep, or only one of them."""
    apart_m = np.array([travel_m[j] - travel_m[i] for j in asked])
    sides = []
    for off_m in (-apart_m, apart_m):
        far_enough = np.flatnonzero(off_m >= _WITNESS_M)
        if len(far_enough):
            sides.append(asked[far_enough[np.argmin(off_m[far_enough])]])
        elif off_m.max() >= _LEAST_WITNESS_M:
            sides.append(asked[int(np.argmax(off_m))])
    return sides


def standing(
    sensors: Sensors, registered: RegisteredSweep, travel_m: float, gone: Bool
) -> StandingWorld:
    """Return the points of one sweep in the world, without those ``gone`` (N,), see `departed`."""
    sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
    one = np.zeros(len(sweep), np.int32)
    normal, spacing_m = tangents(
        sweep.points, sweep.lidar, one, np.ones(len(one), bool), sensors, [sensors.origins_m]
    )
    return StandingWorld(
        points=poses.transform(T_world_lidar, sweep.points).astype(np.float32),
        normal=poses.rotate(T_world_lidar, normal.astype(np.float64)).astype(np.float32),
        spacing_m=np.minimum(spacing_m, np.float32(_MOST_SPACING_M)),
        source=one,
        row=sweep.row,
        lidar=sweep.lidar,
        intensity=sweep.intensity,
        frames=(sweep.frame,),
        stamp_ns=np.array([sweep.stamp_ns], np.int64),
        travel_m=np.array([travel_m]),
    ).select(~gone)


def joined(parts: Sequence[StandingWorld]) -> StandingWorld:
    """Return parts of one world as one, by ascending frame."""
    parts = [_NOTHING, *sorted(parts, key=lambda part: part.frames)]
    counts = np.cumsum([0, *(len(part.frames) for part in parts)])
    sources = [p.source + np.int32(first) for p, first in zip(parts, counts, strict=False)]
    names = {field.name for field in fields(StandingWorld)} - {"source", "frames", "left_out"}
    columns: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in names}
    frames = tuple(frame for part in parts for frame in part.frames)
    return StandingWorld(**columns, source=np.concatenate(sources), frames=frames)


_NOTHING = StandingWorld(
    points=np.zeros((0, 3), np.float32),
    normal=np.zeros((0, 3), np.float32),
    spacing_m=np.zeros((0, 2), np.float32),
    source=np.zeros(0, np.int32),
    row=np.zeros(0, np.int64),
    lidar=np.zeros(0, np.uint8),
    intensity=np.zeros(0, np.float32),
    frames=(),
    stamp_ns=np.zeros(0, np.int64),
    travel_m=np.zeros(0),
)


def may_see(camera: Camera, T_cam_world: Float, points: Float32, slack_m: float) -> Bool:
    """Return (N,) False where a camera certainly does not observe a point (N,3) of the world.

    The camera may be up to ``slack_m`` elsewhere. A lens that is no pinhole may observe all points.
    """
    if camera.model != "pinhole":
        return np.ones(len(points), bool)
    T = T_cam_world.astype(np.float32)
    x, y, z = T[:3, :3] @ points.T + T[:3, 3:]
    K, slack_m = camera.K.astype(np.float32), np.float32(slack_m)
    bent = np.float32(1.2 if camera.distortion else 1.0)
    right, left = bent * (camera.width_px - K[0, 2]) / K[0, 0], -bent * K[0, 2] / K[0, 0]
    low, high = bent * (camera.height_px - K[1, 2]) / K[1, 1], -bent * K[1, 2] / K[1, 1]
    inside: Bool = (x < right * z + slack_m) & (x > left * z - slack_m) & (z > -slack_m)
    inside &= (y < low * z + slack_m) & (y > high * z - slack_m)
    return inside


def far_cloud(
    found: StandingWorld,
    T_key_found: Float,
    stretch: Stretch,
    key: int,
    exposures: Mapping[str, Exposure],
    standing_only: bool,
) -> tuple[Cloud, Patches]:
    """Return the points beyond the window that a camera observes, and their patches; key frame.

    One point of every depth in a pixel is enough.

    Args:
        T_key_found: (4,4) to the key from the world of ``found``.
        stretch: The window.
        standing_only: Without points that the first or the last sweep of the window saw
            through.
    """
    beyond = ~np.isin(found.frames, stretch.frames)
    rows = np.flatnonzero(beyond[found.source])
    needed = np.zeros(len(rows), bool)
    for exposure in exposures.values():
        needed[_seen(found.points.take(rows, axis=0), T_key_found, exposure)] = True
    rows = rows[needed]
    points = poses.transform(T_key_found, found.points.take(rows, axis=0).astype(np.float64))
    if standing_only:
        ends = sorted({stretch.frames[0], stretch.frames[-1]} - {key})
        stands = ~_gone(points, stretch, key, ends)
        rows, points = rows[stands], points[stands]
    found = found.select(rows)
    num, source = len(found), found.source
    cloud = Cloud(
        points=points,
        rigid_points=points,
        frame=np.array(found.frames, np.int32)[source],
        since_key_ns=(found.stamp_ns - stretch[key].sweep.stamp_ns)[source],
        row=found.row,
        lidar=found.lidar,
        moving=np.zeros(num, bool),
        instance=np.full(num, -1, np.int32),
        velocity_m_s=np.zeros((num, 3), np.float32),
        confidence=np.full(num, _CONFIDENCE, np.float32),
        intensity=found.intensity,
        rgb=np.zeros((num, 3), np.uint8),
        far=np.ones(num, bool),
    )
    group = np.floor(found.travel_m / _GROUP_M).astype(np.int32)
    surface = Patches(
        normal=poses.rotate(T_key_found, found.normal.astype(np.float64)).astype(np.float32),
        spacing_m=found.spacing_m,
        free=np.zeros(num, bool),
        sweep=source,
        place=(group - group.min(initial=0))[source],
    )
    return cloud, surface


def _seen(points: Float32, T_key_world: Float, exposure: Exposure) -> Int:
    """Return the rows, ascending, of the points (N,3) of the world that a camera needs.

    It needs one in every pixel and step of depth, from sweeps in mixed order.
    """
    T_cam_world = exposure.T_cam_key @ T_key_world
    near = np.flatnonzero(may_see(exposure.camera, T_cam_world, points, _SLACK_M))
    there = poses.transform(T_key_world, points[near].astype(np.float64))
    sight = exposure.see(there, np.zeros(there.shape, np.float32))
    rows = near[sight.inside]
    depth = exposure.depth_m(sight.points_cam[sight.inside])
    place = np.column_stack([sight.uv[sight.inside], np.log(depth) / _SAME_DEPTH])
    cell = np.rint(place.astype(np.float32))
    # Neighbouring pixels must be from many sweeps, which have to agree.
    mixed = np.arange(len(rows)) * _PRIME % max(1, len(rows))
    return rows[thinned(cell, mixed, 1.0, 1)]


def _gone(points: Float, stretch: Stretch, key: int, witnesses: Sequence[int]) -> Bool:
    """Return (M,) True where one of these sweeps saw through a point (M,3), key frame."""
    free = np.zeros(len(points), bool)
    for frame in witnesses:
        there = poses.transform(stretch.T_target_source(frame, key), points)
        image = RangeImage.of(stretch[frame])
        free |= image.sees_through(there, *FREE)
    return free
