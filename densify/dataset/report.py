# SPDX-License-Identifier: MIT
"""Write HTML pages: ``report.html`` of a run or training set, ``compare.html`` of a comparison.

A training set also keeps a picture of each key that is put aside.
"""

from __future__ import annotations

import base64
import html
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import repeat
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.dataset.manifest import (
    USUAL_SHARES,
    Key,
    KeyRecord,
    describe_pace,
    describe_rest,
    read_manifests,
)
from densify.dataset.plan import Drive, drives_of, planned_keys, read_plan
from densify.depth.exposure import key_shots
from densify.geometry.types import METHOD_NAMES, Float32, LidarSequence
from densify.outputs.depth_png import Picture, encode_jpeg, metres, read_stored
from densify.outputs.folders import write_file
from densify.outputs.plots import Dot, depth_over_image, order_front_first, score_plot
from densify.outputs.report_page import PAGES, fill_template, write_key_page
from densify.readers import open_sequence

FILLED = ("depth_filled", "groundtruth_filled")
"""Folders of the maps of filled depth, in the two layouts."""
_ASIDE = "aside"  # folder of the pictures of keys that are put aside, in a training set
_WIDTH_PX = 400
_QUALITY = 80
_NUM_WORST, _NUM_SPREAD = 6, 18  # keys with pictures: the worst, and others spread over the set
_NUM_ASIDE = 12  # keys with pictures among those put aside
_NUM_LISTED = 1000  # rows of the table of keys, the worst first
_NUM_DOTS = 1000  # of a plot, half of them the worst keys
_LEAST_GRAY = 40  # of confidence 0; black is no depth
_MANY_ASIDE = 0.1  # a greater share of keys put aside or failed is reported in the verdict
# Limit of the recipe -> factor of its unit, and when a key is not kept
_LIMITS = {
    "max_ratio": (
        1,
        "its ghosts or held-out outliers are more than usual and {:g} × its neighbours'",
    ),
    "max_ghost": (100, "its ghosts exceed {:g} %"),
    "max_outliers": (100, "its held-out outliers exceed {:g} %"),
    "min_density": (100, "less than {:g} % of the pixels have a measured depth"),
    "min_sweeps": (1, "its window has fewer than {} sweeps"),
}


class _Score(NamedTuple):
    """A score of a key that the page shows."""

    name: str  # name in a manifest line
    title: str
    is_bad: int  # 1 if a high value is bad, -1 if a low value is, 0 if neither
    limit: str = ""  # name of the limit in the recipe
    unit: str = "%"

    def of(self, record: KeyRecord) -> float | None:
        """Return the score of a key's worst camera in ``unit``; None if unknown."""
        if self.name == "seconds":
            return record.seconds
        values = record.values_of(self.name)
        return 100 * (max(values) if self.is_bad > 0 else min(values)) if values else None

    def camera_of(self, record: KeyRecord) -> str | None:
        """Return the name of the worst camera of a key, None if the score has no cameras."""
        values = record.scores.get(self.name)
        if not isinstance(values, Mapping):
            return None
        known = {name: value for name, value in values.items() if value is not None}
        return max(known, key=lambda name: self.is_bad * known[name], default=None)

    def usual(self) -> list[float]:
        """Return the ends of the range on KITTI in ``unit``, [] if unknown."""
        return [100 * share for share in USUAL_SHARES.get(self.name, ())]

    def is_worse_than_usual(self, value: float) -> bool:
        """Return True if a value in ``unit`` lies beyond the bad end of the range on KITTI."""
        usual = self.usual()
        return bool(usual) and self.is_bad * value > max(self.is_bad * end for end in usual)


_SCORES = (
    _Score("ghost", "Ghosts", 1, "max_ghost"),
    _Score("outliers", "Held-out outliers", 1, "max_outliers"),
    _Score("density", "Measured depth", -1, "min_density"),
    _Score("density_filled", "Filled depth", -1),
    _Score("seconds", "Computing time", 0, unit="s"),
)


class _Set(NamedTuple):
    """The content of a training set, from which the parts of its page are made."""

    root: Path
    table: Mapping[str, Any]  # content of dataset.json
    drives: Mapping[str, Drive]
    records: Sequence[KeyRecord]  # ordered by recording and frame
    worst_first: Sequence[KeyRecord]  # the keys that are done
    worst_score: Mapping[Key, str]  # key -> name of the score that ranks it
    scores: Sequence[_Score]  # the scores that a key of the set has

    def values(self, score: _Score) -> list[float]:
        """Return the known values of a score of the keys that are done."""
        return [value for record in self.worst_first if (value := score.of(record)) is not None]

    def name_of(self, record: KeyRecord) -> str:
        """Return a key's name, with the recording if there are several."""
        return f"{record.drive}, key {record.key}" if len(self.drives) > 1 else f"key {record.key}"

    def marked(self, record: KeyRecord, score: _Score, text: str) -> str:
        """Return the text of a score of a key as HTML, bold if this score ranks the key."""
        return f"<b>{text}</b>" if self.worst_score.get(record.name) == score.name else text


def _read_set(root: Path) -> _Set:
    table = read_plan(root) or {}
    drives = drives_of(table)
    records = [record for record in read_manifests(root).values() if record.drive in drives]
    done = [record for record in records if record.status == "done"]
    # A key is as bad as its worst score. Scores compare by their distance from the median of the
    # set, in widths of the range that is usual on KITTI.
    badness = {record.name: (-math.inf, "") for record in done}
    for score in (score for score in _SCORES if score.usual()):
        low, high = score.usual()
        values = {r.name: value for r in done if (value := score.of(r)) is not None}
        for name, value in values.items():
            distance = score.is_bad * (value - float(np.median([*values.values()])))
            badness[name] = max(badness[name], (distance / (high - low), score.name))
    worst_first = sorted(done, key=lambda record: badness[record.name][0], reverse=True)
    worst_score = {name: score for name, (_, score) in badness.items()}
    scores = [score for score in _SCORES if any(score.of(r) is not None for r in records)]
    return _Set(root, table, drives, records, worst_first, worst_score, scores)


def _set_page(root: Path, command: str) -> bytes:
    """Return the bytes of the page of a training set; ``command`` continues a preview."""
    made = _read_set(root)
    left_out = [record for record in made.records if record.status != "done"]
    pictured = _chosen_for_pictures(made.worst_first)
    aside = [record for record in left_out if record.files][:_NUM_ASIDE]
    with_card = {record.name for record in (*pictured, *aside)}
    listed = made.worst_first[:_NUM_LISTED]
    title = "All keys, worst first"
    if len(listed) < len(made.worst_first):
        title = f"The {len(listed):,} worst keys"
    score_heads = ("score", "median", "5 to 95 % of keys", "limit", "usual on KITTI")
    drive_heads = ("recording", "keys", "split", "cameras, px")
    parts = {
        "title": html.escape(root.resolve().name),
        "state": _state(made, command),
        "verdict": html.escape(_verdict(made)),
        "scores": _table(score_heads, (_score_row(made, score) for score in _SCORES)),
        "plots": "\n".join(_plot(score, made) for score in made.scores),
        "keys": "\n".join(_card(made, record) for record in pictured),
        "aside": "\n".join(_card(made, record) for record in aside),
        "left_out": _key_table(made, left_out, with_card),
        "listed_title": title,
        "listed": _key_table(made, listed, with_card),
        "recipe": html.escape(_recipe(made.table)),
        "drives": _table(drive_heads, map(_drive_row, made.drives.values())),
        "settings": html.escape(yaml.safe_dump(made.table["config"], sort_keys=False)),
    }
    return fill_template("set.html", parts)


def _chosen_for_pictures(worst_first: Sequence[KeyRecord]) -> list[KeyRecord]:
    """Return the worst keys, then others that are spread evenly over the set."""
    others = sorted(worst_first[_NUM_WORST:], key=lambda record: record.name)
    rows = np.linspace(0, len(others) - 1, min(_NUM_SPREAD, len(others))).astype(int)
    return [*worst_first[:_NUM_WORST], *(others[row] for row in rows)]


def _state(made: _Set, command: str) -> str:
    """Return how many keys the set has, what they cost, and how to make the others."""
    counts = Counter[str](record.status for record in made.records)
    words = {"done": "done", "aside": "put aside", "failed": "failed"}
    parts = [f"{counts[status]:,} {word}" for status, word in words.items() if counts[status]]
    planned, tried = planned_keys(made.table), {record.name for record in made.records}
    num_left = len(planned - tried)
    parts += [f"{num_left:,} to make"] if num_left else []
    names = list(made.drives)
    recordings = names[0] if len(names) == 1 else f"{len(names):,} recordings"
    source = f"{recordings}, densify {made.table['densify']}"
    pace = describe_pace(made.records)
    state = html.escape("; ".join(filter(None, [source, ", ".join(parts), pace])))
    if not num_left:
        return state
    kind = "Preview" if command else "Not finished"
    num_tried = f"{len(planned & tried):,} of {len(planned):,} keys"
    rest = describe_rest(made.records, num_left)
    how = "run the command that made the set again, without --preview"
    how = f"<code>{html.escape(command)}</code>" if command else how
    later = "Keys are compared with their neighbours when all are made."
    return f"<b>{kind}: {num_tried}</b>; {rest}: {how}<br>{state}. {later}"


def _verdict(made: _Set) -> str:
    """Return sentences that say whether the set is as good as one of KITTI."""
    if not made.worst_first:
        return "No key is done."
    judged = [score for score in _SCORES if score.usual() and made.values(score)]
    medians = {score.title.lower(): float(np.median(made.values(score))) for score in judged}
    worse = [s.title.lower() for s in judged if s.is_worse_than_usual(medians[s.title.lower()])]
    scanner = "KITTI drive 0013 (64 rings, front camera, moving vehicle)"
    lines = [f"Good: {', '.join(medians)} are as usual on {scanner}."]
    if worse:
        lines = [f"Worse than usual on {scanner}: {', '.join(worse)}. See the worst keys."]
    if "held-out outliers" not in medians:
        lines.append("Outliers are not measured: --set output.score=true does.")
    num_beyond = sum(
        any((v := s.of(record)) is not None and s.is_worse_than_usual(v) for s in judged)
        for record in made.worst_first
    )
    if num_beyond:
        lines.append(
            f"{num_beyond:,} of {len(made.worst_first):,} keys are worse than usual there."
        )
    num_out = len(made.records) - len(made.worst_first)
    if num_out > _MANY_ASIDE * len(made.records):
        lines.append(f"{num_out:,} of {len(made.records):,} keys were put aside or failed.")
    return " ".join(lines)


def _score_row(made: _Set, score: _Score) -> list[str]:
    """Return the cells of a score: its median and range in the set, its limit, usual values."""
    gate, unit, values = made.table["gate"], score.unit, made.values(score)
    limits = []
    if score.limit and gate[score.limit] is not None:
        limits.append(f"{score.limit[:3]}. {_text(100.0 * gate[score.limit])} {unit}")
    if score.limit in ("max_ghost", "max_outliers") and gate["max_ratio"] is not None:
        floor = f"{score.usual()[1]:g} {unit}"
        limits.append(f"{floor} and {gate['max_ratio']:g} × its neighbours' median")
    median, span = "not computed", ""
    if values:
        low, middle, high = map(float, np.quantile(values, (0.05, 0.5, 0.95)))
        median, span = f"{_text(middle)} {unit}", f"{_text(low)} to {_text(high)} {unit}"
    usual = " to ".join(f"{end:g}" for end in score.usual())
    return _cells([score.title, median, span, "; ".join(limits), usual and f"{usual} {unit}"])


def _recipe(table: Mapping[str, Any]) -> str:
    """Return how the maps are made, and which keys are kept, in words."""
    gate, method = table["gate"], METHOD_NAMES.get(table["method"], table["method"])
    limits = [
        text.format(factor * gate[name])
        for name, (factor, text) in _LIMITS.items()
        if gate[name] is not None
    ]
    kept = f"A key is kept unless {', or '.join(limits)}." if limits else "Every key is kept."
    return (
        f"Method: {method}, {table['window']} sweeps on each side of a key, layout "
        f"{table['layout']}, densify {table['densify']}. {kept}"
    )


def _drive_row(drive: Drive) -> list[str]:
    cameras = (f"{c.name} {c.width_px} × {c.height_px}" for c in drive.cameras.values())
    split = drive.folder.rpartition("/")[0]
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
    usual = score.usual()
    if usual and score.is_bad > 0:
        usual[0] = 0.0  # a lower value is no worse
    return score_plot(score.title, score.unit, dots, usual)


def _anchor(kind: str, record: KeyRecord) -> str:
    return f"{kind}-{quote(record.drive)}-{record.key}"


def _card(made: _Set, record: KeyRecord) -> str:
    """Return the pictures of a key with its scores, and a link to its own page."""
    name, pictures, texts = made.name_of(record), "", []
    try:
        for picture in _pictures(made, record, name):
            pictures += picture
    except (InputError, OSError) as error:
        pictures += f"<p>{html.escape(str(error))}</p>"
    worst = made.worst_score.get(record.name)
    for score in sorted(made.scores, key=lambda score: score.name != worst):  # the worst one first
        if (value := score.of(record)) is not None:
            text = f"{score.title.lower()} {_text(value)} {score.unit}".replace(" ", "&nbsp;")
            texts.append(made.marked(record, score, text))
    remarks = "; ".join(filter(None, [record.reason, *record.warnings]))
    return (
        f'<figure id="{_anchor("card", record)}"><figcaption>'
        f"{_link(name, _own_page(record) or '#' + _anchor('row', record))}<br>"
        f"{', '.join(texts)}</figcaption>{pictures}"
        f"<figcaption>{html.escape(remarks)}</figcaption></figure>"
    )


def _pictures(made: _Set, record: KeyRecord, name: str) -> Iterator[str]:
    """Yield the image, the filled depth and the confidence of a key as HTML, if it has them.

    The camera is that of the key's worst score, or the front camera.
    """
    drive = made.drives[record.drive]
    worst = {score.name: score for score in _SCORES}.get(made.worst_score.get(record.name, ""))
    camera = (worst and worst.camera_of(record)) or front_camera(drive)
    depth = find_map(record, FILLED, camera)
    confidence = find_map(record, ("confidence",), camera)
    kept = next((n for n in record.files if n.startswith(f"{_ASIDE}/")), None)
    if depth is not None:
        small_m = metres(_shrink(read_stored(made.root / depth, np.uint16, "a depth map")))
        image = _small_image(drive, camera, record.key, small_m.shape[::-1])
        if image is not None:
            yield _image(image, f"image {camera}, {name}")
        yield _image(_draw_depth(small_m, image), f"filled depth {camera}, {name}")
    elif kept is not None:
        yield _embedded((made.root / kept).read_bytes(), f"filled depth, {name}")
    if confidence is not None:
        stored = _shrink(read_stored(made.root / confidence, np.uint8, "a map of confidence"))
        # Black without depth, white at confidence 1
        gray = _LEAST_GRAY + (stored - 1.0) * (255 - _LEAST_GRAY) / 254
        gray = np.where(stored > 0, gray, 0).astype(np.uint8)
        yield _image(np.repeat(gray[:, :, None], 3, axis=2), f"confidence, {name}")


def _own_page(record: KeyRecord) -> str:
    """Return the address of a key's page, else of its coloured figure, "" for neither."""
    names = (n for last in ("report.html", "figure.png") for n in record.files if n.endswith(last))
    return quote(next(names, ""))


def _link(text: str, target: str) -> str:
    text = html.escape(text)
    return f'<a href="{target}">{text}</a>' if target else text


def _image(picture: Picture, alt: str) -> str:
    return _embedded(encode_jpeg(picture, _QUALITY), alt)


def _embedded(jpeg: bytes, alt: str) -> str:
    data = base64.b64encode(jpeg).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/jpeg;base64,{data}">'


def _key_table(made: _Set, records: Sequence[KeyRecord], with_card: set[Key]) -> str:
    """Return a table of keys: name, scores, status if not done, and warnings."""
    rows = []
    for record in records:
        target = f"#{_anchor('card', record)}" if record.name in with_card else _own_page(record)
        values = [made.marked(record, score, _text(score.of(record))) for score in made.scores]
        status = "" if record.status == "done" else f"{record.status}: {record.reason}"
        remarks = html.escape("; ".join(filter(None, [status, *record.warnings])))
        rows.append([_link(made.name_of(record), target), *values, remarks])
    heads = ["key", *(f"{score.title}, {score.unit}" for score in made.scores), "remarks"]
    return _table(heads, rows, [f' id="{_anchor("row", record)}"' for record in records])


def _cells(values: Iterable[Any]) -> list[str]:
    return [html.escape(_text(value)) for value in values]


def _table(
    heads: Iterable[str], rows: Iterable[Iterable[str]], attributes: Iterable[str] = repeat("")
) -> str:
    """Return the rows of a table, whose cells are HTML, with its head; "" without rows."""
    body = [
        f"<tr{attribute}>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"
        for row, attribute in zip(rows, attributes, strict=False)
    ]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    return "\n".join([f"<tr>{head}</tr>", *body]) if body else ""


def _text(value: Any) -> str:
    """Return a value as people read it: floats with two or three digits."""
    if isinstance(value, float):
        return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2g}"
    return "" if value is None else str(value)


# Pictures of a key


def front_camera(drive: Drive) -> str:
    """Return the name of a recording's camera that is shown: by its name the front camera."""
    return order_front_first([*drive.cameras], {}, {})[0]


def find_map(record: KeyRecord, kinds: tuple[str, ...], camera: str) -> str | None:
    """Return the path, relative to the set, of a camera's first map of one of these kinds."""
    paths = [PurePosixPath(name) for name in record.files]
    of_camera = (p for p in paths if camera in (p.stem, p.parent.name) and {*kinds} & {*p.parts})
    return next(map(str, of_camera), None)


def _shrink(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map with every n-th row and column, about as wide as a picture."""
    step = max(1, values.shape[1] // _WIDTH_PX)
    return np.ascontiguousarray(values[::step, ::step])


def _small_image(drive: Drive, name: str, key: int, size_px: tuple[int, int]) -> Picture | None:
    """Return a camera's RGB image at a key sweep, resized to (width, height); None for none."""
    camera = drive.cameras[name]
    try:
        sequence = _open(drive.data)
        number = key_shots(sequence, [camera], key)[camera.name].number
        image = None if number is None else sequence.image(camera.name, number)
    except (InputError, KeyError):  # the recording has moved, or no longer holds the sweep
        return None
    if image is None:
        return None
    return cv2.resize(image, size_px, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


@lru_cache(maxsize=1)
def _open(data: str) -> LidarSequence:
    """Open a recording, and keep the last one open."""
    return open_sequence(data)


def _draw_depth(depth_m: Float32, image: Picture | None) -> Picture:
    """Return an RGB picture of depth (h,w) over an image of that size, over black without one."""
    below = np.zeros((*depth_m.shape, 3), np.uint8) if image is None else image
    return np.ascontiguousarray(depth_over_image(below, depth_m)[:, :, ::-1])


def keep_picture(out: Path, drive: Drive, key: int, filled_m: Float32) -> Path:
    """Write the picture of a key whose maps are not kept, and return its path.

    Args:
        out: Folder of the training set.
        drive: Recording of the key.
        key: Frame number of the key.
        filled_m: (H,W) filled depth of the `front_camera` in metres, 0 for no depth.
    """
    small_m = _shrink(filled_m)
    image = _small_image(drive, front_camera(drive), key, small_m.shape[::-1])
    picture = _draw_depth(small_m, image)
    path = out / _ASIDE / drive.name / f"{key:010d}.jpg"
    write_file(path, encode_jpeg(picture, _QUALITY))
    return path


# Files


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
    folder, sources = _key_in(folder)
    for path in (folder / PAGES[source] for source in sources):
        if path.exists() and not overwrite:
            raise InputError(f"{path}: already there and kept; give --overwrite to replace it")
    return [write_key_page(folder, source) for source in sources]


def _key_in(folder: Path) -> tuple[Path, list[str]]:
    """Return the folder of a key, which is this one or the only one in it, and its records."""
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such folder; expected what densify run, compare or dataset wrote"
        )
    sources_in = {
        path: [source for source in PAGES if (path / source).is_file()]
        for path in (folder, *sorted(folder.iterdir()))
    }
    keys = [path for path, sources in sources_in.items() if sources]
    if keys[:1] == [folder] or len(keys) == 1:
        return keys[0], sources_in[keys[0]]
    content = f"{len(keys)} keys; name one of them" if keys else "none of these"
    raise InputError(
        f"{folder}: holds {content}; expected the folder of a key, such as "
        f"densify-out/street/000120, or a training set"
    )
