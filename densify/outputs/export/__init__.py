# SPDX-License-Identifier: MIT
"""Write a finished run in the formats of other tools, listed in `config.plugins.EXPORTS`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify.config.errors import InputError, did_you_mean
from densify.config.plugins import EXPORTS
from densify.outputs.atomic import plain
from densify.outputs.export.finished_run import FinishedRun, Kept, finished_runs
from densify.outputs.store import writing
from densify.version import __version__

# Fields: run, to (format), min_confidence, max_age_ms (null for any age), density (camera ->
# measured, filled -> before, after the thresholds: shares of the pixels), num_points, version
_RECORD = "export.yaml"


@dataclass(frozen=True)
class Export:
    """The written files, and the pixels and points within the thresholds."""

    paths: list[Path]  # paths of the files
    # Camera -> ``measured`` and ``filled`` -> share of the pixels with a depth, for formats with
    # maps
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
    """Write a finished run in another format, from its files alone.

    Args:
        run: Folder of one key sweep, or of several for formats of whole drives.
        to: Name of a format in `densify.config.plugins.EXPORTS`.
        out: Folder to write into, None for ``RUN/export/FORMAT``.
        min_confidence: Least confidence of an exported pixel or point, 0 to 1.
        max_age_ms: Greatest time from the source sweep to the image's exposure (pixels) or the key
            sweep (points), None for any. A filled pixel has the age of the nearest measured pixel.
        cameras: Names of the cameras, None for all.
        overwrite: Replace an earlier export.
    """
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")
    if to not in EXPORTS:
        hint = did_you_mean(to, EXPORTS)
        raise InputError(f"--to: got {to!r}, {hint}expected one of {', '.join(EXPORTS)}")
    form = EXPORTS[to]
    read = finished_runs if form.of_drive else lambda *arguments: [FinishedRun(*arguments)]
    runs = read(run, min_confidence, max_age_ms, cameras)
    folder = out or run / "export" / to
    if (folder / "run.yaml").exists():
        raise InputError(f"--out {folder}: holds a run and is kept; choose another folder")
    write = getattr(
        import_module(f"densify.outputs.export.{form.module}"), f"write_{to.replace('-', '_')}"
    )
    owned = (*form.owned, _RECORD)
    with writing(folder, owned, folder, overwrite) as staging:
        write(runs if form.of_drive else runs[0], staging)
        export = Export([], runs[0].density if len(runs) == 1 else {}, _total(runs))
        asked = {"run": str(run), "to": to, "min_confidence": float(min_confidence)}
        record = {**asked, "max_age_ms": max_age_ms, **facts(export), "version": __version__}
        (staging / _RECORD).write_text(yaml.safe_dump(plain(record), sort_keys=False), "utf-8")
        files = sorted(path.relative_to(staging) for path in staging.rglob("*") if path.is_file())
    return replace(export, paths=[folder / path for path in files])


def facts(export: Export) -> dict[str, Any]:
    """Return the fields ``density`` and ``num_points`` of export.yaml, without unknown values."""
    density = {
        camera: {product: kept._asdict() for product, kept in products.items()}
        for camera, products in export.density.items()
    }
    num_points = export.num_points and export.num_points._asdict()
    known = {"density": density, "num_points": num_points}
    return {name: value for name, value in known.items() if value}


def _total(runs: Sequence[FinishedRun]) -> Kept | None:
    known = [run.num_points for run in runs if run.num_points is not None]
    return Kept(sum(k.before for k in known), sum(k.after for k in known)) if known else None
