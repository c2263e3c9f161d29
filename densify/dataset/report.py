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
    """Write ``compare.html`` of the comparison in a key sweep's folder, and return its path."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the HTML pages of a folder and return their paths.

    The folder is that of a run, a comparison, a training set, or of a recording with one key sweep.
    Raise InputError for other folders, or if a page exists and ``overwrite`` is False.
    """
    pages = _pages(folder)
    for path in pages:
        if path.exists() and not overwrite:
            raise InputError(f"{path}: already there and kept; give --overwrite to replace it")
    for path, make in pages.items():
        write_file(path, make())
    return list(pages)


def _pages(folder: Path) -> dict[Path, Callable[[], bytes]]:
    """Return path -> function that makes the page, for each page of a folder."""
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such folder; expected what densify run, compare or dataset wrote"
        )
    makers: dict[str, tuple[str, Callable[[], bytes]]] = {
        "run.yaml": ("report.html", lambda: key_page(KeyFiles.of_run(folder), str(folder))),
        "compare.json": ("compare.html", lambda: key_page(KeyFiles.of_comparison(folder), "")),
    }
    if (folder / "dataset.json").is_file():
        return {folder / "report.html": lambda: set_page(folder)}
    pages = {
        folder / page: make for name, (page, make) in makers.items() if (folder / name).is_file()
    }
    if pages:
        return pages
    inside = [
        path for path in sorted(folder.iterdir()) if any((path / name).is_file() for name in makers)
    ]
    if len(inside) == 1:
        return _pages(inside[0])
    content = f"{len(inside)} keys; name one of them" if inside else "none of these"
    raise InputError(
        f"{folder}: holds {content}; expected the folder of a key, such as "
        f"densify-out/street/000120, or a training set"
    )
