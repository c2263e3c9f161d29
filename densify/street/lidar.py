# SPDX-License-Identifier: MIT
"""One sweep of a sensor through the world: what comes back, where and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from densify.geometry.poses import rotate, transform
from densify.geometry.types import Bool, Float, Float32, Int
from densify.street.materials import LASER_PASSES, REFLECTIVITY
from densify.street.mesh import across, lengths
from densify.street.motion import Driving, poses_at
from densify.street.sensors import Sensor, firings
from densify.street.world import Hits, Rays, World

LIDAR_HEIGHT_M = 1.73
_MIN_RANGE_M = 1.0
_SPOT_RAD = 1.05e-3  # of a beam's spot, along each axis from its centre to the outer rays
_FLAT_M = 0.10  # off the plane through the centre's echo: an edge
_MERGE_M = 2.0  # echoes closer than this can melt into one
_MELT_PROBABILITY = 0.2
_STEP_S = 1e-3  # of velocities


@dataclass(frozen=True)
class Returns:
    """The N returns of a sweep in the order of time.

    points: (N,3) float32, lidar axes, each at its own firing time. intensity: (N,) 0 to 1.
    offset_ns: (N,) int64 from the reference time. lidar: (N,) scanner. body: (N,) index of the
    body met. instance: (N,) object met, -1 none. radial_velocity_m_s: (N,) relative to the scanner,
    away from it; None for sensors that do not measure it.
    """

    points: Float32
    intensity: Float32
    offset_ns: NDArray[np.int64]
    lidar: NDArray[np.uint8]
    body: NDArray[np.int32]
    instance: NDArray[np.int32]
    radial_velocity_m_s: Float32 | None = None


@dataclass(frozen=True)
class Mounted:
    """A sensor on the vehicle; tilt_deg: as in `T_ego_lidar`. period_ns: from sweep to sweep."""

    sensor: Sensor
    period_ns: int
    tilt_deg: float = 0.0


def T_ego_lidar(tilt_deg: float = 0.0) -> Float:
    """(4,4) the lidar frame, which is the mount's.

    tilt_deg: by how much the mount is pitched about the frame's origin, nose down.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()
    T[2, 3] = LIDAR_HEIGHT_M
    return T


def scan(
    world: World, ego: Driving, mounted: Mounted, time_s: float, rng: np.random.Generator
) -> Returns:
    """The sweep whose reference time is ``time_s``, seconds from frame 0."""
    sensor, T = mounted.sensor, T_ego_lidar(mounted.tilt_deg)
    fired = firings(sensor, time_s, mounted.period_ns)
    n = len(fired.offset_ns)
    times = at_offsets(time_s, fired.offset_ns)
    ego_poses = poses_at(ego, times)
    origin = ego_poses.apply(transform(T, sensor.origins_m)[fired.lidar])
    spot = [ego_poses.turn(rotate(T, ray)) for ray in _spot(fired.direction)]
    lucks = [rng.random(n) for _ in spot]
    beams = Rays(origin, spot[0], times)
    echoes = world.cast_bundle(beams, spot, LASER_PASSES, lucks, spread=2 * _SPOT_RAD)
    range_m, hit, edge = _echo(echoes, spot, rng)
    surface = world.triangles.material[hit.triangle]
    reflectivity = REFLECTIVITY[surface] * (
        0.6 + 0.4 * world.triangles.tint[hit.triangle].mean(axis=1)
    )
    grazing = np.abs(np.einsum("ni,ni->n", hit.normal, spot[0]))
    signal = reflectivity * np.sqrt(grazing) * (60.0 / np.maximum(range_m, 5.0)) ** 2
    heard = 0.995 * (1 - np.exp(-8.0 * signal)) * np.where(edge, 0.85, 1.0)
    keep = np.isfinite(range_m) & (rng.random(n) < heard)
    sigma_m = np.array([scanner.range_sigma_m for scanner in sensor.scanners])[fired.lidar]
    reach_m = np.array([scanner.max_range_m for scanner in sensor.scanners])[fired.lidar]
    range_m = np.where(keep, range_m, 0.0) + sigma_m * rng.normal(size=n)
    keep &= (range_m > _MIN_RANGE_M) & (range_m < reach_m)
    points = fired.direction * range_m[:, None]
    origin_m = sensor.origins_m[fired.lidar]
    np.add(points, origin_m, out=points, where=origin_m != 0)  # a coordinate of -0.0 stays one
    brightness = reflectivity * (0.35 + 0.65 * grazing) * (1 + 0.05 * rng.normal(size=n))
    body = world.triangles.body[hit.triangle[keep]]
    radial_m_s = None
    if sensor.measures_velocity:
        sigmas_m_s = [scanner.velocity_sigma_m_s for scanner in sensor.scanners]
        places = origin[keep] + spot[0][keep] * range_m[keep, None]
        v_m_s = velocities_m_s(world, body, places, times[keep])
        v_m_s -= _at_rest_on(ego, T, sensor.origins_m[fired.lidar[keep]], times[keep])
        radial_m_s = np.einsum("ni,ni->n", v_m_s, spot[0][keep])
        noise = np.array(sigmas_m_s, np.float64)[fired.lidar[keep]] * rng.normal(size=len(v_m_s))
        radial_m_s = (radial_m_s + noise).astype(np.float32)
    return Returns(
        points[keep].astype(np.float32),
        np.clip(np.round(brightness[keep], 2), 0, 1).astype(np.float32),
        fired.offset_ns[keep],
        fired.lidar[keep],
        body,
        world.triangles.instance[hit.triangle[keep]],
        radial_m_s,
    )


def velocities_m_s(world: World, body: NDArray[np.int32], places: Float, times: Float) -> Float:
    """(N,3) world axes: of the points of bodies that are at these places (N,3) at these times."""
    found = np.zeros_like(places)
    for index in np.unique(body[body > 0]):
        rows = np.flatnonzero(body == index)
        in_body = world.poses(int(index), times[rows]).undo(places[rows])
        ends = [
            world.poses(int(index), times[rows] + h).apply(in_body) for h in (-_STEP_S, _STEP_S)
        ]
        found[rows] = (ends[1] - ends[0]) / (2 * _STEP_S)
    return found


def _at_rest_on(ego: Driving, T_ego: Float, origins: Float, times: Float) -> Float:
    """(N,3) m/s, world axes: of scanners at these places (N,3) of the lidar frame."""
    mounts = transform(T_ego, origins)
    ends = [ego.poses(times + h).apply(mounts) for h in (-_STEP_S, _STEP_S)]
    moved: Float = ends[1] - ends[0]
    return moved / (2 * _STEP_S)


def at_offsets(time_s: float, offset_ns: Int) -> Float:
    """(N,) seconds at so many nanoseconds from a reference time."""
    times: Float = np.asarray(time_s + offset_ns * 1e-9, dtype=np.float64)
    return times


def _spot(direction: Float) -> list[Float]:
    """(N,3) beams -> the rays of each beam's spot: its centre, then four around it."""
    level = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))], axis=1)
    level /= lengths(level)
    upward = across(direction, level)
    rays = [direction]
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        ray = direction + _SPOT_RAD * (a * level + b * upward)
        rays.append(ray / lengths(ray))
    return rays


def _echo(
    echoes: list[Hits], spot: list[Float], rng: np.random.Generator
) -> tuple[Float, Hits, Bool]:
    """Return the echo of a spot: range (N,), the surface it is from, and edges (N,).

    On one plane the centre counts. At an edge each part of the spot is as likely to be the
    strongest echo, and now and then two that lie close together melt into one between them.
    """
    centre = echoes[0]
    n = len(centre.range_m)
    rows = np.arange(n)
    range_m = np.stack([e.range_m for e in echoes])
    slant = [np.einsum("ni,ni->n", centre.normal, ray) for ray in spot]
    with np.errstate(divide="ignore", invalid="ignore"):  # nothing met is infinitely far
        off_plane = [
            np.abs(r - centre.range_m * slant[0] / s) for r, s in zip(range_m, slant, strict=True)
        ]
    some = np.isfinite(range_m)
    flat = (np.stack(off_plane) < _FLAT_M).all(axis=0)
    edge = np.logical_and(some.any(axis=0), np.logical_not(flat))
    # one of the rays that met something, each as likely
    pick = np.argmax(rng.random(range_m.shape) * some, axis=0)
    pick = np.where(edge, pick, 0)
    chosen = range_m[pick, rows]
    other = range_m[rng.integers(len(spot), size=n), rows]
    melts = edge & np.isfinite(other) & (rng.random(n) < _MELT_PROBABILITY)
    melts[melts] = np.abs(other[melts] - chosen[melts]) < _MERGE_M
    chosen = np.where(melts, (chosen + np.where(melts, other, 0.0)) / 2, chosen)
    columns = (np.stack(column)[pick, rows] for column in zip(*echoes, strict=True))
    return chosen, Hits(*columns), edge
