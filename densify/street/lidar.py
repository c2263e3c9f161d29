# SPDX-License-Identifier: MIT
"""Simulate sweeps of the lidars in lidars.yaml: every pulse, and what comes back from it.

A scan pattern has the methods ``num_pulses`` and ``directions`` of `Spinning`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from densify.geometry.poses import transform
from densify.geometry.types import Bool, Float, Float32, Int
from densify.street import read_table
from densify.street.mesh import REFLECTIVITY, Material, lengths, noise
from densify.street.motion import Driving, poses_at
from densify.street.world import ABSORBED, PASSES, STOPS, Hits, Meeting, Optics, Rays, World

_TABLES = read_table("lidars")
_ROUNDING = 1e-6  # added to a number of pulses before it is cut to an integer
_WIDENING = 1.5  # exponent of the growing steps between elevations
_S_PER_NS = 1e-9

# Scan patterns


@dataclass(frozen=True)
class Spinning:
    """A pattern that spins once a sweep, clockwise from above, forward at the reference time."""

    # Elevations of the beams, which fire one after another: every pulse has its own azimuth.
    elevation_deg: tuple[float, ...]
    columns_per_s: int  # firings per second of each beam, at any rate of revolutions
    phase: float = 0.0  # lead in turns over a scanner that faces forward at the reference time

    def num_pulses(self, period_s: float) -> int:
        """Return the number of pulses in a sweep that takes ``period_s`` seconds."""
        return int(self.columns_per_s * period_s + _ROUNDING) * len(self.elevation_deg)

    def directions(self, number: Int, share: Float, time_s: Float) -> Float:
        """Return the (N,3) unit vectors of pulses in the scanner's axes: x forward, y left, z up.

        Args:
            number: (N,) index of each pulse in its sweep.
            share: (N,) firing time since the reference time, in periods, from -0.5 to 0.5.
            time_s: (N,) firing time in seconds since frame 0.
        """
        azimuth = -2 * np.pi * (share + self.phase)
        beam = number % len(self.elevation_deg)
        return _pointing(azimuth, np.radians(self.elevation_deg)[beam])


@dataclass(frozen=True)
class _Steady:
    """A pattern of ``pulses_per_s`` pulses evenly spaced in time."""

    pulses_per_s: int

    def num_pulses(self, period_s: float) -> int:
        """Return the number of pulses in a sweep."""
        return int(self.pulses_per_s * period_s + _ROUNDING)


@dataclass(frozen=True)
class Raster(_Steady):
    """A scan pattern that covers a rectangle, line by line, by a fast and a slow mirror."""

    width_deg: float  # width of the field of view, with its centre straight ahead
    height_deg: float  # height of the field of view
    lines_per_s: int  # swings of the fast mirror per second, counting each direction

    def directions(self, number: Int, share: Float, time_s: Float) -> Float:
        """Return the unit vectors (N,3), x forward, at (N,) indices and times in periods and s."""
        line = number * (self.lines_per_s / self.pulses_per_s)
        swing = 1 - np.abs(line % 2 - 1)  # from 0 to 1 in one line, back to 0 in the next
        azimuth = np.radians(self.width_deg) * (0.5 - swing)
        return _pointing(azimuth, np.radians(self.height_deg) * -share)


@dataclass(frozen=True)
class Rosette(_Steady):
    """A scan pattern of two equal prisms: a rose that never repeats, as in Livox's scanners."""

    width_deg: float  # diameter of the round field of view
    # Rates of the two prisms. Petals are drawn at their difference and turn at their sum.
    turns_per_s: tuple[float, float]

    def directions(self, number: Int, share: Float, time_s: Float) -> Float:
        """Return the unit vectors (N,3), x forward, at (N,) indices and times in periods and s."""
        # Each prism bends the ray towards its own angle. Two equal bends add up to one of the mean
        # direction, whose size varies with the difference of the angles.
        half_angle_1, half_angle_2 = (np.pi * rate * time_s for rate in self.turns_per_s)
        axis_angle = np.radians(self.width_deg / 2) * np.cos(half_angle_1 - half_angle_2)
        roll, sine = half_angle_1 + half_angle_2, np.sin(axis_angle)
        return np.stack([np.cos(axis_angle), sine * np.cos(roll), sine * np.sin(roll)], axis=1)


def _pointing(azimuth: Float, elevation: Float) -> Float:
    """Return (N,3) unit vectors from (N,) azimuths and (N,) elevations in rad."""
    cosine = np.cos(elevation)
    return np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)], axis=1)


_PATTERNS: dict[str, Any] = {"spinning": Spinning, "raster": Raster, "rosette": Rosette}

# Sensors


@dataclass(frozen=True)
class Scanner:
    """One scanner of a sensor."""

    pattern: Spinning | Raster | Rosette
    max_range_m: float  # greatest range
    range_sigma_m: float  # standard deviation of the range noise
    origin_m: Sequence[float] = (0.0, 0.0, 0.0)  # position of the scanner, lidar frame


@dataclass(frozen=True)
class Sensor:
    """One or several scanners whose returns form one sweep."""

    name: str  # key of `SENSORS`
    scanners: tuple[Scanner, ...]  # a return's scanner is an index into these

    def each(self, field: str) -> Float:
        """Return the values of a field of all S scanners, as an array (S,) or (S,3)."""
        return np.array([getattr(scanner, field) for scanner in self.scanners], np.float64)

    @property
    def origins_m(self) -> Float:
        """(S,3) positions of the scanners, lidar frame."""
        return self.each("origin_m")

    @property
    def azimuth_tells_time(self) -> bool:
        """True if azimuth determines firing time: one scanner that spins about the origin."""
        scanner = self.scanners[0]
        spins = isinstance(scanner.pattern, Spinning)
        return len(self.scanners) == 1 and spins and not any(scanner.origin_m)


def _elevations_deg(row: Any) -> Float:
    """Return the elevations (degrees) that a row of ``elevation_deg`` in lidars.yaml describes."""
    if hasattr(row, "values"):
        return np.array(row.values)
    steps = np.arange(1, row.num + 1)
    if hasattr(row, "between"):
        highest, lowest = row.between
        degrees = np.linspace(highest, lowest, row.num)
    elif hasattr(row, "beyond"):
        degrees = row.beyond + row.step * steps
    else:
        start, end = row.widening
        degrees = start + (end - start) * (steps / row.num) ** _WIDENING
    return degrees[::-1] if hasattr(row, "backwards") else degrees


def _scanner(row: Any) -> Scanner:
    """Return the scanner that a row of ``sensors`` in lidars.yaml describes."""
    columns = vars(row).copy()
    make, name = next((make, name) for name, make in _PATTERNS.items() if name in columns)
    pattern = vars(columns.pop(name)).copy()
    if make is Spinning:
        beams = getattr(_TABLES.elevation_deg, pattern.pop("elevation"))
        pattern["elevation_deg"] = tuple(np.concatenate([*map(_elevations_deg, beams)]).tolist())
    return Scanner(make(**pattern), **columns)


SENSORS: dict[str, Sensor] = {
    name: Sensor(name, tuple(_scanner(row) for row in rows))
    for name, rows in vars(_TABLES.sensors).items()
}


@dataclass(frozen=True)
class Firings:
    """The N pulses of a sweep in the order of time."""

    direction: Float  # (N,3) unit vectors, lidar axes
    offset_ns: Int  # (N,) int64 firing time minus the reference time
    lidar: NDArray[np.uint8]  # (N,) uint8 index of the scanner


def firings(sensor: Sensor, time_s: float, period_ns: int) -> Firings:
    """Return a sweep's pulses, evenly spaced about its middle, ``time_s`` seconds after frame 0."""
    pulses = []
    for index, scanner in enumerate(sensor.scanners):
        num_pulses = scanner.pattern.num_pulses(period_ns * _S_PER_NS)
        number = np.arange(num_pulses, dtype=np.int64)
        offset_ns = -period_ns // 2 + number * period_ns // num_pulses
        share: Float = offset_ns / period_ns
        fired_s = time_s + share * period_ns * _S_PER_NS
        direction = scanner.pattern.directions(number, share, fired_s)
        pulses.append((direction, offset_ns, np.full(num_pulses, index, np.uint8)))
    direction, offset_ns, lidar = (np.concatenate(column) for column in zip(*pulses, strict=True))
    order = np.argsort(offset_ns, kind="stable")
    return Firings(direction[order], offset_ns[order], lidar[order])


# Rays that pass a surface or are absorbed

# Vehicle part by material, -1 for materials of other things
_VEHICLE_PART = np.full(len(Material), -1)
for _part, _name in enumerate(vars(_TABLES.vehicles.lost_percent)):
    _VEHICLE_PART[Material[_name]] = _part
# Shares of rays without a return and of passing rays, by vehicle part, brightness and incidence
_LOST, _PASSES = (
    0.01 * np.array([[*vars(paints).values()] for paints in vars(percent).values()])
    for percent in (_TABLES.vehicles.lost_percent, _TABLES.vehicles.passes_percent)
)
_PATCH_M = 0.7  # size of a patch that loses its rays together: a car window, half a door
_DARK = 0.1  # reflectance below which a surface counts as dark
_LEAF_PASSES = 0.45  # share of the rays that pass a leaf
_GOLDEN = 0.6180339887498949  # its multiples are spread evenly modulo 1
_LARGE_PRIME = 1_000_003  # keeps hashed cells apart
_RARE = 1e-9  # least probability that is converted to a normal quantile


def laser(world: World, luck: Float) -> Optics:
    """Return the optics of lidar. ``luck`` (N,) has a random number from 0 to 1 for each ray."""
    surfaces = world.triangles

    def optics(met: Meeting) -> Int:
        material, instance = surfaces.material[met.triangle], surfaces.instance[met.triangle]
        # A ray that passed a surface of the same object before is inside it.
        is_inside = (instance >= 0) & (instance == met.passed)
        # Each layer draws anew: multiples of the golden ratio are spread evenly.
        draw = (luck[met.ray] + met.layer * _GOLDEN) % 1.0
        is_open = (material == Material.LEAF) & (draw < _LEAF_PASSES)
        is_open |= (material == Material.GLASS) & is_inside
        outcome = np.where(is_open, PASSES, STOPS)

        # The outside of vehicles
        rows = np.flatnonzero((_VEHICLE_PART[material] >= 0) & ~is_inside)
        part = _VEHICLE_PART[material[rows]]
        tint = surfaces.mean_tint[met.triangle[rows]]
        brightness = np.digitize(tint, _TABLES.vehicles.brightness)
        cosine = np.clip(np.abs(met.facing[rows]), 0.0, 1.0)
        incidence_deg = np.degrees(np.arccos(cosine))
        absorbed_share, passing_share = (
            _between(table[part, brightness], incidence_deg) for table in (_LOST, _PASSES)
        )
        # Whole patches of a surface pass or absorb rays. Each part of an object has its own.
        owner = world.seed + 3 * instance[rows].astype(np.int64) + part
        patch_draw = patches(met.position[rows], owner)
        outcome[rows[patch_draw > 1 - passing_share]] = PASSES
        outcome[rows[patch_draw < absorbed_share]] = ABSORBED
        return outcome

    return optics


def share_lost(material: Int, tint: Float, range_m: Float) -> Float:
    """Return the (N,) shares of pulses without a return, by material, tint factor and range (m)."""
    table = _TABLES.lost_elsewhere
    ground, dark, bright = (
        np.interp(range_m, table.range_m, shares)
        for shares in (table.ground, table.dark, table.bright)
    )
    is_dark = (REFLECTIVITY[material] * tint < _DARK) & (_VEHICLE_PART[material] < 0)
    return np.where(material <= Material.PAINT, ground, np.where(is_dark, dark, bright))


def patches(position: Float, owner: Int) -> Float:
    """Return (N,) random numbers from 0 to 1 that vary smoothly over the surface of an object.

    ``position`` (N,3) are points in metres, ``owner`` (N,) the numbers of their objects.
    """
    # Normal random numbers at the corners of a grid of cells are interpolated.
    cell = np.floor(position / _PATCH_M)
    share = position / _PATCH_M - cell
    share = share * share * (3 - 2 * share)  # smoothstep: slope 0 at the sides of a cell
    i, j, k = cell.astype(np.int64).T
    xo_key, yz_key = i + _LARGE_PRIME * owner, j + _LARGE_PRIME * k
    corners = [
        noise(xo_key + x, yz_key + y + _LARGE_PRIME * z) for x, y, z in product((0, 1), repeat=3)
    ]
    normal = ndtri(np.clip(corners, _RARE, 1 - _RARE))
    for axis_share in share.T:  # each axis halves the number of corners
        low, high = np.split(normal, 2)
        normal = low + axis_share * (high - low)
    # Interpolation with weights w lowers the variance to the sum of w², which the division undoes.
    variance = np.prod(share**2 + (1 - share) ** 2, axis=1)
    smooth: Float = ndtr(normal[0] / np.sqrt(variance))
    return smooth


def _between(rows: Float, incidence_deg: Float) -> Float:
    """Return the (N,) values of (N,5) table rows, interpolated at (N,) degrees of incidence."""
    columns_deg = _TABLES.vehicles.incidence_deg
    column = np.interp(incidence_deg, columns_deg, np.arange(len(columns_deg)))
    low = np.minimum(column.astype(int), len(columns_deg) - 2)  # there is a column after it
    row = np.arange(len(column))
    return rows[row, low] + (column - low) * (rows[row, low + 1] - rows[row, low])


# Echoes

LIDAR_HEIGHT_M = 1.73
_MIN_RANGE_M = 1.0
_SPOT_RAD = 1.05e-3  # half the spot of a beam, along each axis
_SPOT = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # rays of the spot, left and up
_FLAT_M = 0.10  # distance to the plane of the central echo from which a spot is at an edge
_EDGE_HEARD = 0.85  # share of the echoes at edges that the receiver detects
_MERGE_M = 2.0  # echoes closer than this can merge into one
_MELT_PROBABILITY = 0.2
# Brightness of an echo: least share by tint, least share at grazing incidence, relative noise
_UNTINTED, _GRAZING, _NOISE = 0.6, 0.35, 0.05


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
    """Return the (4,4) pose of the lidar frame on the vehicle, tilted nose down by ``tilt_deg``."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix()
    T[2, 3] = LIDAR_HEIGHT_M
    return T


class Mount(NamedTuple):
    """A sensor on the ego vehicle, with the duration of its sweeps."""

    ego: Driving  # motion of the vehicle
    sensor: Sensor
    period_ns: int = 100_000_000  # duration of a sweep
    tilt_deg: float = 0.0  # pitch of the sensor, nose down


def scan(world: World, mount: Mount, time_s: float, rng: np.random.Generator) -> Returns:
    """Return the simulated returns of a mounted sensor's sweep.

    The middle of the sweep is ``time_s`` seconds after frame 0. ``rng`` draws noise and losses.
    """
    sensor = mount.sensor
    T = T_ego_lidar(mount.tilt_deg)
    fired = firings(sensor, time_s, mount.period_ns)
    num_pulses = len(fired.offset_ns)

    # Five rays for each pulse, in the world frame
    times = at_offsets(time_s, fired.offset_ns)
    ego_poses = poses_at(mount.ego, times)
    origin_m = sensor.origins_m[fired.lidar]
    origin = ego_poses.apply(transform(T, sensor.origins_m)[fired.lidar])
    spot = _spot(fired.direction) @ (ego_poses.rotation @ T[:3, :3]).transpose(0, 2, 1)
    luck = rng.random((len(_SPOT), num_pulses)).T
    rays = Rays(origin.repeat(len(_SPOT), axis=0), spot.reshape(-1, 3), times.repeat(len(_SPOT)))
    hits = world.cast(rays, laser(world, luck.ravel()), len(_SPOT), 2 * _SPOT_RAD)

    # One echo for each pulse, and whether the receiver detects the echo
    range_m, ray, is_edge = _strongest_echoes(hits, spot, rng)
    triangle = hits.triangle[ray]
    material, tint = world.triangles.material[triangle], world.triangles.mean_tint[triangle]
    probability = 1 - share_lost(material, tint, range_m)
    probability = probability * np.where(is_edge, _EDGE_HEARD, 1.0)
    keep = np.isfinite(range_m) & (rng.random(num_pulses) < probability)

    # Noise of the range, and points in the lidar frame
    range_m = np.where(keep, range_m, 0.0)
    range_m += sensor.each("range_sigma_m")[fired.lidar] * rng.normal(size=num_pulses)
    keep &= (range_m > _MIN_RANGE_M) & (range_m < sensor.each("max_range_m")[fired.lidar])
    points = fired.direction * range_m[:, None]
    np.add(points, origin_m, out=points, where=origin_m != 0)  # a coordinate of -0.0 stays -0.0

    # Brightness
    reflectivity = REFLECTIVITY[material] * (_UNTINTED + (1 - _UNTINTED) * tint)
    cosine = np.abs(np.einsum("ni,ni->n", hits.normal[ray], spot[:, 0]))
    brightness = reflectivity * (_GRAZING + (1 - _GRAZING) * cosine)
    brightness *= 1 + _NOISE * rng.normal(size=num_pulses)
    return Returns(
        points[keep].astype(np.float32),
        np.clip(np.round(brightness[keep], 2), 0, 1).astype(np.float32),
        fired.offset_ns[keep],
        fired.lidar[keep],
        world.triangles.body[triangle[keep]],
        world.triangles.instance[triangle[keep]],
    )


def at_offsets(time_s: float, offset_ns: Int) -> Float:
    """Return the (N,) times in seconds at (N,) offsets in ns from a reference time in seconds."""
    times: Float = np.asarray(time_s + offset_ns * _S_PER_NS, dtype=np.float64)
    return times


def _spot(direction: Float) -> Float:
    """Return the (N,5,3) ray directions of N beams: the centre of the spot, then four around it."""
    left = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))], axis=1)
    left /= lengths(left)
    upward = np.cross(direction, left)
    rays = [direction + _SPOT_RAD * (a * left + b * upward) for a, b in _SPOT[1:]]
    return np.stack([direction, *(ray / lengths(ray) for ray in rays)], axis=1)


def _strongest_echoes(hits: Hits, spot: Float, rng: np.random.Generator) -> tuple[Float, Int, Bool]:
    """Return the strongest echo of each laser spot, from the hits of its (N,5,3) rays.

    Returns:
        (N,) ranges in metres, inf without a hit. (N,) indices of the rays whose surface
        counts. A mask (N,), True for spots at an edge.
    """
    # On one plane the centre ray counts. At an edge each ray is equally likely to be the strongest
    # echo. Two echoes close together sometimes merge into one at a range in between.
    num_spots, num_rays = spot.shape[:2]
    range_m = hits.range_m.reshape(num_spots, num_rays)

    # A spot is at an edge if a ray does not end in the plane of the centre ray's surface.
    # Along ray s, the plane through the centre echo is at range_0 (n · ray_0) / (n · ray_s).
    slant = np.einsum("ni,nsi->ns", hits.normal[::num_rays], spot)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray without a hit has infinite range
        plane_distance = np.abs(range_m - (range_m * slant)[:, :1] / slant)
    is_hit = np.isfinite(range_m)
    is_edge = is_hit.any(axis=1) & ~(plane_distance < _FLAT_M).all(axis=1)

    # One of the rays with a hit is chosen at random; a second ray may merge with it.
    edges = np.flatnonzero(is_edge)
    choice = np.argmax(rng.random((num_rays, num_spots))[:, edges] * is_hit[edges].T, axis=0)
    chosen_m = range_m[edges, choice]
    partner_m = range_m[edges, rng.integers(num_rays, size=(num_spots,))[edges]]
    merges = np.isfinite(partner_m) & (rng.random((num_spots,))[edges] < _MELT_PROBABILITY)
    merges[merges] = np.abs(partner_m[merges] - chosen_m[merges]) < _MERGE_M
    chosen_m[merges] = (chosen_m[merges] + partner_m[merges]) / 2

    echo_m = range_m[:, 0].copy()
    echo_m[edges] = chosen_m
    ray = np.arange(0, num_spots * num_rays, num_rays)  # centre rays
    ray[edges] = edges * num_rays + choice
    return echo_m, ray, is_edge
