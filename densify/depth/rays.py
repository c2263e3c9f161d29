# SPDX-License-Identifier: MIT
"""Follow the rays of a window's sweeps: where they start, and how they meet moving objects.

Rays toward a moving object are moved along with it to the key sweep's time. Where they end on its
hull its body is closed, where they pass through it is open. Where no ray shows free space, its box
grows to the usual size of a vehicle of its width or length, and down to the ground.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree, QhullError

from densify.depth.exposure import Exposure
from densify.depth.patches import AGREE_M, HIDDEN_M
from densify.free_space.ground import HeightMap
from densify.geometry import poses
from densify.geometry.arrays import joined_rows, select_rows
from densify.geometry.twists import move_with_twists
from densify.geometry.types import Bool, Cloud, Float, Float32, Int, ObjectTrack, Stretch, Sweep

_NEAR_M = 2.5 * AGREE_M  # distance within which a point of a body has other points of it
_LEAST_NEAR = 6  # least number of these points; others are outliers
_SIDES = (("rear", "front"), ("right", "left"), ("bottom", "top"))
# Greatest distance of free space from a side that is seen; tolerates errors of motion and
# registration
_BESIDE_M = 2 * HIDDEN_M
_NUM_RAYS = 3  # number of rays that show free space; single rays may be mixed echoes
_MIDDLE = 0.6  # share of a side, around its middle, that is flat; corners are round
_BODY = (0.2, 0.5)  # shares of the height: from above the road to below the windows
_CAR_WIDTH_M = 1.4  # width from which an object may be a car; other road users are narrower
_CAR_LENGTH_M = 3.0  # the same of the length; shorter objects may be people and bicycles
_LENGTH_PER_WIDTH = 2.4  # of cars: 1.65 by 4.0 m, 1.85 by 4.4 m
_WIDEST_M = 2.55  # greatest width of a vehicle by law


@dataclass(frozen=True)
class Rays:
    """The rays of the sweeps of a window, in the lidar frame of the key sweep."""

    stretch: Stretch  # registered sweeps of the window
    key: int  # frame number of the key sweep

    def origins_of(self, cloud: Cloud) -> Float:
        """Return the origins (M,3) of M points' rays at firing time, key sweep's lidar frame."""
        origins = np.empty((len(cloud), 3))
        for frame in np.unique(cloud.frame).tolist():
            rows = np.flatnonzero(cloud.frame == frame)
            registered = self.stretch[frame]
            origin = _scanner_origins(registered.sweep)[cloud.lidar[rows]]
            offset_ns = registered.sweep.offset_ns
            if offset_ns is not None:
                # From the reference time to the firing time the scanner moves with the lidar.
                row = registered.sweep.row
                order = np.argsort(row, kind="stable")
                returns = order[np.searchsorted(row, cloud.row[rows], sorter=order)]
                twists = registered.twist_before, registered.twist_after
                origin = move_with_twists(origin, offset_ns[returns] * 1e-9, *twists)
            origins[rows] = poses.transform(self.stretch.T_target_source(self.key, frame), origin)
        return origins

    def origin_bound_m(self, frame: int) -> float:
        """Return the greatest possible distance (m) of a sweep's ray origins from its lidar."""
        registered = self.stretch[frame]
        sweep = registered.sweep
        bound_m = float(np.linalg.norm(_scanner_origins(sweep), axis=1).max())
        if sweep.offset_ns is not None:
            twists = (registered.twist_before, registered.twist_after)
            speed_m_s = max(float(np.linalg.norm(twist[3:])) for twist in twists)
            bound_m += speed_m_s * 1e-9 * float(np.abs(sweep.offset_ns).max(initial=0))
        return bound_m


def _scanner_origins(sweep: Sweep) -> Float:
    """Return the (S,3) origins of a sweep's scanners in its lidar frame."""
    num_scanners = int(sweep.lidar.max(initial=0)) + 1
    return np.stack([sweep.origin_m(scanner) for scanner in range(num_scanners)])


def half_spaces(corners: Float) -> Float:
    """Return the sides (F,4) n, d of the corners' (V,3) convex hull: inside is n · x + d ≤ 0."""
    return np.unique(ConvexHull(corners).equations, axis=0)  # one for all triangles of a side


def find_crossing(spaces: Float, start: Float, direction: Float) -> tuple[Float, Float]:
    """Return where lines, start + t · direction, enter a convex body and where they leave the body.

    The body has the sides (F,4) of `half_spaces`. Lines start at (K,3), or all at (3,). Directions
    (K,3) have any length. Returned are t (K,) of entering and of leaving, less if a line misses.
    """
    enter, leave = np.full(len(direction), -np.inf), np.full(len(direction), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for side in spaces:
            # The sum turns a slope of -0 into 0: with -0, t has the wrong sign, and a line parallel
            # to a side and outside it would enter.
            slope = direction @ side[:3] + 0.0
            t = (start @ -side[:3] - side[3]) / slope
            # A line enters where all sides have been passed inwards. It leaves at the first side
            # that is passed outwards.
            is_inward = slope < 0
            np.maximum(enter, np.where(is_inward, t, -np.inf), out=enter)
            np.fmin(leave, np.where(is_inward, np.inf, t), out=leave)
    return enter, leave


def passes_near(corners: Float, start: Float, direction: Float) -> Bool:
    """Return the mask (K,) of lines (start, direction) that meet a sphere around corners (V,3)."""
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - middle, axis=1).max()
    # The distance of a line from the middle, times the length of its direction
    scaled_m = np.linalg.norm(np.cross(start - middle, direction), axis=1)
    return scaled_m <= radius_m * np.linalg.norm(direction, axis=1)


class ObjectRays(NamedTuple):
    """K rays in the key sweep's lidar frame, moved along with an object to the key's time."""

    rows: Int  # (K,) indices of the returns in the cloud
    start: Float  # (K,3) origin of each ray
    to_return: Float  # (K,3) vector from the origin to the return


def rays_toward(
    cloud: Cloud, rays: Rays, rows_of: Mapping[int, Int], corners: Mapping[int, Float]
) -> dict[int, ObjectRays]:
    """Return the rays of all sweeps that may meet the hull of each object, by instance number.

    Only sweeps with points of the object count, because these points tell the object's motion.

    Args:
        cloud: The cloud that the rays measured.
        rays: The rays of the window's sweeps.
        rows_of: Indices of each object's points in the cloud, by instance number.
        corners: (V,3) hull corners of each object at the key's time, key sweep's lidar frame.
    """
    if not rows_of:
        return {}
    parts_of: dict[int, list[ObjectRays]] = {instance: [] for instance in rows_of}
    for frame in rays.stretch.frames:
        toward = _returns_toward(cloud, rays, frame, rows_of, corners)
        if not toward:
            continue
        # All origins are found together, and split into those of each object.
        rows_of_part = [rows for _, rows in toward.values()]
        origins = rays.origins_of(cloud.select(np.concatenate(rows_of_part)))
        parts = np.split(origins, np.cumsum([len(rows) for rows in rows_of_part])[:-1])
        for (instance, (T_key_sweep, rows)), part in zip(toward.items(), parts, strict=True):
            start = poses.transform(T_key_sweep, part)
            end = poses.transform(T_key_sweep, cloud.rigid_points[rows])
            parts_of[instance].append(ObjectRays(rows, start, end - start))
    return {instance: joined_rows(parts) for instance, parts in parts_of.items()}


def _returns_toward(
    cloud: Cloud, rays: Rays, frame: int, rows_of: Mapping[int, Int], corners: Mapping[int, Float]
) -> dict[int, tuple[Float, Int]]:
    """Return, by instance number, an object's motion since a sweep, and the returns toward it."""
    returns = np.flatnonzero(cloud.frame == frame)
    lidar_origin = rays.stretch.T_target_source(rays.key, frame)[:3, 3]
    from_lidar = cloud.rigid_points.take(returns, axis=0) - lidar_origin
    xy = from_lidar[:, :2].T.astype(np.float32)
    bound_m = rays.origin_bound_m(frame)
    toward = dict[int, tuple[Float, Int]]()
    for instance, rows in rows_of.items():
        own = rows[cloud.frame[rows] == frame]
        if len(own):
            T_key_sweep = poses.fit_rigid(cloud.rigid_points[own], cloud.points[own])
            hull = poses.transform(poses.inverse(T_key_sweep), corners[instance])
            is_toward = _may_meet(xy, bound_m, hull - lidar_origin)
            toward[instance] = T_key_sweep, returns[is_toward]
    return toward


def _may_meet(xy: Float32, bound_m: float, corners: Float) -> Bool:
    """Return the mask (N,) of returns at xy (2,N) m whose rays may meet a hull of corners (V,3).

    Returns and corners are relative to the lidar. Rays start at most ``bound_m`` from the lidar.
    """
    x, y, _ = corners.T
    middle = np.array([x.mean(), y.mean()])
    range_m = np.hypot(*middle)
    radius_m = np.hypot(x - middle[0], y - middle[1]).max() + bound_m
    if range_m <= radius_m:
        return np.ones(xy.shape[1], bool)
    # The sector from the lidar that touches a circle around the hull, from the circle on
    axis_x, axis_y = (middle / range_m).astype(np.float32)
    tangent = np.float32(radius_m / np.sqrt(range_m**2 - radius_m**2))  # of half its angle
    forward_m = axis_x * xy[0] + axis_y * xy[1]
    sideways_m = axis_y * xy[0] - axis_x * xy[1]
    return (forward_m > range_m - radius_m) & (abs(sideways_m) <= tangent * forward_m)


class MovingBody(NamedTuple):
    """The convex hull of a moving object, and the K rays of all sweeps that meet the hull."""

    # (V,3) corners of the hull in metres, key sweep's lidar frame and reference time
    corners: Float
    velocity_m_s: Float32  # (3,) velocity of the object without ego-motion, same frame
    entries: Float  # (K,3) positions where the rays enter the hull, same frame and time
    ends: Bool  # (K,) True if the ray ends on the object, False if it passes through
    frame: NDArray[np.integer]  # (K,) frame number of the ray's sweep


def find_moving_bodies(
    cloud: Cloud, rays: Rays, exposures: Collection[Exposure]
) -> dict[int, MovingBody]:
    """Return the bodies of moving objects, by instance number.

    An object has a body if its points span a volume and one of the ``exposures`` shows a corner.
    """
    moving = np.flatnonzero(cloud.moving & (cloud.instance >= 0))
    instance_of = cloud.instance[moving]
    shown_rows, hulls, velocities = dict[int, Int](), dict[int, Float](), dict[int, Float32]()
    for instance in np.unique(instance_of).tolist():
        rows = moving[instance_of == instance]
        corners = _hull_corners(cloud.points[rows])
        velocity_m_s = np.median(cloud.velocity_m_s[rows], axis=0)
        if any(exposure.see(corners, velocity_m_s).inside.any() for exposure in exposures):
            shown_rows[instance], hulls[instance] = rows, corners
            velocities[instance] = velocity_m_s

    bodies = {}
    for instance, toward in rays_toward(cloud, rays, shown_rows, hulls).items():
        corners = hulls[instance]
        near = select_rows(toward, passes_near(corners, toward.start, toward.to_return))
        enter, leave = find_crossing(half_spaces(corners), near.start, near.to_return)
        meets = (enter > 0) & (enter < np.minimum(leave, 1))  # 0 is the origin, 1 the return
        rows, start, to_return = select_rows(near, meets)
        bodies[instance] = MovingBody(
            corners=corners,
            velocity_m_s=velocities[instance],
            entries=start + enter[meets, None] * to_return,
            ends=cloud.moving[rows] & (cloud.instance[rows] == instance),
            frame=cloud.frame[rows],
        )
    return bodies


def without_sweep(
    bodies: Mapping[int, MovingBody], cloud: Cloud, frame: int
) -> dict[int, MovingBody]:
    """Return the bodies without the rays of a sweep, if a ``cloud`` without it spans a volume."""
    reduced_bodies = {}
    for instance, body in bodies.items():
        corners = _hull_corners(cloud.points[cloud.moving & (cloud.instance == instance)])
        if len(corners):
            others = select_rows(body, body.frame != frame, ("entries", "ends", "frame"))
            reduced_bodies[instance] = others._replace(corners=corners)
    return reduced_bodies


def _hull_corners(points: Float) -> Float:
    """Return the (V,3) hull corners of points (N,3) without outliers, none without a volume."""
    # One more point than needed, because the nearest is the point itself.
    distance_m, _ = KDTree(points).query(points, [_LEAST_NEAR + 1])
    points = points[np.ravel(distance_m) <= _NEAR_M]
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # too few points, or points on a plane
        return points[:0]


def complete_boxes(
    tracks: Sequence[ObjectTrack], cloud: Cloud, rays: Rays, ground: HeightMap
) -> tuple[ObjectTrack, ...]:
    """Return the tracks with completed boxes and the names of the sides that were seen.

    Where no ray shows free space, a box grows to the usual size of a vehicle, and to the ground. A
    side is seen if free space begins within 0.4 m of the side. The bottom is never named. The
    ``ground`` is in the world frame of the sweeps.
    """
    tracks = [_lower_to_ground(track, rays, ground) for track in tracks]
    reach, rows_of = dict[int, Float](), dict[int, Int]()
    for track in tracks:
        # The space into which the box may grow, at both ends of each axis
        reach_size_m = track.size_m + 2 * (_missing_m(track.size_m) + _BESIDE_M)
        T_key_object = track.T_key_object[track.frames.index(rays.key)]
        reach[track.instance] = poses.transform(T_key_object, corners_of(reach_size_m))
        is_own = cloud.moving & (cloud.instance == track.instance)
        rows_of[track.instance] = np.flatnonzero(is_own)
    toward = rays_toward(cloud, rays, rows_of, reach)
    return tuple(_complete_box(track, toward[track.instance], rays.key) for track in tracks)


def _missing_m(size_m: Float) -> Float:
    """Return the (3,) length, width and height (0) in metres that a box lacks to a vehicle."""
    length_m, width_m, _ = size_m
    missing_m = np.zeros(3)
    if length_m >= _CAR_LENGTH_M:
        missing_m[1] = max(0.0, min(length_m / _LENGTH_PER_WIDTH, _WIDEST_M) - width_m)
    if width_m >= _CAR_WIDTH_M:
        missing_m[0] = max(0.0, _LENGTH_PER_WIDTH * width_m - length_m)
    return missing_m


def _lower_to_ground(track: ObjectTrack, rays: Rays, ground: HeightMap) -> ObjectTrack:
    """Return the track with a box that reaches down to the ground at the key."""
    T_key_object = track.T_key_object[track.frames.index(rays.key)]
    corners = poses.transform(T_key_object, corners_of(track.size_m))
    T_world_key = rays.stretch[rays.key].T_world_lidar
    bottom = corners[::2]  # every other corner
    above_m = float(np.median(ground.above(poses.transform(T_world_key, bottom))))
    return grow_box(track, 2, max(above_m, 0.0), 0.0)


def corners_of(size_m: Float) -> Float:
    """Return the (8,3) corners in metres of a box of lengths ``size_m`` (3,) around the origin.

    Even rows are corners at the bottom, odd rows those above them.
    """
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1)
    return signs.reshape(-1, 3) * size_m / 2


def _complete_box(track: ObjectTrack, rays: ObjectRays, key: int) -> ObjectTrack:
    """Return a track with its completed box, from the rays toward the object."""
    missing_m = _missing_m(track.size_m)
    T_object_key = poses.inverse(track.T_key_object[track.frames.index(key)])
    start, to_return = _rays_in_reach(rays, T_object_key, track.size_m / 2 + missing_m)
    completed = track
    sides_seen = list[str]()
    for axis, sides in enumerate(_SIDES):
        # At the lower and at the upper end of the axis. The rays are in the frame of the first box.
        distances_m = [
            _distance_to_free_space_m(track.size_m, missing_m, axis, sign, start, to_return)
            for sign in (-1, 1)
        ]
        # Free space within 0.4 m fixes a side: it is seen. Farther free space limits its growth.
        limits_m = [distance_m if distance_m > _BESIDE_M else 0.0 for distance_m in distances_m]
        sides_seen += [side for side, limit_m in zip(sides, limits_m, strict=True) if not limit_m]
        if missing_m[axis] > 0 and sum(limits_m):
            before_m, after_m = _share_growth(float(missing_m[axis]), limits_m)
            completed = grow_box(completed, axis, before_m, after_m)
    return replace(completed, sides_seen=tuple(side for side in sides_seen if side != "bottom"))


def _rays_in_reach(rays: ObjectRays, T_object_key: Float, half_m: Float) -> tuple[Float, Float]:
    """Return start and vector to the return (K,3), object frame, of rays that cross the reach."""
    # The reach is the space into which the box may grow, with the margin of free space around.
    start = poses.transform(T_object_key, rays.start)
    to_return = poses.rotate(T_object_key, rays.to_return)
    reach_m = half_m + _BESIDE_M
    enter, leave = find_crossing(_box_spaces(-reach_m, reach_m), start, to_return)
    crosses = (enter < leave) & (leave > 0) & (enter < 1)  # 0 is the origin, 1 the return
    return start[crosses], to_return[crosses]


def _share_growth(missing_m: float, limits_m: Sequence[float]) -> list[float]:
    """Return the growth of the two ends of a box in metres, within the limit of each end."""
    # Equal parts, if both ends may grow. An end takes what the limit of the other leaves.
    num_ends = 1 + all(limits_m)
    parts_m = [min(limit_m, missing_m / num_ends) for limit_m in limits_m]
    more_m = missing_m - sum(parts_m)
    return [
        min(limit_m, part_m + more_m) for limit_m, part_m in zip(limits_m, parts_m, strict=True)
    ]


def _distance_to_free_space_m(
    size_m: Float, missing_m: Float, axis: int, sign: int, start: Float, to_return: Float
) -> float:
    """Return the metres from a side of a box to the nearest free space outside; inf for none.

    The side is at the lower (``sign`` -1) or upper (1) end of ``axis``. Free space is where three
    rays (K,3), in the frame of the box, pass. The search ends 0.4 m beyond the greatest growth.
    """
    # The searched space, from low to high, is outside the flat part of the side. At vertical sides
    # the space is below the windows, because rays pass through glass.
    low, high = -_MIDDLE * size_m / 2, _MIDDLE * size_m / 2
    if axis < 2:
        low[2], high[2] = -size_m[2] / 2 + np.array(_BODY) * size_m[2]
    reach_m = missing_m[axis] + _BESIDE_M
    side_m = sign * size_m[axis] / 2
    low[axis], high[axis] = sorted([side_m, side_m + sign * reach_m])

    # Each ray crosses the space from its origin (0) or entry to its return (1) or exit.
    enter, leave = find_crossing(_box_spaces(low, high), start, to_return)
    enter, leave = np.maximum(enter, 0), np.minimum(leave, 1)
    crosses = enter < leave
    start_m, ray_m = start[crosses, axis], to_return[crosses, axis]
    ends_m = np.stack([start_m + enter[crosses] * ray_m, start_m + leave[crosses] * ray_m])
    # A ray shows free space from the end of this part that is nearer to the side.
    nearer_m = np.sort(np.min(sign * ends_m, axis=0) - abs(side_m))
    return float(nearer_m[_NUM_RAYS - 1]) if len(nearer_m) >= _NUM_RAYS else np.inf


def _box_spaces(low: Float, high: Float) -> Float:
    """Return the (6,4) sides of a box between two corners (3,), as `half_spaces`."""
    return np.block([[np.eye(3), -high[:, None]], [-np.eye(3), low[:, None]]])


def grow_box(track: ObjectTrack, axis: int, before_m: float, after_m: float) -> ObjectTrack:
    """Return the track with a box that is longer along an axis (0, 1 or 2) of the object's frame.

    The box grows by ``before_m`` at the lower and by ``after_m`` at the upper end of the axis.
    """
    size_m, T_key_object = track.size_m.copy(), track.T_key_object.copy()
    size_m[axis] += before_m + after_m
    shift_m = (after_m - before_m) / 2
    T_key_object[:, :3, 3] += shift_m * T_key_object[:, :3, axis]
    return replace(track, size_m=size_m, T_key_object=T_key_object)
