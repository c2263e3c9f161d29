# SPDX-License-Identifier: MIT
"""Prepare clips for a network: a few registered, deskewed sweeps in a row, without the ground.

With labels, each sweep has its flow to the sweeps before and after it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ground
from densify.geometry.types import Bool, Float32, LidarSequence
from densify.learning.network import AboveGround
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.readers.street import Street

STREETS = "streets"
"""Recording specification: a new simulated street for every clip; options as of ``street``."""
NUM_SWEEPS = 7
_PRESETS, _SHARES = ("street", "crossing", "highway"), (0.5, 0.25, 0.25)
_MOST_TRIES = 8
_POSES_GIVEN = {"register": {"source": "dataset"}}


@dataclass(frozen=True)
class ClipSweep:
    """The n points of a sweep above the ground."""

    # (n,3) metres, world axes, origin at the scanner's position in the clip's key frame
    points: Float32
    height_m: Float32  # (n,) height above the ground
    origin_m: Float32  # (3,) position of the scanner, in the coordinates of ``points``
    time_s: float  # time since the clip's first sweep
    # (2,n,3) metres, world axes, ego-motion removed: flow to the previous sweep and to the next
    # sweep, 0 where that sweep is missing. None without labels.
    flow: Float32 | None = None
    moving: Bool | None = None  # (n,) bool, None without labels


Clip = tuple[ClipSweep, ...]
"""Neighbouring sweeps in the order of time."""


@dataclass(frozen=True)
class ClipMaker:
    """Make clips by number: the same number gives the same clip, in any process."""

    data: tuple[str, ...]  # specifications of recordings, or `STREETS`
    seed: int
    teacher: str = "objective"  # source of the labels, as in `make_clip`

    def __call__(self, number: int) -> Clip:
        """Make the clip of a number."""
        rng = np.random.default_rng([self.seed, number])
        spec = self.data[int(rng.integers(len(self.data)))]
        sequence: LidarSequence = (
            _new_street(spec, rng) if spec.partition("?")[0] == STREETS else open_sequence(spec)
        )
        if self.teacher == "truth" and sequence.truth is None:
            raise InputError(f"--data {spec}: has no true flow; choose another --teacher")
        if len(sequence.frames) < NUM_SWEEPS:
            raise InputError(
                f"--data {spec}: {len(sequence.frames)} sweeps, expected {NUM_SWEEPS} or more"
            )
        settings = resolve(_POSES_GIVEN if isinstance(sequence, Street) else {})
        for _ in range(_MOST_TRIES):
            key = int(rng.choice(np.asarray(sequence.frames)))
            with suppress(ComputationError):
                clip = make_clip(sequence, key, settings, self.teacher)
                if len(clip) > 1:
                    return clip
        raise ComputationError(
            f"--data {spec}: at {_MOST_TRIES} places no two neighbouring sweeps could be "
            f"registered; densify doctor may say why"
        )


def _new_street(spec: str, rng: np.random.Generator) -> Street:
    """Open a simulated street whose seed is drawn at random."""
    preset = str(rng.choice(_PRESETS, p=_SHARES))
    options = "".join(f"&{option}" for option in spec.partition("?")[2].split("&") if option)
    if "seed=" in options:
        raise InputError(f"--data {spec}: seeds are drawn; use street?seed=N for a single street")
    seed = int(rng.integers(10**9, 10**17))
    street = Street.from_spec(f"street:{preset}?seed={seed}&cameras=none{options}")
    street.keep_nothing()
    return street


def make_clip(sequence: LidarSequence, key: int, settings: Config, teacher: str) -> Clip:
    """Return the clip of up to 7 sweeps around a key frame.

    Labels are the ground truth ("truth"), the flow of the engine ``groups`` ("engine"), else none.
    """
    stretch = Recording(sequence, settings, NUM_SWEEPS // 2, [key]).window(key)
    heights, frames = ground(stretch), stretch.frames
    motion = None
    if teacher == "engine":
        motion = estimate_motion(Scene(stretch, heights), settings, "groups")
    origin, begin_ns = stretch[key].T_world_lidar[:3, 3], stretch.sweeps[0].sweep.stamp_ns
    sweeps = []
    for i, registered in enumerate(stretch.sweeps):
        above, frame = AboveGround.of(registered, heights), frames[i]
        neighbors = frames[max(i - 1, 0)], frames[min(i + 1, len(frames) - 1)]
        flow = moving = None
        if teacher == "truth" and sequence.truth is not None:
            row = registered.sweep.row[above.row]
            flows = [sequence.truth.displacement(frame, neighbor)[row] for neighbor in neighbors]
            flow, moving = np.stack(flows), sequence.truth.sweep(frame).moving[row]
        elif motion is not None:
            row, fields = above.row, [motion.flow(frame, neighbor) for neighbor in neighbors]
            flow = np.stack([field.displacement[row] for field in fields])
            moving = fields[0].moving[row] & ~fields[0].lost[row]
        if flow is not None:
            flow = (flow @ registered.T_world_lidar[:3, :3].T).astype(np.float32)
        sweeps.append(
            ClipSweep(
                points=(above.points - origin).astype(np.float32),
                height_m=above.height_m,
                origin_m=(registered.T_world_lidar[:3, 3] - origin).astype(np.float32),
                time_s=(registered.sweep.stamp_ns - begin_ns) * 1e-9,
                flow=flow,
                moving=moving,
            )
        )
    return tuple(sweeps)
