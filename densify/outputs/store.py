# SPDX-License-Identifier: MIT
"""Write the files of ``run`` or ``compare`` of one key to ``OUT/000120/...``, all or none."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from densify.config.errors import InputError
from densify.geometry.types import Result
from densify.outputs import flow_writers, key_outputs, plots
from densify.outputs.atomic import staged_folder, write_json
from densify.outputs.key_outputs import Context
from densify.outputs.recording_folder import check_recording
from densify.outputs.report.key_page import write_report

_OUTPUTS: Mapping[tuple[str, ...], Callable[[Result, Context, Path], None]] = {
    ("depth", "depth_filled", "confidence", "age"): key_outputs.write_depth,
    ("depth_full", "confidence_full"): key_outputs.write_full,
    ("flow",): flow_writers.write_flow,
    ("movers",): key_outputs.write_movers,
    ("movers.json",): key_outputs.write_tracks,
    ("optical_flow",): key_outputs.write_optical_flow,
    ("cloud.laz",): key_outputs.write_cloud_laz,
    ("scene",): key_outputs.write_scene,
    ("metrics.json",): key_outputs.write_metrics,
    ("figure.png",): plots.write_key_figure,
    ("curve.png",): plots.write_curve,
    ("run.yaml",): key_outputs.write_run_yaml,
    ("report.html",): write_report,  # last, because it reads the files written above
}
"""Names of the entries in the folder of a key sweep, and the function that writes them.

A function writes no entry if the result lacks its content. Equal results give equal bytes."""

_RUN = tuple(name for names in _OUTPUTS for name in names)
_COMPARISON = ("compare.json", "compare.png", "compare", "compare.html")


def check_writable(
    out: Path,
    key: int,
    overwrite: bool = False,
    verb: Literal["run", "compare"] = "run",
) -> None:
    """Raise InputError if a result of ``verb`` cannot be written. No file is changed."""
    owned = _RUN if verb == "run" else _COMPARISON
    _check_place(_key_folder(out, key), owned, out, overwrite)


@contextmanager
def writing(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a folder for the entries ``owned`` (as `staged_folder`), after `check_writable`."""
    _check_place(folder, owned, out, overwrite)
    with staged_folder(folder, owned) as staging:
        yield staging


def _check_place(folder: Path, owned: Collection[str], out: Path, overwrite: bool) -> None:
    place = folder
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"--out {out}: {place} is not a folder; choose another one with --out DIR")
    # An existing folder is renamed, and a new folder beside it takes its place.
    beside = [Path(os.path.realpath(place)).parent] if place == folder else []
    for touched in (place, *beside):
        if not os.access(touched, os.W_OK | os.X_OK):
            raise InputError(
                f"--out {out}: no permission to write in {touched}; choose another one with --out"
            )
    present = [name for name in owned if (folder / name).exists()]
    if present and not overwrite:
        raise InputError(
            f"{folder}: {', '.join(present)} already there and kept; "
            f"give --overwrite to replace them or another --out DIR"
        )


def write_result(
    result: Result,
    out: Path,
    *,
    config: Mapping[str, Any],
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """Write the result of one key sweep to ``out/KEY/`` and return the paths of the files.

    ``config`` is the merged configuration, ``data`` the recording as the user named it.
    """
    context = Context(config, data)
    check_recording(out, result.recording, data, [result.key])
    with writing(_key_folder(out, result.key), _RUN, out, overwrite) as folder:
        for write in _OUTPUTS.values():
            write(result, context, folder)
    return _written(out, result.key, _RUN)


def write_comparison(
    results: Mapping[str, Result],
    out: Path,
    *,
    config: Mapping[str, Any],
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """Write compare.json and compare.png of several methods, and return the paths of the files.

    The folder ``compare/`` has the files of the last method. Other arguments as in `write_result`.
    """
    last = list(results.values())[-1]
    key, context = last.key, Context(config, data)
    table = {
        "schema_version": key_outputs.SCHEMA_VERSION,
        **key_outputs.record(last, context),
        "methods": {m: {"frames": r.frames, **r.metrics} for m, r in results.items()},
        "warnings": list(dict.fromkeys(w for r in results.values() for w in r.warnings)),
    }
    check_recording(out, last.recording, data, [key])
    with writing(_key_folder(out, key), _COMPARISON, out, overwrite) as folder:
        write_json(folder / "compare.json", table)
        plots.write_figure(folder / "compare.png", results)
        for name in ("write_depth", "write_cloud_laz", "write_tracks", "write_scene"):
            getattr(key_outputs, name)(last, context, folder / "compare")
    return _written(out, key, _COMPARISON)


def _key_folder(out: Path, key: int) -> Path:
    return out / f"{key:06d}"


def _written(out: Path, key: int, owned: Sequence[str]) -> list[Path]:
    places = [_key_folder(out, key) / name for name in owned]
    found = [path for place in places for path in (place, *sorted(place.rglob("*")))]
    return [path for path in found if path.is_file()]
