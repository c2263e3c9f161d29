# SPDX-License-Identifier: MIT
"""What benchmarks and ``densify evaluate`` print: what `densify.bench` measured, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from densify.cli.tables import Column, aligned, look_up, percent, table, written
from densify.readers.timeline import format_frames

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


_SEGMENTATION_COLUMNS: tuple[Column, ...] = (
    ("segmentation: IoU of moving", ("moving_iou",), ".3f"),
    ("panoptic quality", ("panoptic_quality",), ".3f"),
    ("recognition", ("recognition",), ".3f"),
    ("found", ("num_found",), ",d"),
    ("missed", ("num_missed",), ",d"),
    ("false", ("num_false",), ",d"),
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
        table(methods, _METHOD_COLUMNS),
    ]
    for name, other in (("paper", "paper-adam"), ("paper-adam", "paper")):
        solver = look_up(methods, name, "solver")
        if solver is not None:
            lines.append(_solver_line(name, solver, other, measured["num_pairs"]))
    windows = {name: row["window"] for name, row in methods.items() if row["window"] is not None}
    if windows:
        some = next(iter(windows.values()))
        hops = some.get("movers_m_by_hops", {})
        columns = [(f"{n} hops", ("movers_m_by_hops", n), ".3f m") for n in hops]
        known = [c for c in _WINDOW_COLUMNS if c[1][0] in some]
        perfect = {"(truth)": measured["truth"]} if measured["truth"] else {}
        lines += ["", table({**windows, **perfect}, (*columns, *known))]
    segments = {name: row["segmentation"] for name, row in methods.items()}
    if any(segments.values()):
        lines += ["", table(segments, _SEGMENTATION_COLUMNS)]
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
    return ["", table(scored, _CHALLENGE_COLUMNS), "", table(scored, parts)]


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
            table(variants, columns),
            "",
        ]
        steps = next(iter(variants.values()))["reliability"].get(source, ())
        if steps:
            rows = {f"{step['confidence']:.2f}": step for step in steps}
            lines += [table(rows, _RELIABILITY_COLUMNS), ""]
    return "\n".join(lines)


_HOLDS_WITHIN, _HOLDS_WITHIN_SHARE = 0.2, 0.0005


def reliability_tables(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A table for each recording: by confidence the pixels, and the share of them that was expected
    to be wrong and is."""
    lines = []
    for name, steps in rows.items():
        total = sum(step["num_compared"] for step in steps)
        holding, by_confidence = 0, {}
        for step in steps:
            off = abs(step["outliers"] - step["expected"])
            holds = off <= max(_HOLDS_WITHIN * step["expected"], _HOLDS_WITHIN_SHARE)
            holding += holds * step["num_compared"]
            by_confidence[f"{step['confidence']:.2f}{'' if holds else ' !'}"] = step
        share = percent(holding / total if total else None, digits=1)
        lines += [
            f"{name}: holds for {share} of the pixels",
            table(by_confidence, _RELIABILITY_COLUMNS),
        ]
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
        f"{num:,} image{'s' if num != 1 else ''}: predicted {percent(density['predicted'])} of "
        f"the pixels, truth {percent(density['truth'])}; outliers with fx "
        f"{scores['focal_px']:g} px, baseline {scores['baseline_m']:g} m"
    ]
    for name, what in _MISSING.items():
        if paths := scores[name]:
            rest = f", ... and {len(paths) - _MAX_NAMED:,} more" if len(paths) > _MAX_NAMED else ""
            lines.append(f"{what}: {len(paths):,}: {', '.join(paths[:_MAX_NAMED])}{rest}")
    rows = {name: _in_mm(part) for name, part in scores["parts"].items() if part["num_pixels"]}
    return "\n".join([*lines, table(rows, _EVALUATION_COLUMNS)])


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
        seconds = written(solver["seconds_to_others_lowest"], ".2f s")
        line += (
            f"; as low as {other}'s lowest after {seconds}, on "
            f"{solver['pairs_as_low_as_other']} of {num_pairs} pairs"
        )
    return line


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
    return aligned([head, *body])


_PAPER_COLUMNS: tuple[Column, ...] = (
    ("epe", ("epe_m",), ".3f m"),
    ("within 5", ("within_5",), ".1%"),
    ("within 10", ("within_10",), ".1%"),
    ("angle", ("angle_rad",), ".3f"),
    ("moving", ("moving_m",), ".3f m"),
    ("static", ("static_m",), ".4f m"),
    ("seconds", ("seconds",), ".2f"),
)


def paper_table(
    name: str, measured: Mapping[str, Any], published: Any, only_published: Sequence[str]
) -> str:
    """A set's rows, the published ones last, then what was measured over neighbours and points."""
    rows = dict(measured["methods"])
    if published is not None:
        rows |= {f"{learned}, as published": {} for learned in only_published}
        rows["paper, as published"] = published
    pairs = f"{measured['num_pairs']} pair{'s' if measured['num_pairs'] != 1 else ''}"
    parts = [f"{name}: {pairs}, {measured['num_points']} points drawn", table(rows, _PAPER_COLUMNS)]
    if published is not None:
        parts.append(f"Figures of {'; '.join(only_published)}: in the paper's Table 1")
    for kind, what in (("neighbors", "neighbours k"), ("points", "points drawn")):
        if kind in measured:
            parts += [f"{name}: paper over {what}", table(measured[kind], _PAPER_COLUMNS)]
    return "\n".join(parts)
