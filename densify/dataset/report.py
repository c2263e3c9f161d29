# SPDX-License-Identifier: MIT
"""Pages in their places: ``report.html`` of a run or a training set, ``compare.html`` of a
comparison. The page of many keys shows a training set, or the keys of a folder of runs."""

from __future__ import annotations

import os
import re
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
from densify.outputs.report.key_files import KeyFiles
from densify.outputs.report.key_page import key_page
from densify.outputs.report.page_file import Blobs, page_file
from densify.outputs.report.thumbnails import sheets

_SCRIPTS = ("unpack.js", "dom.js", "colours.js", "rows.js", "set.js")
_SHOWN_MAP = re.compile(r"(^|/)(proj_depth/groundtruth|\d{6,}/depth)/[^/]+(/[^/]+)?\.png")
_PER_CAMERA = ("density", "density_filled", "outliers", "mae_m")
_WHOLE = ("num_points", "num_moving", "ghost")


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


@dataclass(frozen=True)
class _Key:
    """A row. status, reason, scores: as of a `KeyRecord`. shown: its first depth map."""

    drive: str
    key: int
    status: str
    reason: str
    num_sweeps: int = 0
    seconds: float = 0.0
    scores: Mapping[str, Any] = field(default_factory=dict)
    shown: Path | None = None


def _set_page(root: Path, shown_from: Path, progress: Progress | None = None) -> bytes:
    """The page of a training set. root: its folder. shown_from: the page's, to which links are
    relative. Raises InputError where there is no set, or its description is damaged."""
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
    num_left = len(planned_keys(table) - records.keys())
    keys = [_of_record(record, root) for record in records.values()]
    return _page(root, shown_from, keys, about, num_left, table["config"], progress)


def _runs_page(
    root: Path, folders: Sequence[Path], shown_from: Path, progress: Progress | None = None
) -> bytes:
    """The page of several keys that ``run`` wrote into one folder. folders: the keys'. The rest as
    `set_page`."""
    keys = [_of_run(folder) for folder in folders]
    about = {"recordings": ", ".join(sorted({key.drive for key in keys}))}
    return _page(root, shown_from, keys, about, 0, {}, progress)


def _page(
    root: Path,
    shown_from: Path,
    keys: Sequence[_Key],
    about: Mapping[str, Any],
    num_left: int,
    config: Mapping[str, Any],
    progress: Progress | None,
) -> bytes:
    cameras = sorted({c for key in keys for c in _mapping(key.scores.get("density"))})
    shown = {row: key.shown for row, key in enumerate(keys) if key.shown is not None}
    blobs = Blobs()
    pictures, found = sheets(blobs, list(shown.values()), progress)
    places = {row: at for at, (row, there) in enumerate(zip(shown, found, strict=True)) if there}
    title = f"{root.resolve().name}: {len(keys):,} keys"
    data = {
        "title": title,
        "footer": f"densify {__version__}; links lead to the files beside this page.",
        "about": list(about.items()),
        "config": [
            (f"{section}.{knob}", str(value))
            for section, knobs in config.items()
            for knob, value in _mapping(knobs).items()
        ],
        "cameras": cameras,
        "num_left": num_left,
        "pictures": pictures,
        "rows": [
            {**_row(key, cameras, shown_from), "picture": places.get(row)}
            for row, key in enumerate(keys)
        ],
    }
    return page_file("set.html", _SCRIPTS, title, data, blobs)


def _row(key: _Key, cameras: Sequence[str], shown_from: Path) -> dict[str, Any]:
    per_camera = {name: _mapping(key.scores.get(name)) for name in _PER_CAMERA}
    page = None if key.shown is None else _key_page(key.shown)
    linked = page or key.shown
    return {
        "drive": key.drive,
        "key": key.key,
        "status": key.status,
        "reason": key.reason,
        "sweeps": key.num_sweeps,
        "seconds": key.seconds,
        **{name: _number(key.scores.get(name)) for name in _WHOLE},
        **{n: [_number(values.get(c)) for c in cameras] for n, values in per_camera.items()},
        "link": "" if linked is None else _link(linked, shown_from),
        "is_page": page is not None,
    }


def _of_record(record: KeyRecord, root: Path) -> _Key:
    return _Key(
        record.drive,
        record.key,
        record.status,
        record.reason or "; ".join(record.warnings),
        len(record.frames),
        record.seconds,
        record.scores,
        _shown_map(record, root),
    )


def _of_run(folder: Path) -> _Key:
    """One that is damaged counts as failed."""
    try:
        about, _ = read_yaml(folder / "run.yaml")
        stages = [_mapping(stage) for stage in about.get("stages") or ()]
        return _Key(
            str(about.get("data")),
            int(about["key"]),
            "done",
            "; ".join(map(str, about.get("warnings") or ())),
            len(about.get("frames") or ()),
            sum(_number(stage.get("seconds")) or 0.0 for stage in stages),
            scores_of_metrics(read_json(folder / "metrics.json")),
            next(iter(sorted((folder / "depth").rglob("*.png"))), None),
        )
    except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
        return _Key(folder.name, 0, "failed", str(error) or type(error).__name__)


def _shown_map(record: KeyRecord, root: Path) -> Path | None:
    """The depth map of the first camera; names that lead out of the set are none."""
    names = sorted(name for name in record.files if _SHOWN_MAP.search(name))
    inside = [n for n in names if not PurePosixPath(n).is_absolute() and ".." not in Path(n).parts]
    return root / inside[0] if inside else None


def _key_page(shown: Path) -> Path | None:
    """The key's own page, where it has one."""
    folders = [place for place in shown.parents if place.name == "depth"]
    page = folders[0].parent / "report.html" if folders else None
    return page if page is not None and page.is_file() else None


def _link(path: Path, shown_from: Path) -> str:
    relative = os.path.relpath(path.resolve(), shown_from.resolve())
    return urllib.parse.quote(Path(relative).as_posix())


def _number(value: Any) -> float | None:
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
