# SPDX-License-Identifier: MIT
"""Make the tables of the scene flow paper again: ``densify bench paper``.

Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or without Learning", 3DV 2020. Methods get
2,048 points drawn from each cloud within 35 m, as in the paper. ``ours`` and trained networks get
all points, and are scored at the drawn points. Scores are the paper's, averaged over pairs.

Other data sets are folders of .npz files by FlowNet3D's authors (Liu et al., CVPR 2019).
FlyingThings3D has ``points1``, ``points2``, ``flow`` and ``valid_mask1`` in camera axes, z forward.
KITTI without ground has ``pos1``, ``pos2`` and ``gt``, z up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.config import Config, ObjectiveSettings, resolve
from densify.config.errors import InputError
from densify.flow.objective import solve
from densify.flow.two_clouds import estimate_flow
from densify.geometry.types import Bool, Float, Int, Progress
from densify.learning.network import AboveGround, Sweeps, read_model
from densify.learning.training import make_clip, sample_of
from densify.readers import open_sequence
from densify.readers.decoded_files import read_arrays
from densify.scores import metrics

FARTHEST_M = 35.0
NUM_POINTS = 2048
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    "flyingthings": {"epe_m": 0.259, "within_5": 0.163, "within_10": 0.416, "angle_rad": 0.369},
    "kitti": {"epe_m": 0.093, "within_5": 0.648, "within_10": 0.821, "angle_rad": 0.137},
}
"""The paper's published scores without learning, by data set."""
_SEED = 0
_FLYINGTHINGS = ("points1", "points2", "flow")  # names of source, target and flow in a file
_KITTI = ("pos1", "pos2", "gt")
_VALID = "valid_mask1"
_R_FLU_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation from axes right, down, forward to axes forward, left, up."""


@dataclass(frozen=True)
class PaperPair:
    """Two clouds in one frame, without ground, and the true flow from the first to the second."""

    name: str
    source: Float  # (n,3) points of the first cloud in metres, z up
    target: Float  # (m,3) points of the second cloud in metres, z up
    flow: Float  # (n,3) true flow of the source points in metres
    moving: Bool | None  # (n,) bool, True for moving points. None if unknown.
    sweeps: Sweeps  # input of trained networks


Flow = Callable[[PaperPair, Int, Int], Float]
"""Function of a pair, the rows drawn from its source, and the rows drawn from its target.

It returns the flow of the drawn source points."""


def _objective(solver: str, **settings: Any) -> Flow:
    """Return a method of scene flow that minimises the paper's objective by a named solver."""
    chosen = ObjectiveSettings(solver=solver, **settings)
    return lambda pair, rows, targets: solve(pair.source[rows], pair.target[targets], chosen).flow


def _ours(pair: PaperPair, rows: Int, targets: Int) -> Float:
    """Return this package's flow of the drawn points, estimated from all points."""
    return estimate_flow(pair.source, pair.target, Config()).displacement[rows]


def _learned(path: Path) -> Flow:
    """Return the method that uses the network of a model file."""
    model = read_model(path)
    return lambda pair, rows, targets: model.flow(pair.sweeps)[rows]


METHODS: dict[str, Flow] = {
    "rest": lambda pair, rows, targets: np.zeros((len(rows), 3)),
    "paper-adam": _objective("adam"),
    "paper": _objective("pcg"),
    "no-laplacian": _objective("pcg", alpha=0.0),
    "ours": _ours,
}
"""Methods by name. rest: zero flow. paper-adam: the published loss, minimized by Adam in 1,500
steps. paper: the same loss with this package's solver. no-laplacian: the loss without its graph
Laplacian (Table 2 of the paper). ours: this package on two whole clouds."""
DEFAULT_METHODS = tuple(name for name in METHODS if name != "paper-adam")


def bench_paper(
    pairs: Iterable[PaperPair],
    methods: Sequence[str] = DEFAULT_METHODS,
    models: Sequence[Path] = (),
    num_points: int = NUM_POINTS,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Return the mean scores of methods and trained networks on pairs of clouds.

    Args:
        pairs: Pairs of clouds. InputError is raised if there are none.
        methods: Keys of `METHODS`.
        models: Paths of model files.
        num_points: Number of points drawn from each cloud.

    Returns:
        ``num_pairs``, ``num_points`` and ``methods``: name of the method or file -> mean scores.
    """
    if num_points < 1:
        raise InputError(f"--points {num_points}: expected 1 or more")
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    flows = {name: METHODS[name] for name in METHODS if name in methods}
    flows |= {path.name: _learned(path) for path in models}
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in flows}
    num_pairs = 0
    for pair in pairs:
        if progress is not None:
            progress(pair.name, num_pairs, num_pairs + 1)
        num_pairs += 1
        for name, flow in flows.items():
            measured[name].append(_score(flow, pair, num_points))
    if not num_pairs:
        raise InputError("densify bench paper: no pairs of sweeps; choose another recording")
    means = {name: _mean(rows) for name, rows in measured.items()}
    return {"num_pairs": num_pairs, "num_points": num_points, "methods": means}


def _score(method: Flow, pair: PaperPair, num_points: int) -> dict[str, float]:
    """Return the scores and the computing time of a method on one pair."""
    rng = np.random.default_rng(_SEED)
    rows, targets = (_draw_rows(cloud, num_points, rng) for cloud in (pair.source, pair.target))
    begin_s = time.perf_counter()
    flow = method(pair, rows, targets)
    seconds = time.perf_counter() - begin_s
    true_flow = pair.flow[rows]
    scores = {
        "epe_m": metrics.end_point_error(flow, true_flow),
        "within_5": metrics.accuracy(flow, true_flow, metrics.STRICT),
        "within_10": metrics.accuracy(flow, true_flow, metrics.RELAXED),
        "angle_rad": metrics.angle_error_rad(flow, true_flow),
        "seconds": seconds,
    }
    if pair.moving is not None:
        moving = pair.moving[rows]
        scores["moving_m"] = metrics.end_point_error(flow, true_flow, moving)
        scores["static_m"] = metrics.end_point_error(flow, true_flow, ~moving)
    return scores


def _draw_rows(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return at most ``count`` ascending indices of random points within 35 m."""
    rows = np.flatnonzero(np.linalg.norm(points[:, :2], axis=1) < FARTHEST_M)
    return np.sort(rng.permutation(rows)[:count])


def _mean(measured: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Return the mean of each score over the pairs where it is finite, None if none is."""
    means: dict[str, float | None] = {}
    for name in measured[0]:
        values = np.array([m[name] for m in measured if name in m])
        known = values[np.isfinite(values)]
        means[name] = float(known.mean()) if len(known) else None
    return means


def has_truth(spec: str) -> bool:
    """Return True if a recording has exact ground truth."""
    return open_sequence(spec).truth is not None


def pair_of_recording(spec: str, key: int) -> PaperPair:
    """Return sweep ``key`` and the next one, with the true flow, else this package's own flow."""
    sequence = open_sequence(spec)
    teacher, settings = "engine", resolve(None)
    if sequence.truth is not None:
        teacher, settings = "truth", resolve({"register": {"source": "dataset"}})
    clip = make_clip(sequence, key, settings, teacher)
    row = next(row for row, sweep in enumerate(clip) if not sweep.origin_m.any())  # the key's
    if row + 1 == len(clip):
        raise InputError(f"--data {spec}: no sweep after {key}; choose an earlier one")
    sample = sample_of(clip, row, row + 1)
    source, target = (clip[n].points.astype(np.float64) for n in (row, row + 1))
    flow, moving = sample.flow.double().numpy(), sample.moving.numpy()
    return PaperPair(f"{spec}@{key}", source, target, flow, moving, sample.sweeps)


def pairs_of_files(folder: Path, num_files: int) -> Iterator[PaperPair]:
    """Yield the pairs in the first ``num_files`` files of a folder, by file name; 0 for all."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise InputError(f"{folder}: no .npz files; expected the sets of FlowNet3D's authors")
    for path in paths[: num_files or None]:
        yield read_pair(path)


def read_pair(path: Path) -> PaperPair:
    """Return the pair in an .npz file, without points farther than 35 m; InputError if damaged."""
    arrays = read_arrays(path)
    names = next((n for n in (_FLYINGTHINGS, _KITTI) if arrays.keys() >= set(n)), None)
    if names is None:
        raise InputError(
            f"{path}: holds {', '.join(sorted(arrays)) or 'nothing'}, expected points1, points2 "
            f"and flow, or pos1, pos2 and gt"
        )
    source, target, flow = (np.asarray(arrays[name], np.float64) for name in names)
    for name, array in zip(names, (source, target, flow), strict=True):
        if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
            raise InputError(f"{path}: {name}: got shape {array.shape}, expected (N,3) numbers")
    valid = np.asarray(arrays.get(_VALID, np.ones(len(source)))).astype(bool).ravel()
    for name, rows in ((names[-1], flow), (_VALID, valid)):
        if len(rows) != len(source):
            raise InputError(f"{path}: {name}: got {len(rows)} rows, expected {len(source)}")
    if names is _FLYINGTHINGS:
        source, target, flow = (x @ _R_FLU_CAMERA.T for x in (source, target, flow))
    valid &= np.abs(source[:, 0]) < FARTHEST_M
    source, flow = source[valid], flow[valid]
    target = target[np.abs(target[:, 0]) < FARTHEST_M]
    if not (len(source) and len(target)):
        raise InputError(f"{path}: no valid point within {FARTHEST_M:g} m ahead")
    lowest = min(source[:, 2].min(), target[:, 2].min())
    sweeps = [
        AboveGround(np.arange(len(x)), x, (x[:, 2] - lowest).astype(np.float32)).cloud(np.zeros(3))
        for x in (source, target)
    ]
    return PaperPair(path.stem, source, target, flow, None, sweeps)
