# SPDX-License-Identifier: MIT
"""Flow files: scene flow between two sweeps on disk, ours or another method's.

``000119_000120.npz`` holds the flow of the points of sweep 119 to the time of sweep 120::

    residual_flow  (N,3) metres, ego motion removed, in the source's lidar frame, or instead of it
    total_flow     (N,3) metres with the ego motion: from the point in the source's lidar frame to
                   its position in the target's (then our registration removes the ego motion)
    row            (N,) row of each point in the source sweep's file; without it N is their number
    moving         (N,) bool; without it everything with a residual flow of 0.05 m or more
    object         (N,) moving object, the same number in every file, -1 none; without it none
    valid          (N,) bool, of labels: the point's flow is known; read for scoring alone
    to_reference   (N,3) metres, own motion from the point's firing to the sweep's reference time;
                   without it 0
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.config.errors import InputError
from densify.flow.chained import ChainedMotion
from densify.flow.engines import Scene
from densify.geometry import poses
from densify.geometry.types import FlowField, Motion, Stretch
from densify.readers.decoded_files import read_arrays

MOVES_M = 0.05
FARTHEST_M = 1000.0
"""The longest step between sweeps that is believed."""
_WIDE = ("residual_flow", "total_flow", "to_reference")
_KNOWN = (*_WIDE, "row", "moving", "object", "valid")


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Read the flow files of a folder as an engine, see `densify.flow.engines.EngineModule`."""
    check_argument(argument)
    step = partial(read_step, Path(argument), scene.stretch)
    return ChainedMotion(scene.stretch, step)


def check_argument(argument: str) -> None:
    """Raise InputError unless the folder is there."""
    if not Path(argument).is_dir():
        raise InputError(f"flow.engine npz:{argument}: no such folder; expected flow files in it")


def read_step(folder: Path, stretch: Stretch, here: int, there: int) -> FlowField:
    """Return the flow of sweep number ``here`` to number ``there``. Points that the file does not
    have are static. Raises InputError for a file that is missing, damaged, or of another form."""
    frame, target = stretch.frames[here], stretch.frames[there]
    sweep, T_here_there = stretch.sweeps[here].sweep, stretch.T_target_source(frame, target)
    path = folder / f"{frame:06d}_{target:06d}.npz"
    columns = sweep_columns(path, sweep.row, sweep.points, T_here_there)
    residual, moving = columns["residual_flow"], columns["moving"].astype(bool)
    residual[~moving] = 0.0
    instance, lost = columns["object"].astype(np.int32), np.zeros(len(moving), bool)
    return FlowField(residual, moving, instance, lost, columns.get("to_reference"))


def sweep_columns(
    path: Path, row: NDArray[np.int64], points: NDArray[np.float64], T_here_there: NDArray[Any]
) -> dict[str, NDArray[Any]]:
    """Return a flow file's columns at the (N,) rows of a sweep.

    row, points: (N,) and (N,3) of the sweep. T_here_there: (4,4) from the target's lidar frame.
    Returns residual_flow, moving, object and valid, completed where the file lacks one, and
    to_reference if the file has it; points of other rows have flow 0, object -1 and are not valid.
    """
    arrays = load_flow_file(path)
    num_points = len(next(iter(arrays.values())))
    rows = arrays.get("row", np.arange(num_points))
    if "row" not in arrays and len(row) and row.max() >= num_points:
        raise InputError(
            f"{path}: holds {num_points} points, expected one for each row of the sweep's file "
            f"(more than {row.max()}); add their 'row' where some are left out"
        )
    place = np.full(int(row.max(initial=0)) + 1, -1, np.int64)
    ours = np.flatnonzero(rows < len(place))
    place[rows[ours]] = ours
    known = place[row] >= 0
    at = place[row][known]
    found = {}
    for name in arrays:
        values = np.zeros((len(row), *arrays[name].shape[1:]))
        values[known] = arrays[name][at]
        found[name] = values
    if "residual_flow" not in arrays:
        back = poses.transform(T_here_there, points + found["total_flow"])
        residual = back - points - found.get("to_reference", 0.0)
        found["residual_flow"] = np.where(known[:, None], residual, 0.0)
    if "moving" not in arrays:
        found["moving"] = np.linalg.norm(found["residual_flow"], axis=1) >= MOVES_M
    found["object"] = np.where(known, found.get("object", -1), -1)
    found["valid"] = known & found.get("valid", known).astype(bool)
    return found


def load_flow_file(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays. Raises InputError if the file is missing, damaged, or of another form."""
    if not path.is_file():
        raise InputError(f"{path}: no such flow file; expected one for every step to the key")
    arrays = read_arrays(path, _KNOWN)
    if "residual_flow" not in arrays and "total_flow" not in arrays:
        raise InputError(
            f"{path}: holds none of the arrays residual_flow and total_flow, expected one of them"
        )
    num_points = len(np.atleast_1d(next(iter(arrays.values()))))
    for name, array in arrays.items():
        shape = (num_points, 3) if name in _WIDE else (num_points,)
        kinds, expected = ("iu", "row numbers") if name == "row" else ("fiub", "numbers")
        if array.shape != shape or array.dtype.kind not in kinds:
            raise InputError(
                f"{path}: array {name}: got shape {array.shape} of {array.dtype}, expected "
                f"{expected} of shape {shape}"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{path}: array {name}: got NaN or infinite, expected finite numbers")
        most = np.abs(array, dtype=np.float64).max(initial=0) if name in _WIDE else 0.0
        if most > FARTHEST_M:
            raise InputError(
                f"{path}: array {name}: got a step of {most:g} m, expected metres, {FARTHEST_M:g} "
                f"at most"
            )
    if (arrays.get("row", np.zeros(1)) < 0).any():
        raise InputError(f"{path}: array row: got a negative one, expected row numbers from 0 up")
    return arrays
