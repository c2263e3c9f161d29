# SPDX-License-Identifier: MIT
"""A finished run's depth maps once more, with only the pixels that are certain and fresh enough.

The folder, ``OUT/000120/export`` if not named, holds depth, depth_filled, confidence and age as the
run does, and export.yaml::

    run             the folder of the run, as the user named it
    min_confidence  at least this certain, 0 to 1
    max_age_ms      not older than this; null for any age
    density         camera -> measured, filled -> before, after: fraction of the pixels
    version         of densify
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from densify.errors import InputError
from densify.outputs.atomic import write_file
from densify.outputs.depth_png import read_stored, stored_age, stored_confidence
from densify.outputs.png import encode_png
from densify.outputs.store import writing
from densify.types import Bool
from densify.version import __version__

_KINDS: Mapping[str, type[np.uint8] | type[np.uint16]] = {
    "depth": np.uint16,
    "depth_filled": np.uint16,
    "confidence": np.uint8,
    "age": np.uint16,
}
_OWNED = (*_KINDS, "export.yaml")


@dataclass(frozen=True)
class Density:
    """Fractions of the pixels that have a depth."""

    before: float
    after: float


@dataclass(frozen=True)
class Export:
    """paths: the files written. density: camera to ``measured`` and ``filled``."""

    paths: list[Path]
    density: Mapping[str, Mapping[str, Density]]


def export_run(
    run: Path,
    min_confidence: float = 0.0,
    max_age_ms: float | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> Export:
    """Write the depth maps of a finished run with fewer pixels; nothing is computed again.

    run: the folder of one key, such as ``densify-out/000120``. min_confidence: 0 to 1; higher keeps
    fewer pixels. max_age_ms: 0 or more, between the exposure and the sweep that measured the pixel;
    lower keeps fewer; None for any age. Both are compared as the maps store them, in steps of 1/254
    and 1 ms. A filled pixel goes by its own confidence and the age of the measured pixel nearest to
    it, and stays even if those around it go. out: the folder to make, ``export`` in ``run`` if
    None. overwrite: replace an earlier export.

    The folder is complete or not there. Raises InputError for a folder that is no run, thresholds
    out of range, maps that are missing, damaged or do not belong together, and if ``out`` holds an
    export already or is a run, whose maps would be lost.
    """
    _check_thresholds(min_confidence, max_age_ms)
    cameras = _cameras(run)
    folder = run / "export" if out is None else out
    if (folder / "run.yaml").exists():
        raise InputError(
            f"--out {folder}: holds a run, whose maps would be lost; choose another folder"
        )
    density: dict[str, dict[str, Density]] = {}
    with writing(folder, _OWNED, folder, overwrite) as staging:
        for camera in cameras:
            for product in _KINDS:
                (staging / product / camera).parent.mkdir(parents=True, exist_ok=True)
            maps = _read_maps(run, camera)
            keep = maps["confidence"] >= stored_confidence(min_confidence)
            if max_age_ms is not None:
                keep &= maps["age"] <= stored_age(max_age_ms / 1000)
            for product, stored in maps.items():
                write_file(staging / product / f"{camera}.png", encode_png(stored * keep))
            density[camera] = {
                "measured": _density(maps["depth"], keep),
                "filled": _density(maps["depth_filled"], keep),
            }
        record = {
            "run": str(run),
            "min_confidence": float(min_confidence),
            "max_age_ms": None if max_age_ms is None else float(max_age_ms),
            "density": {c: {k: asdict(v) for k, v in d.items()} for c, d in density.items()},
            "version": __version__,
        }
        text = yaml.safe_dump(record, sort_keys=False, allow_unicode=True)
        write_file(staging / "export.yaml", text.encode())
    written = [folder / product / f"{camera}.png" for product in _KINDS for camera in cameras]
    return Export([*written, folder / "export.yaml"], density)


def _check_thresholds(min_confidence: float, max_age_ms: float | None) -> None:
    if not 0 <= min_confidence <= 1:
        raise InputError(f"--min-confidence {min_confidence}: expected a number from 0 to 1")
    if max_age_ms is not None and not 0 <= max_age_ms < np.inf:
        raise InputError(f"--max-age-ms {max_age_ms}: expected a number from 0 up")


def _cameras(run: Path) -> list[str]:
    """Cameras, or CAMERA/NUMBER of their images, of which all maps are there."""
    if not (run / "run.yaml").is_file():
        raise InputError(
            f"{run}: no run.yaml in it; expected the folder of a finished run and key, such as "
            f"densify-out/000120"
        )
    cameras = sorted(
        {
            path.relative_to(run / product).with_suffix("").as_posix()
            for product in _KINDS
            for path in (run / product).rglob("*.png")
        }
    )
    if not cameras:
        raise InputError(f"{run}: no depth maps in it; run densify with a camera first")
    paths = [run / product / f"{camera}.png" for camera in cameras for product in _KINDS]
    missing = [str(path.relative_to(run)) for path in paths if not path.is_file()]
    if missing:
        raise InputError(
            f"{run}: {', '.join(missing)} missing; densify the key again (run --overwrite)"
        )
    return cameras


def _read_maps(run: Path, camera: str) -> dict[str, NDArray[Any]]:
    """Maps by product, (H,W) each, as stored."""
    maps = {
        p: read_stored(run / p / f"{camera}.png", kind, f"a map of {p}")
        for p, kind in _KINDS.items()
    }
    filled = maps["depth_filled"]
    for product, stored in maps.items():
        path = run / product / f"{camera}.png"
        if stored.shape != filled.shape:
            raise InputError(
                f"{path}: got {stored.shape[1]} x {stored.shape[0]} px, expected "
                f"{filled.shape[1]} x {filled.shape[0]} as in depth_filled; densify the key again"
            )
        strangers = (stored > 0) & (filled == 0)
        if product != "depth":
            strangers |= (stored == 0) & (filled > 0)
        if strangers.any():
            raise InputError(
                f"{path}: does not belong to depth_filled, {np.count_nonzero(strangers)} pixels "
                f"have a value in one of them only; densify the key again"
            )
    return maps


def _density(stored: NDArray[Any], keep: Bool) -> Density:
    has_depth = stored > 0
    return Density(float(has_depth.mean()), float((has_depth & keep).mean()))
