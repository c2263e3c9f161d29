# SPDX-License-Identifier: MIT
"""The output of scores, metrics.json.

Its keys; compare.json holds those from ``frames`` on under ``methods`` by method, and data, config
stages, warnings and versions as run.yaml::

    schema_version, key, method
    frames      of the window, absolute numbers
    num_points  of the cloud; num_moving of those
    density     camera -> measured, filled: fraction of the pixels with a depth; with
                --prior also full, and prior, the share that came from it
    ghosts      `densify.scores.ghosts.ghost_scores`: num_points, all, moving, static, by_distance
    depth       where there is truth: camera -> measured, filled -> all, moving, static -> the
                fields of `densify.scores.depth_metrics.DepthErrors`; with --prior also full, and
                prior, the pixels that came from it alone
    measure     map -> what its depth is: z, along the camera's axis, or range, from the lens
    held_out    camera -> the same fields as depth: the key densified from its neighbours alone
                against its own returns; and curve,
                `densify.scores.depth_metrics.precision_density`, drawn in curve.png; and
                reliability, `densify.depth.confidence.reliability`; null for the key sweep alone
    reliability where there is truth: map -> the same list against it
    expected_outliers  map -> measured, filled: the share of wrong pixels that confidence expects
    baselines   the same from ``frames`` on for each simpler method on the same registration

A score that nothing can be said of is null.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from densify.geometry.types import Result
from densify.outputs.context import Context
from densify.outputs.plain import write_json

SCHEMA_VERSION = 1
"""Version of metrics.json and compare.json; grows when a key changes its meaning or goes."""


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``metrics.json``."""
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": result.key,
        "method": result.method,
        **scores_of(result),
        "baselines": {m: scores_of(baseline) for m, baseline in result.baselines.items()},
    }
    write_json(folder / "metrics.json", table)


def scores_of(result: Result) -> dict[str, Any]:
    """Those of one method."""
    return {"frames": result.frames, **result.metrics}
