# SPDX-License-Identifier: MIT
"""Train a network by Adam on pairs of sweeps from clips of recordings, with the loss of a teacher.

A clip is a few registered, deskewed sweeps in a row, without the ground. Its pairs are drawn in
both directions of time, each turned about the vertical, mirrored and scaled at random. The same
seed gives the same bytes on CPUs of one kind.

``objective`` is the published objective in m² per point (Pontes, Hays, Lucey, 3DV 2020, sections 3
and 4), with alpha = 4 (10 without learning) and a graph of 50 neighbours. It needs no labels.
``engine`` and ``truth`` compare with a known flow: a sum, in metres, of means over static points,
points slower than 1 m/s, and faster points (DeFlow, Zhang et al., ICRA 2024, eq. 5), because a
plain mean teaches a network to predict no motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError
from densify.flow.energy import energy, on_one_thread
from densify.flow.engines import Scene, estimate_motion
from densify.flow.graph import knn_graph, laplacian
from densify.free_space.ground import ground
from densify.geometry.types import Bool, Float32, LidarSequence, Progress
from densify.learning.network import (
    REACH_M,
    AboveGround,
    Model,
    NetworkCloud,
    Sweeps,
    build,
    order_for,
    write_model,
)
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.readers.street import Street

STREETS = "streets"  # specification of a new simulated street for every clip
_PRESETS, _SHARES = ("street", "crossing", "highway"), (0.5, 0.25, 0.25)  # of new streets
_RECORDED_POSES = {"register": {"source": "dataset"}}
_CLIP_SWEEPS = 7  # number of sweeps in a clip
_MAX_TRIES = 8  # key frames of a recording at which a clip may fail
_NUM_MIXED = 4  # number of clips whose pairs are mixed
_PAIRS_OF_CLIP = 48  # number of pairs drawn from a clip
_MAX_DRAWN = 4096  # greatest number of points of source, and of target, in the objective
_SCALES = (0.95, 1.05)  # least and greatest scale of a sample
ALPHA, NUM_NEIGHBORS = 4.0, 50  # weight of smoothness, neighbours in the graph of the objective
_FAST_M_S = 1.0  # speed from which a moving point counts as fast
_LEARNING_RATE = 2e-3
_LARGEST_GRADIENT = 1.0  # norm of the gradient; a greater one is scaled down
_WARM_UP, _COOL_DOWN = 0.05, 0.5  # shares of the training's steps
_NUM_AVERAGED = 50  # number of last losses whose mean is reported
Predict = Callable[[Sweeps], Tensor]


@dataclass(frozen=True)
class Training:
    """The settings of a training."""

    data: tuple[str, ...]  # specifications of recordings
    steps: int  # number of training steps, each with one pair of sweeps
    teacher: str = "objective"  # source of supervision: "objective", "engine" or "truth"
    seed: int = 0
    device: str = "auto"  # device to train on, "auto", "cpu" or "cuda"


def train(training: Training, out: Path, progress: Progress | None = None) -> float:
    """Train a network, write its model file, and return the mean of its last 50 losses.

    Args:
        training: Recordings, teacher, number of steps, seed and device.
        out: Path of the model file.
        progress: Callback (stage, done, total).

    Raises:
        InputError: The number of steps, the device or a recording cannot be used.
        ComputationError: The loss is not finite.
    """
    loss_of, device = TEACHERS[training.teacher], find_device(training.device)
    if training.steps < 1:
        raise InputError(f"--steps {training.steps}: expected 1 or more")
    network = build(training.seed).to(device).train()
    optimizer = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    drawn = samples(ClipMaker(training.data, training.seed, training.teacher))
    losses: list[float] = []
    with on_one_thread():
        while len(losses) < training.steps:
            sample = _on_device(next(drawn), device)
            optimizer.param_groups[0]["lr"] = _learning_rate(len(losses) / training.steps)
            optimizer.zero_grad()
            loss = loss_of(network, sample)
            if not torch.isfinite(loss):
                raise ComputationError(
                    f"the loss of step {len(losses)} is {loss.item()}; try another --seed"
                )
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
            optimizer.step()
            losses.append(loss.item())
            if progress is not None:
                mean = float(np.mean(losses[-_NUM_AVERAGED:]))
                progress(f"train, loss {mean:.3g}", len(losses), training.steps)
    provenance = {name: getattr(training, name) for name in ("teacher", "seed", "steps")}
    write_model(out, Model(network, {"data": list(training.data), **provenance}))
    return float(np.mean(losses[-_NUM_AVERAGED:]))


def find_device(name: str) -> torch.device:
    """Return the torch device for "cpu", "cuda", or "auto" (CUDA if available)."""
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def _on_device(value: Any, device: torch.device) -> Any:
    """Move a tensor, or all tensors of a tuple, to a device; other values stay the same."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        moved = [_on_device(element, device) for element in value]
        return type(value)(*moved) if hasattr(value, "_fields") else tuple(moved)
    return value


def _learning_rate(done: float) -> float:
    """Return the learning rate at a share of the steps: a rise, a plateau, half a cosine."""
    rate = min(1.0, (done + 0.002) / _WARM_UP)  # not 0 at the first step
    if done > 1 - _COOL_DOWN:
        rate = 0.5 + 0.5 * np.cos(np.pi * (done - 1 + _COOL_DOWN) / _COOL_DOWN)
    return _LEARNING_RATE * max(float(rate), 0.01)


# Clips of recordings


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


Clip = tuple[ClipSweep, ...]  # neighbouring sweeps in the order of time


@dataclass(frozen=True)
class ClipMaker:
    """Maker of numbered clips; the same number gives the same clip, in any process."""

    data: tuple[str, ...]  # specifications of recordings, or `STREETS`
    seed: int
    teacher: str = "objective"  # source of the labels: "objective" (none), "engine" or "truth"

    def __call__(self, number: int) -> Clip:
        """Return the clip of a number, which determines the recording and the key frame."""
        rng = np.random.default_rng([self.seed, number])
        spec = self.data[int(rng.integers(len(self.data)))]
        is_new_street = spec.partition("?")[0] == STREETS
        sequence = _new_street(spec, rng) if is_new_street else open_sequence(spec)
        if self.teacher == "truth" and sequence.truth is None:
            raise InputError(f"--data {spec}: has no true flow; choose another --teacher")
        if len(sequence.frames) < _CLIP_SWEEPS:
            raise InputError(
                f"--data {spec}: {len(sequence.frames)} sweeps, expected {_CLIP_SWEEPS} or more"
            )
        settings = resolve(_RECORDED_POSES if isinstance(sequence, Street) else {})
        for _ in range(_MAX_TRIES):
            key = int(rng.choice(np.asarray(sequence.frames)))
            with suppress(ComputationError):
                clip = make_clip(sequence, key, settings, self.teacher)
                if len(clip) > 1:
                    return clip
        raise ComputationError(
            f"--data {spec}: at {_MAX_TRIES} places no two neighbouring sweeps could be "
            f"registered; densify doctor may say why"
        )


def _new_street(spec: str, rng: np.random.Generator) -> LidarSequence:
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
    """Return the clip of up to 7 sweeps around a key frame, registered by the settings.

    Labels are the ground truth with the teacher "truth", and the flow of the engine ``groups`` with
    "engine". Other teachers give no labels.
    """
    stretch = Recording(sequence, settings, _CLIP_SWEEPS // 2, [key]).window(key)
    heights, frames = ground(stretch), stretch.frames
    motion = None
    if teacher == "engine":
        motion = estimate_motion(Scene(stretch, heights), settings, "groups")
    origin, begin_ns = stretch[key].T_world_lidar[:3, 3], stretch.sweeps[0].sweep.stamp_ns
    sweeps = []
    # At the ends a sweep is its own neighbour: the flow there is 0.
    before_frames, after_frames = (frames[0], *frames[:-1]), (*frames[1:], frames[-1])
    for before, registered, after in zip(before_frames, stretch.sweeps, after_frames, strict=True):
        frame, above = registered.frame, AboveGround.of(registered, heights)
        flow = moving = None
        if teacher == "truth" and sequence.truth is not None:
            row = registered.sweep.row[above.row]
            flow = [sequence.truth.displacement(frame, target)[row] for target in (before, after)]
            moving = sequence.truth.sweep(frame).moving[row]
        elif motion is not None:
            fields = [motion.flow(frame, target) for target in (before, after)]
            flow = [field.displacement[above.row] for field in fields]
            moving = (fields[0].moving & ~fields[0].lost)[above.row]
        if flow is not None:
            # From the lidar frame to world axes: row vectors times the transposed rotation
            flow = (np.stack(flow) @ registered.T_world_lidar[:3, :3].T).astype(np.float32)
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


# Pairs of sweeps


class Sample(NamedTuple):
    """One pair of sweeps to train on; the source has n points."""

    sweeps: Sweeps  # source, target, and sweeps before the source; augmented coordinates
    drawn: Tensor  # (d,) rows of the source points that the objective uses
    drawn_target: Tensor  # (e,3) target points that the objective uses
    # (n,) mask of the source points within the network's grid, which count in the loss
    in_reach: Tensor
    duration_s: float
    flow: Any = None  # (n,3) known flow to the target, m, without ego-motion; None without labels
    moving: Any = None  # (n,) bool tensor, None without labels


def samples(make: ClipMaker) -> Iterator[Sample]:
    """Yield samples without end, from the clips of a maker; pairs of four clips are mixed."""
    for group in count():
        mixed = [make(group * _NUM_MIXED + n) for n in range(_NUM_MIXED)]
        rng = np.random.default_rng([make.seed, group, 1])
        pairs = [(clip, *pair) for clip in mixed for pair in _pairs(clip, rng)]
        for row in rng.permutation(len(pairs)):
            pair_rng = np.random.default_rng([make.seed, group, 2, int(row)])
            clip, source, target = pairs[row]
            yield sample_of(clip, source, target, pair_rng)


def _pairs(clip: Clip, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return 48 pairs (source, target) of a clip, in random rounds of all its pairs."""
    indices = range(len(clip))
    pairs = [(i, j) for i in indices for j in (i - 1, i + 1) if j in indices]
    num_rounds = -(-_PAIRS_OF_CLIP // len(pairs))
    order = [row for _ in range(num_rounds) for row in rng.permutation(len(pairs))]
    return [pairs[row] for row in order[:_PAIRS_OF_CLIP]]


def sample_of(
    clip: Clip, source: int, target: int, rng: np.random.Generator | None = None
) -> Sample:
    """Return the training sample of two neighbouring sweeps of a clip, by their indices.

    ``rng`` turns, mirrors and scales the sample at random, and chooses its points. None changes
    nothing, and chooses points evenly.
    """
    source_sweep, target_sweep = clip[source], clip[target]
    augmentation = np.eye(3, dtype=np.float32) if rng is None else _random_change(rng)
    scale = np.float32(np.linalg.norm(augmentation[2]))

    def cloud(number: int) -> NetworkCloud:
        sweep = clip[number]
        points = torch.from_numpy((sweep.points - source_sweep.origin_m) @ augmentation.T)
        return NetworkCloud(points, torch.from_numpy(sweep.height_m * scale))

    needed = order_for(source, target, len(clip))
    sweeps = tuple(None if number is None else cloud(number) for number in needed)
    points = cloud(source).points, cloud(target).points
    in_reach = [(xyz[:, :2].abs() < REACH_M).all(dim=1) for xyz in points]
    source_rows, target_rows = (_draw(is_within.numpy(), rng) for is_within in in_reach)
    flow = moving = None
    if source_sweep.flow is not None:
        flow = torch.from_numpy(source_sweep.flow[int(target > source)] @ augmentation.T)
        moving = torch.from_numpy(source_sweep.moving)
    duration_s = abs(target_sweep.time_s - source_sweep.time_s)
    drawn_target = points[1][target_rows]
    return Sample(sweeps, source_rows, drawn_target, in_reach[0], duration_s, flow, moving)


def _random_change(rng: np.random.Generator) -> Float32:
    """Return a random matrix (3,3) that turns about z, mirrors half the time, and scales."""
    angle = rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    mirror = np.diag([1.0, -1.0 if rng.random() < 0.5 else 1.0, 1.0])
    return (rng.uniform(*_SCALES) * turn @ mirror).astype(np.float32)


def _draw(within: np.ndarray, rng: np.random.Generator | None) -> Tensor:
    """Return at most 4096 rows where the mask is True, at random, or evenly without ``rng``."""
    rows = np.flatnonzero(within)
    if len(rows) > _MAX_DRAWN:
        every = np.arange(_MAX_DRAWN) * len(rows) // _MAX_DRAWN
        rows = rows[every] if rng is None else np.sort(rng.choice(rows, _MAX_DRAWN, replace=False))
    return torch.from_numpy(rows)


# Losses


def objective_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the published objective of a sample's drawn points, m² per point, a 0-d tensor."""
    source: Tensor = sample.sweeps[0].points[sample.drawn]  # type: ignore[union-attr]
    graph = knn_graph(source.detach().cpu().double().numpy(), NUM_NEIGHBORS)
    flow = predict(sample.sweeps)[sample.drawn]
    loss = energy(flow, source, sample.drawn_target, laplacian(graph), ALPHA)
    return loss.total / len(source)


def supervised_loss(predict: Predict, sample: Sample) -> Tensor:
    """Return the sum of the mean errors of static, slow and fast points, metres, a 0-d tensor."""
    flow, true_flow, moving = predict(sample.sweeps), sample.flow, sample.moving
    is_fast = true_flow.norm(dim=1) >= _FAST_M_S * sample.duration_s
    # The gradient of the norm itself is not a number at 0.
    error_m = ((flow - true_flow) ** 2).sum(dim=1).add(1e-8).sqrt()
    masks = [sample.in_reach & kind for kind in (~moving, moving & ~is_fast, moving & is_fast)]
    means = [error_m[mask].mean() for mask in masks if bool(mask.any())]
    if not means:
        return (flow * 0).sum()  # a loss of 0 that still has a gradient
    return torch.stack(means).sum()


TEACHERS = {"objective": objective_loss, "engine": supervised_loss, "truth": supervised_loss}
