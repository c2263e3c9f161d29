# SPDX-License-Identifier: MIT
"""Scene flow between two clouds by the published objective, and which of it is proven motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from densify.config import Config, FlowSettings, resolve
from densify.flow.evidence import link
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
    return flow_between(source, target, resolve(config).flow, initial)


def flow_between(
    source: ArrayLike, target: ArrayLike, settings: FlowSettings, initial: ArrayLike | None = None
) -> FlowField:
    """`estimate_flow` with the section itself."""
    objective = ObjectiveSettings(
        solver=settings.solver,
        alpha=settings.alpha,
        num_neighbors=settings.num_neighbors,
        radius_m=settings.radius_m,
        laplacian=settings.laplacian,
    )
    flow = solve(source, target, objective, initial, _device(settings)).flow
    if settings.static_prior:
        return _only_proven(np.asarray(source, float), np.asarray(target, float), flow)
    still = FlowField.zero(len(flow))
    return replace(still, displacement=flow, moving=np.ones(len(flow), bool))


def _device(settings: FlowSettings) -> str:
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
        if len(rows) < _MIN_POINTS:
            continue
        if _beats_standing_still(source[rows], target, flow[rows], trees):
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
