# SPDX-License-Identifier: MIT
"""Flow files: scene flow between two sweeps on disk, ours or another method's.

``000119_000120.npz`` holds the flow of the points of sweep 119 to the time of sweep 120::

    residual_flow  (N,3) metres, without the ego motion: 0 for what stands still; in the lidar frame
                   of the source sweep, or, instead of it,
    total_flow     (N,3) metres with the ego motion: from the point in the source's lidar frame to
                   where it is in the target's (then our registration takes the ego motion out)
    row            (N,) row of each point in the source sweep's file; without it N is their number
    moving         (N,) bool; without it everything with a residual flow of 5 cm or more
    object         (N,) which moving object, the same number in every file, -1 none; without it none
    valid          (N,) bool, of labels: the point's flow is known; read for scoring alone
    to_reference   (N,3) metres, own motion from the point's firing to the sweep's reference time;
                   without it 0
"""

from __future__ import annotations

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
"""From sweep to sweep nothing on a road goes farther."""
_WIDE = ("residual_flow", "total_flow", "to_reference")
_KNOWN = (*_WIDE, "row", "moving", "object", "valid")


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """The flow files of a folder as an engine, see `densify.flow.engines.EngineModule`.

    argument: the folder.
    """
    files = FlowFiles(Path(argument), scene.stretch)
    return ChainedMotion(scene.stretch, files.step)


def check_argument(argument: str) -> None:
    """Raise InputError unless the folder is there."""
    if not Path(argument).is_dir():
        raise InputError(f"flow.engine npz:{argument}: no such folder; expected flow files in it")


class FlowFiles:
    """The flow files of a folder, for the sweeps of a stretch.

    Raises InputError for a folder that is not there.
    """

    def __init__(self, folder: Path, stretch: Stretch) -> None:
        check_argument(str(folder))
        self._folder, self._stretch = folder, stretch

    def step(self, here: int, there: int) -> FlowField:
        """Flow of sweep number ``here`` to number ``there``; points of other rows do not move.

        Raises InputError for a file that is missing, damaged, or of another form.
        """
        frame, target = (self._stretch.frames[i] for i in (here, there))
        path = self._folder / f"{frame:06d}_{target:06d}.npz"
        arrays = load_flow_file(path)
        row = self._stretch.sweeps[here].sweep.row
        at, known = rows_in_file(path, arrays, row)

        def column(name: str, width: int | None, default: Any) -> NDArray[Any]:
            found = np.full(len(row) if width is None else (len(row), width), default)
            if name in arrays:
                found[known] = arrays[name][at]
            return found

        residual = column("residual_flow", 3, 0.0)
        if "residual_flow" not in arrays:
            points = self._stretch.sweeps[here].sweep.points
            moved = points + column("total_flow", 3, 0.0)
            back = poses.transform(self._stretch.T_target_source(frame, target), moved)
            residual[known] = (back - points - column("to_reference", 3, 0.0))[known]
        moving = column("moving", None, False)
        if "moving" not in arrays:
            moving = np.linalg.norm(residual, axis=1) >= MOVES_M
        residual[~moving] = 0.0
        return FlowField(
            residual,
            moving,
            column("object", None, np.int32(-1)),
            np.zeros(len(row), bool),
            column("to_reference", 3, 0.0) if "to_reference" in arrays else None,
        )


def rows_in_file(
    path: Path, arrays: dict[str, NDArray[Any]], row: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Where in the file each of the sweep's points is that the file knows, and which those are.

    row: (N,) of the points in the sweep's file. Raises InputError where the file has too few.
    """
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
    found = place[row]
    return found[found >= 0], found >= 0


def load_flow_file(path: Path) -> dict[str, NDArray[Any]]:
    """A flow file's arrays. Raises InputError if it is missing, damaged, or of another form."""
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
        if name in _WIDE and (np.abs(array, dtype=np.float64) > FARTHEST_M).any():
            raise InputError(
                f"{path}: array {name}: got a step of {np.abs(array, dtype=np.float64).max():g} m, "
                f"expected metres, {FARTHEST_M:g} at most"
            )
    if (arrays.get("row", np.zeros(1)) < 0).any():
        raise InputError(f"{path}: array row: got a negative one, expected row numbers from 0 up")
    return arrays
