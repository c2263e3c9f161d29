# SPDX-License-Identifier: MIT
"""Two sweeps at a time as an engine: what certainly moves between neighbours, chained.

For recordings of two sweeps, in which nothing can be followed: a track shows itself in three.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from densify.config import Config
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry import poses
from densify.geometry.types import FlowField, Int, Motion, Stretch, Sweep


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """See `densify.flow.engines.EngineModule`; takes no argument."""
    of_groups = replace(settings, flow=replace(settings.flow, engine="groups"))

    def step(here: int, there: int) -> FlowField:
        return _step(scene.stretch, here, there, of_groups)

    return ChainedMotion(scene.stretch, step)


def _step(stretch: Stretch, here: int, there: int, settings: Config) -> FlowField:
    """Flow of one sweep's points to another's reference time; sweeps by number."""
    pair = [stretch.sweeps[i] for i in (here, there)]
    sweeps = [s.sweep for s in pair]
    if min(map(len, sweeps)) == 0:
        return FlowField.zero(len(sweeps[0]))
    source, target = (poses.transform(s.T_world_lidar, s.sweep.points) for s in pair)
    times_ns = _times_ns(*sweeps)
    lidars = [s.lidar for s in sweeps] if any(s.lidar.any() for s in sweeps) else [None, None]
    field = estimate_flow(source, target, settings, None, *times_ns, *lidars)
    R_lidar_world = pair[0].T_world_lidar[:3, :3].T
    displacement = field.displacement @ R_lidar_world.T
    to_reference = None
    if field.to_reference is not None and times_ns[0] is not None:
        # It leads to the middle of the firing times, on which sweeps need not be stamped.
        late = int(times_ns[0].min()) + np.ptp(times_ns[0]) / 2
        apart_ns = sweeps[1].stamp_ns - sweeps[0].stamp_ns
        to_reference = field.to_reference @ R_lidar_world.T - displacement * (late / apart_ns)
    return replace(field, displacement=displacement, to_reference=to_reference)


def _times_ns(source: Sweep, target: Sweep) -> tuple[Int | None, Int | None]:
    """When the points were measured, since the source's reference time."""
    if source.offset_ns is None or target.offset_ns is None:
        return None, None
    return source.offset_ns, target.offset_ns + (target.stamp_ns - source.stamp_ns)
