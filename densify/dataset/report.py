# SPDX-License-Identifier: MIT
"""Write HTML pages: ``report.html`` of a run or training set, ``compare.html`` of a comparison."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from densify.config.errors import InputError
from densify.dataset.set_page import set_page
from densify.outputs.atomic import write_file
from densify.outputs.report_page import KeyFiles, key_page


def write_comparison_page(folder: Path) -> Path:
    """Write ``compare.html`` into the folder of a key sweep and return its path."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(place: Path, overwrite: bool = False) -> list[Path]:
    """Write the HTML pages of a folder, or of the only key sweep in it, and return their paths."""
    pages = _pages(place)
    for path in pages:
        if path.exists() and not overwrite:
            raise InputError(f"{path}: already there and kept; give --overwrite to replace it")
    for path, make in pages.items():
        write_file(path, make())
    return list(pages)


def _pages(place: Path) -> dict[Path, Callable[[], bytes]]:
    if not place.is_dir():
        raise InputError(
            f"{place}: no such folder; expected what densify run, compare or dataset wrote"
        )
    if (place / "dataset.json").is_file():
        return {place / "report.html": lambda: set_page(place)}
    pages: dict[Path, Callable[[], bytes]] = {}
    if (place / "run.yaml").is_file():
        pages[place / "report.html"] = lambda: key_page(KeyFiles.of_run(place), str(place))
    if (place / "compare.json").is_file():
        pages[place / "compare.html"] = lambda: key_page(KeyFiles.of_comparison(place), "")
    if pages:
        return pages
    names = ("run.yaml", "compare.json")
    inside = [p for p in sorted(place.iterdir()) if any((p / name).is_file() for name in names)]
    if len(inside) == 1:
        return _pages(inside[0])
    found = f"{len(inside)} keys; name one of them" if inside else "none of these"
    raise InputError(
        f"{place}: holds {found}; expected the folder of a key, such as "
        f"densify-out/street/000120, or a training set"
    )
