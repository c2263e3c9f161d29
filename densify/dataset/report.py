# SPDX-License-Identifier: MIT
"""Write HTML pages: ``report.html`` of a run or training set, ``compare.html`` of a comparison.

A training set also keeps a picture of each key that is put aside.
"""

from __future__ import annotations

import base64
import html
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import repeat
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.dataset.judged_set import (
    SCORES,
    JudgedSet,
    Score,
    Series,
    count_messages,
    limits_of,
    read_judged,
)
from densify.dataset.manifest import (
    Key,
    KeyRecord,
    describe_cost,
    describe_pace,
    describe_rest,
)
from densify.dataset.plan import Drive, planned_keys
from densify.depth.exposure import key_shots
from densify.geometry.types import METHOD_NAMES, Float32, LidarSequence
from densify.outputs.depth_png import Picture, encode_jpeg, metres, read_stored
from densify.outputs.folders import write_file
from densify.outputs.plots import (
    Axis,
    Dot,
    depth_over_image,
    order_front_first,
    score_plot,
)
from densify.outputs.report_page import PAGES, fill_template, write_key_page
from densify.readers import open_sequence

FILLED = ("depth_filled", "groundtruth_filled")
"""Folders of the maps of filled depth, in the two layouts."""
_MEASURED = ("depth", "groundtruth")
_ASIDE = "aside"  # folder of the pictures of keys that are put aside, in a training set
_WIDTH_PX, _WIDTH_OF_WORST_PX, _WIDTH_OF_SMALL_PX = 620, 960, 150
_QUALITY = 75
# Keys with pictures: the worst, others spread over the set, and small ones
_NUM_WORST, _NUM_SPREAD, _NUM_SMALL = 6, 6, 60
_NUM_DRIVES = 12  # recordings in the first table, the others are folded
_NUM_ASIDE = 12  # keys with pictures among those put aside
_NUM_LISTED = 1000  # rows of the table of keys, the worst first
_NUM_DOTS = 1000  # of a plot, half of them the worst keys
_NUM_NAMED = 4  # suspect keys that the verdict names
_NUM_MESSAGES = 20  # rows of the table of reasons and warnings
_ON_CARDS = ("ghost", "outliers", "outliers_moving", "density", "density_filled")
_FEWEST_IN_RANGE = 20  # keys; fewer have no share of 5 to 95 %
_MANY_ASIDE = 0.1  # a greater share of keys put aside or failed is reported in the verdict
# Gray of confidence from 0.2, 10 % expected outliers, to 0.8, 0.01 %
_GRAY, _CONFIDENCE = (50, 255), (0.2, 0.8)
_NO_DEPTH_RGB = (28, 36, 78)
_USUAL = "KITTI drive 0013 (64 rings, front camera, moving vehicle)"
# Limit of the recipe -> factor of its unit, and when a key is not kept
_LIMITS = {
    "max_ratio": (
        1,
        "its ghosts or held-out outliers are more than usual and {:g} times those of the keys "
        "around it",
    ),
    "max_ghost": (100, "its ghosts exceed {:g} %"),
    "max_outliers": (100, "its held-out outliers exceed {:g} %"),
    "min_density": (100, "less than {:g} % of the pixels have a measured depth"),
    "min_sweeps": (1, "its window has fewer than {} sweeps"),
}


def _set_page(root: Path, command: str) -> bytes:
    """Return the bytes of the page of a training set; ``command`` continues a preview."""
    made = read_judged(root)
    left_out = [record for record in made.records if record.status != "done"]
    left_out.sort(key=lambda record: record.status, reverse=True)  # failed ones first
    worst = made.worst_moments(_NUM_WORST)
    spread = _spread(made, worst)
    aside = _worst_aside(made, left_out)
    cards = {record.name: _anchor("card", record) for record in (*worst, *spread, *aside)}
    listed = made.worst_first[:_NUM_LISTED]
    rows = {record.name: _anchor("row", record) for record in (*listed, *left_out)}
    title = "All keys, worst first"
    if len(listed) < len(made.worst_first):
        title = f"The {len(listed):,} worst keys"
    level, verdict = _verdict(made, {**rows, **cards})
    score_heads = ("score", "median", _range_head(made), "suspect beyond", "suspect keys")
    message_heads = ("reason or warning", "keys", "for example")
    parts = {
        "title": f"Training set {html.escape(root.resolve().name)}",
        "state": _state(made, command),
        "level": level,
        "verdict": verdict,
        "scores": _table(score_heads, (_score_row(made, series) for series in made.series)),
        **_drive_tables(made, rows),
        "messages": _table(message_heads, _message_rows(made, {**rows, **cards})),
        "limits": _table(("with", "keys put aside"), _limit_rows(made)),
        "suspects": html.escape("\n".join(f"{drive} {key}" for drive, key in made.suspects)),
        "small": "\n".join(_small_card(made, record, cards, rows) for record in _small(made)),
        "plots": "\n".join(_plot(made, score, rows) for score in SCORES),
        "legend": _legend(made),
        "worst": "\n".join(_card(made, record, _WIDTH_OF_WORST_PX) for record in worst),
        "spread": "\n".join(_card(made, record) for record in spread),
        "aside": "\n".join(_card(made, record) for record in aside),
        "left_out": _key_table(made, left_out, cards),
        "listed_title": title,
        "listed": _key_table(made, listed, cards),
        "recipe": html.escape(_recipe(made.table)),
        "recordings": _table(("recording", "split", "cameras, px"), _drive_rows(made)),
        "settings": html.escape(yaml.safe_dump(made.table["config"], sort_keys=False)),
    }
    return fill_template("set.html", parts)


def _spread(made: JudgedSet, worst: Sequence[KeyRecord]) -> list[KeyRecord]:
    """Return keys that are spread evenly over the set, without the ``worst`` ones."""
    others = [r for r in made.records if r.status == "done" and r not in worst]
    rows = np.linspace(0, len(others) - 1, min(_NUM_SPREAD, len(others))).astype(int)
    return [others[row] for row in rows]


def _small(made: JudgedSet) -> list[KeyRecord]:
    """Return keys for small pictures: all if they are few, else evenly spread and some suspect."""
    done = [record for record in made.records if record.status == "done"]
    rows = np.linspace(0, len(done) - 1, min(_NUM_SMALL, len(done))).astype(int)
    suspect = [record for record in made.worst_first if record.name in made.suspects]
    shown = {done[row].name for row in rows} | {r.name for r in suspect[: _NUM_SMALL // 3]}
    return [record for record in done if record.name in shown]


def _worst_aside(made: JudgedSet, left_out: Sequence[KeyRecord]) -> list[KeyRecord]:
    """Return the keys put aside that have a picture, those with most ghosts first."""
    ghosts = Series(SCORES[0], "")
    with_picture = [record for record in left_out if record.files]
    return sorted(with_picture, key=lambda r: -(ghosts.of(r) or 0))[:_NUM_ASIDE]


def _state(made: JudgedSet, command: str) -> str:
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
    cost = describe_cost(made.records)
    state = html.escape("; ".join(filter(None, [source, ", ".join(parts), pace, cost])))
    if not num_left:
        return state
    kind = "Preview" if command else "Not finished"
    num_tried = f"{len(planned & tried):,} of {len(planned):,} keys"
    rest = describe_rest(made.records, num_left)
    how = "run the command that made the set again, without <code>--preview</code>"
    how = f"<code>{html.escape(command)}</code>" if command else how
    later = (
        "The finished set is checked once more: a key that is far worse than the keys around it "
        "is put aside."
    )
    if command and not made.table["config"]["output"]["score"]:
        later += (
            " The other keys get no held-out scores, unless <code>--set output.score=true</code> "
            "is added, which takes twice the time."
        )
    return f"<b>{kind}: {num_tried}</b>; {rest}: {how}<br>{state}. {later}"


def _verdict(made: JudgedSet, targets: Mapping[Key, str]) -> tuple[str, str]:
    """Return a level (good, plain, look, bad), and sentences as HTML: why, and what to do.

    A set without suspect keys is ``plain`` where no moving pixel was judged.
    """
    if not made.worst_first:
        return "bad", "✗ Stop: no key is done. The reasons are below."
    num_done, num_all = len(made.worst_first), len(made.records)
    worse = [
        series
        for series, bound in made.bounds.items()
        if series.score.is_error and made.values(series)
        if np.median(made.values(series)) > bound
    ]
    lines = []
    if worse:
        level, names = "bad", ", ".join(_title(made, series).lower() for series in worse)
        lines.append(
            f"✗ Stop: the median key is worse than usual on {_USUAL}: {html.escape(names)}. "
            "<code>densify doctor</code> looks for the reason."
        )
    elif made.suspects:
        level = "look"
        lines.append("! Usable, but look at the suspect keys before you train on them.")
    else:
        is_judged = any(s.score.name == "outliers_moving" for s in made.series)
        level, mark = ("good", "✓ Good") if is_judged else ("plain", "✓ Good on static surfaces")
        lines.append(f"{mark}: no key of {num_done:,} is suspect.")
    if made.suspects:
        lines.append(_suspect_sentence(made, targets))
    lines.append(_error_sentence(made))
    if num_all - num_done > _MANY_ASIDE * num_all and level in ("good", "plain"):
        level = "look"
    counts = Counter[str](record.status for record in made.records)
    if num_all > num_done:
        texts = [f"{counts['failed']:,} failed"] if counts["failed"] else []
        texts += [f"{counts['aside']:,} were put aside"] if counts["aside"] else []
        lines.append(f'{" and ".join(texts)} (<a href="#left-out">why</a>).')
    if num_warned := sum(bool(record.warnings) for record in made.worst_first):
        lines.append(f'<a href="#reasons">Warnings</a>: {num_warned:,} keys.')
    return level, " ".join(lines)


def _suspect_sentence(made: JudgedSet, targets: Mapping[Key, str]) -> str:
    """Return how many keys are suspect by which scores, with links to the worst, as HTML."""
    ordered = [record.name for record in made.worst_first if record.name in made.suspects]
    links = [_suspect_link(made, name, targets) for name in ordered[:_NUM_NAMED]]
    num_more = len(ordered) - len(links)
    links += [f"and {num_more:,} more"] if num_more else []
    found = [_title(made, j.series).lower() for name in ordered for j in made.suspects[name]]
    causes = Counter(found)
    by = ", ".join(f"{html.escape(title)} {num:,}" for title, num in causes.most_common())
    verb = "is" if len(ordered) == 1 else "are"
    count = f"{len(ordered):,} of {len(made.worst_first):,} keys {verb} suspect"
    by += "; some by several" if len(found) > len(ordered) else ""
    drop = "<code>--set dataset.suspects=aside</code> drops them."
    return f"{count} (by {by}): {', '.join(links)}. {drop}"


def _suspect_link(made: JudgedSet, name: Key, targets: Mapping[Key, str]) -> str:
    """Return the link to a suspect key, with the reason, as HTML."""
    drive, key = name
    text = f"{drive}, key {key}" if len(made.drives) > 1 else f"key {key}"
    reason = html.escape(made.suspects[name][0].reason(len(made.cameras) > 1))
    target = targets.get(name, "")
    return f"{_link(text, target and '#' + target)} ({reason})"


def _error_sentence(made: JudgedSet) -> str:
    """Return how large the errors are, and how to measure them if they are only expected."""
    medians = {
        name: [
            f"{s.score.text(float(np.median(made.values(s))))} %"
            + (f" ({html.escape(s.camera)})" if len(made.cameras) > 1 else "")
            for s in made.series
            if s.score.name == name and made.values(s)
        ]
        for name in ("outliers", "expected_outliers")
    }
    if medians["outliers"]:
        moving = next(score for score in SCORES if score.name == "outliers_moving")
        values = [made.worst_value(moving, record)[0] for record in made.worst_first]
        known = [value for value in values if value is not None]
        judged = f"Moving pixels are judged in {len(known):,} of {len(values):,} keys"
        judged += f": {moving.text(float(np.median(known)))} %." if known else ": look at them."
        return f"Outliers of the median key, held out: {', '.join(medians['outliers'])}. {judged}"
    expected = ", ".join(medians["expected_outliers"])
    expected = f" By confidence, {expected} are expected." if expected else ""
    return (
        f"Outliers are not measured.{expected} A preview measures them: "
        "<code>densify dataset … --out ANOTHER --preview 8</code>."
    )


def _title(made: JudgedSet, series: Series) -> str:
    """Return the title of a score, with the camera if there are several."""
    with_camera = series.camera and len(made.cameras) > 1
    return f"{series.score.title}, {series.camera}" if with_camera else series.score.title


def _range_head(made: JudgedSet) -> str:
    return "5 to 95 % of keys" if len(made.worst_first) >= _FEWEST_IN_RANGE else "range"


def _score_row(made: JudgedSet, series: Series) -> list[str]:
    """Return the cells of a score: its median and range in the set, bound, suspects."""
    score, values = series.score, made.values(series)
    ends = (0.05, 0.95) if len(values) >= _FEWEST_IN_RANGE else (0.0, 1.0)
    cells = ["", ""]
    if values:
        low, middle, high = map(float, np.quantile(values, (ends[0], 0.5, ends[1])))
        cells = [f"{score.text(middle)} {score.unit}", f"{score.text(low)} to {score.text(high)}"]
    bound = made.bounds.get(series)
    text = "" if bound is None else f"{'>' if score.is_bad > 0 else '<'} {score.text(bound)}"
    suspect = sum(any(j.series == series for j in found) for found in made.suspects.values())
    return [html.escape(cell) for cell in (_title(made, series), *cells, text)] + [
        "" if bound is None else _marked(f"{suspect:,}", bool(suspect))
    ]


def _marked(text: str, is_suspect: bool) -> str:
    """Return a text as HTML, marked if it is that of a suspect key."""
    return f'<b class="suspect">{text}</b>' if is_suspect else text


def _drive_tables(made: JudgedSet, rows: Mapping[Key, str]) -> dict[str, str]:
    """Return tables of the worst recordings and of the others, "" for a single recording."""
    if len(made.drives) < 2:
        return {"drives": "", "other_drives": ""}
    scores, lines = made.scores, []
    for drive in made.drives.values():
        records = [record for record in made.records if record.drive == drive.name]
        counts = Counter[str](record.status for record in records)
        done = [record for record in made.worst_first if record.drive == drive.name]
        num_suspect = sum(record.name in made.suspects for record in done)
        target = rows.get(done[0].name, "") if done else ""
        cells = [
            _link(drive.name, target and "#" + target),
            f"{len(drive.keys):,}",
            *(f"{counts[status]:,}" for status in ("done", "aside", "failed")),
            _marked(f"{num_suspect:,}", bool(num_suspect)),
        ]
        for score in scores:
            known = [v for r in done if (v := made.worst_value(score, r)[0]) is not None]
            cells.append(score.text(float(np.median(known))) if known else "")
        bad_share = (num_suspect + counts["aside"] + counts["failed"]) / max(len(records), 1)
        lines.append((bad_share, cells))
    lines.sort(key=lambda line: -line[0])
    titles = (f"{score.title}, {score.unit}" for score in scores)
    heads = ("recording", "keys", "done", "aside", "failed", "suspect", *titles)
    ordered = [cells for _, cells in lines]
    worst, others = ordered[:_NUM_DRIVES], ordered[_NUM_DRIVES:]
    return {"drives": _table(heads, worst), "other_drives": _table(heads, others)}


def _message_rows(made: JudgedSet, targets: Mapping[Key, str]) -> Iterator[list[str]]:
    """Yield the cells of the reasons and warnings of the keys, the most frequent first."""
    for text, records in count_messages(made.records)[:_NUM_MESSAGES]:
        first = records[0]
        target = targets.get(first.name, "")
        link = _link(made.name_of(first), target and "#" + target)
        yield [html.escape(text), f"{len(records):,}", link]


def _limit_rows(made: JudgedSet) -> Iterator[list[str]]:
    for limit in limits_of(made):
        num = f"{limit.num_lost:,} of {len(made.worst_first):,}"
        yield [f"<code>--set {limit.setting}</code>", num]


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


def _drive_rows(made: JudgedSet) -> Iterator[list[str]]:
    for drive in made.drives.values():
        cameras = (f"{c.name} {c.width_px} × {c.height_px}" for c in drive.cameras.values())
        split = drive.folder.rpartition("/")[0]
        yield [html.escape(text) for text in (drive.name, split, ", ".join(cameras))]


def _style(made: JudgedSet, series: Series) -> str:
    """Return the name of the colour of a camera in the style sheet."""
    names = made.cameras
    return f"camera-{names.index(series.camera) % 6}" if series.camera in names else "camera-0"


def _plot(made: JudgedSet, score: Score, rows: Mapping[Key, str]) -> str:
    """Return the values of a score over the frames as SVG, "" if no key has the score."""
    of_score = {series: _style(made, series) for series in made.series if series.score is score}
    all_values = {style: made.values(series) for series, style in of_score.items()}
    bounds = {style: made.bounds[s] for s, style in of_score.items() if s in made.bounds}
    shown = [*all_values.values(), *([bound] for bound in bounds.values())]
    known = [value for values in shown for value in values]
    if not any(all_values.values()):
        return ""
    lowest, highest = min(known), max(known)
    if score.is_bad > 0:
        lowest = 0.0
    if score.name == "seconds":  # rare waits would flatten the others
        highest = min(highest, 3 * float(np.median(known)))
    axis = Axis(f"{score.title}, {score.unit}", lowest, highest, all_values, bounds)

    dots, drawn, top = [], _drawn(made), axis.ticks()[-1]
    for record in made.records:
        target, name = rows.get(record.name, ""), f"{record.drive}, key {record.key}"
        if record.status == "failed":
            dots.append(Dot(record.drive, record.key, None, "", f"{name}: failed", target))
        elif record.status == "aside" or record.name in drawn:
            for series, style in of_score.items():
                if (value := series.of(record)) is None:
                    continue
                suspect = made.suspects.get(record.name, ())
                marks = {
                    "hollow": record.status == "aside",
                    "suspect": any(judgement.series == series for judgement in suspect),
                    "above": value > top,
                }
                style = " ".join([style, *(mark for mark, is_on in marks.items() if is_on)])
                of_camera = f"{name}, {series.camera}" if series.camera else name
                text = f"{of_camera}: {score.text(value)} {score.unit}"
                dots.append(Dot(record.drive, record.key, value, style, text, target))
    return score_plot(axis, dots)


def _drawn(made: JudgedSet) -> set[Key]:
    """Return the keys that have a dot: of many the worst, and others."""
    worst, half = made.worst_first, _NUM_DOTS // 2
    return {record.name for record in (*worst[:half], *worst[half :: len(worst) // half + 1])}


def _legend(made: JudgedSet) -> str:
    """Return what the marks of the plots mean as HTML, for the marks that they have."""
    dots = [
        '<span class="nowrap"><svg class="mark" viewBox="0 0 8 8"><circle cx="4" cy="4" r="3" '
        f'class="camera-{n % 6}"/></svg>&nbsp;{html.escape(name)}</span>'
        for n, name in enumerate(made.cameras)
        if len(made.cameras) > 1
    ]
    seconds = [record.seconds for record in made.worst_first] or [0.0]
    statuses, num_done = {record.status for record in made.records}, len(made.worst_first)
    num_drawn = len(_drawn(made))
    marks = {
        f"Cameras: {', '.join(dots)}.": bool(dots),
        f"Drawn are {num_drawn:,} of {num_done:,} keys, the worst and others; the histograms have "
        "all.": num_drawn < num_done,
        "Dashed: beyond it, a key is suspect.": bool(made.bounds),
        "Red: suspect.": bool(made.suspects),
        "Hollow: put aside.": "aside" in statuses,
        "Cross: failed.": "failed" in statuses,
        "Triangle: beyond the plot, as of keys that wait for compilation or registration.": (
            max(seconds) > 3 * float(np.median(seconds))
        ),
    }
    return " ".join(text for text, is_used in marks.items() if is_used)


def _anchor(kind: str, record: KeyRecord) -> str:
    return f"{kind}-{quote(record.drive)}-{record.key}"


def _small_card(
    made: JudgedSet, record: KeyRecord, cards: Mapping[Key, str], rows: Mapping[Key, str]
) -> str:
    """Return a small picture of a key's filled depth that leads to its card or row, as HTML."""
    camera = _worst_camera(made, record)
    try:
        depth = find_map(record, FILLED, camera)
        if depth is None:
            return ""
        stored = _shrink(read_stored(made.root / depth, np.uint16, "a map"), _WIDTH_OF_SMALL_PX)
        picture = _image(_draw_depth(metres(stored), None), f"key {record.key}")
    except (InputError, OSError):
        return ""
    name = html.escape(made.name_of(record))
    target = cards.get(record.name) or rows.get(record.name, "")
    style = ' class="suspect"' if record.name in made.suspects else ""
    label = f"{record.key} {html.escape(camera)}" if len(made.cameras) > 1 else f"{record.key}"
    link = f' href="#{target}"' if target else ""
    return f'<a{link}{style} title="{name}">{picture}{label}</a>'


def _card(made: JudgedSet, record: KeyRecord, width_px: int = _WIDTH_PX) -> str:
    """Return the pictures of a key with its scores, and a link to its own page or its command."""
    name, camera, pictures = made.name_of(record), _worst_camera(made, record), ""
    try:
        for picture in _pictures(made, record, camera, name, width_px):
            pictures += picture
    except (InputError, OSError) as error:
        pictures += f"<p>{html.escape(str(error))}</p>"
    suspect = made.suspects.get(record.name, ())
    why = "; ".join(judgement.reason(len(made.cameras) > 1) for judgement in suspect)
    texts = []
    for series in made.series:
        value = series.of(record) if series.camera in ("", camera) else None
        if value is not None and series.score.name in _ON_CARDS:
            text = f"{series.score.title.lower()} {series.score.text(value)} {series.score.unit}"
            is_suspect = any(judgement.series == series for judgement in suspect)
            unbroken = html.escape(text).replace(" ", "&nbsp;").replace("-", "&#8209;")
            texts.append(_marked(unbroken, is_suspect))
    worst = made.worst.get(record.name)
    if worst is not None and not suspect:
        why = f"its worst score: {worst.comparison(len(made.cameras) > 1)}"
    remarks = "; ".join(filter(None, [why, record.reason, *record.warnings]))
    files = ", ".join(
        f'<a href="{quote(path)}">{kind}</a>'
        for kind, kinds in (("measured", _MEASURED), ("filled", FILLED))
        if (path := find_map(record, kinds, camera))
    )
    files = f"{'<br>' if remarks else ''}Depth, 256 × metres: {files}" if files else ""
    return (
        f'<figure id="{_anchor("card", record)}"><figcaption>'
        f"{_link(name, _own_page(record))}, {html.escape(camera)}<br>{', '.join(texts)}"
        f'</figcaption><label><input type="checkbox">{pictures}</label>'
        f"<figcaption>{html.escape(remarks)}{files}{_page_command(made, record)}"
        "</figcaption></figure>"
    )


def _worst_camera(made: JudgedSet, record: KeyRecord) -> str:
    """Return the name of the camera of a key's worst score, or of the front camera."""
    worst = made.worst.get(record.name)
    return (worst.series.camera if worst else "") or front_camera(made.drives[record.drive])


def _page_command(made: JudgedSet, record: KeyRecord) -> str:
    """Return the command that makes the page of a key as HTML, "" if the key has one."""
    if _own_page(record).endswith("report.html"):
        return ""
    drive, table = made.drives[record.drive], made.table
    words = ["densify", "run", drive.data, "--key", str(record.key), "--report"]
    words += ["--window", str(table["window"]), "--method", table["method"]]
    words += [word for camera in table["cameras"] or () for word in ("--camera", camera)]
    command = html.escape(shlex.join(words))
    return f"<details><summary>Command for its own page</summary><code>{command}</code></details>"


def _pictures(
    made: JudgedSet, record: KeyRecord, camera: str, name: str, width_px: int
) -> Iterator[str]:
    """Yield the image, the two depth maps and the confidence of a key as HTML, if it has them."""
    drive, image = made.drives[record.drive], None
    kept = next((n for n in record.files if n.startswith(f"{_ASIDE}/")), None)
    for title, kinds in (("measured depth", _MEASURED), ("filled depth", FILLED)):
        if (depth := find_map(record, kinds, camera)) is None:
            continue
        stored = read_stored(made.root / depth, np.uint16, "a depth map")
        small_m = metres(_shrink(stored, width_px))
        if image is None:
            image = _small_image(drive, camera, record.key, small_m.shape[::-1])
            if image is not None:
                yield _image(image, f"image {camera}, {name}")
        yield _image(_draw_depth(small_m, image), f"{title} {camera}, {name}")
    if kept is not None:
        yield _embedded((made.root / kept).read_bytes(), f"filled depth, {name}")
    if (confidence := find_map(record, ("confidence",), camera)) is not None:
        stored = read_stored(made.root / confidence, np.uint8, "a map of confidence")
        stored = _shrink(stored, width_px)
        gray = np.interp((stored - 1.0) / 254, _CONFIDENCE, _GRAY)[:, :, None]
        picture = np.where(stored[:, :, None] > 0, gray, _NO_DEPTH_RGB).astype(np.uint8)
        yield _image(np.ascontiguousarray(picture), f"confidence, {name}")


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


def _key_table(made: JudgedSet, records: Sequence[KeyRecord], cards: Mapping[Key, str]) -> str:
    """Return a table of keys: name, scores of the worst camera, and remarks in a row below."""
    rows, attributes = [], []
    for record in records:
        target = cards.get(record.name)
        cells = [_link(made.name_of(record), f"#{target}" if target else _own_page(record))]
        for score in made.scores:
            value, camera = made.worst_value(score, record)
            text = _marked(score.text(value), made.is_suspect_in(score, record))
            cells.append(f"{text}<br><small>{html.escape(camera)}</small>" if camera else text)
        rows.append(cells)
        attributes.append(f' id="{_anchor("row", record)}"')
        status = "" if record.status == "done" else f"{record.status}: {record.reason}"
        if remarks := "; ".join(filter(None, [status, *record.warnings])):
            rows.append([f"<div>{html.escape(remarks)}</div>"])
            attributes.append(' class="remark"')
    heads = ["key", *(f"{score.title}, {score.unit}" for score in made.scores)]
    return _table(heads, rows, attributes)


def _table(
    heads: Iterable[str], rows: Iterable[Iterable[str]], attributes: Iterable[str] = repeat("")
) -> str:
    """Return the rows of a table, whose cells are HTML, with its head; "" without rows.

    The last cell of a short row reaches over the columns that the row lacks.
    """
    heads, body = list(heads), []
    for row, attribute in zip(rows, attributes, strict=False):
        *cells, last = row
        span = len(heads) - len(cells)
        reach = f' colspan="{span}"' if span > 1 else ""
        texts = "".join(f"<td>{cell}</td>" for cell in cells)
        body.append(f"<tr{attribute}>{texts}<td{reach}>{last}</td></tr>")
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    return "\n".join([f"<tr>{head}</tr>", *body]) if body else ""


# Pictures of a key


def front_camera(drive: Drive) -> str:
    """Return the name of a recording's camera that is shown: by its name the front camera."""
    return order_front_first([*drive.cameras], {}, {})[0]


def find_map(record: KeyRecord, kinds: tuple[str, ...], camera: str) -> str | None:
    """Return the path, relative to the set, of a camera's first map of one of these kinds."""
    paths = [PurePosixPath(name) for name in record.files]
    of_camera = (p for p in paths if camera in (p.stem, p.parent.name) and {*kinds} & {*p.parts})
    return next(map(str, of_camera), None)


def _shrink(values: NDArray[Any], width_px: int = _WIDTH_PX) -> NDArray[Any]:
    """Return a map with every n-th row and column, at least as wide as a picture if it can be."""
    step = max(1, values.shape[1] // width_px)
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


def kept_picture(out: Path, drive: Drive, key: int) -> Path:
    """Return the path of the picture of a key that is put aside."""
    return out / _ASIDE / drive.name / f"{key:010d}.jpg"


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
    path = kept_picture(out, drive, key)
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
