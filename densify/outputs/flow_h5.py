# SPDX-License-Identifier: MIT
"""Flow as OpenSceneFlow's files hold it (`densify.readers.open_scene_flow.reader`), so that its
training, evaluation and pictures take it::

    flow/KEY.h5    a group for each sweep of the window, named by its stamp (ns): lidar (N,4)
                   deskewed to the stamp, pose (4,4), lidar_id; ground_mask, nothing; row (N,) in
                   the sweep's file; up to the key also flow (N,3) to the next sweep, with the
                   ego-motion, flow_is_valid, flow_instance_id (0 none), ego_motion (4,4)

Towards the key flow is known; of the sweeps after it there is none forwards. The ground is not
marked, since no later step here needs it marked: whoever wants it left out segments it there.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry import poses
from densify.geometry.types import StretchFlow
from densify.outputs.atomic import write_file
from densify.readers.extras import needed


def write_flow_h5(folder: Path, key: int, flow: StretchFlow) -> None:
    """``folder/000120.h5``. Raises InputError where h5py is not installed."""
    folder.mkdir(exist_ok=True)
    buffer = io.BytesIO()
    with flow_h5(buffer) as put:
        for frame in flow.stretch.frames:
            put(frame, flow)
    write_file(folder / f"{key:06d}.h5", buffer.getvalue())


@contextmanager
def flow_h5(place: Path | io.BytesIO) -> Iterator[Callable[[int, StretchFlow], None]]:
    """A file that takes sweep after sweep, each with its flow to the next where that is known.
    Raises InputError where h5py is not installed."""
    h5py = needed("h5py", "opensceneflow", "OpenSceneFlow's files")
    with h5py.File(place, "w") as file:

        def put(frame: int, flow: StretchFlow) -> None:
            group = file.create_group(str(flow.stretch[frame].sweep.stamp_ns))
            arrays = _sweep(flow, frame)
            for here, following in flow.steps:
                if here == frame and following > frame:
                    arrays |= _flow(flow, frame, following)
            for name, array in arrays.items():
                group.create_dataset(name, data=array)

        yield put


def _sweep(flow: StretchFlow, frame: int) -> dict[str, Any]:
    registered = flow.stretch[frame]
    sweep = registered.sweep
    return {
        "lidar": np.column_stack([sweep.points, 255 * sweep.intensity]).astype(np.float32),
        "pose": registered.T_world_lidar,
        "lidar_id": sweep.lidar,
        "ground_mask": np.zeros(len(sweep), bool),
        "row": sweep.row,
    }


def _flow(flow: StretchFlow, frame: int, following: int) -> dict[str, Any]:
    """The flow of a point leads from where it was measured, as it is stored, to the next sweep's
    time."""
    points, field = flow.stretch[frame].sweep.points, flow.steps[frame, following]
    T = flow.stretch.T_target_source(following, frame)
    return {
        "flow": (poses.transform(T, points + field.total) - points).astype(np.float32),
        "flow_is_valid": ~field.lost,
        "flow_instance_id": (field.instance + 1).astype(np.int16),
        "ego_motion": T.astype(np.float32),
    }
