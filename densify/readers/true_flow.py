# SPDX-License-Identifier: MIT
"""Read true scene flow beside a recording, for scoring: labels of every point's flow to the next
sweep, in one of two forms, told apart by what lies there::

    DIR/000119_000120.npz   a flow file (`densify.readers.flow_files`)
    DIR/[LOG/]STAMP.feather Argoverse 2's labels as BucketedSceneFlowEval stores them: flow_tx_m
                            flow_ty_m flow_tz_m without ego motion, in the vehicle's frame at the
                            stamp; is_valid; classes_0, -1 the background, else the category's
                            place in `CATEGORIES`. Named by stamps, or 0000000000, 0000000001, …

A feather file has all points of the sweep's file, row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.geometry.types import Bool, Float, Stretch
from densify.readers.arrow_columns import read_feather
from densify.readers.flow_files import sweep_columns
from densify.scores.challenge import CLASSES, IGNORED

CATEGORIES = {
    "ANIMAL": None,
    "ARTICULATED_BUS": "OTHER_VEHICLES",
    "BICYCLE": "WHEELED_VRU",
    "BICYCLIST": "WHEELED_VRU",
    "BOLLARD": None,
    "BOX_TRUCK": "OTHER_VEHICLES",
    "BUS": "OTHER_VEHICLES",
    "CONSTRUCTION_BARREL": None,
    "CONSTRUCTION_CONE": None,
    "DOG": None,
    "LARGE_VEHICLE": "OTHER_VEHICLES",
    "MESSAGE_BOARD_TRAILER": None,
    "MOBILE_PEDESTRIAN_CROSSING_SIGN": None,
    "MOTORCYCLE": "WHEELED_VRU",
    "MOTORCYCLIST": "WHEELED_VRU",
    "OFFICIAL_SIGNALER": "PEDESTRIAN",
    "PEDESTRIAN": "PEDESTRIAN",
    "RAILED_VEHICLE": "OTHER_VEHICLES",
    "REGULAR_VEHICLE": "CAR",
    "SCHOOL_BUS": "OTHER_VEHICLES",
    "SIGN": None,
    "STOP_SIGN": None,
    "STROLLER": "PEDESTRIAN",
    "TRAFFIC_LIGHT_TRAILER": None,
    "TRUCK": "OTHER_VEHICLES",
    "TRUCK_CAB": "OTHER_VEHICLES",
    "VEHICULAR_TRAILER": "OTHER_VEHICLES",
    "WHEELCHAIR": "PEDESTRIAN",
    "WHEELED_DEVICE": "WHEELED_VRU",
    "WHEELED_RIDER": "WHEELED_VRU",
}
"""Argoverse 2's categories and the classes that the challenge of 2024 puts them in; None: left out
(`av2_metacategories` of the package bucketed-scene-flow-eval)."""

_CLASS_OF = np.array(
    [0] + [IGNORED if c is None else CLASSES.index(c) for c in CATEGORIES.values()], np.uint8
)
_OBJECT = CLASSES.index("OBJECT")
_FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


@dataclass(frozen=True)
class LabelledFlow:
    """The truth of a registered sweep's N points.

    flow: (N,3) metres to the next sweep, ego motion removed, in the lidar frame. classes: (N,)
    uint8 as in `densify.scores.challenge`. valid: (N,) bool, its flow is known.
    """

    flow: Float
    classes: NDArray[np.uint8]
    valid: Bool


def labelled_flow(place: Path, name: str, stretch: Stretch, frame: int) -> LabelledFlow:
    """Return the labels of one sweep's flow to the next sweep of the stretch.

    place: as above. name: of the recording, whose folder may lie there. Raises InputError where
    there are no labels of that sweep, or they are damaged or not its own.
    """
    if not place.is_dir():
        raise InputError(f"--truth {place}: no such folder; expected true flow in it")
    target = stretch.frames[stretch.frames.index(frame) + 1]
    path = place / f"{frame:06d}_{target:06d}.npz"
    if path.is_file() or any(place.glob("*_*.npz")):
        sweep, T = stretch[frame].sweep, stretch.T_target_source(frame, target)
        found = sweep_columns(path, sweep.row, sweep.points, T)
        classes = np.where(found["object"] >= 0, _OBJECT, 0).astype(np.uint8)
        return LabelledFlow(found["residual_flow"], classes, found["valid"])
    here = place / name if (place / name).is_dir() else place
    files = {int(p.stem): p for p in here.glob("*.feather") if p.stem.isdecimal()}
    if not files:
        raise InputError(
            f"--truth {place}: holds no labels of {name}; expected FRAME_NEXT.npz, or "
            f"STAMP.feather there or in a folder {name}"
        )
    stamp_ns = stretch[frame].sweep.stamp_ns
    path = files.get(stamp_ns, files.get(frame, here / f"{stamp_ns}.feather"))
    return _read_feather(path, stretch[frame].sweep.row)


def _read_feather(path: Path, row: NDArray[np.int64]) -> LabelledFlow:
    """row: (N,) of the sweep's points in its file."""
    kinds = {**dict.fromkeys(_FLOW, "m"), "is_valid": "t", "classes_0": "i"}
    columns = read_feather(path, kinds, "Argoverse 2's flow labels")
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
