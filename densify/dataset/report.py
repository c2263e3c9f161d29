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

import numpy as np
import yaml
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.dataset.manifest import (
    USUAL_SHARES,
    KeyRecord,
    describe_pace,
    describe_rest,
    read_manifests,
)
from densify.dataset.pictures import (
    FILLED,
    PICTURE_FOLDER,
    draw_depth,
    find_map,
    front_camera,
    shrink,
    small_image,
)
from densify.dataset.plan import Drive, drives_of, planned_keys, read_plan
from densify.geometry.types import METHOD_NAMES
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import Picture, encode_jpeg, metres, read_stored
from densify.outputs.plots import Dot, score_plot
from densify.outputs.report_page import KeyFiles, key_page

_NUM_WORST, _NUM_SPREAD = 6, 18  # keys with pictures: the worst, and others spread over the set
_NUM_ASIDE = 12  # keys with pictures among those put aside
_NUM_LISTED = 1000  # rows of the table of keys, the worst first
_NUM_DOTS = 1000  # of a plot, half of them the worst keys
_QUALITY = 80
_LEAST_GRAY = 40  # of confidence 0; black is no depth
_MANY_ASIDE = 0.1  # a greater share of keys put aside or failed is reported in the verdict


class _Score(NamedTuple):
    """A score of a key that the page shows."""

    name: str  # name in a manifest line
    title: str
    unit: str
    of: Callable[[KeyRecord], float | None]  # the value in ``unit``, None if unknown
    is_bad: float  # 1 if a high value is bad, -1 if a low value is, 0 if neither
    limit: str = ""  # name of the limit in the recipe
    usual: tuple[float, float] | None = None  # range on KITTI, in ``unit``


def _percent(name: str) -> Callable[[KeyRecord], float | None]:
    """Return a function of a record: the mean over cameras of one of its scores, in percent."""

    def of(record: KeyRecord) -> float | None:
        values = record.values_of(name)
        return 100 * float(np.mean(values)) if values else None

    return of


def _share(name: str, title: str, is_bad: float, limit: str = "") -> _Score:
    """Return a score that is a share."""
    low, high = USUAL_SHARES[name]
    return _Score(name, title, "%", _percent(name), is_bad, limit, (100 * low, 100 * high))


_SCORES = (
    _share("ghost", "Ghosts", 1, "max_ghost"),
    _share("outliers", "Held-out outliers", 1, "max_outliers"),
    _share("density", "Measured depth", -1, "min_density"),
    _share("density_filled", "Filled depth", -1),
    _Score("seconds", "Computing time", "s", lambda record: record.seconds, 0),
)


class _Set(NamedTuple):
    """The content of a training set, from which the parts of its page are made."""

    root: Path
    table: Mapping[str, Any]  # content of dataset.json
    drives: Mapping[str, Drive]
    records: Sequence[KeyRecord]  # ordered by recording and frame
    worst_first: Sequence[KeyRecord]  # the keys that are done
    worst_score: Mapping[tuple[str, int], str]  # key -> name of the score that ranks it
    scores: Sequence[_Score]  # the scores that a key of the set has

    def values(self, score: _Score) -> list[float]:
        """Return the known values of a score of the keys that are done."""
        return [value for record in self.worst_first if (value := score.of(record)) is not None]

    def name_of(self, record: KeyRecord) -> str:
        """Return a key's name, with the recording if there are several."""
        return f"{record.drive}, key {record.key}" if len(self.drives) > 1 else f"key {record.key}"


def _read_set(root: Path) -> _Set:
    table = read_plan(root) or {}
    drives = drives_of(table)
    records = [record for record in read_manifests(root).values() if record.drive in drives]
    done = [record for record in records if record.status == "done"]
    ranks: dict[tuple[str, int], tuple[float, str]] = {}
    for score in _SCORES:
        values = [(record.name, score.of(record)) for record in done]
        known = sorted((score.is_bad * value, name) for name, value in values if value is not None)
        for rank, (_, name) in enumerate(known if score.is_bad else [], start=1):
            ranks[name] = max(ranks.get(name, (0.0, "")), (rank / len(known), score.name))
    worst_first = sorted(done, key=lambda r: ranks.get(r.name, (0.0, ""))[0], reverse=True)
    worst_score = {name: score for name, (_, score) in ranks.items()}
    scores = [score for score in _SCORES if any(score.of(r) is not None for r in records)]
    return _Set(root, table, drives, records, worst_first, worst_score, scores)


def _set_page(root: Path, command: str = "") -> bytes:
    """Return the bytes of the page of a training set; ``command`` continues a preview."""
    made = _read_set(root)
    left_out = [record for record in made.records if record.status != "done"]
    pictured, aside = _pictured(made.worst_first), [r for r in left_out if r.files][:_NUM_ASIDE]
    with_card = {record.name for record in (*pictured, *aside)}
    num_listed = min(len(made.worst_first), _NUM_LISTED)
    all_listed = num_listed == len(made.worst_first)
    parts = {
        "title": html.escape(root.resolve().name),
        "state": _state(made, command),
        "verdict": html.escape(_verdict(made)),
        "scores": _table(
            ("score", "median", "5 to 95 % of keys", "limit", "usual on KITTI"),
            map(_facts(made), _SCORES),
        ),
        "plots": "\n".join(_plot(score, made) for score in made.scores),
        "keys": "\n".join(_card(made, record) for record in pictured),
        "aside": "\n".join(_card(made, record) for record in aside),
        "left_out": _key_table(made, left_out, with_card),
        "listed_title": "All keys, worst first" if all_listed else f"The {num_listed:,} worst keys",
        "listed": _key_table(made, made.worst_first[:_NUM_LISTED], with_card),
        "recipe": html.escape(_recipe(made.table)),
        "drives": _table(
            ("recording", "keys", "split", "cameras, px"), map(_drive_row, made.drives.values())
        ),
        "settings": html.escape(yaml.safe_dump(made.table["config"], sort_keys=False)),
    }
    page = (package_files("densify.outputs") / "page" / "set.html").read_text("utf-8")
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)
    return filled.encode("utf-8", "backslashreplace")


def _pictured(worst_first: Sequence[KeyRecord]) -> list[KeyRecord]:
    """Return the worst keys, then others that are spread evenly over the set."""
    others = sorted(worst_first[_NUM_WORST:], key=lambda record: record.name)
    rows = np.linspace(0, len(others) - 1, min(_NUM_SPREAD, len(others))).astype(int)
    return [*worst_first[:_NUM_WORST], *(others[row] for row in rows)]


def _state(made: _Set, command: str) -> str:
    """Return how many keys the set has, what they cost, and how to make the others."""
    counts = Counter[str](record.status for record in made.records)
    names = {"done": "done", "aside": "put aside", "failed": "failed"}
    parts = [f"{counts[status]:,} {name}" for status, name in names.items() if counts[status]]
    planned, tried = planned_keys(made.table), {record.name for record in made.records}
    num_left = len(planned - tried)
    parts += [f"{num_left:,} to make"] if num_left else []
    state = html.escape("; ".join(filter(None, [", ".join(parts), describe_pace(made.records)])))
    if not num_left:
        return state
    kind = "Preview" if command else "Not finished"
    num_tried = f"{len(planned & tried):,} of {len(planned):,} keys"
    rest = describe_rest(made.records, num_left) or f"{num_left:,} keys are left"
    how = "run the command that made the set again, without --preview"
    how = f"<code>{html.escape(command)}</code>" if command else how
    later = "Keys are compared with their neighbours when all are made."
    return f"<b>{kind}: {num_tried}</b>; {rest}: {how}<br>{state}. {later}"


def _verdict(made: _Set) -> str:
    """Return a sentence that says whether the set is as good as one of KITTI."""
    worse = []
    for score in _SCORES:
        if (values := made.values(score)) and score.usual:
            bound = score.usual[1] if score.is_bad > 0 else score.usual[0]
            if score.is_bad * (float(np.median(values)) - bound) > 0:
                worse.append(score.title.lower())
    num_out = len(made.records) - len(made.worst_first)
    if not made.worst_first:
        return "No key is done."
    compared = [score.title.lower() for score in _SCORES if score.usual and made.values(score)]
    lines = [f"As usual on KITTI drive 0013 (64 rings, window 5): {', '.join(compared)}."]
    if worse:
        lines = [f"Worse than usual on KITTI drive 0013: {', '.join(worse)}. See the worst keys."]
    if num_out > _MANY_ASIDE * len(made.records):
        lines.append(f"{num_out:,} of {len(made.records):,} keys were put aside or failed.")
    return " ".join(lines)


def _facts(made: _Set) -> Callable[[_Score], Iterable[str]]:
    """Return a function of a score: its median and range in the set, its limit, usual values."""
    gate = made.table["gate"]

    def of(score: _Score) -> list[str]:
        values, unit = made.values(score), score.unit
        limits = []
        if score.limit and gate[score.limit] is not None:
            limits.append(f"{score.limit[:3]}. {_text(100.0 * gate[score.limit])} {unit}")
        if score.limit in ("max_ghost", "max_outliers") and gate["max_ratio"] is not None:
            limits.append(f"usual, {gate['max_ratio']:g} × the neighbours' median")
        usual = "" if score.usual is None else f"{score.usual[0]:g} to {score.usual[1]:g} {unit}"
        if not values:
            return _cells([score.title, "not computed", "", "; ".join(limits), usual])
        low, median, high = map(float, np.quantile(values, (0.05, 0.5, 0.95)))
        span = f"{_text(low)} to {_text(high)} {unit}"
        return _cells([score.title, f"{_text(median)} {unit}", span, "; ".join(limits), usual])

    return of


def _recipe(table: Mapping[str, Any]) -> str:
    """Return how the maps are made, and which keys are kept, in words."""
    gate, method = table["gate"], METHOD_NAMES.get(table["method"], table["method"])
    limits = [
        text.format(scale * gate[name])
        for name, scale, text in (
            (
                "max_ratio",
                1,
                "its ghosts or held-out outliers are more than usual and {:g} × its neighbours'",
            ),
            ("max_ghost", 100, "its ghosts exceed {:g} %"),
            ("max_outliers", 100, "its held-out outliers exceed {:g} %"),
            ("min_density", 100, "less than {:g} % of the pixels have a measured depth"),
            ("min_sweeps", 1, "its window has fewer than {} sweeps"),
        )
        if gate[name] is not None
    ]
    kept = f"A key is kept unless {', or '.join(limits)}." if limits else "Every key is kept."
    return (
        f"Method: {method}, {table['window']} sweeps on each side of a key, layout "
        f"{table['layout']}, densify {table['densify']}. {kept}"
    )


def _drive_row(drive: Drive) -> list[str]:
    cameras = (f"{c.name} {c.width_px} × {c.height_px}" for c in drive.cameras.values())
    split = drive.folder.partition("/")[0] if "/" in drive.folder else ""
    return _cells([drive.name, f"{len(drive.keys):,}", split, ", ".join(cameras)])


def _plot(score: _Score, made: _Set) -> str:
    """Return the values of a score over the frames as SVG."""
    worst, half = made.worst_first, _NUM_DOTS // 2
    shown = {record.name for record in (*worst[:half], *worst[half :: len(worst) // half + 1])}
    dots = [
        Dot(record.drive, record.key, value, record.status == "done", _anchor("row", record))
        for record in made.records
        if (record.status == "aside" or record.name in shown)
        if (value := score.of(record)) is not None
    ]
    return score_plot(score.title, score.unit, dots)


def _anchor(kind: str, record: KeyRecord) -> str:
    return f"{kind}-{quote(record.drive)}-{record.key}"


def _card(made: _Set, record: KeyRecord) -> str:
    """Return the pictures of a key with its scores, and a link to its own page."""
    drive, name = made.drives[record.drive], made.name_of(record)
    camera = front_camera(drive)
    depth = find_map(record, FILLED, camera)
    confidence = find_map(record, ("confidence",), camera)
    kept = next((n for n in record.files if n.startswith(f"{PICTURE_FOLDER}/")), None)
    pictures = []
    try:
        if depth is not None:
            small_m = metres(shrink(read_stored(made.root / depth, np.uint16, "a depth map")))
            image = small_image(drive, record.key, small_m.shape[::-1])
            if image is not None:
                pictures.append(_image(image, f"image {camera}, {name}"))
            pictures.append(_image(draw_depth(small_m, image), f"filled depth, {name}"))
        elif kept is not None:
            pictures.append(_embedded((made.root / kept).read_bytes(), f"filled depth, {name}"))
        if confidence is not None:
            stored = read_stored(made.root / confidence, np.uint8, "a map of confidence")
            pictures.append(_image(_gray(shrink(stored)), f"confidence, {name}"))
    except (InputError, OSError) as error:
        pictures.append(f"<p>{html.escape(str(error))}</p>")
    remarks = "; ".join(filter(None, [record.reason, *record.warnings]))
    return (
        f'<figure id="{_anchor("card", record)}"><figcaption>'
        f"{_link(name, _own_page(record) or '#' + _anchor('row', record))}<br>"
        f"{', '.join(_score_texts(made, record))}</figcaption>{''.join(pictures)}"
        f"<figcaption>{html.escape(remarks)}</figcaption></figure>"
    )


def _score_texts(made: _Set, record: KeyRecord) -> list[str]:
    """Return the scores of a key as HTML, the one that ranks it in bold."""
    texts = []
    for score in made.scores:
        if (value := score.of(record)) is not None:
            text = f"{score.title.lower()} {_text(value)} {score.unit}".replace(" ", "&nbsp;")
            is_worst = made.worst_score.get(record.name) == score.name
            texts.append(f"<b>{text}</b>" if is_worst else text)
    return texts


def _own_page(record: KeyRecord) -> str:
    """Return the address of a key's page, else of its coloured figure, "" for neither."""
    names = (n for last in ("report.html", "figure.png") for n in record.files if n.endswith(last))
    return quote(next(names, ""))


def _link(text: str, target: str) -> str:
    text = html.escape(text)
    return f'<a href="{target}">{text}</a>' if target else text


def _gray(stored: NDArray[np.uint8]) -> Picture:
    """Return the picture of a map of confidence: black without depth, white at confidence 1."""
    gray = _LEAST_GRAY + (stored - 1.0) * (255 - _LEAST_GRAY) / 254
    return np.repeat(np.where(stored > 0, gray, 0).astype(np.uint8)[:, :, None], 3, axis=2)


def _image(picture: Picture, alt: str) -> str:
    return _embedded(encode_jpeg(picture, _QUALITY), alt)


def _embedded(jpeg: bytes, alt: str) -> str:
    data = base64.b64encode(jpeg).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/jpeg;base64,{data}">'


def _key_table(made: _Set, records: Iterable[KeyRecord], with_card: set[tuple[str, int]]) -> str:
    """Return a table of keys: name, scores, status if not done, and warnings."""
    heads = ["key", *(f"{score.title}, {score.unit}" for score in made.scores), "remarks"]
    rows, ids = [], []
    for record in records:
        is_pictured = record.name in with_card
        target = f"#{_anchor('card', record)}" if is_pictured else _own_page(record)
        cells = [_link(made.name_of(record), target)]
        for score in made.scores:
            text = _text(score.of(record))
            is_worst = made.worst_score.get(record.name) == score.name
            cells.append(f"<b>{text}</b>" if is_worst else text)
        status = "" if record.status == "done" else f"{record.status}: {record.reason}"
        cells.append(html.escape("; ".join(filter(None, [status, *record.warnings]))))
        rows.append(cells)
        ids.append(_anchor("row", record))
    return _table(heads, rows, ids)


def _cells(values: Iterable[Any]) -> list[str]:
    return [html.escape(_text(value)) for value in values]


def _table(
    heads: Iterable[str], rows: Iterable[Iterable[str]], ids: Sequence[str] | None = None
) -> str:
    """Return the rows of a table, whose cells are HTML, with its head; "" without rows."""
    body = [f"{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows]
    starts = ["<tr>"] * len(body) if ids is None else [f'<tr id="{name}">' for name in ids]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    body = [start + row for start, row in zip(starts, body, strict=True)]
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


def write_set_page(root: Path, command: str = "") -> Path:
    """Write ``report.html`` of a training set, and return its path.

    An existing page is replaced. ``command`` continues a preview, "" for a set that is none.
    """
    page = root / "report.html"
    write_file(page, _set_page(root, command))
    return page


def write_report(folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the HTML pages of a run, comparison or training set, and return their paths.

    InputError is raised if the folder holds none of these, or if a page exists that ``overwrite``
    does not allow to replace. The page of a training set is always replaced.
    """
    if (folder / "dataset.json").is_file():
        return [write_set_page(folder)]
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
