# SPDX-License-Identifier: MIT
"""The flow of a whole recording in the forms that other programs take; NAME is the recording's::

    npz            OUT/000119_000120.npz  flow files, see `densify.readers.flow_files`
    av2            OUT/NAME/STAMP.feather  of the Argoverse 2 scene flow challenge of 2024: is_valid
                   bool, flow_tx_m flow_ty_m flow_tz_m float16, to the next sweep without the
                   ego-motion, in the frame of the sweep's file; a row for each of the file's
    opensceneflow  OUT/NAME.h5  every sweep with its flow, see `densify.outputs.flow_h5`

The challenge takes every fifth sweep, zipped as NAME/0000000000.feather, NAME/0000000005.feather
and so on; the masks that it publishes say which points count.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from densify.config.errors import InputError, OutputError
from densify.geometry.types import KnowsRows, LidarSequence, StretchFlow
from densify.outputs.atomic import file_aside, write_file
from densify.outputs.flow_h5 import flow_h5
from densify.outputs.flow_npz import write_flow_files
from densify.readers.extras import needed

FORMATS = ("npz", "av2", "opensceneflow")

FlowWriter = Callable[[int, StretchFlow], Path]
"""Writes a sweep and its flow to the next, the only step it is given (none: the last sweep), and
returns the file."""


@contextmanager
def flow_writer(
    form: str, sequence: LidarSequence, out: Path, frames: Sequence[int], overwrite: bool
) -> Iterator[FlowWriter]:
    """A writer for these sweeps. Each file appears when it is complete, opensceneflow's with all
    sweeps in it.

    form: of `FORMATS`. Raises InputError for a package that is not installed and for files that are
    there and not to be overwritten, OutputError where nothing can be written.
    """
    folder = out / _file_name(sequence.name) if form == "av2" else out
    places = _places(form, sequence, folder, frames)
    there = [place.name for place in places if place.exists()]
    if there and not overwrite:
        others = f" and {len(there) - 1} more" if len(there) > 1 else ""
        raise InputError(
            f"{folder}: {there[0]}{others} already there and kept; give --overwrite to replace "
            f"them or another --out DIR"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if form == "opensceneflow":
            with file_aside(places[0]) as aside, flow_h5(aside) as put:
                yield lambda frame, flow: put(frame, flow) or places[0]
        elif form == "av2":
            needed("pyarrow.feather", "argoverse", "Argoverse 2's flow files")
            yield lambda frame, flow: _write_feather(folder, sequence, frame, flow)
        else:
            yield lambda frame, flow: _write_npz(folder, frame, flow)
    except OSError as error:
        raise OutputError(f"--out {out}: cannot be written: {error.strerror or error}") from error


def _places(form: str, sequence: LidarSequence, folder: Path, frames: Sequence[int]) -> list[Path]:
    if form == "av2":
        return [folder / f"{sequence.stamp_ns(frame)}.feather" for frame in frames]
    if form == "opensceneflow":
        return [folder / f"{_file_name(sequence.name)}.h5"]
    following = dict(zip(sequence.frames[:-1], sequence.frames[1:], strict=True))
    return [
        folder / f"{frame:06d}_{following[frame]:06d}.npz" for frame in frames if frame in following
    ]


def _file_name(name: str) -> str:
    """Streets are named by specs."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)


def _write_npz(folder: Path, frame: int, flow: StretchFlow) -> Path:
    write_flow_files(folder, flow)
    return next((folder / f"{a:06d}_{b:06d}.npz" for a, b in flow.steps), folder)


def _write_feather(folder: Path, sequence: LidarSequence, frame: int, flow: StretchFlow) -> Path:
    """Rows without a valid return stand still, as the ground does."""
    arrow, feather = (needed(m, "argoverse", "") for m in ("pyarrow", "pyarrow.feather"))
    sweep = flow.stretch[frame].sweep
    num_rows = sequence.num_rows(frame) if isinstance(sequence, KnowsRows) else len(sequence[frame])
    residual = np.zeros((num_rows, 3), np.float16)
    for field in flow.steps.values():
        residual[sweep.row] = field.displacement
    columns = {"is_valid": np.ones(num_rows, bool)}
    columns |= dict(zip(("flow_tx_m", "flow_ty_m", "flow_tz_m"), residual.T.copy(), strict=True))
    buffer = io.BytesIO()
    feather.write_feather(arrow.table(columns), buffer)
    path = folder / f"{sequence.stamp_ns(frame)}.feather"
    write_file(path, buffer.getvalue())
    return path
