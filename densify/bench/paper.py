# SPDX-License-Identifier: MIT
"""``densify bench paper``: the tables of Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or
without Learning" (3DV 2020), measured again.

Methods see 2,048 points drawn of each cloud within 35 m, as in the paper; this package and trained
networks see all points, and are scored at the drawn ones. Scores are the paper's: mean end-point
error; share of points within 5 cm or 5 %, within 10 cm or 10 %; mean angle to the true flow where
that is not 0. Means over pairs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from densify.bench.paper_pairs import FARTHEST_M, PaperPair
from densify.config import Config
from densify.config.errors import InputError
from densify.flow.objective.solvers import SolverSettings, solve
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry.types import Float, Int, Progress
from densify.learning.model_file import read_model
from densify.scores import flow_metrics as metrics

NUM_POINTS = 2048
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    "flyingthings": {"epe_m": 0.259, "within_5": 0.163, "within_10": 0.416, "angle_rad": 0.369},
    "kitti": {"epe_m": 0.093, "within_5": 0.648, "within_10": 0.821, "angle_rad": 0.137},
}
"""The paper's row without learning, by set."""

_SEED = 0

Flow = Callable[[Float, Float, PaperPair], Float]
"""Drawn source and target, and the whole pair -> flow of the drawn source, or of the whole one."""


def _objective(solver: str, **settings: Any) -> Flow:
    def flow(source: Float, target: Float, pair: PaperPair) -> Float:
        return solve(source, target, SolverSettings(solver=solver, **settings)).flow

    return flow


def _ours(source: Float, target: Float, pair: PaperPair) -> Float:
    return estimate_flow(pair.source, pair.target, Config()).displacement


METHODS: dict[str, Flow] = {
    "rest": lambda source, target, pair: np.zeros_like(source),
    "paper-adam": _objective("adam"),
    "paper": _objective("pcg"),
    "no-laplacian": _objective("pcg", alpha=0.0),
    "ours": _ours,
}
"""rest: nothing moves. paper-adam: the objective as published, Adam, 1,500 steps. paper: by this
package's solver. no-laplacian: the paper's Table 2. ours: this package on two whole clouds."""
DEFAULT_METHODS = tuple(name for name in METHODS if name != "paper-adam")


def bench_paper(
    pairs: Iterable[PaperPair],
    methods: Sequence[str] = DEFAULT_METHODS,
    models: Sequence[Path] = (),
    num_points: int = NUM_POINTS,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure methods and trained models on pairs; plain numbers ready for JSON.

    Returns ``num_pairs``, ``num_points`` and ``methods``, rows by name.
    Raises InputError for an unknown method, no pairs, or a file that is no model.
    """
    if num_points < 1:
        raise InputError(f"--points {num_points}: expected 1 or more")
    flows = _flows(methods, models)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in flows}
    num_pairs = 0
    for pair in pairs:
        if progress is not None:
            progress(pair.name, num_pairs, num_pairs + 1)
        num_pairs += 1
        for name, flow in flows.items():
            found[name].append(_measured(flow, pair, num_points))
    if not num_pairs:
        raise InputError("densify bench paper: no pairs of sweeps; choose another recording")
    means = {name: _mean(measured) for name, measured in found.items()}
    return {"num_pairs": num_pairs, "num_points": num_points, "methods": means}


def _flows(methods: Sequence[str], models: Sequence[Path]) -> dict[str, Flow]:
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    flows = {name: METHODS[name] for name in METHODS if name in methods}
    return flows | {path.name: _learned(path) for path in models}


def _learned(path: Path) -> Flow:
    model = read_model(path)
    return lambda source, target, pair: model.flow(pair.sweeps)


def _measured(method: Flow, pair: PaperPair, num_points: int) -> dict[str, float]:
    rng = np.random.default_rng(_SEED)
    drawn, of_target = (_drawn(cloud, num_points, rng) for cloud in (pair.source, pair.target))
    start = time.perf_counter()
    flow = method(pair.source[drawn], pair.target[of_target], pair)
    seconds = time.perf_counter() - start
    flow = flow[drawn] if len(flow) == len(pair.source) else flow
    true = pair.flow[drawn]
    scores = {
        "epe_m": metrics.end_point_error(flow, true),
        "within_5": metrics.accuracy(flow, true, metrics.STRICT),
        "within_10": metrics.accuracy(flow, true, metrics.RELAXED),
        "angle_rad": metrics.angle_error_rad(flow, true),
        "seconds": seconds,
    }
    if pair.moving is not None:
        moving = pair.moving[drawn]
        scores["moving_m"] = metrics.end_point_error(flow, true, moving)
        scores["static_m"] = metrics.end_point_error(flow, true, ~moving)
    return scores


def _drawn(points: Float, count: int, rng: np.random.Generator) -> Int:
    near = np.flatnonzero(np.linalg.norm(points[:, :2], axis=1) < FARTHEST_M)
    return np.sort(rng.permutation(near)[:count])


def _mean(measured: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Return the means over the pairs where there is a number."""
    means: dict[str, float | None] = {}
    for name in measured[0]:
        values = np.array([m[name] for m in measured if name in m])
        known = values[np.isfinite(values)]
        means[name] = float(known.mean()) if len(known) else None
    return means
