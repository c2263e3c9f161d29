# SPDX-License-Identifier: MIT
"""Pages in their places: ``report.html`` of a run or a training set, ``compare.html`` of a
comparison."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from densify.config.errors import InputError, OutputError
from densify.dataset.set_page import runs_page, set_page
from densify.geometry.types import Progress, Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.report.key_files import KeyFiles
from densify.outputs.report.key_page import key_page


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


def write_report(
    place: Path,
    out: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Make the page or pages of what lies in a folder; returns them.

    place: a key's folder of ``run`` or ``compare``, such as densify-out/000120, the folder above
    some of them, or a training set. out: the file to write; ``report.html`` of a run or a set,
    ``compare.html`` of a comparison, beside their files, if None. overwrite: replace an earlier
    page.

    What is damaged or missing is said on the page. Raises InputError for a folder that is none of
    these, one whose main files are damaged, and a page that is there already, OutputError if it
    cannot be written.
    """
    pages = _pages(place, progress)
    if out is not None and len(pages) > 1:
        names = ", ".join(path.name for path in pages)
        raise InputError(f"--out {out}: {place} has {len(pages)} pages ({names}); leave --out away")
    places = {path if out is None else out: make for path, make in pages.items()}
    for path in places:
        if path.exists() and not overwrite:
            raise InputError(
                f"{path}: already there and kept; give --overwrite to replace it, or --out"
            )
    for path, make in places.items():
        page = make(path.parent)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, page)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return list(places)


def _pages(place: Path, progress: Progress | None) -> dict[Path, Callable[[Path], bytes]]:
    """Path -> what makes the page for the folder it will be in."""
    if not place.is_dir():
        raise InputError(
            f"{place}: no such folder; expected what densify run, compare or dataset wrote"
        )
    if (place / "dataset.json").is_file():
        return {place / "report.html": lambda there: set_page(place, there, progress)}
    pages: dict[Path, Callable[[Path], bytes]] = {}
    if (place / "run.yaml").is_file():
        pages[place / "report.html"] = lambda _: key_page(KeyFiles.of_run(place), str(place))
    if (place / "compare.json").is_file():
        pages[place / "compare.html"] = lambda _: key_page(KeyFiles.of_comparison(place), "")
    if pages:
        return pages
    inside = [p for p in sorted(place.iterdir()) if p.is_dir()]
    runs = [p for p in inside if (p / "run.yaml").is_file()]
    compared = [p for p in inside if p not in runs and (p / "compare.json").is_file()]
    if len(runs) + len(compared) == 1:
        return _pages((runs + compared)[0], progress)
    if not runs:
        found = f"{len(compared)} comparisons; name one of them" if compared else "none of these"
        raise InputError(
            f"{place}: holds {found}; expected the folder of a key, such as densify-out/000120, "
            f"one of several, or a training set"
        )
    return {place / "report.html": lambda there: runs_page(place, runs, there, progress)}
