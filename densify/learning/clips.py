# SPDX-License-Identifier: MIT
"""Clips: a few neighbouring sweeps of a recording, made ready for a network.

Registered, deskewed, ground left out, with the flow of every sweep to its neighbours where it is
known. Made anew from a recording, or read again from a folder that keeps them.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ground
from densify.geometry.types import Bool, Float32, LidarSequence, Stretch
from densify.learning.clouds import AboveGround
from densify.outputs.atomic import write_file
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.readers.array_files import read_arrays
from densify.readers.street import Street

STREETS = "streets"
"""Recording specification: a new street for every clip; a sensor may follow as of ``street``."""
NUM_SWEEPS = 7
_PRESETS, _SHARES = ("street", "crossing", "highway"), (0.5, 0.25, 0.25)
_MOST_TRIES = 8
_FORM = 1  # raise it whenever the same clip would come out differently
_POSES_GIVEN = {"register": {"source": "dataset"}}


@dataclass(frozen=True)
class Labels:
    """flow: (2,n,3) metres, axes of the clip, to the sweep before and to the one after; 0 where
    there is none. moving: (n,)."""

    flow: Float32
    moving: Bool


@dataclass(frozen=True)
class ClipSweep:
    """What stands above the ground. points: (n,3) metres, axes of the world, about the clip's
    origin. height_m: (n,) above the ground. origin_m: (3,) the scanner. time_s: since the first."""

    points: Float32
    height_m: Float32
    origin_m: Float32
    time_s: float
    truth: Labels | None = None
    engine: Labels | None = None


@dataclass(frozen=True)
class Clip:
    sweeps: tuple[ClipSweep, ...]


@dataclass(frozen=True)
class ClipMaker:
    """Makes clips by number: the same number, the same clip, in any process.

    data: recordings' specifications, or `STREETS`. labels: "", engine or truth. keep: a folder of
    clips made before.
    """

    data: tuple[str, ...]
    seed: int
    labels: str = ""
    keep: Path | None = None

    def __call__(self, number: int) -> Clip:
        """Raises InputError for a recording that cannot be read, or has no truth where that is
        asked for; ComputationError where none of several places can be registered."""
        rng = np.random.default_rng([self.seed, number])
        spec = self.data[int(rng.integers(len(self.data)))]
        if spec.partition("?")[0] == STREETS:
            street = _new_street(spec, rng)
            key = int(rng.integers(NUM_SWEEPS, len(street.frames) - NUM_SWEEPS))
            return self._kept(street, key, _POSES_GIVEN)
        sequence = open_sequence(spec)
        if self.labels == "truth" and sequence.truth is None:
            raise InputError(f"--data {spec}: no truth of what moves; choose another --teacher")
        if len(sequence.frames) < NUM_SWEEPS:
            raise InputError(
                f"--data {spec}: {len(sequence.frames)} sweeps, expected {NUM_SWEEPS} or more"
            )
        given = _POSES_GIVEN if isinstance(sequence, Street) else {}
        last: ComputationError | None = None
        for _ in range(_MOST_TRIES):
            key = int(rng.choice(np.asarray(sequence.frames)))
            try:
                clip = self._kept(sequence, key, given)
            except ComputationError as error:
                last = error
                continue
            if len(clip.sweeps) > 1:
                return clip
        raise last or ComputationError(f"{spec}: no two neighbouring sweeps in {_MOST_TRIES} tries")

    def _kept(self, sequence: LidarSequence, key: int, settings: dict[str, Any]) -> Clip:
        if self.keep is None:
            return make_clip(sequence, key, resolve(settings), self.labels)
        identity = f"{_FORM} {NUM_SWEEPS} {sequence.name} {key} {settings}"
        path = self.keep / f"{hashlib.sha256(identity.encode()).hexdigest()[:24]}.npz"
        found = _read(path)
        if found is None or any(getattr(s, self.labels or "points") is None for s in found.sweeps):
            found = make_clip(sequence, key, resolve(settings), self.labels)
            _write(path, found)
        return found


def _new_street(spec: str, rng: np.random.Generator) -> Street:
    """A street that nobody has seen."""
    preset = str(rng.choice(_PRESETS, p=_SHARES))
    seed = int(rng.integers(10**9, 10**17))
    query = spec.partition("?")[2]
    options = "".join(f"&{option}" for option in query.split("&") if option)
    if "seed=" in options:
        raise InputError(f"--data {spec}: seeds are drawn; use street?seed=N for a single street")
    street = Street.from_spec(f"street:{preset}?seed={seed}&cameras=none{options}")
    street.keep_nothing()
    return street


def make_clip(sequence: LidarSequence, key: int, settings: Config, labels: str) -> Clip:
    """The sweeps around a key. labels: "" or truth: with the truth where there is one; engine: and
    what this package's engine finds."""
    stretch = Recording(sequence, settings, NUM_SWEEPS // 2, [key]).window(key)
    heights = ground(stretch, settings.ground)
    standing = [AboveGround.of(s, heights) for s in stretch.sweeps]
    truth: list[Labels | None] = [None] * len(standing)
    engine = list(truth)
    if sequence.truth is not None:
        truth = [_truth(sequence, stretch, i, s.row) for i, s in enumerate(standing)]
    if labels == "engine":
        motion = estimate_motion(Scene(stretch, heights), settings, "groups")
        frames = stretch.frames

        def found(i: int, row: NDArray[np.int64]) -> Labels:
            fields = [motion.flow(frames[i], frames[j]) for j in _around(i, len(frames))]
            flow = [field.displacement[row] for field in fields]
            return _labels(stretch, i, flow, fields[0].moving[row] & ~fields[0].lost[row])

        engine = [found(i, s.row) for i, s in enumerate(standing)]
    origin = stretch[key].T_world_lidar[:3, 3]
    begin_ns = stretch.sweeps[0].sweep.stamp_ns
    sweeps = [
        ClipSweep(
            points=(s.points - origin).astype(np.float32),
            height_m=s.height_m,
            origin_m=(registered.T_world_lidar[:3, 3] - origin).astype(np.float32),
            time_s=(registered.sweep.stamp_ns - begin_ns) * 1e-9,
            truth=truth[i],
            engine=engine[i],
        )
        for i, (registered, s) in enumerate(zip(stretch.sweeps, standing, strict=True))
    ]
    return Clip(tuple(sweeps))


def _around(i: int, count: int) -> list[int]:
    """The sweep before and after; itself where there is none."""
    return [max(i - 1, 0), min(i + 1, count - 1)]


def _truth(sequence: LidarSequence, stretch: Stretch, i: int, row: NDArray[np.int64]) -> Labels:
    truth, frames = sequence.truth, stretch.frames
    if truth is None:
        raise ValueError("expected a sequence with truth")
    kept = stretch.sweeps[i].sweep.row[row]
    flow = [truth.displacement(frames[i], frames[j])[kept] for j in _around(i, len(frames))]
    return _labels(stretch, i, flow, truth.sweep(frames[i]).moving[kept])


def _labels(stretch: Stretch, i: int, flow: Sequence[Any], moving: Bool) -> Labels:
    """flow: two of (n,3), lidar frame of sweep number i."""
    R_world_lidar = stretch.sweeps[i].T_world_lidar[:3, :3]
    turned = [(f @ R_world_lidar.T).astype(np.float32) for f in flow]
    return Labels(np.stack(turned), moving)


def _write(path: Path, clip: Clip) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    for i, sweep in enumerate(clip.sweeps):
        arrays[f"{i}.points"], arrays[f"{i}.height_m"] = sweep.points, sweep.height_m
        arrays[f"{i}.origin_m"], arrays[f"{i}.time_s"] = sweep.origin_m, np.array(sweep.time_s)
        for name, labels in (("truth", sweep.truth), ("engine", sweep.engine)):
            if labels is not None:
                arrays[f"{i}.{name}.flow"] = labels.flow
                arrays[f"{i}.{name}.moving"] = labels.moving
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, buffer.getvalue())
    except OSError as error:
        raise InputError(f"--keep {path}: cannot be written: {error.strerror or error}") from error


def _read(path: Path) -> Clip | None:
    """None if it is not there, or damaged: it is made anew."""
    try:
        arrays = read_arrays(path)
        return Clip(tuple(_sweep(arrays, i) for i in range(sum("points" in n for n in arrays))))
    except (InputError, KeyError, ValueError):
        return None


def _sweep(arrays: dict[str, NDArray[Any]], i: int) -> ClipSweep:
    def labels(name: str) -> Labels | None:
        if f"{i}.{name}.flow" not in arrays:
            return None
        return Labels(arrays[f"{i}.{name}.flow"], arrays[f"{i}.{name}.moving"])

    points, height_m = arrays[f"{i}.points"], arrays[f"{i}.height_m"]
    origin_m, time_s = arrays[f"{i}.origin_m"], float(arrays[f"{i}.time_s"])
    return ClipSweep(points, height_m, origin_m, time_s, labels("truth"), labels("engine"))
