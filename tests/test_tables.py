# SPDX-License-Identifier: MIT
"""The pages quote the figures of docs/numbers.json and tests/gate.json, and nothing else."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

import densify

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
QUOTED = re.compile(r"\[(\d[^\]]*)\]\(([^)#]*)#([^)]*)\)")  # [20 s](results.md#cost)
COST = re.compile(r"\d[\d.]* (?:s|minutes|GB|KISS)\b")


@pytest.fixture(scope="module")
def maker() -> Any:
    spec = spec_from_file_location("make_tables", ROOT / "docs/make_tables.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def section(page: Path, anchor: str) -> str:
    """The text below the heading with this anchor."""
    parts = re.split(r"^#+ (.*)\n", page.read_text(), flags=re.MULTILINE)
    headings = (re.sub(r"[^\w -]", "", heading.lower()) for heading in parts[1::2])
    return dict(zip((h.replace(" ", "-") for h in headings), parts[2::2], strict=True))[anchor]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_figures_are_those_of_their_table(page: Path, maker: Any) -> None:
    text = page.read_text()
    assert maker.with_tables(text) == text, "run: python docs/make_tables.py"
    for figure, path, anchor in QUOTED.findall(text):
        table = section(page.parent / path if path else page, anchor)
        assert re.search(rf"(?<![\d.]){re.escape(figure)}(?![\d.])", table), (figure, path, anchor)


@pytest.mark.parametrize("name", ("README.md", "docs/questions.md", "docs/first-recording.md"))
def test_costs_are_links_to_their_table(name: str) -> None:
    prose = re.sub(r"```.*?```", "", (ROOT / name).read_text(), flags=re.DOTALL)
    assert not COST.findall(QUOTED.sub("", prose))


def test_bold_marks_a_decided_column_only(maker: Any) -> None:
    def bold(*means: float) -> list[bool]:
        kinds = {str(i): {"test": {"all": (mean, 0.1)}} for i, mean in enumerate(means)}
        return [cell.startswith("**") for (cell,) in maker.best_in_bold(kinds)]

    assert bold(1.0, 2.0, 3.0, 4.0) == [True, False, False, False]
    assert bold(1.0, 1.2, 3.0, 4.0) == [True, True, False, False]
    assert bold(1.0, 1.2, 1.1, 4.0) == [False] * 4


def test_the_page_of_the_api_has_every_public_name() -> None:
    page = (ROOT / "docs/api.md").read_text()
    names = set(dir(densify)) - {"Config", "__version__"}
    assert names <= set(re.findall(r"^### (\w+)$", page, re.MULTILINE))


def test_bold_needs_a_quarter_of_the_greatest_coverage(maker: Any) -> None:
    covered = {"single sweep": 0.1, "rigid (ICP)": 0.8, "rigid, cleaned": 0.19}
    cells = {method: {"coverage": covered.get(method, 0.4)} for method in maker.METHODS}
    texts = dict(zip(maker.METHODS, ("0.1", "9.0", "0.2", "3.0", "–", "2.0", "2.00"), strict=True))
    assert maker.with_best(texts, cells) == [
        "0.1",
        "9.0",
        "0.2",
        "**3.0**",
        "–",
        "**2.0**",
        "**2.00**",
    ]


def test_a_share_of_few_pixels_is_no_figure(maker: Any) -> None:
    cell = {"num_compared": 199, "coverage": 0.01, "outliers": 0.0, "mae_m": 0.1}
    methods = {method: {"all": cell | {"num_pixels": 300}} for method in maker.METHODS}
    assert maker.share(cell, None) == "–"
    assert (
        maker.rows_of_parts("street, exact", methods, "mean absolute error in m")[0][1:]
        == ["–"] * 7
    )
