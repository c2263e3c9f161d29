# SPDX-License-Identifier: MIT
"""The benchmarks' only way to the window engine: sweeps registered around a key, our flow of them,
and flow between neighbours chained to the key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from densify.config import Config
from densify.readers.window import read_sweeps, recorded_trajectory, window_frames
from densify.stages.chain import chain
from densify.stages.deskew import deskew
from densify.stages.flow import step_flow
from densify.stages.ground import height_above_ground
from densify.stages.register import register
from densify.types import Float32, FlowField, LidarSequence, Window


class WindowFlow(NamedTuple):
    """Flow of every sweep of a window, in its own lidar frame. steps: to the next sweep towards the
    key (the key's own is 0). to_key: to the key."""

    steps: tuple[FlowField, ...]
    to_key: tuple[FlowField, ...]


def open_window(sequence: LidarSequence, key: int, size: int, config: Config) -> Window:
    """Read, register and deskew, as the pipeline does. Raises InputError for missing frames."""
    settings = config.register
    frames, lead_in = window_frames(sequence, key, size, settings.num_lead_in)
    sweeps = list(read_sweeps(sequence, [*lead_in, *frames], settings))
    if settings.source == "dataset":
        trajectory = recorded_trajectory(sequence, sweeps)
    else:
        rough = register(sweeps, settings)
        straight = [s.sweep for s in deskew(sweeps, rough, key).sweeps]
        trajectory = register(straight, settings, rough)
    return deskew([s for s in sweeps if s.frame in frames], trajectory, key)


def heights_above_ground(window: Window, config: Config) -> tuple[Float32, ...]:
    """(N,) metres per sweep."""
    return height_above_ground(window, config.ground)


def engine_flow(window: Window, config: Config) -> WindowFlow:
    """Ours, from ground to the flow to the key."""
    heights_m = heights_above_ground(window, config)
    return chained(window, step_flow(window, heights_m, config.flow), config)


def chained(window: Window, steps: Sequence[FlowField], config: Config) -> WindowFlow:
    """Flow to the key of any method's steps."""
    return WindowFlow(tuple(steps), chain(window, steps, config.chain))
