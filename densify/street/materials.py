# SPDX-License-Identifier: MIT
"""The materials of surfaces: colour and texture for cameras, reflectivity for lasers, and how
often a ray goes through."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np

from densify.geometry.compiled import Kernel, inlined
from densify.geometry.types import Float, Int


class Material(IntEnum):
    ASPHALT = 0
    PAVING = 1
    KERB = 2
    GRASS = 3
    PAINT = 4
    BRICK = 5
    PLASTER = 6
    ROOF = 7
    PANE = 8  # of a house: dark, nothing passes
    WOOD = 9
    METAL = 10
    BARK = 11
    LEAF = 12
    BODYWORK = 13
    GLASS = 14  # of a vehicle
    RUBBER = 15
    CLOTH = 16
    SKIN = 17
    LAMP = 18
    UPHOLSTERY = 19
    CONCRETE = 20


# colour, reflectivity at 905 nm, probability that a laser ray passes
_TABLE: dict[Material, tuple[tuple[float, float, float], float, float]] = {
    Material.ASPHALT: ((0.25, 0.25, 0.26), 0.16, 0.0),
    Material.PAVING: ((0.47, 0.45, 0.43), 0.30, 0.0),
    Material.KERB: ((0.58, 0.57, 0.55), 0.38, 0.0),
    Material.GRASS: ((0.26, 0.38, 0.14), 0.40, 0.0),
    Material.PAINT: ((0.86, 0.86, 0.84), 0.85, 0.0),
    Material.BRICK: ((0.56, 0.27, 0.20), 0.42, 0.0),
    Material.PLASTER: ((0.80, 0.76, 0.66), 0.60, 0.0),
    Material.ROOF: ((0.42, 0.20, 0.15), 0.30, 0.0),
    Material.PANE: ((0.16, 0.20, 0.25), 0.08, 0.0),
    Material.WOOD: ((0.45, 0.33, 0.21), 0.45, 0.0),
    Material.METAL: ((0.52, 0.54, 0.56), 0.55, 0.0),
    Material.BARK: ((0.30, 0.23, 0.17), 0.35, 0.0),
    Material.LEAF: ((0.22, 0.36, 0.12), 0.45, 0.45),
    Material.BODYWORK: ((0.90, 0.90, 0.90), 0.55, 0.0),
    Material.GLASS: ((0.10, 0.13, 0.15), 0.10, 0.88),
    Material.RUBBER: ((0.06, 0.06, 0.06), 0.08, 0.0),
    Material.CLOTH: ((0.90, 0.90, 0.90), 0.40, 0.0),
    Material.SKIN: ((0.78, 0.58, 0.46), 0.50, 0.0),
    Material.LAMP: ((0.95, 0.93, 0.85), 0.90, 0.0),
    Material.UPHOLSTERY: ((0.16, 0.15, 0.15), 0.20, 0.0),
    Material.CONCRETE: ((0.62, 0.61, 0.58), 0.45, 0.0),
}

COLOUR: Float = np.array([_TABLE[m][0] for m in Material])
REFLECTIVITY: Float = np.array([_TABLE[m][1] for m in Material])
LASER_PASSES: Float = np.array([_TABLE[m][2] for m in Material])
NOTHING_PASSES: Float = np.zeros(len(Material))
GLASS_PASSES: Float = np.where(np.arange(len(Material)) == Material.GLASS, 1.0, 0.0)


def noise(cell: Int) -> Float:
    """(N,2) integers -> (N,) repeatable random numbers in [0, 1)."""
    number = np.empty(len(cell))
    _numbers_of_cells(cell, number)
    return number


def smooth_noise(uv: Float, cell_m: float) -> Float:
    """(N,2) -> (N,) in [0, 1), smooth over cells of that size."""
    number = np.empty(len(uv))
    _numbers_between_cells(uv, cell_m, number)
    return number


def _courses(uv: Float, length_m: float, height_m: float, joint_m: float) -> tuple[Float, Float]:
    """Bricks laid in courses: a random number for each brick, and 1 where the joint is."""
    row = np.floor(uv[:, 1] / height_m)
    along = uv[:, 0] / length_m + 0.5 * (row % 2)
    column = np.floor(along)
    joint = ((along - column) * length_m < joint_m) | (uv[:, 1] - row * height_m < joint_m)
    return noise(np.stack([column, row], axis=1).astype(np.int64)), joint.astype(np.float64)


def shade_factor(material: Int, uv: Float) -> Float:
    """(N,) materials, (N,2) metres on the surface -> (N,) brightness of the texture there, about 1.

    Textures stick to their body, since uv are coordinates on it.
    """
    factor = np.ones(len(material))

    def apply(kinds: tuple[Material, ...], texture: Callable[[Float], Float]) -> None:
        rows = np.flatnonzero(np.isin(material, kinds))
        if len(rows):
            factor[rows] = texture(uv[rows])

    def rough(fine_m: float, coarse_m: float, contrast: float) -> Callable[[Float], Float]:
        def texture(at: Float) -> Float:
            grain = noise(np.floor(at / fine_m).astype(np.int64))
            mix = 0.4 * grain + 0.6 * smooth_noise(at, coarse_m)
            return 1 + contrast * (2 * mix - 1)

        return texture

    def laid(
        length_m: float, height_m: float, joint_m: float, joint: float
    ) -> Callable[[Float], Float]:
        def texture(at: Float) -> Float:
            brick, line = _courses(at, length_m, height_m, joint_m)
            return np.where(line > 0, joint, 0.82 + 0.36 * brick)

        return texture

    apply((Material.ASPHALT,), rough(0.06, 1.9, 0.22))
    apply((Material.GRASS,), rough(0.08, 1.3, 0.40))
    apply((Material.PLASTER, Material.CONCRETE), rough(0.10, 0.8, 0.10))
    apply((Material.BARK, Material.WOOD), rough(0.05, 0.25, 0.30))
    apply((Material.LEAF,), rough(0.10, 0.30, 0.45))
    apply((Material.CLOTH,), rough(0.04, 0.15, 0.15))
    apply((Material.PAVING,), laid(0.5, 0.5, 0.02, 0.72))
    apply((Material.BRICK,), laid(0.30, 0.11, 0.02, 1.35))
    apply((Material.ROOF,), laid(0.35, 0.28, 0.03, 0.70))
    return factor


_ALONG, _ACROSS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)
_MIX = np.uint64(0xBF58476D1CE4E5B9)
_FAR, _NEAR, _SPARE = np.uint64(32), np.uint64(29), np.uint64(11)


@inlined
def _number(i, j):  # type: ignore[no-untyped-def]
    h = (np.uint64(i) * _ALONG) ^ (np.uint64(j) * _ACROSS)
    h ^= h >> _NEAR
    h *= _MIX
    h ^= h >> _FAR
    return (h >> _SPARE) / 2.0**53


@Kernel
def _numbers_of_cells(cell: Int, number: Float) -> None:
    """number: (N,), filled: in [0, 1), of each cell (N,2)."""
    for n in range(len(cell)):
        number[n] = _number(cell[n, 0], cell[n, 1])


@Kernel
def _numbers_between_cells(uv: Float, cell_m: float, number: Float) -> None:
    """number: (N,), filled: in [0, 1), smooth over cells of that size, at uv (N,2)."""
    for n in range(len(uv)):
        x, y = uv[n, 0] / cell_m, uv[n, 1] / cell_m
        i, j = np.int64(np.floor(x)), np.int64(np.floor(y))
        x, y = x - i, y - j
        x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
        low, high = _number(i, j), _number(i, j + 1)
        low += (_number(i + 1, j) - low) * x
        high += (_number(i + 1, j + 1) - high) * x
        number[n] = low + (high - low) * y
