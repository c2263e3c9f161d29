# SPDX-License-Identifier: MIT
"""`densify.estimate_flow` on neighbouring sweeps of a simulated recording, by what it is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from densify.bench.windows import Window
from densify.config import resolve
from densify.config.errors import InputError
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry import poses
from densify.geometry.types import Bool, Float, LidarSequence, RegisteredSweep, Truth

_CONFIG = {"register": {"source": "dataset"}}  # the flow's own errors, not registration's
_WITHIN_M = 35.0
_GOOD_M = 0.1


class TwoClouds(NamedTuple):
    """Over all pairs, within 35 m and above the ground.

    movers_m: mean end-point error of what moves; what is missed counts as standing still.
    within_10cm: share of it that is off by no more. standing_m: mean error of what stands.
    falsely_moving: share of that which is moved.
    """

    movers_m: float
    within_10cm: float
    standing_m: float
    falsely_moving: float


def bench_two_clouds(sequence: LidarSequence, frames: Sequence[int]) -> dict[str, TwoClouds]:
    """Flow of each of the frames to the next one: of points alone, with their firing times, and
    with their scanners' numbers besides.

    Returns the scores by what was given. Raises InputError for a recording without truth, or where
    a frame is the last one.
    """
    if sequence.truth is None:
        raise InputError(
            "two clouds are scored against exact truth: got a recording without, expected a street"
        )
    errors: dict[str, list[tuple[Float, Bool, Bool]]] = {}
    for frame in frames:
        window = Window.open(sequence, frame, 1, resolve(_CONFIG))
        if window.frames[-1] == frame:
            raise InputError(f"frame {frame}: it is the last one, expected one with a next")
        for given, found in _scored(sequence.truth, window, frame, window.frames[-1]).items():
            errors.setdefault(given, []).append(found)
    return {given: _summed(pairs) for given, pairs in errors.items()}


def _scored(
    truth: Truth, window: Window, frame: int, target: int
) -> dict[str, tuple[Float, Bool, Bool]]:
    """What was given -> (n,) end-point errors in metres, what moves, and what is moved."""
    here, there = window.stretch[frame], window.stretch[target]
    T_here_there = window.stretch.T_target_source(frame, target)
    clouds = here.sweep.points, poses.transform(T_here_there, there.sweep.points)
    rows = here.sweep.row
    true = truth.displacement(frame, target)[rows]
    moves = truth.sweep(frame).moving[rows]
    range_m = np.linalg.norm(here.sweep.points, axis=1)
    asked = window.above[frame] & (range_m <= _WITHIN_M)
    from_ns, to_ns = _time_ns(here), _time_ns(there)
    fields = {
        "points alone": estimate_flow(*clouds),
        "and firing times": estimate_flow(
            *clouds, source_offset_ns=from_ns, target_offset_ns=to_ns
        ),
        "and scanner numbers": estimate_flow(
            *clouds,
            source_offset_ns=from_ns,
            target_offset_ns=to_ns,
            source_lidar=here.sweep.lidar,
            target_lidar=there.sweep.lidar,
        ),
    }
    scored = {}
    for given, found in fields.items():
        error_m = np.linalg.norm(found.displacement - true, axis=1)
        scored[given] = error_m[asked], moves[asked], found.moving[asked]
    return scored


def _time_ns(registered: RegisteredSweep) -> np.ndarray | None:
    """(N,) when each point was measured, on the recording's clock."""
    sweep = registered.sweep
    return None if sweep.offset_ns is None else sweep.stamp_ns + sweep.offset_ns


def _summed(pairs: Sequence[tuple[Float, Bool, Bool]]) -> TwoClouds:
    error_m, moves, moved = (np.concatenate(part) for part in zip(*pairs, strict=True))
    movers_m, standing_m = error_m[moves], error_m[~moves]
    return TwoClouds(
        float(movers_m.mean()) if len(movers_m) else float("nan"),
        float((movers_m <= _GOOD_M).mean()) if len(movers_m) else float("nan"),
        float(standing_m.mean()),
        float(moved[~moves].mean()),
    )
