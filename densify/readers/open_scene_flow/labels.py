# SPDX-License-Identifier: MIT
"""Scene flow out of OpenSceneFlow's files, as an engine: labels (``flow``), or what a network wrote
beside them under its own name (``save.py`` there).

The files hold the flow of each sweep to the next, ego-motion included: a point p of a sweep is at
p + flow in the next one's frame. The ego-motion is taken out with the file's own poses. There is no
flow backwards: towards an earlier sweep a point takes the flow, reversed, of that earlier sweep's
point that arrives nearest to it, and does not move if none arrives within half a metre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from densify.config import Config
from densify.config.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, Stretch
from densify.readers.flow_files import MOVES_M
from densify.readers.open_scene_flow.reader import SweepFile

_ARRIVES_M = 0.5


def estimate_motion(scene: Scene, settings: Config, argument: str) -> ChainedMotion:
    """The flow in a file as an engine, see `densify.flow.engines.EngineModule`.

    argument: ``FILE.h5``, or ``FILE.h5#NAME`` for another flow than ``flow``.
    """
    path, _, name = argument.partition("#")
    labels = FlowLabels(SweepFile(Path(path)), name or "flow", scene.stretch)
    return ChainedMotion(scene.stretch, labels.step)


def check_argument(argument: str) -> None:
    """Raise InputError unless the file is there and holds such a flow."""
    path, _, name = argument.partition("#")
    file = SweepFile(Path(path))
    with file.opened() as groups:
        if not any((name or "flow") in groups[group] for group in file.names):
            held = {key for group in file.names for key in groups[group]}
            raise InputError(
                f"flow.engine opensceneflow:{argument}: no sweep has {name or 'flow'}; got "
                f"{', '.join(sorted(held))}"
            )


@dataclass(frozen=True)
class FlowLabels:
    """The flow ``name`` in the file that the stretch's sweeps were read from."""

    file: SweepFile
    name: str
    stretch: Stretch

    def step(self, here: int, there: int) -> FlowField:
        """Flow of sweep number ``here`` to its neighbour ``there``.

        Raises InputError where the file has no flow of that sweep, or is another recording's.
        """
        return self._forward(here, there) if there > here else self._backward(here, there)

    def _forward(self, here: int, there: int) -> FlowField:
        registered, after = self.stretch.sweeps[here], self.stretch.sweeps[there]
        frame, sweep = registered.frame, registered.sweep
        if after.frame != frame + 1 or after.frame >= len(self.file.names):
            raise InputError(
                f"{self.file.path}: no flow from sweep {frame} to {after.frame}: got "
                f"{len(self.file.names)} sweeps, each with the flow to the next one only"
            )
        residual, valid, instance = self.read(frame, int(sweep.row.max(initial=-1)) + 1)
        residual = residual[sweep.row]
        moving = valid[sweep.row] & (np.linalg.norm(residual, axis=1) >= MOVES_M)
        residual[~moving] = 0.0
        to_reference = None
        if sweep.offset_ns is not None:
            share = sweep.offset_ns / (after.sweep.stamp_ns - sweep.stamp_ns)
            to_reference = -share[:, None] * residual
        objects = np.where(moving, instance[sweep.row], -1).astype(np.int32)
        return FlowField(residual, moving, objects, np.zeros(len(sweep), bool), to_reference)

    def _backward(self, here: int, there: int) -> FlowField:
        forward = self._forward(there, here)
        now, before = self.stretch.sweeps[here], self.stretch.sweeps[there]
        T = self.stretch.T_target_source(now.frame, before.frame)
        arrived = poses.transform(T, before.sweep.points + forward.total)
        gap_m, nearest = cKDTree(arrived).query(now.sweep.points)
        moving: Bool = forward.moving[nearest] & (gap_m <= _ARRIVES_M)
        back = np.where(moving[:, None], -poses.rotate(T, forward.displacement[nearest]), 0.0)
        to_reference = None
        if now.sweep.offset_ns is not None:
            share = now.sweep.offset_ns / (now.sweep.stamp_ns - before.sweep.stamp_ns)
            to_reference = share[:, None] * back
        objects = np.where(moving, forward.instance[nearest], -1).astype(np.int32)
        return FlowField(back, moving, objects, np.zeros(len(moving), bool), to_reference)

    def read(self, frame: int, num_rows: int) -> tuple[Float, Bool, Float]:
        """Flow without ego-motion (N,3), whether it is valid (N,), and the object, -1 none (N,), of
        all rows. num_rows: at the least. Raises InputError where the file has no such flow."""
        read = self.file.array
        with self.file.opened() as groups:
            group = groups[self.file.names[frame]]
            if self.name not in group:
                raise InputError(
                    f"{self.file.path}: sweep {frame} ({self.file.names[frame]}) has no "
                    f"{self.name}; got {', '.join(group)}; choose another key or window"
                )
            points = read(group, "lidar", (None, None))[:, :3].astype(np.float64)
            total = read(group, self.name, (len(points), 3)).astype(np.float64)
            valid, instance = np.ones(len(points), bool), np.full(len(points), -1)
            if "flow_is_valid" in group and self.name == "flow":
                valid = read(group, "flow_is_valid", (len(points),), "biu").astype(bool)
            if "flow_instance_id" in group and self.name == "flow":
                ids = read(group, "flow_instance_id", (len(points),), "iu").astype(np.int64)
                instance = ids - 1  # 0 is none
        if len(points) < num_rows:
            raise InputError(
                f"{self.file.path}: sweep {frame} has {len(points)} points, expected {num_rows} or "
                f"more, as the recording has; give the file that --data names"
            )
        valid &= np.isfinite(total).all(axis=1)
        T_here_next = poses.inverse(self.file.poses[frame]) @ self.file.poses[frame + 1]
        residual = poses.transform(T_here_next, points + total) - points
        return residual, valid, instance
