# SPDX-License-Identifier: MIT
"""Read flow files: scene flow between two sweeps, from densify or from another method.

``000119_000120.npz`` holds the flow of N points of sweep 119 (source) to the reference time of
sweep 120 (target): residual_flow or total_flow, and optional arrays::

    residual_flow  (N,3) metres, ego-motion removed, in the source's lidar frame
    total_flow     (N,3) metres, target minus source coordinates, each in its sweep's lidar frame
    row            (N,) row index of each point in the sweep's file; default 0 to N - 1
    moving         (N,) bool; default True for a residual flow of 0.05 m or more
    object         (N,) number of the moving object, the same in every file; default -1, no object
    valid          (N,) bool, the ground-truth flow of the point is known; used only for scoring
    to_reference   (N,3) metres, the point's own motion from firing to reference time; default 0

Ground truth for scoring is in flow files or in Argoverse 2 labels of BucketedSceneFlowEval::

    DIR/[LOG/]STAMP.feather  flow_tx_m flow_ty_m flow_tz_m, ego-motion removed, in the vehicle's
                             frame at the stamp; is_valid; classes_0, an index of `CATEGORIES` or
                             -1 for background; a row for each row of the sweep's file. Names are
                             stamps, or 0000000000, 0000000001, …
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.config import Config
from densify.config.errors import InputError
from densify.flow.engines import ChainedMotion, Scene
from densify.geometry import poses
from densify.geometry.types import Bool, Float, FlowField, Motion, Stretch
from densify.readers.decoded_files import read_arrays, read_arrow
from densify.scores.metrics import CLASSES, IGNORED

MOVES_M = 0.05
FARTHEST_M = 1000.0
"""Longest flow vector that is accepted; a longer vector raises InputError."""
_WIDE = ("residual_flow", "total_flow", "to_reference")
_KNOWN = (*_WIDE, "row", "moving", "object", "valid")
Columns = dict[str, NDArray[Any]]


def estimate_motion(scene: Scene, settings: Config, argument: str) -> Motion:
    """Return the motion by the flow files of the folder ``argument`` (engine ``npz:FOLDER``)."""
    check_argument(argument)
    step = partial(read_step, Path(argument), scene.stretch)
    return ChainedMotion(scene.stretch, step)


def check_argument(argument: str) -> None:
    """Raise InputError if the folder of flow files does not exist."""
    if not Path(argument).is_dir():
        raise InputError(f"flow.engine npz:{argument}: no such folder; expected flow files in it")


def read_step(folder: Path, stretch: Stretch, source: int, target: int) -> FlowField:
    """Return the flow of a sweep to another sweep, without ego-motion, in the source's lidar frame.

    ``source`` and ``target`` are indices in ``stretch``. A point that the file lacks is static.
    Raise InputError if the file is missing or malformed.
    """
    columns = _step_columns(folder, stretch, stretch.frames[source], stretch.frames[target])
    residual = columns["residual_flow"]
    moving = columns["moving"].astype(bool)
    residual[~moving] = 0.0
    instance = columns["object"].astype(np.int32)
    lost = np.zeros(len(moving), bool)  # flow files do not state which points are lost
    return FlowField(residual, moving, instance, lost, columns.get("to_reference"))


def _step_columns(folder: Path, stretch: Stretch, frame: int, target: int) -> Columns:
    """Return a flow file's arrays for a sweep's N points, flow 0 and object -1 for missing ones."""
    path = folder / f"{frame:06d}_{target:06d}.npz"
    sweep = stretch[frame].sweep
    row = sweep.row
    arrays = load_flow_file(path)
    num_points = len(next(iter(arrays.values())))
    if "row" not in arrays and row.max(initial=-1) >= num_points:
        raise InputError(
            f"{path}: holds {num_points} points, expected one for each row of the sweep's file "
            f"(more than {row.max()}); add their 'row' where some are left out"
        )

    # The entry of the flow file for each point of the sweep, -1 for none
    stored_row = arrays.get("row", np.arange(num_points))
    entry_of_row = np.full(int(row.max(initial=0)) + 1, -1, np.int64)
    entries = np.flatnonzero(stored_row < len(entry_of_row))
    entry_of_row[stored_row[entries]] = entries
    entry = entry_of_row[row]
    has_entry = entry >= 0
    columns = {}
    for name, array in arrays.items():
        columns[name] = np.zeros((len(row), *array.shape[1:]))
        columns[name][has_entry] = array[entry[has_entry]]

    # Missing columns. residual = T_source_target (p + total) - p - to_reference
    if "residual_flow" not in arrays:
        T_source_target = stretch.T_target_source(frame, target)
        arrived = poses.transform(T_source_target, sweep.points + columns["total_flow"])
        residual = arrived - sweep.points - columns.get("to_reference", 0.0)
        columns["residual_flow"] = np.where(has_entry[:, None], residual, 0.0)
    if "moving" not in arrays:
        columns["moving"] = np.linalg.norm(columns["residual_flow"], axis=1) >= MOVES_M
    columns["object"] = np.where(has_entry, columns.get("object", -1), -1)
    columns["valid"] = has_entry & columns.get("valid", has_entry).astype(bool)
    return columns


def load_flow_file(path: Path) -> Columns:
    """Return the stored arrays of a flow file. Raise InputError if missing or malformed."""
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
        longest_m = np.abs(array, dtype=np.float64).max(initial=0) if name in _WIDE else 0.0
        if longest_m > FARTHEST_M:
            raise InputError(
                f"{path}: array {name}: got a step of {longest_m:g} m, expected metres, "
                f"{FARTHEST_M:g} at most"
            )
    if (arrays.get("row", np.zeros(1)) < 0).any():
        raise InputError(f"{path}: array row: got a negative one, expected row numbers from 0 up")
    return arrays


_CATEGORIES_OF_CLASS: dict[str | None, str] = {
    "CAR": "REGULAR_VEHICLE",
    "PEDESTRIAN": "OFFICIAL_SIGNALER PEDESTRIAN STROLLER WHEELCHAIR",
    "WHEELED_VRU": "BICYCLE BICYCLIST MOTORCYCLE MOTORCYCLIST WHEELED_DEVICE WHEELED_RIDER",
    "OTHER_VEHICLES": "ARTICULATED_BUS BOX_TRUCK BUS LARGE_VEHICLE RAILED_VEHICLE SCHOOL_BUS "
    "TRUCK TRUCK_CAB VEHICULAR_TRAILER",
    None: "ANIMAL BOLLARD CONSTRUCTION_BARREL CONSTRUCTION_CONE DOG MESSAGE_BOARD_TRAILER "
    "MOBILE_PEDESTRIAN_CROSSING_SIGN SIGN STOP_SIGN TRAFFIC_LIGHT_TRAILER",
}
CATEGORIES = dict(
    sorted((name, key) for key, names in _CATEGORIES_OF_CLASS.items() for name in names.split())
)
"""Class in the Argoverse 2 challenge of 2024 for each category, in alphabetical order; None if the
category is ignored (`av2_metacategories` of the package bucketed-scene-flow-eval)."""

_CLASS_OF = np.array(
    [0] + [IGNORED if name is None else CLASSES.index(name) for name in CATEGORIES.values()],
    np.uint8,
)
_OBJECT = CLASSES.index("OBJECT")
_FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


@dataclass(frozen=True)
class LabelledFlow:
    """The ground-truth flow of the N points of a registered sweep."""

    flow: Float  # (N,3) metres to the next sweep, ego-motion removed, in the sweep's lidar frame
    # (N,) uint8 index in `densify.scores.metrics.CLASSES`, or its ``IGNORED``
    classes: NDArray[np.uint8]
    valid: Bool  # (N,) bool, the ground-truth flow of the point is known


def read_labelled_flow(folder: Path, name: str, stretch: Stretch, frame: int) -> LabelledFlow:
    """Return a sweep's ground-truth flow to the next sweep. Raise InputError if it is missing.

    Args:
        folder: Folder of flow files or of Argoverse 2 labels.
        name: Name of the recording, which may be the name of a subfolder.
        stretch: Registered sweeps.
        frame: Frame number of the sweep.
    """
    if not folder.is_dir():
        raise InputError(f"--truth {folder}: no such folder; expected true flow in it")
    if any(folder.glob("*_*.npz")):
        target = stretch.frames[stretch.frames.index(frame) + 1]
        columns = _step_columns(folder, stretch, frame, target)
        # Flow files know objects, but not their classes.
        classes = np.where(columns["object"] >= 0, _OBJECT, 0).astype(np.uint8)
        return LabelledFlow(columns["residual_flow"], classes, columns["valid"])
    label_folder = folder / name if (folder / name).is_dir() else folder
    files = {
        int(path.stem): path for path in label_folder.glob("*.feather") if path.stem.isdecimal()
    }
    if not files:
        raise InputError(
            f"--truth {folder}: holds no labels of {name}; expected FRAME_NEXT.npz, or "
            f"STAMP.feather there or in a folder {name}"
        )
    stamp_ns = stretch[frame].sweep.stamp_ns
    path = files.get(stamp_ns, files.get(frame, label_folder / f"{stamp_ns}.feather"))
    return _read_feather(path, stretch[frame].sweep.row)


def _read_feather(path: Path, row: NDArray[np.int64]) -> LabelledFlow:
    """Read an Argoverse 2 label file for N points with the row indices ``row`` (N,)."""
    kinds = {**dict.fromkeys(_FLOW, "m"), "is_valid": "t", "classes_0": "i"}
    columns = read_arrow(path, kinds, ("argoverse", "Argoverse 2's flow labels"))
    flow = np.stack([columns[axis].astype(np.float64) for axis in _FLOW], axis=1)
    number = columns["classes_0"].astype(np.int64)
    if len(row) and row.max() >= len(flow):
        raise InputError(
            f"{path}: holds {len(flow)} labels, expected one for each row of the sweep's file "
            f"(more than {row.max()}); give the labels of the recording that --data names"
        )
    if ((number < -1) | (number >= len(CATEGORIES))).any():
        raise InputError(
            f"{path}: got categories {number.min()} to {number.max()}, expected -1 to "
            f"{len(CATEGORIES) - 1}"
        )
    valid = columns["is_valid"] & np.isfinite(flow).all(axis=1)
    flow = np.where(valid[:, None], flow, 0.0)
    return LabelledFlow(flow[row], _CLASS_OF[number + 1][row], valid[row])
