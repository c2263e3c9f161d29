# SPDX-License-Identifier: MIT
"""A finished run in other tools' formats, optionally with only the certain and recent pixels.

`config.written` is the table of forms. Beside the files of the form lies export.yaml::

    run             the folder of the run, as the user named it
    to              the form
    min_confidence  0 to 1
    max_age_ms      null for any age
    density         of forms with maps: camera -> measured, filled -> before, after: fraction of
                    the pixels
    num_points      of forms with the cloud: before, after
    version         of densify
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify import __version__
from densify.config.errors import InputError
from densify.config.written import EXPORTS
from densify.outputs.export.finished_run import FinishedRun, Kept, finished_runs
from densify.outputs.plain import plain
from densify.outputs.store import writing

_RECORD = "export.yaml"

WriteExport = Callable[[FinishedRun, Path], None]
"""Writes the files of a form into a folder that appears when all are there. Raises InputError where
the run lacks what the form needs. A form of drives takes a list of runs, ascending by key."""


@dataclass(frozen=True)
class Export:
    """The files written, and what the thresholds left.

    density: camera -> ``measured`` and ``filled``, fractions of the pixels, of forms with maps.
    num_points: of forms with the cloud.
    """

    paths: list[Path]
    density: Mapping[str, Mapping[str, Kept]]
    num_points: Kept | None = None


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
    """Write a finished run in another form. Nothing is computed again.

    run: the folder of one key, such as ``densify-out/000120``, or of several keys for forms of
        drives.
    to: a name of `densify.config.written.EXPORTS`.
    out: the folder to make; ``RUN/export/FORM`` if None.
    min_confidence: 0 to 1. Pixels and points with less are left out.
    max_age_ms: greatest time between the exposure, or the key, and the sweep that measured the
        pixel or point; None for any. A filled pixel has the age of the nearest measured pixel.
    cameras: only these; all if None. overwrite: replace an earlier export.

    Raises InputError for thresholds out of range, files that are missing, damaged or inconsistent,
    a form that cannot hold the run, and an ``out`` that holds an export or a run.
    """
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")
    form = EXPORTS.row(to, "--to")
    read = finished_runs if form.of_drive else lambda *arguments: [FinishedRun(*arguments)]
    runs = read(run, min_confidence, max_age_ms, cameras)
    folder = out or run / "export" / to
    if (folder / "run.yaml").exists():
        raise InputError(f"--out {folder}: holds a run and is kept; choose another folder")
    write = getattr(form.work(), form.function)
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
    """Return density and num_points as plain mappings, without those that are not known."""
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
