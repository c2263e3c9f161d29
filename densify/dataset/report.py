# SPDX-License-Identifier: MIT
"""Pages in their places: ``report.html`` of a run or a training set, ``compare.html`` of a
comparison. The page of many keys shows a training set, or the keys of a folder of runs."""

from __future__ import annotations

import os
import re
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from densify import __version__
from densify.config.errors import InputError, OutputError
from densify.config.file_content import read_json, read_yaml
from densify.dataset.key import scores_of_metrics
from densify.dataset.manifest import KeyRecord, read_manifests
from densify.dataset.plan import planned_keys, read_plan
from densify.geometry.types import Progress, Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.kitti_tree import FileRecord
from densify.outputs.report.key_files import KeyFiles
from densify.outputs.report.key_page import key_page
from densify.outputs.report.page_file import Blobs, page_file
from densify.outputs.report.thumbnails import sheets

_SCRIPTS = ("unpack.js", "dom.js", "colours.js", "rows.js", "set.js")
_SHOWN_MAP = re.compile(r"(^|/)(proj_depth/groundtruth|\d{6,}/depth)/[^/]+(/[^/]+)?\.png")
_PER_CAMERA = ("density", "density_filled", "outliers", "mae_m")
_WHOLE = ("num_points", "num_moving", "ghost")


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


def write_report(
    place: Path,
    out: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Make the page or pages of what lies in a folder; return them.

    place: a key's folder of ``run`` or ``compare``, such as densify-out/000120, the folder above
        some of them, or a training set.
    out: the file to write; if None ``report.html`` of a run or a set, ``compare.html`` of a
        comparison, beside their files. overwrite: replace an earlier page.

    The page tells what is damaged or missing. Raises InputError for a folder that is none of these,
    one whose main files are damaged, and a page that is there already, OutputError if it cannot be
    written.
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
    """Return path -> what makes the page for the folder it will be in."""
    if not place.is_dir():
        raise InputError(
            f"{place}: no such folder; expected what densify run, compare or dataset wrote"
        )
    if (place / "dataset.json").is_file():
        return {place / "report.html": lambda there: _set_page(place, there, progress)}
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
    return {place / "report.html": lambda there: _runs_page(place, runs, there, progress)}


def _set_page(root: Path, shown_from: Path, progress: Progress | None) -> bytes:
    """Return the page of a training set. shown_from: the folder to which links are relative."""
    table = read_plan(root)
    if table is None:
        raise InputError(f"{root}: no dataset.json in it; expected a training set's folder")
    records = read_manifests(root)
    limits = [f"{k} {v}" for k, v in table["gate"].items() if v is not None]
    about = {
        **{name: table[name] for name in ("layout", "method", "window", "densify")},
        "quality gate": ", ".join(limits) or "none",
        "recordings": ", ".join(table["drives"]),
    }
    config = [
        (f"{section}.{knob}", str(value))
        for section, knobs in table["config"].items()
        for knob, value in _mapping(knobs).items()
    ]
    num_left = len(planned_keys(table) - records.keys())
    more = {"about": list(about.items()), "config": config, "num_left": num_left}
    return _page(root, shown_from, list(records.values()), more, progress)


def _runs_page(
    root: Path, folders: Sequence[Path], shown_from: Path, progress: Progress | None
) -> bytes:
    """Return the page of several keys that ``run`` wrote into folders of one folder."""
    records = [_record_of_run(folder) for folder in folders]
    drives = ", ".join(sorted({record.drive for record in records}))
    more = {"about": [("recordings", drives)], "config": [], "num_left": 0}
    return _page(root, shown_from, records, more, progress)


def _page(
    root: Path,
    shown_from: Path,
    records: Sequence[KeyRecord],
    more: Mapping[str, Any],
    progress: Progress | None,
) -> bytes:
    cameras = sorted({c for r in records for c in _mapping(r.scores.get("density"))})
    maps = [_first_map(record, root) for record in records]
    shown = {row: path for row, path in enumerate(maps) if path is not None}
    blobs = Blobs()
    pictures, found = sheets(blobs, list(shown.values()), progress)
    places = {row: at for at, (row, there) in enumerate(zip(shown, found, strict=True)) if there}
    title = f"{root.resolve().name}: {len(records):,} keys"
    rows = [
        {**_row(record, path, cameras, shown_from), "picture": places.get(row)}
        for row, (record, path) in enumerate(zip(records, maps, strict=True))
    ]
    footer = f"densify {__version__}; links lead to the files beside this page."
    data = {**more, "title": title, "footer": footer, "cameras": cameras, "pictures": pictures}
    return page_file("set.html", _SCRIPTS, title, {**data, "rows": rows}, blobs)


def _row(
    record: KeyRecord, shown: Path | None, cameras: Sequence[str], shown_from: Path
) -> dict[str, Any]:
    """Return a row of the table. shown: the key's depth map, to which the row leads unless the key
    has a page of its own."""
    per_camera = {name: _mapping(record.scores.get(name)) for name in _PER_CAMERA}
    folders = [place for place in shown.parents if place.name == "depth"] if shown else []
    page = folders[0].parent / "report.html" if folders else None
    is_page = page is not None and page.is_file()
    linked = page if is_page else shown
    link = ""
    if linked is not None:
        relative = os.path.relpath(linked.resolve(), shown_from.resolve())
        link = urllib.parse.quote(Path(relative).as_posix())
    return {
        "drive": record.drive,
        "key": record.key,
        "status": record.status,
        "reason": record.reason or "; ".join(record.warnings),
        "sweeps": len(record.frames),
        "seconds": record.seconds,
        **{name: _number(record.scores.get(name)) for name in _WHOLE},
        **{n: [_number(values.get(c)) for c in cameras] for n, values in per_camera.items()},
        "link": link,
        "is_page": is_page,
    }


def _record_of_run(folder: Path) -> KeyRecord:
    """Return the record of a key that ``run`` wrote; a damaged one counts as failed."""
    try:
        about, _ = read_yaml(folder / "run.yaml")
        stages = [_mapping(stage) for stage in about.get("stages") or ()]
        maps = [p.relative_to(folder.parent) for p in (folder / "depth").rglob("*.png")]
        return KeyRecord(
            str(about.get("data")),
            int(about["key"]),
            "done",
            frames=tuple(about.get("frames") or ()),
            files={path.as_posix(): FileRecord(0, 64 * "0") for path in maps},
            scores=scores_of_metrics(read_json(folder / "metrics.json")),
            seconds=sum(_number(stage.get("seconds")) or 0.0 for stage in stages),
            warnings=tuple(map(str, about.get("warnings") or ())),
        )
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        return KeyRecord(folder.name, 0, "failed", str(error) or type(error).__name__)


def _first_map(record: KeyRecord, root: Path) -> Path | None:
    """Return the depth map of the first camera; names that lead out of the set are none."""
    names = sorted(name for name in record.files if _SHOWN_MAP.search(name))
    inside = [n for n in names if not PurePosixPath(n).is_absolute() and ".." not in Path(n).parts]
    return root / inside[0] if inside else None


def _number(value: Any) -> float | None:
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
