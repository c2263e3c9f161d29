# SPDX-License-Identifier: MIT
"""The presets by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from densify.config.errors import InputError
from densify.street.casting import Scene
from densify.street.crossing import crossing
from densify.street.highway import highway
from densify.street.town import street

PRESETS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "street": partial(street, alive=True),
    "static": partial(street, alive=False),
    "crossing": crossing,
    "highway": highway,
}


@lru_cache(maxsize=2)
def build_scene(preset: str, seed: int) -> Scene:
    """The same scene for the same preset and seed, always; it takes 1 to 2 s, and the last ones are
    shared by all scanners and rates. Raises InputError for an unknown preset."""
    if preset not in PRESETS:
        raise InputError(
            f"street preset {preset!r}: no such preset; there are {', '.join(PRESETS)}"
        )
    return PRESETS[preset](np.random.default_rng([seed, 0]))
