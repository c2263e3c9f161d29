# SPDX-License-Identifier: MIT
"""Write HTML pages: ``report.html`` of a run or training set, ``compare.html`` of a comparison."""

from __future__ import annotations

import base64
import html
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.plan import planned_keys, read_plan
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import metres, read_stored
from densify.outputs.plots import colour_depth, score_figure
from densify.outputs.report_page import KeyFiles, key_page

_NUM_WORST, _NUM_SPREAD = 6, 18  # keys with pictures: the worst, and others spread over the set
_NUM_LISTED = 1000  # rows of the table of keys, the worst first
_THUMBNAIL_PX = 320  # width of a picture
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 80]


class _Score(NamedTuple):
    """A score of a key that the page shows."""

    title: str
    unit: str
    of: Callable[[KeyRecord], float | None]  # the value in ``unit``, None if unknown
    is_bad: float  # 1 if a high value is bad, -1 if a low value is, 0 if neither


def _percent(name: str) -> Callable[[KeyRecord], float | None]:
    """Return a function of a record: the mean over cameras of one of its scores, in percent."""

    def of(record: KeyRecord) -> float | None:
        values = record.values_of(name)
        return 100 * float(np.mean(values)) if values else None

    return of


_SCORES = (
    _Score("Ghosts", "%", _percent("ghost"), 1),
    _Score("Held-out outliers", "%", _percent("outliers"), 1),
    _Score("Pixels with measured depth", "%", _percent("density"), -1),
    _Score("Pixels with filled depth", "%", _percent("density_filled"), -1),
    _Score("Computing time", "s", lambda record: record.seconds, 0),
)


def _set_page(root: Path) -> bytes:
    """Return the bytes of the page of a training set in a folder."""
    table, records = read_plan(root) or {}, list(read_manifests(root).values())
    done = [record for record in records if record.status == "done"]
    left_out = [record for record in records if record.status != "done"]
    worst_first = sorted(done, key=_badness(done), reverse=True)
    num_to_make = len(planned_keys(table) - {record.name for record in records})
    parts = {
        "title": html.escape(root.resolve().name),
        "summary": _summary(records, num_to_make),
        "recipe": _facts(table),
        "plots": "\n".join(_plot(score, done) for score in _SCORES),
        "keys": "\n".join(_card(root, record) for record in _pictured(worst_first)),
        "left_out": _table(("recording", "key", "status", "reason"), map(_reason_row, left_out)),
        "listed": _table(
            (
                "recording",
                "key",
                *(f"{score.title}, {score.unit}" for score in _SCORES),
                "warnings",
            ),
            map(_score_row, worst_first[:_NUM_LISTED]),
        ),
    }
    page = (package_files("densify.outputs") / "page" / "set.html").read_text("utf-8")
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)
    return filled.encode("utf-8", "backslashreplace")


def _badness(records: Sequence[KeyRecord]) -> Callable[[KeyRecord], float]:
    """Return a function of a record: its worst rank, 0 to 1, among all records and scores."""
    ranks: dict[tuple[str, int], float] = {}
    for score in _SCORES:
        values = [(record.name, score.of(record)) for record in records]
        known = sorted((score.is_bad * value, name) for name, value in values if value is not None)
        for rank, (_, name) in enumerate(known if score.is_bad else [], start=1):
            ranks[name] = max(ranks.get(name, 0.0), rank / len(known))
    return lambda record: ranks.get(record.name, 0.0)


def _pictured(worst_first: Sequence[KeyRecord]) -> list[KeyRecord]:
    """Return the worst keys, then others that are spread evenly over the set."""
    others = sorted(worst_first[_NUM_WORST:], key=lambda record: record.name)
    step = max(1, len(others) // _NUM_SPREAD)
    return [*worst_first[:_NUM_WORST], *others[::step][:_NUM_SPREAD]]


def _summary(records: Sequence[KeyRecord], num_to_make: int) -> str:
    """Return how many keys the set has, and what they cost."""
    counts = Counter[str](record.status for record in records)
    names = {"done": "done", "aside": "put aside", "failed": "failed"}
    parts = [f"{counts[status]:,} {name}" for status, name in names.items() if counts[status]]
    parts += [f"{num_to_make:,} to make"] if num_to_make else []
    seconds = [record.seconds for record in records if record.status == "done"]
    cost = f"{np.mean(seconds):.1f} s a key, {sum(seconds) / 60:.1f} min in all" if seconds else ""
    return html.escape("; ".join(filter(None, [", ".join(parts), cost])))


def _facts(table: Mapping[str, Any]) -> str:
    """Return the recipe of the set as rows of a table."""
    facts = {name: value for name, value in table.items() if name not in ("drives", "config")}
    return _table(("recipe", ""), facts.items())


def _plot(score: _Score, records: Sequence[KeyRecord]) -> str:
    """Return the histogram and the timeline of a score as SVG, "" without values."""
    values = [score.of(record) for record in records]
    if all(value is None for value in values):
        return ""
    return score_figure(score.title, score.unit, np.array(values, float))


def _card(root: Path, record: KeyRecord) -> str:
    """Return the pictures of a key with its scores, and a link to its own page or map."""
    pictures = []
    for kinds, draw in (
        (("depth_filled", "groundtruth_filled"), _depth_picture),
        (("confidence",), _confidence_picture),
    ):
        path = next((root / file for file in record.files if {*kinds} & {*Path(file).parts}), None)
        if path is not None:
            try:
                pictures.append(_image(draw(path), kinds[0]))
            except InputError as error:
                pictures.append(f"<p>{html.escape(str(error))}</p>")
    pages = [name for name in record.files if name.endswith("report.html")]
    maps = [name for name in record.files if name.endswith(".png")]
    link = quote(next(iter([*pages, *maps]), ""))
    scores = ", ".join(
        f"{score.title.lower()} {_text(value)} {score.unit}"
        for score in _SCORES
        if (value := score.of(record)) is not None
    )
    name = html.escape(f"{record.drive}, key {record.key}")
    return (
        f'<figure><figcaption><a href="{link}">{name}</a><br>{html.escape(scores)}</figcaption>'
        f"{''.join(pictures)}</figure>"
    )


def _depth_picture(path: Path) -> NDArray[np.uint8]:
    return colour_depth(metres(_small(read_stored(path, np.uint16, "a depth map"))))


def _confidence_picture(path: Path) -> NDArray[np.uint8]:
    stored = _small(read_stored(path, np.uint8, "a map of confidence"))
    picture = np.asarray(cv2.applyColorMap(stored, cv2.COLORMAP_TURBO), np.uint8)
    picture[stored == 0] = 0
    return picture


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map with every n-th row and column, about as wide as a picture."""
    step = max(1, values.shape[1] // _THUMBNAIL_PX)
    return np.ascontiguousarray(values[::step, ::step])


def _image(picture: NDArray[np.uint8], kind: str) -> str:
    data = base64.b64encode(cv2.imencode(".jpg", picture, _JPEG)[1].tobytes()).decode()
    return f'<img alt="{kind}" src="data:image/jpeg;base64,{data}">'


def _reason_row(record: KeyRecord) -> tuple[Any, ...]:
    return record.drive, record.key, record.status, record.reason


def _score_row(record: KeyRecord) -> tuple[Any, ...]:
    scores = [score.of(record) for score in _SCORES]
    return record.drive, record.key, *scores, "; ".join(record.warnings)


def _table(heads: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return the rows of a table with its head, "" without rows."""
    body = [f"<tr>{''.join(f'<td>{html.escape(_text(v))}</td>' for v in row)}</tr>" for row in rows]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    return "\n".join([f"<tr>{head}</tr>", *body]) if body else ""


def _text(value: Any) -> str:
    """Return a value as people read it: floats with two or three digits."""
    if isinstance(value, float):
        return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2g}"
    return "" if value is None else str(value)


def write_comparison_page(folder: Path) -> Path:
    """Write ``compare.html`` of the comparison in a key sweep's folder, and return its path."""
    page = folder / "compare.html"
    write_file(page, key_page(KeyFiles.of_comparison(folder), ""))
    return page


def write_report(folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the HTML pages of a run, comparison or training set, and return their paths.

    InputError is raised if the folder holds none of these, or if a page exists that ``overwrite``
    does not allow to replace.
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
        return {folder / "report.html": lambda: _set_page(folder)}
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
