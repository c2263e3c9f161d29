# SPDX-License-Identifier: MIT
"""Follow the rays of a window's sweeps: where they start, and how they meet moving objects.

Rays that meet a moving object are moved along with it to the key sweep's time. They show its body:
where they end on its hull it is closed, where they pass it is open. They also complete its box
along the sides that no sweep saw. A side is seen if rays pass or end close beside it. Where no ray
was, a box grows to the usual size of a vehicle of its width or length, but not into space that rays
passed through. It stands on the ground.
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
from densify.geometry.types import Bool, Cloud, Float, Float32, Int, ObjectTrack, Stretch

_AROUND_M = 2.5 * AGREE_M  # distance within which a point of a body has other points of it
_LEAST_AROUND = 6  # number of these points
_SIDES = (("rear", "front"), ("right", "left"), ("bottom", "top"))
# Distance of rays to a side that is seen; tolerates errors of motion and registration.
_BESIDE_M = 2 * HIDDEN_M
_NUM_RAYS = 3  # rays that show free space; single rays may be mixed echoes
_MIDDLE = 0.6  # share of a side, around its middle, that is flat; corners are round
_BODY = (0.2, 0.5)  # share of the height: above the road, below the panes
_CAR_WIDE_M = 1.4  # the narrowest cars are wider, other road users narrower
_CAR_LONG_M = 3.0  # shorter objects may be people and bicycles
_LENGTH_OF_WIDTH = 2.4  # of cars: 1.65 by 4.0 m, 1.85 by 4.4 m
_WIDEST_M = 2.55  # by law


@dataclass(frozen=True)
class Rays:
    """The rays of the sweeps of a window, in the lidar frame of the key sweep."""

    stretch: Stretch  # registered sweeps of the window
    key: int  # frame number of the key sweep

    def starts(self, cloud: Cloud) -> Float:
        """Return the (M,3) origins of the rays of a cloud's M points, at their firing times."""
        starts = np.empty((len(cloud), 3))
        for frame in np.unique(cloud.frame).tolist():
            rows, registered = np.flatnonzero(cloud.frame == frame), self.stretch[frame]
            sweep = registered.sweep
            origin = np.stack([sweep.origin_m(n) for n in range(int(sweep.lidar.max()) + 1)])
            start = origin[cloud.lidar[rows]]
            if sweep.offset_ns is not None:
                order = np.argsort(sweep.row, kind="stable")
                sweep_rows = order[np.searchsorted(sweep.row, cloud.row[rows], sorter=order)]
                offset_s = sweep.offset_ns[sweep_rows, None] * 1e-9
                twist: Float = np.where(
                    offset_s < 0, registered.twist_before, registered.twist_after
                )
                start = poses.transform_each(offset_s * twist, start)
            starts[rows] = poses.transform(self.stretch.T_target_source(self.key, frame), start)
        return starts

    def moved_m(self, frame: int) -> float:
        """Return a bound of the distances of a sweep's rays, at their start, from its lidar."""
        registered = self.stretch[frame]
        sweep = registered.sweep
        numbers = range(int(sweep.lidar.max(initial=0)) + 1)
        bound_m = float(np.linalg.norm([sweep.origin_m(n) for n in numbers], axis=1).max())
        if sweep.offset_ns is not None:
            speeds = (registered.twist_before, registered.twist_after)
            speed_m_s = max(float(np.linalg.norm(twist[3:])) for twist in speeds)
            bound_m += speed_m_s * 1e-9 * float(np.abs(sweep.offset_ns).max(initial=0))
        return bound_m


def half_spaces(corners: Float) -> Float:
    """Return the (F,4) sides of the corners' (V,3) convex hull: unit normal n and offset d.

    A point x is inside if n · x + d ≤ 0 for all sides.
    """
    return np.unique(ConvexHull(corners).equations, axis=0)


def crossing(spaces: Float, start: Float, direction: Float) -> tuple[Float, Float]:
    """Return the (K,) t at which lines start + t · direction enter a convex body, and leave it.

    A line that misses the body leaves before it enters. ``spaces`` is from `half_spaces`,
    ``direction`` (K,3), ``start`` (K,3) or (3,) for all lines.
    """
    enter, leave = np.full(len(direction), -np.inf), np.full(len(direction), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for side in spaces:
            # No -0: a line along a side that is outside never enters.
            slope = direction @ side[:3] + 0.0
            t = (start @ -side[:3] - side[3]) / slope
            inward = slope < 0
            np.maximum(enter, np.where(inward, t, -np.inf), out=enter)
            np.fmin(leave, np.where(inward, np.inf, t), out=leave)
    return enter, leave


def passes_near(corners: Float, start: Float, direction: Float) -> Bool:
    """Return (K,) True for lines, as in `crossing`, that meet a sphere around the corners (V,3)."""
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius_m = np.linalg.norm(corners - middle, axis=1).max()
    off = np.linalg.norm(np.cross(start - middle, direction), axis=1)
    passes: Bool = off <= radius_m * np.linalg.norm(direction, axis=1)
    return passes


class ObjectRays(NamedTuple):
    """K rays in the key sweep's lidar frame, moved along with an object to the key's time."""

    rows: Int  # (K,) indices of the returns in the cloud
    start: Float  # (K,3) origin of each ray
    to_return: Float  # (K,3) vector from the origin to the return

    def select(self, keep: Bool) -> ObjectRays:
        """Return the rays where ``keep`` (K,) is True."""
        return ObjectRays(self.rows[keep], self.start[keep], self.to_return[keep])


def rays_toward(
    cloud: Cloud, rays: Rays, rows_of: Mapping[int, Int], corners: Mapping[int, Float]
) -> dict[int, ObjectRays]:
    """Return the rays of all sweeps that may meet the hull of each object, by instance number.

    ``rows_of`` are the indices of each object's points in the cloud, ``corners`` (V,3) those of its
    hull at the key's time.
    """
    rays_of: dict[int, list[ObjectRays]] = {k: [] for k in rows_of}
    for frame in rays.stretch.frames if rows_of else ():
        motions = dict[int, Float]()  # of objects from the sweep to the key, key's lidar frame
        for k, rows in rows_of.items():
            seen = rows[cloud.frame[rows] == frame]
            if len(seen):
                motions[k] = poses.fit_rigid(cloud.rigid_points[seen], cloud.points[seen])
        returns = np.flatnonzero(cloud.frame == frame)
        origin = rays.stretch.T_target_source(rays.key, frame)[:3, 3]
        xy = (cloud.rigid_points.take(returns, axis=0) - origin)[:, :2].T.astype(np.float32)
        moved_m, toward = rays.moved_m(frame), dict[int, Int]()
        for k, T_key_sweep in motions.items():
            hull = poses.transform(poses.inverse(T_key_sweep), corners[k]) - origin
            toward[k] = returns[_may_meet(xy, moved_m, hull)]
        starts = rays.starts(cloud.select(np.concatenate([returns[:0], *toward.values()])))
        for k, T_key_sweep in motions.items():
            rows = toward[k]
            start, starts = poses.transform(T_key_sweep, starts[: len(rows)]), starts[len(rows) :]
            end = poses.transform(T_key_sweep, cloud.rigid_points[rows])
            rays_of[k].append(ObjectRays(rows, start, end - start))
    return {
        k: ObjectRays(*(np.concatenate(column) for column in zip(*by_sweep, strict=True)))
        for k, by_sweep in rays_of.items()
    }


def _may_meet(xy: Float32, moved_m: float, corners: Float) -> Bool:
    """Return (N,) True for returns at xy (2,N) whose rays may meet a hull with corners (V,3)."""
    # Metres from the lidar at the sweep's reference time; rays start up to moved_m away from it
    x, y, _ = corners.T
    middle = np.array([x.mean(), y.mean()])
    range_m = np.hypot(*middle)
    radius_m = np.hypot(x - middle[0], y - middle[1]).max() + moved_m
    if range_m <= radius_m:
        return np.ones(xy.shape[1], bool)
    right, ahead = (middle / range_m).astype(np.float32)
    wide = np.float32(radius_m / np.sqrt(range_m**2 - radius_m**2))
    along, aside = right * xy[0] + ahead * xy[1], ahead * xy[0] - right * xy[1]
    meets: Bool = (along > range_m - radius_m) & (abs(aside) <= wide * along)
    return meets


class MovingBody(NamedTuple):
    """The convex hull of a moving object, and the K rays of all sweeps that meet the hull."""

    # (V,3) corners of the hull in metres, key sweep's lidar frame and reference time
    corners: Float
    velocity_m_s: Float32  # (3,) velocity of the object without ego-motion, same frame
    entries: Float  # (K,3) positions where the rays enter the hull, same frame and time
    ends: Bool  # (K,) True if the ray ends on the object, False if it passes through
    frame: NDArray[np.integer]  # (K,) frame number of the ray's sweep


def moving_bodies(
    cloud: Cloud, rays: Rays, exposures: Collection[Exposure]
) -> dict[int, MovingBody]:
    """Return the bodies of moving objects in view of a camera, by instance number.

    Objects whose points span no volume have no body. The ``rays`` measured the ``cloud``.
    """
    moving = np.flatnonzero(cloud.moving & (cloud.instance >= 0))
    instance = cloud.instance[moving]
    rows_of = {k: moving[instance == k] for k in np.unique(instance).tolist()}
    hulls = {k: _corners(cloud.points[rows]) for k, rows in rows_of.items()}
    velocity_m_s = {k: np.median(cloud.velocity_m_s[rows], axis=0) for k, rows in rows_of.items()}

    def is_shown(k: int) -> bool:
        """Return True if a corner of the object's hull is in an image."""
        return any(e.see(hulls[k], velocity_m_s[k]).inside.any() for e in exposures)

    rows_of = {k: rows for k, rows in rows_of.items() if is_shown(k)}
    return {
        k: MovingBody(hulls[k], velocity_m_s[k], *_met(cloud, k, hulls[k], toward))
        for k, toward in rays_toward(cloud, rays, rows_of, hulls).items()
    }


def without_sweep(
    bodies: Mapping[int, MovingBody], cloud: Cloud, frame: int
) -> dict[int, MovingBody]:
    """Return the bodies without sweep ``frame``. cloud: points of all other sweeps."""
    reduced_bodies = {}
    for k, body in bodies.items():
        corners = _corners(cloud.points[cloud.moving & (cloud.instance == k)])
        if len(corners):
            rays = (column[body.frame != frame] for column in (body.entries, body.ends, body.frame))
            reduced_bodies[k] = MovingBody(corners, body.velocity_m_s, *rays)
    return reduced_bodies


def _corners(points: Float) -> Float:
    """Return the (V,3) hull corners of the points (N,3) that have other points around."""
    away_m, _ = KDTree(points).query(points, [_LEAST_AROUND + 1])  # the first is the point
    points = points[np.ravel(away_m) <= _AROUND_M]
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # too few, or flat
        return points[:0]


def _met(
    cloud: Cloud, instance: int, corners: Float, rays: ObjectRays
) -> tuple[Float, Bool, NDArray[np.integer]]:
    """Return entries, ends and frame of the rays that meet a hull (V,3), as in `MovingBody`."""
    rays = rays.select(passes_near(corners, rays.start, rays.to_return))
    enter, leave = crossing(half_spaces(corners), rays.start, rays.to_return)
    meets = (enter > 0) & (enter < np.minimum(leave, 1))
    (rows, start, to_return), enter = rays.select(meets), enter[meets]
    ends = cloud.moving[rows] & (cloud.instance[rows] == instance)
    return start + enter[:, None] * to_return, ends, cloud.frame[rows]


def complete_boxes(
    tracks: Sequence[ObjectTrack], cloud: Cloud, rays: Rays, ground: HeightMap
) -> tuple[ObjectTrack, ...]:
    """Return the tracks with completed boxes, and with the sides that were seen.

    The boxes of ``tracks`` are around the objects' points. The ``rays`` measured the ``cloud``.
    ``ground`` is in the world of their sweeps.
    """
    tracks = [_on_ground(track, rays, ground) for track in tracks]
    reach = {track.instance: _reach(track, rays.key) for track in tracks}
    rows_of = {k: np.flatnonzero(cloud.moving & (cloud.instance == k)) for k in reach}
    toward = rays_toward(cloud, rays, rows_of, reach)
    completed = []
    for track in tracks:
        k = track.instance
        T_object_key = poses.inverse(track.T_key_object[track.frames.index(rays.key)])
        start = poses.transform(T_object_key, toward[k].start)
        to_return = poses.rotate(T_object_key, toward[k].to_return)
        completed.append(_completed(track, start, to_return))
    return tuple(completed)


def _missing_m(size_m: Float) -> Float:
    """Return (3,) metres by which length, width and height are below the usual ones."""
    length_m, width_m, _ = size_m
    missing_m = np.zeros(3)
    if length_m >= _CAR_LONG_M:
        missing_m[1] = max(0.0, min(length_m / _LENGTH_OF_WIDTH, _WIDEST_M) - width_m)
    if width_m >= _CAR_WIDE_M:
        missing_m[0] = max(0.0, _LENGTH_OF_WIDTH * width_m - length_m)
    return missing_m


def _on_ground(track: ObjectTrack, rays: Rays, ground: HeightMap) -> ObjectTrack:
    """Return the track with a box whose bottom is on the ground at the key."""
    T_key_object = track.T_key_object[track.frames.index(rays.key)]
    corners = poses.transform(T_key_object, corners_of(track.size_m))
    T_world_key = rays.stretch[rays.key].T_world_lidar
    above_m = float(np.median(ground.above(poses.transform(T_world_key, corners[::2]))))
    return grown(track, 2, max(above_m, 0.0), 0.0)


def _reach(track: ObjectTrack, key: int) -> Float:
    """Return the (8,3) corners at the key of all space that decides about a track's box."""
    wider_m = 2 * (_missing_m(track.size_m) + _BESIDE_M)
    T_key_object = track.T_key_object[track.frames.index(key)]
    return poses.transform(T_key_object, corners_of(track.size_m + wider_m))


def corners_of(size_m: Float) -> Float:
    """Return the (8,3) corners of a box of (3,) metres around the origin, bottom, top in turn."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1)
    corners: Float = signs.reshape(-1, 3) * size_m / 2
    return corners


def _completed(track: ObjectTrack, start: Float, to_return: Float) -> ObjectTrack:
    """Return a track with its completed box, from rays (K,3) in the object's frame at the key."""
    seen, missing_m = list[str](), _missing_m(track.size_m)
    reach_m = track.size_m / 2 + missing_m + _BESIDE_M
    enter, leave = crossing(_box_spaces(-reach_m, reach_m), start, to_return)
    meets = (enter < leave) & (leave > 0) & (enter < 1)
    start, to_return = start[meets], to_return[meets]
    size_m = track.size_m  # the rays are in the frame of this box
    for axis, names in enumerate(_SIDES):
        free_m = [_free_m(size_m, missing_m, axis, sign, start, to_return) for sign in (-1, 1)]
        seen += [name for name, m in zip(names, free_m, strict=True) if m <= _BESIDE_M]
        room_m = [0.0 if m <= _BESIDE_M else m for m in free_m]
        if missing_m[axis] > 0 and sum(room_m):
            part_m = [min(m, missing_m[axis] / (1 + all(room_m))) for m in room_m]
            left_m = missing_m[axis] - sum(part_m)
            part_m = [min(m, p + left_m) for m, p in zip(room_m, part_m, strict=True)]
            track = grown(track, axis, *part_m)
    return replace(track, sides_seen=tuple(name for name in seen if name != "bottom"))


def _free_m(
    size_m: Float, missing_m: Float, axis: int, sign: int, start: Float, to_return: Float
) -> float:
    """Return the metres from a side of a box to the nearest free space outside; inf for none."""
    half = np.stack([-size_m / 2, size_m / 2])
    low, high = _MIDDLE * half
    if axis < 2:
        low[2], high[2] = half[0, 2] + np.array(_BODY) * size_m[2]
    reach_m = missing_m[axis] + _BESIDE_M
    edge_m = sign * size_m[axis] / 2
    low[axis], high[axis] = sorted([edge_m, edge_m + sign * reach_m])
    enter, leave = crossing(_box_spaces(low, high), start, to_return)
    enter, leave = np.maximum(enter, 0), np.minimum(leave, 1)
    crosses = enter < leave
    along = [start[crosses, axis] + t[crosses] * to_return[crosses, axis] for t in (enter, leave)]
    away_m = np.sort(np.min(sign * np.stack(along), axis=0) - abs(edge_m))
    return float(away_m[_NUM_RAYS - 1]) if len(away_m) >= _NUM_RAYS else np.inf


def _box_spaces(low: Float, high: Float) -> Float:
    """Return the (6,4) sides of a box between two corners (3,), as `hulls.half_spaces`."""
    return np.block([[np.eye(3), -high[:, None]], [-np.eye(3), low[:, None]]])


def grown(track: ObjectTrack, axis: int, before_m: float, after_m: float) -> ObjectTrack:
    """Return the track with a box that is longer along an axis at its lower and its upper end."""
    size_m, T_key_object = track.size_m.copy(), track.T_key_object.copy()
    size_m[axis] += before_m + after_m
    shift_m = (after_m - before_m) / 2
    T_key_object[:, :3, 3] += shift_m * T_key_object[:, :3, axis]
    return replace(track, size_m=size_m, T_key_object=T_key_object)
