# SPDX-License-Identifier: MIT
"""A finished run once more, in another form or with only what is certain and fresh enough.

The table of forms, a module each, is `config.plugins.exports`. The folder holds what the form owns,
and export.yaml::

    run             the folder of the run, as the user named it
    to              the form
    min_confidence  at least this certain, 0 to 1
    max_age_ms      not older than this; null for any age
    density         of forms with maps: camera -> measured, filled -> before, after: fraction of
                    the pixels
    num_points      of forms with the cloud: before, after
    version         of densify
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import yaml

from densify import __version__
from densify.config.errors import InputError
from densify.config.plugins.exports import EXPORTS, ExportFormat
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import Density, FinishedRun, Kept, finished_runs
from densify.outputs.store import writing

_RECORD = "export.yaml"


class ExportModule(Protocol):
    """What the module of a form has."""

    def write_export(self, run: FinishedRun, folder: Path) -> None:
        """Write the files that the form owns into a folder that appears when all are there.

        Raises InputError where the run lacks what the form needs. Same run, same bytes.
        """
        ...


class DriveModule(Protocol):
    """What the module of a form has that takes several keys as well."""

    def write_drive(self, runs: Sequence[FinishedRun], folder: Path) -> None:
        """As `ExportModule.write_export`; runs: by key."""
        ...


@dataclass(frozen=True)
class Export:
    """paths: the files written. density: camera to ``measured`` and ``filled``, of forms with maps.
    num_points: of forms with the cloud."""

    paths: list[Path]
    density: Mapping[str, Mapping[str, Density]]
    num_points: Kept | None = None


def export_run(
    run: Path,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    out: Path | None = None,
    overwrite: bool = False,
    to: str = "png",
    cameras: Sequence[str] | None = None,
) -> Export:
    """Write a finished run in another form, or with fewer pixels; nothing is computed again.

    run: the folder of one key, such as ``densify-out/000120``; of forms that take drives also one
    with several keys in it. min_confidence: 0 to 1; higher keeps fewer pixels, and points by their
    own, relative confidence. max_age_ms: 0 or more, between the exposure and the sweep that
    measured the pixel, or the key and the sweep that measured the point; lower keeps fewer; None
    for any age. Both are compared as the maps store them, in steps of 1/254 and 1 ms. A filled
    pixel goes by its own confidence and the age of the measured pixel nearest to it, and stays even
    if those around it go. out: the folder to make; if None, ``export`` in ``run``, and
    ``export/FORM`` for all but png. overwrite: replace an earlier export. to: a name of
    `densify.config.plugins.exports.EXPORTS`. cameras: only these, all if None.

    The folder is complete or not there. Raises InputError for a folder that is no run, thresholds
    out of range, files that are missing, damaged or do not belong together, a form that is none or
    cannot hold the run, and if ``out`` holds an export already or is a run, whose maps would be
    lost.
    """
    _check_thresholds(min_confidence, max_age_ms)
    form = EXPORTS.row(to, "--to")
    read = finished_runs if hasattr(EXPORTS.module(form), "write_drive") else _one_run
    runs = read(run, min_confidence, max_age_ms, cameras)
    folder = out or (run / "export" if to == "png" else run / "export" / to)
    if (folder / "run.yaml").exists():
        raise InputError(
            f"--out {folder}: holds a run, whose maps would be lost; choose another folder"
        )
    owned = (*form.owned, _RECORD)
    with writing(folder, owned, folder, overwrite) as staging:
        _write_form(form, runs, staging)
        asked = {
            "run": str(run),
            "to": to,
            "min_confidence": float(min_confidence),
            "max_age_ms": None if max_age_ms is None else float(max_age_ms),
        }
        density = runs[0].density if len(runs) == 1 else {}
        num_points = _sum([run.num_points for run in runs])
        write_file(staging / _RECORD, _record(asked, density, num_points))
        written = [
            folder / file.relative_to(staging)
            for name in owned
            for file in [staging / name, *sorted((staging / name).rglob("*"))]
            if file.is_file()
        ]
    return Export(written, density, num_points)


def _one_run(run: Path, *thresholds: Any) -> list[FinishedRun]:
    return [FinishedRun(run, *thresholds)]


def _write_form(form: ExportFormat, runs: Sequence[FinishedRun], staging: Path) -> None:
    module = EXPORTS.module(form)
    if len(runs) > 1:
        cast(DriveModule, module).write_drive(runs, staging)
    else:
        cast(ExportModule, module).write_export(runs[0], staging)
    if strays := sorted({entry.name for entry in staging.iterdir()} - {*form.owned}):
        raise InputError(
            f"--to {form.name}: wrote {', '.join(strays)}, expected nothing but "
            f"{', '.join(form.owned) or 'what OWNED names'}; mend {form.module}"
        )


def _sum(counts: Sequence[Kept | None]) -> Kept | None:
    known = [count for count in counts if count is not None]
    return Kept(sum(k.before for k in known), sum(k.after for k in known)) if known else None


def _record(
    asked: dict[str, Any],
    density: Mapping[str, Mapping[str, Density]],
    num_points: Kept | None,
) -> bytes:
    """What was asked for, and how much of the run was left."""
    record = dict(asked)
    if density:
        record["density"] = {
            camera: {product: asdict(value) for product, value in products.items()}
            for camera, products in density.items()
        }
    if num_points is not None:
        record["num_points"] = asdict(num_points)
    record["version"] = __version__
    return yaml.safe_dump(record, sort_keys=False, allow_unicode=True).encode()


def _check_thresholds(min_confidence: float, max_age_ms: float | None) -> None:
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")
