# SPDX-License-Identifier: MIT
"""Pages in their places: ``report.html`` of a run or a training set, ``compare.html`` of a
comparison. The page of a training set is one table."""

from __future__ import annotations

import html
import os
import re
import urllib.parse
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from densify import __version__
from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.plan import planned_keys, read_plan
from densify.geometry.types import Result
from densify.outputs.atomic import write_file
from densify.outputs.key_outputs import Context
from densify.outputs.report.key_page import KeyFiles, key_page

_SHOWN_MAP = re.compile(r"(^|/)(proj_depth/groundtruth|\d{6,}/depth)/[^/]+(/[^/]+)?\.png")
_WHOLE = ("num_points", "num_moving", "ghost")
_PER_CAMERA = ("density", "density_filled", "outliers", "mae_m")
_STATUSES = ("failed", "aside", "done")
_PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>{title}</title>
<style>body {{font: 14px sans-serif}} td, th {{padding: 2px 8px; text-align: left}}
tr:nth-child(even) {{background: #eee}}</style>
<h1>{title}</h1>
<p>{counts}</p>
<table>{about}</table>
<table><thead><tr>{heads}</tr></thead>
<tbody>
{rows}
</tbody></table>
<p>densify {version}; links lead to the files beside this page.</p>
</html>
"""


def write_output(result: Result, context: Context, folder: Path) -> None:
    """Write ``report.html`` of the files of the other outputs, where ``output.report`` asks."""
    if context.config.get("output", {}).get("report"):
        page = key_page(KeyFiles.of_run(folder), f"{result.key:06d}")
        write_file(folder / "report.html", page)


def write_comparison_page(folder: Path) -> Path:
    """Write ``compare.html`` of a key's folder."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(place: Path, out: Path | None = None, overwrite: bool = False) -> list[Path]:
    """Make the page or pages of what lies in a folder; return them.

    place: a key's folder of ``run`` or ``compare``, such as densify-out/000120, the folder above
        it if it holds no other, or a training set.
    out: the file to write; if None ``report.html`` of a run or a set, ``compare.html`` of a
        comparison, beside their files. overwrite: replace an earlier page.

    The page tells what is damaged or missing. Raises InputError for a folder that is none of these,
    one whose main files are damaged, and a page that is there already, OutputError if it cannot be
    written.
    """
    pages = _pages(place)
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
        write_file(path, page)
    return list(places)


def _pages(place: Path) -> dict[Path, Callable[[Path], bytes]]:
    """Return path -> what makes the page for the folder it will be in."""
    if not place.is_dir():
        raise InputError(
            f"{place}: no such folder; expected what densify run, compare or dataset wrote"
        )
    if (place / "dataset.json").is_file():
        return {place / "report.html": lambda there: _set_page(place, there)}
    pages: dict[Path, Callable[[Path], bytes]] = {}
    if (place / "run.yaml").is_file():
        pages[place / "report.html"] = lambda _: key_page(KeyFiles.of_run(place), str(place))
    if (place / "compare.json").is_file():
        pages[place / "compare.html"] = lambda _: key_page(KeyFiles.of_comparison(place), "")
    if pages:
        return pages
    names = ("run.yaml", "compare.json")
    inside = [p for p in sorted(place.iterdir()) if any((p / name).is_file() for name in names)]
    if len(inside) == 1:
        return _pages(inside[0])
    found = f"{len(inside)} keys; name one of them" if inside else "none of these"
    raise InputError(
        f"{place}: holds {found}; expected the folder of a key, such as densify-out/000120, or a "
        f"training set"
    )


def _set_page(root: Path, shown_from: Path) -> bytes:
    """Return the page of a training set: its keys, the failed ones and those with the highest
    ghost rate first. shown_from: the folder to which links are relative."""
    table = read_plan(root)
    if table is None:
        raise InputError(f"{root}: no dataset.json in it; expected a training set's folder")
    records = read_manifests(root)
    cameras = sorted({camera for r in records.values() for camera in r.scores.get("density", ())})
    limits = [f"{name} {limit}" for name, limit in table["gate"].items() if limit is not None]
    about = {
        **{name: table[name] for name in ("layout", "method", "window", "densify")},
        "quality gate": ", ".join(limits) or "none",
        "recordings": ", ".join(table["drives"]),
        "configuration": table["config"],
    }
    counts: Counter[str] = Counter(record.status for record in records.values())
    counts["to make"] = len(planned_keys(table) - records.keys())
    heads = ["recording", "key", "status", "reason or warnings", "sweeps", "seconds", *_WHOLE]
    heads += [f"{name} {camera}" for camera in cameras for name in _PER_CAMERA]
    ordered = sorted(records.values(), key=_badness)
    page = _PAGE.format(
        title=html.escape(f"{root.resolve().name}: {len(records):,} keys"),
        counts=", ".join(f"{number:,} {status}" for status, number in counts.items()),
        about=_rows([name, html.escape(str(value))] for name, value in about.items()),
        heads="".join(f"<th>{html.escape(head)}</th>" for head in heads),
        rows=_rows(_cells(record, cameras, root, shown_from) for record in ordered),
        version=__version__,
    )
    return page.encode("utf-8", "backslashreplace")


def _badness(record: KeyRecord) -> tuple[Any, ...]:
    """Return what records are ordered by."""
    return _STATUSES.index(record.status), -_number(record.scores.get("ghost")), record.name


def _rows(rows: Iterable[Sequence[str]]) -> str:
    """Return rows of a table, of cells in HTML."""
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return "\n".join(f"<tr>{row}</tr>" for row in cells)


def _cells(record: KeyRecord, cameras: Sequence[str], root: Path, shown_from: Path) -> list[str]:
    """Return the row of a key in HTML. Its number links to the first camera's depth map, or to the
    key's own page."""
    key, shown = str(record.key), _first_map(record, root)
    if shown is not None:
        pages = [p.parent / "report.html" for p in shown.parents if p.name == "depth"]
        linked = next((page for page in pages if page.is_file()), shown)
        relative = os.path.relpath(linked.resolve(), shown_from.resolve())
        key = f'<a href="{urllib.parse.quote(Path(relative).as_posix())}">{key}</a>'
    values = [record.scores.get(name) for name in _WHOLE]
    for camera in cameras:
        values += [(record.scores.get(name) or {}).get(camera) for name in _PER_CAMERA]
    reason = record.reason or "; ".join(record.warnings)
    numbers = [len(record.frames), record.seconds, *values]
    return [
        html.escape(record.drive),
        key,
        record.status,
        html.escape(reason),
        *("" if value is None else f"{_number(value):.5g}" for value in numbers),
    ]


def _first_map(record: KeyRecord, root: Path) -> Path | None:
    """Return the depth map of the first camera; names that lead out of the set are none."""
    names = sorted(name for name in record.files if _SHOWN_MAP.search(name))
    inside = [n for n in names if not PurePosixPath(n).is_absolute() and ".." not in Path(n).parts]
    return root / inside[0] if inside else None


def _number(value: Any) -> float:
    return value if isinstance(value, int | float) else 0.0
