# SPDX-License-Identifier: MIT
"""Write a finished run in the formats of other tools, listed in `config.plugins.EXPORTS`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import import_extra
from densify.config.plugins import EXPORTS
from densify.geometry.types import Float32
from densify.outputs.atomic import plain
from densify.outputs.cloud_files import save_ply
from densify.outputs.depth_png import confidence_of, map_path, metres
from densify.outputs.finished_run import FinishedRun, Kept, Thresholds, finished_runs
from densify.outputs.key_outputs import writing
from densify.version import __version__

# Fields: run, to (format), min_confidence, max_age_ms (null for any age), density (camera ->
# measured, filled -> before, after the thresholds: shares of the pixels), num_points, version
_RECORD = "export.yaml"


@dataclass(frozen=True)
class Export:
    """The written files, and the pixels and points within the thresholds."""

    paths: list[Path]  # paths of the files
    # Camera -> ``measured``, ``filled`` -> share of the pixels with a depth, for formats with maps
    density: Mapping[str, Mapping[str, Kept]]
    num_points: Kept | None = None  # number of points, for formats with a cloud


def export_run(
    run: Path,
    to: str,
    out: Path | None = None,
    *,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    cameras: Sequence[str] | None = None,
    overwrite: bool = False,
) -> Export:
    """Write a finished run in another format, from its files alone; return what was written.

    Args:
        run: Folder of one key sweep, or of several for formats of whole drives.
        to: Name of a format in `densify.config.plugins.EXPORTS`.
        out: Folder to write into, None for ``RUN/export/FORMAT``.
        min_confidence: Least confidence of pixels and points, 0 to 1.
        max_age_ms: Greatest time from the measurement to the exposure (pixels) or the key sweep
            (points); None for any.
        cameras: Names of the cameras, None for all.
        overwrite: True to replace an earlier export.

    Raises:
        InputError: An argument is out of range or unknown, the run is damaged, or files exist.
    """
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")
    if to not in EXPORTS:
        hint = did_you_mean(to, EXPORTS)
        raise InputError(f"--to: got {to!r}, {hint}expected one of {', '.join(EXPORTS)}")
    form, thresholds = EXPORTS[to], Thresholds(min_confidence, max_age_ms, cameras)
    runs = finished_runs(run, thresholds) if form.of_drive else [FinishedRun(run, thresholds)]
    folder = out or run / "export" / to
    if (folder / "run.yaml").exists():
        raise InputError(f"--out {folder}: holds a run and is kept; choose another folder")
    module = import_module(f"densify.outputs.{form.module}")
    write = getattr(module, f"write_{to.replace('-', '_')}")
    with writing(folder, (*form.owned, _RECORD), folder, overwrite) as staging:
        write(runs if form.of_drive else runs[0], staging)
        counts = [run.num_points for run in runs if run.num_points is not None]
        num_points = Kept(*map(sum, zip(*counts, strict=True))) if counts else None
        export = Export([], runs[0].density if len(runs) == 1 else {}, num_points)
        record = {
            "run": str(run),
            "to": to,
            "min_confidence": float(min_confidence),
            "max_age_ms": max_age_ms,
            **facts(export),
            "version": __version__,
        }
        (staging / _RECORD).write_text(yaml.safe_dump(plain(record), sort_keys=False), "utf-8")
        files = sorted(path.relative_to(staging) for path in staging.rglob("*") if path.is_file())
    return replace(export, paths=[folder / path for path in files])


def facts(export: Export) -> dict[str, Any]:
    """Return the known ones of the fields ``density`` and ``num_points`` of export.yaml."""
    density = {
        camera: {product: kept._asdict() for product, kept in products.items()}
        for camera, products in export.density.items()
    }
    num_points = export.num_points and export.num_points._asdict()
    values = {"density": density, "num_points": num_points}
    return {name: value for name, value in values.items() if value}


def write_npy(run: FinishedRun, folder: Path) -> None:
    """Write each map as (H,W) float32 .npy: depth, depth_filled (metres, 0 none) and confidence."""
    for path, _, values in _maps(run, folder, ".npy"):
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, values)


def write_exr(run: FinishedRun, folder: Path) -> None:
    """Write the maps of `write_npy` as 32-bit OpenEXR, channel Z for depth, Y for confidence."""
    for path, kind, values in _maps(run, folder, ".exr"):
        save_exr(path, "Y" if kind == "confidence" else "Z", values)


def save_exr(path: Path, channel: str, values: Float32) -> None:
    """Write (H,W) float32 as an OpenEXR file with one channel."""
    library = import_extra("OpenEXR", "exr", "EXR files")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    path.parent.mkdir(parents=True, exist_ok=True)
    library.File(header, {channel: values}).write(str(path))


def _maps(run: FinishedRun, folder: Path, suffix: str) -> Iterator[tuple[Path, str, Float32]]:
    """Yield path, kind and (H,W) values of the three maps of each camera."""
    for camera in run.cameras:
        maps = run.maps(camera)
        for kind in ("depth", "depth_filled", "confidence"):
            values = (confidence_of if kind == "confidence" else metres)(maps[kind])
            yield map_path(folder, kind, camera, suffix), kind, values


def write_ply(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.ply`` with every column of cloud.laz (`StoredCloud.columns`)."""
    save_ply(folder / "cloud.ply", run.cloud().columns())


def write_pcd(run: FinishedRun, folder: Path) -> None:
    """Write ``cloud.pcd``, binary PCD 0.7 with the same columns, colour as one float ``rgb``."""
    from pypcd4 import Encoding, PointCloud

    columns = run.cloud().columns()
    rgb = np.stack([columns.pop(name) for name in ("red", "green", "blue")], axis=1)
    columns["rgb"] = PointCloud.encode_rgb(rgb)
    types = [column.dtype.type for column in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), types)
    cloud.save(folder / "cloud.pcd", Encoding.BINARY)
