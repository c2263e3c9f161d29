# SPDX-License-Identifier: MIT
"""What the verbs say on the screen. Reads `Result.metrics`:

- ``ghosts``: `densify.scores.ghosts.ghost_scores`;
- ``held_out``: camera -> the same for the key densified from its neighbours alone;
- ``depth``: camera -> `densify.scores.depth_metrics.depth_scores`, where there is truth;

for a benchmark of flow what `densify.bench.flow.bench_flow` returns, and for depth on disk what
`densify.bench.evaluation.evaluate` does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from densify.outputs import Export
from densify.readers.files import format_frames
from densify.types import Result

_NONE = "-"
_SCORES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ("coverage", "coverage", lambda value: f"{100 * value:.1f} %"),
    ("mae_m", "MAE", lambda value: f"{value:.3f} m"),
    ("rmse_m", "RMSE", lambda value: f"{value:.3f} m"),
    ("outliers", "outliers", lambda value: f"{100 * value:.2f} %"),
)
_PARTS = ("all", "moving", "static")


def summary(result: Result) -> str:
    """Three or so lines about one densified key."""
    cloud = result.cloud
    lines = [
        f"key {result.key}, {result.method}: {len(cloud):,} points of {len(result.frames)} sweeps "
        f"({format_frames(result.frames)}), {_moving(result)}"
    ]
    for name in result.depth:
        measured, filled = (_density(result, name, product) for product in ("measured", "filled"))
        line = f"{name}: depth in {measured} of the pixels, {filled} with filled ones"
        if name in result.full:
            line += f", {_density(result, name, 'full')} with those from the prior"
        lines.append(line)
    ghosts = _percent(_look_up(result.metrics, "ghosts", "all"))
    if ghosts != _NONE:
        baseline = _NONE
        if "icp" in result.baselines:
            baseline = _percent(_look_up(result.baselines["icp"].metrics, "ghosts", "all"))
        beside = "" if baseline == _NONE else f" ({baseline} by registration alone)"
        lines.append(f"ghosts: {ghosts} of the accumulated points{beside}")
    lines += [line for name in result.depth if (line := _held_out_line(result, name))]
    return "\n".join(lines)


def _moving(result: Result) -> str:
    if not result.movers:
        return f"{np.count_nonzero(result.cloud.moving):,} on moving objects"
    num_apart = sum(len(mover.cloud) for mover in result.movers.values())
    return f"{num_apart:,} more apart, on {len(result.movers)} moving objects"


def _held_out_line(result: Result, camera: str) -> str:
    """The key from its neighbours alone, against its own returns."""
    said = []
    for part in ("all", "moving"):
        path = ("held_out", camera, "measured", part, "outliers")
        mine = _look_up(result.metrics, *path)
        if mine is None:
            continue
        icp = result.baselines.get("icp")
        other = None if icp is None else _look_up(icp.metrics, *path)
        beside = "" if other is None else f" ({_percent(other)} by registration alone)"
        said.append(f"{_percent(mine)} wrong{beside}{'' if part == 'all' else ' where it moves'}")
    return f"{camera}, key held out: {', '.join(said)}" if said else ""


def export_summary(exported: Export) -> str:
    """A line for each camera, the share of its pixels with a depth, before and after, and one for
    the cloud."""
    lines = []
    for camera, products in exported.density.items():
        measured, filled = (
            f"{_percent(products[p].before, digits=1)} -> {_percent(products[p].after, digits=1)}"
            for p in ("measured", "filled")
        )
        lines.append(f"{camera}: depth in {measured} of the pixels, {filled} with filled ones")
    if exported.num_points is not None:
        lines.append(
            f"cloud: {exported.num_points.after:,} of {exported.num_points.before:,} points"
        )
    return "\n".join(lines)


def comparison(results: Mapping[str, Result]) -> str:
    """A table with one column per method.

    Rows: points, image density per camera, ghost rate, and coverage, MAE, RMSE and KITTI outliers
    of the measured depth at all, moving and static pixels, with the key held out (neither needs
    truth) and against truth where there is some.
    """
    columns = list(results.values())
    rows = [
        ["", *results],
        ["points", *(f"{len(result.cloud):,}" for result in columns)],
    ]
    for name in columns[0].depth:
        for product in ("measured", "filled"):
            densities = [_density(result, name, product) for result in columns]
            rows.append([f"{name} density, {product}", *densities])
    rates = [_look_up(result.metrics, "ghosts", "all") for result in columns]
    rows.append(["ghost rate", *map(_percent, rates)])
    for name in columns[0].depth:
        for source, title in (("held_out", "key held out"), ("depth", "truth")):
            if any(_look_up(result.metrics, source, name) for result in columns):
                rows += _score_rows(columns, source, name, title)
    return _aligned(rows)


Column = tuple[str, tuple[str, ...], str]
"""Title, where the number lies in a method's row, and how it is written."""

_METHOD_COLUMNS: tuple[Column, ...] = (
    ("points", ("num_points",), ",d"),
    ("movers", ("step", "movers_m"), ".3f m"),
    ("/ ours", ("times_error",), ".1f"),
    ("objects", ("step", "static_objects_m"), ".4f m"),
    ("background", ("step", "background_m"), ".4f m"),
    ("found", ("step", "found"), ".1%"),
    ("false", ("step", "falsely_moving"), ".3%"),
    ("E before", ("energy_before",), ".0f"),
    ("E after", ("energy_after",), ".0f"),
    ("seconds", ("seconds_per_pair",), ".3f"),
    ("/ ours", ("times_seconds",), ".1f"),
    ("memory", ("peak_memory_mb",), ".0f MB"),
)
_WINDOW_COLUMNS: tuple[Column, ...] = (
    ("coverage", ("coverage",), ".3f"),
    ("thickness", ("plane_residual_m",), ".4f m"),
    ("extent", ("extent_m2",), ".1f m2"),
    ("lost", ("lost",), ".1%"),
    ("ghosts", ("ghost_rate",), ".2%"),
)


_CHALLENGE_COLUMNS: tuple[Column, ...] = (
    ("challenge: dynamic", ("three_way", "foreground_dynamic_m"), ".4f m"),
    ("static objects", ("three_way", "foreground_static_m"), ".4f m"),
    ("background", ("three_way", "background_static_m"), ".4f m"),
    ("three-way", ("three_way", "mean_m"), ".4f m"),
)


def flow_table(measured: Mapping[str, Any]) -> str:
    """One benchmark of flow: the methods on the pairs, and what they make of the window."""
    methods: Mapping[str, Any] = measured["methods"]
    frames, cap = measured["frames"], measured["max_points"]
    pairs = "1 pair" if measured["num_pairs"] == 1 else f"{measured['num_pairs']} pairs"
    drawn = f"at most {cap:,} drawn points" if cap else "all points"
    lines = [
        f"{measured['data']}, key {measured['key']}, frames {frames[0]}-{frames[-1]}: "
        f"{pairs} of {measured['points_above_ground']:,} points above the "
        f"ground; paper, paper-adam, nicp move {drawn}; E is the paper's energy on those points",
        _table(methods, _METHOD_COLUMNS),
    ]
    for name, other in (("paper", "paper-adam"), ("paper-adam", "paper")):
        solver = _look_up(methods, name, "solver")
        if solver is not None:
            lines.append(_solver_line(name, solver, other, measured["num_pairs"]))
    windows = {name: row["window"] for name, row in methods.items() if row["window"] is not None}
    if windows:
        some = next(iter(windows.values()))
        hops = some.get("movers_m_by_hops", {})
        columns = [(f"{n} hops", ("movers_m_by_hops", n), ".3f m") for n in hops]
        known = [c for c in _WINDOW_COLUMNS if c[1][0] in some]
        perfect = {"(truth)": measured["truth"]} if measured["truth"] else {}
        lines += ["", _table({**windows, **perfect}, (*columns, *known))]
    lines += _challenge_lines({name: row["challenge"] for name, row in methods.items()})
    return "\n".join(lines)


def _challenge_lines(rows: Mapping[str, Any]) -> list[str]:
    scored = {name: row for name, row in rows.items() if row is not None}
    if not scored:
        return []
    classes = next(iter(scored.values()))["bucketed"]
    parts = [
        (f"{name.lower().replace('_', ' ')} {kind}", ("bucketed", name, key), form)
        for name in classes
        for kind, key, form in (("static", "static_m", ".4f m"), ("dynamic", "dynamic", ".3f"))
    ]
    return ["", _table(scored, _CHALLENGE_COLUMNS), "", _table(scored, parts)]


_RELIABILITY_COLUMNS: tuple[Column, ...] = (
    ("confidence from: pixels", ("num_compared",), ",d"),
    ("expected wrong", ("expected",), ".3%"),
    ("wrong", ("outliers",), ".3%"),
)


def depth_table(measured: Mapping[str, Any]) -> str:
    """Two tables for each truth: a row per variant, coverage and outliers of each product; and how
    far confidence keeps what it promises, of the first variant."""
    variants: Mapping[str, Any] = measured["variants"]
    keys = format_frames(measured["keys"])
    sources = {source: None for row in variants.values() for source in row["scores"]}
    lines = []
    for source in sources:
        columns: list[Column] = []
        for product in ("measured", "filled"):
            columns.append((f"{product}", ("density", product), ".1%"))
            for part, title in (("all", ""), ("moving", " movers")):
                path = ("scores", source, product, part)
                columns.append((f"cov{title}", (*path, "coverage"), ".3f"))
                columns.append((f"wrong{title}", (*path, "outliers"), ".3%"))
        columns.append(("s/key", ("seconds",), ".2f"))
        lines += [
            f"{measured['data']}, keys {keys}, against {source}",
            _table(variants, columns),
            "",
        ]
        steps = next(iter(variants.values()))["reliability"].get(source, ())
        if steps:
            rows = {f"{step['confidence']:.2f}": step for step in steps}
            lines += [_table(rows, _RELIABILITY_COLUMNS), ""]
    return "\n".join(lines)


_HOLDS_WITHIN, _HOLDS_WITHIN_SHARE = 0.2, 0.0005


def reliability_tables(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A table for each recording: by confidence the pixels, and the share of them that was expected
    to be wrong and is."""
    lines = []
    for name, steps in rows.items():
        total = sum(step["num_compared"] for step in steps)
        holding, table = 0, {}
        for step in steps:
            off = abs(step["outliers"] - step["expected"])
            holds = off <= max(_HOLDS_WITHIN * step["expected"], _HOLDS_WITHIN_SHARE)
            holding += holds * step["num_compared"]
            table[f"{step['confidence']:.2f}{'' if holds else ' !'}"] = step
        share = _percent(holding / total if total else None, digits=1)
        lines += [f"{name}: holds for {share} of the pixels", _table(table, _RELIABILITY_COLUMNS)]
        lines.append("")
    return "\n".join(lines).rstrip()


_EVALUATION_COLUMNS: tuple[Column, ...] = (
    ("pixels", ("num_pixels",), ",d"),
    ("coverage", ("coverage",), ".1%"),
    ("MAE mm", ("mae_mm",), ",.1f"),
    ("RMSE mm", ("rmse_mm",), ",.1f"),
    ("iMAE 1/km", ("imae_per_km",), ".3f"),
    ("iRMSE 1/km", ("irmse_per_km",), ".3f"),
    ("AbsRel", ("abs_rel",), ".2%"),
    ("SqRel", ("sq_rel",), ".2%"),
    ("d<1.25", ("delta_1",), ".2%"),
    ("d<1.25^2", ("delta_2",), ".2%"),
    ("d<1.25^3", ("delta_3",), ".2%"),
    ("outliers", ("outliers",), ".3%"),
)
_MISSING = {
    "without_truth": "predicted without truth",
    "without_prediction": "truth without prediction",
    "without_mask": "truth without mask",
}
_MAX_NAMED = 5


def evaluation_table(scores: Mapping[str, Any]) -> str:
    """Depth against truth, a row per part of the pixels, in the units of KITTI's leaderboard; what
    found no counterpart is counted, and named as far as there is room."""
    num, density = scores["num_images"], scores["density"]
    lines = [
        f"{num:,} image{'s' if num != 1 else ''}: predicted {_percent(density['predicted'])} of "
        f"the pixels, truth {_percent(density['truth'])}; outliers with fx "
        f"{scores['focal_px']:g} px, baseline {scores['baseline_m']:g} m"
    ]
    for name, what in _MISSING.items():
        if paths := scores[name]:
            rest = f", ... and {len(paths) - _MAX_NAMED:,} more" if len(paths) > _MAX_NAMED else ""
            lines.append(f"{what}: {len(paths):,}: {', '.join(paths[:_MAX_NAMED])}{rest}")
    rows = {name: _in_mm(part) for name, part in scores["parts"].items() if part["num_pixels"]}
    return "\n".join([*lines, _table(rows, _EVALUATION_COLUMNS)])


def _in_mm(part: Mapping[str, Any]) -> dict[str, Any]:
    metres = {name: part[f"{name}_m"] for name in ("mae", "rmse")}
    return {**part, **{f"{n}_mm": None if m is None else 1000 * m for n, m in metres.items()}}


def _solver_line(name: str, solver: Mapping[str, Any], other: str, num_pairs: int) -> str:
    line = (
        f"{name}: {solver['steps']:.0f} steps in {solver['seconds']:.2f} s; lowest E "
        f"{solver['lowest_energy']:.1f} after {solver['steps_to_lowest']:.0f}, "
        f"{solver['seconds_to_lowest']:.2f} s"
    )
    if "pairs_as_low_as_other" in solver:
        seconds = _written(solver["seconds_to_others_lowest"], ".2f s")
        line += (
            f"; as low as {other}'s lowest after {seconds}, on "
            f"{solver['pairs_as_low_as_other']} of {num_pairs} pairs"
        )
    return line


def _table(rows: Mapping[str, Any], columns: Sequence[Column]) -> str:
    """One row per method; columns that say nothing of any are left out."""
    told = [c for c in columns if any(_look_up(r, *c[1]) is not None for r in rows.values())]
    body = [
        [name, *(_written(_look_up(row, *path), form) for _, path, form in told)]
        for name, row in rows.items()
    ]
    return _aligned([["", *(title for title, _, _ in told)], *body])


def _written(value: float | None, form: str) -> str:
    """Format by a format and, after a blank, a unit; percentages with a blank before the sign."""
    if value is None:
        return _NONE
    number, _, unit = form.partition(" ")
    return f"{value:{number}}".replace("%", " %") + (f" {unit}" if unit else "")


def _score_rows(columns: Sequence[Result], source: str, camera: str, title: str) -> list[list[str]]:
    rows: list[list[str]] = [[]]
    for part in _PARTS:
        for key, score, write in _SCORES:
            values = [
                _look_up(result.metrics, source, camera, "measured", part, key)
                for result in columns
            ]
            cells = [_NONE if value is None else write(value) for value in values]
            rows.append([f"{camera} {title}, {part}, {score}", *cells])
    return rows


def _density(result: Result, camera: str, product: str) -> str:
    if product == "full":
        image = result.full[camera].depth_m
    else:
        depth = result.depth[camera]
        image = depth.depth_m if product == "measured" else depth.filled_m
    return _percent(np.count_nonzero(image) / image.size, digits=1)


def _percent(value: float | None, digits: int = 2) -> str:
    return _NONE if value is None else f"{100 * value:.{digits}f} %"


def _look_up(metrics: Mapping[str, Any], *path: str) -> Any:
    """metrics[a][b]..., None where a step of it is missing."""
    value: Any = metrics
    for step in path:
        value = value.get(step) if isinstance(value, Mapping) else None
    return value


def memory_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """What `densify.bench.peaks.bench_memory` returns."""
    head = ["rings", "points", "window", "cameras", "peak", "said before"]
    body = [
        [
            str(row["rings"]),
            f"{row['points']:,}",
            *(str(row[name]) for name in ("window", "cameras")),
            *(f"{row[name]:.2f} GB" for name in ("peak_gb", "said_gb")),
        ]
        for row in rows
    ]
    return _aligned([head, *body])


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right; an empty row is a blank line."""
    widths = [max(map(len, column)) for column in zip(*filter(None, rows), strict=True)]
    lines = []
    for row in rows:
        first, *others = row or [""]
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=False)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    return "\n".join(lines)
