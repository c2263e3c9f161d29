# SPDX-License-Identifier: MIT
"""Scene flow between two clouds by the published objective, and which of it is proven motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from densify.config import Config, FlowSettings, resolve
from densify.flow.evidence import link
from densify.flow.neighbors import require_points
from densify.flow.solvers import ObjectiveSettings, solve
from densify.types import Float, FlowField

_LEAST_MOTION_M = 0.15
_LINK_M = 0.6
_MIN_POINTS = 8
_REACH_M = 0.5
_MIN_GAIN_M = 0.07


def estimate_flow(
    source: ArrayLike,
    target: ArrayLike,
    config: Config | str | Path | Mapping[str, Any] | None = None,
    initial: ArrayLike | None = None,
) -> FlowField:
    """Scene flow of two clouds in one coordinate frame.

    source: (N,3), target: (M,3), metres. initial: (N,3) flow to start from. config: its ``flow``
    section is used.

    With ``flow.static_prior`` only groups of points move whose motion explains the target better
    than standing still; the flow of all others is exactly 0. Without it every point takes the
    objective's flow.

    Raises InputError for no points, wrong shapes or NaN.
    """
    settings = resolve(config).flow
    points = np.asarray(require_points(source, "source"), np.float64)
    aim = np.asarray(require_points(target, "target"), np.float64)
    flow = solve(
        points, aim, objective_settings(settings), initial, device=device(settings)
    ).flow
    if not settings.static_prior:
        everything = np.ones(len(points), bool)
        none = np.full(len(points), -1, np.int32)
        return FlowField(flow, everything, none, np.zeros(len(points), bool))
    return _only_proven(points, aim, flow)


def objective_settings(settings: FlowSettings) -> ObjectiveSettings:
    """The objective as configured."""
    return ObjectiveSettings(
        solver=settings.solver,
        alpha=settings.alpha,
        num_neighbors=settings.num_neighbors,
        radius_m=settings.radius_m,
        laplacian=settings.laplacian,
    )


def device(settings: FlowSettings) -> str:
    """Where the objective is minimised."""
    if settings.device != "auto":
        return settings.device
    return "cuda" if torch.cuda.is_available() else "cpu"


def _only_proven(source: Float, target: Float, flow: Float) -> FlowField:
    """Keep the flow of groups that beat "did not move" in both directions."""
    field = FlowField.zero(len(source))
    moved = np.flatnonzero(np.linalg.norm(flow, axis=1) > _LEAST_MOTION_M)
    num_groups, group = link(source[moved], _LINK_M)
    trees = cKDTree(source), cKDTree(target)
    instance = 0
    for k in range(num_groups):
        rows = moved[group == k]
        if len(rows) >= _MIN_POINTS and _beats_standing_still(source[rows], target, flow[rows], trees):
            field.displacement[rows] = flow[rows]
            field.moving[rows] = True
            field.instance[rows] = instance
            instance += 1
    return field


def _beats_standing_still(
    group: Float, target: Float, flow: Float, trees: tuple[cKDTree, cKDTree]
) -> bool:
    """Judged by the group's common translation: a free flow always comes closer to the target."""
    source_tree, target_tree = trees
    arrived = group + np.median(flow, axis=0)

    def mean_distance(tree: cKDTree, points: Float) -> float:
        return float(np.minimum(tree.query(points)[0], _REACH_M).mean())

    reached = np.unique(np.concatenate(target_tree.query_ball_point(arrived, _REACH_M))).astype(int)
    if not len(reached):
        return False
    forward = mean_distance(target_tree, group) - mean_distance(target_tree, arrived)
    there = target[reached]
    backward = mean_distance(source_tree, there) - mean_distance(cKDTree(arrived), there)
    return min(forward, backward) >= _MIN_GAIN_M
