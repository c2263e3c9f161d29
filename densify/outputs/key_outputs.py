# SPDX-License-Identifier: MIT
"""Write the folder of a key, ``OUT/000120/``, all files or none; see docs/outputs.md."""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from densify.geometry.types import Result
from densify.outputs import flow_writers, plots
from densify.outputs.cloud_files import write_cloud
from densify.outputs.depth_png import (
    encode_jpeg,
    encode_png,
    map_path,
    write_age_png,
    write_confidence_png,
    write_depth_png,
    write_flow_png,
)
from densify.outputs.folders import (
    check_folder,
    check_recording,
    plain,
    write_file,
    write_json,
    writing,
)
from densify.outputs.report_page import KeyFiles, key_page
from densify.version import __version__

SCHEMA_VERSION = 1
"""Version of each JSON file. It grows when a field changes its meaning or is removed."""
_PACKAGES = (
    *("numpy", "scipy", "torch", "embreex", "kiss-icp", "small-gicp", "opencv-python-headless"),
    *("laspy", "lazrs", "PyYAML"),
)


def check_writable(
    out: Path, key: int, overwrite: bool = False, verb: Literal["run", "compare"] = "run"
) -> None:
    """Raise InputError if a result of ``verb`` cannot be written. No file is changed."""
    check_folder(_key_folder(out, key), _RUN if verb == "run" else _COMPARISON, out, overwrite)


def write_result(
    result: Result, out: Path, *, config: Mapping[str, Any], data: str, overwrite: bool = False
) -> list[Path]:
    """Write the result of one key sweep to ``out/KEY/`` and return the paths of the files.

    run.yaml records ``config``, the settings ``{section: {key: value}}``, and ``data``, the text of
    ``--data``. Raise InputError if the files exist, unless ``overwrite`` replaces them, or if
    ``out`` has results of another recording.
    """
    check_recording(out, result.recording, data, [result.key])
    with writing(_key_folder(out, result.key), _RUN, out, overwrite) as folder:
        for write in _WRITERS.values():
            write(result, folder)
        record = plain(_record(result, config, data))
        text = yaml.safe_dump(record, sort_keys=False, allow_unicode=True)
        write_file(folder / "run.yaml", text.encode())
        if config.get("output", {}).get("report"):
            page = key_page(KeyFiles.of_run(folder), f"{result.key:06d}")
            write_file(folder / "report.html", page)
    return _written(_key_folder(out, result.key), _RUN)


def write_comparison(
    results: Mapping[str, Result],
    out: Path,
    *,
    config: Mapping[str, Any],
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """Write compare.json, compare.png and the last method's ``compare/``, and return the paths.

    ``results`` has method -> result. The other arguments are those of `write_result`.
    """
    last = list(results.values())[-1]
    table = {
        "schema_version": SCHEMA_VERSION,
        **_record(last, config, data),
        "methods": {m: {"frames": r.frames, **r.metrics} for m, r in results.items()},
        "warnings": list(dict.fromkeys(w for r in results.values() for w in r.warnings)),
    }
    check_recording(out, last.recording, data, [last.key])
    with writing(_key_folder(out, last.key), _COMPARISON, out, overwrite) as folder:
        write_json(folder / "compare.json", table)
        plots.write_figure(folder / "compare.png", results)
        for write in (_write_maps, _write_cloud, _write_tracks, _write_scene):
            write(last, folder / "compare")
    return _written(_key_folder(out, last.key), _COMPARISON)


def _key_folder(out: Path, key: int) -> Path:
    return out / f"{key:06d}"


def _written(folder: Path, owned: Sequence[str]) -> list[Path]:
    """Return the paths of all files in the entries ``owned`` of a folder."""
    entries = [folder / name for name in owned]
    paths = [path for entry in entries for path in (entry, *sorted(entry.rglob("*")))]
    return [path for path in paths if path.is_file()]


def _write_maps(result: Result, folder: Path) -> None:
    """Write the maps ``depth``, ``depth_filled``, ``confidence`` and ``age`` of each camera."""
    for camera, depth in result.depth.items():
        if depth.age_s is None:
            raise ValueError(f"depth map of {camera}: expected ages (with_ages)")
        write_depth_png(map_path(folder, "depth", camera), depth.depth_m)
        write_depth_png(map_path(folder, "depth_filled", camera), depth.filled_m)
        path = map_path(folder, "confidence", camera)
        write_confidence_png(path, depth.confidence, depth.filled_m)
        write_age_png(map_path(folder, "age", camera), depth.age_s, depth.filled_m)


def _write_full(result: Result, folder: Path) -> None:
    """Write ``depth_full``, depth completed with the user's prior, and ``confidence_full``."""
    for camera, full in result.full.items():
        write_depth_png(map_path(folder, "depth_full", camera), full.depth_m)
        # At most 0.2 at pixels whose depth comes from the prior
        path = map_path(folder, "confidence_full", camera)
        write_confidence_png(path, full.confidence, full.depth_m)


def _write_optical_flow(result: Result, folder: Path) -> None:
    """Write ``optical_flow/previous`` and ``optical_flow/next`` of maps with optical flow."""
    for camera, flows in result.optical_flow.items():
        for direction, flow_px in flows.items():
            write_flow_png(map_path(folder / "optical_flow", direction, camera), flow_px)


def _write_cloud(result: Result, folder: Path) -> None:
    """Write the accumulated cloud as ``cloud.laz``."""
    write_cloud(folder / "cloud.laz", result.cloud, result.stamp_ns)


def _write_flow(result: Result, folder: Path) -> None:
    """Write the flow files ``flow/*.npz`` if ``output.flow`` asks for flow."""
    if result.flow is not None:
        flow_writers.write_flow_npz(folder / "flow", result.flow, result.recording)


def _write_movers(result: Result, folder: Path) -> None:
    """Write cloud and depth maps of each separated object to ``movers/0007/``."""
    for instance, mover in result.movers.items():
        # others: moving points without an object
        mover_folder = folder / "movers" / (f"{instance:04d}" if instance >= 0 else "others")
        for name, maps in mover.depth.items():
            write_depth_png(map_path(mover_folder, "depth", name), maps.depth_m)
        write_cloud(mover_folder / "cloud.laz", mover.cloud, result.stamp_ns)


def _write_figure(result: Result, folder: Path) -> None:
    """Write ``figure.png``: the maps of the baselines from top to bottom, then the result's."""
    plots.write_figure(folder / "figure.png", {**result.baselines, result.method: result})


def _write_metrics(result: Result, folder: Path) -> None:
    """Write ``metrics.json``, the scores of the result and of its baselines."""
    table = {
        "schema_version": SCHEMA_VERSION,
        **{name: getattr(result, name) for name in ("key", "method", "frames")},
        **result.metrics,
        "baselines": {m: {"frames": b.frames, **b.metrics} for m, b in result.baselines.items()},
    }
    write_json(folder / "metrics.json", table)


def _write_tracks(result: Result, folder: Path) -> None:
    """Write ``movers.json``, the poses of moving objects, if the sweeps are registered."""
    if not result.T_key_lidar:
        return
    fields = ("instance", "size_m", "seen_size_m", "sides_seen")
    fields_of_poses = ("stamp_ns", "num_points", "T_key_object", "velocity_m_s")
    objects = []
    for track in result.tracks:
        poses = [
            {"frame": frame, **{name: getattr(track, name)[row] for name in fields_of_poses}}
            for row, frame in enumerate(track.frames)
        ]
        objects.append({**{name: getattr(track, name) for name in fields}, "poses": poses})
    table = {"schema_version": SCHEMA_VERSION, "key": result.key, "objects": objects}
    write_json(folder / "movers.json", table)


def _record(result: Result, config: Mapping[str, Any], data: str) -> dict[str, Any]:
    """Return how a result was made: recording, key, configuration, cost of each stage, versions."""
    versions: dict[str, str | None] = {"densify": __version__, "python": platform.python_version()}
    versions["platform"] = platform.platform()
    for package in _PACKAGES:
        versions[package] = None  # unknown, as in system builds
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    copied = ("key", "stamp_ns", "method", "frames", "far_frames", "far_left_out")
    return {
        "recording": result.recording,
        "data": data,
        **{name: getattr(result, name) for name in copied},
        "cameras": list(result.depth),
        "prior": {
            name: {"source": full.source, **asdict(full.fit), "share": full.from_prior.mean()}
            for name, full in result.full.items()
        },
        "warnings": result.warnings,
        "config": config,
        "elapsed_s": round(result.elapsed_s, 3),
        "stages": [
            {"name": cost.name, "seconds": round(cost.seconds, 3)}
            | {"peak_memory_mb": round(cost.peak_memory_mb, 1)}
            for cost in result.costs
        ],
        "versions": versions,
    }


def _write_scene(result: Result, folder: Path) -> None:
    """Write the folder ``scene/`` if the sweeps are registered."""
    if not result.T_key_lidar:
        return
    scene, sweeps = folder / "scene", _sweeps(result)
    row_of = {sweep["frame"]: row for row, sweep in enumerate(sweeps)}
    for name, maps in result.depth.items():
        if name in result.images:
            image = encode_jpeg(result.images[name])
            write_file(map_path(scene, "image", name, ".jpg"), image)
        for method, baseline in result.baselines.items():
            write_depth_png(map_path(scene, method, name), baseline.depth[name].depth_m)
        if name in result.truth_m:
            write_depth_png(map_path(scene, "truth", name), result.truth_m[name])
        # Frame number -> 1 + index of the sweep. Frame -1, no sweep, takes the last entry, 0.
        lookup = np.zeros(max(row_of) + 2, np.uint16)
        lookup[[*row_of]] = 1 + np.arange(len(row_of))
        write_file(map_path(scene, "sweep", name), encode_png(lookup[maps.frame]))
        if name in result.rejected:
            write_file(map_path(scene, "reason", name), encode_png(result.rejected[name]))
    views = {
        name: {**vars(view.camera), **{n: v for n, v in vars(view).items() if n != "camera"}}
        for name, view in result.views.items()
    }
    table = {"schema_version": SCHEMA_VERSION, "key": result.key, "sweeps": sweeps, "views": views}
    write_json(scene / "scene.json", table)


def _sweeps(result: Result) -> list[dict[str, Any]]:
    """Return entries of scene.json for all source sweeps and the window, by frame number."""
    frames, rows = np.unique(result.cloud.frame, return_index=True)
    since_s = dict(zip(frames.tolist(), 1e-9 * result.cloud.since_key_ns[rows], strict=True))
    far = {*result.far_frames} - {*result.T_key_lidar}
    return [
        {
            "frame": frame,
            "since_key_s": since_s.get(frame),
            "far": frame in far,
            "T_key_lidar": result.T_key_lidar.get(frame),
        }
        for frame in sorted({*since_s, *result.T_key_lidar})
    ]


_WRITERS: Mapping[tuple[str, ...], Callable[[Result, Path], None]] = {
    ("depth", "depth_filled", "confidence", "age"): _write_maps,
    ("depth_full", "confidence_full"): _write_full,
    ("flow",): _write_flow,
    ("movers",): _write_movers,
    ("movers.json",): _write_tracks,
    ("optical_flow",): _write_optical_flow,
    ("cloud.laz",): _write_cloud,
    ("scene",): _write_scene,
    ("metrics.json",): _write_metrics,
    ("figure.png",): _write_figure,
    ("curve.png",): plots.write_curve,
}
"""Names of the entries in the folder of a key sweep, and the function that writes them.

A function writes no entry if the result lacks its content. Equal results give equal bytes."""

_RUN = (*(name for names in _WRITERS for name in names), "run.yaml", "report.html")
_COMPARISON = ("compare.json", "compare.png", "compare", "compare.html")
