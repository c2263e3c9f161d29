# SPDX-License-Identifier: MIT
"""Pages in their places: ``report.html`` of a run, ``compare.html`` of a comparison."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from densify.errors import InputError, OutputError
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.report.key_files import KeyFiles
from densify.report.key_page import key_page
from densify.types import Result


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``report.html``, of the files that the other outputs wrote, where ``output.report`` asks."""
    if context.config.get("output", {}).get("report"):
        page = key_page(KeyFiles.of_run(folder), f"{result.key:06d}")
        write_file(folder / "report.html", page)


def write_comparison_page(folder: Path) -> Path:
    """``compare.html`` of a key's folder."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(place: Path, out: Path | None = None, overwrite: bool = False) -> list[Path]:
    """Make the page or pages of what lies in a folder; returns them.

    place: a key's folder of ``run`` or ``compare``, such as densify-out/000120, or the folder above
    a single one. out: the file to write; ``report.html`` of a run and ``compare.html`` of a
    comparison, beside their files, if None. overwrite: replace an earlier page.

    What is damaged or missing is said on the page. Raises InputError for a folder that is none of
    these, one whose main files are damaged, and a page that is there already, OutputError if it
    cannot be written.
    """
    pages = _pages(place)
    if out is not None and len(pages) > 1:
        names = ", ".join(path.name for path in pages)
        raise InputError(f"--out {out}: {place} has {len(pages)} pages ({names}); leave --out away")
    written = []
    for path, make in pages.items():
        path = path if out is None else out
        if path.exists() and not overwrite:
            raise InputError(
                f"{path}: already there and kept; give --overwrite to replace it, or --out"
            )
        page = make()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, page)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
        written.append(path)
    return written


def _pages(place: Path) -> dict[Path, Callable[[], bytes]]:
    """Path -> what makes the page."""
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; expected what densify run or compare wrote")
    pages: dict[Path, Callable[[], bytes]] = {}
    if (place / "run.yaml").is_file():
        pages[place / "report.html"] = lambda: key_page(KeyFiles.of_run(place), str(place))
    if (place / "compare.json").is_file():
        pages[place / "compare.html"] = lambda: key_page(KeyFiles.of_comparison(place), "")
    if pages:
        return pages
    inside = [p for p in sorted(place.iterdir()) if p.is_dir() and _is_key(p)]
    if len(inside) == 1:
        return _pages(inside[0])
    found = f"{len(inside)} keys, of which one is to be named" if inside else "none of these"
    raise InputError(
        f"{place}: holds {found}; expected the folder of a key, such as densify-out/000120"
    )


def _is_key(folder: Path) -> bool:
    return (folder / "run.yaml").is_file() or (folder / "compare.json").is_file()
