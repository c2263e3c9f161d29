# SPDX-License-Identifier: MIT
"""Write HTML pages: ``report.html`` of a run or training set, ``compare.html`` of a comparison."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.plan import planned_keys, read_plan
from densify.outputs.atomic import write_file
from densify.outputs.report.key_page import KeyFiles, key_page

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
<table><thead>{heads}</thead>
<tbody>
{rows}
</tbody></table>
</html>
"""


def write_comparison_page(folder: Path) -> Path:
    """Write ``compare.html`` into the folder of a key sweep and return its path."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the HTML pages of a folder, or of the only key sweep in it, and return their paths."""
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
        return {folder / "report.html": lambda: _set_page(folder)}
    pages = {
        folder / page: make for name, (page, make) in makers.items() if (folder / name).is_file()
    }
    if pages:
        return pages
    inside = [p for p in sorted(folder.iterdir()) if any((p / name).is_file() for name in makers)]
    if len(inside) == 1:
        return _pages(inside[0])
    content = f"{len(inside)} keys; name one of them" if inside else "none of these"
    raise InputError(
        f"{folder}: holds {content}; expected the folder of a key, such as "
        f"densify-out/street/000120, or a training set"
    )


def _set_page(root: Path) -> bytes:
    """Return the bytes of a training set's page: failed keys first, then the most ghosts."""
    table, records = read_plan(root) or {}, read_manifests(root)
    counts = Counter[str](record.status for record in records.values())
    counts["to make"] = len(planned_keys(table) - records.keys())
    keys = [_row(record) for record in sorted(records.values(), key=_badness)]
    heads = dict.fromkeys(head for row in keys for head in row)
    page = _PAGE.format(
        title=html.escape(f"{root.resolve().name}: {len(records):,} keys"),
        counts=", ".join(f"{number:,} {status}" for status, number in counts.items()),
        about=_rows((name, table[name]) for name in table if name != "drives"),
        heads=_rows([heads]),
        rows=_rows([row.get(head) for head in heads] for row in keys),
    )
    return page.encode("utf-8", "backslashreplace")


def _badness(record: KeyRecord) -> tuple[Any, ...]:
    """Return a sort key: failed first, then aside, then the highest ghost rate."""
    ghost = record.scores.get("ghost")
    share = ghost if isinstance(ghost, int | float) else 0.0
    return _STATUSES.index(record.status), -share, record.name


def _row(record: KeyRecord) -> dict[str, Any]:
    """Return column title -> cell for the row of a key sweep."""
    row = {
        "recording": record.drive,
        "key": record.key,
        "status": record.status,
        "reason or warnings": record.reason or "; ".join(record.warnings),
        "sweeps": len(record.frames),
        "seconds": record.seconds,
    }
    for name, score in record.scores.items():
        by_camera = score.items() if isinstance(score, dict) else [("", score)]
        row |= {f"{name} {camera}".rstrip(): value for camera, value in by_camera}
    return row


def _rows(rows: Iterable[Iterable[Any]]) -> str:
    cells = ("".join(f"<td>{html.escape(_text(value))}</td>" for value in row) for row in rows)
    return "\n".join(f"<tr>{row}</tr>" for row in cells)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return "" if value is None else str(value)
