# SPDX-License-Identifier: MIT
"""Select static points of sweeps beyond the window, and the part that a key sweep needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from typing import Any

import numpy as np

from densify.depth.confidence import confidence_by_age
from densify.depth.exposure import AT_ONCE, Exposure
from densify.depth.patches import AGREE_M, HIDDEN_FRACTION, fit_tangents
from densify.free_space.range_image import FREE_MARGIN, RangeImage
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
    StaticWorld,
    Stretch,
    Sweep,
)

_MOST_RANGE_M = 60.0  # greatest range of returns that are registered well
# Larger patches hide edges. These are large enough, because many sweeps measure each surface.
_MOST_SPACING_M = 0.5 * AGREE_M
_SLACK_M = 0.5  # distance from its pose at which a camera may be, in the fast test of the view
_PRIME = 2_654_435_761  # multiples of it, modulo a number of points, shuffle the points
_MIN_FILLED = 3  # least number of filled cells of nine, for a sweep beyond the window
_TESTER_STEP_M = 5.0  # travel between testing sweeps
# Travel from a sweep to the testing sweep of its points, and the least at the ends of the road. A
# car ahead that drives along has then left most of its place, or its rear half.
_TEST_M, _LEAST_TEST_M = 3.5, 2.0


def in_reach(sweep: Sweep) -> Bool:
    """Return the mask (N,) of the returns within 60 m of the lidar, which are registered well."""
    x, y, z = sweep.points.T
    return x * x + y * y + z * z < _MOST_RANGE_M**2


def find_seen_through(sweeps: Sequence[RegisteredSweep], travel_m: Float) -> list[Bool]:
    """Return, for each sweep, the mask (N,) of its points that another sweep saw through.

    Some sweeps, 5 m of travel apart, test the points of the others. Points ahead of a sweep are
    tested by the next testing sweep at least 3.5 m farther, points behind by the previous one. By
    then even a vehicle that drives along has left most of its place. At the ends of the road the
    last testing sweep is taken, if 2 m away or more, or the testing sweep on the other side. The S
    deskewed sweeps have the ascending positions ``travel_m`` (S,) along the road in metres.
    """
    testers = _choose_testers(travel_m)
    with ThreadPoolExecutor(num_threads()) as pool:
        range_images = pool.map(RangeImage.of, [sweeps[tester] for tester in testers])
        images = dict(zip(testers, range_images, strict=True))

    def find_in_sweep(index: int) -> Bool:
        """Return the mask (N,) of the points of a sweep that were seen through."""
        tested = sweeps[index]
        points = tested.sweep.points
        own_testers = _choose_testers_of(index, testers, travel_m)
        T_tester_lidar = [
            poses.inverse(sweeps[tester].T_world_lidar) @ tested.T_world_lidar
            for tester in own_testers
        ]
        # With two testers, the later one tests the points on its own side, the earlier the others.
        tester_of_point = np.zeros(len(points), np.int64)
        if len(own_testers) == 2:
            to_later_tester = poses.inverse(T_tester_lidar[1])[:3, 3]
            tester_of_point[points @ to_later_tester > 0] = 1

        is_free = np.zeros(len(points), bool)
        for tester_number, tester in enumerate(own_testers):
            rows = np.flatnonzero(tester_of_point == tester_number)
            T = T_tester_lidar[tester_number]
            is_free[rows] = images[tester].sees_through(
                poses.transform(T, points.take(rows, axis=0)), *FREE_MARGIN, min_filled=_MIN_FILLED
            )
        return is_free

    with ThreadPoolExecutor(num_threads()) as pool:
        return list(pool.map(find_in_sweep, range(len(sweeps))))


def _choose_testers(travel_m: Float) -> list[int]:
    """Return the indices of the testing sweeps: the first, the last, and some between."""
    testers: list[int] = []
    last = len(travel_m) - 1
    for index, sweep_m in enumerate(travel_m):
        if index in (0, last) or sweep_m - travel_m[testers[-1]] >= _TESTER_STEP_M:
            testers.append(index)
    return testers


def _choose_testers_of(index: int, testers: Sequence[int], travel_m: Float) -> list[int]:
    """Return the indices of the sweeps that test one sweep, behind and ahead: two, one or none."""
    ahead_m = np.array([travel_m[tester] - travel_m[index] for tester in testers])
    chosen = []
    for distance_m in (-ahead_m, ahead_m):
        far_enough = np.flatnonzero(distance_m >= _TEST_M)
        if len(far_enough):
            chosen.append(testers[far_enough[np.argmin(distance_m[far_enough])]])
        elif distance_m.max() >= _LEAST_TEST_M:
            chosen.append(testers[int(np.argmax(distance_m))])
    return chosen


def static_points(sensors: Sensors, registered: RegisteredSweep, seen_through: Bool) -> StaticWorld:
    """Return a sweep's points, except ``seen_through`` (N,), in the world, with their patches."""
    sweep, T_world_lidar = registered.sweep, registered.T_world_lidar
    source = np.zeros(len(sweep), np.int32)
    surface = fit_tangents(sweep.points, sweep.lidar, source, sensors, [sensors.origins_m])
    return StaticWorld(
        points=poses.transform(T_world_lidar, sweep.points).astype(np.float32),
        normal=poses.rotate(T_world_lidar, surface.normal.astype(np.float64)).astype(np.float32),
        spacing_m=np.minimum(surface.spacing_m, np.float32(_MOST_SPACING_M)),
        source=source,
        row=sweep.row,
        lidar=sweep.lidar,
        intensity=sweep.intensity,
        frames=(sweep.frame,),
        stamp_ns=np.array([sweep.stamp_ns], np.int64),
    ).select(~seen_through)


def join_worlds(worlds: Sequence[StaticWorld]) -> StaticWorld:
    """Return the parts of one static world as a whole, ordered by frame number."""
    # Without parts, the columns of the empty world are concatenated.
    parts = [_EMPTY_WORLD, *sorted(worlds, key=lambda world: world.frames)]
    # ``source`` is an index in ``frames``. The frames of a part follow those of all earlier parts.
    starts = np.cumsum([0, *(len(part.frames) for part in parts)])
    sources = [part.source + np.int32(start) for part, start in zip(parts, starts, strict=False)]
    names = {field.name for field in fields(StaticWorld)} - {"source", "frames", "left_out"}
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    frames = tuple(frame for part in parts for frame in part.frames)
    return StaticWorld(**columns, source=np.concatenate(sources), frames=frames)


_EMPTY_WORLD = StaticWorld(
    points=np.zeros((0, 3), np.float32),
    normal=np.zeros((0, 3), np.float32),
    spacing_m=np.zeros((0, 2), np.float32),
    source=np.zeros(0, np.int32),
    row=np.zeros(0, np.int64),
    lidar=np.zeros(0, np.uint8),
    intensity=np.zeros(0, np.float32),
    frames=(),
    stamp_ns=np.zeros(0, np.int64),
)


def may_see(camera: Camera, T_cam_world: Float, points: Float32, slack_m: float) -> Bool:
    """Return the mask (N,) of the points that a camera near a given pose may observe.

    This is a fast test: False is certain, unlike True. For a lens that is no pinhole all are True.
    Points (N,3) are in the world frame. The camera is at most ``slack_m`` from the pose.
    """
    if camera.model != "pinhole":
        return np.ones(len(points), bool)
    T = T_cam_world.astype(np.float32)
    x, y, z = T[:3, :3] @ points.T + T[:3, 3:]
    K, slack_m = camera.K.astype(np.float32), np.float32(slack_m)
    # A distorted image may show more than a pinhole of its matrix.
    widening = np.float32(1.2 if camera.distortion else 1.0)
    inside: Bool = z > -slack_m
    for axis, position, size_px in ((0, x, camera.width_px), (1, y, camera.height_px)):
        # Slopes x / z or y / z of the rays at both edges of the image
        low = -widening * K[axis, 2] / K[axis, axis]
        high = widening * (size_px - K[axis, 2]) / K[axis, axis]
        inside &= (position < high * z + slack_m) & (position > low * z - slack_m)
    return inside


def far_cloud(
    world: StaticWorld,
    T_key_world: Float,
    stretch: Stretch,
    key: int,
    exposures: Mapping[str, Exposure],
    static_only: bool,
) -> tuple[Cloud, Patches]:
    """Return the points beyond the window that a camera observes, and their patches.

    Points and patches are in the key sweep's lidar frame. One point per pixel and step of depth is
    kept. Exposures are by name of the map, ``key`` is the frame number of the key sweep. With
    ``static_only``, points that the first or the last sweep of the window saw through are left out.
    """
    is_beyond = ~np.isin(world.frames, stretch.frames)
    rows = np.flatnonzero(is_beyond[world.source])
    is_needed = np.zeros(len(world), bool)
    for exposure in exposures.values():
        is_needed[_select_needed(world.points, rows, T_key_world, exposure)] = True
    used = world.select(is_needed)
    points = poses.transform(T_key_world, used.points.astype(np.float64))
    if static_only:
        is_static = ~_seen_through_by_ends(points, stretch, key)
        used, points = used.select(is_static), points[is_static]
    num_points = len(used)
    sweeps_since_key_ns = used.stamp_ns - stretch[key].sweep.stamp_ns
    cloud = Cloud(
        points=points,
        rigid_points=points,
        frame=np.array(used.frames, np.int32)[used.source],
        since_key_ns=sweeps_since_key_ns[used.source],
        row=used.row,
        lidar=used.lidar,
        moving=np.zeros(num_points, bool),
        instance=np.full(num_points, -1, np.int32),
        velocity_m_s=np.zeros((num_points, 3), np.float32),
        confidence=confidence_by_age(sweeps_since_key_ns)[used.source],
        intensity=used.intensity,
        rgb=np.zeros((num_points, 3), np.uint8),
        far=np.ones(num_points, bool),
    )
    normal = poses.rotate(T_key_world, used.normal.astype(np.float64)).astype(np.float32)
    return cloud, Patches(normal, used.spacing_m)


def _select_needed(points: Float32, rows: Int, T_key_world: Float, exposure: Exposure) -> Int:
    """Return the ``rows`` (K,) of points (N,3), world, with one in each pixel and depth step."""
    if not len(rows):
        return rows
    chunks = [
        _find_cells(points, rows[begin : begin + AT_ONCE], T_key_world, exposure)
        for begin in range(0, len(rows), AT_ONCE)
    ]
    rows_in_view, cell_of_row = (np.concatenate(column) for column in zip(*chunks, strict=True))
    # Shuffle, because support needs several sweeps among neighbouring pixels.
    shuffled_order = np.arange(len(rows_in_view)) * _PRIME % max(1, len(rows_in_view))
    return rows_in_view[thinned(cell_of_row, shuffled_order, step=1.0, max_per_cell=1)]


def _find_cells(
    points: Float32, rows: Int, T_key_world: Float, exposure: Exposure
) -> tuple[Int, Float32]:
    """Return the rows in the image, and their (K,3) cells: column, row, step of log depth."""
    # A fast test first: the projection takes far longer.
    T_cam_world = exposure.T_cam_key @ T_key_world
    viewable = rows[may_see(exposure.camera, T_cam_world, points.take(rows, axis=0), _SLACK_M)]
    points_key = poses.transform(T_key_world, points.take(viewable, axis=0).astype(np.float64))
    sight = exposure.see(points_key, np.zeros(points_key.shape, np.float32))
    inside = np.flatnonzero(sight.inside)
    depth_m = exposure.depth_m(sight.points_cam.take(inside, axis=0))
    depth_step = np.log(depth_m) / HIDDEN_FRACTION
    cell = np.column_stack([sight.uv.take(inside, axis=0), depth_step])
    return viewable[inside], np.rint(cell.astype(np.float32))


def _seen_through_by_ends(points: Float, stretch: Stretch, key: int) -> Bool:
    """Return the mask (M,) of the points that the window's first or last sweep saw through."""
    is_free = np.zeros(len(points), bool)
    for frame in {stretch.frames[0], stretch.frames[-1]} - {key}:
        points_sweep = poses.transform(stretch.T_target_source(frame, key), points)
        is_free |= RangeImage.of(stretch[frame]).sees_through(points_sweep, *FREE_MARGIN)
    return is_free
