# SPDX-License-Identifier: MIT
"""How many processes a training set is made with: as many as cores, memory and keys suffice for."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from contextlib import suppress

from densify.config.errors import InputError
from densify.dataset.plan import PlannedDrive, Recipe
from densify.geometry.threads import num_threads
from densify.pipeline.memory import available_bytes, check_free
from densify.readers import open_sequence

_log = logging.getLogger("densify")

BASE_BYTES = 0.55e9
"""What a process has loaded before it begins."""
# What a point takes in the shared steps, in a key's window, and, of one sweep, for all beyond it.
_SHARED_BYTES_PER_POINT, _KEY_BYTES_PER_POINT, _FAR_BYTES_PER_POINT = 110, 500, 6000
_LEAST_KEYS = 8  # of a process; fewer are made before another one has begun
_SHARE_OF_FREE = 0.7  # others want memory too, and so do files that are read


def num_processes(
    wanted: int | None, memory_bytes: int | None, recipe: Recipe, drives: Sequence[PlannedDrive]
) -> int:
    """The number that makes the keys of ``drives``; one more leads several.

    wanted: None for one on each core, or fewer where the free memory or the number of keys suffices
    for fewer. memory_bytes: of all together; no more than fit into it.
    Raises InputError if the memory does not suffice for a single one.
    """
    if not drives:
        return wanted or 1
    num_points = _num_points(drives)
    need = _need_bytes(recipe, drives, num_points)
    room = float(memory_bytes or math.inf)
    if memory_bytes is None:
        check_free(need, f"--window {recipe.window}: a process")
        if wanted is None:
            room = max(need, _SHARE_OF_FREE * (available_bytes() or math.inf))
    if room < need:
        raise InputError(
            f"--memory: got {room / 1e9:.1f} GB, expected at least {need / 1e9:.1f} GB "
            f"for window {recipe.window} and sweeps of {num_points:,} points"
        )
    fitting = max(1.0, (room - BASE_BYTES) / need)
    if wanted is None:
        num_keys = sum(len(drive.keys) for drive in drives)
        return int(min(fitting, num_threads(), max(1, num_keys // _LEAST_KEYS)))
    if fitting < wanted:
        _log.warning("%d workers instead of %d fit into the memory", int(fitting), wanted)
    return int(min(fitting, wanted))


def _need_bytes(recipe: Recipe, drives: Sequence[PlannedDrive], num_points: int) -> float:
    """About what a process takes at its peak."""
    num_shared = max(drive.cut.num_sweeps_of_block for drive in drives)
    of_key = (2 * recipe.window + 1) * _KEY_BYTES_PER_POINT
    of_far = _FAR_BYTES_PER_POINT if recipe.config.accumulate.far_m else 0
    return BASE_BYTES + num_points * (num_shared * _SHARED_BYTES_PER_POINT + of_key + of_far)


def _num_points(drives: Sequence[PlannedDrive]) -> int:
    """Number of points of the first sweep that can be read."""
    for drive in drives:
        sequence = open_sequence(drive.source.data)
        for key in drive.keys:
            with suppress(InputError):
                return len(sequence[key])
    return 0
