# SPDX-License-Identifier: MIT
"""Write the tables that README.md and docs/ share, from docs/numbers.json and tests/gate.json.

python docs/make_tables.py [FILE]

FILE, printed by ``densify bench baselines --json`` or ``densify bench training --json``, replaces
errors in docs/numbers.json. Costs are entered there by hand. ``densify bench gate --write`` writes
tests/gate.json. A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``. Prose quotes
a figure as a link to its table. The commands, the settings and the Python API are made in the same
way, from the code.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import make_api

from densify.bench import gate
from densify.bench.training import mean_and_error
from densify.bench.verdicts import coverage, outliers_at
from densify.cli.commands import command_line
from densify.scores.metrics import LEAST_PIXELS

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = ROOT / "docs/numbers.json"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
FIGURES = ("num_pixels", "num_compared", "coverage", "outliers", "outliers_1_px", "mae_m")
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
MEASURED = ("single sweep", "rigid (ICP)", "rigid, cleaned", "densify, measured")
FILLED = ("single sweep, filled", "single sweep, IP-Basic", "densify, filled")
METHODS = (*MEASURED, *FILLED)
TITLES = dict(
    zip(
        METHODS,
        ("single sweep", "rigid (ICP)", "rigid cleaned", "densify measured")
        + ("single sweep filled", "IP-Basic", "densify filled"),
        strict=True,
    )
)
HELD_OUT = ("rigid (ICP)", "rigid cleaned", "densify measured", "densify filled")
TRUTHS = {
    "KITTI, stereo": ("KITTI, 1 image, stereo truth", ["0013@10"]),
    "PandaSet, second scanner": ("PandaSet, 3 images, second scanner", []),
    "street, exact": ("street, 1 image, exact truth", ["street?seed=301@60"]),
}
"""Truth -> its title, and the keys of the gate that have its luck."""


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = (f"| {' | '.join(cells)} |" for cells in (titles, *rows))
    head, *body = (re.sub(r"\|  (?=\|)", "| ", line) for line in lines)
    return "\n".join([head, "|" + "---|" * len(titles), *body])


def share(cell: Any, stored: gate.Stored | None, keys: Sequence[str] = (), figure: str = "") -> str:
    """Return outliers in %, with the luck of a figure of the gate's keys, and coverage."""
    if cell["num_compared"] < LEAST_PIXELS:
        return "–"
    outliers, covered = 100 * cell["outliers"], f"({cell['coverage']:.2f})"
    if not keys or stored is None:
        return f"{outliers:.{1 if outliers >= 10 else 2}f} {covered}"
    luck = math.hypot(*(stored.luck[key][f"{figure} outliers"] for key in keys)) / len(keys)
    return f"{outliers:.2f} ± {luck:.2f} {covered}"


def with_best(texts: Mapping[str, str], cells: Mapping[str, Any]) -> list[str]:
    """Return the texts of methods, in bold the least of the measured and of the filled maps.

    Maps with less than a quarter of the greatest coverage of their group are not among them.
    """
    best = {}
    for group in (MEASURED, FILLED):
        covered = {m: cells[m]["coverage"] for m in group if texts.get(m, "–") != "–"}
        least_covered = 0.25 * max(covered.values(), default=0.0)
        numbers = {m: texts[m].split()[0] for m in covered if covered[m] >= least_covered}
        least = min(map(float, numbers.values()), default=0.0)
        best |= {method: number for method, number in numbers.items() if float(number) == least}
    return [re.sub(r"^\S+", r"**\g<0>**", text) if m in best else text for m, text in texts.items()]


def comparison(errors: Any, stored: gate.Stored) -> str:
    """Return the table of all methods."""
    return rows_of_truths(errors, METHODS, stored)


def headline(errors: Any, stored: gate.Stored) -> str:
    """Return the table of the README, without the single sweep as measured and without luck."""
    return rows_of_truths(errors, METHODS[1:], None)


def rows_of_truths(errors: Any, methods: Sequence[str], stored: gate.Stored | None) -> str:
    """Return a table of outliers and coverage, with luck if the gate's figures are given."""
    rows = []
    for truth, (label, keys) in TRUTHS.items():
        for part in ("all", "moving"):
            texts = {}
            for method in METHODS:
                kind = method.removeprefix("densify, ")
                has_luck = kind != method and stored is not None
                luck = (keys, f"{kind} {part}") if has_luck else ()
                texts[method] = share(errors[truth][method][part], stored, *luck)
            cells = {method: errors[truth][method][part] for method in METHODS}
            marked = dict(zip(METHODS, with_best(texts, cells), strict=True))
            label_of_row = label if part == "all" else "its moving pixels"
            rows.append([label_of_row, *(marked[method] for method in methods)])
    return table(["outliers in % (coverage)", *(TITLES[m] for m in methods)], rows)


def many_keys(held_out: Any) -> str:
    """Return the table of recordings whose keys are held out, with standard errors over keys."""
    rows = []
    for label, methods in held_out.items():
        for part, title in (("all", label), ("moving", "its moving pixels")):
            cells = [methods[method][part] for method in HELD_OUT]
            texts = []
            for cell in cells:
                text = f"{100 * cell['outliers']:.2f} ± {100 * cell['error']:.2f}"
                is_known = cell["num_compared"] >= LEAST_PIXELS
                texts.append(f"{text} ({cell['coverage']:.2f})" if is_known else "–")
            num_true = cells[-1]["num_compared"] / cells[-1]["coverage"]
            rows.append([title, f"{num_true:,.0f}", *texts])
    return table(["outliers in % (coverage)", "true pixels", *HELD_OUT], rows)


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
    return table(["outliers in % (coverage)", "measured", "filled", "moving, filled"], cells)


def of_gate(stored: gate.Stored, keys: Sequence[str], figure: str) -> str:
    """Return the mean outliers and coverage of a map over keys, with luck."""
    curves = [stored.figures[key][figure] for key in keys]
    outliers = sum(outliers_at(c, coverage(c)) for c in curves) / len(keys) / 100
    covered = sum(map(coverage, curves)) / len(keys) / 100
    cell = {"num_compared": math.inf, "outliers": outliers, "coverage": covered}
    return share(cell, stored, keys, figure)


def short_cost(costs: Sequence[Sequence[str]]) -> str:
    """Return the table of the README: seconds and memory of three tasks of the table of costs."""
    labels = {
        "the very first run": "the first run above, two cameras",
        "a key of KITTI": "a key of KITTI, one camera",
        "each key of a set": "each key of a training set of KITTI, one camera",
    }
    rows = []
    for begin, label in labels.items():
        (found,) = (row for row in costs if row[0].startswith(begin))
        _, _, elapsed, memory = found
        per_worker = ", each worker" if "a worker" in memory else ""
        rows.append([label, elapsed.split(" s")[0], memory.split(" GB")[0] + per_worker])
    return table(["on two cores", "seconds", "memory in GB"], rows)


def training(networks: Any) -> str:
    """Return the table of outliers of networks that were trained on all real recordings."""
    of_kinds = networks["both"]
    rows = [[kind, *cells] for kind, cells in zip(of_kinds, best_in_bold(of_kinds), strict=True)]
    return table(["trained on", *training_titles(networks)], rows)


def trained(networks: Any) -> str:
    """Return the table of the README: networks of all real recordings on the two real tests."""
    kinds = ("single sweep held out", "rigid (ICP)", "rigid cleaned")
    kinds += ("densify measured", "densify filled")
    real = [test for test in next(iter(networks["both"].values())) if "street" not in test]
    of_kinds = {k: {t: networks["both"][k][t] for t in real} for k in kinds}
    rows = [[kind, *cells] for kind, cells in zip(of_kinds, best_in_bold(of_kinds), strict=True)]
    titles = training_titles({"both": of_kinds})
    return table(["outliers in %, trained on", *titles], rows)


def gains(networks: Any) -> str:
    """Return by how much fewer the outliers after training on densify's measured maps are."""
    of_kinds, rows = networks["both"], []
    simpler = ("single sweep held out", "single sweep IP-Basic", "rigid (ICP)", "rigid cleaned")
    for kind in simpler:
        cells = []
        for test, parts in of_kinds[kind].items():
            for part, (others, _) in parts.items():
                ours = of_kinds["densify measured"][test][part][0]
                cells.append(f"{100 * (1 - ours / others):.0f} %")
        rows.append([kind, *cells])
    return table(["instead of", *training_titles(networks)], rows)


def other_training(networks: Any) -> str:
    """Return the table of outliers of networks that were trained on other recordings."""
    rows = [
        [name, kind, *cells]
        for name, kinds in networks.items()
        if name != "both"
        for kind, cells in zip(kinds, best_in_bold(kinds), strict=True)
    ]
    return table(["recordings", "trained on", *training_titles(networks)], rows)


def training_titles(networks: Any) -> list[str]:
    """Return the titles of the columns of `training_cells`."""
    tests = next(iter(networks["both"].values()))
    return [f"{test.split(',')[0]}, {part}" for test, parts in tests.items() for part in parts]


def best_in_bold(kinds: Any) -> list[list[str]]:
    """Return outliers in % with their standard error, for each kind of maps, test and part.

    The least of a test and part is in bold, with those within two standard errors of it. None is
    if these are more than half of the kinds.
    """
    figures = [
        [both for parts in tests.values() for both in parts.values()] for tests in kinds.values()
    ]
    columns = []
    for column in zip(*figures, strict=True):
        least, least_error = min(column)
        is_best = [mean - least <= 2 * math.hypot(error, least_error) for mean, error in column]
        is_decided = sum(is_best) <= len(is_best) / 2
        columns.append(
            [
                f"**{mean:.2f}** ± {error:.2f}"
                if best and is_decided
                else f"{mean:.2f} ± {error:.2f}"
                for (mean, error), best in zip(column, is_best, strict=True)
            ]
        )
    return [list(row) for row in zip(*columns, strict=True)]


def training_figures(networks: Any) -> Any:
    """Return set -> kind of maps -> test -> part -> mean outliers in % and standard error."""
    return {
        name: {
            kind: {
                test: {
                    part: mean_and_error([100 * of[test][part]["outliers"] for of in of_seeds])
                    for part in ("all", "moving")
                }
                for test in of_seeds[0]
            }
            for kind, of_seeds in kinds.items()
        }
        for name, kinds in networks.items()
        if name
    }


ERRORS: dict[str, Callable[[Any], str]] = {
    "outliers over 3 px in % (coverage)": lambda cell: (
        f"{100 * cell['outliers']:.2f} ({cell['coverage']:.2f})"
    ),
    "outliers over 1 px in %": lambda cell: f"{100 * cell['outliers_1_px']:.2f}",
    "mean absolute error in m": lambda cell: f"{cell['mae_m']:.2f}",
}
"""Title of a table of baselines -> the text of a cell."""


def baselines(errors: Any, stored: gate.Stored) -> str:
    """Return a heading and tables for each truth, by part of the pixels; only one is unfolded."""
    blocks = []
    for truth, (title, _) in TRUTHS.items():
        first, *others = (
            table([error, *TITLES.values()], rows_of_parts(truth, errors[truth], error))
            for error in ERRORS
        )
        blocks += [f"## {title}", first, '<details markdown="1">']
        blocks.append(f"<summary>{title.split(',')[0]}: 1 px and mean absolute error</summary>")
        blocks += [*others, "</details>"]
    return "\n" + "\n\n".join(blocks) + "\n"


def rows_of_parts(truth: str, methods: Any, error: str) -> list[list[str]]:
    """Return the rows of a table of one error, one for each part of the pixels."""
    rows, left_out = [], ["not edge"]
    if truth.startswith("PandaSet"):
        left_out.append("edge")  # its truth is too sparse to have discontinuities
    for part, cell in methods[METHODS[0]].items():
        if cell["num_pixels"] < LEAST_PIXELS or part in left_out:
            continue
        cells = {method: methods[method][part] for method in METHODS}
        has_figure = {m: c["num_compared"] >= LEAST_PIXELS for m, c in cells.items()}
        texts = {m: ERRORS[error](c) if has_figure[m] else "–" for m, c in cells.items()}
        label = "discontinuities" if part == "edge" else part.replace("-", " to ")
        rows.append([f"{label} ({cell['num_pixels']:,})", *with_best(texts, cells)])
    return rows


def commands() -> str:
    """Return the options of many commands, then each command with its text and its own options."""
    parsers = [*commands_of(command_line())]
    uses = Counter(row for parser in parsers for row in options_of(parser))
    shared = {row for row, count in uses.items() if count >= 5}
    first_uses = [row for row in uses if row in shared]
    rows = sorted(first_uses, key=lambda row: ("-" in row[0][:1], row[0].startswith("--json")))
    overview = [[f"[`{p.prog}`](#{p.prog.replace(' ', '-')})", summary(p)] for p in parsers]
    blocks = [table(["command", "to"], overview)]
    blocks += ["## Common options", table(["option", "meaning"], coded(rows))]
    for parser in parsers:
        own = [row for row in options_of(parser) if row not in shared]
        common = [
            f"`{spelled(action).split()[0] if action.option_strings else spelled(action)}`"
            for action in actions_of(parser)
            if row_of(action) in shared
        ]
        blocks += [f"## {parser.prog}", plain(parser.description)]
        blocks += [table(["option", "meaning"], coded(own))] if own else []
        blocks += [f"[Common options](#common-options): {', '.join(common)}."]
        blocks += [plain(parser.epilog)] if parser.epilog else []
    return "\n" + "\n\n".join(blocks) + "\n"


def summary(parser: argparse.ArgumentParser) -> str:
    """Return the first clause of a command's description."""
    first = re.split(r"[.:;](?:\s|$)", plain(parser.description))[0]
    return first[:1].lower() + first[1:]


def commands_of(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parser of a command, or those of the commands in its group."""
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    for choices in groups:
        for command in choices.choices.values():
            yield from commands_of(command)
    if not groups:
        yield parser


def actions_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the arguments of a command but ``--help``, positional ones first, ``--json`` last."""
    actions = [action for action in parser._actions if "-h" not in action.option_strings]
    return sorted(actions, key=lambda a: (bool(a.option_strings), "--json" in a.option_strings))


def options_of(parser: argparse.ArgumentParser) -> list[tuple[str, str]]:
    """Return how each argument of a command is written, and its meaning."""
    return [row_of(action) for action in actions_of(parser)]


def row_of(action: argparse.Action) -> tuple[str, str]:
    """Return how an argument is written, and its meaning; recordings alike for one and several."""
    usage = spelled(action)
    return usage.removesuffix(" …") if action.metavar == "SPEC" else usage, plain(action.help)


def coded(rows: Sequence[tuple[str, str]]) -> list[list[str]]:
    """Return rows of a table with the option as code."""
    return [[make_api.code(usage), meaning] for usage, meaning in rows]


def plain(text: str | None) -> str:
    """Return a text without marks of Markdown, and without the folder of the installed settings."""
    text = re.sub(r"\S+/(default\.yaml)", r"configs/\1", text or "")
    return re.sub(r"[|*\[\]]", r"\\\g<0>", text).replace("<", "&lt;")


def spelled(action: argparse.Action) -> str:
    """Return an option with the name of its value or its choices, as it is written."""
    value = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.metavar
    value = "" if action.nargs == 0 else str(value or action.dest.upper())
    value += " …" if action.nargs in ("+", "*") else ""
    return " ".join(filter(None, [*action.option_strings, value]))


def settings() -> str:
    """Return the file of all settings as a block of code."""
    return f"\n```yaml\n{(ROOT / 'configs/default.yaml').read_text()}```\n"


def with_tables(page: str) -> str:
    """Return the text of a page with its tables made again."""
    numbers, stored = json.loads(NUMBERS.read_text()), gate.read(ROOT / "tests/gate.json")
    of_errors = {f.__name__: f for f in (headline, comparison, judged, baselines)}
    of_training = {f.__name__: f for f in (training, gains, other_training, trained)}
    of_code = {f.__name__: f for f in (commands, settings, make_api.api)}

    def made(found: re.Match[str]) -> str:
        name = found[2]
        if name == "cost":
            text = table(["task", "CPU", "elapsed", "memory"], numbers["cost"])
        elif name == "short_cost":
            text = short_cost(numbers["cost"])
        elif name in of_code:
            text = of_code[name]()
        elif name == "many_keys":
            text = many_keys(numbers["held_out"])
        elif name in of_training:
            text = of_training[name](numbers["training"])
        else:
            text = of_errors[name](numbers["baselines"], stored)
        return f"{found[1]}{text}\n{found[3]}"

    return MARKED.sub(made, page)


def main() -> None:
    """Store the errors that are given, and write the tables of all pages."""
    for name in sys.argv[1:]:
        measured, numbers = json.loads(Path(name).read_text()), json.loads(NUMBERS.read_text())
        for name, kinds in training_figures(measured.get("networks", {})).items():
            numbers["training"].setdefault(name, {}).update(kinds)
        for truth in TRUTHS.keys() & measured.keys():
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
