# SPDX-License-Identifier: MIT
"""Write the tables that README.md and docs/ share, from docs/numbers.json and tests/gate.json.

python docs/make_tables.py [FILE]

FILE, printed by ``densify bench baselines --json``, replaces the errors in docs/numbers.json. Costs
are entered there by hand. ``densify bench gate --write`` writes tests/gate.json. A table stands
between ``<!-- table: NAME -->`` and ``<!-- end -->``. Prose quotes a figure as a link to its table.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from densify.bench import gate
from densify.bench.verdicts import coverage, outliers_at
from densify.scores.depth_metrics import LEAST_PIXELS

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = ROOT / "docs/numbers.json"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
FIGURES = ("num_pixels", "num_compared", "coverage", "outliers", "outliers_1_px", "mae_m")
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
SIMPLER = ("single sweep", "single sweep, filled", "single sweep, IP-Basic", "rigid (ICP)")
OURS = ("densify, measured", "densify, filled")
TRUTHS = {
    "KITTI, stereo": ("KITTI", ["0013@10"]),
    "PandaSet, second scanner": ("PandaSet", [f"pandaset/002@{k}" for k in (15, 17, 19)]),
    "street, exact": ("street", []),
}
"""Truth -> its short name, and the keys of the gate that have it."""


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = (f"| {' | '.join(cells)} |" for cells in (titles, *rows))
    head, *body = (re.sub(r"\|  (?=\|)", "| ", line) for line in lines)
    return "\n".join([head, "|" + "---|" * len(titles), *body])


def share(cell: Any, stored: gate.Stored, keys: Sequence[str] = (), figure: str = "") -> str:
    """Return outliers, with the luck of a figure of the gate's keys, and coverage."""
    if cell["num_compared"] < LEAST_PIXELS:
        return "–"
    outliers, covered = 100 * cell["outliers"], f"({cell['coverage']:.2f})"
    if not keys:
        return f"{outliers:.{1 if outliers >= 10 else 2}f} % {covered}"
    luck = math.hypot(*(stored.luck[key][f"{figure} outliers"] for key in keys)) / len(keys)
    return f"{outliers:.2f} ± {luck:.2f} % {covered}"


def comparison(errors: Any, stored: gate.Stored) -> str:
    """Return the table of all methods."""
    rows = []
    for truth, (_, keys) in TRUTHS.items():
        for part, label in (("all", f"{truth} truth, all"), ("moving", "the same, moving")):
            cells = {method: parts[part] for method, parts in errors[truth].items()}
            single, filled, basic, rigid = (share(cells[m], stored) for m in SIMPLER)
            ours = [share(cells[m], stored, keys, f"{m[9:]} {part}") for m in OURS]
            rows.append([label, single, f"{filled}; {basic}", rigid, *ours])
    filled = "filled (ours; IP-Basic)"
    return table(["scored against", "single sweep", filled, "rigid (ICP)", *OURS], rows)


def judged(errors: Any, stored: gate.Stored) -> str:
    """Return the table of figures that only the gate has."""
    usual = ["measured all", "filled all"]
    posts, held_out = ["measured aside", "filled aside"], [104, 112, 120, 128]
    rows = {
        "KITTI drive 0013, key 10, posts not widened": (["0013@10"], posts),
        "KITTI drive 0013, 4 keys, key held out": ([f"0013@{k}" for k in held_out], usual),
    }
    for key in gate.KEYS:
        if not key.is_real:
            moving = [f for f in ("filled moving",) if f in stored.figures[key.name]]
            rows[f"`{key.data}`, key {key.key}"] = [key.name], usual + moving
    cells = [
        [label, *(of_gate(stored, keys, figure) for figure in figures), *[""] * (3 - len(figures))]
        for label, (keys, figures) in rows.items()
    ]
    return table(["", "measured", "filled", "moving, filled"], cells)


def of_gate(stored: gate.Stored, keys: Sequence[str], figure: str) -> str:
    """Return the mean outliers and coverage of a map over keys, with luck."""
    curves = [stored.figures[key][figure] for key in keys]
    outliers = sum(outliers_at(c, coverage(c)) for c in curves) / len(keys) / 100
    covered = sum(map(coverage, curves)) / len(keys) / 100
    cell = {"num_compared": math.inf, "outliers": outliers, "coverage": covered}
    return share(cell, stored, keys, figure)


def baselines(errors: Any, stored: gate.Stored) -> str:
    """Return the table of all errors by part of the pixels."""
    rows = []
    for truth, methods in errors.items():
        name = TRUTHS[truth][0]
        ranges = [p for p in methods[SIMPLER[0]] if name == "KITTI" and "-" in p]
        for part in ["all", "moving", "static", *ranges, *["edge"] * (name != "PandaSet")]:
            label = {"all": f"{name}, all", "edge": "discontinuities"}.get(part, part)
            cells = [methods[method][part] for method in (*SIMPLER, *OURS)]
            pixels = f"({cells[0]['num_pixels']:,})"
            rows.append([f"{label.replace('-', ' to ')} {pixels}", *map(all_errors, cells)])
    titles = ["single sweep", "filled our way", "filled by IP-Basic", "rigid (ICP)", *OURS]
    return table(["truth, part (true pixels)", *titles], rows)


def all_errors(cell: Any) -> str:
    """Return outliers over 3 px and over 1 px, mean absolute error and coverage."""
    if cell["num_compared"] < LEAST_PIXELS:
        return "–"
    shares = f"{100 * cell['outliers']:.2f} / {100 * cell['outliers_1_px']:.2f} %"
    return f"{shares}, {cell['mae_m']:.2f} m ({cell['coverage']:.2f})"


def with_tables(page: str) -> str:
    """Return the text of a page with its tables made again."""
    numbers, stored = json.loads(NUMBERS.read_text()), gate.read(ROOT / "tests/gate.json")
    makers = {f.__name__: f for f in (comparison, judged, baselines)}

    def made(found: re.Match[str]) -> str:
        if found[2] == "cost":
            text = table(["task", "CPU", "elapsed", "memory"], numbers["cost"])
        else:
            text = makers[found[2]](numbers["baselines"], stored)
        return f"{found[1]}{text}\n{found[3]}"

    return MARKED.sub(made, page)


def main() -> None:
    """Store the errors that are given, and write the tables of all pages."""
    for name in sys.argv[1:]:
        measured, numbers = json.loads(Path(name).read_text()), json.loads(NUMBERS.read_text())
        for truth in TRUTHS:
            numbers["baselines"][truth] = {
                method: {part: {f: cell[f] for f in FIGURES} for part, cell in parts.items()}
                for method, parts in measured[truth].items()
            }
        text = json.dumps(numbers, indent=1, ensure_ascii=False)
        flat = re.sub(r"(?<=[\[{])\n[^][{}]*(?=[\]}])", lambda m: " ".join(m[0].split()), text)
        NUMBERS.write_text(flat + "\n")
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))


if __name__ == "__main__":
    main()
