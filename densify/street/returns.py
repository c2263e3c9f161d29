# SPDX-License-Identifier: MIT
"""Laser rays that meet a surface: they come back, pass, or are lost.

Cars lose whole panes and dark doors. The shares are those of 207 moving cars of KITTI's stereo
benchmark (Menze and Geiger, "Object Scene Flow for Autonomous Vehicles", CVPR 2015) in sweeps of an
HDL-64E, by angle of incidence, brightness of the car and part. The source's upper part is the
window band with its pillars and the roof; the tables here are of paint and glass by themselves.
They were fitted until cars in a sweep have the source's shares (``tests/test_street_returns.py``).
Doors let fewer rays pass than the source has from behind them, which are errors of calibration.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import ndtr, ndtri

from densify.geometry.types import Bool, Float, Int
from densify.street.materials import REFLECTIVITY, Material, noise
from densify.street.world import ABSORBED, PASSES, STOPS, Meeting, Optics, World

_PARTS = (Material.BODYWORK, Material.FRAME, Material.GLASS)
_BRIGHTNESS = (0.2, 0.55)  # between dark, middle and bright paint
_INCIDENCE_DEG = (10.0, 30.0, 50.0, 67.5, 82.5)
# Percent of rays that are lost, and that pass: for each part, five incidences of dark, middle and
# bright cars.
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
_PATCH_M = 0.7  # in which most rays share their fate: a pane, half a door
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
    """Return what rays of a lidar do. luck: (N,) random number of each ray in [0, 1)."""
    surfaces = world.triangles

    def optics(met: Meeting) -> Int:
        material = surfaces.material[met.triangle]
        outcome = np.full(len(material), STOPS)
        again = (luck[met.ray] + met.layer * _GOLDEN) % 1.0
        outcome[(material == Material.LEAF) & (again < _LEAF_PASSES)] = PASSES
        outcome[(material == Material.GLASS) & met.inside] = PASSES
        rows = np.flatnonzero(_of_vehicle(material) & ~met.inside)
        triangle = met.triangle[rows]
        part = np.argmax(material[rows, None] == np.array(_PARTS), axis=1)
        brightness = np.digitize(surfaces.tint[triangle].mean(axis=1), _BRIGHTNESS)
        incidence_deg = np.degrees(np.arccos(np.clip(met.cosine[rows], 0.0, 1.0)))
        lost, passes = (
            _between(table[part, brightness], incidence_deg) for table in (_LOST, _PASSES)
        )
        owner = world.seed + 3 * surfaces.instance[triangle].astype(np.int64) + part
        level = patches(met.place[rows], owner)
        outcome[rows[level > 1 - passes]] = PASSES
        outcome[rows[level < lost]] = ABSORBED
        return outcome

    return optics


def share_lost(material: Int, tint: Float, range_m: Float) -> Float:
    """(N,) materials, (N,3) tints, (N,) metres -> (N,) share of pulses that are lost, beside what
    vehicles absorb."""
    ground, dark, other = (
        np.interp(range_m, _RANGE_M, lost) for lost in (_GROUND_LOST, _DARK_LOST, _OTHER_LOST)
    )
    is_dark = (REFLECTIVITY[material] * tint.mean(axis=1) < _DARK) & ~_of_vehicle(material)
    return np.where(material <= Material.PAINT, ground, np.where(is_dark, dark, other))


def _of_vehicle(material: Int) -> Bool:
    return np.isin(material, _PARTS)


def patches(place: Float, owner: Int) -> Float:
    """Return (N,) numbers, evenly spread from 0 to 1, that vary smoothly over a surface.

    place: (N,3) metres. owner: (N,) each has numbers of its own.
    """
    cell = np.floor(place / _PATCH_M).astype(np.int64)
    share = place / _PATCH_M - cell
    share = share * share * (3 - 2 * share)
    total, squared = np.zeros(len(place)), np.zeros(len(place))
    for corner in product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        i, j, k = (cell + corner).T
        number = noise(i + 1_000_003 * owner, j + 1_000_003 * k)
        total += weight * ndtri(np.clip(number, 1e-9, 1 - 1e-9))
        squared += weight * weight
    level: Float = ndtr(total / np.sqrt(squared))
    return level


def _between(rows: Float, incidence_deg: Float) -> Float:
    """(N,5) table rows, (N,) degrees -> (N,) read between the table's angles."""
    at = np.interp(incidence_deg, _INCIDENCE_DEG, np.arange(len(_INCIDENCE_DEG)))
    low, n = np.minimum(at.astype(int), len(_INCIDENCE_DEG) - 2), np.arange(len(at))
    return rows[n, low] + (at - low) * (rows[n, low + 1] - rows[n, low])
