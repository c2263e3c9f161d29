# SPDX-License-Identifier: MIT
"""Simulate one sweep: the returns of each ray, and the rays that pass surfaces or are lost."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, Float32, Int
from densify.street.lidar import Sensor, firings
from densify.street.materials import REFLECTIVITY, Material, noise
from densify.street.mesh import across, lengths
from densify.street.motion import Driving, poses_at
from densify.street.world import ABSORBED, PASSES, STOPS, Hits, Meeting, Optics, Rays, World

_PARTS = (Material.BODYWORK, Material.FRAME, Material.GLASS)
_IS_LEAKY = np.isin(np.arange(len(Material)), (*_PARTS, Material.LEAF))
_BRIGHTNESS = (0.2, 0.55)  # between dark, middle and bright paint
_INCIDENCE_DEG = (10.0, 30.0, 50.0, 67.5, 82.5)
# Percent of rays that are lost, and that pass: for each part, five incidences of dark, middle and
# bright cars. From 207 moving cars of KITTI's stereo benchmark (Menze and Geiger, "Object Scene
# Flow for Autonomous Vehicles", CVPR 2015) in sweeps of an HDL-64E, fitted to give simulated cars
# the same shares (tests/test_street_returns.py): the upper part there is the window band with
# pillars and roof, here glass alone. Fewer rays pass doors here: there, errors of calibration do.
_LOST = 0.01 * np.array(
    [
        [(8, 18, 22, 35, 35), (5, 6, 13, 18, 8), (2, 8, 10, 0, 0)],
        [(11, 18, 22, 35, 41), (10, 6, 13, 18, 23), (14, 8, 10, 0, 34)],
        [(65, 61, 54, 91, 44), (50, 13, 42, 64, 38), (62, 5, 47, 49, 49)],
    ]
)
_PASSES = 0.01 * np.array(
    [
        [(1, 1, 4, 4, 4), (1, 1, 4, 4, 4), (1, 1, 4, 4, 4)],
        [(1, 1, 4, 4, 57), (2, 1, 4, 4, 22), (5, 1, 4, 4, 17)],
        [(8, 22, 29, 7, 54), (40, 20, 20, 16, 30), (34, 37, 32, 24, 25)],
    ]
)
_PATCH_M = 0.7  # size of a patch that loses its rays together: a car window, half a door
# Share of pulses that are lost elsewhere, by range: gaps in the rings of KITTI's drives 0013 and
# 0002 (HDL-64E) between returns of one surface. Beyond 35 m the ground loses more than measured.
_RANGE_M = (5.0, 14.0, 27.0, 45.0, 75.0, 110.0)
_GROUND_LOST = (0.003, 0.004, 0.009, 0.4, 0.7, 0.9)
_DARK_LOST = (0.03, 0.10, 0.12, 0.10, 0.13, 0.20)  # reflectance below 0.1, upright
_OTHER_LOST = (0.001, 0.003, 0.007, 0.012, 0.06, 0.15)
_DARK = 0.1
_LEAF_PASSES = 0.45
_GOLDEN = 0.6180339887498949


def laser(world: World, luck: Float) -> Optics:
    """Return the optics of lidar, by a random number of each ray in [0, 1)."""
    surfaces = world.triangles

    def optics(met: Meeting) -> Int:
        outcome = np.full(len(met.ray), STOPS)
        rows = np.flatnonzero(_IS_LEAKY[surfaces.material[met.triangle]])
        material, instance = (c[met.triangle[rows]] for c in (surfaces.material, surfaces.instance))
        inside = (instance >= 0) & (instance == met.passed[rows])
        again = (luck[met.ray[rows]] + met.layer * _GOLDEN) % 1.0
        outcome[rows[(material == Material.LEAF) & (again < _LEAF_PASSES)]] = PASSES
        outcome[rows[(material == Material.GLASS) & inside]] = PASSES
        outside = (material != Material.LEAF) & ~inside
        rows, material, instance = rows[outside], material[outside], instance[outside]
        part = np.argmax(material[:, None] == np.array(_PARTS), axis=1)
        brightness = np.digitize(surfaces.mean_tint[met.triangle[rows]], _BRIGHTNESS)
        cosine = np.abs(met.facing[rows])
        incidence_deg = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        lost, passes = (
            _between(table[part, brightness], incidence_deg) for table in (_LOST, _PASSES)
        )
        level = patches(met.place(rows), world.seed + 3 * instance.astype(np.int64) + part)
        outcome[rows[level > 1 - passes]] = PASSES
        outcome[rows[level < lost]] = ABSORBED
        return outcome

    return optics


def share_lost(material: Int, tint: Float, range_m: Float) -> Float:
    """Return the (N,) share of pulses without a return, besides pulses that vehicles absorb."""
    ground, dark, other = (
        np.interp(range_m, _RANGE_M, lost) for lost in (_GROUND_LOST, _DARK_LOST, _OTHER_LOST)
    )
    is_dark = (REFLECTIVITY[material] * tint < _DARK) & ~_of_vehicle(material)
    return np.where(material <= Material.PAINT, ground, np.where(is_dark, dark, other))


def _of_vehicle(material: Int) -> Bool:
    return np.isin(material, _PARTS)


def patches(place: Float, owner: Int) -> Float:
    """Return (N,) uniform numbers, 0 to 1, smooth over the surface of each ``owner`` (object)."""
    cell = np.floor(place / _PATCH_M)
    share = place / _PATCH_M - cell
    share = share * share * (3 - 2 * share)
    i, j, k = cell.astype(np.int64).T
    one, other = i + 1_000_003 * owner, j + 1_000_003 * k
    _, first, which = np.unique(noise(one, other), return_index=True, return_inverse=True)
    corners = [
        noise(one[first] + x, other[first] + y + 1_000_003 * z)
        for x, y, z in product((0, 1), repeat=3)
    ]
    level = ndtri(np.clip(corners, 1e-9, 1 - 1e-9)).T.take(which, axis=0).T
    for part in share.T:  # halves the corners, axis by axis
        near, far = np.split(level, 2)
        level = near + part * (far - near)
    spread = np.prod(share**2 + (1 - share) ** 2, axis=1)
    smooth: Float = ndtr(level[0] / np.sqrt(spread))
    return smooth


def _between(rows: Float, incidence_deg: Float) -> Float:
    """Return (N,) values of (N,5) table rows at (N,) degrees, interpolated."""
    at = np.interp(incidence_deg, _INCIDENCE_DEG, np.arange(len(_INCIDENCE_DEG)))
    low, n = np.minimum(at.astype(int), len(_INCIDENCE_DEG) - 2), np.arange(len(at))
    return rows[n, low] + (at - low) * (rows[n, low + 1] - rows[n, low])


LIDAR_HEIGHT_M = 1.73
_MIN_RANGE_M = 1.0
_SPOT_RAD = 1.05e-3  # half the spot of a beam, along each axis
_SPOT = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # its rays, left and up
_FLAT_M = 0.10  # distance to the plane of the central echo from which a spot is at an edge
_MERGE_M = 2.0  # echoes closer than this can melt into one
_MELT_PROBABILITY = 0.2


@dataclass(frozen=True)
class Returns:
    """The N returns of a sweep in the order of time."""

    points: Float32  # (N,3) metres, in the lidar frame at each point's own firing time
    intensity: Float32  # (N,) 0 to 1
    offset_ns: NDArray[np.int64]  # (N,) firing time minus the reference time
    lidar: NDArray[np.uint8]  # (N,) index of the scanner
    body: NDArray[np.int32]  # (N,) index of the body hit
    instance: NDArray[np.int32]  # (N,) number of the object hit, -1 for none


def T_ego_lidar(tilt_deg: float = 0.0) -> Float:
    """Return the (4,4) pose of the lidar frame on the vehicle, tilted nose down."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()
    T[2, 3] = LIDAR_HEIGHT_M
    return T


def scan(
    world: World, ego: Driving, sensor: Sensor, time_s: float, rng: np.random.Generator,
    period_ns: int = 100_000_000, tilt_deg: float = 0.0,
) -> Returns:  # fmt: skip
    """Simulate one sweep around ``time_s``, seconds since frame 0, as long as ``period_ns``."""
    T = T_ego_lidar(tilt_deg)
    fired = firings(sensor, time_s, period_ns)
    n = len(fired.offset_ns)
    times = at_offsets(time_s, fired.offset_ns)
    ego_poses = poses_at(ego, times)
    origin_m = sensor.origins_m[fired.lidar]
    origin = ego_poses.apply(transform(T, sensor.origins_m)[fired.lidar])
    spot = _spot(fired.direction) @ (ego_poses.rotation @ T[:3, :3]).transpose(0, 2, 1)
    luck = rng.random((len(_SPOT), n)).T
    beams = (np.repeat(column, len(_SPOT), axis=0) for column in (origin, times))
    echoes = world.cast(
        Rays(next(beams), spot.reshape(-1, 3), next(beams)),
        laser(world, luck.ravel()), len(_SPOT), 2 * _SPOT_RAD,
    )  # fmt: skip
    range_m, ray, edge = _echo(echoes, spot, rng)
    triangle, normal = echoes.triangle[ray], echoes.normal.take(ray, axis=0)
    material, tint = world.triangles.material[triangle], world.triangles.mean_tint[triangle]
    reflectivity = REFLECTIVITY[material] * (0.6 + 0.4 * tint)
    grazing = np.abs(np.einsum("ni,ni->n", normal, spot[:, 0]))
    heard = (1 - share_lost(material, tint, range_m)) * np.where(edge, 0.85, 1.0)
    keep = np.isfinite(range_m) & (rng.random(n) < heard)
    range_m = np.where(keep, range_m, 0.0)
    range_m += sensor.each("range_sigma_m")[fired.lidar] * rng.normal(size=n)
    keep &= (range_m > _MIN_RANGE_M) & (range_m < sensor.each("max_range_m")[fired.lidar])
    points = fired.direction * range_m[:, None]
    np.add(points, origin_m, out=points, where=origin_m != 0)  # a coordinate of -0.0 stays one
    brightness = reflectivity * (0.35 + 0.65 * grazing) * (1 + 0.05 * rng.normal(size=n))
    body = world.triangles.body[triangle[keep]]
    return Returns(
        points[keep].astype(np.float32),
        np.clip(np.round(brightness[keep], 2), 0, 1).astype(np.float32),
        fired.offset_ns[keep],
        fired.lidar[keep],
        body,
        world.triangles.instance[triangle[keep]],
    )


def at_offsets(time_s: float, offset_ns: Int) -> Float:
    """Return (N,) times in seconds from (N,) offsets in ns and a reference time in seconds."""
    times: Float = np.asarray(time_s + offset_ns * 1e-9, dtype=np.float64)
    return times


def _spot(direction: Float) -> Float:
    """Return (N,5,3) ray directions of N beams: spot centre, then four around it."""
    level = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))], axis=1)
    level /= lengths(level)
    upward = across(direction, level)
    rays = [direction + _SPOT_RAD * (a * level + b * upward) for a, b in _SPOT[1:]]
    return np.stack([direction, *(ray / lengths(ray) for ray in rays)], axis=1)


def _echo(echoes: Hits, spot: Float, rng: np.random.Generator) -> tuple[Float, Int, Bool]:
    """Return (N,) ranges (m) of laser spots, rays that count, and True for spots at an edge."""
    # On one plane the centre ray counts. At an edge each ray is equally likely to be the strongest
    # echo. Two echoes close together sometimes merge into one at a range in between.
    n, num = spot.shape[:2]
    range_m = echoes.range_m.reshape(n, num)
    slant = np.einsum("ni,nsi->ns", echoes.normal[::num], spot)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray without a hit has infinite range
        off_plane = np.abs(range_m - (range_m * slant)[:, :1] / slant)
    some = np.isfinite(range_m)
    flat = off_plane < _FLAT_M
    edge = np.logical_or.reduce([*some.T]) & ~np.logical_and.reduce([*flat.T])
    # any of the rays with a hit, all equally likely
    at = np.flatnonzero(edge)
    pick = np.argmax(rng.random((num, n))[:, at] * some[at].T, axis=0)
    chosen, other = range_m[at, pick], range_m[at, rng.integers(num, size=(n,))[at]]
    merged = np.isfinite(other) & (rng.random((n,))[at] < _MELT_PROBABILITY)
    merged[merged] = np.abs(other[merged] - chosen[merged]) < _MERGE_M
    chosen[merged] = (chosen[merged] + other[merged]) / 2
    range_m, ray = range_m[:, 0].copy(), np.arange(0, n * num, num)
    range_m[at], ray[at] = chosen, at * num + pick
    return range_m, ray, edge
