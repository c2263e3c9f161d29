# SPDX-License-Identifier: MIT
"""The files of one key, ``OUT/000120/...``: results of ``run`` and tables of ``compare``, whole or
not at all. What ``run`` writes is the table `config.plugins.outputs`; each module says what its
files hold.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol, cast

from densify.config.errors import InputError, OutputError
from densify.config.plugins.outputs import OUTPUTS, Output, chosen
from densify.geometry.types import Result
from densify.outputs import cloud_laz, depth_maps, scene, tracks
from densify.outputs.atomic import staged_folder
from densify.outputs.context import Context
from densify.outputs.figure import write_figure
from densify.outputs.metrics import SCHEMA_VERSION, scores_of
from densify.outputs.plain import write_json
from densify.outputs.png import Picture
from densify.outputs.run_yaml import stages, versions

Verb = Literal["run", "compare"]

_COMPARISON = ("compare.json", "compare.png", "compare", "compare.html")


class OutputModule(Protocol):
    """What the module of an output has."""

    def write_output(self, result: Result, context: Context, folder: Path) -> None:
        """Write the files that the output owns, where the result has something for them.

        folder: of the key, not yet in its place: all of it appears when every output is done, or
        nothing does. Same result and context, same bytes.
        """
        ...


def check_writable(
    out: Path, key: int, overwrite: bool = False, verb: Verb = "run", also: str = ""
) -> None:
    """Find out before a computation whether its result can be written; touches nothing.

    out: the folder of ``--out``, which need not exist. also: as ``output.also``. Raises InputError
    if the files that ``verb`` writes for ``key`` are there and not to be overwritten, the place
    cannot be written to, or an output is not there.
    """
    owned = _owned(chosen(also)) if verb == "run" else _COMPARISON
    _check_place(_key_folder(out, key), owned, out, overwrite)


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
    also: str = "",
) -> list[Path]:
    """Write one densified key as ``out/KEY/``: what the outputs of the table make of it.

    images: camera to (H,W,3) RGB; a camera without one is drawn on black. config: the merged
    configuration, as plain mappings. data: the recording, as the user named it. overwrite: replace
    an earlier result; whatever else lies in the folder is kept either way. also: outputs of other
    packages, as ``output.also``.

    Returns the files written. Raises InputError if the place cannot be written to, or holds a
    result already.
    """
    rows = chosen(also)
    owned, context = _owned(rows), Context(images, config, data)
    with writing(_key_folder(out, result.key), owned, out, overwrite) as folder:
        for row in rows:
            cast(OutputModule, OUTPUTS.module(row)).write_output(result, context, folder)
            strays = sorted({entry.name for entry in folder.iterdir()} - set(owned))
            if strays:
                raise InputError(
                    f"output {row.name}: wrote {', '.join(strays)}, expected nothing but "
                    f"{', '.join(row.owned)}; mend {row.module}"
                )
    return _written(out, result.key, owned)


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
    of a run where there are some; in ``compare/`` the last method's maps and cloud as
    `write_result` has them, with the others' maps in its scene.

    results: method to result, of one key. The rest as `write_result`.
    """
    last = list(results.values())[-1]
    key, context = last.key, Context(images, config, data)
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": key,
        "data": data,
        "methods": {method: scores_of(result) for method, result in results.items()},
        "config": config,
        "stages": stages(last),
        "warnings": list(dict.fromkeys(w for r in results.values() for w in r.warnings)),
        "versions": versions(),
    }
    with writing(_key_folder(out, key), _COMPARISON, out, overwrite) as folder:
        write_json(folder / "compare.json", table)
        write_figure(folder / "compare.png", results, context)
        maps = folder / "compare"
        maps.mkdir()
        for output in (depth_maps, cloud_laz, tracks, scene):
            output.write_output(last, context, maps)
    return _written(out, key, _COMPARISON)


def _key_folder(out: Path, key: int) -> Path:
    return out / f"{key:06d}"


def _owned(rows: Sequence[Output]) -> tuple[str, ...]:
    return tuple(name for row in rows for name in row.owned)


def _written(out: Path, key: int, owned: Sequence[str]) -> list[Path]:
    folder = _key_folder(out, key)
    files: list[Path] = []
    for name in owned:
        entry = folder / name
        files += [entry] if entry.is_file() else sorted(f for f in entry.rglob("*") if f.is_file())
    return files
