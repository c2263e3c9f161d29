# SPDX-License-Identifier: MIT
"""``densify bench paper``: the tables of Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or
without Learning" (3DV 2020), measured again.

Methods see 2,048 points drawn of each cloud within 35 m, as in the paper; this package and trained
networks see all points, and are scored at the drawn ones. Scores
are the paper's: mean end-point error; share of points within 5 cm or 5 %, within 10 cm or 10 %;
mean angle to the true flow where that is not 0. Means over pairs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

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

_ICP_REACH_M, _ICP_STEPS, _ICP_SETTLED_M = 1.0, 20, 1e-3
_SEED = 0

Flow = Callable[[Float, Float, PaperPair], Float]
"""Drawn source and target, and the whole pair -> flow of the drawn source, or of the whole one."""


class Row(NamedTuple):
    """A method. whole: its flow is of all points."""

    about: str
    flow: Flow
    whole: bool = False


def rigid_icp(source: Float, target: Float) -> Float:
    """Return the (n,3) flow of one rigid motion of the whole cloud, from rest.

    source, target: (n,3), (m,3) metres, one frame.
    Point to point: Besl and McKay, "A Method for Registration of 3-D Shapes", PAMI 1992.
    """
    tree, moved = cKDTree(target), source
    for _ in range(_ICP_STEPS):
        distance_m, near = tree.query(moved, distance_upper_bound=_ICP_REACH_M)
        hit = np.isfinite(distance_m)
        if hit.sum() < 3:
            break
        own, goal = moved[hit], target[np.asarray(near)[hit]]
        turn, _ = Rotation.align_vectors(goal - goal.mean(axis=0), own - own.mean(axis=0))
        new = turn.apply(moved - own.mean(axis=0)) + goal.mean(axis=0)
        step_m = np.abs(new - moved).max()
        moved = new
        if step_m < _ICP_SETTLED_M:
            break
    return moved - source


def _objective(solver: str, **settings: Any) -> Flow:
    def flow(source: Float, target: Float, pair: PaperPair) -> Float:
        return solve(source, target, SolverSettings(solver=solver, **settings)).flow

    return flow


def _ours(source: Float, target: Float, pair: PaperPair) -> Float:
    return estimate_flow(pair.source, pair.target, Config()).displacement


METHODS = {
    "rest": Row("nothing moves", lambda s, t, pair: np.zeros_like(s)),
    "icp": Row("rigid ICP of the whole cloud", lambda s, t, pair: rigid_icp(s, t)),
    "paper-adam": Row("the objective as published: Adam, 1,500 steps", _objective("adam")),
    "paper": Row("the objective, this package's solver", _objective("pcg")),
    "no-laplacian": Row("Table 2: without the Laplacian", _objective("pcg", alpha=0.0)),
    "ours": Row("this package on two whole clouds", _ours, whole=True),
}
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
    rows = _rows(methods, models)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in rows}
    num_pairs = 0
    for pair in pairs:
        if progress is not None:
            progress(pair.name, num_pairs, num_pairs + 1)
        num_pairs += 1
        for name, row in rows.items():
            found[name].append(_measured(row, pair, num_points))
    if not num_pairs:
        raise InputError("densify bench paper: no pairs of sweeps; choose another recording")
    means = {name: {"about": rows[name].about, **_mean(found[name])} for name in rows}
    return {"num_pairs": num_pairs, "num_points": num_points, "methods": means}


def _rows(methods: Sequence[str], models: Sequence[Path]) -> dict[str, Row]:
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    rows = {name: METHODS[name] for name in METHODS if name in methods}
    return rows | {path.name: _learned(path) for path in models}


def _learned(path: Path) -> Row:
    model = read_model(path)
    about = f"network, teacher {model.made.get('teacher')}, {model.made.get('steps')} steps"
    return Row(about, lambda s, t, pair: model.flow(pair.sweeps), whole=True)


def _measured(row: Row, pair: PaperPair, num_points: int) -> dict[str, float]:
    rng = np.random.default_rng(_SEED)
    drawn, of_target = (_drawn(cloud, num_points, rng) for cloud in (pair.source, pair.target))
    start = time.perf_counter()
    flow = row.flow(pair.source[drawn], pair.target[of_target], pair)
    seconds = time.perf_counter() - start
    flow = flow[drawn] if row.whole else flow
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
