# SPDX-License-Identifier: MIT
"""``densify bench paper``: the tables of Pontes, Hays, Lucey, "Scene Flow from Point Clouds with or
without Learning" (3DV 2020), measured again.

Methods see 2,048 points drawn of each cloud, within 35 m, as in the paper; those of whole sweeps
(this package's, and trained networks) see all points, registered where poses are known, and are
scored at the drawn ones. Scores are
the paper's: ε, the mean end-point error; the share of points within 5 cm or 5 %, within 10 cm or
10 %; θ, the mean angle to the true flow, where that is not 0. Means over pairs.

Published figures are of the paper's own sets, and each beside what was measured on that set alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from densify.bench.baselines import nonrigid_icp, rigid_icp
from densify.bench.paper_pairs import FARTHEST_M, PaperPair
from densify.config import Config
from densify.config.errors import InputError
from densify.flow.objective.solvers import SolverSettings, solve
from densify.flow.pairs.estimate import estimate_flow
from densify.geometry.types import Float, Int, Progress
from densify.learning.model_file import read_model
from densify.scores import flow_metrics as metrics

NUM_POINTS = 2048
NEIGHBORS = (5, 10, 20, 50, 100)
POINTS = (512, 1024, 2048, 4096, 8192)
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    "flyingthings": {"epe_m": 0.259, "within_5": 0.163, "within_10": 0.416, "angle_rad": 0.369},
    "kitti": {"epe_m": 0.093, "within_5": 0.648, "within_10": 0.821, "angle_rad": 0.137},
    "argoverse": {"epe_m": 0.257, "within_5": 0.253, "within_10": 0.475, "angle_rad": 0.467},
    "nuscenes": {"epe_m": 0.288, "within_5": 0.202, "within_10": 0.436, "angle_rad": 0.337},
}
"""The paper's row without learning, by set."""
ONLY_PUBLISHED = ("DCP", "FlowNet3D, supervised", "PointPWC-Net, supervised")
"""Rows of the paper's Table 1 whose weights are not to be had; nor are their figures here."""

_SEED = 0

Flow = Callable[[Float, Float, PaperPair], Float]
"""Drawn source and target, and the whole pair -> flow of the drawn source, or of the whole one."""


@dataclass(frozen=True)
class Row:
    """A method. whole: its flow is of all points."""

    about: str
    flow: Flow
    whole: bool = False


def _objective(solver: str, **settings: Any) -> Flow:
    def flow(source: Float, target: Float, pair: PaperPair) -> Float:
        return solve(source, target, SolverSettings(solver=solver, **settings)).flow

    return flow


def _at_rest(source: Float, target: Float, pair: PaperPair) -> Float:
    return pair.of_vehicle()


def _ours(source: Float, target: Float, pair: PaperPair) -> Float:
    own = pair.of_vehicle()
    return own + estimate_flow(pair.source + own, pair.target, Config()).displacement


METHODS = {
    "rest": Row("nothing moves but the vehicle, where poses tell", _at_rest, whole=True),
    "icp": Row("rigid ICP of the whole cloud", lambda s, t, pair: rigid_icp(s, t)),
    "nicp": Row("non-rigid ICP", lambda s, t, pair: nonrigid_icp(s, t)),
    "paper-adam": Row("the objective as published: Adam, 1,500 steps", _objective("adam")),
    "paper": Row("the objective, this package's solver", _objective("pcg")),
    "no-laplacian": Row("Table 2: without the Laplacian", _objective("pcg", alpha=0.0)),
    "ours": Row("this package on two whole clouds", _ours, whole=True),
}
SLOW = ("paper-adam",)
DEFAULT_METHODS = tuple(name for name in METHODS if name not in SLOW)


def bench_paper(
    pairs: Iterable[PaperPair],
    methods: Sequence[str] = DEFAULT_METHODS,
    models: Sequence[Path] = (),
    num_points: int = NUM_POINTS,
    curves: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure methods and trained models on pairs; plain numbers ready for JSON.

    Returns ``num_pairs``, ``methods`` (rows by name), and with ``curves`` the errors of ``paper``
    over the graph's neighbours and over the number of points. Raises InputError for an unknown
    method, no pairs, or a file that is no model.
    """
    rows = _rows(methods, models)
    if num_points < 1:
        raise InputError(f"--points {num_points}: expected 1 or more")
    variants: dict[str, dict[str, Row]] = {"methods": rows}
    if curves:
        by_k = {str(k): Row("", _objective("pcg", num_neighbors=k)) for k in NEIGHBORS}
        variants["neighbors"] = by_k
    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    report = progress or (lambda stage, done, total: None)
    num_pairs = 0
    for pair in pairs:
        report(pair.name, num_pairs, num_pairs + 1)
        num_pairs += 1
        for kind, table in variants.items():
            for name, row in table.items():
                measured = _measured(row, pair, num_points)
                found.setdefault(kind, {}).setdefault(name, []).append(measured)
        for n in POINTS if curves else ():
            measured = _measured(METHODS["paper"], pair, n)
            found.setdefault("points", {}).setdefault(str(n), []).append(measured)
    if not num_pairs:
        raise InputError("densify bench paper: no pairs of sweeps; choose another recording")
    tables: dict[str, dict[str, dict[str, Any]]]
    tables = {k: {name: {**_mean(m)} for name, m in t.items()} for k, t in found.items()}
    for name, row in rows.items():
        tables["methods"][name] = {"about": row.about, **tables["methods"][name]}
    return {"num_pairs": num_pairs, "num_points": num_points, **tables}


def _rows(methods: Sequence[str], models: Sequence[Path]) -> dict[str, Row]:
    for name in methods:
        if name not in METHODS:
            raise InputError(f"--methods {name}: expected some of {', '.join(METHODS)}")
    rows = {name: METHODS[name] for name in METHODS if name in methods}
    return rows | {path.name: _learned(path) for path in models}


def _learned(path: Path) -> Row:
    model = read_model(path)
    about = f"network, teacher {model.made.get('teacher')}, {model.made.get('steps')} steps"

    def flow(source: Float, target: Float, pair: PaperPair) -> Float:
        return pair.of_vehicle() + model.flow(pair.sweeps)

    return Row(about, flow, whole=True)


def flows_of_pair(
    pair: PaperPair, methods: Sequence[str], models: Sequence[Path], num_points: int
) -> tuple[Float, dict[str, Float]]:
    """The drawn points (n,3) and, by what a method is, (n,3) their flow, the truth first. Raises
    InputError as `bench_paper` does."""
    rows = _rows(methods, models)
    drawn, _ = _both_drawn(pair, num_points)
    flows = {row.about: _flow(row, pair, num_points) for row in rows.values()}
    return pair.source[drawn], {"truth": pair.flow[drawn], **flows}


def _flow(row: Row, pair: PaperPair, num_points: int) -> Float:
    drawn, of_target = _both_drawn(pair, num_points)
    flow = row.flow(pair.source[drawn], pair.target[of_target], pair)
    return flow[drawn] if row.whole else flow


def _measured(row: Row, pair: PaperPair, num_points: int) -> dict[str, float]:
    begun_s = time.perf_counter()
    flow = _flow(row, pair, num_points)
    seconds = time.perf_counter() - begun_s
    drawn, _ = _both_drawn(pair, num_points)
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


def _both_drawn(pair: PaperPair, num_points: int) -> tuple[Int, Int]:
    """Rows of the source and of the target."""
    rng = np.random.default_rng(_SEED)
    return _drawn(pair.source, num_points, rng), _drawn(pair.target, num_points, rng)


def _drawn(points: Float, count: int, rng: np.random.Generator) -> Int:
    near = np.flatnonzero(np.linalg.norm(points[:, :2], axis=1) < FARTHEST_M)
    return np.sort(rng.permutation(near)[:count])


def _mean(measured: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Over the pairs where there is a number."""
    means: dict[str, float | None] = {}
    for name in measured[0]:
        values = np.array([m[name] for m in measured if name in m])
        known = values[np.isfinite(values)]
        means[name] = float(known.mean()) if len(known) else None
    return means
