# SPDX-License-Identifier: MIT
"""The files of one key, ``OUT/000120/...``: results of ``run`` and tables of ``compare``, whole or
not at all.

``age/CAMERA.png`` holds, as 16 bit, milliseconds between the camera's exposure and the sweep that
measured the pixel, plus 1; 0 is no depth, and 65535 says 65.5 s or more. It covers the pixels of
``depth_filled``; filled ones have the age of the nearest measured pixel.

Keys of metrics.json; compare.json holds those from ``frames`` on under ``methods`` by method, and
data, config and versions as run.yaml::

    schema_version, key, method
    frames      of the window, absolute numbers
    num_points  of the cloud; num_moving of those
    density     camera -> measured, filled: fraction of the pixels with a depth
    ghosts      `densify.scores.ghosts.ghost_scores`: num_points, all, moving, static, by_distance,
                by_seconds
    depth       where there is truth: camera -> measured, filled -> all, moving, static -> the
                fields of `densify.scores.depth_metrics.DepthErrors`
    held_out    camera -> the same fields as depth: the key densified from its neighbours alone
                against its own returns; and curve,
                `densify.scores.depth_metrics.precision_density`, drawn in curve.png;
                null for the key sweep alone
    baselines   the same from ``frames`` on for each simpler method on the same registration

A score that nothing can be said of is null.
"""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from densify.errors import InputError, OutputError
from densify.outputs.atomic import staged_folder, write_file
from densify.outputs.cloud_laz import write_cloud
from densify.outputs.curve import draw_curve
from densify.outputs.depth_png import (
    write_age_png,
    write_confidence_png,
    write_depth_png,
    write_flow_png,
)
from densify.outputs.figure import draw_figure, draw_rejected
from densify.outputs.flow_npz import write_flow_files
from densify.outputs.png import Picture, write_picture
from densify.types import DepthMap, Result
from densify.version import __version__

Verb = Literal["run", "compare"]

SCHEMA_VERSION = 1
"""Of metrics.json and compare.json; grows when a key changes its meaning or goes."""

_OWNED: Mapping[Verb, tuple[str, ...]] = {
    "run": (
        *(
            "depth",
            "depth_filled",
            "confidence",
            "age",
            "flow",
            "movers",
            "optical_flow",
            "rejected",
        ),
        *("cloud.laz", "metrics.json", "figure.png", "curve.png", "run.yaml"),
    ),
    "compare": ("compare.json", "compare.png"),
}
_TITLES = {"none": "sparse"}  # of the figures' rows
_PACKAGES = (
    *("numpy", "scipy", "torch", "embreex", "kiss-icp"),
    *("opencv-python-headless", "laspy", "lazrs", "PyYAML"),
)


def check_writable(out: Path, key: int, overwrite: bool = False, verb: Verb = "run") -> None:
    """Find out before a computation whether its result can be written; touches nothing.

    out: the folder of ``--out``, which need not exist. Raises InputError if the files that ``verb``
    writes for ``key`` are there and not to be overwritten, or the place cannot be written to.
    """
    _check_place(_key_folder(out, key), _OWNED[verb], out, overwrite)


@contextmanager
def writing(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> Iterator[Path]:
    """A folder to write into that becomes ``folder`` if the block ends well, see `staged_folder`.

    owned: entries that are written. out: what ``--out`` says, for messages. Raises InputError if
    one of them is there and not to be overwritten, or the place cannot be written to.
    """
    _check_place(folder, owned, out, overwrite)
    try:
        with staged_folder(folder, owned) as staging:
            yield staging
    except OSError as error:
        raise OutputError(
            f"--out {out}: cannot be written: {error.strerror or error}; nothing was kept"
        ) from error


def _check_place(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> None:
    place = folder
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"--out {out}: {place} is not a folder; choose another one with --out DIR")
    # An old folder is emptied and, as a new one, put in place from beside it.
    beside = [Path(os.path.realpath(place)).parent] if place == folder else []
    for touched in (place, *beside):
        if not os.access(touched, os.W_OK | os.X_OK):
            raise InputError(
                f"--out {out}: no permission to write in {touched}; "
                f"choose another one with --out DIR"
            )
    present = [name for name in owned if (folder / name).exists()]
    if present and not overwrite:
        raise InputError(
            f"{folder}: {', '.join(present)} already there and kept; "
            f"give --overwrite to replace them or another --out DIR"
        )


def write_result(
    result: Result,
    images: Mapping[str, Picture],
    out: Path,
    *,
    config: Mapping[str, Any],
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """Write one densified key as ``out/KEY/``: depth, depth_filled, confidence and age of each
    camera, cloud.laz, metrics.json, figure.png and run.yaml.

    images: camera to (H,W,3) RGB; a camera without one is drawn on black. config: the merged
    configuration, as plain mappings. data: the recording, as the user named it. overwrite: replace
    an earlier result; whatever else lies in the folder is kept either way.

    figure.png shows the first camera: the result's baselines from top to bottom, then the result.

    Returns the files written. Raises InputError if the place cannot be written to, or holds a
    result already.
    """
    with writing(_key_folder(out, result.key), _OWNED["run"], out, overwrite) as folder:
        for name, depth in result.depth.items():
            _write_depth(folder, name, depth)
        write_cloud(folder / "cloud.laz", result.cloud)
        if result.flow is not None:
            write_flow_files(folder / "flow", result.flow)
        for instance, mover in result.movers.items():
            apart = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
            (apart / "depth").mkdir(parents=True)
            for name, maps in mover.depth.items():
                write_depth_png(apart / "depth" / f"{name}.png", maps.depth_m)
            write_cloud(apart / "cloud.laz", mover.cloud)
        for name, reason in result.rejected.items():
            (folder / "rejected").mkdir(exist_ok=True)
            image = images.get(name, np.zeros((*reason.shape, 3), np.uint8))
            write_picture(folder / "rejected" / f"{name}.png", draw_rejected(image, reason))
        for name, flows in result.optical_flow.items():
            for other, flow_px in flows.items():
                (folder / "optical_flow" / other).mkdir(parents=True, exist_ok=True)
                write_flow_png(folder / "optical_flow" / other / f"{name}.png", flow_px)
        _write_json(
            folder / "metrics.json",
            {
                "schema_version": SCHEMA_VERSION,
                "key": result.key,
                "method": result.method,
                **_scores(result),
                "baselines": {m: _scores(baseline) for m, baseline in result.baselines.items()},
            },
        )
        methods = {**result.baselines, result.method: result}
        _write_figure(folder / "figure.png", methods, images)
        _write_curve(folder / "curve.png", methods)
        _write_run(folder / "run.yaml", result, config, data)
    return _written(out, result.key, "run")


def write_comparison(
    results: Mapping[str, Result],
    images: Mapping[str, Picture],
    out: Path,
    *,
    config: Mapping[str, Any],
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """Write methods side by side as ``out/KEY/compare.json`` and ``compare.png``, beside the files
    of a run where there are some.

    results: method to result, of one key. The rest as `write_result`.
    """
    key = next(iter(results.values())).key
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": key,
        "data": data,
        "methods": {method: _scores(result) for method, result in results.items()},
        "config": config,
        "versions": _versions(),
    }
    with writing(_key_folder(out, key), _OWNED["compare"], out, overwrite) as folder:
        _write_json(folder / "compare.json", table)
        _write_figure(folder / "compare.png", results, images)
    return _written(out, key, "compare")


def _key_folder(out: Path, key: int) -> Path:
    return out / f"{key:06d}"


def _written(out: Path, key: int, verb: Verb) -> list[Path]:
    folder = _key_folder(out, key)
    files: list[Path] = []
    for name in _OWNED[verb]:
        entry = folder / name
        files += [entry] if entry.is_file() else sorted(f for f in entry.rglob("*") if f.is_file())
    return files


def _write_depth(folder: Path, camera: str, depth: DepthMap) -> None:
    if depth.age_s is None:
        raise ValueError(f"depth map of {camera}: expected ages, see densify.depth.age")
    for product in ("depth", "depth_filled", "confidence", "age"):
        (folder / product).mkdir(exist_ok=True)
    name = f"{camera}.png"
    write_depth_png(folder / "depth" / name, depth.depth_m)
    write_depth_png(folder / "depth_filled" / name, depth.filled_m)
    write_confidence_png(folder / "confidence" / name, depth.confidence, depth.filled_m)
    write_age_png(folder / "age" / name, depth.age_s, depth.filled_m)


def _scores(result: Result) -> dict[str, Any]:
    return {"frames": result.frames, **result.metrics}


def _write_figure(path: Path, results: Mapping[str, Result], images: Mapping[str, Picture]) -> None:
    """The measured depth of each method in the first camera, if there is one."""
    depth = next(iter(results.values())).depth
    if not depth:
        return
    camera = next(iter(depth))
    image = images.get(camera)
    if image is None:
        image = np.zeros((*depth[camera].depth_m.shape, 3), np.uint8)
    panels = {_TITLES.get(m, m): r.depth[camera].depth_m for m, r in results.items()}
    write_picture(path, draw_figure(image, panels))


def _write_curve(path: Path, results: Mapping[str, Result]) -> None:
    """Of the first camera, if any method was scored with the key held out."""
    curves = {
        method: next(iter(held_out.values()))["curve"]
        for method, result in results.items()
        if (held_out := result.metrics.get("held_out"))
    }
    if curves:
        write_picture(path, draw_curve(curves))


def _write_run(path: Path, result: Result, config: Mapping[str, Any], data: str) -> None:
    record = {
        "data": data,
        "key": result.key,
        "method": result.method,
        "frames": result.frames,
        "cameras": list(result.depth),
        "config": config,
        "stages": [
            {
                "name": cost.name,
                "seconds": round(cost.seconds, 3),
                "peak_memory_mb": round(cost.peak_memory_mb, 1),
            }
            for cost in result.costs
        ],
        "versions": _versions(),
    }
    text = yaml.safe_dump(plain(record), sort_keys=False, allow_unicode=True)
    write_file(path, text.encode())


def _versions() -> dict[str, str | None]:
    versions: dict[str, str | None] = {
        "densify": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:  # conda and system builds go by other names
            versions[package] = None
    return versions


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    write_file(path, (json.dumps(plain(value), indent=2, allow_nan=False) + "\n").encode())


def plain(value: Any) -> Any:
    """Numpy's numbers as Python's, tuples as lists, and None for what JSON cannot say (not finite
    numbers); for the files that people and other programs read."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
