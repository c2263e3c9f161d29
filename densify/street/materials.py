# SPDX-License-Identifier: MIT
"""Define the materials of surfaces: colour, texture, reflectivity, and reflection of the sky."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np

from densify.geometry.types import Float, Int


class Material(IntEnum):
    """A material: colour, reflectivity at 905 nm, and the share of the sky that it mirrors."""

    def __new__(
        cls, colour: tuple[float, float, float], reflectivity: float, gloss: float = 0.0
    ) -> Material:
        """Return the next member, numbered from 0."""
        material = int.__new__(cls, len(cls.__members__))
        material._value_ = len(cls.__members__)
        material.row = (*colour, reflectivity, gloss)
        return material

    row: tuple[float, ...]
    ASPHALT = (0.25, 0.25, 0.26), 0.16
    PAVING = (0.47, 0.45, 0.43), 0.30
    KERB = (0.58, 0.57, 0.55), 0.38
    GRASS = (0.26, 0.38, 0.14), 0.40
    PAINT = (0.86, 0.86, 0.84), 0.85
    BRICK = (0.56, 0.27, 0.20), 0.42
    PLASTER = (0.80, 0.76, 0.66), 0.60
    ROOF = (0.42, 0.20, 0.15), 0.30
    PANE = (0.16, 0.20, 0.25), 0.08, 0.25  # window of a house: dark, no ray passes
    WOOD = (0.45, 0.33, 0.21), 0.45
    METAL = (0.52, 0.54, 0.56), 0.55
    BARK = (0.30, 0.23, 0.17), 0.35
    LEAF = (0.22, 0.36, 0.12), 0.45
    BODYWORK = (0.90, 0.90, 0.90), 0.55, 0.06
    GLASS = (0.10, 0.13, 0.15), 0.10  # of a vehicle
    RUBBER = (0.06, 0.06, 0.06), 0.08
    CLOTH = (0.90, 0.90, 0.90), 0.40
    SKIN = (0.78, 0.58, 0.46), 0.50
    LAMP = (0.95, 0.93, 0.85), 0.90
    UPHOLSTERY = (0.16, 0.15, 0.15), 0.20
    CONCRETE = (0.62, 0.61, 0.58), 0.45
    FRAME = (0.90, 0.90, 0.90), 0.55, 0.06  # bodywork around and above car windows


_ROWS: Float = np.array([m.row for m in Material])
COLOUR, (REFLECTIVITY, GLOSS) = _ROWS[:, :3], _ROWS[:, 3:].T


def noise(i: Int, j: Int) -> Float:
    """Return (N,) repeatable random numbers in [0, 1), a hash of two (N,) integer arrays."""
    h = i.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    h ^= j.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= h >> np.uint64(32)
    return (h >> np.uint64(11)) / 2.0**53


def smooth_noise(uv: Float, cell_m: float) -> Float:
    """Return (N,) numbers in [0, 1) at (N,2) positions, smooth over cells of ``cell_m``."""
    x, y = uv.T / cell_m
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x, y = x - i, y - j
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    low, high = noise(i, j), noise(i, j + 1)
    low += (noise(i + 1, j) - low) * x
    high += (noise(i + 1, j + 1) - high) * x
    return low + (high - low) * y


def _rough(fine_m: float, coarse_m: float, contrast: float) -> Callable[[Float], Float]:
    """Return a texture of grains and blotches."""

    def texture(at: Float) -> Float:
        grain = noise(*np.floor(at.T / fine_m).astype(np.int64))
        mix = 0.4 * grain + 0.6 * smooth_noise(at, coarse_m)
        return 1 + contrast * (2 * mix - 1)

    return texture


def _laid(
    length_m: float, height_m: float, joint_m: float, joint: float
) -> Callable[[Float], Float]:
    """Return a texture of bricks laid in courses, with joints of the brightness ``joint``."""

    def texture(at: Float) -> Float:
        row = np.floor(at[:, 1] / height_m)
        along = at[:, 0] / length_m + 0.5 * (row % 2)
        column = np.floor(along)
        line = ((along - column) * length_m < joint_m) | (at[:, 1] - row * height_m < joint_m)
        brick = noise(column.astype(np.int64), row.astype(np.int64))
        return np.where(line, joint, 0.82 + 0.36 * brick)

    return texture


_TEXTURES = {
    Material.ASPHALT: _rough(0.06, 1.9, 0.22),
    Material.GRASS: _rough(0.08, 1.3, 0.40),
    Material.PLASTER: _rough(0.10, 0.8, 0.10),
    Material.CONCRETE: _rough(0.10, 0.8, 0.10),
    Material.BARK: _rough(0.05, 0.25, 0.30),
    Material.WOOD: _rough(0.05, 0.25, 0.30),
    Material.LEAF: _rough(0.10, 0.30, 0.45),
    Material.CLOTH: _rough(0.04, 0.15, 0.15),
    Material.PAVING: _laid(0.5, 0.5, 0.02, 0.72),
    Material.BRICK: _laid(0.30, 0.11, 0.02, 1.35),
    Material.ROOF: _laid(0.35, 0.28, 0.03, 0.70),
}


def shade_factor(material: Int, uv: Float) -> Float:
    """Return the (N,) brightness of the texture, around 1, at (N,2) metres on the surface."""
    factor = np.ones(len(material))
    for kind, texture in _TEXTURES.items():
        rows = np.flatnonzero(material == kind)
        if len(rows):
            factor[rows] = texture(uv[rows])
    return factor
