# SPDX-License-Identifier: MIT
"""Complete the boxes of moving objects along the sides that no sweep saw.

A side is seen if rays pass or end close beside it. Where no ray was, a box grows to the usual size
of a vehicle of its width or length, but not into space that rays passed through. It stands on the
ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from densify.depth.hulls import crossing
from densify.depth.object_rays import rays_toward
from densify.depth.seen_through import Rays
from densify.free_space.ground import HeightMap
from densify.geometry import poses
from densify.geometry.types import Cloud, Float, ObjectTrack

_SIDES = (("rear", "front"), ("right", "left"), ("bottom", "top"))
_BESIDE_M = 0.4  # of rays to a side that is seen; tolerates errors of motion and registration
_NUM_RAYS = 3  # rays that show free space; single rays may be mixed echoes
_MIDDLE = 0.6  # share of a side, around its middle, that is flat; corners are round
_BODY = (0.2, 0.5)  # share of the height: above the road, below the panes
_CAR_WIDE_M = 1.4  # the narrowest cars are wider, other road users narrower
_CAR_LONG_M = 3.0  # shorter objects may be people and bicycles
_LENGTH_OF_WIDTH = 2.4  # of cars: 1.65 by 4.0 m, 1.85 by 4.4 m
_WIDEST_M = 2.55  # by law


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
