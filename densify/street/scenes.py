# SPDX-License-Identifier: MIT
"""The presets of the street by name; each lies in a module of its own, imported when asked for."""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module

import numpy as np

from densify.config.errors import InputError
from densify.street.traffic import Scene

PRESETS = {
    "street": ("densify.street.town", "street"),
    "static": ("densify.street.town", "static_street"),
    "crossing": ("densify.street.crossing", "crossing"),
    "highway": ("densify.street.highway", "highway"),
}
"""Module and function that builds the scene from a random generator."""


@lru_cache(maxsize=2)
def build_scene(preset: str, seed: int) -> Scene:
    """Return the scene of a preset and seed, always the same one.

    Building takes 1 to 2 s; the last two scenes are shared by all sensors and rates.
    Raises InputError for an unknown preset.
    """
    if preset not in PRESETS:
        raise InputError(
            f"street preset {preset!r}: no such preset; there are {', '.join(PRESETS)}"
        )
    module, function = PRESETS[preset]
    scene: Scene = getattr(import_module(module), function)(np.random.default_rng([seed, 0]))
    return scene
